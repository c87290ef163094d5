"""One compiled pass for all planes at once: each point to its nearest plane, sums per cell.

Slabs as in `plane_kernels`; blocks of points are tried only against the slabs that their box meets,
mostly one or two, so that sixteen planes cost little more than one.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.plane_kernels import STEPS_PER_TOLERANCE
from orthoflow.geometry.point_kernels import BLOCK_POINTS, BlockedPoints, compiled


@compiled
def _box_misses(
    boxes: NDArray[np.float32],
    block: int,
    slabs: NDArray[np.float64],
    k: int,
    reach_m: float,
) -> bool:
    """Whether no point of a block's box lies within reach of a slab's plane."""
    centre = -slabs[k, 3]
    half = reach_m
    for axis in range(3):
        low, high = np.float64(boxes[block, 2 * axis]), np.float64(boxes[block, 2 * axis + 1])
        centre += slabs[k, axis] * 0.5 * (low + high)
        half += abs(slabs[k, axis]) * 0.5 * (high - low)
    return bool(abs(centre) > half)


@compiled
def _is_inside(
    boxes: NDArray[np.float32],
    block: int,
    slabs: NDArray[np.float64],
    bounds: NDArray[np.float64],
    k: int,
) -> bool:
    """Whether a slab within its rectangle holds the entire box of a block."""
    for row in range(3):
        centre = -slabs[k, 4 * row + 3]
        half = 0.0
        for axis in range(3):
            low, high = np.float64(boxes[block, 2 * axis]), np.float64(boxes[block, 2 * axis + 1])
            centre += slabs[k, 4 * row + axis] * 0.5 * (low + high)
            half += abs(slabs[k, 4 * row + axis]) * 0.5 * (high - low)
        least = -bounds[k, 0] if row == 0 else bounds[k, 2 * row - 1]
        most = bounds[k, 0] if row == 0 else bounds[k, 2 * row]
        if not (centre - half >= least and centre + half <= most):
            return False
    return True


@compiled
def _measure(
    points: BlockedPoints,
    block: int,
    slabs: NDArray[np.float64],
    k: int,
    distances: NDArray[np.float64],
) -> None:
    """Distances of a block's points to a slab's plane."""
    x, y, z = points.x, points.y, points.z
    n0, n1, n2, n3 = slabs[k, 0], slabs[k, 1], slabs[k, 2], slabs[k, 3]
    start = block * BLOCK_POINTS
    for i in range(start, min(start + BLOCK_POINTS, x.size)):
        distances[i - start] = n0 * x[i] + n1 * y[i] + n2 * z[i] - n3


@compiled
def _take_nearer(  # noqa: PLR0913, PLR0917 - compiled code has no objects to bundle these in
    points: BlockedPoints,
    block: int,
    slabs: NDArray[np.float64],
    bounds: NDArray[np.float64],
    k: int,
    owner: NDArray[np.int8],
    distances: NDArray[np.float64],
    nearest: NDArray[np.float64],
) -> None:
    """Give those points of a block to a slab that it holds and no earlier one is nearer to."""
    x, y, z = points.x, points.y, points.z
    start = block * BLOCK_POINTS
    stop = min(start + BLOCK_POINTS, x.size)
    # Apart from the choice below, so that the processor takes several points at once.
    _measure(points, block, slabs, k, distances)
    find_m = bounds[k, 0]
    for i in range(start, stop):
        size = abs(distances[i - start])
        if size > find_m or size >= abs(nearest[i - start]):
            continue
        px, py, pz = np.float64(x[i]), np.float64(y[i]), np.float64(z[i])
        u = slabs[k, 4] * px + slabs[k, 5] * py + slabs[k, 6] * pz - slabs[k, 7]
        v = slabs[k, 8] * px + slabs[k, 9] * py + slabs[k, 10] * pz - slabs[k, 11]
        if bounds[k, 1] <= u <= bounds[k, 2] and bounds[k, 3] <= v <= bounds[k, 4]:
            owner[i - start] = k
            nearest[i - start] = distances[i - start]


@compiled
def assign_points(  # noqa: C901 - one loop over all points, where a call would cost
    points: BlockedPoints,
    claims: NDArray[np.int8],
    slabs: NDArray[np.float64],
    bounds: NDArray[np.float64],
    rasters: NDArray[np.float64],
    counts: NDArray[np.int32],
    sums: NDArray[np.int64],
) -> None:
    """Give each point to the nearest slab that holds it, or sum distances in that slab's cells.

    Numbers are picked one by one: a row of an array per point costs more than the sums.

    Args:
        points: (n,) offsets in blocks.
        claims: (n,) set to the slab of each point, -1 for none, if there are no cells.
        slabs: (k, 12) see `plane_kernels`.
        bounds: (k, 5) find tolerance, then smallest and largest u and v; metres.
        rasters: (k, 8) smallest u and v, cells per metre, rows, columns, first cell in the tables,
            fit tolerance, inner tolerance. Slabs without rows are not summed.
        counts: (cells, 3) points within the find, inner and fit tolerance; added to.
        sums: (cells, 2) distances and squared distances of those within the fit tolerance, in
            steps and squared steps; added to.
    """
    x, y, z, boxes = points.x, points.y, points.z, points.boxes
    active = np.empty(slabs.shape[0], dtype=np.int64)
    owner = np.empty(BLOCK_POINTS, dtype=np.int8)
    distances, nearest = np.empty(BLOCK_POINTS), np.empty(BLOCK_POINTS)
    is_summing = counts.shape[0] > 0
    for block in range(boxes.shape[0]):
        n_active, n_wanted = 0, 0
        for k in range(slabs.shape[0]):
            if not _box_misses(boxes, block, slabs, k, bounds[k, 0]):
                active[n_active] = k
                n_active += 1
                n_wanted += rasters[k, 3] > 0.0
        start = block * BLOCK_POINTS
        stop = min(start + BLOCK_POINTS, x.size)
        if is_summing and n_wanted == 0:
            continue
        if n_active == 1 and _is_inside(boxes, block, slabs, bounds, active[0]):
            # Most blocks of a scan are a short piece of one wall: no point has to be asked.
            if not is_summing:
                claims[start:stop] = active[0]
                continue
            owner[:] = active[0]
            _measure(points, block, slabs, active[0], nearest)
        else:
            owner[:] = -1
            nearest[:] = np.inf
            for place in range(n_active):
                k = active[place]
                _take_nearer(points, block, slabs, bounds, k, owner, distances, nearest)
        for i in range(start, stop):
            k, distance = owner[i - start], nearest[i - start]
            if not is_summing:
                claims[i] = k
                continue
            if k < 0 or rasters[k, 3] == 0.0:
                continue
            px, py, pz = np.float64(x[i]), np.float64(y[i]), np.float64(z[i])
            u = slabs[k, 4] * px + slabs[k, 5] * py + slabs[k, 6] * pz - slabs[k, 7]
            v = slabs[k, 8] * px + slabs[k, 9] * py + slabs[k, 10] * pz - slabs[k, 11]
            column = np.int64((u - rasters[k, 0]) * rasters[k, 2])
            row = np.int64((v - rasters[k, 1]) * rasters[k, 2])
            column = min(column, np.int64(rasters[k, 4]) - 1)
            row = min(row, np.int64(rasters[k, 3]) - 1)
            cell = np.int64(rasters[k, 5]) + row * np.int64(rasters[k, 4]) + column
            size = abs(distance)
            counts[cell, 0] += 1
            counts[cell, 1] += size <= rasters[k, 7]
            if size <= rasters[k, 6]:
                steps = np.int64(math.floor(distance * (STEPS_PER_TOLERANCE / rasters[k, 6]) + 0.5))
                counts[cell, 2] += 1
                sums[cell, 0] += steps
                sums[cell, 1] += steps * steps


@compiled
def name_labels(
    claims: NDArray[np.int8], names: NDArray[np.int16], labels: NDArray[np.int16]
) -> None:
    """Set (n,) labels to the name of each claim; the last of (k + 1,) names is for -1."""
    last = names.size - 1
    for i in range(claims.size):
        claim = claims[i]
        labels[i] = names[claim] if claim >= 0 else names[last]
