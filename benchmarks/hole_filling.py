"""Find and fill narrow gaps of a raster, and compare the time with OpenCV's distance transform.

    python benchmarks/hole_filling.py [--repeat 7] [--threads 2]

`cv2.distanceTransformWithLabels` returns the nearest known cell for every void cell, including
those of windows; it does not distinguish gaps from windows. Our code does, and interpolates in
gaps. The raster has the size of a 9 x 5 m wall with 3 mm cells; 8 % of its cells are scattered void
cells, and windows cover a sixth of it. Times are medians of interleaved runs.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.interpolation import Surroundings, cell_values, interpolate
from orthoflow.geometry.narrow_gaps import narrow_gaps

SHAPE = (1733, 3066)
RADII_CELLS = (1, 2, 3, 5, 10)


def raster() -> NDArray[np.bool_]:
    """Return a mask of the known cells."""
    is_known = np.random.default_rng(2).random(SHAPE, dtype=np.float32) > 0.08
    for row in range(200, SHAPE[0] - 300, 700):
        for column in range(150, SHAPE[1] - 250, 500):
            is_known[row : row + 400, column : column + 190] = False
    return is_known


def filled(is_known: NDArray[np.bool_], radius: int, *, threads: int) -> NDArray[np.float32]:
    """Return depths with interpolated gaps."""
    depth_m = np.where(is_known, np.float32(1.0), np.float32(np.nan)).ravel()
    places = np.repeat(depth_m[:, None] - np.float32(1.0), 2, axis=1)
    values = cell_values(depth_m)
    gaps = narrow_gaps(is_known, radius)
    around = Surroundings(places, SHAPE[1], 0.02)
    interpolate(gaps, around, values, values, reach_cells=radius, threads=threads)
    return depth_m


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeat", type=int, default=7)
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    cv2.setNumThreads(options.threads)
    is_known = raster()
    is_void = (~is_known).astype(np.uint8)
    tasks: dict[str, Callable[[], object]] = {
        "cv2.distanceTransformWithLabels": lambda: cv2.distanceTransformWithLabels(
            is_void, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
        )
    }
    for radius in RADII_CELLS:
        tasks[f"gaps within {radius} cells found"] = lambda radius=radius: narrow_gaps(
            is_known, radius
        )
        tasks[f"gaps within {radius} cells filled"] = lambda radius=radius: filled(
            is_known, radius, threads=options.threads
        )
    times: dict[str, list[float]] = {name: [] for name in tasks}
    for round_number in range(options.repeat + 1):
        for name, task in tasks.items():
            started = time.perf_counter()
            task()
            # The first round includes compilation.
            if round_number:
                times[name].append(time.perf_counter() - started)
    medians = {name: statistics.median(values) for name, values in times.items()}
    peer = medians["cv2.distanceTransformWithLabels"]
    print(f"{SHAPE[1]} x {SHAPE[0]} cells, {is_void.mean():.0%} void, {options.threads} threads")
    for name, median in medians.items():
        print(f"{name:34s} {1e3 * median:7.1f} ms  {median / peer:5.2f} x")


if __name__ == "__main__":
    main()
