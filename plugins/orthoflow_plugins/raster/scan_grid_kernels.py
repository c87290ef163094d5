"""Compiled passes that carry the surface across void cells between neighbours in a scan's grid."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled
from orthoflow.geometry.point_kernels import Offsets

# A hair outside of a triangle still counts: a centre on an edge belongs to one of two at least.
_ON_EDGE = 1e-9


class ScanGrid(NamedTuple):
    """Points of one scan by their row and column.

    Attributes:
        points: (rows, cols) int64 index in the cloud, -1 where none is.
        offsets: of the cloud.
        wall_from_offset: (3, 4) float64; rows give column, row and depth in metres of an offset.
    """

    points: NDArray[np.int64]
    offsets: Offsets
    wall_from_offset: NDArray[np.float64]


class Reach(NamedTuple):
    """What neighbours may stand for one surface.

    Attributes:
        steps: rows and columns of the scan between them, at most.
        side_cells: their distance on the wall along u and along v, at most.
        step_m: difference of their depths, at most.
    """

    steps: int
    side_cells: float
    step_m: float


class CellValues(NamedTuple):
    """What is recovered, flat over cells; arrays without cells are left alone.

    Attributes:
        depth_m: float32.
        intensity: float32.
        rgb: (cells, 3) uint8.
    """

    depth_m: NDArray[np.float32]
    intensity: NDArray[np.float32]
    rgb: NDArray[np.uint8]


@compiled
def recover_between(
    grid: ScanGrid,
    intensity: NDArray[np.float32],
    rgb: NDArray[np.uint8],
    reach: Reach,
    is_void: NDArray[np.bool_],
    values: CellValues,
) -> None:
    """Fill void cells in triangles of neighbours, linear between them, near neighbours first.

    Args:
        grid: one scan.
        intensity: of the cloud, or without points.
        rgb: of the cloud, or without points.
        reach: what neighbours are.
        is_void: (rows, cols) of the wall; made false where a cell is filled.
        values: written where a cell is filled.
    """
    rows, columns = grid.points.shape
    corners = np.empty((3, 3))
    chosen = np.empty(3, dtype=np.int64)
    for step in range(1, reach.steps + 1):
        for row in range(rows):
            for column in range(columns):
                chosen[0] = grid.points[row, column]
                if chosen[0] < 0:
                    continue
                _place(grid, chosen[0], corners[0])
                # The two halves of a square of four neighbours, each seen from its right angle.
                for side in (step, -step):
                    across, down = column + side, row + side
                    if across < 0 or across >= columns or down < 0 or down >= rows:
                        continue
                    chosen[1] = grid.points[row, across]
                    chosen[2] = grid.points[down, column]
                    if chosen[1] < 0 or chosen[2] < 0:
                        continue
                    _place(grid, chosen[1], corners[1])
                    _place(grid, chosen[2], corners[2])
                    if _is_one_surface(corners, reach):
                        _fill(corners, chosen, intensity, rgb, is_void, values)


@compiled
def _place(grid: ScanGrid, point: int, place: NDArray[np.float64]) -> None:
    """Column, row and depth of a point."""
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
    values: CellValues,
) -> None:
    """Fill the void cells whose centres lie in a triangle."""
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
            is_void[row, column] = False
            cell = row * width + column
            values.depth_m[cell] = a * corners[0, 2] + b * corners[1, 2] + c * corners[2, 2]
            p, q, r = chosen
            if values.intensity.size:
                values.intensity[cell] = a * intensity[p] + b * intensity[q] + c * intensity[r]
            if values.rgb.size:
                for band in range(3):
                    mixed = a * rgb[p, band] + b * rgb[q, band] + c * rgb[r, band]
                    values.rgb[cell, band] = np.uint8(min(255.0, max(0.0, mixed + 0.5)))
