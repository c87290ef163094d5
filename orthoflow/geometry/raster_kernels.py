"""Compiled passes that lay points into the cells of a raster.

A pass works on one chunk of the cloud after the other. `project_points` transforms a chunk and
keeps what falls into the raster, in the order of the points; the other passes then run over the
kept entries, each thread on the cells it owns. Every cell is therefore visited in the order of the
points whatever the number of threads, and no result depends on it, sums of floats included.

The bodies of the parallel loops are functions of their own: written in place, numba 0.68 drops
stores into an array that is reached through a named tuple as if nobody read them.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

# Points handled by one task; an entry slot exists for each, so that tasks never wait for another.
BLOCK: Final = 8192
# Cells are dealt out to threads in runs of 2^10: scans write neighbouring cells one after the
# other, and two threads on one cache line would slow each other down.
_RUN_SHIFT: Final = 10
NO_POINT: Final = np.uint32(0xFFFFFFFF)


class Target(NamedTuple):
    """The raster that points are laid into.

    Attributes:
        wall_from_offset: (3, 4) float64; rows give column, row and depth in metres of an offset.
        behind_m: smallest depth that counts.
        front_m: largest depth that counts.
        height: number of rows.
        width: number of columns.
    """

    wall_from_offset: NDArray[np.float64]
    behind_m: float
    front_m: float
    height: int
    width: int


class Entries(NamedTuple):
    """Points of one chunk that fall into the raster, `n_inside[b]` from slot `b * BLOCK` on.

    Attributes:
        cells: int32, row * width + column.
        depths_m: float32.
        squares: float32, squared distance to the centre of the cell, in cells.
        points: uint32, index in the cloud.
        n_inside: int64, entries per block.
    """

    cells: NDArray[np.int32]
    depths_m: NDArray[np.float32]
    squares: NDArray[np.float32]
    points: NDArray[np.uint32]
    n_inside: NDArray[np.int64]


class Winners(NamedTuple):
    """The point that won each cell, flat.

    Attributes:
        depths_m: float32.
        squares: float32, squared distance to the centre of the cell, in cells.
        points: uint32 index in the cloud, `NO_POINT` where the cell is void.
    """

    depths_m: NDArray[np.float32]
    squares: NDArray[np.float32]
    points: NDArray[np.uint32]


class Moments(NamedTuple):
    """Number, sum and sum of squares of the depths in each cell, flat."""

    n_points: NDArray[np.uint32]
    sum_m: NDArray[np.float64]
    sum_m2: NDArray[np.float64]


@njit(parallel=True, cache=True)
def project_points(
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    z: NDArray[np.float32],
    first: int,
    target: Target,
    entries: Entries,
) -> None:
    """Fill `entries` with the points of a chunk that lie inside the raster and its buffer.

    Both ends of the buffer are inside. A cell owns its left and upper edge.

    Args:
        x: (n,) offsets of the chunk in metres; y and z alike.
        y: see x.
        z: see x.
        first: index in the cloud of the chunk's first point.
        target: the raster.
        entries: overwritten.
    """
    for block in prange((x.size + BLOCK - 1) // BLOCK):
        _project_block(x, y, z, first, target, entries, block)


@njit(cache=True)
def _project_block(
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    z: NDArray[np.float32],
    first: int,
    target: Target,
    entries: Entries,
    block: int,
) -> None:
    m = target.wall_from_offset
    slot = begin = block * BLOCK
    for i in range(begin, min(x.size, begin + BLOCK)):
        # float64 on purpose: the pass waits for memory, not for arithmetic.
        px, py, pz = np.float64(x[i]), np.float64(y[i]), np.float64(z[i])
        depth = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]
        if not (target.behind_m <= depth <= target.front_m):
            continue
        u = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3]
        v = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3]
        if not (0.0 <= u < target.width and 0.0 <= v < target.height):
            continue
        column, row = np.int64(u), np.int64(v)
        du, dv = u - column - 0.5, v - row - 0.5
        entries.cells[slot] = row * target.width + column
        entries.depths_m[slot] = depth
        entries.squares[slot] = du * du + dv * dv
        entries.points[slot] = first + i
        slot += 1
    entries.n_inside[block] = slot - begin


@njit(parallel=True, cache=True)
def keep_topmost(entries: Entries, winners: Winners, owners: int) -> None:
    """Let the largest depth win; ties go to the point nearer the centre, then the lower index.

    Args:
        entries: one chunk.
        winners: updated; depths start at minus infinity.
        owners: a power of two, how many threads share the cells.
    """
    for owner in prange(owners):
        _keep_topmost_of(entries, winners, owners, owner)


@njit(cache=True)
def _keep_topmost_of(entries: Entries, winners: Winners, owners: int, owner: int) -> None:
    for block in range(entries.n_inside.size):
        first = block * BLOCK
        for k in range(first, first + entries.n_inside[block]):
            cell = entries.cells[k]
            if (cell >> _RUN_SHIFT) & (owners - 1) != owner:
                continue
            depth = entries.depths_m[k]
            top = winners.depths_m[cell]
            if depth > top or (depth == top and entries.squares[k] < winners.squares[cell]):
                winners.depths_m[cell] = depth
                winners.squares[cell] = entries.squares[k]
                winners.points[cell] = entries.points[k]


@njit(parallel=True, cache=True)
def keep_nearest(entries: Entries, winners: Winners, owners: int) -> None:
    """Let the point nearest the centre of the cell win; ties go to the lower index.

    Args:
        entries: one chunk.
        winners: updated; squares start at infinity.
        owners: a power of two, how many threads share the cells.
    """
    for owner in prange(owners):
        _keep_nearest_of(entries, winners, owners, owner)


@njit(cache=True)
def _keep_nearest_of(entries: Entries, winners: Winners, owners: int, owner: int) -> None:
    for block in range(entries.n_inside.size):
        first = block * BLOCK
        for k in range(first, first + entries.n_inside[block]):
            cell = entries.cells[k]
            if (cell >> _RUN_SHIFT) & (owners - 1) != owner:
                continue
            if entries.squares[k] < winners.squares[cell]:
                winners.depths_m[cell] = entries.depths_m[k]
                winners.squares[cell] = entries.squares[k]
                winners.points[cell] = entries.points[k]


@njit(parallel=True, cache=True)
def add_moments(entries: Entries, moments: Moments, owners: int) -> None:
    """Count the points of each cell and sum their depths and squared depths."""
    for owner in prange(owners):
        _add_moments_of(entries, moments, owners, owner)


@njit(cache=True)
def _add_moments_of(entries: Entries, moments: Moments, owners: int, owner: int) -> None:
    for block in range(entries.n_inside.size):
        first = block * BLOCK
        for k in range(first, first + entries.n_inside[block]):
            cell = entries.cells[k]
            if (cell >> _RUN_SHIFT) & (owners - 1) != owner:
                continue
            depth = np.float64(entries.depths_m[k])
            moments.n_points[cell] += np.uint32(1)
            moments.sum_m[cell] += depth
            moments.sum_m2[cell] += depth * depth


@njit(parallel=True, cache=True)
def sort_into_cells(
    entries: Entries, cursors: NDArray[np.int64], sorted_m: NDArray[np.float32], owners: int
) -> None:
    """Write each depth behind those its cell already holds.

    Args:
        entries: one chunk.
        cursors: (cells,) where the cell's next depth goes; moved on.
        sorted_m: (points inside,) depths grouped by cell.
        owners: a power of two, how many threads share the cells.
    """
    for owner in prange(owners):
        _sort_into_cells_of(entries, cursors, sorted_m, owners, owner)


@njit(cache=True)
def _sort_into_cells_of(
    entries: Entries,
    cursors: NDArray[np.int64],
    sorted_m: NDArray[np.float32],
    owners: int,
    owner: int,
) -> None:
    for block in range(entries.n_inside.size):
        first = block * BLOCK
        for k in range(first, first + entries.n_inside[block]):
            cell = entries.cells[k]
            if (cell >> _RUN_SHIFT) & (owners - 1) != owner:
                continue
            sorted_m[cursors[cell]] = entries.depths_m[k]
            cursors[cell] += 1


@njit(parallel=True, cache=True)
def median_depths(
    ends: NDArray[np.int64], sorted_m: NDArray[np.float32], layer_m: float
) -> NDArray[np.float32]:
    """Median depth of each cell that never lies between two layers.

    With an even number of depths the two middle ones are averaged if they lie within `layer_m`;
    otherwise the one nearer the viewer counts, because a mean of two layers is on neither.

    Args:
        ends: (cells,) end of each cell's depths in `sorted_m`.
        sorted_m: depths grouped by cell; sorted in place.
        layer_m: distance beyond which two depths belong to different layers.

    Returns:
        (cells,) metres, NaN where the cell is void.
    """
    medians_m = np.empty(ends.size, dtype=np.float32)
    for cell in prange(ends.size):
        begin = np.int64(0) if cell == 0 else ends[cell - 1]
        count = ends[cell] - begin
        if count == 0:
            medians_m[cell] = np.nan
            continue
        depths = sorted_m[begin : ends[cell]]
        depths.sort()
        upper = depths[count // 2]
        lower = depths[(count - 1) // 2]
        medians_m[cell] = np.float32(0.5) * (lower + upper) if upper - lower <= layer_m else upper
    return medians_m


@njit(parallel=True, cache=True)
def add_values(
    entries: Entries,
    values: NDArray[np.generic],
    depths_m: NDArray[np.float32],
    layer_m: float,
    sums: NDArray[np.generic],
    owners: int,
) -> None:
    """Sum the values of the points that lie on the surface of their cell.

    Args:
        entries: one chunk.
        values: (points of the cloud, channels).
        depths_m: (cells,) the surface.
        layer_m: a point farther than this from the surface belongs to another layer.
        sums: (cells, channels + 1); the last channel counts the points.
        owners: a power of two, how many threads share the cells.
    """
    for owner in prange(owners):
        _add_values_of(entries, values, depths_m, layer_m, sums, owners, owner)


@njit(cache=True)
def _add_values_of(
    entries: Entries,
    values: NDArray[np.generic],
    depths_m: NDArray[np.float32],
    layer_m: float,
    sums: NDArray[np.generic],
    owners: int,
    owner: int,
) -> None:
    channels = values.shape[1]
    for block in range(entries.n_inside.size):
        first = block * BLOCK
        for k in range(first, first + entries.n_inside[block]):
            cell = entries.cells[k]
            if (cell >> _RUN_SHIFT) & (owners - 1) != owner:
                continue
            if abs(entries.depths_m[k] - depths_m[cell]) > layer_m:
                continue
            for channel in range(channels):
                sums[cell, channel] += values[entries.points[k], channel]
            sums[cell, channels] += 1


@njit(parallel=True, cache=True)
def nearest_within(
    is_measured: NDArray[np.bool_], offsets: NDArray[np.int64], reach: int
) -> NDArray[np.int32]:
    """Flat index of the measured cell nearest to each cell, -1 without one within the disc.

    Args:
        is_measured: (rows, cols), framed by `reach` cells whose own result stays -1.
        offsets: (k, 2) rows and columns of a disc without its centre, nearest first.
        reach: largest offset.

    Returns:
        (rows, cols); a measured cell is its own nearest.
    """
    rows, columns = is_measured.shape
    nearest = np.full((rows, columns), -1, dtype=np.int32)
    for row in prange(reach, rows - reach):
        for column in range(reach, columns - reach):
            if is_measured[row, column]:
                nearest[row, column] = row * columns + column
                continue
            for k in range(offsets.shape[0]):
                r, c = row + offsets[k, 0], column + offsets[k, 1]
                if is_measured[r, c]:
                    nearest[row, column] = r * columns + c
                    break
    return nearest


@njit(parallel=True, cache=True)
def is_narrow_gap(
    is_measured: NDArray[np.bool_], nearest: NDArray[np.int32], offsets: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Whether a cell is void and no disc that covers it fits into the void around it.

    Args:
        is_measured: (rows, cols), framed by twice the disc's radius.
        nearest: (rows, cols) of `nearest_within` the same disc; -1 where a disc fits.
        offsets: (k, 2) rows and columns of the disc without its centre.
    """
    rows, columns = is_measured.shape
    reach = 2 * np.abs(offsets).max()
    is_narrow = np.zeros((rows, columns), dtype=np.bool_)
    for row in prange(reach, rows - reach):
        for column in range(reach, columns - reach):
            if is_measured[row, column] or nearest[row, column] < 0:
                continue
            fits = False
            for k in range(offsets.shape[0]):
                if nearest[row + offsets[k, 0], column + offsets[k, 1]] < 0:
                    fits = True
                    break
            is_narrow[row, column] = not fits
    return is_narrow
