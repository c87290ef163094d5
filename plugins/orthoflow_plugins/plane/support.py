"""What supports a plane: a coarse raster on it, the cells that belong, parts and rectangles.

A cell belongs to the plane when its points crowd about it. A floor that a vertical plane cuts, or
clutter, spreads evenly over the slab instead: that is what tells a wall from the mere smear that
floors and ceilings leave in an accumulator.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane, wall_axes
from orthoflow_plugins.plane.kernels import BlockedPoints, each_part, piece_of
from orthoflow_plugins.plane.slab_kernels import sum_cells

CELL_LEAST_M: Final = 0.05
_CELLS_MOST: Final = 1_000_000
# Points a cell should hold on average, so that the crowding test has something to count.
_POINTS_PER_CELL: Final = 12.0
# The inner slab is this share of the tolerance; evenly spread points fill it by that share.
INNER_SHARE: Final = 0.4
_CROWDED_SHARE: Final = 0.6
# A part smaller than this share of the plane's cells is a chance meeting, not a piece of wall.
PART_SHARE: Final = 0.03
# A plane whose cells cover less of its rectangle is a frame or scattered parts.
_FILLED_SHARE: Final = 0.5
# Cells along a side that cuts are looked for between.
_CUT_CELLS: Final = 64


@dataclass(frozen=True, kw_only=True)
class SurfaceRaster:
    """A raster on a plane, in the cloud's offsets: columns along u, rows along v.

    Attributes:
        plane: the plane.
        axes: (2, 3) unit vectors u and v (`wall_axes`).
        low_m: (2,) smallest u and v, metres.
        cell_m: side of a cell.
        shape: rows and columns.
    """

    plane: Plane
    axes: NDArray[np.float64]
    low_m: NDArray[np.float64]
    cell_m: float
    shape: tuple[int, int]

    @classmethod
    def over(
        cls, plane: Plane, box_corners: NDArray[np.float64], up: NDArray[np.float64], cell_m: float
    ) -> SurfaceRaster:
        """Lay a raster on a plane that covers a box of (8, 3) corners; too many cells grow."""
        axes = wall_axes(plane.normal, up)
        placed = box_corners @ axes.T
        low, high = placed.min(axis=0), placed.max(axis=0)
        extent = np.maximum(high - low, cell_m)
        cell_m = max(cell_m, math.sqrt(float(np.prod(extent)) / _CELLS_MOST))
        columns, rows = (math.ceil(length / cell_m) for length in extent)
        return cls(plane=plane, axes=axes, low_m=low, cell_m=cell_m, shape=(rows, columns))

    def moved_to(self, plane: Plane, up: NDArray[np.float64]) -> SurfaceRaster:
        """Return the same cells on the plane after a small correction."""
        return replace(self, plane=plane, axes=wall_axes(plane.normal, up))

    def slab(self, *, from_low: bool = False) -> NDArray[np.float64]:
        """Row of 12 numbers that the compiled passes take; u and v count from 0 or from `low_m`."""
        return slab_of(self.plane, self.axes, self.low_m if from_low else np.zeros(2))

    def centres_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(rows, columns) u and v of the cell centres, metres."""
        rows, columns = np.indices(self.shape)
        return (
            self.low_m[0] + (columns + 0.5) * self.cell_m,
            self.low_m[1] + (rows + 0.5) * self.cell_m,
        )

    def covers(self, points: NDArray[np.float64], cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(m,) whether points project into cells (rows, columns) that belong."""
        placed = np.floor((points @ self.axes.T - self.low_m) / self.cell_m).astype(np.int64)
        row = np.clip(placed[:, 1], 0, self.shape[0] - 1)
        return cells[row, np.clip(placed[:, 0], 0, self.shape[1] - 1)]


@dataclass(frozen=True, kw_only=True)
class CellSums:
    """What points in each cell of a surface raster add up to.

    Attributes:
        n_near: (rows, columns) int64 points within the tolerance.
        n_inner: the same within `INNER_SHARE` of it.
        n_fit: the same within the tolerance of the fit.
        steps: (rows, columns) int64 sum of distances of those, in steps.
        squared_steps: (rows, columns) int64 sum of squared distances, in squared steps.
    """

    n_near: NDArray[np.int64]
    n_inner: NDArray[np.int64]
    n_fit: NDArray[np.int64]
    steps: NDArray[np.int64]
    squared_steps: NDArray[np.int64]

    @classmethod
    def of(cls, counts: NDArray[np.int64], sums: NDArray[np.int64]) -> CellSums:
        """Name the tables (rows, columns, 3) and (rows, columns, 2) of the compiled passes."""
        near, inner, fit = np.moveaxis(counts, -1, 0)
        return cls(
            n_near=near, n_inner=inner, n_fit=fit, steps=sums[..., 0], squared_steps=sums[..., 1]
        )


@dataclass(frozen=True, kw_only=True)
class Support:
    """The cells that belong to a plane.

    Attributes:
        cells: (rows, columns) bool.
        part_of_cell: (rows, columns) int32, which part a cell belongs to, -1 for none.
        parts_m: (p, 4) smallest u, largest u, smallest v, largest v of each connected part, the
            part with most points first.
        bounds_m: (4,) the same of all parts together.
        n_points: points within the tolerance in those cells.
    """

    cells: NDArray[np.bool_]
    part_of_cell: NDArray[np.int32]
    parts_m: NDArray[np.float64]
    bounds_m: NDArray[np.float64]
    n_points: int

    @property
    def area_m2(self) -> float:
        """Area of the rectangles about its parts: cells may be empty where points are sparse."""
        sides_m = self.parts_m[:, 1::2] - self.parts_m[:, ::2]
        return float(np.prod(sides_m, axis=1).sum())


def slab_of(
    plane: Plane, axes: NDArray[np.float64], low_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Row of 12 numbers that the compiled passes take for a plane, see `slab_kernels`."""
    u, v = axes
    return np.concatenate([plane.normal, [plane.offset_m], u, low_m[:1], v, low_m[1:]])


def cell_for(n_points: float, area_m2: float) -> float:
    """Side of a cell that holds enough of so many points spread over an area, metres."""
    if n_points <= 0.0 or area_m2 <= 0.0:
        return CELL_LEAST_M
    return max(CELL_LEAST_M, math.sqrt(_POINTS_PER_CELL * area_m2 / n_points))


def measure_cells(
    points: BlockedPoints,
    raster: SurfaceRaster,
    *,
    tolerance_m: float,
    fit_tolerance_m: float,
    parts: int,
) -> CellSums:
    """Sum the points near a plane per cell, in one pass split into parts, one per thread."""
    counts = np.zeros((parts, *raster.shape, 3), dtype=np.int32)
    sums = np.zeros((parts, *raster.shape, 2), dtype=np.int64)
    fit_tolerance_m = min(fit_tolerance_m, tolerance_m)
    limits = np.array([raster.cell_m, tolerance_m, INNER_SHARE * tolerance_m, fit_tolerance_m])
    slab = raster.slab(from_low=True)

    def add(part: int, piece: slice) -> None:
        sum_cells(piece_of(points, piece), slab, limits, counts[part], sums[part])

    each_part(len(points.x), parts, add)
    return CellSums.of(counts.sum(axis=0, dtype=np.int64), sums.sum(axis=0))


def crowded_cells(sums: CellSums) -> NDArray[np.bool_]:
    """Cells whose points crowd about the plane instead of filling the slab, with like neighbours.

    A cell needs three points, and more of them in the inner slab than chance would put there; and
    three of its eight neighbours must agree, which scattered clutter does not manage.
    """
    wanted = _CROWDED_SHARE * sums.n_near + 0.5 * np.sqrt(sums.n_near)
    crowded = (sums.n_near >= 3) & (sums.n_inner >= wanted)
    if crowded.any():
        # Far below the usual density a cell is a stray echo beside the wall, not the wall.
        crowded &= sums.n_near >= 0.02 * np.median(sums.n_near[crowded])
    # The cell itself is one of those around it.
    return crowded & (summed_around(crowded.astype(np.int64)) >= 4)


def support_of(
    raster: SurfaceRaster,
    belongs: NDArray[np.bool_],
    sums: CellSums,
    *,
    join_parts: bool = True,
    part_share: float = PART_SHARE,
) -> Support | None:
    """Join cells into parts and put rectangles about them.

    Parts are connected over gaps of up to four cells. Every part with `part_share` of the cells
    counts, so that the rectangle holds the entire wall, also where a pilaster cuts it in two;
    without `join_parts` only the one with most points.

    Returns:
        The support, or None where no cell belongs, or all lie scattered: no part is large enough.
    """
    from scipy import ndimage

    if not belongs.any():
        return None
    names, n_parts = ndimage.label(closed(belongs, 2) | belongs, np.ones((3, 3), dtype=int))
    sizes = np.bincount(names[belongs], minlength=n_parts + 1)
    kept = np.flatnonzero(sizes >= max(part_share * belongs.sum(), 1.0))
    if not len(kept):
        return None
    n_points = np.bincount(names[belongs], sums.n_near[belongs], minlength=n_parts + 1)
    kept = kept[np.argsort(-n_points[kept], kind="stable")][: None if join_parts else 1]
    part_of_name = np.full(n_parts + 1, -1, dtype=np.int32)
    part_of_name[kept] = np.arange(len(kept), dtype=np.int32)
    part_of_cell = np.where(belongs, part_of_name[names], np.int32(-1))
    cells = part_of_cell >= 0
    return Support(
        cells=cells,
        part_of_cell=part_of_cell,
        parts_m=np.array([_bounds_m(raster, part_of_cell == part) for part in range(len(kept))]),
        bounds_m=_bounds_m(raster, cells),
        n_points=int(sums.n_near[cells].sum()),
    )


def covering_rectangles(
    raster: SurfaceRaster, cells: NDArray[np.bool_], most: int
) -> NDArray[np.float64]:
    """(r, 4) smallest and largest u, smallest and largest v of rectangles that cover cells.

    One rectangle where it is covered well; else the cut that leaves the smallest area is made
    again and again, until `_FILLED_SHARE` is reached: a frame must not compete for the points of
    the wall that it surrounds.
    """
    every = max(1, math.ceil(max(cells.shape) / _CUT_CELLS))
    rows, columns = (math.ceil(side / every) for side in cells.shape)
    padded = np.zeros((rows * every, columns * every), dtype=bool)
    padded[: cells.shape[0], : cells.shape[1]] = cells
    coarse = np.asarray(padded.reshape(rows, every, columns, every).any(axis=(1, 3)))
    rectangles = [_tight(coarse, (0, rows, 0, columns))]
    while len(rectangles) < most and coarse.sum() < _FILLED_SHARE * _area(rectangles):
        cuts = [_best_cut(coarse, rectangle) for rectangle in rectangles]
        saved = [_area([old]) - _area(new) for old, new in zip(rectangles, cuts, strict=True)]
        best = int(np.argmax(saved))
        if saved[best] <= 0:
            break
        rectangles[best : best + 1] = cuts[best]
    edges = np.array(rectangles, dtype=np.float64)[:, [2, 3, 0, 1]]
    return np.asarray(raster.low_m[[0, 0, 1, 1]] + every * raster.cell_m * edges)


# First row, end row, first column, end column.
_Rectangle = tuple[int, int, int, int]


def _best_cut(cells: NDArray[np.bool_], rectangle: _Rectangle) -> list[_Rectangle]:
    """Cut a rectangle in two that cover its cells with the smallest area; itself if none does."""
    top, bottom, left, right = rectangle
    pairs = [((top, k, left, right), (k, bottom, left, right)) for k in range(top + 1, bottom)]
    pairs += [((top, bottom, left, k), (top, bottom, k, right)) for k in range(left + 1, right)]
    halves = [[_tight(cells, first), _tight(cells, second)] for first, second in pairs]
    return min([[rectangle], *halves], key=_area)


def _tight(cells: NDArray[np.bool_], rectangle: _Rectangle) -> _Rectangle:
    """Shrink a rectangle to the cells in it; without any it has no area."""
    top, bottom, left, right = rectangle
    within = cells[top:bottom, left:right]
    rows, columns = np.flatnonzero(within.any(axis=1)), np.flatnonzero(within.any(axis=0))
    if not len(rows):
        return (top, top, left, left)
    low, high = int(rows[0]), int(rows[-1]) + 1
    return (top + low, top + high, left + int(columns[0]), left + int(columns[-1]) + 1)


def _area(rectangles: list[_Rectangle]) -> int:
    return sum((bottom - top) * (right - left) for top, bottom, left, right in rectangles)


def _bounds_m(raster: SurfaceRaster, cells: NDArray[np.bool_]) -> NDArray[np.float64]:
    rows = np.flatnonzero(cells.any(axis=1))
    columns = np.flatnonzero(cells.any(axis=0))
    edges = np.array([columns[0], columns[-1] + 1, rows[0], rows[-1] + 1], dtype=np.float64)
    return np.repeat(raster.low_m, 2) + edges * raster.cell_m


# As shifted additions of whole arrays: the filters of libraries ask each cell by itself, which on
# the small rasters of hundreds of candidates costs more than all else.
def summed_around(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Sum each value of an array of any dimension with those beside it, also across corners."""
    for axis in range(values.ndim):
        along = np.moveaxis(values, axis, 0)
        total = values.copy()
        sums = np.moveaxis(total, axis, 0)
        sums[1:] += along[:-1]
        sums[:-1] += along[1:]
        values = total
    return values


def closed(cells: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """Close gaps of up to twice a reach between cells (rows, columns)."""
    rows, columns = cells.shape
    wide = np.zeros((rows + 4 * reach, columns + 4 * reach), dtype=bool)
    wide[2 * reach : 2 * reach + rows, 2 * reach : 2 * reach + columns] = cells
    return ~_any_in_windows(~_any_in_windows(wide, reach), reach)


def _any_in_windows(cells: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """Whether any cell is set in each square window that lies within the raster."""
    rows, columns = (size - 2 * reach for size in cells.shape)
    shifts = range(1, 2 * reach + 1)
    down = cells[:rows].copy()
    for shift in shifts:
        down |= cells[shift : shift + rows]
    across = down[:, :columns].copy()
    for shift in shifts:
        across |= down[:, shift : shift + columns]
    return across
