"""One compiled pass for all planes at once: each point to its nearest plane, sums per cell.

Slabs as in `plane_kernels`; blocks of points are tried only against the slabs that their box meets,
mostly one or two, so that sixteen planes cost little more than one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.plane_kernels import STEPS_PER_TOLERANCE
from orthoflow.geometry.point_kernels import BLOCK_POINTS, BlockedPoints, compiled


@compiled
def _meeting(
    boxes: NDArray[np.float32],
    block: int,
    slabs: NDArray[np.float64],
    bounds: NDArray[np.float64],
    k: int,
) -> int:
    """How a slab within its rectangle meets the box of a block: 0 misses it, 2 holds it, else 1."""
    holds = 2
    for row in range(3):
        centre = -slabs[k, 4 * row + 3]
        half = 0.0
        for axis in range(3):
            low, high = np.float64(boxes[block, 2 * axis]), np.float64(boxes[block, 2 * axis + 1])
            centre += slabs[k, 4 * row + axis] * 0.5 * (low + high)
            half += abs(slabs[k, 4 * row + axis]) * 0.5 * (high - low)
        least = -bounds[k, 0] if row == 0 else bounds[k, 2 * row - 1]
        most = bounds[k, 0] if row == 0 else bounds[k, 2 * row]
        if centre + half < least or centre - half > most:
            return 0
        if centre - half < least or centre + half > most:
            holds = 1
    return holds


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
def _place(
    points: BlockedPoints,
    block: int,
    slabs: NDArray[np.float64],
    rasters: NDArray[np.float64],
    k: int,
    cells: NDArray[np.int32],
) -> None:
    """Set the cell of each point of a block in a slab's raster, clipped to its edges."""
    x, y, z = points.x, points.y, points.z
    per_m = rasters[k, 2]
    u0, u1, u2 = slabs[k, 4] * per_m, slabs[k, 5] * per_m, slabs[k, 6] * per_m
    v0, v1, v2 = slabs[k, 8] * per_m, slabs[k, 9] * per_m, slabs[k, 10] * per_m
    u3, v3 = (slabs[k, 7] + rasters[k, 0]) * per_m, (slabs[k, 11] + rasters[k, 1]) * per_m
    last_row, last_column = rasters[k, 3] - 1.0, rasters[k, 4] - 1.0
    width, first = np.int32(rasters[k, 4]), np.int32(rasters[k, 5])
    start = block * BLOCK_POINTS
    for i in range(start, min(start + BLOCK_POINTS, x.size)):
        u = u0 * x[i] + u1 * y[i] + u2 * z[i] - u3
        v = v0 * x[i] + v1 * y[i] + v2 * z[i] - v3
        u = max(0.0, u)
        v = max(0.0, v)
        column = np.int32(min(last_column, u))
        row = np.int32(min(last_row, v))
        cells[i - start] = first + row * width + column


@compiled
def _add(  # noqa: PLR0913, PLR0917 - compiled code has no objects to bundle these in
    count: int,
    rasters: NDArray[np.float64],
    k: int,
    owner: NDArray[np.int8],
    nearest: NDArray[np.float64],
    cells: NDArray[np.int32],
    counts: NDArray[np.int32],
    sums: NDArray[np.int64],
) -> None:
    """Add the points of a block that a slab owns to its cells."""
    fit_m, inner_m = rasters[k, 6], rasters[k, 7]
    to_steps = STEPS_PER_TOLERANCE / fit_m
    for i in range(count):
        if owner[i] != k:
            continue
        cell = cells[i]
        size = abs(nearest[i])
        counts[cell, 0] += 1
        counts[cell, 1] += size <= inner_m
        if size <= fit_m:
            # Rounded to the nearest whole number: truncation of a positive one.
            steps = np.int64(nearest[i] * to_steps + (STEPS_PER_TOLERANCE + 0.5))
            steps -= STEPS_PER_TOLERANCE
            counts[cell, 2] += 1
            sums[cell, 0] += steps
            sums[cell, 1] += steps * steps


@compiled
def assign_points(  # noqa: C901 - one loop over all blocks, whose tables are made once
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
    boxes = points.boxes
    active = np.empty(slabs.shape[0], dtype=np.int64)
    owner = np.empty(BLOCK_POINTS, dtype=np.int8)
    distances, nearest = np.empty(BLOCK_POINTS), np.empty(BLOCK_POINTS)
    cells = np.empty(BLOCK_POINTS, dtype=np.int32)
    is_summing = counts.shape[0] > 0
    for block in range(boxes.shape[0]):
        n_active, n_wanted, meeting = 0, 0, 0
        for k in range(slabs.shape[0]):
            here = _meeting(boxes, block, slabs, bounds, k)
            if here > 0:
                active[n_active] = k
                n_active += 1
                n_wanted += rasters[k, 3] > 0.0
                meeting = here
        start = block * BLOCK_POINTS
        stop = min(start + BLOCK_POINTS, claims.size)
        if is_summing and n_wanted == 0:
            continue
        if n_active == 1 and meeting == 2:
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
        if not is_summing:
            claims[start:stop] = owner[: stop - start]
            continue
        for place in range(n_active):
            k = active[place]
            if rasters[k, 3] > 0.0:
                _place(points, block, slabs, rasters, k, cells)
                _add(stop - start, rasters, k, owner, nearest, cells, counts, sums)


@compiled
def name_labels(
    claims: NDArray[np.uint8], names: NDArray[np.int16], labels: NDArray[np.int16]
) -> None:
    """Set (n,) labels to the name of each claim.

    Args:
        claims: (n,) claims as bytes.
        names: (256,) name of each byte.
        labels: (n,) set.
    """
    for i in range(claims.size):
        labels[i] = names[claims[i]]
