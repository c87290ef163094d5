"""Compiled passes that lay points into the cells of a raster.

A pass works on one chunk of the cloud after the other. `project_points` transforms a chunk and
keeps what falls into the raster, in the order of the points; the other passes then run over the
kept entries, each thread on the cells it owns. Every cell is therefore visited in the order of the
points whatever the number of threads, and no result depends on it, sums of floats included.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.point_kernels import Offsets, compiled

# Points handled by one task; an entry slot exists for each, so that tasks never wait for another.
BLOCK: Final = 8192
# Points transformed together; their positions stay in the first-level cache.
_LANE: Final = 512
# Cells are dealt out to threads in runs of 2^17, some dozens of rows: a scan runs along columns or
# rows, and a thread that meets its own points in long runs is not slowed by the others'.
_RUN_SHIFT: Final = 17
NO_POINT: Final = np.uint32(0xFFFFFFFF)
# One cell in one record: a scan along columns touches another row of the raster with every point,
# and one cache line for each is what the passes wait for.
WINNER: Final = np.dtype([("depth_m", "f4"), ("square", "f4"), ("point", "u4"), ("n_points", "u4")])


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
    u, v, depth = np.empty(_LANE), np.empty(_LANE), np.empty(_LANE)
    is_inside = np.empty(_LANE, dtype=np.bool_)
    for block in range(first_block, end_block):
        slot = begin = block * BLOCK
        end = min(offsets.x.size, begin + BLOCK)
        for lane in range(begin, end, _LANE):
            n_lane = min(_LANE, end - lane)
            _transform(offsets, lane, n_lane, target, (u, v, depth), is_inside)
            for k in range(n_lane):
                if not is_inside[k]:
                    continue
                column, row = np.int32(u[k]), np.int32(v[k])
                du, dv = u[k] - column - 0.5, v[k] - row - 0.5
                entries.cells[slot] = row * target.width + column
                entries.depths_m[slot] = depth[k]
                entries.squares[slot] = du * du + dv * dv
                entries.points[slot] = first + lane + k
                slot += 1
        entries.n_inside[block] = slot - begin


@compiled
def _transform(
    offsets: Offsets,
    first: int,
    n_points: int,
    target: Target,
    position: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
    is_inside: NDArray[np.bool_],
) -> None:
    """Transform at most `_LANE` points; without branches, so that it vectorises."""
    us, vs, depths = position
    m = target.wall_from_offset
    u0, u1, u2, u3 = m[0, 0], m[0, 1], m[0, 2], m[0, 3]
    v0, v1, v2, v3 = m[1, 0], m[1, 1], m[1, 2], m[1, 3]
    d0, d1, d2, d3 = m[2, 0], m[2, 1], m[2, 2], m[2, 3]
    behind_m, front_m = target.behind_m, target.front_m
    width, height = np.float64(target.width), np.float64(target.height)
    x, y, z = offsets.x[first:], offsets.y[first:], offsets.z[first:]
    for k in range(n_points):
        # float64 on purpose: the pass waits for memory, not for arithmetic.
        px, py, pz = np.float64(x[k]), np.float64(y[k]), np.float64(z[k])
        u = u0 * px + u1 * py + u2 * pz + u3
        v = v0 * px + v1 * py + v2 * pz + v3
        depth = d0 * px + d1 * py + d2 * pz + d3
        us[k], vs[k], depths[k] = u, v, depth
        is_in_raster = (u >= 0.0) & (u < width) & (v >= 0.0) & (v < height)
        is_inside[k] = is_in_raster & (depth >= behind_m) & (depth <= front_m)


@compiled
def keep_topmost(entries: Entries, winners: NDArray[np.void], owners: int, owner: int) -> None:
    """Let the largest depth win; ties go to the point nearer the centre, then the lower index.

    Args:
        entries: one chunk.
        winners: (cells,) of `WINNER`, updated; depths start at minus infinity.
        owners: a power of two, how many threads share the cells.
        owner: whose cells to visit.
    """
    for block in range(entries.n_inside.size):
        first = block * BLOCK
        for k in range(first, first + entries.n_inside[block]):
            cell = entries.cells[k]
            if (cell >> _RUN_SHIFT) & (owners - 1) != owner:
                continue
            winner = winners[cell]
            winner.n_points += np.uint32(1)
            depth = entries.depths_m[k]
            is_tie = depth == winner.depth_m
            if depth > winner.depth_m or (is_tie and entries.squares[k] < winner.square):
                winner.depth_m = depth
                winner.square = entries.squares[k]
                winner.point = entries.points[k]


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
            if (cell >> _RUN_SHIFT) & (owners - 1) != owner:
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
                    if (place >> _RUN_SHIFT) & (owners - 1) != owner:
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
            if (cell >> _RUN_SHIFT) & (owners - 1) == owner:
                n_points[cell] += np.uint32(1)


@compiled
def add_moments(entries: Entries, moments: NDArray[np.float64], owners: int, owner: int) -> None:
    """Sum depths and squared depths of each cell into `moments` (cells, 2)."""
    for block in range(entries.n_inside.size):
        first = block * BLOCK
        for k in range(first, first + entries.n_inside[block]):
            cell = entries.cells[k]
            if (cell >> _RUN_SHIFT) & (owners - 1) == owner:
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
            if (cell >> _RUN_SHIFT) & (owners - 1) != owner:
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
            if (cell >> _RUN_SHIFT) & (owners - 1) != owner:
                continue
            if abs(entries.depths_m[k] - depths_m[cell]) > layer_m:
                continue
            for channel in range(channels):
                sums[cell, channel] += values[entries.points[k], channel]
            sums[cell, channels] += 1
