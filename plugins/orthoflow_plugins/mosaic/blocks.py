"""Blocks of cells over which colours and depths are averaged, for seams and balances."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.bands import row_bands
from orthoflow.geometry.levels import Colours

# Rows and columns of blocks.
Box: TypeAlias = tuple[slice, slice]


@dataclass(frozen=True, kw_only=True)
class Blocks:
    """Blocks of about equal numbers of cells, symmetric from either end of each side.

    Attributes:
        rows: first row of each block, and the row after the last one.
        columns: the same for columns.
    """

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]

    @classmethod
    def over(cls, shape: tuple[int, int], side_cells: int) -> Blocks:
        """Cut a raster into blocks with sides of about this many cells, one more at most."""
        rows, columns = (_symmetric_edges(length, side_cells) for length in shape)
        return cls(rows=rows, columns=columns)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of blocks."""
        return len(self.rows) - 1, len(self.columns) - 1

    def cells(self, box: Box) -> tuple[slice, slice]:
        """Return rows and columns of the cells of a box of blocks."""
        rows, columns = box
        return (
            slice(int(self.rows[rows.start]), int(self.rows[rows.stop])),
            slice(int(self.columns[columns.start]), int(self.columns[columns.stop])),
        )

    def within(self, box: Box) -> Blocks:
        """Return the blocks of a box, relative to its first cell."""
        rows = self.rows[box[0].start : box[0].stop + 1]
        columns = self.columns[box[1].start : box[1].stop + 1]
        return Blocks(rows=rows - rows[0], columns=columns - columns[0])

    def centres(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return row and column, in cells, of the centre of each row and column of blocks."""
        rows, columns = (
            np.asarray(0.5 * (edges[1:] + edges[:-1]), np.float64)
            for edges in (self.rows, self.columns)
        )
        return rows, columns


def _symmetric_edges(length: int, part: int) -> NDArray[np.int64]:
    n_parts = -(-length // part)
    # A single middle cell belongs to neither half: it becomes a part of its own.
    n_parts += length % 2 * (1 - n_parts % 2)
    half = np.arange(n_parts // 2 + 1) * length // n_parts
    return np.concatenate([half, (length - half[::-1])[1 - n_parts % 2 :]])


def raster_means(raster: Colours | NDArray[np.float32], blocks: Blocks) -> NDArray[np.float64]:
    """Return means (rows, cols) of the cells of each block of a raster (rows, cols)."""
    return block_means(lambda rows: raster[rows], blocks)


def block_means(
    values: Callable[[slice], NDArray[np.generic]], blocks: Blocks
) -> NDArray[np.float64]:
    """Return means (rows, cols) of the cells of each block; `values` returns those of some rows."""
    rows, columns = blocks.rows, blocks.columns
    means = np.empty((len(rows) - 1, len(columns) - 1))
    # Rows of blocks processed at once, about a band.
    for some in row_bands((len(means), int(columns[-1] * np.diff(rows).max()))):
        first, last = rows[some.start], rows[some.stop]
        known = values(slice(int(first), int(last))).astype(np.float64)
        sums = np.add.reduceat(known, rows[some] - first, axis=0)
        means[some] = np.add.reduceat(sums, columns[:-1], axis=1)
    means /= np.outer(np.diff(rows), np.diff(columns))
    return means
