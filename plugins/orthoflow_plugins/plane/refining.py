"""A candidate moved onto the surface near it, with the sample alone: parts, shrinking tolerance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane
from orthoflow_plugins.plane.candidates import Candidate, Rules
from orthoflow_plugins.plane.fitting import Freedom, refine_plane, shrinking_tolerances
from orthoflow_plugins.plane.footprints import (
    CellSums,
    Footprint,
    SurfaceRaster,
    cell_for,
    crowded_cells,
    footprint,
    measure_cells,
    surface_raster,
)
from orthoflow_plugins.plane.remainders import Remainder

# The sample may miss a plane's share by this much before the full cloud is asked.
_SAMPLE_CAUTION: Final = 0.7
# Parts are of one plane when the common fit lies not much worse in the largest than its own.
_ASKEW: Final = 1.5
_SAME_M: Final = 2e-4
# Points that are enough to move a candidate to the surface near it; the fits that follow, to the
# cells of the sample and then of all points, have all.
_FIT_POINTS: Final = 20_000
# Points that are enough to see how far a candidate's points spread.
_SPREAD_POINTS: Final = 5_000


@dataclass(frozen=True, kw_only=True)
class Refined:
    """A candidate after the sample has seen it.

    Attributes:
        plane: the plane, in offsets.
        cell_m: side of the cells that suit its points.
    """

    plane: Plane
    cell_m: float


def refine_on_sample(
    candidate: Candidate, remainder: Remainder, rules: Rules, freedom: Freedom
) -> Refined | None:
    """Move a candidate to the surface near it; None where too few of the sample crowd there."""
    sample = remainder.sample
    free_points = remainder.free_sample().offsets_m
    first, *rest = shrinking_tolerances(rules.find_m, rules.fit_m)
    start = candidate.plane if candidate.start is None else candidate.start
    some = _thinned(free_points, _FIT_POINTS)
    plane = refine_plane(some, start, first, freedom=freedom, up=remainder.up)
    if plane is None:
        return None
    distances_m = free_points @ plane.normal - plane.offset_m
    near = free_points.take(np.flatnonzero(np.abs(distances_m) <= rules.find_m), axis=0)
    sums, raster = _sample_cells(near, plane, remainder, rules)
    place = footprint(raster, crowded_cells(sums), sums, joins_parts=rules.joins_parts)
    least = _SAMPLE_CAUTION * rules.least_share * len(sample.index)
    if place is None or place.n_points < least:
        return None
    plane = _fitted_to_parts(
        plane, _thinned(near, _FIT_POINTS), raster, place, (first, *rest), freedom, remainder.up
    )
    if plane is None:
        return None
    n_represented = float(sums.n_find[place.cells].sum()) * sample.n_represented
    area_m2 = float(place.cells.sum()) * raster.cell_m**2
    return Refined(plane=plane, cell_m=cell_for(n_represented, area_m2))


def _thinned(points: NDArray[np.float64], n_most: int) -> NDArray[np.float64]:
    """Some of the points (m, 3), about so many if there are more."""
    return points[:: max(1, len(points) // n_most)]


def _fitted_to_parts(
    plane: Plane,
    near: NDArray[np.float64],
    raster: SurfaceRaster,
    place: Footprint,
    tolerances_m: tuple[float, ...],
    freedom: Freedom,
    up: NDArray[np.float64],
) -> Plane | None:
    """Fit a plane to all its parts, or to the largest alone when the others pull it askew.

    A door and a niche in one wall, at different depths, both lie near one plane that leans by some
    degrees and runs through them askew; fitted alone, each shows that it does not.
    """
    on_plane = near[_inside(near, raster, place.cells)]
    together = _shrunk(on_plane, plane, tolerances_m, freedom, up)
    if len(place.parts_m) < 2:
        return together
    largest = near[_inside(near, raster, place.cells & (place.part_of_cell == 0))]
    alone = _shrunk(largest, plane, tolerances_m, freedom, up)
    if together is None or alone is None:
        return alone
    apart_m, joint_m = (float(np.median(np.abs(p.distances_m(largest)))) for p in (alone, together))
    return together if joint_m <= _ASKEW * apart_m + _SAME_M else alone


def _shrunk(
    points: NDArray[np.float64],
    start: Plane,
    tolerances_m: tuple[float, ...],
    freedom: Freedom,
    up: NDArray[np.float64],
) -> Plane | None:
    plane: Plane | None = start
    for tolerance_m in tolerances_m:
        if plane is not None:
            plane = refine_plane(points, plane, tolerance_m, freedom=freedom, up=up)
    return plane


def _sample_cells(
    near: NDArray[np.float64], plane: Plane, remainder: Remainder, rules: Rules
) -> tuple[CellSums, SurfaceRaster]:
    """Cells of sample points on a plane; their side follows from the points' own spread."""
    probe = surface_raster(plane, remainder.box_corners(), remainder.up, cell_m=rules.find_m)
    placed = near @ probe.axes.T
    low, high = _spread(placed) if len(near) else np.zeros((2, 2))
    cell_m = max(rules.find_m, cell_for(len(near), float(np.prod(high - low))))
    raster = surface_raster(plane, remainder.box_corners(), remainder.up, cell_m=cell_m)
    free = remainder.free_sample()
    sums = measure_cells(
        free.points,
        free.claims,
        raster,
        find_m=rules.find_m,
        fit_m=rules.fit_m,
        parts=1,
    )
    return sums, raster


def _spread(placed_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2, 2) where the middle 96 % of points (m, 2) begin and end along both axes."""
    some = _thinned(placed_m, _SPREAD_POINTS)
    spread: NDArray[np.float64] = np.quantile(some, (0.02, 0.98), axis=0)
    return spread


def _inside(
    points: NDArray[np.float64], raster: SurfaceRaster, cells: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """(m,) whether points project into cells that belong."""
    placed = np.floor((points @ raster.axes.T - raster.low_m) / raster.cell_m).astype(np.int64)
    n_rows, n_columns = raster.shape
    column = np.clip(placed[:, 0], 0, n_columns - 1)
    row = np.clip(placed[:, 1], 0, n_rows - 1)
    within: NDArray[np.bool_] = cells[row, column]
    return within
