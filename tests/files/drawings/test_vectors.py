"""GeoJSON of walls, rooms and seams, and regular openings and layers of DXF files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from orthoflow.files.drawings import geojson
from orthoflow.files.drawings.dxf import regular_opening
from tests import samples
from tests.long_loops import seeds


def features(path: Path) -> list[Any]:
    found: list[Any] = json.loads(path.read_text())["features"]
    return found


@pytest.mark.parametrize("most_cells", [24, 6])
def test_seams_lie_in_the_metres_of_the_wall_however_coarse(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most_cells: int
) -> None:
    monkeypatch.setattr(geojson, "SEAM_CELLS", most_cells)
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


def wobbled(outline: np.ndarray, seed: int, sd_m: float) -> np.ndarray:
    """An outline with a vertex every 5 cm, each moved at random."""
    points = []
    for begin, end in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        count = max(1, int(np.linalg.norm(end - begin) / 0.05))
        points += [begin + k / count * (end - begin) for k in range(count)]
    return np.array(points) + np.random.default_rng(seed).normal(0.0, sd_m, (len(points), 2))


@pytest.mark.parametrize("seed", seeds(5))
def test_a_window_with_uneven_sides_is_a_rectangle(seed: int) -> None:
    box = np.array([[1.0, 0.5], [2.2, 0.5], [2.2, 2.0], [1.0, 2.0]])
    found = regular_opening(wobbled(box, seed, 0.005), 0.005)
    assert found.kind == "rectangle"
    assert np.abs(found.outline_m - box).max() < 0.005
    assert 0.004 < found.deviation_m < 0.03


@pytest.mark.parametrize(("seed", "rise_m"), [(0, 0.6), (1, 0.3), (2, 0.15)])
def test_a_door_under_an_arch_is_one(seed: int, rise_m: float) -> None:
    half, spring = 0.6, 2.0
    radius = (half**2 + rise_m**2) / (2 * rise_m)
    angle = np.arcsin(half / radius)
    turns = np.linspace(angle, -angle, 40)
    arc = np.column_stack([np.sin(turns), np.cos(turns)]) * radius
    arc += [0.0, spring + rise_m - radius]
    door = np.vstack([[-half, 0.0], [half, 0.0], arc])
    found = regular_opening(wobbled(door, seed, 0.003), 0.003)
    assert found.kind == "arch"
    assert found.outline_m[:, 1].max() == pytest.approx(spring + rise_m, abs=0.012)
    assert found.deviation_m < 0.03


def test_what_is_neither_keeps_its_outline() -> None:
    star = np.array([[0.0, 0.0], [1.0, 0.3], [2.0, 0.0], [1.4, 0.8], [1.0, 2.0], [0.6, 0.8]])
    found = regular_opening(star, None)
    assert (found.kind, found.deviation_m) == ("outline", 0.0)
    np.testing.assert_array_equal(found.outline_m, star)
