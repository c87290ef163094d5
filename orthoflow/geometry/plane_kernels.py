"""Compiled passes that look for planes: votes, moments, cells on a plane, claims, deviations.

A slab is handed over as a row of 12 float64: normal (3) and offset in the cloud's own offsets, then
the in-plane axes u (3) with its origin and v (3) with its origin. Passes over the cloud skip blocks
whose box lies outside the slab, and sum integers only (distances as multiples of a fixed step), so
that neither the number of threads nor the order of blocks shows in the result.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part
from orthoflow.geometry.point_kernels import BLOCK_POINTS, BlockedPoints

# Distances are summed in steps of the fit tolerance over this: half a micrometre at 15 mm, and the
# squares of 48 million points still fit into 64 bits.
STEPS_PER_TOLERANCE: Final = 32768
# Bins that the deviations of a plane's points are counted in.
HISTOGRAM_BINS: Final = 200


@compiled
def vote_lines(
    cells: NDArray[np.float32],
    weights: NDArray[np.int64],
    angles_rad: NDArray[np.float64],
    low_m: float,
    bin_m: float,
    votes: NDArray[np.int64],
) -> None:
    """Let each plan cell vote for all lines through it.

    Args:
        cells: (m, 2) centres in the plan, metres.
        weights: (m,) votes a cell has.
        angles_rad: (a,) directions of the lines' normals.
        low_m: distance of the first bin's lower edge; bins that miss the table are dropped.
        bin_m: width of a bin.
        votes: (a, bins) table, added to. Equation 4 of markiewicz2015: r = x cos + y sin.
    """
    n_bins = votes.shape[1]
    for angle in range(angles_rad.size):
        cosine = math.cos(angles_rad[angle]) / bin_m
        sine = math.sin(angles_rad[angle]) / bin_m
        start = low_m / bin_m
        for i in range(cells.shape[0]):
            position = cells[i, 0] * cosine + cells[i, 1] * sine - start
            if 0.0 <= position < n_bins:
                votes[angle, int(position)] += weights[i]


@compiled
def vote_points(
    points: BlockedPoints,
    claims: NDArray[np.int8],
    plan: NDArray[np.float64],
    angles_rad: NDArray[np.float64],
    low_m: float,
    bin_m: float,
    votes: NDArray[np.int64],
) -> None:
    """Let each unclaimed point vote with its own coordinates; otherwise as `vote_lines`.

    Args:
        points: (n,) offsets in blocks.
        claims: (n,) plane of each point, negative for none.
        plan: (2, 4) e1 and e2, each with the position of the plan's centre along it.
        angles_rad: (a,) directions of the lines' normals.
        low_m: distance of the first bin's lower edge.
        bin_m: width of a bin.
        votes: (a, bins) table, added to.
    """
    x, y, z = points.x, points.y, points.z
    n_bins = votes.shape[1]
    for angle in range(angles_rad.size):
        cosine = math.cos(angles_rad[angle]) / bin_m
        sine = math.sin(angles_rad[angle]) / bin_m
        a = cosine * plan[0, 0] + sine * plan[1, 0]
        b = cosine * plan[0, 1] + sine * plan[1, 1]
        c = cosine * plan[0, 2] + sine * plan[1, 2]
        start = low_m / bin_m + cosine * plan[0, 3] + sine * plan[1, 3]
        for i in range(x.size):
            if claims[i] >= 0:
                continue
            position = a * x[i] + b * y[i] + c * z[i] - start
            if 0.0 <= position < n_bins:
                votes[angle, int(position)] += 1


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
def _misses_rectangle(
    box: NDArray[np.float32], slab: NDArray[np.float64], bounds: NDArray[np.float64]
) -> bool:
    """Whether no point of a block's box projects into a rectangle on the slab's plane."""
    for row in range(1, 3):
        centre, half = -slab[4 * row + 3], 0.0
        for axis in range(3):
            centre += slab[4 * row + axis] * 0.5 * (box[2 * axis] + box[2 * axis + 1])
            half += abs(slab[4 * row + axis]) * 0.5 * (box[2 * axis + 1] - box[2 * axis])
        if centre + half < bounds[2 * row - 1] or centre - half > bounds[2 * row]:
            return True
    return False


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


@kernel_part
def _distance(slab: NDArray[np.float64], x: float, y: float, z: float) -> float:
    return float(abs(slab[0] * x + slab[1] * y + slab[2] * z - slab[3]))


@kernel_part
def _within(
    slab: NDArray[np.float64], bounds: NDArray[np.float64], x: float, y: float, z: float
) -> bool:
    """Whether a point projects into a rectangle on the slab's plane."""
    u = slab[4] * x + slab[5] * y + slab[6] * z - slab[7]
    v = slab[8] * x + slab[9] * y + slab[10] * z - slab[11]
    return bool(bounds[1] <= u <= bounds[2] and bounds[3] <= v <= bounds[4])


@compiled
def sum_cells(
    points: BlockedPoints,
    claims: NDArray[np.int8],
    slab: NDArray[np.float64],
    limits: NDArray[np.float64],
    counts: NDArray[np.int32],
    sums: NDArray[np.int64],
) -> None:
    """Sum distances of unclaimed points per cell of a raster on a plane.

    Args:
        points: (n,) offsets in blocks.
        claims: (n,) plane of each point, negative for none.
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
            if size > find_m or claims[i] >= 0:
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

    Args:
        points: (n,) offsets in blocks.
        claims: (n,) plane of each point, negative for none; changed.
        slabs: (k, 12) all slabs so far, the new one last.
        bounds: (5,) of the new slab: find tolerance, then smallest and largest u and v, metres.

    Returns:
        How many points were unclaimed and no longer are.
    """
    x, y, z, boxes = points.x, points.y, points.z, points.boxes
    index = slabs.shape[0] - 1
    slab = slabs[index]
    find_m = bounds[0]
    n_taken = 0
    distances = np.empty(BLOCK_POINTS)
    for block in range(boxes.shape[0]):
        if _misses(boxes[block], slab, find_m) or _misses_rectangle(boxes[block], slab, bounds):
            continue
        start = block * BLOCK_POINTS
        _measure(points, start, slab, distances)
        for i in range(start, min(start + BLOCK_POINTS, x.size)):
            size = abs(distances[i - start])
            if size > find_m:
                continue
            px, py, pz = np.float64(x[i]), np.float64(y[i]), np.float64(z[i])
            if not _within(slab, bounds, px, py, pz):
                continue
            owner = claims[i]
            if owner < 0:
                claims[i] = index
                n_taken += 1
            elif size < _distance(slabs[owner], px, py, pz):
                claims[i] = index
    return n_taken
