"""The main job: scan + hand-held photographs -> orthoimages, walked with the command line."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import laspy
import numpy as np
import pytest
from numpy.typing import NDArray

import orthoflow
from orthoflow.files.calibration import write_calibration
from orthoflow.products import Calibration, Photos, PointCloud, Truth
from orthoflow.records.runs import Run
from tests.road.conftest import Shell, metrics_of
from tests.scan_files import write_las

# A third of the shipped recipe's cells, and of its points of the main wall, fewer of the others;
# less than half of its pixels.
SMALL = (
    *("--set", "room.scan_step_m=0.0045", "--set", "room.panorama_step_m=0.03"),
    *("--set", "room.photo_gsd_m=0.0038", "--set", "wall.gsd_m=0.007"),
)
GSD_MM, PHOTO_GSD_MM = 7.0, 3.8
# What the recipe for simulated data sets, for the recipe for own data.
SAME_WALL = (
    *("--set", "wall.gsd_m=0.007", "--set", "wall.buffer_m=0.3"),
    *("--set", "wall.n_walls_max=1"),
)
FOOT_M = 0.3048
# What the surveyor has of six photos in two rows of three: two of the upper row and one below,
# which overlap as all do.
BROUGHT = {f"photo_{place:02d}.jpg" for place in (0, 1, 4)}


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory, store: Path) -> Shell:
    """A folder in which `quickstart.yaml` ran once, small, as `run`, everything embedded."""
    shell = Shell(tmp_path_factory.mktemp("quick"), store)
    # Libraries and kernels are loaded once for all steps, and no chart is drawn.
    how = (*SMALL, "--embed", "--executor", "inline")
    ended = shell("run", "quickstart.yaml", *how, "-o", "run", timeout_s=900)
    assert str(Path("run") / "report.html") in ended.out
    assert "wall_0_ortho.tif" in ended.out
    return shell


def test_the_orthoimages_of_the_simulated_room_are_true(quick: Shell) -> None:
    metrics = metrics_of(quick.folder / "run")
    # The limits: 0.35 cells in u and v, 97 % of what a station and a photo see, no ghost.
    assert metrics["check", "rmse_u_mm"] <= 0.35 * GSD_MM
    assert metrics["check", "rmse_v_mm"] <= 0.35 * GSD_MM
    assert metrics["check", "completeness_seen_by_both"] >= 0.97
    assert metrics["check", "ghost_share"] < 1e-3


def test_the_orientation_is_exported_to_colmap(quick: Shell) -> None:
    import pycolmap

    cameras = orthoflow.open_run(quick.folder / "run").product("orient", "cameras").cameras
    ended = quick("export", "run", "--to", "colmap", "-o", "model")
    # Those of the room are the true ones.
    assert (
        "note: using the orientations of orient; --step selects others: room, first" in ended.said
    )
    assert ended.out.startswith(f"colmap: model: {len(cameras)} photos, 1 camera, ")
    assert ended.out.rstrip().endswith(" of orient")
    scene = pycolmap.Reconstruction(str(quick.folder / "model"))
    centres = {image.name: image.projection_center() for image in scene.images.values()}
    for camera in cameras:
        np.testing.assert_allclose(centres[camera.photo], camera.viewing().centre_world, atol=1e-9)
    quick("export", "run", "--to", "colmap", "--step", "first")
    assert (quick.folder / "run" / "export" / "colmap" / "images.txt").is_file()


def test_the_cloud_is_exported(quick: Shell) -> None:
    run = orthoflow.open_run(quick.folder / "run")
    cloud, labels = run.product("room", "cloud"), run.product("plane", "labels")
    said = f": cloud.laz: {len(cloud)} points coloured by photos, cloud of plane"
    ended = quick("export", "run", "--to", "laz", "-o", "planes")
    assert ended.out.rstrip().endswith(said)
    read = laspy.read(quick.folder / "planes" / "cloud.laz")
    np.testing.assert_array_equal(read["plane"], labels.plane_index)
    np.testing.assert_allclose(read.xyz, cloud.points_world(), atol=0.51e-4)
    # What photos show is what the simulated scanner coloured, where they see it.
    seen = np.asarray(read["photo"]) >= 0
    assert seen.mean() > 0.3
    rgb = np.column_stack([read.red, read.green, read.blue]) / 257.0
    assert np.median(np.abs(rgb - cloud.rgb)[seen]) < 12.0
    assert (rgb[~seen] == 128).all()


def test_the_orthoimages_are_handed_over(quick: Shell) -> None:
    for target, file in (("gltf", "room.glb"), ("stac", "collection.json")):
        ended = quick("export", "run", "--to", target)
        assert f"{target}: run/export/{target}: {file}" in ended.out
        assert (quick.folder / "run" / "export" / target / file).is_file()


# The surveyor's files lie in the national grid, in feet, y up: axes of the file from the room's.
AXES = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
ORIGIN_FT = np.array([2081733.1, 369.4, -1595193.5])
SETTINGS = ("--set", "cloud.up=y", "--set", "cloud.unit=ft")


def survey_from_room(points_room: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coordinates of the file, in feet."""
    return points_room @ AXES.T / FOOT_M + ORIGIN_FT


def write_survey(folder: Path, run: Run) -> None:
    """Lay the simulated scan, photos and calibration out as a user's files."""
    cloud = run.product("room", "cloud")
    photos = run.product("room", "photos")
    calibration = run.product("room", "calibration")
    assert isinstance(cloud, PointCloud)
    assert isinstance(photos, Photos)
    assert isinstance(calibration, Calibration)
    assert cloud.intensity is not None
    points_room = cloud.origin + np.column_stack([cloud.x, cloud.y, cloud.z]).astype(np.float64)
    rgb = None if cloud.rgb is None else cloud.rgb.astype(np.int64) * 257
    folder.mkdir()
    write_las(
        folder / "scan.las",
        survey_from_room(points_room),
        intensity=np.rint(cloud.intensity * 65535).astype(np.int64),
        rgb=rgb,
    )
    (folder / "photos").mkdir()
    for photo in photos.photos:
        if photo.name in BROUGHT:
            (folder / "photos" / photo.name).write_bytes(photo.encoded)
    write_calibration(folder / "calibration.yaml", calibration)


def places_on(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """A grid of points on a rectangle, (n, 3)."""
    down, right = corners[1] - corners[0], corners[3] - corners[0]
    shares = np.linspace(0.0, 1.0, 12)
    return np.array([corners[0] + a * down + b * right for a in shares for b in shares])


def test_own_files_give_the_same_accuracy_wherever_they_lie(quick: Shell) -> None:
    run = orthoflow.open_run(quick.folder / "run")
    folder = quick.folder / "survey"
    write_survey(folder, run)
    truth = run.product("room", "truth")
    assert isinstance(truth, Truth)
    assert truth.cameras is not None
    station = FOOT_M * survey_from_room(truth.stations[0])
    said = [
        *(*SAME_WALL, *SETTINGS, "--set", f"cloud.view_from={station.tolist()}"),
        *("--input", f"scan={folder / 'scan.las'}", "--input", f"photos={folder / 'photos'}"),
        *("--input", f"calibration={folder / 'calibration.yaml'}"),
    ]
    quick(
        *("run", "photos-on-scan.yaml", "--until", "orient", *said, "-o", folder / "run"),
        *("--executor", "inline"),
        timeout_s=900,
    )
    found = json.loads((folder / "run" / "products" / "orient" / "cameras.json").read_text())
    oriented = 0
    assert found["cameras"].keys() == BROUGHT
    for true in truth.cameras.cameras:
        if true.photo not in BROUGHT:
            continue
        camera = found["cameras"][true.photo]
        if camera["status"] != "ok":
            continue
        oriented += 1
        places_room = places_on(truth.planes.corners[0])
        pixels = true.viewing().project(places_room)[:, :2]
        inside = np.all((pixels > 0) & (pixels < [camera["width"], camera["height"]]), axis=1)
        found_px, _ = cv2.projectPoints(
            FOOT_M * survey_from_room(places_room[inside]),
            cv2.Rodrigues(np.array(camera["R_camera_from_world"]))[0],
            np.array(camera["t_camera_from_world"]),
            np.array(camera["K"]),
            np.array(camera["distortion"]),
        )
        # OpenCV counts from the centre of the first pixel. A sixth of a cell on the wall.
        errors_px = found_px.reshape(-1, 2) + 0.5 - pixels[inside]
        assert np.sqrt((errors_px**2).mean()) * PHOTO_GSD_MM < GSD_MM / 6
    assert oriented >= len(BROUGHT) - 1
    # Given orientations take the place of matching.
    given = folder / "run" / "products" / "orient" / "cameras.json"
    planned = quick("plan", "photos-on-scan.yaml", *said, "--input", f"cameras={given}", "--json")
    states = {cell["cell"]: cell["status"] for cell in json.loads(planned.out)}
    assert (states["ties"], states["placed"]) == ("skipped", "will run")
