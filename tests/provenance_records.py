"""Small records and products for the tests of the record format."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from orthoflow_provenance.arrays import write_product_file
from orthoflow_provenance.document import (
    JsonValue,
    Metric,
    PayloadLike,
    RecordedCell,
    RecordedFigure,
    RecordedFile,
    RecordedInput,
    RunRecord,
    canonical_json,
    sha256_text,
)
from orthoflow_provenance.record import write_record

from tests.report_runs import cell, given, record

WORKFLOW = "orthoflow: 1\nname: court-yard\nseed: 7\n# café\r\n"


@dataclass(frozen=True, kw_only=True)
class Given:
    """A payload as a method would give it."""

    type_name: str = "walls"
    encoding_version: int = 1
    metadata: Mapping[str, JsonValue] = field(default_factory=dict)
    arrays: Mapping[str, NDArray[np.generic]] = field(default_factory=dict)
    mapped: bool = False


def cloud_payload(n_points: int = 3000) -> Given:
    rng = np.random.default_rng(3)
    arrays: dict[str, NDArray[np.generic]] = {
        axis: rng.random(n_points, dtype=np.float32) for axis in "xyz"
    }
    arrays["origin"] = np.array([634512.347, 486215.781, 112.193])
    return Given(
        type_name="cloud", mapped=True, arrays=arrays, metadata={"x": {"$array": "numeric"}}
    )


def walls_payload() -> Given:
    rng = np.random.default_rng(4)
    depth = rng.random((60, 50), dtype=np.float32)
    depth[:5] = np.nan
    arrays: dict[str, NDArray[np.generic]] = {
        "walls/0/depth_m": depth,
        "walls/0/mask": (rng.random((60, 90)) > 0.3).astype(np.uint8),
        "walls/0/origin_world": np.array([1.0, 2.0, 3.0]),
    }
    return Given(arrays=arrays, metadata={"walls": [{"name": "wall 0", "gsd_m": 0.01}]})


class ProductShelf:
    """Product files by digest, as a store keeps them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.files: dict[str, Path] = {}

    def put(self, payload: PayloadLike) -> str:
        path = self.folder / f"product-{len(self.files)}.h5"
        digest = write_product_file(path, payload)
        self.files[digest] = path
        return digest

    def find(self, digest: str) -> Path | None:
        return self.files.get(digest)


def made(address: str, **more: object) -> RecordedCell:
    """A cell that went well, with the key of its preimage."""
    preimage = canonical_json({"what": "orthoflow/step", "params": {"gsd_m": 0.01}})
    facts: dict[str, object] = {
        "distribution": "orthoflow-tls",
        "distribution_version": "0.1.0",
        "result_version": 1,
        "determinism": "exact",
        "params": {"gsd_m": 0.01, "windows": [3, 5, 7], "label": None},
        "params_set": {"gsd_m": 0.01},
        "key": sha256_text(preimage),
        "key_preimage": preimage,
        "started": "2025-01-02T03:04:05Z",
        "ended": "2025-01-02T03:04:06Z",
    }
    return cell(address, **{**facts, **more})


def sample_record(cloud_digest: str, walls_digest: str) -> RunRecord:
    cloud = replace(given("", "c", "cloud"), digest=cloud_digest, embedded=False)
    picture = b"\x89PNG\r\n\x1a\n" + bytes(range(256))
    cells = (
        made("cloud", method="read.scan", outputs={"cloud": cloud}, cached_from="earlier-run"),
        made(
            "wall@plane=hough2d,orient=pnp#2",
            method="raster.grid",
            seed=2**100 + 1,
            inputs={"cloud": replace(cloud, source="cloud.cloud")},
            outputs={"walls": replace(given("", "w", "walls"), digest=walls_digest)},
            metrics=(
                Metric(name="rms_mm", value=1.25, unit="mm"),
                Metric(name="cells", value=5400.0, unit="1", label="cells seen", better="higher"),
            ),
            figures=(
                RecordedFigure(
                    name="residuals", caption="Résidus", media_type="image/png", data=picture
                ),
            ),
            warnings=("the scan has no intensity",),
            citations=("doi:10.1/x", "doi:10.2/y"),
            log="first line\nsecond line\n",
        ),
        cell(
            "ortho",
            method="ortho.pointcloud-direct",
            status="failed",
            error_type="MethodError",
            error_message="no cell has enough points",
        ),
    )
    scan = RecordedFile(name="hall.laz", size_bytes=2**40, sha256=hashlib.sha256(b"a").hexdigest())
    return record(
        cells,
        run_id="20250102-abc",
        name="court-yard",
        status="failed",
        seed=7,
        workflow_source=WORKFLOW,
        workflow_resolved=canonical_json({"name": "court-yard", "seed": 7, "orthoflow": 1}),
        overrides=("wall.gsd_m=0.01",),
        inputs=(
            RecordedInput(name="scan", files=(scan,)),
            RecordedInput(name="calibration", files=()),
        ),
    )


def write_sample(folder: Path, *, embed: bool = False) -> tuple[Path, RunRecord, ProductShelf]:
    """Write the sample record with its products as `run.h5`."""
    shelf = ProductShelf(folder)
    sample = sample_record(shelf.put(cloud_payload()), shelf.put(walls_payload()))
    path = folder / "run.h5"
    write_record(path, sample, shelf.find, embed=embed)
    return path, sample, shelf
