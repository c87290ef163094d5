"""What supports a plane: a coarse raster on it, the cells that belong, parts and rectangles.

A cell belongs to the plane when its points crowd about it. A floor that a vertical plane cuts, or
clutter, spreads evenly over the slab instead: that is what tells a wall from the mere smear that
floors and ceilings leave in an accumulator.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane, wall_axes
from orthoflow_plugins.plane.kernels import BlockedPoints, each_part, piece_of
from orthoflow_plugins.plane.neighbouring import closed, summed_around
from orthoflow_plugins.plane.slab_kernels import sum_cells

CELL_LEAST_M: Final = 0.05
_CELLS_MOST: Final = 1_000_000
# Points a cell should hold on average, so that the crowding test has something to count.
_POINTS_PER_CELL: Final = 12.0
# The inner slab is this share of the find tolerance; evenly spread points fill it by that share.
INNER_SHARE: Final = 0.4
_CROWDED_SHARE: Final = 0.6
# A part smaller than this share of the plane's cells is a chance meeting, not a piece of wall.
PART_SHARE: Final = 0.03


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

    def slab(self, *, from_low: bool = False) -> NDArray[np.float64]:
        """Row of 12 numbers that the compiled passes take; u and v count from 0 or from `low_m`."""
        low = self.low_m if from_low else np.zeros(2)
        return np.concatenate(
            [
                self.plane.normal,
                [self.plane.offset_m],
                self.axes[0],
                [low[0]],
                self.axes[1],
                [low[1]],
            ]
        )

    def centres_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(rows, columns) u and v of the cell centres, metres."""
        rows, columns = np.indices(self.shape)
        return (
            self.low_m[0] + (columns + 0.5) * self.cell_m,
            self.low_m[1] + (rows + 0.5) * self.cell_m,
        )


@dataclass(frozen=True, kw_only=True)
class CellSums:
    """What points in each cell of a surface raster add up to.

    Attributes:
        n_find: (rows, columns) int64 points within the find tolerance.
        n_inner: the same within `INNER_SHARE` of it.
        n_fit: the same within the fit tolerance.
        steps: (rows, columns) int64 sum of distances of those, in steps.
        squared_steps: (rows, columns) int64 sum of squared distances, in squared steps.
    """

    n_find: NDArray[np.int64]
    n_inner: NDArray[np.int64]
    n_fit: NDArray[np.int64]
    steps: NDArray[np.int64]
    squared_steps: NDArray[np.int64]

    @classmethod
    def of(cls, counts: NDArray[np.int64], sums: NDArray[np.int64]) -> CellSums:
        """Name the tables (rows, columns, 3) and (rows, columns, 2) of the compiled passes."""
        return cls(
            n_find=counts[..., 0],
            n_inner=counts[..., 1],
            n_fit=counts[..., 2],
            steps=sums[..., 0],
            squared_steps=sums[..., 1],
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
        n_points: points within the find tolerance in those cells.
    """

    cells: NDArray[np.bool_]
    part_of_cell: NDArray[np.int32]
    parts_m: NDArray[np.float64]
    bounds_m: NDArray[np.float64]
    n_points: int


def surface_raster(
    plane: Plane, box_corners: NDArray[np.float64], up: NDArray[np.float64], *, cell_m: float
) -> SurfaceRaster:
    """Lay a raster on a plane that covers a box.

    Args:
        plane: the plane, in offsets.
        box_corners: (8, 3) offsets of the box that holds the points.
        up: (3,) unit vector.
        cell_m: side of a cell; grows when there would be too many.
    """
    axes = wall_axes(plane.normal, up)
    placed = box_corners @ axes.T
    low, high = placed.min(axis=0), placed.max(axis=0)
    extent = np.maximum(high - low, cell_m)
    cell_m = max(cell_m, math.sqrt(float(np.prod(extent)) / _CELLS_MOST))
    columns, rows = (math.ceil(length / cell_m) for length in extent)
    return SurfaceRaster(plane=plane, axes=axes, low_m=low, cell_m=cell_m, shape=(rows, columns))


def cell_for(n_points: float, area_m2: float) -> float:
    """Side of a cell that holds enough of so many points spread over an area, metres."""
    if n_points <= 0.0 or area_m2 <= 0.0:
        return CELL_LEAST_M
    return max(CELL_LEAST_M, math.sqrt(_POINTS_PER_CELL * area_m2 / n_points))


def measure_cells(
    points: BlockedPoints,
    raster: SurfaceRaster,
    *,
    find_m: float,
    fit_m: float,
    parts: int,
) -> CellSums:
    """Sum the points near a plane per cell, in one pass.

    Args:
        points: the points.
        raster: cells on the plane.
        find_m: find tolerance, metres.
        fit_m: fit tolerance, metres.
        parts: into how many parts the pass is split, e.g. one per thread.
    """
    counts = np.zeros((parts, *raster.shape, 3), dtype=np.int32)
    sums = np.zeros((parts, *raster.shape, 2), dtype=np.int64)
    limits = np.array([raster.cell_m, find_m, INNER_SHARE * find_m, min(fit_m, find_m)])
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
    wanted = _CROWDED_SHARE * sums.n_find + 0.5 * np.sqrt(sums.n_find)
    crowded = (sums.n_find >= 3) & (sums.n_inner >= wanted)
    if crowded.any():
        # Far below the usual density a cell is a stray echo beside the wall, not the wall.
        crowded &= sums.n_find >= 0.02 * np.median(sums.n_find[crowded])
    # The cell itself is one of those around it.
    return crowded & (summed_around(crowded.astype(np.int64)) >= 4)


def support_of(
    raster: SurfaceRaster,
    belongs: NDArray[np.bool_],
    sums: CellSums,
    *,
    joins_parts: bool = True,
    part_share: float = PART_SHARE,
) -> Support | None:
    """Join cells into parts and put rectangles about them.

    Parts are connected over gaps of up to four cells. Every part with `part_share` of the cells
    counts, so that the rectangle holds the entire wall, also where a pilaster cuts it in two;
    without `joins_parts` only the one with most points.

    Returns:
        The support, or None where no cell belongs, or all lie scattered: no part is large enough.
    """
    from scipy import ndimage

    if not belongs.any():
        return None
    joined = closed(belongs, 2)
    names, n_parts = ndimage.label(joined | belongs, np.ones((3, 3), dtype=int))
    sizes = np.bincount(names[belongs], minlength=n_parts + 1)
    kept = np.flatnonzero(sizes >= max(part_share * belongs.sum(), 1.0))
    if not len(kept):
        return None
    n_points = np.bincount(names[belongs], sums.n_find[belongs], minlength=n_parts + 1)
    kept = kept[np.argsort(-n_points[kept], kind="stable")]
    kept = kept if joins_parts else kept[:1]
    part_of_name = np.full(n_parts + 1, -1, dtype=np.int32)
    part_of_name[kept] = np.arange(len(kept), dtype=np.int32)
    part_of_cell = np.where(belongs, part_of_name[names], np.int32(-1))
    cells = part_of_cell >= 0
    parts_m = np.array([_bounds(raster, part_of_cell == part) for part in range(len(kept))])
    return Support(
        cells=cells,
        part_of_cell=part_of_cell,
        parts_m=parts_m,
        bounds_m=_bounds(raster, cells),
        n_points=int(sums.n_find[cells].sum()),
    )


def _bounds(raster: SurfaceRaster, cells: NDArray[np.bool_]) -> NDArray[np.float64]:
    rows = np.flatnonzero(cells.any(axis=1))
    columns = np.flatnonzero(cells.any(axis=0))
    edges = np.array([columns[0], columns[-1] + 1, rows[0], rows[-1] + 1], dtype=np.float64)
    return np.repeat(raster.low_m, 2) + edges * raster.cell_m
