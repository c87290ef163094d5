"""What cells of a raster have around them: sums of neighbours, and gaps closed.

As shifted additions of whole arrays: the filters of libraries ask each cell by itself, which on the
small rasters of hundreds of candidates costs more than all else.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def summed_around(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Sum each value of an array of any dimension with those beside it, also across corners."""
    for axis in range(values.ndim):
        along = np.moveaxis(values, axis, 0)
        total = values.copy()
        sums = np.moveaxis(total, axis, 0)
        sums[1:] += along[:-1]
        sums[:-1] += along[1:]
        values = total
    return values


def closed(cells: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """Close gaps of up to twice a reach between cells (rows, columns)."""
    rows, columns = cells.shape
    wide = np.zeros((rows + 4 * reach, columns + 4 * reach), dtype=bool)
    wide[2 * reach : 2 * reach + rows, 2 * reach : 2 * reach + columns] = cells
    return ~_any_in_windows(~_any_in_windows(wide, reach), reach)


def _any_in_windows(cells: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """Whether any cell is set in each square window that lies within the raster."""
    rows, columns = (size - 2 * reach for size in cells.shape)
    down = cells[:rows].copy()
    for shift in range(1, 2 * reach + 1):
        down |= cells[shift : shift + rows]
    across = down[:, :columns].copy()
    for shift in range(1, 2 * reach + 1):
        across |= down[:, shift : shift + columns]
    return across
