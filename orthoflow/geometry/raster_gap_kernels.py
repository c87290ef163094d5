"""Compiled passes that tell the narrow gaps of a raster from windows, and who lends them values."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.point_kernels import compiled


@compiled
def nearest_within(
    is_measured: NDArray[np.bool_],
    offsets: NDArray[np.int64],
    nearest: NDArray[np.int32],
    first_row: int,
    end_row: int,
) -> None:
    """Find the measured cell nearest to each cell of some rows.

    Args:
        is_measured: (rows, cols); no visited row or column is nearer to the border than the
            largest offset.
        offsets: (k, 2) rows and columns of a disc without its centre, nearest first.
        nearest: (rows, cols) flat indices, written where a measured cell lies within the disc; a
            measured cell is its own nearest.
        first_row: first row to visit.
        end_row: the row after the last one.
    """
    columns = is_measured.shape[1]
    reach = np.abs(offsets).max()
    for row in range(first_row, end_row):
        for column in range(reach, columns - reach):
            if is_measured[row, column]:
                nearest[row, column] = row * columns + column
                continue
            for k in range(offsets.shape[0]):
                r, c = row + offsets[k, 0], column + offsets[k, 1]
                if is_measured[r, c]:
                    nearest[row, column] = r * columns + c
                    break


@compiled
def find_narrow_gaps(
    is_measured: NDArray[np.bool_],
    nearest: NDArray[np.int32],
    offsets: NDArray[np.int64],
    is_narrow: NDArray[np.bool_],
    first_row: int,
    end_row: int,
) -> None:
    """Tell which void cells of some rows no disc covers that fits into the void.

    Args:
        is_measured: (rows, cols).
        nearest: (rows, cols) of `nearest_within` the same disc; -1 where a disc fits.
        offsets: (k, 2) rows and columns of the disc without its centre.
        is_narrow: (rows, cols), made true for such cells.
        first_row: first row to visit, at least twice the disc's radius from the border.
        end_row: the row after the last one.
    """
    columns = nearest.shape[1]
    reach = 2 * np.abs(offsets).max()
    for row in range(first_row, end_row):
        for column in range(reach, columns - reach):
            if is_measured[row, column] or nearest[row, column] < 0:
                continue
            fits = False
            for k in range(offsets.shape[0]):
                if nearest[row + offsets[k, 0], column + offsets[k, 1]] < 0:
                    fits = True
                    break
            is_narrow[row, column] = not fits
