"""Compiled passes that tell narrow gaps of a raster from windows, and find who lends them values."""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray


@njit(parallel=True, cache=True)
def nearest_within(
    is_measured: NDArray[np.bool_], offsets: NDArray[np.int64], reach: int
) -> NDArray[np.int32]:
    """Flat index of the measured cell nearest to each cell, -1 without one within the disc.

    Args:
        is_measured: (rows, cols), framed by `reach` cells whose own result stays -1.
        offsets: (k, 2) rows and columns of a disc without its centre, nearest first.
        reach: largest offset.

    Returns:
        (rows, cols); a measured cell is its own nearest.
    """
    rows, columns = is_measured.shape
    nearest = np.full((rows, columns), -1, dtype=np.int32)
    for row in prange(reach, rows - reach):
        for column in range(reach, columns - reach):
            if is_measured[row, column]:
                nearest[row, column] = row * columns + column
                continue
            for k in range(offsets.shape[0]):
                r, c = row + offsets[k, 0], column + offsets[k, 1]
                if is_measured[r, c]:
                    nearest[row, column] = r * columns + c
                    break
    return nearest


@njit(parallel=True, cache=True)
def is_narrow_gap(
    is_measured: NDArray[np.bool_], nearest: NDArray[np.int32], offsets: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Whether a cell is void and no disc that covers it fits into the void around it.

    Args:
        is_measured: (rows, cols), framed by twice the disc's radius.
        nearest: (rows, cols) of `nearest_within` the same disc; -1 where a disc fits.
        offsets: (k, 2) rows and columns of the disc without its centre.
    """
    rows, columns = is_measured.shape
    reach = 2 * np.abs(offsets).max()
    is_narrow = np.zeros((rows, columns), dtype=np.bool_)
    for row in prange(reach, rows - reach):
        for column in range(reach, columns - reach):
            if is_measured[row, column] or nearest[row, column] < 0:
                continue
            fits = False
            for k in range(offsets.shape[0]):
                if nearest[row + offsets[k, 0], column + offsets[k, 1]] < 0:
                    fits = True
                    break
            is_narrow[row, column] = not fits
    return is_narrow
