"""Support of a plane: a coarse raster, the cells that belong to the plane, parts and rectangles.

A cell belongs to the plane if its points concentrate near the plane. In contrast, points of
clutter, or of a floor that a vertical plane intersects, are distributed evenly over the tolerance.
The test distinguishes walls from planes that intersect floors and ceilings.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane, wall_axes
from orthoflow_plugins.plane.cloud import PreparedCloud
from orthoflow_plugins.plane.kernels import (
    BLOCK_POINTS,
    BlockedPoints,
    each_part,
    piece_of,
    sum_assigned,
)

CELL_LEAST_M: Final = 0.05
_CELLS_MOST: Final = 1_000_000
# The test for concentration on the plane needs this mean number of points per cell, and the second
# number in noisy clouds, whose tolerance is less than a multiple of the noise. Noise increases with
# distance, incidence angle and darkness. On a plane with 1.5 times the median noise of the cloud
# and a tolerance of 4 times this median, 72 % of the points are in the inner slab. A cell of 12
# points needs 74 %, and one of 36 points needs 68 %.
_POINTS_PER_CELL: Final = 12.0
_POINTS_PER_NOISY_CELL: Final = 36.0
_NOISY_BELOW: Final = 6.0
# Thickness of the inner slab as a share of the tolerance, and minimum share of the points in the
# inner slab.
INNER_SHARE: Final = 0.4
_CROWDED_SHARE: Final = 0.6
# Minimum share of the plane's cells in a part; a smaller part is due to chance and does not belong
# to the wall.
PART_SHARE: Final = 0.03
# Cells are connected across gaps of up to twice this number of cells.
_GAP_CELLS: Final = 2
# If the cells of a plane cover a smaller share of its rectangle than this, the plane is a frame or
# consists of separate parts.
_FILLED_SHARE: Final = 0.5
# Maximum number of cells along each side of the raster in which cuts are searched for.
_CUT_CELLS: Final = 64


@dataclass(frozen=True, kw_only=True)
class SurfaceRaster:
    """A raster on a plane, in the cloud's offsets, with columns along u and rows along v.

    Attributes:
        plane: the plane.
        axes: (2, 3) unit vectors u and v (`wall_axes`).
        low_m: (2,) smallest u and v, metres.
        cell_m: side of a cell in metres.
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
        """Return a raster of limited size on a plane; it covers a box with corners (8, 3)."""
        axes = wall_axes(plane.normal, up)
        placed = box_corners @ axes.T
        low, high = placed.min(axis=0), placed.max(axis=0)
        extent = np.maximum(high - low, cell_m)
        cell_m = max(cell_m, math.sqrt(float(np.prod(extent)) / _CELLS_MOST))
        columns, rows = (math.ceil(length / cell_m) for length in extent)
        return cls(plane=plane, axes=axes, low_m=low, cell_m=cell_m, shape=(rows, columns))

    def moved_to(self, plane: Plane, up: NDArray[np.float64]) -> SurfaceRaster:
        """Return the same cells on a plane that differs slightly."""
        return replace(self, plane=plane, axes=wall_axes(plane.normal, up))

    def slab(self) -> NDArray[np.float64]:
        """Return the row (12,) that represents the plane in `kernels`; u and v have origin 0."""
        return slab_of(self.plane, self.axes)

    def bounds_m(self, cells: NDArray[np.bool_] | None = None) -> NDArray[np.float64]:
        """Return (4,) smallest u, largest u, smallest v and largest v of cells; all by default."""
        edges = np.array([0, self.shape[1], 0, self.shape[0]], dtype=np.float64)
        if cells is not None:
            rows, columns = (np.flatnonzero(cells.any(axis=axis)) for axis in (1, 0))
            edges[:] = columns[0], columns[-1] + 1, rows[0], rows[-1] + 1
        return np.repeat(self.low_m, 2) + edges * self.cell_m

    def centres_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return u and v (rows, columns) of the centres of cells, in metres."""
        rows, columns = np.indices(self.shape)
        return (
            self.low_m[0] + (columns + 0.5) * self.cell_m,
            self.low_m[1] + (rows + 0.5) * self.cell_m,
        )

    def covers(self, points: NDArray[np.float64], cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return a mask (m,) of points whose projections are in the given cells (rows, columns)."""
        placed = np.floor((points @ self.axes.T - self.low_m) / self.cell_m).astype(np.int64)
        row = np.clip(placed[:, 1], 0, self.shape[0] - 1)
        return cells[row, np.clip(placed[:, 0], 0, self.shape[1] - 1)]


class CellSums(NamedTuple):
    """Sums over the points in each cell of a surface raster; each is (rows, columns) int64.

    Attributes:
        n_near: number of points within the tolerance.
        n_inner: number of points within `INNER_SHARE` of the tolerance.
        n_fit: number of points within the tolerance of the fit.
        steps: sum of the distances of points within the tolerance of the fit, in steps.
        squared_steps: sum of squares of these distances, in squared steps.
    """

    n_near: NDArray[np.int64]
    n_inner: NDArray[np.int64]
    n_fit: NDArray[np.int64]
    steps: NDArray[np.int64]
    squared_steps: NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class Support:
    """The cells that belong to a plane.

    Attributes:
        cells: (rows, columns) bool, True for cells that belong to the plane.
        part_of_cell: (rows, columns) int32 part of each cell; -1 for cells in no part.
        parts_m: (p, 4) smallest u, largest u, smallest v and largest v of each connected part; the
            part with the most points is first.
        bounds_m: (4,) the same for all parts together.
        n_points: number of points within the tolerance in the cells of the plane.
    """

    cells: NDArray[np.bool_]
    part_of_cell: NDArray[np.int32]
    parts_m: NDArray[np.float64]
    bounds_m: NDArray[np.float64]
    n_points: int

    @property
    def area_m2(self) -> float:
        """Total area of the parts' rectangles, which may contain empty cells."""
        sides_m = self.parts_m[:, 1::2] - self.parts_m[:, ::2]
        return float(np.prod(sides_m, axis=1).sum())


def slab_of(plane: Plane, axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the row (12,) that represents a plane in `kernels`."""
    return np.concatenate([plane.normal, [plane.offset_m], axes[0], [0.0], axes[1], [0.0]])


def cell_for(n_points: float, area_m2: float, cloud: PreparedCloud) -> float:
    """Return a cell size in metres at which cells have enough points, given number and area."""
    if n_points <= 0.0 or area_m2 <= 0.0:
        return CELL_LEAST_M
    is_noisy = cloud.tolerance_m < _NOISY_BELOW * cloud.noise_m
    wanted = _POINTS_PER_NOISY_CELL if is_noisy else _POINTS_PER_CELL
    return max(CELL_LEAST_M, math.sqrt(wanted * area_m2 / n_points))


def measure_cells(
    cloud: PreparedCloud,
    rasters: Sequence[SurfaceRaster],
    *,
    points: BlockedPoints | None = None,
    bounds_m: Sequence[NDArray[np.float64]] | None = None,
    drawn: NDArray[np.bool_] | None = None,
) -> list[CellSums]:
    """Sum the points near planes in cells, in one pass; each point is added to its nearest plane.

    Args:
        cloud: the cloud.
        rasters: raster on each plane. Points may also be nearest to planes without rows, but these
            points are not summed.
        points: points to sum; all points of the cloud by default.
        bounds_m: for each plane, the bounds (r, 5) of its points (see `kernels`); by default those
            of its raster.
        drawn: (blocks,) True for blocks whose points are summed; None for all blocks.
    """
    points = cloud.points if points is None else points
    if bounds_m is None:
        bounds_m = [np.append(cloud.tolerance_m, raster.bounds_m())[None] for raster in rasters]
    if drawn is None:
        drawn = np.ones(len(points.boxes), dtype=bool)
    starts = np.cumsum([0, *(math.prod(raster.shape) for raster in rasters)])
    limits = (cloud.fit_tolerance_m, INNER_SHARE * cloud.tolerance_m)
    tables = np.array(
        [
            (*r.low_m, 1.0 / r.cell_m, *r.shape, start, *limits)
            for r, start in zip(rasters, starts, strict=False)
        ]
    ).reshape(-1, 8)
    repeats = [len(own) for own in bounds_m]
    slabs = np.array([raster.slab() for raster in rasters]).reshape(-1, 12)
    rows = [np.repeat(table, repeats, axis=0) for table in (slabs, tables)]
    slabs, tables, bounds = *rows, np.concatenate([np.zeros((0, 5)), *bounds_m])
    counts = np.zeros((cloud.parts, int(starts[-1]), 3), dtype=np.int32)
    sums = np.zeros((cloud.parts, int(starts[-1]), 2), dtype=np.int64)

    def add(part: int, piece: slice) -> None:
        blocks = drawn[piece.start // BLOCK_POINTS :]
        own = (blocks, counts[part], sums[part])
        sum_assigned(piece_of(points, piece), slabs, bounds, tables, *own)

    each_part(len(points.x), cloud.parts, add)
    columns = [*counts.sum(axis=0, dtype=np.int64).T, *sums.sum(axis=0).T]
    return [
        CellSums(
            *(column[start : start + math.prod(r.shape)].reshape(r.shape) for column in columns)
        )
        for r, start in zip(rasters, starts, strict=False)
    ]


def crowded_cells(sums: CellSums) -> NDArray[np.bool_]:
    """Return the cells whose points concentrate on the plane instead of filling the tolerance.

    A cell needs at least three points, of which significantly more must be in the inner slab than
    expected by chance. At least three of its eight neighbours must meet the same criteria; this
    excludes scattered clutter.
    """
    wanted = _CROWDED_SHARE * sums.n_near + 0.5 * np.sqrt(sums.n_near)
    crowded = (sums.n_near >= 3) & (sums.n_inner >= wanted)
    if crowded.any():
        # Cells with far fewer points than usual contain only stray points.
        crowded &= sums.n_near >= 0.02 * np.median(sums.n_near[crowded])
    # The sum includes the cell itself.
    return crowded & (summed_around(crowded) >= 4)


def summed_around(values: NDArray[np.int64] | NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the sums of each value in an array (rows, columns) and its eight neighbours."""
    import cv2

    zero = cv2.BORDER_CONSTANT
    sums = cv2.boxFilter(values.astype(np.float64), -1, (3, 3), normalize=False, borderType=zero)
    return np.rint(np.asarray(sums)).astype(np.int64)


def support_of(
    raster: SurfaceRaster,
    belongs: NDArray[np.bool_],
    sums: CellSums,
    *,
    join_parts: bool = True,
    part_share: float = PART_SHARE,
) -> Support | None:
    """Group cells into connected parts, and compute the rectangles of these.

    Cells are connected across gaps of up to four cells. All parts with at least `part_share` of the
    cells are kept, so that the rectangle contains the entire wall, even if a pilaster divides it.
    Without `join_parts`, only the part with the most points is kept.

    Returns:
        The support; None if no cell belongs to the plane or no part is large enough.
    """
    import cv2
    from scipy import ndimage

    if not belongs.any():
        return None
    reach, margin = 2 * _GAP_CELLS + 1, 2 * _GAP_CELLS
    wide = np.pad(belongs.astype(np.uint8), margin)
    closed = cv2.morphologyEx(wide, cv2.MORPH_CLOSE, np.ones((reach, reach), dtype=np.uint8))
    closed = closed[margin:-margin, margin:-margin]
    names, n_parts = ndimage.label(closed, np.ones((3, 3), dtype=int))
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
        parts_m=np.array([raster.bounds_m(part_of_cell == part) for part in range(len(kept))]),
        bounds_m=raster.bounds_m(cells),
        n_points=int(sums.n_near[cells].sum()),
    )


def covering_rectangles(
    raster: SurfaceRaster, cells: NDArray[np.bool_], most: int
) -> NDArray[np.float64]:
    """Return rectangles (r, 4) that cover cells: smallest and largest u, and the same for v.

    If the cells cover at least `_FILLED_SHARE` of the rectangle around them, it is not divided.
    Otherwise, rectangles are repeatedly divided by the cut that leaves the smallest area, until
    this share is reached. A frame therefore does not get points of the wall inside it.
    """
    every = max(1, math.ceil(max(cells.shape) / _CUT_CELLS))
    rows, columns = (math.ceil(side / every) for side in cells.shape)
    padded = np.zeros((rows * every, columns * every), dtype=bool)
    padded[: cells.shape[0], : cells.shape[1]] = cells
    coarse = np.asarray(padded.reshape(rows, every, columns, every).any(axis=(1, 3)))
    whole = _tight(coarse, (0, rows, 0, columns))
    cuts = {whole: _best_cut(coarse, whole)}
    while len(cuts) < most and coarse.sum() < _FILLED_SHARE * _area(cuts):
        saved = {old: _area([old]) - _area(new) for old, new in cuts.items()}
        best = max(cuts, key=saved.__getitem__)
        if saved[best] <= 0:
            break
        cuts |= {new: _best_cut(coarse, new) for new in cuts.pop(best)}
    edges = np.array(list(cuts), dtype=np.float64)[:, [2, 3, 0, 1]]
    return np.asarray(raster.low_m[[0, 0, 1, 1]] + every * raster.cell_m * edges)


# First row, end row, first column, end column.
_Rectangle = tuple[int, int, int, int]


def _best_cut(cells: NDArray[np.bool_], rectangle: _Rectangle) -> list[_Rectangle]:
    """Divide a rectangle into the two smallest ones that cover its cells, if this saves area."""
    top, bottom, left, right = rectangle
    part = cells[top:bottom, left:right]
    row, column = (
        int(np.argmin(_heads(lines)[:-1] + _heads(lines[::-1])[-2::-1])) + 1
        if len(lines) > 1
        else 0
        for lines in (part, part.T)
    )
    pairs = [
        ((top, top + row, left, right), (top + row, bottom, left, right)),
        ((top, bottom, left, left + column), (top, bottom, left + column, right)),
    ]
    halves = [[_tight(cells, first), _tight(cells, second)] for first, second in pairs]
    return min([[rectangle], *halves], key=_area)


def _heads(lines: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return areas (n,) of the smallest rectangles around cells in the first 1 to n lines."""
    held, places = lines.any(axis=1), np.arange(1, len(lines) + 1)
    low = np.where(held, lines.argmax(axis=1), lines.shape[1])
    high = np.where(held, lines.shape[1] - lines[:, ::-1].argmax(axis=1), 0)
    ends = np.maximum.accumulate(np.where(held, places, 0))
    starts = np.minimum.accumulate(np.where(held, places - 1, len(lines)))
    across = np.maximum.accumulate(high) - np.minimum.accumulate(low)
    return np.asarray((ends - starts) * across)


def _tight(cells: NDArray[np.bool_], rectangle: _Rectangle) -> _Rectangle:
    """Return the smallest rectangle around the cells in a rectangle; of area 0 without cells."""
    top, bottom, left, right = rectangle
    part = cells[top:bottom, left:right]
    rows, columns = (np.flatnonzero(part.any(axis=axis)).tolist() for axis in (1, 0))
    if not rows:
        return (top, top, left, left)
    return (top + rows[0], top + rows[-1] + 1, left + columns[0], left + columns[-1] + 1)


def _area(rectangles: Iterable[_Rectangle]) -> int:
    return sum((bottom - top) * (right - left) for top, bottom, left, right in rectangles)
