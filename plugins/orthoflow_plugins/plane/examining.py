"""Is a candidate a plane? Refined on the sample, then judged and fitted on all points.

The same for every detector, so that methods differ in how they look, not in how they fit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane, wall_axes
from orthoflow_plugins.plane.adjustment import AdjustedPlane, adjust_plane
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
# Share of the points in a plane's slab and rectangle that must lie in crowded cells.
_CROWDED_LEAST: Final = 0.5
# Surfaces rounder than this radius are no planes, when the rounding is what shows in their cells.
_RADIUS_LEAST_M: Final = 5.0
_BENT_SHARE: Final = 0.5
# Parts are of one plane when the common fit lies not much worse in the largest than its own.
_ASKEW: Final = 1.5
_SAME_M: Final = 2e-4
# Passes over all points that one plane may take, and the share of the fit tolerance by which a fit
# may move without asking for another.
_LOOKS_MOST: Final = 3
_SETTLED_SHARE: Final = 0.1


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A plane that a detector proposes.

    Attributes:
        plane: in the cloud's offsets, a few centimetres or a degree off.
        is_level: a floor or ceiling; a wall otherwise.
        support: the points that speak for it, by the detector's own count.
    """

    plane: Plane
    is_level: bool
    support: float


@dataclass(frozen=True, kw_only=True)
class Rules:
    """When a plane counts, and when the search ends.

    Attributes:
        find_m: points this near to a plane belong to it.
        fit_m: points this near to a plane take part in its fit.
        n_planes_most: the search ends with so many planes.
        least_share: share of all points that a plane must hold.
        stop_unclassified_share: the search ends when fewer points remain.
        tilt_most_deg: walls and floors may be off vertical and level by this.
        is_exact: keep walls exactly vertical and floors exactly level.
    """

    find_m: float
    fit_m: float
    n_planes_most: int
    least_share: float
    stop_unclassified_share: float
    tilt_most_deg: float
    is_exact: bool


@dataclass(frozen=True, kw_only=True)
class FoundPlane:
    """A plane that holds its share of the points.

    Attributes:
        raster: its cells; `raster.plane` is the plane, in the cloud's offsets.
        footprint: which cells belong, parts, rectangle.
        adjusted: the fit.
        is_level: a floor or ceiling; a wall otherwise.
    """

    raster: SurfaceRaster
    footprint: Footprint
    adjusted: AdjustedPlane
    is_level: bool

    def label_bounds(self, find_m: float) -> NDArray[np.float64]:
        """(5,) find tolerance, and the rectangle in (u, v) in which points belong to the plane."""
        grown = self.footprint.bounds_m + find_m * np.array([-1.0, 1.0, -1.0, 1.0])
        return np.concatenate([[find_m], grown])


def examine(candidate: Candidate, remainder: Remainder, rules: Rules) -> FoundPlane | None:
    """Refine a candidate and see whether it is a plane: on the sample first, then on all points."""
    freedom: Freedom = "free"
    if rules.is_exact:
        freedom = "level" if candidate.is_level else "vertical"
    refined = _refine_on_sample(candidate, remainder, rules, freedom)
    if refined is None or not _leans_little(refined, candidate, remainder.up, rules):
        return None
    corners, up = remainder.box_corners(), remainder.up
    rough = surface_raster(refined.plane, corners, up, cell_m=refined.cell_m)
    look = _look(rough, remainder, rules, freedom)
    for _ in range(_LOOKS_MOST - 1):
        # A plane that moved saw its points through a tolerance that lay askew: look again.
        if look is None or look.adjusted.moved_m < _SETTLED_SHARE * rules.fit_m:
            break
        rough = surface_raster(look.adjusted.plane, corners, up, cell_m=rough.cell_m)
        look = _look(rough, remainder, rules, freedom)
    if look is None:
        return None
    return FoundPlane(
        raster=_carried(rough, look.adjusted.plane, up),
        footprint=look.footprint,
        adjusted=look.adjusted,
        is_level=candidate.is_level,
    )


@dataclass(frozen=True, kw_only=True)
class _Look:
    """What all points say about a plane that is nearly right."""

    footprint: Footprint
    adjusted: AdjustedPlane


def _look(
    raster: SurfaceRaster, remainder: Remainder, rules: Rules, freedom: Freedom
) -> _Look | None:
    """One pass over all points: the cells that belong, and the fit to them; None for no plane."""
    sums = measure_cells(
        remainder.points,
        remainder.claims,
        raster,
        find_m=rules.find_m,
        fit_m=rules.fit_m,
        parts=remainder.parts,
    )
    place = footprint(raster, crowded_cells(sums), sums)
    if place is None or place.n_points < rules.least_share * len(remainder.claims):
        return None
    if _is_strip(place, raster) or _is_smear(place, raster, sums):
        return None
    adjusted = adjust_plane(raster, sums, place.cells, fit_m=rules.fit_m, freedom=freedom)
    if adjusted is None or _is_bent(adjusted):
        return None
    return _Look(footprint=place, adjusted=adjusted)


@dataclass(frozen=True, kw_only=True)
class _Refined:
    """A candidate after the sample has seen it: the plane, and the cell side that suits it."""

    plane: Plane
    cell_m: float


def _refine_on_sample(
    candidate: Candidate, remainder: Remainder, rules: Rules, freedom: Freedom
) -> _Refined | None:
    sample, claims = remainder.sample, remainder.sample_claims
    free_points = sample.offsets_m[claims < 0]
    first, *rest = shrinking_tolerances(rules.find_m, rules.fit_m)
    plane = refine_plane(free_points, candidate.plane, first, freedom=freedom, up=remainder.up)
    if plane is None:
        return None
    near = free_points[np.abs(free_points @ plane.normal - plane.offset_m) <= rules.find_m]
    sums, raster = _sample_cells(near, plane, remainder, rules)
    place = footprint(raster, crowded_cells(sums), sums)
    least = _SAMPLE_CAUTION * rules.least_share * len(sample.index)
    if place is None or place.n_points < least:
        return None
    plane = _fitted_to_parts(plane, near, raster, place, (first, *rest), freedom, remainder.up)
    if plane is None:
        return None
    n_represented = float(sums.n_find[place.cells].sum()) * sample.n_represented
    area_m2 = float(place.cells.sum()) * raster.cell_m**2
    return _Refined(plane=plane, cell_m=cell_for(n_represented, area_m2))


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
    low, high = np.quantile(placed, (0.02, 0.98), axis=0) if len(near) else np.zeros((2, 2))
    cell_m = max(rules.find_m, cell_for(len(near), float(np.prod(high - low))))
    raster = surface_raster(plane, remainder.box_corners(), remainder.up, cell_m=cell_m)
    sums = measure_cells(
        remainder.sample.points,
        remainder.sample_claims,
        raster,
        find_m=rules.find_m,
        fit_m=rules.fit_m,
        parts=1,
    )
    return sums, raster


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


def _leans_little(
    refined: _Refined, candidate: Candidate, up: NDArray[np.float64], rules: Rules
) -> bool:
    tilt_deg = math.degrees(math.asin(min(1.0, abs(float(refined.plane.normal @ up)))))
    if candidate.is_level:
        return tilt_deg >= 90.0 - rules.tilt_most_deg
    return tilt_deg <= rules.tilt_most_deg


def _is_strip(place: Footprint, raster: SurfaceRaster) -> bool:
    """Whether the cells form a line, about which a plane may turn as it likes."""
    width_m = min(place.bounds_m[1] - place.bounds_m[0], place.bounds_m[3] - place.bounds_m[2])
    return bool(width_m < 2.5 * raster.cell_m)


def _is_smear(place: Footprint, raster: SurfaceRaster, sums: CellSums) -> bool:
    """Whether most points in the rectangle's slab only pass through it, as on a rounded body."""
    u, v = raster.centres_m()
    left, right, top, bottom = place.bounds_m
    within = (u > left) & (u < right) & (v > top) & (v < bottom)
    return bool(place.n_points < _CROWDED_LEAST * sums.n_find[within].sum())


def _is_bent(adjusted: AdjustedPlane) -> bool:
    """Whether the cells lie on a column or barrel that the plane only touches."""
    return adjusted.bend_per_m > 1.0 / _RADIUS_LEAST_M and adjusted.bend_share > _BENT_SHARE


def _carried(raster: SurfaceRaster, plane: Plane, up: NDArray[np.float64]) -> SurfaceRaster:
    """The raster on the plane after its last small correction, with the same cells."""
    return SurfaceRaster(
        plane=plane,
        axes=wall_axes(plane.normal, up),
        low_m=raster.low_m,
        cell_m=raster.cell_m,
        shape=raster.shape,
    )
