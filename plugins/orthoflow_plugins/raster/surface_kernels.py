"""Compiled passes that compute the surface of a wall from the points of each cell.

They run over the entries of `raster_kernels`, each thread on the cells it owns.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled
from orthoflow.geometry.point_kernels import Offsets
from orthoflow.geometry.raster_kernels import BLOCK, Entries, is_own

# With more points the mean is near the centre of the cell. With few it may be off, and over many
# cells in the same way: by up to half a point spacing if the cell is a multiple of it.
FEW_POINTS: Final = 16


class FewPoints(NamedTuple):
    """Positions of the points of cells with few of them, all flat over cells.

    Attributes:
        n_inside: points in each cell.
        depths_m: the surface.
        layer_m: a point farther than this from the surface belongs to another layer.
        n_summed: uint8, points on the surface in cells with few points.
        places: (cells, 2) float32, sum of their positions right of and below the centre, in cells.
    """

    n_inside: NDArray[np.uint32]
    depths_m: NDArray[np.float32]
    layer_m: float
    n_summed: NDArray[np.uint8]
    places: NDArray[np.float32]


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
        winners: (cells,) of `WINNER`, updated; points count in their own cell.
        width: columns of the raster.
        owners: number of threads that share the cells, a power of two.
        owner: the thread whose cells to visit.
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
    first_cell: int,
    cursors: NDArray[np.int64],
    sorted_m: NDArray[np.float32],
    owners: int,
    owner: int,
) -> None:
    """Append each depth to those of its cell.

    Args:
        entries: one chunk.
        first_cell: first of the requested cells; points in others are skipped.
        cursors: (requested cells,) where the cell's next depth goes; advanced.
        sorted_m: (points inside,) depths grouped by cell.
        owners: number of threads that share the cells, a power of two.
        owner: the thread whose cells to visit.
    """
    for block in range(entries.n_inside.size):
        first = block * BLOCK
        for k in range(first, first + entries.n_inside[block]):
            cell = entries.cells[k]
            place = cell - first_cell
            if not (0 <= place < cursors.size and is_own(cell, owners, owner)):
                continue
            sorted_m[cursors[place]] = entries.depths_m[k]
            cursors[place] += 1


@compiled
def median_depths(
    ends: NDArray[np.int64],
    sorted_m: NDArray[np.float32],
    layer_m: float,
    medians_m: NDArray[np.float32],
    first: int,
    end: int,
) -> None:
    """Set the median depth of each cell's best supported layer.

    The depths of a cell are split into layers at differences of more than `layer_m`; the layer with
    the most points is used, among equals the one nearest the viewer. So no depth is between two
    surfaces, and a stray point does not matter.

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
    best_size, best_first, first = 1, 0, 0
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
def add_values(  # noqa: PLR0913, PLR0917
    entries: Entries,
    values: NDArray[np.generic],
    has_value: NDArray[np.bool_],
    depths_m: NDArray[np.float32],
    layer_m: float,
    sums: NDArray[np.generic],
    owners: int,
    owner: int,
) -> None:
    """Sum the values of the points on the surface of their cell.

    Args:
        entries: one chunk.
        values: (points of the cloud, channels); points whose first channel is NaN are ignored.
        has_value: (points of the cloud,) which points to use, or empty: all.
        depths_m: (cells,) the surface.
        layer_m: a point farther than this from the surface belongs to another layer.
        sums: (cells, channels + 1); the last channel counts the points.
        owners: number of threads that share the cells, a power of two.
        owner: the thread whose cells to visit.
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
            point = entries.points[k]
            if has_value.size and not has_value[point]:
                continue
            if values[point, 0] != values[point, 0]:
                continue
            for channel in range(channels):
                sums[cell, channel] += values[point, channel]
            sums[cell, channels] += 1


@compiled
def add_places(
    entries: Entries,
    offsets: Offsets,
    wall_from_offset: NDArray[np.float64],
    few: FewPoints,
    owners: int,
    owner: int,
) -> None:
    """Sum the positions of the points on the surface, of cells with few points.

    Args:
        entries: one chunk.
        offsets: of the whole cloud.
        wall_from_offset: (3, 4) as in `Target`.
        few: added to.
        owners: number of threads that share the cells, a power of two.
        owner: the thread whose cells to visit.
    """
    m = wall_from_offset
    for block in range(entries.n_inside.size):
        first = block * BLOCK
        for k in range(first, first + entries.n_inside[block]):
            cell = entries.cells[k]
            if not is_own(cell, owners, owner) or few.n_inside[cell] > FEW_POINTS:
                continue
            # A void cell has no surface; its depth is NaN.
            if not abs(entries.depths_m[k] - few.depths_m[cell]) <= few.layer_m:
                continue
            point = entries.points[k]
            x, y, z = float(offsets.x[point]), float(offsets.y[point]), float(offsets.z[point])
            u = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]
            v = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]
            few.places[cell, 0] += u - math.floor(u) - 0.5
            few.places[cell, 1] += v - math.floor(v) - 0.5
            few.n_summed[cell] += np.uint8(1)


@compiled
def find_mean_places(few: FewPoints, first: int, end: int) -> None:
    """Turn the sums of some cells into means: NaN without a point, 0 in cells with many."""
    for cell in range(first, end):
        if few.n_inside[cell] <= FEW_POINTS:
            for axis in range(2):
                few.places[cell, axis] /= np.float32(few.n_summed[cell])
