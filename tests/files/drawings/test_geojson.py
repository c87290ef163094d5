"""GeoJSON of walls, rooms and seams: which coordinates its rings and lines are in."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from orthoflow.files.drawings import geojson
from orthoflow.files.drawings.room_lines import DrawnWall, room_lines
from tests import samples
from tests.drawing_runs import WALL, box_openings, box_planes, drawn_wall, wall_frame


def features(path: Path) -> list[Any]:
    found: list[Any] = json.loads(path.read_text())["features"]
    return found


def test_a_wall_without_planes_is_its_frame_and_its_openings_in_its_own_metres(
    tmp_path: Path,
) -> None:
    (opening,) = box_openings().openings
    frame = wall_frame(box_planes())
    wall = DrawnWall(
        number=WALL, name="the wall", plane_index=None, frame=frame, openings=(opening, opening)
    )
    geojson.write_wall_geojson(tmp_path / "a.geojson", wall, None)
    first, *niches = features(tmp_path / "a.geojson")
    assert first["properties"] == {"kind": "frame", "wall": WALL, "name": "the wall"}
    assert [one["properties"]["number"] for one in niches] == [0, 1]
    for niche in niches:
        (ring,) = niche["geometry"]["coordinates"]
        np.testing.assert_allclose(ring, [*opening.outline_m, opening.outline_m[0]])


@pytest.mark.parametrize("is_closed", [True, False])
def test_an_outline_that_does_not_close_is_a_line(tmp_path: Path, *, is_closed: bool) -> None:
    lines = room_lines(box_planes(), None)
    chain = np.array([[1.0, 2.0, 3.0], [4.0, 2.0, 3.0], [4.0, 6.1234567, 3.0]])
    outline = replace(lines.outline, chains_world=(chain,), closed=(is_closed,), floor_m=3.0)
    geojson.write_room_geojson(tmp_path / "a.geojson", replace(lines, outline=outline), None)
    (drawn,) = (
        one for one in features(tmp_path / "a.geojson") if one["properties"]["kind"] == "outline"
    )
    places = chain.round(6).tolist()
    geometry = {"type": "LineString", "coordinates": places}
    if is_closed:
        geometry = {"type": "Polygon", "coordinates": [[*places, places[0]]]}
    assert drawn["geometry"] == geometry
    assert drawn["properties"] == {"kind": "outline", "floor_m": 3.0}


@pytest.mark.parametrize("most_cells", [24, 6])
def test_seams_lie_in_the_metres_of_the_wall_however_coarse(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most_cells: int
) -> None:
    monkeypatch.setattr(geojson, "_SEAM_CELLS_MOST", most_cells)
    frame = samples.facing_south(0.5, 6, 4, (100.0, 200.0, 3.0))
    source = np.zeros(frame.shape, dtype=np.int16)
    source[:, 4:] = 1
    image = samples.orthoimage(
        frame,
        source=source,
        sources=("a.jpg", "b.jpg"),
        rgb=np.zeros((*frame.shape, 3), dtype=np.uint8),
    )
    geojson.write_seams_geojson(tmp_path / "a.geojson", image)
    left, right = frame.raster_corner_m[0], frame.raster_corner_m[0] + 3.0
    high = frame.raster_corner_m[1]
    drawn = features(tmp_path / "a.geojson")
    assert [one["properties"] for one in drawn] == [
        {"photo": "a.jpg", "wall": image.number},
        {"photo": "b.jpg", "wall": image.number},
    ]
    for one, begin, end in zip(drawn, (left, left + 2.0), (left + 2.0, right), strict=True):
        (ring,) = one["geometry"]["coordinates"]
        assert ring[0] == ring[-1]
        corners = [[begin, high - 2.0], [begin, high], [end, high - 2.0], [end, high]]
        assert sorted(map(list, set(map(tuple, ring)))) == corners


@pytest.mark.parametrize("is_known", [True, False])
def test_a_wall_has_the_lines_of_its_plane_where_that_is_known(
    tmp_path: Path, is_known: bool
) -> None:
    planes = box_planes()
    lines = room_lines(planes, None)
    wall = drawn_wall(planes, is_known=is_known)
    geojson.write_wall_geojson(tmp_path / "a.geojson", wall, lines)
    kinds = [one["properties"]["kind"] for one in features(tmp_path / "a.geojson")]
    assert kinds == (["frame", "rectangle", "part", *["edge"] * 4] if is_known else ["frame"])


def test_an_opening_says_how_well_each_side_is_known() -> None:
    (opening,) = box_openings().openings
    about: Any = geojson.opening_feature(opening, 3)["properties"]
    assert about["number"] == 3
    # Millimetres; the third side was found by nobody.
    assert about["side_sigma_mm"] == [3.0, 1.5, None, 3.0]
    assert [about[f"{name}_m"] for name in ("depth", "width", "height", "sill")] == [
        *(0.25, 0.8, 1.2, 0.5),
    ]
    assert (about["area_m2"], about["seen_share"]) == (0.96, 0.75)
    assert len(set(about["side_source"])) == 3
