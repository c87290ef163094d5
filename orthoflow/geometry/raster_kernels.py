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
    u, v, depth = np.empty(_LANE), np.empty(_LANE), np.empty(_LANE)
    is_inside = np.empty(_LANE, dtype=np.bool_)
    slot = begin = block * BLOCK
    for lane in range(begin, min(x.size, begin + BLOCK), _LANE):
        part = slice(lane, min(x.size, begin + BLOCK, lane + _LANE))
        _transform(x[part], y[part], z[part], target, (u, v, depth), is_inside)
        for k in range(part.stop - part.start):
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


@njit(cache=True)
def _transform(
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    z: NDArray[np.float32],
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
    for k in range(x.size):
        # float64 on purpose: the pass waits for memory, not for arithmetic.
        px, py, pz = np.float64(x[k]), np.float64(y[k]), np.float64(z[k])
        u = u0 * px + u1 * py + u2 * pz + u3
        v = v0 * px + v1 * py + v2 * pz + v3
        depth = d0 * px + d1 * py + d2 * pz + d3
        us[k], vs[k], depths[k] = u, v, depth
        is_in_raster = (u >= 0.0) & (u < width) & (v >= 0.0) & (v < height)
        is_inside[k] = is_in_raster & (depth >= behind_m) & (depth <= front_m)


@njit(parallel=True, cache=True)
def keep_topmost(entries: Entries, winners: NDArray[np.void], owners: int) -> None:
    """Let the largest depth win; ties go to the point nearer the centre, then the lower index.

    Args:
        entries: one chunk.
        winners: (cells,) of `WINNER`, updated; depths start at minus infinity.
        owners: a power of two, how many threads share the cells.
    """
    for owner in prange(owners):
        _keep_topmost_of(entries, winners, owners, owner)


@njit(cache=True)
def _keep_topmost_of(entries: Entries, winners: NDArray[np.void], owners: int, owner: int) -> None:
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


@njit(parallel=True, cache=True)
def keep_nearest(entries: Entries, winners: NDArray[np.void], owners: int) -> None:
    """Let the point nearest the centre of the cell win; ties go to the lower index.

    Args:
        entries: one chunk.
        winners: (cells,) of `WINNER`, updated; squares start at infinity.
        owners: a power of two, how many threads share the cells.
    """
    for owner in prange(owners):
        _keep_nearest_of(entries, winners, owners, owner)


@njit(cache=True)
def _keep_nearest_of(entries: Entries, winners: NDArray[np.void], owners: int, owner: int) -> None:
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


@njit(parallel=True, cache=True)
def count_points(entries: Entries, n_points: NDArray[np.uint32], owners: int) -> None:
    """Count the points of each cell."""
    for owner in prange(owners):
        _count_points_of(entries, n_points, owners, owner)


@njit(cache=True)
def _count_points_of(
    entries: Entries, n_points: NDArray[np.uint32], owners: int, owner: int
) -> None:
    for block in range(entries.n_inside.size):
        first = block * BLOCK
        for k in range(first, first + entries.n_inside[block]):
            cell = entries.cells[k]
            if (cell >> _RUN_SHIFT) & (owners - 1) == owner:
                n_points[cell] += np.uint32(1)


@njit(parallel=True, cache=True)
def add_moments(entries: Entries, moments: NDArray[np.float64], owners: int) -> None:
    """Sum depths and squared depths of each cell into `moments` (cells, 2)."""
    for owner in prange(owners):
        _add_moments_of(entries, moments, owners, owner)


@njit(cache=True)
def _add_moments_of(
    entries: Entries, moments: NDArray[np.float64], owners: int, owner: int
) -> None:
    for block in range(entries.n_inside.size):
        first = block * BLOCK
        for k in range(first, first + entries.n_inside[block]):
            cell = entries.cells[k]
            if (cell >> _RUN_SHIFT) & (owners - 1) == owner:
                depth = np.float64(entries.depths_m[k])
                moments[cell, 0] += depth
                moments[cell, 1] += depth * depth


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
    """Median depth of each cell's best supported layer.

    The depths of a cell are split into layers where neighbours in depth lie more than `layer_m`
    apart; the layer with the most points counts, among equals the one nearest the viewer. So no
    depth lies between two surfaces, and a stray point does not matter.

    Args:
        ends: (cells,) end of each cell's depths in `sorted_m`.
        sorted_m: depths grouped by cell; sorted in place.
        layer_m: depth step that separates two layers.

    Returns:
        (cells,) metres, NaN where the cell is void.
    """
    medians_m = np.empty(ends.size, dtype=np.float32)
    for cell in prange(ends.size):
        begin = np.int64(0) if cell == 0 else ends[cell - 1]
        if begin == ends[cell]:
            medians_m[cell] = np.nan
        else:
            depths = sorted_m[begin : ends[cell]]
            depths.sort()
            medians_m[cell] = _layer_median(depths, layer_m)
    return medians_m


@njit(cache=True)
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
