"""Compiled passes that interpolate void cells between neighbours in a scan's grid."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled
from orthoflow.geometry.interpolation import CellValues
from orthoflow.geometry.point_kernels import Offsets

# Slightly outside of a triangle still counts: a centre on an edge belongs to at least one of two.
_ON_EDGE = 1e-9


class ScanGrid(NamedTuple):
    """Points of one scan by row and column.

    Attributes:
        points: (rows, cols) int64 index in the cloud, -1 without one.
        offsets: of the cloud.
        wall_from_offset: (3, 4) float64; rows give column, row and depth in metres of an offset.
    """

    points: NDArray[np.int64]
    offsets: Offsets
    wall_from_offset: NDArray[np.float64]


class Reach(NamedTuple):
    """Limits for neighbours on one surface.

    Attributes:
        step: rows and columns of the scan between them.
        side_cells: maximum distance on the wall along u and along v.
        step_m: maximum difference of their depths.
    """

    step: int
    side_cells: float
    step_m: float


class Sums(NamedTuple):
    """Sums over the triangles that cover cells, flat over cells.

    Attributes:
        n: uint16 number of triangles.
        depth_m: float32.
        intensity: float32.
        rgb: (cells, 3) float32.
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
    """Add the triangles of neighbours to void cells, interpolated linearly.

    A square of four neighbours is cut along both of its diagonals, so that both have equal weight.

    Args:
        grid: one scan.
        intensity: of the cloud, or empty.
        rgb: of the cloud, or empty.
        reach: limits for neighbours.
        is_void: (rows, cols) of the wall.
        sums: added to.
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
            # The four squares around a point, of each the half with its right angle there.
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


@compiled
def take_means(
    cells: NDArray[np.int64], sums: Sums, is_void: NDArray[np.bool_], values: CellValues
) -> None:
    """Set some void cells to the mean of the triangles that cover them, if any.

    Args:
        cells: flat indices.
        sums: of the triangles.
        is_void: (cells,), cleared where a cell is filled.
        values: written where a cell is filled.
    """
    for cell in cells:
        n = sums.n[cell]
        if n == 0:
            continue
        is_void[cell] = False
        values.depth_m[cell] = sums.depth_m[cell] / n
        if values.intensity.size:
            values.intensity[cell] = sums.intensity[cell] / n
        if values.rgb.size:
            for band in range(3):
                shade = sums.rgb[cell, band] / n
                values.rgb[cell, band] = np.uint8(min(255.0, max(0.0, shade + 0.5)))


@compiled
def _place(grid: ScanGrid, point: int, place: NDArray[np.float64]) -> None:
    """Return column, row and depth of a point."""
    offsets = grid.offsets
    x, y, z = offsets.x[point], offsets.y[point], offsets.z[point]
    m = grid.wall_from_offset
    for axis in range(3):
        place[axis] = m[axis, 0] * x + m[axis, 1] * y + m[axis, 2] * z + m[axis, 3]


@compiled
def _is_one_surface(corners: NDArray[np.float64], reach: Reach) -> bool:
    for axis in range(3):
        a, b, c = corners[0, axis], corners[1, axis], corners[2, axis]
        most = reach.step_m if axis == 2 else reach.side_cells
        if max(a, b, c) - min(a, b, c) > most:
            return False
    return True


@compiled
def _fill(
    corners: NDArray[np.float64],
    chosen: NDArray[np.int64],
    intensity: NDArray[np.float32],
    rgb: NDArray[np.uint8],
    is_void: NDArray[np.bool_],
    sums: Sums,
) -> None:
    """Add a triangle to the void cells whose centres are in it."""
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
