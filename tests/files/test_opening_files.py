"""Files of openings as GIS programs and spreadsheets read them."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from orthoflow.files.publishing import publish_openings
from tests.drawing_runs import WALL, box_openings


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
