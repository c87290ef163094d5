"""Runs made by hand for the report: a comparison with pictures, ties, a failure and repeats."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from orthoflow_plugins.inspect.checkpoints import InspectCheckpoints
from orthoflow_plugins.inspect.truth import InspectTruth
from orthoflow_plugins.orient.pose import ORIENTATION_METRICS
from orthoflow_plugins.plane.detector import DETECTOR_METRICS
from orthoflow_provenance.document import (
    Metric,
    RecordedCell,
    RecordedEnvironment,
    RecordedFigure,
    RecordedProduct,
    RunRecord,
)

from orthoflow.diagnostics import DiagnosticSpec, warning_texts
from orthoflow.files.images import encode_png, encode_webp
from orthoflow.products import (
    Camera,
    Cameras,
    Inspection,
    Intrinsics,
    Orthoimages,
    TieRole,
    Walls,
)
from orthoflow.products.product import Payload, Product
from orthoflow.records.compare import Distance, ProductDistance
from orthoflow.records.runs import Run
from orthoflow.sdk import Method, MetricSpec
from orthoflow.sdk.methods import labelled
from orthoflow.sdk.units import unit_of
from tests import samples

FRAME = samples.facing_south(0.01, 120, 80, (4.0e5, 5.0e6, 3.0))
# Looks at the middle of the wall from 2 m away: x right, y down, z forward.
ROTATION = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
CENTRE = FRAME.origin_world + np.array([0.6, -2.0, -0.4])
FOCAL_PX = 1000.0


class _Declaring(Method):
    """A method that may report what some of the built-in methods do."""

    metrics: ClassVar[tuple[MetricSpec, ...]] = (
        MetricSpec("rms_mm", label="points to the first plane, RMS", better="lower", headline=True),
        *InspectTruth.metrics,
        *InspectCheckpoints.metrics,
        *ORIENTATION_METRICS,
        *DETECTOR_METRICS,
    )


@dataclass(frozen=True, kw_only=True)
class HeldRun(Run):
    """A run whose products are in memory.

    Attributes:
        products: (address, port) -> product.
    """

    products: Mapping[tuple[str, str], Product] = field(default_factory=dict)

    def payloads(self, places: Sequence[tuple[str, str]]) -> Iterator[Payload]:
        for place in places:
            yield self.products[place].to_payload()

    @contextmanager
    def held_open(self) -> Iterator[Run]:
        yield self


# Steps whose name is not their kind's.
_KINDS = {"check": "inspect", "other": "inspect", "first": "orient", "second": "orient"}


# What cells of a kind give where a test does not say it.
_GIVES = {"inspect": "inspection", "orient": "cameras", "raster": "walls"}


def cell(address: str, **more: object) -> RecordedCell:
    """A cell that went well, but for what `more` says."""
    step, _, variants = address.partition("#")[0].partition("@")
    assignment = dict(pair.split("=") for pair in variants.split(",") if pair)
    wanted: dict[str, object] = {
        "address": address,
        "step": step,
        "method": f"{_KINDS.get(step, step)}.toy",
        "status": "ok",
        "assignment": assignment,
        "repeat": int(address.partition("#")[2] or 0),
        "environment": "e1",
        "wall_s": 1.0,
        "cpu_s": more.get("wall_s", 1.0),
        "compile_s": 0.25,
        "params_set": more.get("params", {}),
    }
    type_name = _GIVES.get(str(more.get("method", wanted["method"])).partition(".")[0])
    if type_name and more.get("status", "ok") == "ok":
        made = replace(given("", "0", type_name), embedded=False)
        wanted["outputs"] = {type_name: made}
    return RecordedCell(**{**wanted, **more})  # type: ignore[arg-type]


def warned(*texts: str, code: str = "", subject: str = "", remedy: str = "") -> dict[str, Any]:
    """What a cell holds that warned of something, of a code of its own or of none."""
    spec = DiagnosticSpec(code=code or "warning", severity="warning", text="{text}", remedy=remedy)
    reported = tuple(spec.of(subject, {"text": text}) for text in texts)
    return {"diagnostics": reported, "warnings": warning_texts(reported)}


def metrics(**values: float) -> tuple[Metric, ...]:
    """Metrics as built-in methods declare them; others with the unit that their name ends in."""
    reported = [
        Metric(name=name, value=value, unit=unit_of(name) or "1") for name, value in values.items()
    ]
    return labelled(_Declaring, reported)


def given(source: str, digest: str, type_name: str) -> RecordedProduct:
    """A product that a cell takes or, without a source, gives."""
    return RecordedProduct(
        type_name=type_name,
        encoding_version=1,
        digest=f"sha256:{digest * 64}",
        source=source,
        embedded=not source,
    )


def environment(name: str = "e1", *, threads: int = 2) -> RecordedEnvironment:
    return RecordedEnvironment(
        id=name,
        python="3.11.2",
        os="Linux",
        cpu="toy",
        cores=2,
        threads=threads,
        git_commit=40 * "c" + "+changes",
        packages={"numpy": "2.1"},
    )


def record(cells: Sequence[RecordedCell], **more: object) -> RunRecord:
    wanted: dict[str, object] = {
        "run_id": "r1",
        "name": "toy <run>",
        "created_by": "orthoflow 0.1.0",
        "status": "ok",
        "started": "2026-01-02T03:04:05Z",
        "ended": "2026-01-02T03:05:05Z",
        "seed": 1,
        "workflow_source": "orthoflow: 1\n",
        "workflow_resolved": "{}",
        "environments": (environment(),),
        "cells": tuple(cells),
    }
    return RunRecord(**{**wanted, **more})  # type: ignore[arg-type]


def run_of(
    *cells: RecordedCell, products: Mapping[tuple[str, str], Product] | None = None, **more: object
) -> HeldRun:
    """A run of some cells, with products that they give and other facts of its record."""
    return HeldRun(path=Path("run.h5"), record=record(cells, **more), products=products or {})


def without_products(run: Run) -> Run:
    """A run whose record holds the digests of its products alone."""
    cells = tuple(
        replace(one, outputs={p: replace(out, embedded=False) for p, out in one.outputs.items()})
        for one in run.record.cells
    )
    return replace(run, record=replace(run.record, cells=cells))


def compared_resolved(*patterns: str) -> str:
    """The resolved workflow of a comparison of `plane`, as much of it as the report reads."""
    return json.dumps({"compare": {"baseline": {"plane": "fine"}, "metrics": list(patterns)}})


def compared_run(folder: Path) -> HeldRun:
    """Three variants of `plane`: one repeated, one not, one failed; orthoimages of two."""
    cells = [
        cell("scan", outputs={"cloud": replace(given("", "0", "cloud"), embedded=False)}),
        *(
            cell(
                f"plane@plane=fine{mark}",
                metrics=metrics(rms_mm=value, omega_deg=10.0),
                params={"cell_m": 0.01, "exact": False},
                params_set={"cell_m": 0.01},
                citations=("A. Author, Planes, 2015, doi:10.3390/rs71215869",),
            )
            for mark, value in (("", 1.0), ("#1", 1.2), ("#2", 1.1))
        ),
        cell("plane@plane=coarse", metrics=metrics(rms_mm=4.0, omega_deg=11.0), wall_s=0.2),
        cell("plane@plane=broken", status="failed", error_message="no plane & no <wall>"),
    ]
    products: dict[tuple[str, str], Product] = {}
    for mark, shift, digests in (("fine", 0, "ace1"), ("coarse", 60, "bdf2")):
        made = {
            "wall": walls_product(),
            "orient": cameras_product(),
            "check": inspection_product(),
            "mosaic": orthoimages_product(shift),
        }
        outputs = {
            step: {one.type_name: given("", digest, one.type_name)}
            for digest, (step, one) in zip(digests, made.items(), strict=True)
        }
        walls = {"walls": replace(outputs["wall"]["walls"], source=f"wall@plane={mark}.walls")}
        pictures = (
            ("error_map", "how far", "image/webp", encode_webp(picture(shift))),
            ("chart", "a chart", "image/png", encode_png(picture(shift + 1))),
        )
        more: dict[str, dict[str, Any]] = {
            "wall": {},
            "orient": {"inputs": walls, "cached_from": "r0"},
            "check": {
                "inputs": walls,
                "figures": tuple(
                    RecordedFigure(name=name, caption=caption, media_type=kind, data=data)
                    for name, caption, kind, data in pictures
                ),
                "metrics": metrics(rmse_u_mm=0.4 + shift, completeness=0.9931),
                **warned(f"the grid is <{mark}>"),
            },
            "mosaic": {},
        }
        cells += [
            cell(f"{step}@plane={mark}", outputs=outputs[step], **about)
            for step, about in more.items()
        ]
        products |= {(f"{step}@plane={mark}", one.type_name): one for step, one in made.items()}
    recorded = record(
        cells,
        status="failed",
        workflow_resolved=compared_resolved(
            "plane.rms_mm", "plane.omega_deg", "check.*", "*.wall_s"
        ),
    )
    return HeldRun(path=folder / "run.h5", record=recorded, products=products)


def picture(shift: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """A colour gradient."""
    rows, columns = np.indices(FRAME.shape)
    return np.dstack([columns + shift, 2 * rows, 255 - columns]).astype(np.uint8)


def walls_product() -> Walls:
    depth_m = np.full(FRAME.shape, 0.002, dtype=np.float32)
    shades = np.linspace(0, 1, depth_m.size, dtype=np.float32).reshape(FRAME.shape)
    mask = np.ones(FRAME.shape, dtype=np.uint8)
    return samples.walls(
        samples.wall(FRAME, depth_m=depth_m, sigma_m=depth_m, mask=mask, intensity=shades),
        intensity_source="laser",
    )


def orthoimages_product(shift: int) -> Orthoimages:
    return Orthoimages(
        images=(
            samples.orthoimage(
                FRAME,
                rgb=picture(shift),
                mask=np.ones(FRAME.shape, dtype=np.uint8),
                sources=("cloud",),
            ),
        )
    )


def camera() -> Camera:
    return Camera(
        photo="a.jpg",
        status="ok",
        intrinsics=Intrinsics(width=1200, height=900, fx=FOCAL_PX, fy=FOCAL_PX, cx=600.0, cy=450.0),
        rotation_camera_from_world=ROTATION,
        translation_camera_from_world=-ROTATION @ CENTRE,
    )


def cameras_product() -> Cameras:
    n_ties = 30
    rng = np.random.default_rng(4)
    pixels_wall = rng.uniform((5, 5), (115, 75), (n_ties, 2))
    points_world = FRAME.world_from_wall(pixels_wall)
    role = np.array([TieRole.CONTROL, TieRole.CHECK, TieRole.REJECTED] * 10, dtype=np.uint8)
    ties = samples.ties(
        np.zeros((n_ties, 2)),
        photo_names=("a.jpg",),
        points_world=points_world,
        sigma_px=np.ones(n_ties),
        sigma_m=np.ones(n_ties),
        role=role,
        residual_px=rng.normal(0.0, 0.5, (n_ties, 2)),
    )
    return Cameras(cameras=(camera(),), ties=ties)


def inspection_product() -> Inspection:
    pixels_wall = np.array([[20.0, 20.0], [100.0, 60.0]])
    return Inspection(
        wall=np.zeros(2, dtype=np.int32),
        points_world=FRAME.world_from_wall(pixels_wall),
        displacement_m=np.array([[0.001, 0.0], [0.0, -0.001]]),
        kind=np.zeros(2, dtype=np.uint8),
        kinds=("patch",),
        findings=(),
    )


def distance(port: str, verdict: str, reason: str = "", *parts: Distance) -> ProductDistance:
    """How far a product of two runs is apart."""
    return ProductDistance(
        cell="a",
        port=port,
        type_name="planes",
        verdict=verdict,  # type: ignore[arg-type]
        left="1",
        right="2",
        distances=parts,
        reason=reason,
    )
