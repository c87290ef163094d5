"""Kernels that compute the surface of a wall from points and close gaps between points.

Kernels with the arguments `owners` and `owner` process the entries of `geometry.rastering`. They
run in all threads; each thread processes the cells that it owns.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part
from orthoflow.geometry.rastering import Entries, is_own
from orthoflow.geometry.slabs import Offsets

# Maximum number of points in a cell with few points. The mean position of more points is near the
# centre of the cell. The mean position of few points may be off by up to half a point spacing, in
# the same direction in many cells if the cell size is a multiple of the spacing.
FEW_POINTS: Final = 16
# Tolerance outside a triangle, so that the centre of a cell on an edge is in at least one triangle.
_ON_EDGE: Final = 1e-9


class FewPoints(NamedTuple):
    """Positions of points in cells with few points; the first axis of all arrays is the cell.

    Attributes:
        n_inside: number of points.
        depths_m: depth of the surface in metres.
        layer_m: points whose depth differs from the surface by more than this, in metres, belong to
            another layer.
        n_summed: uint8 number of points on the surface; only for cells with few points.
        places: (cells, 2) float32 sums of the positions of these points to the right of and below
            the centre of the cell, in cells.
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
    """Select the point nearest to the centre of each cell, in the cell and its eight neighbours.

    Args:
        entries: one chunk.
        offsets: points of the whole cloud.
        wall_from_offset: (3, 4) as in `Target`.
        winners: (cells,) of `WINNER`, updated; `n_points` counts only points inside a cell.
        width: columns of the raster.
        owners: number of threads that share the cells, a power of two.
        owner: the thread whose cells are visited.
    """
    m = wall_from_offset
    height = winners.size // width
    for k in range(entries.cells.size):
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
def add_moments(
    entries: Entries,
    n_points: NDArray[np.uint32],
    moments: NDArray[np.float64],
    owners: int,
    owner: int,
) -> None:
    """Add up the numbers of points (cells,), and depths and squared depths (cells, 2)."""
    for k in range(entries.cells.size):
        cell = entries.cells[k]
        if is_own(cell, owners, owner):
            depth = np.float64(entries.depths_m[k])
            n_points[cell] += np.uint32(1)
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
    """Write the depths of points to `sorted_m`, grouped by cell.

    Args:
        entries: one chunk.
        first_cell: first of the requested cells; points in other cells are skipped.
        cursors: (requested cells,) index of the next depth of each cell; incremented.
        sorted_m: (points inside,) depths grouped by cell.
        owners: number of threads that share the cells, a power of two.
        owner: the thread whose cells are visited.
    """
    for k in range(entries.cells.size):
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
    """Set the median depth of each cell, using only the layer with the most points.

    The depths of a cell are divided into layers where consecutive depths differ by more than
    `layer_m`. If several layers have the most points, the one nearest to the viewer is used.
    Medians are therefore never between two surfaces, and stray points have no influence.

    Args:
        ends: (cells,) index after the last depth of each cell in `sorted_m`.
        sorted_m: depths grouped by cell; sorted in place.
        layer_m: depth step that separates two layers.
        medians_m: (cells,) metres, overwritten; NaN if the cell is void.
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


@kernel_part
def _sort(values: NDArray[np.float32]) -> None:
    """Sort by Shell's method with gap ratio 3, since numba's sort takes seconds to compile."""
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


@kernel_part
def _layer_median(depths: NDArray[np.float32], layer_m: float) -> float:
    best_size, best_first, first = 1, 0, 0
    for k in range(1, depths.size + 1):
        if k == depths.size or depths[k] - depths[k - 1] > layer_m:
            # `>=` selects the last layer, which is nearest to the viewer because depths are
            # ascending.
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
    """Sum the values of points on the surface of their cells.

    Args:
        entries: one chunk.
        values: (points of the cloud, channels); points whose first channel is NaN are ignored.
        has_value: (points of the cloud,) True for points to use; empty to use all.
        depths_m: (cells,) depth of the surface in metres.
        layer_m: points whose depth differs from the surface by more than this belong to another
            layer.
        sums: (cells, channels + 1); the last channel counts the points.
        owners: number of threads that share the cells, a power of two.
        owner: the thread whose cells are visited.
    """
    channels = values.shape[1]
    for k in range(entries.cells.size):
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
    """Sum the positions of points on the surface, in cells with few points.

    Args:
        entries: one chunk.
        offsets: points of the whole cloud.
        wall_from_offset: (3, 4) as in `Target`.
        few: sums of positions, updated.
        owners: number of threads that share the cells, a power of two.
        owner: the thread whose cells are visited.
    """
    m = wall_from_offset
    for k in range(entries.cells.size):
        cell = entries.cells[k]
        if not is_own(cell, owners, owner) or few.n_inside[cell] > FEW_POINTS:
            continue
        # `not ... <=` also skips void cells, whose depth is NaN.
        if not abs(entries.depths_m[k] - few.depths_m[cell]) <= few.layer_m:
            continue
        point = entries.points[k]
        x, y, z = float(offsets.x[point]), float(offsets.y[point]), float(offsets.z[point])
        u = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]
        v = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]
        few.places[cell, 0] += u - math.floor(u) - 0.5
        few.places[cell, 1] += v - math.floor(v) - 0.5
        few.n_summed[cell] += np.uint8(1)


class ScanGrid(NamedTuple):
    """Points of one scan by row and column.

    Attributes:
        points: (rows, cols) int64 index in the cloud; -1 if there is no point.
        offsets: points of the cloud.
        wall_from_offset: (3, 4) float64 transform from offsets in metres to (column, row, depth in
            metres).
    """

    points: NDArray[np.int64]
    offsets: Offsets
    wall_from_offset: NDArray[np.float64]


class Reach(NamedTuple):
    """Limits within which neighbouring points of a scan are assumed to be on the same surface.

    Attributes:
        step: distance between neighbours in rows or columns of the scan.
        side_cells: maximum distance on the wall along u and along v, in cells.
        step_m: maximum difference between their depths, in metres.
    """

    step: int
    side_cells: float
    step_m: float


class Sums(NamedTuple):
    """Sums over the triangles that cover each cell, in row order of the cells.

    Attributes:
        n: uint16 number of triangles.
        depth_m: float32 sum of depths.
        intensity: float32 sum of intensities.
        rgb: (cells, 3) float32 sums of colours.
    """

    n: NDArray[np.uint16]
    depth_m: NDArray[np.float32]
    intensity: NDArray[np.float32]
    rgb: NDArray[np.float32]


@compiled
def recover_between(
    grid: ScanGrid,
    intensity: NDArray[np.float32],
    rgb: NDArray[np.uint8],
    reach: Reach,
    is_void: NDArray[np.bool_],
    sums: Sums,
) -> None:
    """Interpolate void cells linearly in triangles of neighbouring points, and sum the values.

    Each square of four neighbours is divided along both diagonals, and the two divisions have equal
    weight.

    Args:
        grid: points of a scan.
        intensity: intensities of the cloud, or empty.
        rgb: colours of the cloud, or empty.
        reach: limits for neighbours.
        is_void: (rows, cols) True for void cells of the wall.
        sums: updated.
    """
    rows, columns = grid.points.shape
    step = reach.step
    corners = np.empty((3, 3))
    chosen = np.empty(3, dtype=np.int64)
    for row in range(rows):
        for column in range(columns):
            chosen[0] = grid.points[row, column]
            if chosen[0] < 0:
                continue
            _place(grid, chosen[0], corners[0])
            # In each of the four squares around a point, use the triangle with its right angle at
            # the point.
            for quarter in range(4):
                across = column + (step if quarter % 2 else -step)
                down = row + (step if quarter // 2 else -step)
                if not (0 <= across < columns and 0 <= down < rows):
                    continue
                chosen[1] = grid.points[row, across]
                chosen[2] = grid.points[down, column]
                if chosen[1] < 0 or chosen[2] < 0:
                    continue
                _place(grid, chosen[1], corners[1])
                _place(grid, chosen[2], corners[2])
                if _is_one_surface(corners, reach):
                    _fill(corners, chosen, intensity, rgb, is_void, sums)


@kernel_part
def _place(grid: ScanGrid, point: int, place: NDArray[np.float64]) -> None:
    """Set `place` to the column, the row and the depth in metres of a point."""
    offsets = grid.offsets
    x, y, z = offsets.x[point], offsets.y[point], offsets.z[point]
    m = grid.wall_from_offset
    for axis in range(3):
        place[axis] = m[axis, 0] * x + m[axis, 1] * y + m[axis, 2] * z + m[axis, 3]


@kernel_part
def _is_one_surface(corners: NDArray[np.float64], reach: Reach) -> bool:
    for axis in range(3):
        a, b, c = corners[0, axis], corners[1, axis], corners[2, axis]
        most = reach.step_m if axis == 2 else reach.side_cells
        if max(a, b, c) - min(a, b, c) > most:
            return False
    return True


@kernel_part
def _fill(
    corners: NDArray[np.float64],
    chosen: NDArray[np.int64],
    intensity: NDArray[np.float32],
    rgb: NDArray[np.uint8],
    is_void: NDArray[np.bool_],
    sums: Sums,
) -> None:
    """Add the values of a triangle to the sums of void cells whose centres are inside it."""
    ax, ay, bx, by = corners[0, 0], corners[0, 1], corners[1, 0], corners[1, 1]
    cx, cy = corners[2, 0], corners[2, 1]
    area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    if area == 0.0:
        return
    height, width = is_void.shape
    first_row = max(0, int(np.ceil(min(ay, by, cy) - 0.5)))
    end_row = min(height, int(np.floor(max(ay, by, cy) - 0.5)) + 1)
    first_column = max(0, int(np.ceil(min(ax, bx, cx) - 0.5)))
    end_column = min(width, int(np.floor(max(ax, bx, cx) - 0.5)) + 1)
    for row in range(first_row, end_row):
        for column in range(first_column, end_column):
            if not is_void[row, column]:
                continue
            x, y = column + 0.5 - ax, row + 0.5 - ay
            b = (x * (cy - ay) - (cx - ax) * y) / area
            c = ((bx - ax) * y - x * (by - ay)) / area
            a = 1.0 - b - c
            if a < -_ON_EDGE or b < -_ON_EDGE or c < -_ON_EDGE:
                continue
            cell = row * width + column
            sums.n[cell] += np.uint16(1)
            sums.depth_m[cell] += a * corners[0, 2] + b * corners[1, 2] + c * corners[2, 2]
            p, q, r = chosen
            if sums.intensity.size:
                sums.intensity[cell] += a * intensity[p] + b * intensity[q] + c * intensity[r]
            if sums.rgb.size:
                for band in range(3):
                    sums.rgb[cell, band] += a * rgb[p, band] + b * rgb[q, band] + c * rgb[r, band]
