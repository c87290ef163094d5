"""Narrow gaps of a raster, as distinguished from windows.

A disc around a cell contains a member of a set if, in some column of the disc, the member nearest
to the middle row is within the disc. Distances along columns are therefore found first; then each
row checks the columns to its left and right. Both run along rows without branches, 32 cells at a
time.

This module loads numba: methods import it inside functions.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled
from orthoflow.geometry.threads import in_parts


def narrow_gaps(
    is_measured: NDArray[np.bool_], radius_cells: int, *, threads: int
) -> NDArray[np.int64]:
    """Find the void cells of narrow gaps.

    A gap is narrow where no disc of the radius fits into it: what remains void is the morphological
    opening of the void cells, so windows and outlines keep their shape to the cell. Cells outside
    the raster count as void. Every cell found has a measured cell within the radius.

    Args:
        is_measured: (rows, cols).
        radius_cells: radius of the disc; with 0 no gap is found.
        threads: number of threads.

    Returns:
        (k,) flat indices, ascending.
    """
    if radius_cells == 0:
        return np.empty(0, dtype=np.int64)
    rows, columns = is_measured.shape
    # Padded with void cells, so that discs may extend beyond the raster.
    framed: NDArray[np.bool_] = np.pad(is_measured, radius_cells)
    is_touched = _met_by_discs(framed, radius_cells, threads=threads)
    is_open = _met_by_discs(~is_touched, radius_cells, threads=threads)
    inner = np.s_[radius_cells : radius_cells + rows, radius_cells : radius_cells + columns]
    return np.flatnonzero(np.logical_not(is_open[inner] | is_measured))


def _met_by_discs(
    is_in_set: NDArray[np.bool_], radius_cells: int, *, threads: int
) -> NDArray[np.bool_]:
    """Report the cells (rows, cols) whose disc contains a member of a set."""
    rows, columns = is_in_set.shape
    steps = np.arange(-radius_cells, radius_cells + 1)
    heights = np.floor(np.sqrt(radius_cells**2 - steps**2)).astype(np.uint8)
    far = radius_cells + 1
    distances = np.full((rows, columns + 2 * radius_cells), far, dtype=np.uint8)
    inner = distances[:, radius_cells : radius_cells + columns]
    in_parts(partial(find_distances_down, is_in_set, far, inner), columns, threads=threads)
    is_met = np.empty(is_in_set.shape, dtype=np.bool_)
    in_parts(partial(find_discs, distances, heights, is_met), rows, threads=threads)
    return is_met


@compiled
def find_distances_down(
    is_in_set: NDArray[np.bool_], most: int, distances: NDArray[np.uint8], first: int, end: int
) -> None:
    """Find the distance to the nearest member of a set above or below, in some columns.

    Args:
        is_in_set: (rows, cols).
        most: larger distances are not counted.
        distances: (rows, cols) output.
        first: first column.
        end: the column after the last one.
    """
    rows, far, zero = is_in_set.shape[0], np.uint8(most), np.uint8(0)
    one = np.uint8(1)
    for row in range(rows):
        here, into = is_in_set[row, first:end], distances[row, first:end]
        if row == 0:
            for j in range(here.size):
                into[j] = zero if here[j] else far
            continue
        above = distances[row - 1, first:end]
        for j in range(here.size):
            next_one = far if above[j] == far else np.uint8(above[j] + one)
            into[j] = zero if here[j] else next_one
    for row in range(rows - 2, -1, -1):
        into, below = distances[row, first:end], distances[row + 1, first:end]
        for j in range(into.size):
            into[j] = np.uint8(below[j] + one) if into[j] > below[j] else into[j]


@compiled
def find_discs(
    distances: NDArray[np.uint8],
    heights: NDArray[np.uint8],
    is_met: NDArray[np.bool_],
    first: int,
    end: int,
) -> None:
    """Report which cells of some rows have a member of the set in their disc.

    Args:
        distances: (rows, cols + 2 radius) from `find_distances_down`, padded with columns on both
            sides.
        heights: (2 radius + 1,) half height of the disc in each of its columns.
        is_met: (rows, cols) output.
        first: first row.
        end: the row after the last one.
    """
    columns = is_met.shape[1]
    for row in range(first, end):
        into = is_met[row]
        into[:] = False
        for k in range(heights.size):
            beside, height = distances[row, k : k + columns], heights[k]
            for j in range(columns):
                into[j] |= beside[j] <= height
