"""GeoJSON of walls, rooms and seams: which coordinates its rings and lines are in."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from orthoflow.files.drawings import geojson
from tests import samples


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
