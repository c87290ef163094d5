"""Compiled passes of points against slabs: sums per cell, the plane of each point, deviations.

A slab is handed over as a row of 12 float64: normal (3) and offset in the cloud's own offsets, then
the in-plane axes u (3) with its origin and v (3) with its origin. Passes skip blocks of points
whose box lies outside, and sum integers only (distances as multiples of a fixed step), so that
neither the number of threads nor the order of blocks shows in the result.

The first passes ask about one plane, mostly in a sample, whose blocks reach through the scene. The
others ask a whole cloud about all planes at once: blocks are tried only against the slabs that
their box meets, mostly one or two, so that sixteen planes cost little more than one. Within a block
places are counted from the middle of its box: float32 then is exact to nanometres wherever the
block lies, and the processor takes twice as many points at once as with float64.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part
from orthoflow_plugins.plane.kernels import BLOCK_POINTS, BlockedPoints

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
    """Return the points of the last slab to it, unless an earlier slab that has them is nearer.

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


# Axes of a slab. Of a type, since each plain number would have a version compiled for itself.
_ALONG_NORMAL: Final = np.int64(0)
_ALONG_U: Final = np.int64(1)
_ALONG_V: Final = np.int64(2)
# Blocks whose boxes are tried against the slabs at once.
_CHUNK_BLOCKS: Final = 64
# What a point adds to its cell, packed into one number so that a run of points is one sum: its
# distance in steps from the lower limit of the fit tolerance, if it is within, itself, and whether
# it lies within the inner and the fit tolerance. A block has fewer points than a bit field holds.
_FIND_BIT: Final = 32
_INNER_BIT: Final = 42
_FIT_BIT: Final = 52
_FIELD: Final = 1023


@compiled
def assign_points(
    points: BlockedPoints,
    claims: NDArray[np.int8],
    slabs: NDArray[np.float64],
    bounds: NDArray[np.float64],
) -> None:
    """Assign each point to the nearest slab that holds it.

    Args:
        points: (n,) offsets in blocks.
        claims: (n,) set to the slab of each point, -1 for none.
        slabs: (k, 12) see module.
        bounds: (k, 5) find tolerance, then smallest and largest u and v; metres.
    """
    boxes = points.boxes
    scratch = _new_scratch()
    listed = np.empty(slabs.shape[0], dtype=np.int64)
    spread = np.zeros((6, _CHUNK_BLOCKS), dtype=np.float32)
    meeting = np.empty((slabs.shape[0], _CHUNK_BLOCKS), dtype=np.int32)
    for block in range(boxes.shape[0]):
        place = block % _CHUNK_BLOCKS
        if place == 0:
            _meet_chunk(boxes, block, slabs, bounds, spread, meeting)
        n_active, holder = _list_active(meeting, place, listed)
        start = block * BLOCK_POINTS
        stop = min(start + BLOCK_POINTS, claims.size)
        if n_active == 0 or holder >= 0:
            # Most blocks of a scan are a short piece of one wall: no point has to be asked.
            claims[start:stop] = np.int8(holder)
            continue
        _centre_block(points, block, scratch.middle, scratch.local)
        _own_block(scratch, slabs, bounds, listed[:n_active], holder)
        taken = claims[start:stop]
        for i in range(taken.size):
            taken[i] = np.int8(scratch.owner[i])


@compiled
def sum_assigned(
    points: BlockedPoints,
    slabs: NDArray[np.float64],
    bounds: NDArray[np.float64],
    rasters: NDArray[np.float64],
    counts: NDArray[np.int32],
    sums: NDArray[np.int64],
    drawn: tuple[int, int],
) -> None:
    """Sum the distances of each point in the cells of the nearest slab that holds it.

    Args:
        points: (n,) offsets in blocks.
        slabs: (k, 12) see module.
        bounds: (k, 5) find tolerance, then smallest and largest u and v; metres.
        rasters: (k, 8) smallest u and v, cells per metre, rows, columns, first cell in the tables,
            fit tolerance, inner tolerance; the last two are the same for all. Slabs without rows
            are not summed.
        counts: (cells, 3) points within the find, inner and fit tolerance; added to.
        sums: (cells, 2) distances and squared distances of those within the fit tolerance, in
            steps and squared steps; added to.
        drawn: one of so many blocks is summed; number of the first block in the cloud.
    """
    boxes = points.boxes
    scratch = _new_scratch()
    listed = np.empty(slabs.shape[0], dtype=np.int64)
    spread = np.zeros((6, _CHUNK_BLOCKS), dtype=np.float32)
    meeting = np.empty((slabs.shape[0], _CHUNK_BLOCKS), dtype=np.int32)
    for block in range(boxes.shape[0]):
        place = block % _CHUNK_BLOCKS
        if place == 0:
            _meet_chunk(boxes, block, slabs, bounds, spread, meeting)
        n_active, holder = _list_active(meeting, place, listed)
        active = listed[:n_active]
        if not _any_summed(rasters, active) or not _is_drawn(drawn[1] + block, drawn[0]):
            continue
        count = min(BLOCK_POINTS, points.x.size - block * BLOCK_POINTS)
        _centre_block(points, block, scratch.middle, scratch.local)
        _own_block(scratch, slabs, bounds, active, holder)
        _sum_block(scratch, count, slabs, rasters, active, counts, sums)


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
    for start in range(0, claims.size, BLOCK_POINTS):
        stop = min(start + BLOCK_POINTS, claims.size)
        held, named = claims[start:stop], labels[start:stop]
        first, differing = held[0], np.uint8(0)
        for i in range(held.size):
            differing |= held[i] ^ first
        if differing == 0:
            # Most blocks of a scan are a short piece of one wall.
            named[:] = names[first]
            continue
        for i in range(held.size):
            named[i] = names[held[i]]


@kernel_part
def _centre_block(
    points: BlockedPoints, block: int, middle: NDArray[np.float64], local: NDArray[np.float32]
) -> None:
    """Set (3, BLOCK_POINTS) local to a block's points, counted from the middle of its box."""
    x, y, z, boxes = points.x, points.y, points.z, points.boxes
    start = block * BLOCK_POINTS
    mx = np.float32(0.5) * (boxes[block, 0] + boxes[block, 1])
    my = np.float32(0.5) * (boxes[block, 2] + boxes[block, 3])
    mz = np.float32(0.5) * (boxes[block, 4] + boxes[block, 5])
    middle[0], middle[1], middle[2] = mx, my, mz
    stop = min(start + BLOCK_POINTS, x.size)
    # As pieces, since an index that is a sum keeps the processor from taking several at once.
    xs, ys, zs = x[start:stop], y[start:stop], z[start:stop]
    for i in range(xs.size):
        local[0, i] = xs[i] - mx
        local[1, i] = ys[i] - my
        local[2, i] = zs[i] - mz


@kernel_part
def _place_along(  # noqa: PLR0913, PLR0917 - compiled code has no objects to bundle these in
    local: NDArray[np.float32],
    middle: NDArray[np.float64],
    slabs: NDArray[np.float64],
    k: int,
    row: np.int64,
    scale: float,
    low: float,
    values: NDArray[np.float32],
) -> None:
    """Set values to `scale` times the places of a block's points along an axis of a slab."""
    a, b, c = slabs[k, 4 * row], slabs[k, 4 * row + 1], slabs[k, 4 * row + 2]
    there = a * middle[0] + b * middle[1] + c * middle[2] - slabs[k, 4 * row + 3] - low
    p, q, r = np.float32(a * scale), np.float32(b * scale), np.float32(c * scale)
    s = np.float32(there * scale)
    for i in range(BLOCK_POINTS):
        values[i] = p * local[0, i] + q * local[1, i] + r * local[2, i] + s


@kernel_part
def _meet_chunk(
    boxes: NDArray[np.float32],
    block: int,
    slabs: NDArray[np.float64],
    bounds: NDArray[np.float64],
    spread: NDArray[np.float32],
    meeting: NDArray[np.int32],
) -> None:
    """Try the boxes of up to _CHUNK_BLOCKS blocks from one on against all slabs.

    Args:
        boxes: (blocks, 6) smallest and largest x, y, z.
        block: the first block.
        slabs: (k, 12) see module.
        bounds: (k, 5) find tolerance, then smallest and largest u and v; metres.
        spread: (6, _CHUNK_BLOCKS) scratch: middles and half sides of the boxes.
        meeting: (k, _CHUNK_BLOCKS) set: 0 where a slab misses a block, 2 where it holds it, else 1.
    """
    one_half, one = np.float32(0.5), np.int32(1)
    for b in range(min(_CHUNK_BLOCKS, boxes.shape[0] - block)):
        for axis in range(3):
            low, high = boxes[block + b, 2 * axis], boxes[block + b, 2 * axis + 1]
            spread[axis, b] = one_half * (low + high)
            spread[3 + axis, b] = one_half * (high - low)
    for k in range(slabs.shape[0]):
        for b in range(_CHUNK_BLOCKS):
            meeting[k, b] = 2
        for row in range(3):
            p, q, r = slabs[k, 4 * row], slabs[k, 4 * row + 1], slabs[k, 4 * row + 2]
            a, b_, c = np.float32(p), np.float32(q), np.float32(r)
            u, v, w = np.float32(abs(p)), np.float32(abs(q)), np.float32(abs(r))
            shift = np.float32(slabs[k, 4 * row + 3])
            least = np.float32(-bounds[k, 0] if row == 0 else bounds[k, 2 * row - 1])
            most = np.float32(bounds[k, 0] if row == 0 else bounds[k, 2 * row])
            for b in range(_CHUNK_BLOCKS):
                centre = a * spread[0, b] + b_ * spread[1, b] + c * spread[2, b] - shift
                half = u * spread[3, b] + v * spread[4, b] + w * spread[5, b]
                misses = (centre + half < least) | (centre - half > most)
                cuts = (centre - half < least) | (centre + half > most)
                here = np.int32(0) if misses else (one if cuts else np.int32(2))
                meeting[k, b] = min(meeting[k, b], here)


@kernel_part
def _list_active(
    meeting: NDArray[np.int32], place: int, active: NDArray[np.int64]
) -> tuple[int, int]:
    """List the slabs that a block meets; gives how many, and the holder.

    The holder is the slab that holds the entire block and is all it meets, -1 for none.
    """
    n_active, holds = 0, False
    for k in range(meeting.shape[0]):
        if meeting[k, place] > 0:
            active[n_active] = k
            n_active += 1
            holds = meeting[k, place] == 2
    return n_active, int(active[0]) if n_active == 1 and holds else -1


@kernel_part
def _any_summed(rasters: NDArray[np.float64], active: NDArray[np.int64]) -> bool:
    """Whether any of the slabs that a block meets has cells."""
    n_summed = 0
    for k in active:
        n_summed += int(rasters[k, 3] > 0.0)
    return n_summed > 0


class _Scratch(NamedTuple):
    """What is known of the points of one block; each (BLOCK_POINTS,) unless said otherwise.

    Attributes:
        local: (3, BLOCK_POINTS) places from the middle of the block's box, metres.
        middle: (3,) that middle.
        u: along a slab's first axis in the plane; v along the second one.
        distances: from the slab that is asked about.
        nearest: distance from the owner.
        owner: slab of each point, -1 for none.
        cells: cell of each point, -1 for none.
        packed: what the point counts for.
        squares: squared distance from the owner in steps, if it is within the fit tolerance.
    """

    local: NDArray[np.float32]
    middle: NDArray[np.float64]
    u: NDArray[np.float32]
    v: NDArray[np.float32]
    distances: NDArray[np.float32]
    nearest: NDArray[np.float32]
    owner: NDArray[np.int32]
    cells: NDArray[np.int32]
    packed: NDArray[np.int64]
    squares: NDArray[np.int64]


@kernel_part
def _new_scratch() -> _Scratch:
    return _Scratch(
        np.zeros((3, BLOCK_POINTS), dtype=np.float32),
        np.empty(3),
        np.empty(BLOCK_POINTS, dtype=np.float32),
        np.empty(BLOCK_POINTS, dtype=np.float32),
        np.empty(BLOCK_POINTS, dtype=np.float32),
        np.empty(BLOCK_POINTS, dtype=np.float32),
        np.empty(BLOCK_POINTS, dtype=np.int32),
        np.empty(BLOCK_POINTS, dtype=np.int32),
        np.empty(BLOCK_POINTS, dtype=np.int64),
        np.empty(BLOCK_POINTS, dtype=np.int64),
    )


@kernel_part
def _own_block(
    scratch: _Scratch,
    slabs: NDArray[np.float64],
    bounds: NDArray[np.float64],
    active: NDArray[np.int64],
    holder: int,
) -> None:
    """Find the owner of each point of a block, and its distance from it.

    Args:
        scratch: the points; owner and nearest are set.
        slabs: see `assign_points`.
        bounds: see `assign_points`.
        active: the slabs that the block meets.
        holder: the slab that holds the entire block and is all it meets, -1 for none.
    """
    local, middle, owner, nearest = scratch.local, scratch.middle, scratch.owner, scratch.nearest
    if holder >= 0:
        owner[:] = holder
        _place_along(local, middle, slabs, holder, _ALONG_NORMAL, 1.0, 0.0, nearest)
        return
    owner[:] = -1
    nearest[:] = np.inf
    for k in active:
        _place_along(local, middle, slabs, k, _ALONG_NORMAL, 1.0, 0.0, scratch.distances)
        if not _any_near(scratch.distances, bounds[k, 0]):
            continue
        _place_along(local, middle, slabs, k, _ALONG_U, 1.0, 0.0, scratch.u)
        _place_along(local, middle, slabs, k, _ALONG_V, 1.0, 0.0, scratch.v)
        _take_nearer(scratch.u, scratch.v, scratch.distances, bounds, k, owner, nearest)


@kernel_part
def _any_near(distances: NDArray[np.float32], find_m: float) -> bool:
    """Whether any point of a block lies within the tolerance."""
    limit, count = np.float32(find_m), np.int32(0)
    for i in range(BLOCK_POINTS):
        count += np.int32(1) if abs(distances[i]) <= limit else np.int32(0)
    return bool(count > 0)


@kernel_part
def _take_nearer(
    u: NDArray[np.float32],
    v: NDArray[np.float32],
    distances: NDArray[np.float32],
    bounds: NDArray[np.float64],
    k: int,
    owner: NDArray[np.int32],
    nearest: NDArray[np.float32],
) -> None:
    """Return those points of a block to a slab that it holds and no earlier one is nearer to."""
    find_m = np.float32(bounds[k, 0])
    left, right = np.float32(bounds[k, 1]), np.float32(bounds[k, 2])
    top, bottom = np.float32(bounds[k, 3]), np.float32(bounds[k, 4])
    new = np.int32(k)
    # Without branches, so that the processor takes several points at once.
    for i in range(BLOCK_POINTS):
        here, before, earlier = distances[i], nearest[i], owner[i]
        holds = (abs(here) <= find_m) & (abs(here) < abs(before))
        holds = holds & (u[i] >= left) & (u[i] <= right) & (v[i] >= top) & (v[i] <= bottom)
        owner[i] = new if holds else earlier
        nearest[i] = here if holds else before


@kernel_part
def _is_drawn(block: int, every: int) -> bool:
    """Whether a block is among those that are summed: one of so many, drawn by its number.

    At a fixed step, blocks would fall in step with the columns of a scan and leave stripes out.
    """
    mixed = np.uint64(block + 1) * np.uint64(0x9E3779B97F4A7C15)
    mixed ^= mixed >> np.uint64(29)
    mixed *= np.uint64(0xBF58476D1CE4E5B9)
    return bool((mixed >> np.uint64(33)) % np.uint64(every) == np.uint64(0))


@kernel_part
def _sum_block(
    scratch: _Scratch,
    count: int,
    slabs: NDArray[np.float64],
    rasters: NDArray[np.float64],
    active: NDArray[np.int64],
    counts: NDArray[np.int32],
    sums: NDArray[np.int64],
) -> None:
    """Add the points of a block to the cells of their owners."""
    local, middle, u, v = scratch.local, scratch.middle, scratch.u, scratch.v
    scratch.cells[:] = -1
    for k in active:
        if rasters[k, 3] > 0.0:
            _place_along(local, middle, slabs, k, _ALONG_U, rasters[k, 2], rasters[k, 0], u)
            _place_along(local, middle, slabs, k, _ALONG_V, rasters[k, 2], rasters[k, 1], v)
            _place(u, v, rasters, k, scratch.owner, scratch.cells)
    _weigh(scratch.nearest, rasters[0, 7], rasters[0, 6], scratch.packed, scratch.squares)
    _add(count, scratch.cells, scratch.packed, scratch.squares, counts, sums)


@kernel_part
def _place(
    u: NDArray[np.float32],
    v: NDArray[np.float32],
    rasters: NDArray[np.float64],
    k: int,
    owner: NDArray[np.int32],
    cells: NDArray[np.int32],
) -> None:
    """Set the cell of those points of a block that a slab owns, clipped to its raster's edges."""
    last_row, last_column = np.float32(rasters[k, 3] - 1.0), np.float32(rasters[k, 4] - 1.0)
    width, first = np.int32(rasters[k, 4]), np.int32(rasters[k, 5])
    mine, zero = np.int32(k), np.float32(0.0)
    for i in range(BLOCK_POINTS):
        column = max(zero, u[i])
        row = max(zero, v[i])
        column = min(last_column, column)
        row = min(last_row, row)
        cell = first + np.int32(row) * width + np.int32(column)
        cells[i] = cell if owner[i] == mine else cells[i]


@kernel_part
def _weigh(
    nearest: NDArray[np.float32],
    inner_m: float,
    fit_m: float,
    packed: NDArray[np.int64],
    squares: NDArray[np.int64],
) -> None:
    """Set what each point of a block adds: packed numbers, and its squared distance in steps."""
    inner, fit = np.float32(inner_m), np.float32(fit_m)
    to_steps = np.float32(STEPS_PER_TOLERANCE / fit_m)
    half, far = np.float32(0.5), np.float32(STEPS_PER_TOLERANCE)
    zero, none, shift = np.float32(0.0), np.int64(0), np.int64(STEPS_PER_TOLERANCE)
    for i in range(BLOCK_POINTS):
        size = abs(nearest[i])
        fits = size <= fit
        distance = nearest[i] if fits else zero
        # Rounded to the nearest whole number: truncation of a positive one.
        steps = np.int64(np.int32(distance * to_steps + (far + half)))
        bits = np.int64(1) << _FIND_BIT
        bits += np.int64(1) << _INNER_BIT if size <= inner else none
        bits += (np.int64(1) << _FIT_BIT) + steps if fits else none
        packed[i] = bits
        squares[i] = (steps - shift) * (steps - shift)


@kernel_part
def _add(
    count: int,
    cells: NDArray[np.int32],
    packed: NDArray[np.int64],
    squares: NDArray[np.int64],
    counts: NDArray[np.int32],
    sums: NDArray[np.int64],
) -> None:
    """Add the points of a block to their cells; a scan's neighbours share one, so runs are few."""
    cell, total, total_squares = cells[0], np.int64(0), np.int64(0)
    for i in range(count):
        if cells[i] != cell:
            if cell >= 0:
                _add_run(cell, total, total_squares, counts, sums)
            cell, total, total_squares = cells[i], np.int64(0), np.int64(0)
        total += packed[i]
        total_squares += squares[i]
    if cell >= 0:
        _add_run(cell, total, total_squares, counts, sums)


@kernel_part
def _add_run(
    cell: int,
    packed: np.int64,
    squares: np.int64,
    counts: NDArray[np.int32],
    sums: NDArray[np.int64],
) -> None:
    """Add the packed sum of a run of points to their cell."""
    n_fit = packed >> _FIT_BIT
    counts[cell, 0] += (packed >> _FIND_BIT) & _FIELD
    counts[cell, 1] += (packed >> _INNER_BIT) & _FIELD
    counts[cell, 2] += n_fit
    sums[cell, 0] += (packed & ((1 << _FIND_BIT) - 1)) - n_fit * STEPS_PER_TOLERANCE
    sums[cell, 1] += squares


# Bins that the deviations of a plane's points are counted in.
HISTOGRAM_BINS: Final = 200


@kernel_part
def _list_owners(
    claims: NDArray[np.int8], owners: NDArray[np.int64], seen: NDArray[np.uint8]
) -> int:
    """List the planes that have points of a block; gives how many."""
    count = 0
    last = np.int8(-1)
    for i in range(claims.size):
        k = claims[i]
        # Neighbours have one owner, so this asks little.
        if k != last and k >= 0 and seen[k] == 0:
            seen[k] = 1
            owners[count] = k
            count += 1
        last = k
    for j in range(count):
        seen[owners[j]] = 0
    return count


@kernel_part
def _add_distances(
    claims: NDArray[np.int8],
    k: int,
    distances: NDArray[np.float32],
    limits: NDArray[np.float64],
    places: NDArray[np.int32],
    sums: NDArray[np.int64],
    histogram: NDArray[np.int64],
) -> None:
    """Add the distances of one plane's points of a block to its sums and its histogram."""
    find_m, fit_m = np.float32(limits[k, 0]), np.float32(limits[k, 1])
    to_steps = np.float32(STEPS_PER_TOLERANCE / limits[k, 1])
    to_bins = np.float32(0.5 * HISTOGRAM_BINS) / find_m
    half, one, none = np.float32(0.5), np.int32(1), np.int32(0)
    shift, last = np.float32(0.5 * HISTOGRAM_BINS), np.float32(HISTOGRAM_BINS - 1)
    zero, mine = np.float32(0.0), np.int8(k)
    n_find, n_fit = np.int32(0), np.int32(0)
    total, squares = np.int64(0), np.int64(0)
    total_fit, squares_fit = np.int64(0), np.int64(0)
    # Without branches, so that the processor takes several points at once.
    for i in range(claims.size):
        place = distances[i] * to_bins + shift
        place = max(zero, place)
        place = min(last, place)
        places[i] = np.int32(place) if claims[i] == mine else np.int32(-1)
    for i in range(claims.size):
        is_mine = claims[i] == mine
        fits = is_mine & (abs(distances[i]) <= fit_m)
        scaled = distances[i] * to_steps
        # Truncation after a half towards the number's own side rounds to the nearest.
        steps = np.int32(scaled + (half if scaled >= zero else -half))
        steps = steps if is_mine else none
        step = np.int64(steps)
        step_fit = np.int64(steps if fits else none)
        n_find += one if is_mine else none
        n_fit += one if fits else none
        total += step
        squares += step * step
        total_fit += step_fit
        squares_fit += step_fit * step_fit
    for i in range(claims.size):
        if places[i] >= 0:
            histogram[k, places[i]] += 1
    sums[k, 0] += n_find
    sums[k, 1] += total
    sums[k, 2] += squares
    sums[k, 3] += n_fit
    sums[k, 4] += total_fit
    sums[k, 5] += squares_fit


@kernel_part
def _reaches_further(
    boxes: NDArray[np.float32],
    block: int,
    slabs: NDArray[np.float64],
    extents: NDArray[np.float64],
    k: int,
) -> bool:
    """Whether points of a block may lie beyond what the plane reached so far."""
    for row in range(1, 3):
        centre, half = -slabs[k, 4 * row + 3], 0.0
        for axis in range(3):
            low, high = np.float64(boxes[block, 2 * axis]), np.float64(boxes[block, 2 * axis + 1])
            centre += slabs[k, 4 * row + axis] * 0.5 * (low + high)
            half += abs(slabs[k, 4 * row + axis]) * 0.5 * (high - low)
        if centre - half < extents[k, 2 * row - 2] or centre + half > extents[k, 2 * row - 1]:
            return True
    return False


@kernel_part
def _reach(  # noqa: PLR0913, PLR0917 - compiled code has no objects to bundle these in
    points: BlockedPoints,
    block: int,
    claims: NDArray[np.int8],
    distances: NDArray[np.float32],
    slabs: NDArray[np.float64],
    limits: NDArray[np.float64],
    extents: NDArray[np.float64],
    k: int,
) -> None:
    """Widen the extents of a plane to its points of a block."""
    x, y, z = points.x, points.y, points.z
    start = block * BLOCK_POINTS
    fit_m = np.float32(limits[k, 1])
    for i in range(claims.size):
        if claims[i] != k or abs(distances[i]) > fit_m:
            continue
        px, py, pz = np.float64(x[start + i]), np.float64(y[start + i]), np.float64(z[start + i])
        u = slabs[k, 4] * px + slabs[k, 5] * py + slabs[k, 6] * pz - slabs[k, 7]
        v = slabs[k, 8] * px + slabs[k, 9] * py + slabs[k, 10] * pz - slabs[k, 11]
        if limits[k, 2] <= u <= limits[k, 3] and limits[k, 4] <= v <= limits[k, 5]:
            extents[k, 0], extents[k, 1] = min(extents[k, 0], u), max(extents[k, 1], u)
            extents[k, 2], extents[k, 3] = min(extents[k, 2], v), max(extents[k, 3], v)


@compiled
def measure_deviations(
    points: BlockedPoints,
    claims: NDArray[np.int8],
    slabs: NDArray[np.float64],
    limits: NDArray[np.float64],
    sums: NDArray[np.int64],
    histogram: NDArray[np.int64],
    extents: NDArray[np.float64],
) -> None:
    """Sum and bin the distances of claimed points to their plane, and see how far they reach.

    Args:
        points: (n,) offsets in blocks.
        claims: (n,) plane of each point, negative for none.
        slabs: (k, 12) the planes.
        limits: (k, 6) find tolerance, fit tolerance, smallest and largest u, smallest and largest
            v of the plane's rectangle; metres.
        sums: (k, 6) of points within the find tolerance: number, steps, squared steps, then
            the same within the fit tolerance; added to.
        histogram: (k, HISTOGRAM_BINS) points per bin of -find tolerance..find tolerance.
        extents: (k, 4) smallest and largest u, smallest and largest v of the points within the fit
            tolerance and the rectangle; widened.
    """
    local = np.zeros((3, BLOCK_POINTS), dtype=np.float32)
    middle = np.empty(3)
    distances = np.empty(BLOCK_POINTS, dtype=np.float32)
    places = np.empty(BLOCK_POINTS, dtype=np.int32)
    owners, seen = np.empty(slabs.shape[0], dtype=np.int64), np.zeros(128, dtype=np.uint8)
    for block in range(points.boxes.shape[0]):
        start = block * BLOCK_POINTS
        held = claims[start : min(start + BLOCK_POINTS, claims.size)]
        n_owners = _list_owners(held, owners, seen)
        if n_owners == 0:
            continue
        _centre_block(points, block, middle, local)
        for k in owners[:n_owners]:
            _place_along(local, middle, slabs, k, _ALONG_NORMAL, 1.0, 0.0, distances)
            _add_distances(held, k, distances, limits, places, sums, histogram)
            if _reaches_further(points.boxes, block, slabs, extents, k):
                _reach(points, block, held, distances, slabs, limits, extents, k)
