"""The road from a scan to outlines of openings, and from there to other programs."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from tests.road.conftest import Shell, metrics_of

SMALL = ("--set", "room.scan_step_m=0.016", "--set", "wall.gsd_m=0.024")


@pytest.fixture(scope="module")
def road(tmp_path_factory: pytest.TempPathFactory, store: Path) -> Shell:
    """A folder in which `openings.yaml` ran on the room of `test_direct`, as `run`."""
    shell = Shell(tmp_path_factory.mktemp("openings"), store)
    ended = shell("run", "openings.yaml", *SMALL, "-o", "run", "--executor", "inline")
    assert ended.code == 0, ended.said
    return shell


def test_niche_door_and_windows_of_the_room_are_found(road: Shell) -> None:
    numbers = metrics_of(road.folder / "run")
    assert numbers["check", "n_true_openings"] == 4
    assert numbers["check", "n_found_openings"] == 4
    assert numbers["check", "n_false_openings"] == 0
    # Cells of 24 mm, points of the walls beside 16 to 48 mm apart.
    assert numbers["check", "opening_iou_min"] >= 0.93
    assert numbers["check", "side_rmse_cells"] <= 1.0
    assert numbers["check", "side_error_over_sigma"] <= 1.5
    assert numbers["check", "opening_depth_error_max_mm"] <= 5.0


def test_they_are_published_and_exported(road: Shell) -> None:
    published = road.folder / "run" / "products" / "openings"
    with (published / "openings.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 4
    assert {row["kind"] for row in rows} == {"niche"}
    ended = road("export", "run", "--to", "geojson")
    assert ended.code == 0, ended.said
    assert "4 openings" in ended.out
    room = json.loads((road.folder / "run" / "export" / "geojson" / "room.geojson").read_text())
    found = [f for f in room["features"] if f["properties"]["kind"] == "opening"]
    depths = sorted(feature["properties"]["depth_m"] for feature in found)
    # The door, the niche, and two windows as they are designed.
    assert depths == pytest.approx([0.12, 0.25, 0.3, 0.3], abs=0.005)
