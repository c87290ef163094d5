"""Compiled passes of points against one slab: sums per cell of a plane, and the points on it.

A slab is handed over as a row of 12 float64: normal (3) and offset in the cloud's own offsets, then
the in-plane axes u (3) with its origin and v (3) with its origin. Passes skip blocks of points
whose box lies outside, and sum integers only (distances as multiples of a fixed step), so that
neither the number of threads nor the order of blocks shows in the result.

These passes ask about one plane, mostly in a sample, whose blocks reach through the scene; those
of `assignment_kernels` ask a whole cloud about all planes at once.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part
from orthoflow_plugins.plane.block_kernels import BLOCK_POINTS, BlockedPoints

# Distances are summed in steps of the fit tolerance over this: half a micrometre at 15 mm, and the
# squares of 48 million points still fit into 64 bits.
STEPS_PER_TOLERANCE: Final = 32768


@compiled
def sum_cells(
    points: BlockedPoints,
    slab: NDArray[np.float64],
    limits: NDArray[np.float64],
    counts: NDArray[np.int32],
    sums: NDArray[np.int64],
) -> None:
    """Sum distances of points per cell of a raster on one plane.

    In float64: the blocks of a sample are too wide for places from their middles in float32.

    Args:
        points: (n,) offsets in blocks.
        slab: (12,) see module.
        limits: cell side, find tolerance, inner tolerance, fit tolerance; metres.
        counts: (rows, columns, 3) points within the find, inner and fit tolerance; added to.
        sums: (rows, columns, 2) distances and squared distances of the points within the
            fit tolerance, in steps and squared steps; added to.
    """
    x, y, z, boxes = points.x, points.y, points.z, points.boxes
    n_rows, n_columns, _ = counts.shape
    per_m = 1.0 / limits[0]
    find_m, inner_m, fit_m = limits[1], limits[2], limits[3]
    to_steps = STEPS_PER_TOLERANCE / fit_m
    distances = np.empty(BLOCK_POINTS)
    u0, u1, u2, u3 = slab[4] * per_m, slab[5] * per_m, slab[6] * per_m, slab[7] * per_m
    v0, v1, v2, v3 = slab[8] * per_m, slab[9] * per_m, slab[10] * per_m, slab[11] * per_m
    for block in range(boxes.shape[0]):
        if _misses(boxes[block], slab, find_m):
            continue
        start = block * BLOCK_POINTS
        _measure(points, start, slab, distances)
        for i in range(start, min(start + BLOCK_POINTS, x.size)):
            distance = distances[i - start]
            size = abs(distance)
            if size > find_m:
                continue
            px, py, pz = np.float64(x[i]), np.float64(y[i]), np.float64(z[i])
            column = math.floor(u0 * px + u1 * py + u2 * pz - u3)
            row = math.floor(v0 * px + v1 * py + v2 * pz - v3)
            if not (0 <= column < n_columns and 0 <= row < n_rows):
                continue
            counts[row, column, 0] += 1
            if size <= inner_m:
                counts[row, column, 1] += 1
            if size <= fit_m:
                steps = np.int64(math.floor(distance * to_steps + 0.5))
                counts[row, column, 2] += 1
                sums[row, column, 0] += steps
                sums[row, column, 1] += steps * steps


@compiled
def claim_slab(
    points: BlockedPoints,
    claims: NDArray[np.int8],
    slabs: NDArray[np.float64],
    bounds: NDArray[np.float64],
) -> int:
    """Give the points of the last slab to it, unless an earlier slab that has them is nearer.

    As `assign_points` with all slabs would, but in float64, like `sum_cells`.

    Args:
        points: (n,) offsets in blocks.
        claims: (n,) slab of each point, negative for none; changed.
        slabs: (k, 12) all slabs so far, the new one last.
        bounds: (5,) of the new slab: find tolerance, then smallest and largest u and v, metres.

    Returns:
        How many points were unclaimed and no longer are.
    """
    index, n_taken = slabs.shape[0] - 1, 0
    slab, find_m = slabs[index], bounds[0]
    distances = np.empty(BLOCK_POINTS)
    for block in range(points.boxes.shape[0]):
        if _misses(points.boxes[block], slab, find_m):
            continue
        start = block * BLOCK_POINTS
        _measure(points, start, slab, distances)
        for i in range(start, min(start + BLOCK_POINTS, claims.size)):
            size = abs(distances[i - start])
            if size > find_m:
                continue
            x, y, z = np.float64(points.x[i]), np.float64(points.y[i]), np.float64(points.z[i])
            u = slab[4] * x + slab[5] * y + slab[6] * z - slab[7]
            v = slab[8] * x + slab[9] * y + slab[10] * z - slab[11]
            if not (bounds[1] <= u <= bounds[2] and bounds[3] <= v <= bounds[4]):
                continue
            owner = claims[i]
            if owner < 0:
                claims[i] = index
                n_taken += 1
                continue
            a, b, c = slabs[owner, 0], slabs[owner, 1], slabs[owner, 2]
            if size < abs(a * x + b * y + c * z - slabs[owner, 3]):
                claims[i] = index
    return n_taken


@kernel_part
def _misses(box: NDArray[np.float32], slab: NDArray[np.float64], reach_m: float) -> bool:
    """Whether no point of a block's box lies within the reach of the slab's plane."""
    centre = -slab[3]
    half = reach_m
    for axis in range(3):
        centre += slab[axis] * 0.5 * (box[2 * axis] + box[2 * axis + 1])
        half += abs(slab[axis]) * 0.5 * (box[2 * axis + 1] - box[2 * axis])
    return bool(abs(centre) > half)


@kernel_part
def _measure(
    points: BlockedPoints, start: int, slab: NDArray[np.float64], distances: NDArray[np.float64]
) -> None:
    """Distances of a block's points to the slab's plane.

    Apart from what is done with them, so that the processor takes several points at once.
    """
    x, y, z = points.x, points.y, points.z
    n0, n1, n2, n3 = slab[0], slab[1], slab[2], slab[3]
    for i in range(start, min(start + BLOCK_POINTS, x.size)):
        distances[i - start] = n0 * x[i] + n1 * y[i] + n2 * z[i] - n3
