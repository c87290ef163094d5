"""Polygons in GeoJSON files, filled on a grid and drawn around areas of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from orthoflow.files.geotiff import GridPlace, read_raster, write_raster
from orthoflow.files.polygons import (
    filled,
    read_polygons,
    write_features,
)

SQUARE = [[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 0.0]]
HOLE = [[1.0, 1.0], [2.0, 1.0], [2.0, 2.0]]


def feature(coordinates: Any, *, kind: str = "Polygon", **properties: Any) -> dict[str, Any]:
    return {
        "type": "Feature",
        "properties": {"photo": "a.jpg", **properties},
        "geometry": {"type": kind, "coordinates": coordinates},
    }


def features(*found: Any) -> str:
    return json.dumps({"type": "FeatureCollection", "features": found})


def test_polygons_come_in_their_order_with_their_holes_and_what_is_said_of_them(
    tmp_path: Path,
) -> None:
    # Heights are left out.
    high = [[*corner, 7.0] for corner in SQUARE]
    path = tmp_path / "masks.geojson"
    several = feature([[SQUARE], [HOLE]], kind="MultiPolygon", photo="b.jpg")
    path.write_text(features(feature([high, HOLE], note="window"), several))
    first, second, third = read_polygons(path, name="photo", what="a mask of photos")
    assert [one.name for one in (first, second, third)] == ["a.jpg", "b.jpg", "b.jpg"]
    assert first.properties == {"photo": "a.jpg", "note": "window"}
    for one, rings in ((first, [SQUARE, HOLE]), (second, [SQUARE]), (third, [HOLE])):
        assert [ring.tolist() for ring in one.rings] == rings


def test_cells_are_filled_whose_centres_lie_inside_and_in_no_hole() -> None:
    outer = np.array([[0.4, 0.4], [4.6, 0.4], [4.6, 3.4], [0.4, 3.4]])
    hole = np.array([[1.4, 1.4], [2.6, 1.4], [2.6, 2.6], [1.4, 2.6]])
    found = filled((outer, hole), (4, 6))
    expected = np.zeros((4, 6), dtype=np.bool_)
    expected[0:3, 0:5] = True
    expected[1:3, 1:3] = False
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("crs", ["wall 0 (1f)", "site", "EPSG:25832"])
def test_what_is_written_lies_where_rasters_lie(tmp_path: Path, crs: str) -> None:
    from rasterio.crs import CRS

    ring: Any = [[[0.5, -0.5], [1.0, -0.5], [1.0, -1.0], [0.5, -0.5]]]
    area = feature(ring)
    write_features(tmp_path / "a.geojson", [area], crs, digest="ab12")
    document = json.loads((tmp_path / "a.geojson").read_text())
    name = document.pop("crs")["properties"]["name"]
    assert document == {
        "type": "FeatureCollection",
        "name": "a",
        "product_digest": "ab12",
        "features": [area],
    }
    write_raster(
        tmp_path / "a.tif",
        np.zeros((2, 2), np.uint8),
        place=GridPlace(gsd_m=1.0, crs=crs),
        tags={},
    )
    # As GDAL reads it; without a name it takes metres for degrees.
    raster = CRS.from_wkt(read_raster(tmp_path / "a.tif").crs_wkt)
    assert CRS.from_user_input(name).to_wkt() == raster.to_wkt()
    assert read_polygons(tmp_path / "a.geojson", "photo", what="areas")[0].name == "a.jpg"
