"""Filters of a raster of depths: cells that only outliers measured, and noise."""

from __future__ import annotations

import math
from functools import partial
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled
from orthoflow.geometry.depth_noise import depth_noise_m
from orthoflow.geometry.threads import in_parts

# Neighbours are within this many rows and columns.
_NEAR_CELLS: Final = 2
# With fewer known neighbours nothing is decided; with fewer that agree a cell is a speck.
_KNOWN_LEAST: Final = 6
_AGREEING_LEAST: Final = 2
# Where cells are sparse more neighbours are used, and more must agree: at least half of the known.
_SPARSE_CELLS: Final = 4
_SPARSE_LEAST: Final = 3
# Steepest surface whose sparse cells agree: 27 degrees.
_SLOPE: Final = 0.5
# A cell is sparse if the share of known cells is below this fraction of the maximum nearby.
_SPARSE_SHARE: Final = 0.35
# The shadow of an edge is narrower than twice this reach, in cells.
_AROUND_CELLS: Final = 16
# Cells on one surface differ by noise, in standard deviations, and by its slope.
_CLOSE_SIGMAS: Final = 4.0
# The first pass removes most of the noise; the second, on what remains, can be stricter at steps.
# In standard deviations of the noise of a cell.
_REACHES: Final = (3.0, 1.5)
# Void cells have no weight: they are this many reaches below everything.
_VOID_REACHES: Final = 8.0
# Smaller differences of depth need no filter: a tenth of a cell at 1 mm.
_NOISE_LEAST_M: Final = 2.0e-5


def without_specks(
    depth_m: NDArray[np.float32], *, gsd_m: float, layer_m: float, threads: int
) -> NDArray[np.float32]:
    """Make void what only an outlier measured: cells with which hardly any neighbour agrees.

    A photo would paint such a cell with a distant place. In the shadow of an edge in the scan,
    where cells are sparse that are dense beside it, there are outliers and mixed distances of both
    sides of the edge: there most of the few neighbours must agree, allowing for a slope.

    Args:
        depth_m: (rows, cols) metres, NaN where void.
        gsd_m: side of a cell.
        layer_m: depths that differ by more are of different layers.
        threads: number of threads.
    """
    noise_m = min(layer_m, _CLOSE_SIGMAS * depth_noise_m(depth_m))
    rule = _SpeckRule(layer_m=layer_m, noise_m=noise_m, gsd_m=gsd_m)
    is_sparse, is_speck = _sparse(np.isfinite(depth_m)), np.zeros(depth_m.shape, dtype=np.bool_)
    task = partial(_find_specks, depth_m, is_sparse, rule, is_speck)
    in_parts(task, depth_m.shape[0], threads=threads)
    return np.where(is_speck, np.float32(np.nan), depth_m)


def _sparse(is_known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Report known cells with far fewer known neighbours than there are nearby."""
    import cv2

    near = 2 * _NEAR_CELLS + 1
    known = np.asarray(
        cv2.boxFilter(
            is_known.view(np.uint8),
            cv2.CV_8U,
            (near, near),
            normalize=False,
            borderType=cv2.BORDER_CONSTANT,
        )
    )
    around = cv2.dilate(known, np.ones((2 * _AROUND_CELLS + 1,) * 2, dtype=np.uint8))
    return is_known & (known < _SPARSE_SHARE * np.asarray(around))


def denoised(depth_m: NDArray[np.float32], radius_cells: int) -> NDArray[np.float32]:
    """Average depths over neighbours on the same surface (bilateral filter, Tomasi 1998).

    The permitted difference of depth follows from the noise of the raster, so that steps of more
    than about six standard deviations are preserved, to the cell.

    Args:
        depth_m: (rows, cols) metres, NaN where void.
        radius_cells: maximum distance of neighbours; half of it is the sigma of the Gaussian
            weight.

    Returns:
        (rows, cols) metres, NaN where it was.
    """
    import cv2

    noise_m = depth_noise_m(depth_m)
    is_known = np.isfinite(depth_m)
    if noise_m < _NOISE_LEAST_M or radius_cells == 0 or not is_known.any():
        return depth_m
    lowest = float(depth_m[is_known].min())
    values = depth_m
    for reach in _REACHES:
        reach_m = reach * noise_m
        filled = np.where(is_known, values, np.float32(lowest - _VOID_REACHES * reach_m))
        values = np.asarray(
            cv2.bilateralFilter(
                filled,
                2 * radius_cells + 1,
                sigmaColor=reach_m,
                sigmaSpace=0.5 * max(1.0, float(radius_cells)),
                borderType=cv2.BORDER_REPLICATE,
            ),
            dtype=np.float32,
        )
    return np.where(is_known, values, np.float32(math.nan))


class _SpeckRule(NamedTuple):
    """Which depths agree.

    Attributes:
        layer_m: maximum difference.
        noise_m: maximum difference for sparse cells, apart from the slope of a surface.
        gsd_m: side of a cell.
    """

    layer_m: float
    noise_m: float
    gsd_m: float


@compiled
def _find_specks(
    depth_m: NDArray[np.float32],
    is_sparse: NDArray[np.bool_],
    rule: _SpeckRule,
    is_speck: NDArray[np.bool_],
    first_row: int,
    end_row: int,
) -> None:
    """Report the specks among the cells of some rows.

    Args:
        depth_m: (rows, cols) metres, NaN where void.
        is_sparse: (rows, cols) cells in gaps of an otherwise well known surface.
        rule: which depths agree.
        is_speck: (rows, cols), set for known cells with which fewer than two of at least six known
            ones in the 5 x 5 neighbourhood agree, and for sparse ones with which fewer than three,
            or fewer than half of the known ones, in the 9 x 9 neighbourhood agree.
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
            n_known, n_agreeing = _count_around(
                depth_m, row, column, _NEAR_CELLS, rule.layer_m, 0.0
            )
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

    Depths agree that differ by at most `agree_m`, plus `slope_m` for each row or column between.
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
