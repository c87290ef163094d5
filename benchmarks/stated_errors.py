"""Compare expected errors of photos with the truth, for clouds with correlated point errors.

    python benchmarks/stated_errors.py [--rooms 3] [--clouds plain bent ...] [--noise-m 0.005 0.03]
    python benchmarks/stated_errors.py --entry FOLDER --fountain FOLDER   # real photos, see below

Drawn rooms: For each type of cloud, there are several rooms with different scan noise, cameras and
viewpoints, each with six photos without a known focal length. Scans are registered with an accuracy
of 5 mm, or the cloud is bent by 8 mm at the ends of the room, or the errors of its points are
correlated over half a metre, as in stereo matching. Photos are matched at their true poses
(`match.guided`) and oriented by bundle adjustment. `true` is the error per coordinate on the wall
relative to the scan, RMS over all photos; `stated` is the expected error; `wrong` counts accepted
photos whose error exceeds five expected standard deviations. `cloud` is the mean offset of the
points that a photo shows. The scan cannot reveal this offset, so `true` and `stated` exclude it.
`walls` are the planes of at least 4 m² that were found within 1 degree and 15 mm. With
`--noise-m`, the geometry of the rooms is drawn as well, and the noise of the points of each room
is drawn between these two values, independently of the room.

Real photos: These are folders of the benchmark of Strecha et al. 2008 (entry-P10, fountain-P11)
with `images/NNNN.jpg`, `images/NNNN.jpg.camera` and a cloud `cloud_from_photos.laz` in the same
coordinate system. Each folder is processed with `photos-on-scan.yaml` and 10 mm cells, with and
without its calibration. The mean offset of the points of a photo, which errors exclude, is the mean
difference between withheld ties and the reference camera.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from orthoflow_plugins.inspect.orientation_errors import pose_errors
from orthoflow_plugins.match.guided import MatchGuided
from orthoflow_plugins.orient.bundle import OrientColmapBundle
from orthoflow_plugins.plane.hough2d import Hough2d
from orthoflow_plugins.raster.grid import RasterGrid
from orthoflow_plugins.simulate.room import SimulateRoom

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.resection import pixels_by_point
from orthoflow.geometry.scene_views import SceneCameras
from orthoflow.products import Camera, Cameras, Photos, Planes, PointCloud, Wall
from orthoflow.sdk import StepContext

CLOUDS: Final[dict[str, dict[str, float]]] = {
    "plain": {},
    "registered": {"registration_error_m": 0.005},
    "bent": {"bending_m": 0.008},
    "stereo": {"shared_noise_m": 0.004, "shared_noise_length_m": 0.5},
    "far": {"shared_noise_m": 0.004, "shared_noise_length_m": 3.0},
}
_BUFFER_M: Final = 0.3
# Minimum area of the planes that must be found, and the distance within which they count as found.
_LARGE_M2: Final = 4.0
_NEAR_M: Final = 0.015
# Offsets are computed for every nth point of a wall.
_EVERY: Final = 50
# Photos from which no cloud of these folders was made.
ENTRY: Final = ("0002", "0003", "0004", "0007", "0008", "0009")
FOUNTAIN: Final = ("0000", "0003", "0006", "0009", "0010")


def context(folder: str, seed: int) -> StepContext:
    return StepContext(rng=np.random.default_rng(seed), cores=2, scratch=Path(folder))


@dataclass(frozen=True, kw_only=True)
class Oriented:
    """True and expected errors of the photos of a room, reasons for rejection, and wrong poses.

    `walls` are the numbers of large planes found and of all large planes.
    """

    errors_m: list[tuple[float, float]]
    refused: list[str]
    n_wrong: int
    cloud_m: float
    walls: tuple[int, int]


def simulated(cloud: str, seed: int, folder: str, noise_m: float | None) -> SimulateRoom.Out:
    """Build a room with the cloud errors given in `CLOUDS`, or with noise only."""
    chosen: dict[str, object] = {"scan_step_m": 0.004, "panorama_step_m": 0.02, "noise_m": 0.002}
    chosen |= {"photo_gsd_m": 0.003, "photo_layout": "quick", "textile_share": 0.33}
    if noise_m is not None:
        chosen |= {"geometry": "drawn", "noise_m": noise_m}
    params = SimulateRoom.Params.model_validate(chosen | CLOUDS[cloud])
    return SimulateRoom().run(SimulateRoom.In(), params, context(folder, seed))


def walls_found(found: Planes, true: Planes) -> tuple[int, int]:
    """Return the numbers of true planes of at least 4 m² that were found, and of all of them."""
    sides = true.corners[:, [1, 3]] - true.corners[:, :1]
    is_large = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) >= _LARGE_M2
    middles = true.corners[is_large].mean(axis=1)
    is_parallel = np.abs(true.normal[is_large] @ found.normal.T) >= np.cos(np.radians(1.0))
    is_near = np.abs(middles @ found.normal.T - found.offset) <= _NEAR_M
    return int((is_parallel & is_near).any(axis=1).sum()), int(is_large.sum())


def cloud_shifts(
    off: PointCloud, exact: PointCloud, wall: Wall, cameras: Cameras
) -> list[NDArray[np.float64]]:
    """Return the mean offset (3,) of the wall points that each photo shows, metres."""
    some = np.arange(0, len(off), _EVERY)
    points, true = off.points_world(some), exact.points_world(some)
    near = np.abs(wall.frame.wall_from_world(points)[:, 2]) < _BUFFER_M
    points, true = points[near], true[near]
    shifts = []
    for camera in cameras.cameras:
        view = camera.viewing()
        shown = view.sees(view.project(points)[:, :2])
        shifts.append(np.asarray((points - true)[shown].mean(axis=0)))
    return shifts


def room(cloud: str, seed: int, folder: str, noise_m: float | None) -> Oriented:
    """Orient the photos of a drawn room."""
    built = simulated(cloud, seed, folder, noise_m)
    planes = Hough2d().run(Hough2d.In(cloud=built.cloud), Hough2d.Params(), context(folder, 1))
    walls = (
        RasterGrid()
        .run(
            RasterGrid.In(cloud=built.cloud, planes=planes.planes),
            RasterGrid.Params(gsd_m=0.006, buffer_m=_BUFFER_M, n_walls_max=1),
            context(folder, 1),
        )
        .walls
    )
    true = built.truth.cameras or Cameras(cameras=())
    ties = (
        MatchGuided()
        .run(
            MatchGuided.In(photos=built.photos, walls=walls, cameras=true),
            MatchGuided.Params(),
            context(folder, 1),
        )
        .ties
    )
    unknown = Photos(
        photos=tuple(
            replace(photo, intrinsics=None, exif_focal_px=None) for photo in built.photos.photos
        )
    )
    wide = {"max_sigma_wall_cells": 10.0, "max_sigma_corner_cells": 30.0}
    cameras = (
        OrientColmapBundle()
        .run(
            OrientColmapBundle.In(ties=ties, photos=unknown, cloud=built.cloud),
            OrientColmapBundle.Params.model_validate(wide),
            context(folder, 1),
        )
        .cameras
    )
    shifts = [np.zeros(3)] * len(cameras.cameras)
    if CLOUDS[cloud]:
        with tempfile.TemporaryDirectory() as beside:
            exact = simulated("plain", seed, beside, noise_m).cloud
            shifts = cloud_shifts(built.cloud, exact, walls.walls[0], true)
    there = [moved(one, -shift) for one, shift in zip(cameras.cameras, shifts, strict=True)]
    relative = replace(cameras, cameras=tuple(there))
    errors = pose_errors(relative, walls, built.truth, SceneCameras(built.truth.scene, cores=2))
    known = [
        (error.wall_m, error.sigma_wall_m)
        for error in errors
        if error.wall_m is not None and error.sigma_wall_m is not None
    ]
    refused = [error.status for error in errors if error.status != "ok"]
    return Oriented(
        errors_m=known,
        refused=refused,
        n_wrong=sum(error.is_wrong for error in errors),
        cloud_m=float(np.sqrt(np.mean(np.square(shifts)))),
        walls=walls_found(planes.planes, built.truth.planes),
    )


def moved(camera: Camera, by_m: NDArray[np.float64]) -> Camera:
    """Return a camera shifted in the world."""
    if camera.status != "ok":
        return camera
    return replace(
        camera, translation_camera_from_world=camera.viewing().shifted(-by_m).translation
    )


def rms(pairs: list[tuple[float, float]]) -> NDArray[np.float64]:
    """Return the RMS of the true and of the expected errors; NaN if no photo is oriented."""
    return np.asarray(np.sqrt(np.mean(np.square(pairs or [(np.nan, np.nan)]), axis=0)))


def drawn(chosen: argparse.Namespace) -> None:
    print(f"{'cloud':12s} photos   cloud    true  stated  stated/true  wrong  walls")
    for cloud in chosen.clouds:
        rooms = []
        for seed in range(chosen.first, chosen.first + chosen.rooms):
            # A second key makes the noise independent of the room, which the seed alone draws.
            noise_m = chosen.noise_m and np.random.default_rng([seed, 1]).uniform(*chosen.noise_m)
            with tempfile.TemporaryDirectory() as folder:
                rooms.append(room(cloud, seed, folder, noise_m))
            noise = f", noise {1e3 * noise_m:.1f} mm" if noise_m else ""
            shown = "no photo is oriented"
            if rooms[-1].errors_m:
                shown = "true {:.2f}, stated {:.2f} mm".format(*1e3 * rms(rooms[-1].errors_m))
            print(f"  {cloud} {seed}{noise}: {shown}", flush=True)
            for reason in rooms[-1].refused:
                print(f"  {cloud} {seed}: {reason}", flush=True)
        found = [pair for one in rooms for pair in one.errors_m]
        n_photos = len(found) + sum(len(one.refused) for one in rooms)
        true, stated = rms(found)
        n_walls, n_true = np.sum([one.walls for one in rooms], axis=0)
        off = np.sqrt(np.mean([one.cloud_m**2 for one in rooms]))
        print(
            f"{cloud:12s} {len(found):2d}/{n_photos:<3d} {1e3 * off:6.2f}  {1e3 * true:6.2f}  "
            f"{1e3 * stated:6.2f}  {stated / true:11.2f}  {sum(one.n_wrong for one in rooms):5d}  "
            f"{n_walls}/{n_true}",
            flush=True,
        )


def real(folder: Path, names: tuple[str, ...]) -> None:
    """Orient photos on their cloud, with and without calibration, and compare the cameras."""
    import laspy

    cloud = np.asarray(laspy.read(folder / "cloud_from_photos.laz").xyz)[::_EVERY]
    with tempfile.TemporaryDirectory() as scratch:
        photos, calibration = Path(scratch, "photos"), Path(scratch, "calibration.yaml")
        photos.mkdir()
        for name in names:
            (photos / f"{name}.jpg").symlink_to((folder / "images" / f"{name}.jpg").resolve())
        rows = [float(word) for word in (folder / "images" / "K.txt").read_text().split()]
        calibration.write_text(
            'cameras: {"*": {width: 3072, height: 2048, '
            f"fx: {rows[0]}, fy: {rows[4]}, cx: {rows[2]}, cy: {rows[5]}, "
            "distortion: [0, 0, 0, 0, 0]}}\n"
        )
        for is_known in (True, False):
            run = Path(scratch, f"run-{is_known}")
            subprocess.run(
                [sys.executable, "-m", "orthoflow", "run", "photos-on-scan.yaml", "-o", str(run)]
                + ["--store", str(Path(scratch, "store")), "--until", "orient"]
                + ["--set", "cloud.up=-z", "--set", "wall.gsd_m=0.01"]
                + ["--input", f"scan={folder / 'cloud_from_photos.laz'}"]
                + ["--input", f"photos={photos}"]
                + (["--input", f"calibration={calibration}"] if is_known else []),
                check=True,
                capture_output=True,
            )
            written = json.loads(next(run.glob("products/orient*/cameras.json")).read_text())
            with next(run.glob("products/orient*/ties.csv")).open(encoding="utf-8") as file:
                withheld = [row for row in csv.DictReader(file) if row["role"] == "check"]
            for name in names:
                camera = written["cameras"][f"{name}.jpg"]
                label = f"{folder.name} {'with' if is_known else 'without'} K {name}"
                if camera["status"] != "ok":
                    print(f"{label}: {camera['status']}")
                    continue
                found, true = read_camera(camera), reference_camera(folder, name, rows)
                apart = np.linalg.norm(found.centre_world - true.centre_world)
                offset_m = mean_offset(true, [r for r in withheld if r["photo"] == f"{name}.jpg"])
                relative = found.shifted(offset_m)
                on_wall, stated = error_on_wall(relative, true, cloud), camera["sigma_wall_mm"]
                print(
                    f"{label}: centre {1e3 * apart:5.1f} mm off, on the wall {1e3 * on_wall:.2f} mm"
                    f" where {stated:.2f} is stated ({1e3 * on_wall / stated:.2f}), "
                    f"f {found.fx:.1f} px",
                    flush=True,
                )


def read_camera(written: dict[str, Any]) -> ViewingCamera:
    """Read a camera from `cameras.json`."""
    lens = np.array(written["K"])
    return ViewingCamera(
        width=written["width"],
        height=written["height"],
        fx=lens[0, 0],
        fy=lens[1, 1],
        cx=lens[0, 2],
        cy=lens[1, 2],
        distortion=np.array(written["distortion"]),
        rotation=np.array(written["R_camera_from_world"]),
        translation=np.array(written["t_camera_from_world"]),
    )


def reference_camera(folder: Path, name: str, lens: list[float]) -> ViewingCamera:
    """Read a camera of the benchmark of Strecha et al.; `lens` contains K row by row."""
    lines = (folder / "images" / f"{name}.jpg.camera").read_text().splitlines()
    # The file contains few digits, so take the nearest rotation.
    left, _, right = np.linalg.svd([[float(word) for word in row.split()] for row in lines[4:7]])
    rotation = (left @ right).T
    centre = np.array([float(word) for word in lines[7].split()])
    return ViewingCamera(
        width=3072,
        height=2048,
        fx=lens[0],
        fy=lens[4],
        cx=lens[2],
        cy=lens[5],
        distortion=np.zeros(5),
        rotation=rotation,
        translation=-rotation @ centre,
    )


def mean_offset(true: ViewingCamera, ties: list[dict[str, str]]) -> NDArray[np.float64]:
    """Return the mean offset (3,) of the cloud that ties of a photo show, metres."""
    points = np.array([[float(tie[axis]) for axis in "xyz"] for tie in ties])
    pixels = np.array([[float(tie["u_px"]), float(tie["v_px"])] for tie in ties])
    off, by_point = true.project(points)[:, :2] - pixels, pixels_by_point(true, points)
    offset_m, *_ = np.linalg.lstsq(by_point.reshape(-1, 3), off.ravel(), rcond=None)
    return np.asarray(offset_m)


def error_on_wall(found: ViewingCamera, true: ViewingCamera, points: NDArray[np.float64]) -> float:
    """Return the RMS error per coordinate, perpendicular to the view, of points in a photo."""
    seen = true.project(points)
    shown = true.sees(seen[:, :2])
    off = found.project(points[shown])[:, :2] - seen[shown, :2]
    return float(np.sqrt(np.mean((off * seen[shown, 2:] / true.fx) ** 2)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rooms", type=int, default=3, help="rooms of each kind of cloud")
    parser.add_argument("--first", type=int, default=1, help="seed of the first room")
    parser.add_argument("--clouds", nargs="*", default=list(CLOUDS), choices=list(CLOUDS))
    parser.add_argument(
        "--noise-m", type=float, nargs=2, help="range of the noise of the points in drawn rooms"
    )
    parser.add_argument("--entry", type=Path)
    parser.add_argument("--fountain", type=Path)
    chosen = parser.parse_args()
    if chosen.entry or chosen.fountain:
        for folder, names in ((chosen.entry, ENTRY), (chosen.fountain, FOUNTAIN)):
            if folder is not None:
                real(folder, names)
        return
    drawn(chosen)


if __name__ == "__main__":
    main()
