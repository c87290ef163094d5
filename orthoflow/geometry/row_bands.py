"""Rasters looked at some rows at a time: a large one lies in a file and never wholly in memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final

import numpy as np
from numpy.typing import DTypeLike, NDArray

# Name, shape, type -> zeroed array, in a file that is mapped into memory where it is large.
Allocate = Callable[[str, tuple[int, ...], DTypeLike], NDArray[np.generic]]

# What is made of a band for a moment takes some 16 MB a byte.
_BAND_CELLS: Final = 1 << 24


def row_bands(shape: tuple[int, ...], *, multiple: int = 1) -> Iterator[slice]:
    """Cut a raster into bands of rows.

    Args:
        shape: rows, columns, and what else a cell holds.
        multiple: all bands but the last have a multiple of so many rows.

    Yields:
        Rows of a band, from the top.
    """
    height = max(1, _BAND_CELLS // max(1, shape[1]) // multiple) * multiple
    for first in range(0, shape[0], height):
        yield slice(first, min(shape[0], first + height))


def count_cells(raster: NDArray[np.generic], value: int) -> int:
    """How many cells of a raster (rows, cols) have a value."""
    return sum(int(np.count_nonzero(raster[rows] == value)) for rows in row_bands(raster.shape))


def holds_cells(raster: NDArray[np.generic], value: int) -> bool:
    """Whether any cell of a raster (rows, cols) has a value."""
    return any(bool((raster[rows] == value).any()) for rows in row_bands(raster.shape))


def count_known(raster: NDArray[np.floating]) -> int:
    """How many cells of a raster (rows, cols) are not NaN."""
    return sum(
        raster[rows].size - int(np.count_nonzero(np.isnan(raster[rows])))
        for rows in row_bands(raster.shape)
    )
