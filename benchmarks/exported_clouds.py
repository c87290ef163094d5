"""Measure the time and memory of cloud exports by number of points.

`python -m benchmarks.exported_clouds --points 50` writes 50 million points of a simulated room as
LAZ, COPC, PLY and E57, each in a separate process, and prints the time and the peak memory of each,
with and without memory-mapped files.
"""

from __future__ import annotations

import argparse
import multiprocessing
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from benchmarks.large_exports import own_mib, watch
from benchmarks.tiled_orthoimage import largest_mib
from orthoflow.files.clouds.attributes import AttributedCloud
from orthoflow.files.clouds.copc import write_copc
from orthoflow.files.clouds.neighbourhoods import neighbourhoods_of
from orthoflow.files.clouds.writers import write_e57, write_laz, write_ply
from orthoflow.products import PointCloud

WRITERS = {"laz": write_laz, "copc": write_copc, "ply": write_ply, "e57": write_e57}
ROOM_M = (12.0, 8.0, 4.0)


def mapped_room(folder: Path, n_points: int) -> PointCloud:
    """Return points on six walls with 1 mm of noise, in memory-mapped files as in a store."""
    random = np.random.default_rng(7)
    arrays = {
        axis: np.memmap(folder / axis, dtype=np.float32, mode="w+", shape=(n_points,))
        for axis in "xyz"
    }
    intensity = np.memmap(folder / "i", dtype=np.float32, mode="w+", shape=(n_points,))
    for first in range(0, n_points, 1 << 20):
        part = slice(first, min(n_points, first + (1 << 20)))
        count = part.stop - part.start
        points = random.random((count, 3)) * ROOM_M
        axis = random.integers(0, 3, count)
        side = random.integers(0, 2, count) * np.array(ROOM_M)[axis]
        points[np.arange(count), axis] = side + random.normal(0.0, 0.001, count)
        for name, values in zip("xyz", points.T, strict=True):
            arrays[name][part] = values
        intensity[part] = random.random(count)
    return PointCloud(
        origin=np.array([500_000.0, 4_000_000.0, 100.0]),
        up=np.array([0.0, 0.0, 1.0]),
        intensity=intensity,
        **arrays,
    )


def export(name: str, folder: Path, n_points: int) -> None:
    """Open the files of the room, export the cloud, and print time and memory."""
    names = {"x": "x", "y": "y", "z": "z", "intensity": "i"}
    arrays = {
        field: np.memmap(folder / file, dtype=np.float32, mode="r", shape=(n_points,))
        for field, file in names.items()
    }
    cloud = PointCloud(
        origin=np.array([500_000.0, 4_000_000.0, 100.0]), up=np.array([0.0, 0.0, 1.0]), **arrays
    )
    peaks, is_over = [own_mib()], threading.Event()
    watcher = threading.Thread(target=watch, args=(peaks, is_over))
    watcher.start()
    before, first = time.perf_counter(), time.process_time()
    attributed = AttributedCloud(
        cloud=cloud, colouring="intensity", neighbourhoods=neighbourhoods_of(cloud)
    )
    looked = time.perf_counter() - before
    path = folder / f"cloud.{name}"
    WRITERS[name](path, attributed)
    is_over.set()
    watcher.join()
    print(
        f"{name}: {n_points / 1e6:g} M points, {time.perf_counter() - before:.0f} s "
        f"({looked:.0f} s for normals), processor {time.process_time() - first:.0f} s, largest "
        f"memory {largest_mib():.0f} MiB, without mapped files {peaks[0]:.0f} MiB, "
        f"{path.stat().st_size / 1e6:.0f} MB",
        flush=True,
    )
    path.unlink()


def main() -> None:
    """Write the room in each format."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=float, default=50.0, help="millions of points")
    parser.add_argument("--format", choices=WRITERS, help="only this one")
    given = parser.parse_args()
    n_points = int(1e6 * given.points)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        mapped_room(folder, n_points)
        for target in [given.format] if given.format else WRITERS:
            worker = multiprocessing.get_context("spawn").Process(
                target=export, args=(target, folder, n_points)
            )
            worker.start()
            worker.join()


if __name__ == "__main__":
    main()
