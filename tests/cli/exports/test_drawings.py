"""What an export of drawings asks of those who draw: scale, sheets, pictures, and refusals."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from orthoflow.cli.exports import drawings as module
from orthoflow.cli.exports.choices import Choices
from orthoflow.products import Orthoimages
from tests import samples


def wall(width_m: float = 3.8, height_m: float = 2.3, *kinds: str, gsd_m: float = 0.01) -> Any:
    """A wall whose pictures nobody opens."""
    shape = (round(width_m / gsd_m), round(height_m / gsd_m))
    return SimpleNamespace(
        number=7,
        plane_index=7,
        name="wall 7",
        frame=samples.facing_east(gsd_m, *shape, (1.0, 2.0, 30.0)),
        rasters={kind: Path(f"{kind}.tif") for kind in kinds or ("ortho", "depth")},
        accuracy=("RMSE 1 mm", "RMS 2 mm"),
        colours="colours untouched",
        intensity_source="laser",
    )


def results(**more: Any) -> Any:
    plain = {"planes": None, "address": "mosaic", "openings_of": lambda _: (), "walls": (wall(),)}
    return SimpleNamespace(**(plain | more))


# --- CAD and GIS ---


@pytest.fixture
def drawn_files(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """Which writer would have written which file."""
    kept: list[tuple[str, str]] = []
    walls, rooms = (
        ("write_wall_dxf", "write_room_dxf"),
        ("write_wall_geojson", "write_room_geojson"),
    )
    for writer in (*walls, *rooms, "write_seams_geojson"):
        monkeypatch.setattr(
            f"orthoflow.cli.exports.drawings.{writer}",
            lambda path, *_args, writer=writer: kept.append((writer, path.name)),
        )
    monkeypatch.setattr(
        "orthoflow.cli.exports.drawings.write_cad_picture",
        lambda _raster, path: kept.append(("picture", path.name)),
    )
    lines = SimpleNamespace(surfaces=(1, 2), edges=(1,), corners=(1, 2, 3), openings=())
    monkeypatch.setattr("orthoflow.cli.exports.drawings.room_lines", lambda *_args, **_more: lines)
    return kept


def of_room(monkeypatch: pytest.MonkeyPatch, *, has_planes: bool) -> Any:
    """A run of two walls, one of which has no orthoimage; each with seams."""
    walls = (wall(3.8, 2.3, "ortho"), wall(9.0, 3.0, "depth"))
    walls[1].number = 9
    told = results(
        walls=walls,
        planes=SimpleNamespace() if has_planes else None,
        checkpoints=None,
        inspections={},
        openings=(),
    )
    monkeypatch.setattr(
        "orthoflow.cli.exports.drawings.room_results", lambda _run, _cell, _wall: told
    )
    images = [
        SimpleNamespace(number=7, sources=("a.jpg", "b.jpg")),
        SimpleNamespace(number=9, sources=("a.jpg",)),
    ]
    monkeypatch.setattr(module, "_images", lambda _run, _address: images)
    return SimpleNamespace()


CAD_OF_9 = ("write_wall_dxf", "wall_9.dxf")
CAD = [("picture", "wall_7_ortho.png"), ("write_wall_dxf", "wall_7.dxf"), CAD_OF_9]
GIS_OF_9 = ("write_wall_geojson", "wall_9.geojson")
# Only the first wall is painted by several photos.
SEAMS = ("write_seams_geojson", "wall_7_seams.geojson")
GIS = [("write_wall_geojson", "wall_7.geojson"), GIS_OF_9, SEAMS]


@pytest.mark.parametrize("has_planes", [False, True])
@pytest.mark.parametrize(
    ("name", "of_all", "of_9"),
    [("dxf", CAD, CAD_OF_9), ("geojson", GIS, GIS_OF_9)],
    ids=["CAD", "GIS"],
)
def test_files_are_of_each_wall_and_of_the_room_where_it_is_known(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    drawn_files: list[tuple[str, str]],
    *,
    name: str,
    of_all: list[tuple[str, str]],
    of_9: tuple[str, str],
    has_planes: bool,
) -> None:
    run, export = of_room(monkeypatch, has_planes=has_planes), getattr(module, f"export_{name}")
    said = export(run, tmp_path / "out", Choices())
    room = [(f"write_room_{name}", f"room.{name}")] if has_planes else []
    assert drawn_files == [*of_all, *room]
    beside = ", and the room: 2 planes, 1 edge, 3 corners" if has_planes else ""
    assert said == f"2 walls{beside}"
    drawn_files.clear()
    assert export(run, tmp_path / "out", Choices(wall=9)) == f"1 wall{beside}"
    assert drawn_files == [of_9, *room]


@pytest.mark.parametrize("embedded", [True, False])
def test_seams_are_those_of_the_orthoimages_that_a_cell_gave_and_kept(embedded: bool) -> None:
    frame = samples.facing_east(0.1, 3, 4, (0.0, 0.0, 0.0))
    rgb = np.zeros((*frame.shape, 3), dtype=np.uint8)
    images = Orthoimages(images=(samples.orthoimage(frame, wall=7, rgb=rgb),))
    outputs = {
        "walls": SimpleNamespace(type_name="walls", embedded=True),
        "images": SimpleNamespace(type_name="orthoimages", embedded=embedded),
    }
    run: Any = SimpleNamespace(
        cell=lambda address: SimpleNamespace(outputs=outputs if address == "mosaic" else {}),
        payload=lambda _, port: images.to_payload() if port == "images" else None,
    )
    found = module._images(run, "mosaic")
    assert [one.number for one in found] == (
        [one.number for one in images.images] if embedded else []
    )
    assert module._images(run, "walls") == ()
