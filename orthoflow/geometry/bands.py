"""Rasters cut into bands of rows: a large one lies in a file and never wholly in memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import DTypeLike, NDArray

# Name, shape, type -> zeroed array, in a file that is mapped into memory where it is large.
Allocate = Callable[[str, tuple[int, ...], DTypeLike], NDArray[np.generic]]

# Finished rasters of more cells lie in files: a site has many walls.
IN_MEMORY_CELLS: Final = 1 << 22
# What is made of a band for a moment takes some 16 MB a byte.
_BAND_CELLS: Final = 1 << 24


def in_memory(name: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[np.generic]:
    """Return a zeroed array of a raster that is small enough; an `Allocate`."""
    del name
    return np.zeros(shape, dtype=dtype)


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


@dataclass(frozen=True, kw_only=True)
class Band:
    """Some rows of a raster, and so many more about them as decide what becomes of them.

    Attributes:
        rows: that the band is for.
        around: these and a reach above and below, as far as there are rows.
    """

    rows: slice
    around: slice

    @property
    def inner(self) -> slice:
        """Where `rows` are within `around`."""
        first = self.rows.start - self.around.start
        return slice(first, first + self.rows.stop - self.rows.start)


def bands_with_reach(shape: tuple[int, int], *, cells_most: int, reach_rows: int) -> Iterator[Band]:
    """Cut a raster into bands of about equal height with at most so many cells, reach included."""
    n_rows, n_columns = shape
    height = max(1, cells_most // max(1, n_columns) - 2 * reach_rows)
    height = -(-n_rows // -(-n_rows // height))
    for first in range(0, n_rows, height):
        end = min(n_rows, first + height)
        around = slice(max(0, first - reach_rows), min(n_rows, end + reach_rows))
        yield Band(rows=slice(first, end), around=around)


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
