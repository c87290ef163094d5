"""The road from a scan to orthoimages, walked with the command line on scans with known truth."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest

import orthoflow
from orthoflow.files.geotiff import read_raster
from orthoflow.geometry import angle_between_deg
from tests.road.conftest import Shell, metrics_of
from tests.studios import asked

SHIFT_M = (634512.347, 486215.781, 112.193)
# The room of the openings, too, which is simulated once for both.
SMALL = ("--set", "room.scan_step_m=0.016", "--set", "wall.gsd_m=0.024")
# What is compared with the truth and with itself is the main wall.
ONE_WALL = ("--set", "wall.n_walls_max=1")
SMALL_WALL = (*SMALL, *ONE_WALL)


@pytest.fixture(scope="module")
def road(tmp_path_factory: pytest.TempPathFactory, store: Path) -> Shell:
    """A folder in which `direct.yaml` ran once on the small simulated room, as `run`."""
    shell = Shell(tmp_path_factory.mktemp("road"), store)
    ended = shell("run", "direct.yaml", *SMALL_WALL, "-o", "run", "--executor", "inline")
    assert str(Path("run") / "report.html") in ended.out
    assert str(Path("run") / "run.h5") in ended.out
    assert "wall_0_ortho.tif" in ended.out
    return shell


def planes_of(folder: Path) -> list[dict[str, object]]:
    found: list[dict[str, object]] = json.loads(
        (folder / "products" / "plane" / "planes.json").read_text()
    )["planes"]
    return found


def test_layers_are_written_when_asked_for(road: Shell) -> None:
    road("export", "run", "--to", "layers", "--store", str(road.store))
    layer = read_raster(road.folder / "run" / "export" / "layers" / "wall_0_layer_0_cloud.tif")
    # A single layer is its mosaic.
    mosaic = read_raster(road.folder / "run" / "products" / "mosaic" / "wall_0_ortho.tif")
    np.testing.assert_array_equal(layer.values[layer.shown], mosaic.values[layer.shown])
    assert layer.shown.sum() == mosaic.shown.sum()
    # The record only names the layers.
    lost = road("export", "run", "--to", "layers", "--store", "elsewhere", "-o", "lost", code=2)
    assert "neither the record nor the store elsewhere" in lost.said


def test_the_record_verifies_and_a_second_run_comes_from_the_cache(road: Shell) -> None:
    road("verify", "run")
    again = road("run", "direct.yaml", *SMALL_WALL, "-o", "again")
    assert "10 of 10 steps cached" in again.out
    run = orthoflow.open_run(road.folder / "run")
    cells = "cloud room survey plane flat domes vaults curved wall ortho mosaic points check"
    assert set(run.cells) == set(cells.split())
    assert (run.cells["cloud"].status, run.cells["check"].status) == ("skipped", "ok")


def test_the_main_wall_and_its_orthoimage_agree_with_the_truth(road: Shell) -> None:
    metrics = metrics_of(road.folder / "run")
    assert metrics["check", "plane_angle_deg"] <= 0.02
    assert metrics["check", "plane_offset_mm"] <= 1.0
    # A third of a 24 mm cell: the scan step is 16 mm, each cell shows one point.
    assert metrics["check", "rmse_u_mm"] <= 8.0
    assert metrics["check", "rmse_v_mm"] <= 8.0


def test_survey_coordinates_change_nothing_but_the_origin(road: Shell) -> None:
    shift = "[" + ", ".join(map(str, SHIFT_M)) + "]"
    road(
        *("run", "direct.yaml", "--until", "mosaic", *SMALL_WALL, "-o", "shifted"),
        *("--set", f"room.shift_world_m={shift}", "--executor", "inline"),
    )
    here, there = planes_of(road.folder / "run")[0], planes_of(road.folder / "shifted")[0]
    normal, moved = (np.array(plane["normal"]) for plane in (here, there))
    assert angle_between_deg(normal, moved) < 1e-6
    offset_m = there["offset_m"] - moved @ np.array(SHIFT_M)
    assert offset_m == pytest.approx(here["offset_m"], abs=0.05e-3)
    images = [
        read_raster(road.folder / name / "products" / "mosaic" / "wall_0_ortho.tif").values
        for name in ("run", "shifted")
    ]
    assert images[0].shape == images[1].shape
    assert np.mean(images[0] != images[1]) < 1e-3


def test_the_decorated_hall_gives_its_main_wall(shell: Shell, shared_data: Path) -> None:
    scan = shared_data / "heritage-hall-west-wall" / "west_wall.laz"
    options = ("--set=wall.gsd_m=0.02", "--set=wall.buffer_m=0.45", *ONE_WALL, "--executor=inline")
    shell("run", "direct.yaml", "--input", f"scan={scan}", *options, "-o", "run")
    main = planes_of(shell.folder / "run")[0]
    normal = np.array(main["normal"])
    expected = np.array([0.9998, -0.018, 0.0])
    assert angle_between_deg(normal, expected / np.linalg.norm(expected)) < 0.1
    # x of the plane at y = -1.1, z = 1.4.
    x = (main["offset_m"] - normal[1] * -1.1 - normal[2] * 1.4) / normal[0]
    assert x == pytest.approx(-2.865, abs=0.010)
    image = read_raster(shell.folder / "run" / "products" / "mosaic" / "wall_0_ortho.tif")
    assert image.values.shape[-2] > 1150  # 24.6 m at 2 cm
    assert np.mean(image.shown) > 0.95


def test_a_gridded_e57_gives_intensity_and_depth(shell: Shell, shared_data: Path) -> None:
    scan = shared_data / "pump-e57" / "pumpAVisualReferenceImage.e57"
    options = ("--set=wall.gsd_m=0.02", *ONE_WALL, "--executor=inline")
    shell("run", "direct.yaml", "--input", f"scan={scan}", *options, "-o", "run")
    floor = planes_of(shell.folder / "run")[0]
    assert abs(floor["normal"][2]) > 0.999
    walls = shell.folder / "run" / "products" / "wall"
    depth = read_raster(walls / "wall_0_depth.tif").values
    intensity = read_raster(walls / "wall_0_intensity.tif").values
    assert np.isfinite(depth).any()
    assert np.nanmin(intensity) >= 0.0
    assert np.nanmax(intensity) <= 1.0


OTHER_SCANS = {
    "fountain-p11/cloud_from_photos.laz": ("cloud.up=-z",),
    "ceiling-808/808_db.ply": (),
    "ceiling-808/808-60.ply": ("cloud.up=y",),
    "lion-takanawa/lion_takanawa_1mm.laz": (),
    "lion-takanawa/lion_takanawa.copc.laz": (),
    "indoor-laz/indoor.laz": ("cloud.up=y",),
    "tls-targets-sp1/T1.1.txt": ("wall.gsd_m=0.002",),
}


@pytest.mark.long
@pytest.mark.parametrize("scan", OTHER_SCANS)
def test_every_other_scan_goes_through_or_ends_with_a_sentence(
    shell: Shell, shared_data: Path, scan: str
) -> None:
    options = [word for setting in OTHER_SCANS[scan] for word in ("--set", setting)]
    defaults = ("--set", "wall.gsd_m=0.02") if "wall.gsd_m" not in str(options) else ()
    ended = shell(
        "run", "direct.yaml", "--input", f"scan={shared_data / scan}", *defaults, *options,
        "--executor", "inline", "-o", "run", code=None,
    )  # fmt: skip
    assert "Traceback" not in ended.said
    if ended.code == 0:
        assert list((shell.folder / "run" / "products" / "mosaic").glob("wall_0_ortho.tif"))
    else:
        assert ended.code in (1, 2)
        assert re.search(r": failed in [^:]+: \w", ended.err)


# What goes wrong ends in a sentence ---------------------------------------------------------------


def test_a_bad_scan_ends_in_one_sentence_with_exit_code_two(
    shell: Shell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "corrupt.laz").write_bytes(b"LASF" + bytes(range(256)) * 8)
    monkeypatch.chdir(tmp_path)
    # In this process; the steps of the next test are processes.
    how = ("--executor", "inline", "--store", shell.store)
    ended = asked("run", "direct.yaml", "--input", "scan=corrupt.laz", "-o", "run", *how, code=2)
    assert "Traceback" not in ended.output
    assert "corrupt.laz" in ended.output


def test_a_truncated_laz_is_named(shell: Shell, tmp_path: Path, shared_data: Path) -> None:
    whole = (shared_data / "lion-takanawa" / "lion_takanawa_1mm.laz").read_bytes()
    (tmp_path / "half.laz").write_bytes(whole[: len(whole) // 2])
    ended = shell("run", "direct.yaml", "--input", "scan=half.laz", "-o", "run", code=2)
    assert "Traceback" not in ended.said
    assert "half.laz" in ended.said


# From a scan to outlines of openings, and from there to other programs ----------------------------


@pytest.fixture(scope="module")
def outlined(tmp_path_factory: pytest.TempPathFactory, store: Path) -> Shell:
    """A folder in which `openings.yaml` ran on the room of `test_direct`, as `run`."""
    shell = Shell(tmp_path_factory.mktemp("openings"), store)
    shell("run", "openings.yaml", *SMALL, "-o", "run", "--executor", "inline")
    return shell


def test_niche_door_and_windows_of_the_room_are_found(outlined: Shell) -> None:
    numbers = metrics_of(outlined.folder / "run")
    assert numbers["check", "n_true_openings"] == 4
    assert numbers["check", "n_found_openings"] == 4
    assert numbers["check", "n_false_openings"] == 0
    # Cells of 24 mm, points of the walls beside 16 to 48 mm apart.
    assert numbers["check", "opening_iou_min"] >= 0.93
    assert numbers["check", "side_rmse_cells"] <= 1.0
    assert numbers["check", "side_error_over_sigma"] <= 1.5
    assert numbers["check", "opening_depth_error_max_mm"] <= 5.0


def test_they_are_published_and_exported(outlined: Shell) -> None:
    published = outlined.folder / "run" / "products" / "openings"
    with (published / "openings.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 4
    assert {row["kind"] for row in rows} == {"niche"}
    ended = outlined("export", "run", "--to", "geojson")
    assert "4 openings" in ended.out
    room = json.loads((outlined.folder / "run" / "export" / "geojson" / "room.geojson").read_text())
    found = [f for f in room["features"] if f["properties"]["kind"] == "opening"]
    depths = sorted(feature["properties"]["depth_m"] for feature in found)
    # The door, the niche, and two windows as they are designed.
    assert depths == pytest.approx([0.12, 0.25, 0.3, 0.3], abs=0.005)
