"""Compiled passes that bin points into the cells of a raster.

A pass processes one chunk of the cloud after the other. `project_points` transforms a chunk and
keeps the points inside the raster, in order; the passes then run over these entries, each thread on
the cells it owns. Every cell is therefore visited in the order of the points for any number of
threads, and no result depends on it, including sums of floats.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, inlined, kernel_part
from orthoflow.geometry.point_kernels import Offsets

# Points per task; an entry slot exists for each, so that tasks never wait for each other.
BLOCK: Final = 8192
# Points transformed together; their coordinates stay in the first-level cache.
_LANE: Final = 256
# Cells are assigned to threads in runs of 2^17, some dozens of rows: a scan runs along columns or
# rows, and a thread that meets its own points in long runs is not slowed down by the others'.
_RUN_SHIFT: Final = 17
NO_POINT: Final = np.uint32(0xFFFFFFFF)
# One record per cell: a scan along columns accesses another row of the raster with every point, and
# the passes are limited by one cache line for each.
WINNER: Final = np.dtype([("depth_m", "f4"), ("square", "f4"), ("point", "u4"), ("n_points", "u4")])
# The same record with the bits of its floats as integers.
_WINNER_BITS: Final = np.dtype(
    [("depth_m", "i4"), ("square", "i4"), ("point", "u4"), ("n_points", "u4")]
)
# Cells whose channels are fetched one after the other: their winners stay in the first-level cache.
_RUN_OF_VALUES: Final = 1024


class Target(NamedTuple):
    """The raster into which points are binned.

    Attributes:
        wall_from_offset: (3, 4) float64; rows give column, row and depth in metres of an offset.
        behind_m: smallest accepted depth.
        front_m: largest accepted depth.
        height: number of rows.
        width: number of columns.
    """

    wall_from_offset: NDArray[np.float64]
    behind_m: float
    front_m: float
    height: int
    width: int


class Entries(NamedTuple):
    """Points of one chunk that lie inside the raster, `n_inside[b]` from slot `b * BLOCK` on.

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


@compiled
def project_points(
    offsets: Offsets, first: int, target: Target, entries: Entries, first_block: int, end_block: int
) -> None:
    """Fill blocks of `entries` with the points of a chunk inside the raster and its buffer.

    Both ends of the buffer are inside. A cell owns its left and upper edge.

    Args:
        offsets: of the chunk.
        first: index in the cloud of the chunk's first point.
        target: the raster.
        entries: overwritten.
        first_block: first block to fill.
        end_block: the block after the last one.
    """
    for block in range(first_block, end_block):
        slot = begin = block * BLOCK
        end = min(offsets.x.size, begin + BLOCK)
        for lane in range(begin, end, _LANE):
            stop = min(lane + _LANE, end)
            part = Offsets(offsets.x[lane:stop], offsets.y[lane:stop], offsets.z[lane:stop])
            after = slot + stop - lane
            # A scan is ordered: most lanes are entirely inside or entirely outside.
            n_inside = _set_cells(part, target, entries.cells[slot:after])
            if n_inside == 0:
                continue
            _set_depths(part, target.wall_from_offset[2], entries.depths_m[slot:after])
            _set_squares(part, target.wall_from_offset, entries.squares[slot:after])
            points = entries.points[slot:after]
            for k in range(points.size):
                points[k] = first + lane + k
            slot = after if n_inside == stop - lane else _close_up(entries, slot, after)
        entries.n_inside[block] = slot - begin


@compiled
def leave_out(
    is_left_out: NDArray[np.bool_], entries: Entries, first_block: int, end_block: int
) -> None:
    """Drop the entries of some points from blocks of `entries`; the rest keeps its order.

    Args:
        is_left_out: (n,) of the points of the cloud.
        entries: changed.
        first_block: first block to go through.
        end_block: the block after the last one.
    """
    for block in range(first_block, end_block):
        begin = block * BLOCK
        after = begin + entries.n_inside[block]
        for k in range(begin, after):
            if is_left_out[entries.points[k]]:
                entries.cells[k] = -1
        entries.n_inside[block] = _close_up(entries, begin, after) - begin


# Each loop below writes one array and has no branches, so that it is vectorised. float64 on
# purpose: the passes are limited by memory, not by arithmetic.


@kernel_part
def _set_cells(part: Offsets, target: Target, cells: NDArray[np.int32]) -> int:
    """Set the cell of each point, -1 outside, and return the number inside."""
    m = target.wall_from_offset
    u0, u1, u2, u3 = m[0, 0], m[0, 1], m[0, 2], m[0, 3]
    v0, v1, v2, v3 = m[1, 0], m[1, 1], m[1, 2], m[1, 3]
    d0, d1, d2, d3 = m[2, 0], m[2, 1], m[2, 2], m[2, 3]
    behind_m, front_m = target.behind_m, target.front_m
    last_column, last_row = np.float64(target.width), np.float64(target.height)
    width, nowhere, nothing = np.int32(target.width), np.int32(-1), np.float64(0.0)
    x, y, z = part.x, part.y, part.z
    for k in range(cells.size):
        px, py, pz = np.float64(x[k]), np.float64(y[k]), np.float64(z[k])
        u = u0 * px + u1 * py + u2 * pz + u3
        v = v0 * px + v1 * py + v2 * pz + v3
        depth = d0 * px + d1 * py + d2 * pz + d3
        is_in_raster = (u >= 0.0) & (u < last_column) & (v >= 0.0) & (v < last_row)
        is_inside = is_in_raster & (depth >= behind_m) & (depth <= front_m)
        column = np.int32(u if is_inside else nothing)
        row = np.int32(v if is_inside else nothing)
        cells[k] = np.int32(row * width + column) if is_inside else nowhere
    n_outside = np.int32(0)
    for k in range(cells.size):
        n_outside += np.int32(cells[k] >> np.int32(31))
    return int(cells.size + n_outside)


@kernel_part
def _set_depths(part: Offsets, m: NDArray[np.float64], depths_m: NDArray[np.float32]) -> None:
    d0, d1, d2, d3 = m[0], m[1], m[2], m[3]
    x, y, z = part.x, part.y, part.z
    for k in range(depths_m.size):
        px, py, pz = np.float64(x[k]), np.float64(y[k]), np.float64(z[k])
        depths_m[k] = d0 * px + d1 * py + d2 * pz + d3


@kernel_part
def _set_squares(part: Offsets, m: NDArray[np.float64], squares: NDArray[np.float32]) -> None:
    u0, u1, u2, u3 = m[0, 0], m[0, 1], m[0, 2], m[0, 3]
    v0, v1, v2, v3 = m[1, 0], m[1, 1], m[1, 2], m[1, 3]
    x, y, z = part.x, part.y, part.z
    for k in range(squares.size):
        px, py, pz = np.float64(x[k]), np.float64(y[k]), np.float64(z[k])
        u = u0 * px + u1 * py + u2 * pz + u3
        v = v0 * px + v1 * py + v2 * pz + v3
        du, dv = u - math.floor(u) - 0.5, v - math.floor(v) - 0.5
        squares[k] = du * du + dv * dv


@kernel_part
def _close_up(entries: Entries, slot: int, after: int) -> int:
    """Move entries with a cell to the front, in order, and return the slot after the last."""
    for k in range(slot, after):
        cell = entries.cells[k]
        entries.cells[slot] = cell
        entries.depths_m[slot] = entries.depths_m[k]
        entries.squares[slot] = entries.squares[k]
        entries.points[slot] = entries.points[k]
        slot += cell >= 0
    return slot


@inlined
def is_own(cell, owners, owner):  # type: ignore[no-untyped-def]  # numba infers the types
    """Return whether a thread owns a cell; owners are a power of two."""
    return (cell >> _RUN_SHIFT) & (owners - 1) == owner


@compiled
def empty_cells(winners: NDArray[np.void], first: int, end: int) -> None:
    """Initialise some cells of `WINNER` without a winner."""
    for cell in range(first, end):
        winner = winners[cell]
        winner.depth_m = np.float32(-np.inf)
        winner.square = np.float32(np.inf)
        winner.point = NO_POINT
        winner.n_points = np.uint32(0)


@compiled
def take_values(
    winners: NDArray[np.void],
    values: NDArray[np.generic],
    nothing: np.generic,
    taken: NDArray[np.generic],
    first: int,
    end: int,
) -> None:
    """Fetch for some cells the values of the points that won them.

    Args:
        winners: (cells,) of `WINNER`.
        values: (points of the cloud, channels).
        nothing: value for cells without a point of their own.
        taken: (cells, channels), overwritten.
        first: first cell.
        end: the cell after the last one.
    """
    for start in range(first, end, _RUN_OF_VALUES):
        stop = min(start + _RUN_OF_VALUES, end)
        of_cells = winners[start:stop]
        # One channel at a time and without branches, so that several values are fetched at once.
        for channel in range(values.shape[1]):
            source, goal = values[:, channel], taken[start:stop, channel]
            for k in range(of_cells.size):
                winner = of_cells[k]
                goal[k] = source[winner.point] if winner.n_points > 0 else nothing


@compiled
def find_places(
    cells: NDArray[np.int64],
    winners: NDArray[np.void],
    offsets: Offsets,
    wall_from_offset: NDArray[np.float64],
    places: NDArray[np.float32],
    first: int,
    end: int,
) -> None:
    """Find the positions of the points that won some cells.

    Args:
        cells: (n,) flat indices.
        winners: (cells,) of `WINNER`.
        offsets: of the cloud.
        wall_from_offset: (3, 4) as in `Target`.
        places: (rows, cols, 2) to the right of and below the centre, overwritten at the cells.
        first: first item of `cells` to visit.
        end: the item after the last one.
    """
    m = wall_from_offset
    for cell in cells[first:end]:
        row, column = cell // places.shape[1], cell % places.shape[1]
        winner = winners[cell]
        if winner.n_points == 0:
            places[row, column] = np.nan
            continue
        x, y, z = offsets.x[winner.point], offsets.y[winner.point], offsets.z[winner.point]
        u = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]
        v = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]
        places[row, column, 0] = u - column - 0.5
        places[row, column, 1] = v - row - 0.5


@inlined
def _rank(depth_bits, square_bits):  # type: ignore[no-untyped-def]  # numba infers the types
    """Return an integer sort key of points: descending depth, then ascending squared distance.

    Bits of floats, inverted for negative ones, sort like their values; depths of -0.0 do not occur
    (see `wall_from_offset`), and squares are never negative. Integers are compared and selected
    without branches: which point wins a cell is unpredictable, and mispredicted branches took half
    of the pass.
    """
    ordered = np.int64(depth_bits ^ ((depth_bits >> np.int32(31)) & np.int32(0x7FFFFFFF)))
    return (ordered << 32) - np.int64(square_bits)


@compiled
def keep_topmost(entries: Entries, winners: NDArray[np.void], owners: int, owner: int) -> None:
    """Let the largest depth win; ties go to the point nearer the centre, then the lower index.

    Args:
        entries: one chunk.
        winners: (cells,) of `WINNER`, updated; depths start at minus infinity.
        owners: number of threads that share the cells, a power of two.
        owner: the thread whose cells to visit.
    """
    winners_in_bits = winners.view(_WINNER_BITS)
    for block in range(entries.n_inside.size):
        first = block * BLOCK
        end = first + entries.n_inside[block]
        # An unsigned index needs no check for negative values.
        cells = entries.cells[first:end].view(np.uint32)
        depths, squares = entries.depths_m[first:end], entries.squares[first:end]
        depth_bits, square_bits = depths.view(np.int32), squares.view(np.int32)
        points = entries.points[first:end]
        for k in range(cells.size):
            cell = cells[k]
            if not is_own(cell, owners, owner):
                continue
            winner = winners_in_bits[cell]
            depth, square = winner.depth_m, winner.square
            wins = _rank(depth_bits[k], square_bits[k]) > _rank(depth, square)
            winner.depth_m = depth_bits[k] if wins else depth
            winner.square = square_bits[k] if wins else square
            winner.point = points[k] if wins else winner.point
            winner.n_points += np.uint32(1)


@compiled
def keep_nearest(entries: Entries, winners: NDArray[np.void], owners: int, owner: int) -> None:
    """Let the point nearest the centre of the cell win; ties go to the lower index.

    Args:
        entries: one chunk.
        winners: (cells,) of `WINNER`, updated; squares start at infinity.
        owners: number of threads that share the cells, a power of two.
        owner: the thread whose cells to visit.
    """
    for block in range(entries.n_inside.size):
        first = block * BLOCK
        for k in range(first, first + entries.n_inside[block]):
            cell = entries.cells[k]
            if not is_own(cell, owners, owner):
                continue
            winner = winners[cell]
            winner.n_points += np.uint32(1)
            if entries.squares[k] < winner.square:
                winner.depth_m = entries.depths_m[k]
                winner.square = entries.squares[k]
                winner.point = entries.points[k]
