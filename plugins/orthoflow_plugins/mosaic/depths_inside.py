"""Distances of cells from the border of the area that a layer paints, some rows at a time.

Distances are exact (Meijster 2000): first along the columns, into a file, then along each row over
the parabolas above the columns. OpenCV needs the whole wall in memory.
"""

from __future__ import annotations

from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.bands import Allocate
from orthoflow.geometry.compiling import compiled, kernel_part
from orthoflow.geometry.threads import in_parts
from orthoflow.products import LayerMask

# Rows are shared by two threads: those of a band wait for the file.
_THREADS: Final = 2


def column_distances(mask: NDArray[np.uint8], name: str, allocate: Allocate) -> NDArray[np.uint32]:
    """Return distances (rows, cols) along the column to unpainted cells, or to the border.

    Args:
        mask: (rows, cols) `LayerMask`.
        name: of the array that is allocated.
        allocate: returns it.
    """
    distances = np.asarray(allocate(name, mask.shape, np.uint32), np.uint32)
    before = np.zeros(mask.shape[1], dtype=np.uint32)
    for row in range(mask.shape[0]):
        before = np.where(mask[row] == LayerMask.PAINTED, before + np.uint32(1), np.uint32(0))
        distances[row] = before
    before = np.zeros(mask.shape[1], dtype=np.uint32)
    for row in range(mask.shape[0] - 1, -1, -1):
        before = np.minimum(distances[row], before + np.uint32(1))
        distances[row] = before
    return distances


def depths_inside(distances: NDArray[np.uint32], rows: slice) -> NDArray[np.float32]:
    """Return distances in cells to the nearest cell that a layer does not paint, or to the border.

    Args:
        distances: (rows, cols) from `column_distances`.
        rows: the requested rows.
    """
    part = np.ascontiguousarray(distances[rows]).view(np.ndarray)
    depths = np.empty(part.shape, dtype=np.float32)
    in_parts(partial(look_along_rows, part, depths), len(part), threads=_THREADS)
    return depths


@compiled
def look_along_rows(
    distances: NDArray[np.uint32], depths: NDArray[np.float32], first: int, end: int
) -> None:
    """Set the distances of some rows.

    Args:
        distances: (rows, cols) along the columns.
        depths: (rows, cols), overwritten.
        first: first row to visit.
        end: the row after the last one.
    """
    width = distances.shape[1]
    # With the border on either side.
    squares = np.zeros(width + 2, dtype=np.int64)
    lowest = np.zeros(width + 2, dtype=np.int64)
    starts = np.zeros(width + 2, dtype=np.int64)
    for row in range(first, end):
        for column in range(width):
            distance = np.int64(distances[row, column])
            squares[column + 1] = distance * distance
        last = _lowest_parabolas(squares, lowest, starts)
        for column in range(width, 0, -1):
            while starts[last] > column:
                last -= 1
            across = column - lowest[last]
            depths[row, column - 1] = np.sqrt(np.float32(across * across + squares[lowest[last]]))


@kernel_part
def _lowest_parabolas(
    squares: NDArray[np.int64], lowest: NDArray[np.int64], starts: NDArray[np.int64]
) -> int:
    """Find which of the parabolas above the columns are lowest, and from which column on.

    Args:
        squares: (columns,) height of the parabola over a column.
        lowest: (columns,) columns of the lowest parabolas, overwritten up to the last one.
        starts: (columns,) first column where each of them is the lowest; likewise.

    Returns:
        Index of the last one.
    """
    last = 0
    lowest[0], starts[0] = 0, 0
    for column in range(1, squares.size):
        begin = 0
        while last >= 0:
            other = lowest[last]
            apart = column * column - other * other + squares[column] - squares[other]
            # Beyond it this parabola is lower than the other one.
            begin = 1 + apart // (2 * (column - other))
            if begin > starts[last]:
                break
            begin = 0
            last -= 1
        if begin < squares.size:
            last += 1
            lowest[last], starts[last] = column, begin
    return last
