"""Compare our computation of the topmost raster of a scan-ordered wall with numpy's.

    python benchmarks/raster_top.py [--millions 48] [--threads 2] [--repeat 5]

Times are medians of interleaved runs. F is the time of one streaming pass over the coordinates,
measured in the same run; no method that reads the cloud once can be faster. The goals are: at most
20 F, at least four times as fast as `np.maximum.at`, and depths identical to those of `np.lexsort`.
numpy's version does less: it assumes that the wall is vertical and along x, does not count points,
and does not define which of several topmost points provides the intensity. The complete
`raster.grid` is also measured.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np
from numpy.typing import NDArray
from orthoflow_plugins.raster.grid import RasterGrid

from orthoflow.geometry import frame_over
from orthoflow.geometry.rastering import topmost_points, values_of_winners
from orthoflow.geometry.slabs import Slab
from orthoflow.products import Planes, PointCloud
from orthoflow.sdk import StepContext

GSD_M = 0.003
BUFFER_M = 0.15
SIZE_M = (9.2, 5.2)


def scan(n_points: int) -> PointCloud:
    """Return the columns of a scan of a room corner, in scan order; half of it is on the wall."""
    rng = np.random.default_rng(20150807)
    n_columns = int(np.sqrt(2 * n_points))
    per_column = n_points // n_columns
    azimuth = np.linspace(-1.5, 1.5, n_columns, dtype=np.float32)[:, None]
    height = np.linspace(0.0, SIZE_M[1], per_column, dtype=np.float32)[None, :]
    along = SIZE_M[0] / 2 * (1 + azimuth / 0.75) + 0 * height
    is_beside = np.abs(azimuth) > 0.75
    depth = np.where(is_beside, 1.0 + np.abs(azimuth), 0.0) + 0.08 * (along % 1 > 0.8) + 0 * height
    depth = depth + rng.normal(0, 0.002, depth.shape).astype(np.float32)
    x, y, z = (
        np.ascontiguousarray(a, dtype=np.float32).ravel()
        for a in (along, -depth, height + 0 * along)
    )
    intensity = rng.random(x.size, dtype=np.float32)
    return PointCloud(
        origin=np.zeros(3), x=x, y=y, z=z, up=np.array([0.0, 0, 1]), intensity=intensity
    )


def planes() -> Planes:
    width, height = SIZE_M
    corners = np.array([[0, 0, height], [0, 0, 0], [width, 0, 0], [width, 0, height]], dtype=float)
    return Planes(
        normal=np.array([[0.0, -1.0, 0.0]]),
        offset=np.zeros(1),
        corners=corners[None],
        covariance=np.zeros((1, 4, 4)),
        n_points=np.ones(1, dtype=np.int64),
        rms_m=np.zeros(1),
        up=np.array([0.0, 0, 1]),
        names=("wall 0",),
    )


@numba.njit(parallel=True)
def one_pass(x: NDArray[np.float32], y: NDArray[np.float32], z: NDArray[np.float32]) -> int:
    count = 0
    for i in numba.prange(x.size):
        count += abs(x[i] * 0.1 + y[i] * 0.9 + z[i] * 0.01 - 3.7) < 0.05
    return count


def with_ours(cloud: PointCloud, slab: Slab, threads: int) -> tuple[NDArray, NDArray]:
    winners = topmost_points(cloud, slab, threads=threads)
    intensity = values_of_winners(winners, cloud.intensity[:, None], np.nan)
    return winners["depth_m"], intensity[:, 0]


def laid_out(cloud: PointCloud, slab: Slab) -> tuple[NDArray, NDArray, NDArray]:
    """Return cell, depth and intensity of the points inside, computed with numpy."""
    frame = slab.frame
    depth = -cloud.y
    near = np.abs(depth) <= np.float32(BUFFER_M)
    column = (cloud.x[near].astype(np.float64) / GSD_M).astype(np.int32)
    row = ((SIZE_M[1] - cloud.z[near].astype(np.float64)) / GSD_M).astype(np.int32)
    inside = (column >= 0) & (column < frame.width) & (row >= 0) & (row < frame.height)
    cell = (row * frame.width + column)[inside]
    return cell, depth[near][inside], cloud.intensity[near][inside]


def with_maximum_at(cloud: PointCloud, slab: Slab) -> tuple[NDArray, NDArray]:
    cell, depth, values = laid_out(cloud, slab)
    top = np.full(slab.n_cells, -np.inf, dtype=np.float32)
    np.maximum.at(top, cell, depth)
    is_top = depth == top[cell]
    intensity = np.full(slab.n_cells, np.nan, dtype=np.float32)
    intensity[cell[is_top]] = values[is_top]
    return top, intensity


def depths_by_sorting(cloud: PointCloud, slab: Slab) -> NDArray:
    cell, depth, _ = laid_out(cloud, slab)
    order = np.lexsort((depth, cell))
    is_last = np.append(np.diff(cell[order]) != 0, True)
    top = np.full(slab.n_cells, -np.inf, dtype=np.float32)
    top[cell[order[is_last]]] = depth[order[is_last]]
    return top


def whole_method(cloud: PointCloud, surface: str, threads: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        ctx = StepContext(rng=np.random.default_rng(0), cores=threads, scratch=Path(folder))
        params = RasterGrid.Params.model_validate({"gsd_m": GSD_M, "surface": surface})
        RasterGrid().run(RasterGrid.In(cloud=cloud, planes=planes()), params, ctx)


def interleaved(
    contestants: dict[str, Callable[[], object]], repeat: int
) -> tuple[dict[str, list[float]], dict[str, list[float]]]:
    """Return elapsed times, and processor times, which other load affects less."""
    seconds: dict[str, list[float]] = {name: [] for name in contestants}
    processor: dict[str, list[float]] = {name: [] for name in contestants}
    for round_number in range(repeat + 1):
        for name, run in contestants.items():
            started, used = time.perf_counter(), time.process_time()
            run()
            # The first round includes compilation.
            if round_number:
                seconds[name].append(time.perf_counter() - started)
                processor[name].append(time.process_time() - used)
    return seconds, processor


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--millions", type=float, default=48.0)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeat", type=int, default=5)
    options = parser.parse_args()
    cloud = scan(int(options.millions * 1e6))
    threads = options.threads
    numba.set_num_threads(threads)
    frame = frame_over(planes().corners[0], planes().normal[0], gsd_m=GSD_M)
    slab = Slab(frame=frame, front_m=BUFFER_M, behind_m=BUFFER_M)
    seconds, processor = interleaved(
        {
            "F": lambda: one_pass(cloud.x, cloud.y, cloud.z),
            "topmost, ours": lambda: with_ours(cloud, slab, threads),
            "topmost, np.maximum.at": lambda: with_maximum_at(cloud, slab),
            "raster.grid topmost": lambda: whole_method(cloud, "topmost", threads),
            "raster.grid median": lambda: whole_method(cloud, "median", threads),
        },
        options.repeat,
    )
    ours, theirs = with_ours(cloud, slab, threads)[0], depths_by_sorting(cloud, slab)
    print(
        f"{len(cloud) / 1e6:.1f} M points, {frame.width} x {frame.height} cells, {threads} threads"
    )
    floor = statistics.median(seconds["F"])
    for name, values in seconds.items():
        middle = statistics.median(values)
        spread = f"{min(values):.3f}..{max(values):.3f}"
        used = statistics.median(processor[name])
        multiple = middle / floor
        print(f"{name:24s} {middle:7.3f} s ({spread})  {multiple:6.1f} F, processor {used:.3f} s")
    for kind, times in (("", seconds), (" of processor time", processor)):
        ratio = statistics.median(times["topmost, np.maximum.at"]) / statistics.median(
            times["topmost, ours"]
        )
        print(f"np.maximum.at takes {ratio:.1f} x as long{kind}")
    print(f"same depths as by np.lexsort: {np.array_equal(ours, theirs)}")


if __name__ == "__main__":
    main()
