"""Bands of rows: large rasters are kept in files and never completely in memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import DTypeLike, NDArray

# Function that creates a zeroed array from a name, a shape and a type, in a memory-mapped file if
# the array is large.
Allocate = Callable[[str, tuple[int, ...], DTypeLike], NDArray[np.generic]]

# Finished rasters with more cells are kept in files, because there may be many walls.
IN_MEMORY_CELLS: Final = 1 << 22
# With this limit, temporary arrays of a band need about 16 MB per byte of a cell.
_BAND_CELLS: Final = 1 << 24


def in_memory(name: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[np.generic]:
    """Return a zeroed array in memory; an `Allocate` for small rasters."""
    del name
    return np.zeros(shape, dtype=dtype)


def row_bands(shape: tuple[int, ...], *, multiple: int = 1) -> Iterator[slice]:
    """Divide a raster into bands of rows.

    Args:
        shape: numbers of rows and columns, and the further dimensions of a cell.
        multiple: number of which the height of every band except the last is a multiple.

    Yields:
        The rows of each band, from top to bottom.
    """
    height = max(1, _BAND_CELLS // max(1, shape[1]) // multiple) * multiple
    for first in range(0, shape[0], height):
        yield slice(first, min(shape[0], first + height))


@dataclass(frozen=True, kw_only=True)
class Band:
    """A band of rows with a margin of rows that influence its result.

    Attributes:
        rows: the rows of the band.
        around: the same rows with a margin above and below, clipped to the raster.
    """

    rows: slice
    around: slice

    @property
    def inner(self) -> slice:
        """Position of `rows` within `around`."""
        first = self.rows.start - self.around.start
        return slice(first, first + self.rows.stop - self.rows.start)


def bands_with_reach(shape: tuple[int, int], *, cells_most: int, reach_rows: int) -> Iterator[Band]:
    """Divide a raster into bands of similar height, each with at most `cells_most` cells."""
    n_rows, n_columns = shape
    height = max(1, cells_most // max(1, n_columns) - 2 * reach_rows)
    height = -(-n_rows // -(-n_rows // height))
    for first in range(0, n_rows, height):
        end = min(n_rows, first + height)
        around = slice(max(0, first - reach_rows), min(n_rows, end + reach_rows))
        yield Band(rows=slice(first, end), around=around)


def count_cells(raster: NDArray[np.generic], value: int) -> int:
    """Count the cells of a raster (rows, cols) with a given value."""
    return sum(int(np.count_nonzero(raster[rows] == value)) for rows in row_bands(raster.shape))


def holds_cells(raster: NDArray[np.generic], value: int) -> bool:
    """Return whether any cell of a raster (rows, cols) has a given value."""
    return any(bool((raster[rows] == value).any()) for rows in row_bands(raster.shape))


def count_known(raster: NDArray[np.floating]) -> int:
    """Count the cells of a raster (rows, cols) that are not NaN."""
    return sum(
        raster[rows].size - int(np.count_nonzero(np.isnan(raster[rows])))
        for rows in row_bands(raster.shape)
    )
