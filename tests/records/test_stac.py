from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pystac
import pytest
import rasterio
from orthoflow_provenance.document import PublishedFile
from pystac.validation import RegisteredValidator

from orthoflow.errors import ArgumentError
from orthoflow.files.publishing import publish_orthoimages
from orthoflow.geometry import WallFrame
from orthoflow.products import Orthoimages
from orthoflow.records.runs import Run
from orthoflow.records.stac import write_stac
from tests import samples
from tests.report_runs import cell, record

SOUTH, UP = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0])
EAST, NORTH = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])


def orthoimages() -> Orthoimages:
    """A wall in its own plane, and a floor in UTM 32 near Munich."""
    corner = np.array([691_000.0, 5_334_000.0, 520.0])
    shared: dict[str, Any] = {"origin_world": corner, "u_world": EAST}
    wall = WallFrame(**shared, v_world=-UP, normal_world=SOUTH, gsd_m=0.01, width=60, height=40)
    floor = WallFrame(
        **shared,
        v_world=-NORTH,
        normal_world=UP,
        gsd_m=0.02,
        width=50,
        height=30,
        map_crs="EPSG:25832",
    )
    return Orthoimages(
        images=tuple(
            samples.orthoimage(
                frame,
                wall=k,
                name=name,
                rgb=np.full((*frame.shape, 3), 90, np.uint8),
                mask=np.ones(frame.shape, np.uint8),
            )
            for k, (frame, name) in enumerate([(wall, "wall 0"), (floor, "floor 1")])
        )
    )


@pytest.fixture
def finished(tmp_path: Path) -> Run:
    folder = tmp_path / "run" / "products" / "mosaic"
    folder.mkdir(parents=True)
    publish_orthoimages(orthoimages(), folder, "sha256:" + "0" * 64)
    published = tuple(
        PublishedFile(
            path=f"products/mosaic/{path.name}",
            size_bytes=path.stat().st_size,
            sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
        )
        for path in sorted(folder.iterdir())
    )
    made = cell("mosaic", ended="2026-01-02T03:04:05.000Z")
    return Run(path=tmp_path / "run" / "run.h5", record=record([made], published=published))


def test_the_collection_is_valid_and_places_what_is_on_earth(finished: Run, tmp_path: Path) -> None:
    folder = tmp_path / "stac"
    folder.mkdir()
    assert write_stac(finished, folder) == 2
    collection = pystac.Collection.from_file(str(folder / "collection.json"))
    core = RegisteredValidator.get_validator()
    parsed = json.loads((folder / "collection.json").read_text())
    core.validate_core(parsed, pystac.STACObjectType.COLLECTION, "1.1.0")
    items = {item.id: item for item in collection.get_items()}
    assert set(items) == {"mosaic.wall_0_ortho", "mosaic.wall_1_ortho"}
    for item in items.values():
        parsed = json.loads(Path(item.self_href).read_text())
        core.validate_core(parsed, pystac.STACObjectType.ITEM, "1.1.0")
        asset = item.assets["image"]
        href = asset.get_absolute_href()
        assert href is not None
        content = Path(href).read_bytes()
        assert asset.extra_fields["file:checksum"] == f"1220{hashlib.sha256(content).hexdigest()}"
        assert asset.extra_fields["file:size"] == len(content)
        assert item.properties["processing_digest"] == f"sha256:{64 * '0'}"
        assert item.properties["gsd"] in (0.01, 0.02)
        with rasterio.open(href) as raster:
            assert item.properties["proj:shape"] == list(raster.shape)
            assert item.properties["proj:transform"] == list(raster.transform)[:6]
    wall, floor = items["mosaic.wall_0_ortho"], items["mosaic.wall_1_ortho"]
    assert (wall.geometry, wall.bbox) == (None, None)
    assert wall.properties["proj:code"] is None
    assert floor.properties["proj:code"] == "EPSG:25832"
    # 191 km / 0.9996 east of 9 degrees, over 6390 km * cos(48.15 deg), less 5 of 10,000.
    assert floor.bbox == pytest.approx([11.567, 48.131, 11.567, 48.131], abs=1e-3)
    assert (floor.properties["proj:wkt2"] or "").startswith("PROJCRS")
    (outline,) = (floor.geometry or {})["coordinates"]
    assert len(outline) == 5
    assert (min(outline)[0], max(outline)[0]) == (floor.bbox[0], floor.bbox[2])
    for path in folder.rglob("*.item.json"):
        text = path.read_text()
        assert str(tmp_path) not in text
        for link in json.loads(text)["links"]:
            assert (path.parent / link["href"]).resolve() == folder / "collection.json"
    assert collection.extent.spatial.bboxes == [floor.bbox]


def test_a_run_without_orthoimages_says_so(finished: Run, tmp_path: Path) -> None:
    for path in finished.folder.rglob("*_ortho.tif"):
        path.unlink()
    with pytest.raises(ArgumentError, match="has no orthoimages among its published files"):
        write_stac(finished, tmp_path)
