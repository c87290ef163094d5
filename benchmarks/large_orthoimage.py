"""Measure the time and memory of making a large orthoimage file from one photo.

    python benchmarks/large_orthoimage.py [--side 20000] [--megapixels 24] [--threads 2]

Only the depths of the wall, simulated as in `ortho_backward.py`, and the layer are in memory-mapped
files, as they are between steps. The memory is the maximum of RssAnon (memory not backed by files),
sampled every 20 ms.
"""

from __future__ import annotations

import argparse
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import DTypeLike, NDArray
from ortho_backward import GSD_M, UP, camera
from orthoflow_plugins.ortho.dsm_backward import DsmBackward
from orthoflow_plugins.ortho.painting import paint
from orthoflow_plugins.ortho.surfaces import surface_of, view_of

from orthoflow.files.geotiff import GridPlace, read_raster, write_orthoimage
from orthoflow.files.images import cells_png
from orthoflow.geometry import WallFrame
from orthoflow.geometry.occluders import nothing_in_the_way
from orthoflow.products import LayerMask, Wall, Walls

BAND_ROWS = 256


def mapped(path: Path, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[np.generic]:
    """Return a zeroed array in a file."""
    return np.memmap(path, dtype=np.dtype(dtype), mode="w+", shape=shape)


def wall(side: int, folder: Path) -> Wall:
    """Return a square wall with 5 cm frames, 2 mm noise, and one void cell in a thousand."""
    rng = np.random.default_rng(1)
    depth = mapped(folder / "depth", (side, side), np.float32)
    steps = (0.05 * ((np.arange(side) // 90) % 4 == 0)).astype(np.float32)
    for first in range(0, side, BAND_ROWS):
        shape = depth[first : first + BAND_ROWS].shape
        heights = rng.standard_normal(shape, dtype=np.float32) * np.float32(0.002) + steps
        heights[rng.random(shape, dtype=np.float32) < 0.001] = np.nan
        depth[first : first + BAND_ROWS] = heights
    frame = WallFrame(
        origin_world=np.zeros(3),
        u_world=np.array([1.0, 0, 0]),
        v_world=np.array([0, 0, -1.0]),
        normal_world=np.array([0, -1.0, 0]),
        gsd_m=GSD_M,
        width=side,
        height=side,
    )
    return Wall(
        frame=frame,
        plane_index=0,
        name="wall 0",
        depth_m=depth,
        sigma_m=mapped(folder / "sigma", (side, side), np.float32),
        count=mapped(folder / "count", (side, side), np.uint32),
        mask=mapped(folder / "mask", (side, side), np.uint8),
    )


def anonymous_mib() -> float:
    """Return the memory that is not backed by files."""
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith("RssAnon"):
            return int(line.split()[1]) / 1024
    return float("nan")


@contextmanager
def measured(what: str) -> Iterator[None]:
    """Print the duration of a call, and its peak memory above the initial level."""
    before, most, is_over = anonymous_mib(), [0.0], threading.Event()

    def watch() -> None:
        while not is_over.wait(0.02):
            most[0] = max(most[0], anonymous_mib())

    watcher = threading.Thread(target=watch)
    watcher.start()
    started = time.perf_counter()
    yield
    seconds = time.perf_counter() - started
    is_over.set()
    watcher.join()
    print(f"{what:28s} {seconds:6.1f} s, {max(0.0, most[0] - before):6.0f} MiB", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--side", type=int, default=20_000)
    parser.add_argument("--megapixels", type=float, default=24.0)
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    cv2.setNumThreads(options.threads)
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as name:
        folder = Path(name)
        raster = wall(options.side, folder)
        viewer = camera(raster.frame, options.megapixels, 25.0)
        shape = (viewer.height, viewer.width, 3)
        photo = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
        print(f"{options.side} x {options.side} cells, photo of {options.megapixels:g} megapixels")
        with measured("relief"):
            walls = Walls(
                walls=(raster,),
                up=UP,
                intensity_source="none",
                buffer_front_m=0.15,
                buffer_behind_m=0.15,
            )
            params = DsmBackward.Params()
            surface = surface_of(walls, 0)
        with measured("painting"):
            painting = paint(
                photo,
                view_of(viewer, surface, params),
                surface,
                nothing_in_the_way(viewer),
                params,
                allocate=lambda name, shape, dtype: mapped(folder / name, shape, dtype),
                threads=options.threads,
            )
        if painting.rgb is None:
            raise SystemExit("nothing was painted")
        shown = painting.mask == LayerMask.PAINTED
        path = folder / "ortho.tif"
        with measured("cloud-optimised GeoTIFF"):
            write_orthoimage(path, painting.rgb, shown, place=GridPlace(gsd_m=GSD_M), tags={})
        with measured("preview"):
            cells_png(shown.shape, lambda part: (painting.rgb[part], shown[part]))
        print(f"file of {path.stat().st_size / 2**20:.0f} MiB, {shown.mean():.1%} painted")
        if options.side <= 4000:
            print("reads back:", np.array_equal(read_raster(path).values, painting.rgb))


if __name__ == "__main__":
    main()
