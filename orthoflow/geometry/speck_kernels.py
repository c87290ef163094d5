"""A compiled pass that finds cells of a raster whose depth nothing around them shares."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.point_kernels import compiled

# Cells within so many rows and columns are around.
_REACH = 2
# Fewer of them known say nothing, fewer of the known ones in agreement make a speck.
_KNOWN_LEAST = 6
_AGREEING_LEAST = 2


@compiled
def find_specks(
    depth_m: NDArray[np.float32],
    layer_m: float,
    is_speck: NDArray[np.bool_],
    first_row: int,
    end_row: int,
) -> None:
    """Tell the specks among the cells of some rows.

    Args:
        depth_m: (rows, cols) metres, NaN where void.
        layer_m: depths that differ by no more agree.
        is_speck: (rows, cols), made true for known cells of which fewer than two of at least six
            known ones in the 5 x 5 around agree.
        first_row: first row to visit.
        end_row: the row after the last one.
    """
    rows, columns = depth_m.shape
    for row in range(first_row, end_row):
        for column in range(columns):
            here = depth_m[row, column]
            if np.isnan(here):
                continue
            n_known, n_agreeing = 0, 0
            for r in range(max(0, row - _REACH), min(rows, row + _REACH + 1)):
                for c in range(max(0, column - _REACH), min(columns, column + _REACH + 1)):
                    other = depth_m[r, c]
                    if np.isnan(other) or (r == row and c == column):
                        continue
                    n_known += 1
                    if abs(other - here) <= layer_m:
                        n_agreeing += 1
                if n_agreeing >= _AGREEING_LEAST:
                    break
            is_speck[row, column] = n_agreeing < _AGREEING_LEAST and n_known >= _KNOWN_LEAST
