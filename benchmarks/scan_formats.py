"""Read one room from several file formats; measure the bias of ties and check expected errors.

    python benchmarks/scan_formats.py --rooms 2 --first 501
    # the other walls scanned finely too, 16 million points a room:
    python benchmarks/scan_formats.py --rooms 4 --first 501 --panorama-step-m 0.0022

A room is scanned from one station, with points 4.4 mm apart on its main wall (median), and written
as E57 with rows and columns, E57 without them, LAZ, and E57 without them in random order. Each file
is processed separately: `read.scan`, `plane.hough2d`, `raster.grid` with cells of 2, 4 and 8 mm,
ties of six photos (`match.guided` from the true poses), and `orient.colmap-bundle`. `u` and `v` are
the mean offsets, over all photos, of the ties from the true positions of their pixels, in cells to
the right and down. This offset is the displacement of the raster, and thus of every photo. `wall`
is the error per coordinate on the wall, RMS over the photos; `stated` is the expected error of the
poses; `ratio` is the first divided by the second, RMS.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from orientation_truth import context, orient
from orthoflow_plugins.inspect.orientation_errors import pose_errors, true_camera
from orthoflow_plugins.match.guided import MatchGuided
from orthoflow_plugins.orient.bundle import OrientColmapBundle
from orthoflow_plugins.plane.hough2d import Hough2d
from orthoflow_plugins.raster.grid import RasterGrid
from orthoflow_plugins.read.scan import ReadScan
from orthoflow_plugins.simulate.deliverables import measured_step
from orthoflow_plugins.simulate.room import SimulateRoom

from orthoflow.geometry.resection import pixels_by_point
from orthoflow.geometry.scene_views import SceneCameras
from orthoflow.products import InputFiles, Planes, PointCloud, Ties, Truth, Walls

FORMATS = ("e57 with rows", "e57 without", "laz", "random order")
CELLS_M = (0.002, 0.004, 0.008)
# Point spacing opposite the station; it is larger farther away. It is varied by a twentieth at
# random, because with a single value, the scan would sample the edges of the wall at the same
# positions in every room.
_STEP_M = 0.00356
_STEP_SHARE = 0.05
# The main wall, its relief and its recesses are only in the detail scan.
_BEFORE_WALL_M = 0.5
_ALONG_COSINE = 0.99
_LAZ_SCALE_M = 1e-4
# Ties with larger offsets are wrong, and estimators reject them, so they cause no bias.
_WRONG_CELLS = 1.5


@dataclass(kw_only=True)
class Score:
    """Results of a format and a cell size in all rooms; displacements in cells."""

    biases: list[NDArray[np.float64]] = field(default_factory=list)
    errors_m: list[float] = field(default_factory=list)
    stated_m: list[float] = field(default_factory=list)
    n_ties: int = 0

    def row(self) -> str:
        if not self.errors_m:
            return "no photo oriented"
        u, v = np.mean(self.biases, axis=0)
        error, stated = (
            1000.0 * float(np.sqrt(np.mean(np.square(values))))
            for values in (self.errors_m, self.stated_m)
        )
        ratios = np.array(self.errors_m) / np.array(self.stated_m)
        ratio = float(np.sqrt(np.mean(ratios**2)))
        return (
            f"{len(ratios):4d} {self.n_ties:6d} {u:7.3f} {v:7.3f} {error:8.3f} {stated:8.3f} "
            f"{ratio:6.2f}"
        )


def write_e57(path: Path, cloud: PointCloud, order: NDArray[np.intp], *, is_grid: bool) -> None:
    import pye57

    stations = cloud.stations
    scans = np.zeros(len(cloud), dtype=np.uint16) if cloud.scan is None else cloud.scan
    with pye57.E57(str(path), mode="w") as file:
        for index in np.unique(scans):
            chosen = order[scans[order] == index]
            station = np.zeros(3) if stations is None else stations[index]
            points = cloud.points_world(chosen) - station
            fields = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), points.T, strict=True))
            fields |= {"intensity": cloud.intensity[chosen].astype(np.float64)}
            if is_grid:
                fields |= {"rowIndex": cloud.row[chosen].astype(np.int64)}
                fields |= {"columnIndex": cloud.column[chosen].astype(np.int64)}
            fields = {name: np.ascontiguousarray(values) for name, values in fields.items()}
            file.write_scan_raw(fields, translation=station)


def write_laz(path: Path, cloud: PointCloud) -> None:
    import laspy

    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, _LAZ_SCALE_M), np.floor(cloud.origin)
    points = laspy.ScaleAwarePointRecord.zeros(len(cloud), header=header)
    points.x, points.y, points.z = cloud.points_world(np.arange(len(cloud))).T
    points.intensity = np.rint(65535.0 * cloud.intensity).astype(np.uint16)
    with laspy.open(path, mode="w", header=header) as file:
        file.write_points(points)


def written(room: SimulateRoom.Out, folder: Path) -> Iterator[tuple[str, Path]]:
    """Write all files of a room."""
    cloud = room.cloud
    straight = np.arange(len(cloud))
    mixed = np.random.default_rng(7).permutation(len(cloud))
    for name in FORMATS:
        path = folder / f"{name.replace(' ', '-')}.{'laz' if name == 'laz' else 'e57'}"
        if name == "laz":
            write_laz(path, cloud)
        else:
            order = mixed if name == "random order" else straight
            write_e57(path, cloud, order, is_grid=name == "e57 with rows")
        yield name, path


def scanned_room(
    seed: int, panorama_step_m: float, photo_gsd_m: float = 0.0025
) -> SimulateRoom.Out:
    """Simulate a room scanned from one station, with uniform density on its main wall."""
    drawn = np.random.default_rng(seed).uniform(1.0 - _STEP_SHARE, 1.0 + _STEP_SHARE)
    params = SimulateRoom.Params.model_validate(
        {
            "scan_step_m": drawn * _STEP_M,
            "panorama_step_m": panorama_step_m,
            "n_stations": 1,
            "photo_layout": "quick",
            "photo_gsd_m": photo_gsd_m,
        }
    )
    room = SimulateRoom().run(SimulateRoom.In(), params, context(seed))
    cloud, truth = scanned_apart(room.cloud, room.truth)
    return replace(room, cloud=cloud, truth=truth)


def scanned_apart(cloud: PointCloud, truth: Truth) -> tuple[PointCloud, Truth]:
    """Return the cloud without the panorama's points on the main wall, for uniform density."""
    main = truth.planes.names.index("main wall")
    off_m = cloud.points_world() @ truth.planes.normal[main] - truth.planes.offset[main]
    is_kept = np.abs(off_m) > _BEFORE_WALL_M
    if cloud.scan is not None:
        is_kept |= cloud.scan != 0
    per_point = ("x", "y", "z", "intensity", "rgb", "scan", "row", "column")
    kept = {name: np.asarray(getattr(cloud, name))[is_kept] for name in per_point}
    return replace(cloud, **kept), replace(truth, labels=truth.labels[is_kept])


def main_wall_found(cloud: PointCloud, truth: Truth) -> tuple[Planes, int]:
    """Find planes and the main wall; turn it towards the room, because LAZ has no stations."""
    planes = Hough2d().run(Hough2d.In(cloud=cloud), Hough2d.Params(), context(1)).planes
    main = truth.planes.names.index("main wall")
    middle = truth.planes.corners[main].mean(axis=0)
    off_m = np.abs(planes.normal @ middle - planes.offset)
    along = np.abs(planes.normal @ truth.planes.normal[main])
    found = int(np.argmin(np.where(along > _ALONG_COSINE, off_m, np.inf)))
    inside = truth.stations.mean(axis=0) @ planes.normal[found] - planes.offset[found]
    return planes if inside > 0.0 else planes.turned(found), found


def displacements_cells(ties: Ties, walls: Walls, truth: Truth) -> NDArray[np.float64]:
    """Return the offsets of tie points, right and down, from the true targets of their pixels."""
    frame = walls.walls[0].frame
    parts = []
    for photo in np.unique(ties.photo):
        mine = ties.photo == photo
        camera = true_camera(truth, ties.photo_names[photo])
        points = ties.points_world[mine]
        off_px = ties.pixels_photo[mine] - camera.project(points)[:, :2]
        by_plane = pixels_by_point(camera, points) @ np.column_stack([frame.u_world, frame.v_world])
        parts.append(-np.linalg.solve(by_plane, off_px[:, :, None])[:, :, 0] / frame.gsd_m)
    return np.concatenate(parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rooms", type=int, default=2)
    parser.add_argument("--first", type=int, default=501, help="seed of the first room")
    parser.add_argument("--panorama-step-m", type=float, default=0.03, help="of the other walls")
    parser.add_argument("--photo-gsd-m", type=float, default=0.0025, help="pixel on the wall")
    parser.add_argument("--cells-m", type=float, nargs="+", default=CELLS_M)
    parser.add_argument("--formats", nargs="+", default=FORMATS, choices=FORMATS)
    chosen = parser.parse_args()
    scores: dict[tuple[str, float], Score] = {}
    titles = "photos  ties    u       v     wall[mm]  stated  ratio"
    for seed in range(chosen.first, chosen.first + chosen.rooms):
        room = scanned_room(seed, chosen.panorama_step_m, chosen.photo_gsd_m)
        views = SceneCameras(room.truth.scene, cores=2)
        nth = room.truth.planes.names.index("main wall")
        step = measured_step(room.truth, room.cloud, nth)
        if step is not None:
            spacing = f"{1e3 * step[0]:.1f} mm apart (p90 {1e3 * step[1]:.1f})"
            print(f"{seed} {len(room.cloud) / 1e6:.1f} M points, {spacing}", flush=True)
        with tempfile.TemporaryDirectory() as folder:
            for name, path in written(room, Path(folder)):
                if name not in chosen.formats:
                    continue
                files = InputFiles(name="scan", paths=(path,))
                cloud = (
                    ReadScan().run(ReadScan.In(files=files), ReadScan.Params(), context(1)).cloud
                )
                planes, wall = main_wall_found(cloud, room.truth)
                for gsd_m in chosen.cells_m:
                    rule = RasterGrid.Params(gsd_m=gsd_m, buffer_m=0.3, ranks=(wall,))
                    rastered = RasterGrid.In(cloud=cloud, planes=planes)
                    walls = RasterGrid().run(rastered, rule, context(1)).walls
                    score = scores.setdefault((name, gsd_m), Score())
                    judge(score, (walls, cloud), room, views)
                    print(f"{seed} {name:14s} {1000 * gsd_m:3.0f} mm {score.row()}", flush=True)
    print(f"\n{'':23s} {titles}")
    for (name, gsd_m), score in scores.items():
        print(f"{name:14s} {1000 * gsd_m:3.0f} mm   {score.row()}")


def judge(
    score: Score, seen: tuple[Walls, PointCloud], room: SimulateRoom.Out, views: SceneCameras
) -> None:
    """Add the results of a room's photos on a raster of a cloud."""
    walls, cloud = seen
    cameras = room.truth.cameras
    if cameras is None:
        raise SystemExit("the room has no photos")
    matching = MatchGuided.In(photos=room.photos, walls=walls, cameras=cameras, cloud=cloud)
    ties = MatchGuided().run(matching, MatchGuided.Params(), context(1)).ties
    if not len(ties.photo):
        return
    off_cells = displacements_cells(ties, walls, room.truth)
    right = np.abs(off_cells).max(axis=1) < _WRONG_CELLS
    score.biases.append(off_cells[right].mean(axis=0))
    score.n_ties += len(off_cells)
    found = orient(OrientColmapBundle, ties, room.photos)
    for error in pose_errors(found, walls, room.truth, views):
        if error.status == "ok" and error.wall_m and error.sigma_wall_m:
            score.errors_m.append(error.wall_m)
            score.stated_m.append(error.sigma_wall_m)
        else:
            print(f"  {error.photo}: {error.status}", flush=True)


if __name__ == "__main__":
    main()
