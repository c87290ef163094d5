"""Compiled passes that lay points into the cells of a raster.

A pass works on one chunk of the cloud after the other. `raster_entry_kernels` transforms a chunk
and keeps what falls into the raster, in the order of the points; the passes then run over the kept
entries, each thread on the cells it owns. Every cell is therefore visited in the order of the
points whatever the number of threads, and no result depends on it, sums of floats included.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, inlined
from orthoflow.geometry.point_kernels import Offsets
from orthoflow.geometry.raster_entry_kernels import BLOCK, Entries

# Cells are dealt out to threads in runs of 2^17, some dozens of rows: a scan runs along columns or
# rows, and a thread that meets its own points in long runs is not slowed by the others'.
_RUN_SHIFT: Final = 17
NO_POINT: Final = np.uint32(0xFFFFFFFF)
# One cell in one record: a scan along columns touches another row of the raster with every point,
# and one cache line for each is what the passes wait for.
WINNER: Final = np.dtype([("depth_m", "f4"), ("square", "f4"), ("point", "u4"), ("n_points", "u4")])
# The same record with the bits of its floats as whole numbers.
_WINNER_BITS: Final = np.dtype(
    [("depth_m", "i4"), ("square", "i4"), ("point", "u4"), ("n_points", "u4")]
)
# Cells whose channels are fetched one after the other: their winners stay in the nearest cache.
_RUN_OF_VALUES: Final = 1024


@inlined
def is_own(cell, owners, owner):  # type: ignore[no-untyped-def]  # numba infers the types
    """Tell whether a thread owns a cell; owners are a power of two."""
    return (cell >> _RUN_SHIFT) & (owners - 1) == owner


@compiled
def empty_cells(winners: NDArray[np.void], first: int, end: int) -> None:
    """Make some cells of `WINNER` such that nobody has won them yet."""
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
    """Give some cells the values of the points that won them.

    Args:
        winners: (cells,) of `WINNER`.
        values: (points of the cloud, channels).
        nothing: for cells without a point of their own.
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


@inlined
def _rank(depth_bits, square_bits):  # type: ignore[no-untyped-def]  # numba infers the types
    """Order of points as whole numbers: larger depths first, then smaller squares.

    Bits of floats, those of negative ones turned over, are in the order of their values; there is
    no depth of -0.0 (see `wall_from_offset`), and squares are never negative. Whole numbers are
    compared and chosen without branches: which of a cell's points wins cannot be foreseen, and
    wrong guesses took half of the pass.
    """
    ordered = np.int64(depth_bits ^ ((depth_bits >> np.int32(31)) & np.int32(0x7FFFFFFF)))
    return (ordered << 32) - np.int64(square_bits)


@compiled
def keep_topmost(entries: Entries, winners: NDArray[np.void], owners: int, owner: int) -> None:
    """Let the largest depth win; ties go to the point nearer the centre, then the lower index.

    Args:
        entries: one chunk.
        winners: (cells,) of `WINNER`, updated; depths start at minus infinity.
        owners: a power of two, how many threads share the cells.
        owner: whose cells to visit.
    """
    winners_in_bits = winners.view(_WINNER_BITS)
    for block in range(entries.n_inside.size):
        first = block * BLOCK
        end = first + entries.n_inside[block]
        # Unsigned, an index is not looked at for being negative.
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
        owners: a power of two, how many threads share the cells.
        owner: whose cells to visit.
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


@compiled
def keep_nearest_around(
    entries: Entries,
    offsets: Offsets,
    wall_from_offset: NDArray[np.float64],
    winners: NDArray[np.void],
    width: int,
    owners: int,
    owner: int,
) -> None:
    """Let the point nearest the centre win, of the cell itself or its eight neighbours.

    Args:
        entries: one chunk.
        offsets: of the whole cloud.
        wall_from_offset: (3, 4) as in `Target`.
        winners: (cells,) of `WINNER`, updated; points count in the cell that they lie in.
        width: columns of the raster.
        owners: a power of two, how many threads share the cells.
        owner: whose cells to visit.
    """
    m = wall_from_offset
    height = winners.size // width
    for block in range(entries.n_inside.size):
        first = block * BLOCK
        for k in range(first, first + entries.n_inside[block]):
            cell, point = entries.cells[k], entries.points[k]
            x, y, z = float(offsets.x[point]), float(offsets.y[point]), float(offsets.z[point])
            u = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]
            v = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]
            row, column = cell // width, cell % width
            for r in range(max(0, row - 1), min(height, row + 2)):
                for c in range(max(0, column - 1), min(width, column + 2)):
                    place = r * width + c
                    if not is_own(place, owners, owner):
                        continue
                    winner = winners[place]
                    if place == cell:
                        winner.n_points += np.uint32(1)
                    du, dv = u - c - 0.5, v - r - 0.5
                    square = np.float32(du * du + dv * dv)
                    if square < winner.square:
                        winner.depth_m = entries.depths_m[k]
                        winner.square = square
                        winner.point = point


@compiled
def count_points(entries: Entries, n_points: NDArray[np.uint32], owners: int, owner: int) -> None:
    """Count the points of each cell."""
    for block in range(entries.n_inside.size):
        first = block * BLOCK
        for k in range(first, first + entries.n_inside[block]):
            cell = entries.cells[k]
            if is_own(cell, owners, owner):
                n_points[cell] += np.uint32(1)


@compiled
def add_moments(entries: Entries, moments: NDArray[np.float64], owners: int, owner: int) -> None:
    """Sum depths and squared depths of each cell into `moments` (cells, 2)."""
    for block in range(entries.n_inside.size):
        first = block * BLOCK
        for k in range(first, first + entries.n_inside[block]):
            cell = entries.cells[k]
            if is_own(cell, owners, owner):
                depth = np.float64(entries.depths_m[k])
                moments[cell, 0] += depth
                moments[cell, 1] += depth * depth


@compiled
def sort_into_cells(
    entries: Entries,
    cursors: NDArray[np.int64],
    sorted_m: NDArray[np.float32],
    owners: int,
    owner: int,
) -> None:
    """Write each depth behind those its cell already holds.

    Args:
        entries: one chunk.
        cursors: (cells,) where the cell's next depth goes; moved on.
        sorted_m: (points inside,) depths grouped by cell.
        owners: a power of two, how many threads share the cells.
        owner: whose cells to visit.
    """
    for block in range(entries.n_inside.size):
        first = block * BLOCK
        for k in range(first, first + entries.n_inside[block]):
            cell = entries.cells[k]
            if not is_own(cell, owners, owner):
                continue
            sorted_m[cursors[cell]] = entries.depths_m[k]
            cursors[cell] += 1


@compiled
def median_depths(
    ends: NDArray[np.int64],
    sorted_m: NDArray[np.float32],
    layer_m: float,
    medians_m: NDArray[np.float32],
    first: int,
    end: int,
) -> None:
    """Median depth of each cell's best supported layer.

    The depths of a cell are split into layers where neighbours in depth lie more than `layer_m`
    apart; the layer with the most points counts, among equals the one nearest the viewer. So no
    depth lies between two surfaces, and a stray point does not matter.

    Args:
        ends: (cells,) end of each cell's depths in `sorted_m`.
        sorted_m: depths grouped by cell; sorted in place.
        layer_m: depth step that separates two layers.
        medians_m: (cells,) metres, overwritten; NaN where the cell is void.
        first: first cell to visit.
        end: the cell after the last one.
    """
    for cell in range(first, end):
        begin = np.int64(0) if cell == 0 else ends[cell - 1]
        if begin == ends[cell]:
            medians_m[cell] = np.nan
        else:
            depths = sorted_m[begin : ends[cell]]
            _sort(depths)
            medians_m[cell] = _layer_median(depths, layer_m)


@compiled
def _sort(values: NDArray[np.float32]) -> None:
    """Shell's sort with gaps of one third: numba's own takes seconds to compile."""
    gap = 1
    while gap < values.size // 3:
        gap = 3 * gap + 1
    while gap > 0:
        for k in range(gap, values.size):
            value = values[k]
            place = k
            while place >= gap and values[place - gap] > value:
                values[place] = values[place - gap]
                place -= gap
            values[place] = value
        gap //= 3


@compiled
def _layer_median(depths: NDArray[np.float32], layer_m: float) -> float:
    best_size, best_first, first = 0, 0, 0
    for k in range(1, depths.size + 1):
        if k == depths.size or depths[k] - depths[k - 1] > layer_m:
            # At least as large: depths ascend, the later layer is nearer to the viewer.
            if k - first >= best_size:
                best_size, best_first = k - first, first
            first = k
    lower = depths[best_first + (best_size - 1) // 2]
    upper = depths[best_first + best_size // 2]
    return float(0.5 * (lower + upper))


@compiled
def add_values(
    entries: Entries,
    values: NDArray[np.generic],
    depths_m: NDArray[np.float32],
    layer_m: float,
    sums: NDArray[np.generic],
    owners: int,
    owner: int,
) -> None:
    """Sum the values of the points that lie on the surface of their cell.

    Args:
        entries: one chunk.
        values: (points of the cloud, channels).
        depths_m: (cells,) the surface.
        layer_m: a point farther than this from the surface belongs to another layer.
        sums: (cells, channels + 1); the last channel counts the points.
        owners: a power of two, how many threads share the cells.
        owner: whose cells to visit.
    """
    channels = values.shape[1]
    for block in range(entries.n_inside.size):
        first = block * BLOCK
        for k in range(first, first + entries.n_inside[block]):
            cell = entries.cells[k]
            if not is_own(cell, owners, owner):
                continue
            if abs(entries.depths_m[k] - depths_m[cell]) > layer_m:
                continue
            for channel in range(channels):
                sums[cell, channel] += values[entries.points[k], channel]
            sums[cell, channels] += 1
