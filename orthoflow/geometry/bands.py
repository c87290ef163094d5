"""Bands of rows, so that a large raster is stored in a file and never completely in memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import DTypeLike, NDArray

# Function that creates an array of zeros from a name, a shape and a type; large arrays are in
# memory-mapped files.
Allocate = Callable[[str, tuple[int, ...], DTypeLike], NDArray[np.generic]]

# Rasters with more cells are stored in files, because there may be many walls.
IN_MEMORY_CELLS: Final = 1 << 22
# A temporary array for a band of this size needs about 16 MB for each byte per cell.
BAND_CELLS: Final = 1 << 24


def in_memory(name: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[np.generic]:
    """Return an array of zeros in memory; implements `Allocate` for small rasters."""
    del name
    return np.zeros(shape, dtype=dtype)


def row_bands(shape: tuple[int, ...], *, multiple: int = 1) -> Iterator[slice]:
    """Divide a raster into bands of rows.

    Args:
        shape: shape of the raster; the first two entries are the numbers of rows and columns.
        multiple: the height of each band except the last is a multiple of this number.

    Yields:
        The rows of each band, from top to bottom.
    """
    height = max(1, BAND_CELLS // max(1, shape[1]) // multiple) * multiple
    for first in range(0, shape[0], height):
        yield slice(first, min(shape[0], first + height))


@dataclass(frozen=True, kw_only=True)
class Band:
    """A band of rows, and a margin of rows above and below that affect its result.

    Attributes:
        around: the rows of the band and its margin, clipped to the raster.
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
