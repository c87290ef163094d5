"""Polygons in GeoJSON files, and files of openings for GIS programs and spreadsheets."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from orthoflow.files.geotiff import GridPlace, read_raster, write_raster
from orthoflow.files.polygons import filled, read_polygons, write_features
from orthoflow.files.publishing import publish_openings
from tests.drawing_runs import WALL, box_openings

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
        tmp_path / "a.tif", np.zeros((2, 2), np.uint8), place=GridPlace(gsd_m=1.0, crs=crs), tags={}
    )
    # As GDAL reads it; without a name it takes metres for degrees.
    raster = CRS.from_wkt(read_raster(tmp_path / "a.tif").crs_wkt)
    assert CRS.from_user_input(name).to_wkt() == raster.to_wkt()
    assert read_polygons(tmp_path / "a.geojson", "photo", what="areas")[0].name == "a.jpg"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("openings")
    found = box_openings()
    other = replace(found.openings[0], wall=WALL + 1, wall_name="wall 3", kind="through")
    unseen = replace(other, depth_m=None, side_sigma_m=np.full(4, np.nan))
    publish_openings(
        replace(found, openings=(*found.openings, unseen), walls=(WALL, WALL + 1, WALL + 2)),
        folder,
        "sha256:12",
    )
    return folder


def test_openings_are_rings_in_the_metres_of_their_walls_and_rows_of_a_schedule(
    folder: Path,
) -> None:
    # A wall without openings has no file.
    assert sorted(path.name for path in folder.iterdir()) == [
        "openings.csv",
        "openings.geojson",
        f"wall_{WALL}_openings.geojson",
        f"wall_{WALL + 1}_openings.geojson",
    ]
    (opening,) = box_openings().openings
    content = json.loads((folder / f"wall_{WALL}_openings.geojson").read_text())
    assert (content["type"], content["product_digest"]) == ("FeatureCollection", "sha256:12")
    (feature,) = content["features"]
    ring = np.array(feature["geometry"]["coordinates"][0])
    np.testing.assert_allclose(ring, np.vstack([opening.outline_m, opening.outline_m[:1]]))
    about = feature["properties"]
    assert (about["kind"], about["opening"], about["number"]) == ("opening", "niche", 0)
    assert about["depth_m"] == 0.25
    assert about["side_source"] == ["depth", "image", "unseen", "depth"]
    assert about["side_sigma_mm"] == [3.0, 1.5, None, 3.0]
    with (folder / "openings.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["wall"], row["number"], row["kind"]) for row in rows] == [
        (str(WALL), "0", "niche"),
        (str(WALL + 1), "0", "through"),
    ]
    assert float(rows[0]["width_m"]) == 0.8
    assert float(rows[0]["edge_sigma_mm"]) == pytest.approx(2.6, abs=0.01)
    assert rows[1]["depth_m"] == rows[1]["edge_sigma_mm"] == ""


def test_a_map_names_its_coordinate_system(tmp_path: Path) -> None:
    publish_openings(replace(box_openings(), map_crs="EPSG:2180"), tmp_path, "sha256:0")
    content = json.loads((tmp_path / "openings.geojson").read_text())
    assert content["crs"]["properties"]["name"] == "urn:ogc:def:crs:EPSG::2180"
    # The plane of an upright wall is none of it, and without a map there are those of the scan.
    own = json.loads((tmp_path / f"wall_{WALL}_openings.geojson").read_text())
    assert own["crs"]["properties"]["name"].startswith(
        'LOCAL_CS["run 00000000-000000-000000 plane, metres"'
    )
    publish_openings(box_openings(), tmp_path, "sha256:0")
    content = json.loads((tmp_path / "openings.geojson").read_text())
    assert content["crs"]["properties"]["name"].startswith('LOCAL_CS["coordinates of the scan')
