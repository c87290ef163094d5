"""Interpolation of raster cells from the surrounding points.

The value of a cell is that of a plane fitted to the values of the surrounding cells, which are
weighted by the distance of their points from the centre of the cell. No direction is preferred:
except for rounding, interpolating a rotated or mirrored raster gives the rotated or mirrored
result.

This module loads numba, so methods import it inside functions.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part
from orthoflow.geometry.levels import Colours
from orthoflow.geometry.slabs import read_only_view
from orthoflow.geometry.threads import in_parts

# Cells are used if they are at most this many cells farther away than the nearest one.
_BEYOND_CELLS: Final = 1.0
# Cells within this squared distance, the eight neighbours, are always used.
_NEIGHBOURS_SQUARE: Final = 2.0
# Standard deviation of the Gaussian weights, relative to the distance to the nearest cell (at least
# 1 cell).
_SIGMA_SHARE: Final = 0.5
# Minimum weight. The weights (1 - x / 8)^8, which approximate exp(-x) and take a tenth of the time,
# would be 0 for the outermost cells.
_WEIGHT_LEAST: Final = 1e-6
# Regularisation that reduces the slope of the plane to zero if the points hardly determine it.
_RIDGE: Final = 0.005
# Points whose squared distances differ by less than this count as equally near.
_AS_NEAR: Final = 1e-6


class CellValues(NamedTuple):
    """Values of the cells of a raster in row order; empty arrays are ignored.

    Attributes:
        depth_m: float32, NaN if void.
        intensity: float32.
        rgb: (cells, 3) uint8 or uint16.
    """

    depth_m: NDArray[np.float32]
    intensity: NDArray[np.float32]
    rgb: Colours


def cell_values(
    depth_m: NDArray[np.float32],
    *,
    intensity: NDArray[np.float32] | None = None,
    rgb: Colours | None = None,
) -> CellValues:
    """Return values in the form for which kernels are compiled."""
    return CellValues(
        depth_m,
        np.empty(0, dtype=np.float32) if intensity is None else intensity,
        np.empty((0, 3), dtype=np.uint8) if rgb is None else rgb,
    )


class Surroundings(NamedTuple):
    """Cells of a raster from which other cells are interpolated.

    Attributes:
        places: (cells, 2) float32 positions of the points relative to the centre of their cell, to
            the right and downwards, in cells; NaN for cells that are not used.
        width: number of columns of the raster.
        layer_m: maximum difference between depths on the same surface, in metres.
    """

    places: NDArray[np.float32]
    width: int
    layer_m: float


def interpolate(
    cells: NDArray[np.int64],
    around: Surroundings,
    values: CellValues,
    into: CellValues,
    *,
    reach_cells: float,
    threads: int,
) -> NDArray[np.bool_]:
    """Interpolate cells linearly from surrounding cells.

    A void cell is interpolated from the surrounding points of one surface. This is the surface at
    the depth of the cell if this depth is known, and otherwise the surface of the nearest point (of
    several equally near points, the one nearest to the viewer). The value of a cell with points is
    corrected for the distance of these points from the centre of the cell. Results are limited to
    the range of the surrounding values.

    Args:
        cells: (n,) indices, in row order, of the cells to interpolate.
        around: cells from which they are interpolated.
        values: values of the surrounding cells and, if known, depths of the cells to interpolate.
        into: output; may be `values` if no cell in `cells` is used to interpolate others.
        reach_cells: maximum distance of the nearest cell with points; cells without points within
            this distance are not interpolated.
        threads: number of threads.

    Returns:
        Mask (n,) of the cells that were interpolated; all others are unchanged.
    """
    wanted = _Wanted(
        cells=cells,
        offsets=_offsets_within(max(math.sqrt(_NEIGHBOURS_SQUARE), reach_cells + _BEYOND_CELLS)),
        is_found=np.zeros(len(cells), dtype=np.bool_),
    )
    values = values._replace(depth_m=read_only_view(values.depth_m))
    task = partial(interpolate_cells, wanted, around, values, into)
    in_parts(task, len(cells), threads=threads)
    return wanted.is_found


def _offsets_within(radius_cells: float) -> NDArray[np.int64]:
    """Return the cells (k, 2) = (row, column) within a radius, beginning with the centre."""
    most = math.floor(radius_cells)
    steps = np.arange(-most, most + 1, dtype=np.int64)
    rows, columns = (grid.ravel() for grid in np.meshgrid(steps, steps, indexing="ij"))
    squares = rows * rows + columns * columns
    order = np.argsort(squares, kind="stable")
    order = order[squares[order] <= radius_cells * radius_cells + _AS_NEAR]
    return np.column_stack([rows[order], columns[order]])


class _Wanted(NamedTuple):
    cells: NDArray[np.int64]
    offsets: NDArray[np.int64]
    is_found: NDArray[np.bool_]


class _Lenders(NamedTuple):
    cells: NDArray[np.int64]
    across: NDArray[np.float64]
    down: NDArray[np.float64]
    weights: NDArray[np.float64]


@compiled
def interpolate_cells(
    wanted: _Wanted,
    around: Surroundings,
    values: CellValues,
    into: CellValues,
    first: int,
    end: int,
) -> None:
    """Interpolate the cells from `first` to `end` (exclusive); see `interpolate`."""
    most = wanted.offsets.shape[0]
    lenders = _Lenders(
        np.empty(most, dtype=np.int64), np.empty(most), np.empty(most), np.empty(most)
    )
    for i in range(first, end):
        cell = wanted.cells[i]
        n, sigma = _find_lenders(cell, wanted.offsets, around, values.depth_m, lenders)
        if n == 0:
            continue
        wanted.is_found[i] = True
        _weigh(cell, n, sigma, around.places, lenders)
        own = -1 if math.isnan(around.places[cell, 0]) else cell
        if into.depth_m.size and math.isnan(values.depth_m[cell]):
            into.depth_m[cell] = _mixed(values.depth_m, lenders, n, own)
        if into.intensity.size:
            into.intensity[cell] = _mixed(values.intensity, lenders, n, own)
        if into.rgb.size:
            for band in range(3):
                shade = _mixed(values.rgb[:, band], lenders, n, own)
                into.rgb[cell, band] = math.floor(shade + 0.5)


@kernel_part
def _find_lenders(
    cell: int,
    offsets: NDArray[np.int64],
    around: Surroundings,
    depth_m: NDArray[np.float32],
    lenders: _Lenders,
) -> tuple[int, float]:
    """Find the neighbours of a cell; return their number and the sigma of their weights."""
    places, width = around.places, around.width
    height = places.shape[0] // width
    row, column = cell // width, cell % width
    surface_m = float(depth_m[cell])
    n, farthest, sigma = 0, math.inf, _SIGMA_SHARE
    nearest, nearest_m = math.inf, 0.0
    for k in range(offsets.shape[0]):
        r, c = row + offsets[k, 0], column + offsets[k, 1]
        square = float(offsets[k, 0] ** 2 + offsets[k, 1] ** 2)
        if square > farthest + _AS_NEAR:
            break
        if not (0 <= r < height and 0 <= c < width):
            continue
        other = r * width + c
        if math.isnan(places[other, 0]) or abs(depth_m[other] - surface_m) > around.layer_m:
            continue
        if n == 0:
            farthest = max(_NEIGHBOURS_SQUARE, (math.sqrt(square) + _BEYOND_CELLS) ** 2)
            sigma = _SIGMA_SHARE * max(1.0, math.sqrt(square))
        lenders.cells[n] = other
        lenders.across[n] = offsets[k, 1] + float(places[other, 0])
        lenders.down[n] = offsets[k, 0] + float(places[other, 1])
        apart = lenders.across[n] ** 2 + lenders.down[n] ** 2
        is_as_near = abs(apart - nearest) <= _AS_NEAR
        if (is_as_near and depth_m[other] > nearest_m) or apart < nearest - _AS_NEAR:
            nearest_m = float(depth_m[other])
            nearest = min(apart, nearest)
        n += 1
    if math.isnan(surface_m):
        n = _keep_layer(n, nearest_m, around.layer_m, depth_m, lenders)
    return n, sigma


@kernel_part
def _keep_layer(
    n: int, surface_m: float, layer_m: float, depth_m: NDArray[np.float32], lenders: _Lenders
) -> int:
    """Keep only the neighbours on one surface; return their number."""
    kept = 0
    for k in range(n):
        if abs(depth_m[lenders.cells[k]] - surface_m) <= layer_m:
            lenders.cells[kept] = lenders.cells[k]
            lenders.across[kept], lenders.down[kept] = lenders.across[k], lenders.down[k]
            kept += 1
    return kept


@kernel_part
def _weigh(cell: int, n: int, sigma: float, places: NDArray[np.float32], lenders: _Lenders) -> None:
    """Set the weights of n neighbours by linear regression, weighted by proximity.

    For a cell with points, the weights correct its own value for the position of the points.
    """
    per_square = 1.0 / (16.0 * sigma * sigma)
    w, wx, wy, wxx, wxy, wyy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(n):
        x, y = lenders.across[k], lenders.down[k]
        weight = max(0.0, 1.0 - (x * x + y * y) * per_square) ** 2
        weight *= weight
        weight = max(_WEIGHT_LEAST, weight * weight)
        lenders.weights[k] = weight
        w, wx, wy = w + weight, wx + weight * x, wy + weight * y
        wxx, wxy, wyy = wxx + weight * x * x, wxy + weight * x * y, wyy + weight * y * y
    ridge = _RIDGE * sigma * sigma * w
    wxx, wyy = wxx + ridge, wyy + ridge
    # First row of the inverse of ((w, wx, wy), (wx, wxx, wxy), (wy, wxy, wyy)), times the
    # determinant.
    level, across, down = wxx * wyy - wxy * wxy, wxy * wy - wx * wyy, wx * wxy - wxx * wy
    determinant = w * level + wx * across + wy * down
    if not math.isnan(places[cell, 0]):
        x, y = -float(places[cell, 0]), -float(places[cell, 1])
        xx, xy, yy = w * wyy - wy * wy, wx * wy - w * wxy, w * wxx - wx * wx
        level, across, down = x * across + y * down, x * xx + y * xy, x * xy + y * yy
    for k in range(n):
        share = level + across * lenders.across[k] + down * lenders.down[k]
        lenders.weights[k] *= share / determinant


@kernel_part
def _mixed(values: NDArray[np.generic], lenders: _Lenders, n: int, own: int) -> float:
    """Return the interpolated value, limited to the range of n neighbours; `own` is -1 if void."""
    total, least, most = 0.0, math.inf, -math.inf
    if own >= 0:
        total = float(values[own])
    for k in range(n):
        value = float(values[lenders.cells[k]])
        total += lenders.weights[k] * value
        least, most = min(least, value), max(most, value)
    return min(most, max(least, total))
