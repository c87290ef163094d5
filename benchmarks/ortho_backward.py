"""Compare our projection of photos onto a wall, including visibility, with cv2.remap alone.

    python benchmarks/ortho_backward.py [--megacells 4] [--megapixels 6] [--threads 2]
                                        [--repeat 5] [--fresh]

Times are medians of interleaved runs and exclude decoding. cv2.remap gets precomputed maps, whose
time is not counted, and does not test visibility. Both write into existing arrays. With `--fresh`,
both allocate new arrays each time; those of the layer, with quality and mask, are two and a half
times as large. On a virtual machine that returns unused memory to its host, allocation may take
longer than projection. Each task runs twice in a row, and the second run is measured. `layer` is
the complete projection of one photo onto one wall: relief, cloud, erosion, anti-aliasing, quality.
`cloud` is the additional time per photo for examining the cloud.
"""

from __future__ import annotations

import argparse
import math
import time
import tracemalloc
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import DTypeLike, NDArray
from orthoflow_plugins.ortho.dsm_backward import DsmBackward
from orthoflow_plugins.ortho.painting import paint
from orthoflow_plugins.ortho.surfaces import surface_of, view_of

from orthoflow.geometry import WallFrame
from orthoflow.geometry.cameras import ViewingCamera, looking_at
from orthoflow.geometry.occluders import (
    Occluders,
    depth_buffer,
    nothing_in_the_way,
    occluders_before,
)
from orthoflow.products import PointCloud, Wall, Walls

GSD_M = 0.003
UP = np.array([0.0, 0.0, 1.0])
# Number of rows that are processed in float64 at once.
BAND_ROWS = 256
MOST_POINTS = 10_000_000


def wall(megacells: float) -> Walls:
    """Return a 3:2 wall with 5 cm frames, 2 mm noise, and one void cell in a thousand."""
    rng = np.random.default_rng(1)
    rows = round(math.sqrt(megacells * 1e6 / 1.5))
    columns = round(1.5 * rows)
    depth = rng.standard_normal((rows, columns), dtype=np.float32) * np.float32(0.002)
    depth += (0.05 * ((np.arange(columns) // 90) % 4 == 0)).astype(np.float32)
    depth[rng.random(depth.shape, dtype=np.float32) < 0.001] = np.nan
    frame = WallFrame(
        origin_world=np.zeros(3),
        u_world=np.array([1.0, 0, 0]),
        v_world=np.array([0, 0, -1.0]),
        normal_world=np.array([0, -1.0, 0]),
        gsd_m=GSD_M,
        width=columns,
        height=rows,
    )
    raster = Wall(
        frame=frame,
        plane_index=0,
        name="wall 0",
        depth_m=depth,
        sigma_m=np.full_like(depth, np.nan),
        count=np.ones(depth.shape, dtype=np.uint32),
        mask=np.isfinite(depth).astype(np.uint8),
    )
    return Walls(
        walls=(raster,), up=UP, intensity_source="none", buffer_front_m=0.15, buffer_behind_m=0.15
    )


def cloud(walls: Walls) -> PointCloud:
    """Return all or some wall cells as points, and a tenth as many points on a board in front."""
    frame, depth = walls.walls[0].frame, walls.walls[0].depth_m
    points, step = [], max(1, depth.size // MOST_POINTS)
    for first in range(0, frame.height, BAND_ROWS):
        rows, columns = (
            part[::step] for part in np.nonzero(np.isfinite(depth[first : first + BAND_ROWS]))
        )
        rows = rows + first
        places = np.column_stack([columns, rows]) + 0.5
        heights = depth[rows, columns].astype(np.float64)
        points.append(frame.world_from_wall(places, heights).astype(np.float32))
        is_near = (rows < frame.height // 3) & (columns < frame.width // 3)
        board = np.full(int(is_near.sum()), 0.6)
        points.append(frame.world_from_wall(places[is_near], board).astype(np.float32))
    x, y, z = (np.concatenate([part[:, axis] for part in points]) for axis in range(3))
    return PointCloud(origin=np.zeros(3), x=x, y=y, z=z, up=UP)


def camera(frame: WallFrame, megapixels: float, oblique_deg: float) -> ViewingCamera:
    """Return a camera with distortion that shows the whole wall."""
    height = round(math.sqrt(megapixels * 1e6 / 1.5))
    width = round(1.5 * height)
    target = frame.world_from_wall(np.array([[frame.width / 2, frame.height / 2]]))[0]
    distance = 1.15 * frame.width * GSD_M
    angle = math.radians(oblique_deg)
    centre = target + distance * (
        math.cos(angle) * frame.normal_world + math.sin(angle) * frame.u_world
    )
    rotation = looking_at(centre, target, UP)
    return ViewingCamera(
        width=width,
        height=height,
        fx=0.95 * width,
        fy=0.95 * width,
        cx=width / 2,
        cy=height / 2,
        distortion=np.array([-0.05, 0.01, 1e-4, -1e-4, 0.0]),
        rotation=rotation,
        translation=-rotation @ centre,
    )


def seconds(task: Callable[[], object]) -> tuple[float, float]:
    """Return elapsed and processor time of all threads; other load affects the latter less."""
    started, used = time.perf_counter(), time.process_time()
    task()
    return time.perf_counter() - started, time.process_time() - used


def peak_bytes(task: Callable[[], object]) -> int:
    """Return the peak memory of arrays while a task runs, without OpenCV's own arrays."""
    tracemalloc.start()
    task()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


def maps(walls: Walls, viewer: ViewingCamera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    frame, depth = walls.walls[0].frame, walls.walls[0].depth_m
    u, v = np.empty(frame.shape, dtype=np.float32), np.empty(frame.shape, dtype=np.float32)
    for first in range(0, frame.height, BAND_ROWS):
        band = slice(first, first + BAND_ROWS)
        heights = np.nan_to_num(depth[band]).astype(np.float64)
        rows, columns = np.indices(heights.shape) + 0.5
        places = np.column_stack([columns.ravel(), rows.ravel() + first])
        pixels = viewer.project(frame.world_from_wall(places, heights.ravel()))[:, :2] - 0.5
        u[band], v[band] = pixels.T.reshape(2, *heights.shape)
    return u, v


class KeptArrays:
    """Returns the same array for a name every time, with its previous content."""

    def __init__(self) -> None:
        self._arrays: dict[str, NDArray[np.generic]] = {}

    def __call__(self, name: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[np.generic]:
        if name not in self._arrays:
            self._arrays[name] = allocate_anew(name, shape, dtype)
        return self._arrays[name].view()


def allocate_anew(name: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[np.generic]:
    del name
    return np.zeros(shape, dtype)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--megacells", type=float, default=4.0)
    parser.add_argument("--megapixels", type=float, default=6.0)
    parser.add_argument("--oblique-deg", type=float, default=25.0)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--fresh", action="store_true")
    options = parser.parse_args()
    walls = wall(options.megacells)
    raster = walls.walls[0]
    viewer = camera(raster.frame, options.megapixels, options.oblique_deg)
    points = cloud(walls)
    rng = np.random.default_rng(0)
    photo = rng.integers(0, 256, (viewer.height, viewer.width, 3), np.uint8)

    def found() -> Occluders:
        return occluders_before(
            points,
            [walls.slab(0)],
            [viewer],
            spacing_m=walls.points_apart_m(),
            stations_world=None,
            n_least=6,
            threads=options.threads,
        )

    occluders = found()
    buffer = depth_buffer(occluders, viewer)
    ready = maps(walls, viewer)
    cv2.setNumThreads(options.threads)

    kept = KeptArrays()

    def layer(
        resampling: str, *, is_seen_through: bool = False, is_fresh: bool = options.fresh
    ) -> Callable[[], object]:
        visibility = "none" if is_seen_through else "full"
        params = DsmBackward.Params.model_validate(
            {"resampling": resampling, "visibility": visibility}
        )
        allocate = allocate_anew if is_fresh else kept

        def task() -> object:
            hides = not is_seen_through
            surface = surface_of(walls, 0, hides=hides, allocate=allocate)
            return paint(
                photo,
                view_of(viewer, surface, params),
                surface,
                nothing_in_the_way(viewer) if is_seen_through else buffer,
                params,
                allocate=allocate,
                threads=options.threads,
            )

        return task

    def remap(flag: int) -> Callable[[], object]:
        into = None if options.fresh else np.zeros((*raster.frame.shape, 3), dtype=np.uint8)
        return lambda: cv2.remap(photo, *ready, flag, dst=into, borderMode=cv2.BORDER_CONSTANT)

    tasks = {
        "cv2.remap bilinear": remap(cv2.INTER_LINEAR),
        "layer bilinear, visibility none": layer("bilinear", is_seen_through=True),
        "layer bilinear": layer("bilinear"),
        "cv2.remap cubic": remap(cv2.INTER_CUBIC),
        "layer cubic": layer("cubic"),
        "layer nearest": layer("nearest"),
        "cloud": lambda: depth_buffer(occluders, viewer),
        "count in voxels": found,
    }
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in tasks}
    for _ in range(options.repeat):
        for name, task in tasks.items():
            task()
            times[name].append(seconds(task))
    medians = {name: np.median(values, axis=0) for name, values in times.items()}
    print(
        f"wall {raster.frame.width} x {raster.frame.height}, photo {viewer.width} x "
        f"{viewer.height}, {len(points) / 1e6:.1f} M points, {options.oblique_deg:g} deg, "
        f"{options.threads} threads"
    )
    for name, median in medians.items():
        least = 1e3 * min(times[name])[0]
        wall_ms, processor_ms = 1e3 * median
        print(f"{name:32s} {wall_ms:8.1f} ms  (from {least:.1f}), processor {processor_ms:.1f} ms")
    for kind in ("bilinear, visibility none", "bilinear", "cubic"):
        ratio = medians[f"layer {kind}"] / medians[f"cv2.remap {kind.split(',', maxsplit=1)[0]}"]
        print(f"layer / cv2.remap, {kind}: {ratio[0]:.2f}, of processor time {ratio[1]:.2f}")
    # A layer consists of colours, quality and mask: eight bytes per cell.
    layer_bytes = 8 * raster.depth_m.size
    for kind in ("none", "full"):
        task = layer("bilinear", is_seen_through=kind == "none", is_fresh=True)
        extra = peak_bytes(task) - layer_bytes
        print(f"memory besides the layer, visibility {kind}: {extra / 2**20:.0f} MiB")


if __name__ == "__main__":
    main()
