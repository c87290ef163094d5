"""Compiled passes that find cells of a raster whose depth nothing around them shares."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled

# Cells within so many rows and columns are around.
NEAR_CELLS = 2
# Fewer of them known say nothing, fewer of the known ones in agreement make a speck.
_KNOWN_LEAST = 6
_AGREEING_LEAST = 2
# Where cells are sparse more of them are asked, and more must agree: at least half of the known.
_SPARSE_CELLS = 4
_SPARSE_LEAST = 3
# Steepest surface whose sparse cells agree: 27 degrees.
_SLOPE = 0.5


class SpeckRule(NamedTuple):
    """Which depths agree.

    Attributes:
        layer_m: those that differ by no more.
        noise_m: of sparse cells, those that differ by no more, but for the slope of a surface.
        gsd_m: side of a cell.
    """

    layer_m: float
    noise_m: float
    gsd_m: float


@compiled
def find_specks(
    depth_m: NDArray[np.float32],
    is_sparse: NDArray[np.bool_],
    rule: SpeckRule,
    is_speck: NDArray[np.bool_],
    first_row: int,
    end_row: int,
) -> None:
    """Tell the specks among the cells of some rows.

    Args:
        depth_m: (rows, cols) metres, NaN where void.
        is_sparse: (rows, cols) cells in gaps of an otherwise well known surface.
        rule: which depths agree.
        is_speck: (rows, cols), made true for known cells of which fewer than two of at least six
            known ones in the 5 x 5 around agree, and for sparse ones of which fewer than three, or
            fewer than half of the known ones, in the 9 x 9 around agree.
        first_row: first row to visit.
        end_row: the row after the last one.
    """
    columns = depth_m.shape[1]
    for row in range(first_row, end_row):
        for column in range(columns):
            if np.isnan(depth_m[row, column]):
                continue
            if is_sparse[row, column]:
                n_known, n_agreeing = _count_around(
                    depth_m, row, column, _SPARSE_CELLS, rule.noise_m, _SLOPE * rule.gsd_m
                )
                is_speck[row, column] = n_agreeing < max(_SPARSE_LEAST, 0.5 * n_known)
                continue
            n_known, n_agreeing = _count_around(depth_m, row, column, NEAR_CELLS, rule.layer_m, 0.0)
            is_speck[row, column] = n_agreeing < _AGREEING_LEAST and n_known >= _KNOWN_LEAST


@compiled
def _count_around(
    depth_m: NDArray[np.float32],
    row: int,
    column: int,
    reach: int,
    agree_m: float,
    slope_m: float,
) -> tuple[int, int]:
    """Count the known cells around a cell, and those that agree with it.

    Depths agree that differ by `agree_m`, and by `slope_m` more for each row or column between.
    """
    rows, columns = depth_m.shape
    here = depth_m[row, column]
    n_known, n_agreeing = -1, -1
    for r in range(max(0, row - reach), min(rows, row + reach + 1)):
        for c in range(max(0, column - reach), min(columns, column + reach + 1)):
            other = depth_m[r, c]
            if np.isnan(other):
                continue
            n_known += 1
            n_between = max(abs(r - row), abs(c - column))
            n_agreeing += abs(other - here) <= agree_m + n_between * slope_m
    return n_known, n_agreeing
