"""Measure the time and memory of making tiles of a large orthoimage.

`python benchmarks/tiled_orthoimage.py --side 20000` writes a simulated orthoimage of 400 million
cells in the form that exports read (a cloud-optimised GeoTIFF with its sidecar), then its tiles in
a separate process, and prints the time and the peak memory.
"""

from __future__ import annotations

import argparse
import multiprocessing
import tempfile
import time
from pathlib import Path

import numpy as np

from orthoflow.files.geotiff import GridPlace, write_orthoimage
from orthoflow.files.sidecars import frame_json, ortho_files, write_json
from orthoflow.files.tiles.pyramid import write_tiles, write_viewer
from orthoflow.geometry import WallFrame

GSD_M = 0.001


def large_orthoimage(folder: Path, side: int, n_rows: int) -> Path:
    """Write an orthoimage of smooth colours with noise and a hole, band by band."""
    frame = WallFrame(
        origin_world=np.array([500_000.0, 4_000_000.0, 100.0]),
        u_world=np.array([1.0, 0.0, 0.0]),
        v_world=np.array([0.0, 0.0, -1.0]),
        normal_world=np.array([0.0, -1.0, 0.0]),
        gsd_m=GSD_M,
        width=side,
        height=n_rows,
    )
    random = np.random.default_rng(3)
    rgb = np.memmap(folder / "rgb", dtype=np.uint8, mode="w+", shape=(n_rows, side, 3))
    shown = np.memmap(folder / "shown", dtype=np.bool_, mode="w+", shape=(n_rows, side))
    ramp = np.linspace(0.0, 200.0, side)[None, :, None]
    for first in range(0, n_rows, 512):
        rows = slice(first, min(n_rows, first + 512))
        count = rows.stop - rows.start
        rgb[rows] = (ramp + random.integers(0, 40, (count, side, 3), dtype=np.uint8)).astype(
            np.uint8
        )
        shown[rows] = True
    shown[n_rows // 3 : n_rows // 2, side // 3 : side // 2] = False
    path = folder / "wall_0_ortho.tif"
    write_orthoimage(path, rgb, shown, place=GridPlace(gsd_m=GSD_M), tags={})
    write_json(path.with_suffix(".json"), frame_json(frame) | {"name": "wall 0"})
    for name in ("rgb", "shown"):
        (folder / name).unlink()
    return path


def export(path: Path, target: Path) -> None:
    """Write the tiles and the page, and print time and memory."""
    before, first = time.perf_counter(), time.process_time()
    (ortho,) = ortho_files([path])
    n_tiles = write_tiles(target, "wall_0_ortho", ortho)
    write_viewer(target, {"wall_0_ortho": ortho})
    size = sum(file.stat().st_size for file in target.rglob("*") if file.is_file())
    print(
        f"{ortho.frame.width * ortho.frame.height / 1e6:g} M cells: {n_tiles} tiles, "
        f"{size / 1e6:.0f} MB in {time.perf_counter() - before:.0f} s, processor "
        f"{time.process_time() - first:.0f} s, largest memory {largest_mib():.0f} MiB"
    )


def largest_mib() -> float:
    """Return the peak memory of this process; getrusage may return that of its parent."""
    lines = Path("/proc/self/status").read_text().splitlines()
    (found,) = [line for line in lines if line.startswith("VmHWM")]
    return int(found.split()[1]) / 1024


def main() -> None:
    """Write the image and the tiles."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--side", type=int, default=20_000, help="cells of a side")
    parser.add_argument("--rows", type=int, help="rows, where they are not as many")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = large_orthoimage(folder, given.side, given.rows or given.side)
        target = folder / "tiles"
        target.mkdir()
        worker = multiprocessing.get_context("spawn").Process(target=export, args=(path, target))
        worker.start()
        worker.join()


if __name__ == "__main__":
    main()
