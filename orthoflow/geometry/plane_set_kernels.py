"""One compiled pass for all planes at once: each point to its nearest plane, sums per cell.

Slabs as in `plane_kernels`; blocks of points are tried only against the slabs that their box meets,
mostly one or two, so that sixteen planes cost little more than one. Within a block places are
counted from the middle of its box: float32 then is exact to nanometres wherever the block lies, and
the processor takes twice as many points at once as with float64.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.box_kernels import (
    ALONG_NORMAL,
    ALONG_U,
    ALONG_V,
    CHUNK_BLOCKS,
    centre_block,
    meet_chunk,
    place_along,
)
from orthoflow.geometry.compiling import compiled, kernel_part
from orthoflow.geometry.plane_kernels import STEPS_PER_TOLERANCE
from orthoflow.geometry.point_kernels import BLOCK_POINTS, BlockedPoints

# What a point adds to its cell, packed into one number so that a run of points is one sum: its
# distance in steps from the lower limit of the fit tolerance, if it is within, itself, and whether
# it lies within the inner and the fit tolerance. A block has fewer points than a bit field holds.
_FIND_BIT: Final = 32
_INNER_BIT: Final = 42
_FIT_BIT: Final = 52
_FIELD: Final = 1023


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
    """Give those points of a block to a slab that it holds and no earlier one is nearer to."""
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
def _list_active(
    meeting: NDArray[np.int32],
    place: int,
    rasters: NDArray[np.float64],
    active: NDArray[np.int64],
) -> tuple[int, int, int]:
    """List the slabs that a block meets; gives how many, how many are summed, and the holder.

    The holder is the slab that holds the entire block and is all it meets, -1 for none.
    """
    n_active, n_wanted, holds = 0, 0, False
    for k in range(meeting.shape[0]):
        if meeting[k, place] > 0:
            active[n_active] = k
            n_active += 1
            n_wanted += int(rasters[k, 3] > 0.0)
            holds = meeting[k, place] == 2
    return n_active, n_wanted, int(active[0]) if n_active == 1 and holds else -1


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
        place_along(local, middle, slabs, holder, ALONG_NORMAL, 1.0, 0.0, nearest)
        return
    owner[:] = -1
    nearest[:] = np.inf
    for k in active:
        place_along(local, middle, slabs, k, ALONG_NORMAL, 1.0, 0.0, scratch.distances)
        if not _any_near(scratch.distances, bounds[k, 0]):
            continue
        place_along(local, middle, slabs, k, ALONG_U, 1.0, 0.0, scratch.u)
        place_along(local, middle, slabs, k, ALONG_V, 1.0, 0.0, scratch.v)
        _take_nearer(scratch.u, scratch.v, scratch.distances, bounds, k, owner, nearest)


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
            place_along(local, middle, slabs, k, ALONG_U, rasters[k, 2], rasters[k, 0], u)
            place_along(local, middle, slabs, k, ALONG_V, rasters[k, 2], rasters[k, 1], v)
            _place(u, v, rasters, k, scratch.owner, scratch.cells)
    _weigh(scratch.nearest, rasters[0, 7], rasters[0, 6], scratch.packed, scratch.squares)
    _add(count, scratch.cells, scratch.packed, scratch.squares, counts, sums)


@kernel_part
def _claim(owner: NDArray[np.int32], claims: NDArray[np.int8]) -> None:
    """Set the claims of a block's points."""
    for i in range(claims.size):
        claims[i] = np.int8(owner[i])


@kernel_part
def _is_drawn(block: int, every: int) -> bool:
    """Whether a block is among those that are summed: one of so many, drawn by its number.

    At a fixed step, blocks would fall in step with the columns of a scan and leave stripes out.
    """
    mixed = np.uint64(block + 1) * np.uint64(0x9E3779B97F4A7C15)
    mixed ^= mixed >> np.uint64(29)
    mixed *= np.uint64(0xBF58476D1CE4E5B9)
    return bool((mixed >> np.uint64(33)) % np.uint64(every) == np.uint64(0))


@compiled
def assign_points(  # noqa: PLR0913, PLR0917 - compiled code has no objects to bundle these in
    points: BlockedPoints,
    claims: NDArray[np.int8],
    slabs: NDArray[np.float64],
    bounds: NDArray[np.float64],
    rasters: NDArray[np.float64],
    counts: NDArray[np.int32],
    sums: NDArray[np.int64],
    drawn: tuple[int, int],
) -> None:
    """Give each point to the nearest slab that holds it, or sum distances in that slab's cells.

    Args:
        points: (n,) offsets in blocks.
        claims: (n,) set to the slab of each point, -1 for none, if there are no cells.
        slabs: (k, 12) see `plane_kernels`.
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
    spread = np.zeros((6, CHUNK_BLOCKS), dtype=np.float32)
    meeting = np.empty((slabs.shape[0], CHUNK_BLOCKS), dtype=np.int32)
    is_summing = counts.shape[0] > 0
    for block in range(boxes.shape[0]):
        place = block % CHUNK_BLOCKS
        if place == 0:
            meet_chunk(boxes, block, slabs, bounds, spread, meeting)
        n_active, n_wanted, holder = _list_active(meeting, place, rasters, listed)
        active = listed[:n_active]
        start = block * BLOCK_POINTS
        stop = min(start + BLOCK_POINTS, claims.size)
        if not is_summing and (n_active == 0 or holder >= 0):
            # Most blocks of a scan are a short piece of one wall: no point has to be asked.
            claims[start:stop] = np.int8(holder)
            continue
        if is_summing and (n_wanted == 0 or not _is_drawn(drawn[1] + block, drawn[0])):
            continue
        centre_block(points, block, scratch.middle, scratch.local)
        _own_block(scratch, slabs, bounds, active, holder)
        if is_summing:
            _sum_block(scratch, stop - start, slabs, rasters, active, counts, sums)
            continue
        _claim(scratch.owner, claims[start:stop])


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
