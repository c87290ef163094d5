"""Candidates: what detectors propose, moved to the surface near it, and verified to be a plane.

The same for every detector, so that methods differ in how they look, not in how they fit. A
candidate is refined on the free points of the sample with a shrinking tolerance, must hold crowded
cells of enough of them, and is fitted to those cells; `final_fit` then takes all points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane, wall_axes
from orthoflow_plugins.plane.fitting import (
    SETTLED_M,
    AdjustedPlane,
    Freedom,
    adjust_plane,
    refine_plane,
    shrinking_tolerances,
)
from orthoflow_plugins.plane.sample import Claim, Unassigned
from orthoflow_plugins.plane.support import (
    CellSums,
    Support,
    SurfaceRaster,
    cell_for,
    crowded_cells,
    measure_cells,
    support_of,
    surface_raster,
)

# What a detector may mean by a candidate: a wall or a level within the tilt allowed, or anything.
Family = Literal["wall", "level", "any"]

# Share of the points in a plane's slab and rectangle that must lie in crowded cells.
_CROWDED_LEAST: Final = 0.5
# Surfaces rounder than this radius are no planes, when the rounding is what shows in their cells.
_RADIUS_LEAST_M: Final = 5.0
_BENT_SHARE: Final = 0.5
# Passes over the points that one plane may take, and the share of the fit tolerance by which a fit
# may move without asking for another.
PASSES_MOST: Final = 3
SETTLED_SHARE: Final = 0.1
# Planes of a sample are fitted to all points later.
_SETTLED_ON_SAMPLE_M: Final = 2e-5
# A candidate may miss a plane's share by this much before its cells are fitted.
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
class Candidate:
    """A plane that a detector proposes.

    Attributes:
        plane: in the cloud's offsets, a few centimetres or a degree off.
        family: what it may be.
        votes: the points that speak for it, by the detector's own count.
        own_tolerance_m: the tolerance that the detector found by itself, or None.
        start: where the common fit starts, if not from the plane itself.
    """

    plane: Plane
    family: Family
    votes: float
    own_tolerance_m: float | None = None
    start: Plane | None = None


# What may refuse a candidate: too few points, none that crowd about it, a strip as narrow as a
# line, points that only pass through, a rounded surface, or a tilt that was not asked for.
Criterion = Literal["few", "scattered", "strip", "smear", "bent", "tilt"]


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """Why a candidate is no plane.

    Attributes:
        criterion: what refused it.
        share: share of all points that it held.
    """

    criterion: Criterion
    share: float


@dataclass(frozen=True, kw_only=True)
class Rules:
    """When a plane counts, and when the search ends.

    Attributes:
        find_m: points this near to a plane belong to it.
        fit_m: points this near to a plane take part in its fit.
        n_planes_most: the search ends with so many planes.
        least_share: share of all points that a plane must hold.
        stop_unclassified_share: the search ends when fewer points remain.
        stop_rest_share: the search ends at a plane with a smaller share of those that remain.
        tilt_most_deg: walls and floors may be off vertical and level by this.
        is_exact: keep walls exactly vertical and floors exactly level.
        joins_parts: parts that do not touch are one plane.
    """

    find_m: float
    fit_m: float
    n_planes_most: int
    least_share: float
    stop_unclassified_share: float
    tilt_most_deg: float
    stop_rest_share: float
    is_exact: bool
    joins_parts: bool


@dataclass(frozen=True, kw_only=True)
class FoundPlane:
    """A plane that holds its share of the points.

    Attributes:
        raster: its cells; `raster.plane` is the plane, in the cloud's offsets.
        support: which cells belong, parts, rectangle.
        adjusted: the fit.
        candidate: what the detector proposed.
        freedom: what the fit could change.
    """

    raster: SurfaceRaster
    support: Support
    adjusted: AdjustedPlane
    candidate: Candidate
    freedom: Freedom

    def claim(self, find_m: float) -> Claim:
        """What it takes of the sample."""
        return Claim(slab=self.raster.slab(), bounds_m=self.label_bounds(find_m))

    def label_bounds(self, find_m: float) -> NDArray[np.float64]:
        """(5,) find tolerance, and the rectangle in (u, v) in which points belong to the plane."""
        grown = self.support.bounds_m + find_m * np.array([-1.0, 1.0, -1.0, 1.0])
        return np.concatenate([[find_m], grown])


@dataclass(frozen=True, kw_only=True)
class Verification:
    """What points say about a plane that is nearly right.

    Attributes:
        support: the cells that belong.
        adjusted: the fit to them.
    """

    support: Support
    adjusted: AdjustedPlane


def verify(
    candidate: Candidate,
    unassigned: Unassigned,
    rules: Rules,
    refusals: list[Refusal] | None = None,
) -> FoundPlane | None:
    """Refine a candidate and see whether it is a plane of points that no other has.

    Args:
        candidate: what a detector proposed.
        unassigned: the points that remain.
        rules: when a plane counts.
        refusals: gets the criterion that refused the candidate.
    """
    refused = [] if refusals is None else refusals
    corners, up = unassigned.box_corners_m, unassigned.up
    freedom = _freedom_of(candidate, up, rules)
    refined = _refined(candidate, unassigned, rules, freedom, refused)
    if refined is None:
        return None
    if not _leans_little(refined, candidate, up, rules):
        refused.append(Refusal(criterion="tilt", share=0.0))
        return None
    rough = surface_raster(refined.plane, corners, up, cell_m=refined.cell_m)
    found = _verified_on(rough, unassigned, rules, freedom, refused)
    for _ in range(PASSES_MOST - 1):
        # A plane that moved saw its points through a tolerance that lay askew: look again.
        if found is None or found.adjusted.moved_m < SETTLED_SHARE * rules.fit_m:
            break
        rough = surface_raster(found.adjusted.plane, corners, up, cell_m=rough.cell_m)
        found = _verified_on(rough, unassigned, rules, freedom, refused)
    if found is None:
        return None
    return FoundPlane(
        raster=carried(rough, found.adjusted.plane, up),
        support=found.support,
        adjusted=found.adjusted,
        candidate=candidate,
        freedom=freedom,
    )


def verification(
    raster: SurfaceRaster,
    sums: CellSums,
    rules: Rules,
    freedom: Freedom,
    *,
    n_least: float,
    settled_m: float = SETTLED_M,
    refusals: list[Refusal] | None = None,
) -> Verification | None:
    """Return which cells belong to a plane and how it fits them; None when it is none."""
    place = support_of(raster, crowded_cells(sums), sums, joins_parts=rules.joins_parts)
    adjusted = None
    criterion = _refused_by(place, raster, sums, n_least)
    if place is not None and not criterion:
        adjusted = adjust_plane(
            raster, sums, place.cells, fit_m=rules.fit_m, freedom=freedom, settled_m=settled_m
        )
        criterion = "bent" if adjusted is None or _is_bent(adjusted) else ""
    if place is None or adjusted is None or criterion:
        if refusals is not None:
            n_points = 0.0 if place is None else float(place.n_points)
            share = rules.least_share * n_points / max(n_least, 1e-9)
            refusals.append(Refusal(criterion=criterion or "bent", share=share))
        return None
    return Verification(support=place, adjusted=adjusted)


def _refused_by(
    place: Support | None, raster: SurfaceRaster, sums: CellSums, n_least: float
) -> Criterion | Literal[""]:
    """The criterion that refuses the cells of a plane, before it is fitted; empty for none."""
    if place is None:
        return "scattered"
    if place.n_points < n_least:
        return "few"
    if _is_strip(place, raster):
        return "strip"
    return "smear" if _is_smear(place, raster, sums) else ""


def carried(raster: SurfaceRaster, plane: Plane, up: NDArray[np.float64]) -> SurfaceRaster:
    """Give the raster on the plane after its last small correction, with the same cells."""
    return SurfaceRaster(
        plane=plane,
        axes=wall_axes(plane.normal, up),
        low_m=raster.low_m,
        cell_m=raster.cell_m,
        shape=raster.shape,
    )


def as_proposed(item: FoundPlane, up: NDArray[np.float64]) -> FoundPlane:
    """Give a plane back as its detector proposed it, with the rectangle that was found for it."""
    plane = item.candidate.plane
    if float(plane.normal @ item.raster.plane.normal) < 0.0:
        plane = plane.flipped()
    return replace(item, raster=carried(item.raster, plane, up))


def _freedom_of(candidate: Candidate, up: NDArray[np.float64], rules: Rules) -> Freedom:
    """What the fit of a candidate may change."""
    if not rules.is_exact:
        return "free"
    tilt_deg = math.degrees(math.asin(min(1.0, abs(float(candidate.plane.normal @ up)))))
    if candidate.family == "wall" or tilt_deg <= rules.tilt_most_deg:
        return "vertical"
    return "level" if tilt_deg >= 90.0 - rules.tilt_most_deg else "free"


def _verified_on(
    raster: SurfaceRaster,
    unassigned: Unassigned,
    rules: Rules,
    freedom: Freedom,
    refusals: list[Refusal],
) -> Verification | None:
    """One pass over the free points: the cells that belong, and the fit to them."""
    sums = measure_cells(
        unassigned.free().points,
        raster,
        find_m=rules.find_m,
        fit_m=rules.fit_m,
        parts=unassigned.parts,
    )
    return verification(
        raster,
        sums,
        rules,
        freedom,
        n_least=rules.least_share * len(unassigned.claims),
        settled_m=_SETTLED_ON_SAMPLE_M,
        refusals=refusals,
    )


def _leans_little(
    refined: _Refined, candidate: Candidate, up: NDArray[np.float64], rules: Rules
) -> bool:
    tilt_deg = math.degrees(math.asin(min(1.0, abs(float(refined.plane.normal @ up)))))
    if candidate.family == "level":
        return tilt_deg >= 90.0 - rules.tilt_most_deg
    return candidate.family == "any" or tilt_deg <= rules.tilt_most_deg


def _is_strip(place: Support, raster: SurfaceRaster) -> bool:
    """Whether the cells form a line, about which a plane may turn as it likes."""
    width_m = min(place.bounds_m[1] - place.bounds_m[0], place.bounds_m[3] - place.bounds_m[2])
    return bool(width_m < 2.5 * raster.cell_m)


def _is_smear(place: Support, raster: SurfaceRaster, sums: CellSums) -> bool:
    """Whether most points in the rectangle's slab only pass through it, as on a rounded body."""
    u, v = raster.centres_m()
    left, right, top, bottom = place.bounds_m
    within = (u > left) & (u < right) & (v > top) & (v < bottom)
    return bool(place.n_points < _CROWDED_LEAST * sums.n_find[within].sum())


def _is_bent(adjusted: AdjustedPlane) -> bool:
    """Whether the cells lie on a column or barrel that the plane only touches."""
    return adjusted.bend_per_m > 1.0 / _RADIUS_LEAST_M and adjusted.bend_share > _BENT_SHARE


@dataclass(frozen=True, kw_only=True)
class _Refined:
    """A candidate after the sample has seen it.

    Attributes:
        plane: the plane, in offsets.
        cell_m: side of the cells that suit its points.
    """

    plane: Plane
    cell_m: float


def _refined(
    candidate: Candidate,
    unassigned: Unassigned,
    rules: Rules,
    freedom: Freedom,
    refusals: list[Refusal],
) -> _Refined | None:
    """Move a candidate to the surface near it; None where too few of the sample crowd there."""
    free_points = unassigned.free().offsets_m
    first, *rest = shrinking_tolerances(rules.find_m, rules.fit_m)
    start = candidate.plane if candidate.start is None else candidate.start
    some = _thinned(free_points, _FIT_POINTS)
    plane = refine_plane(some, start, first, freedom=freedom, up=unassigned.up)
    if plane is None:
        refusals.append(Refusal(criterion="scattered", share=0.0))
        return None
    distances_m = free_points @ plane.normal - plane.offset_m
    near = free_points.take(np.flatnonzero(np.abs(distances_m) <= rules.find_m), axis=0)
    sums, raster = _cells_near(near, plane, unassigned, rules)
    place = support_of(raster, crowded_cells(sums), sums, joins_parts=rules.joins_parts)
    least = _SAMPLE_CAUTION * rules.least_share * len(unassigned.claims)
    if place is None or place.n_points < least:
        n_points = 0.0 if place is None else float(place.n_points)
        share = n_points / max(1, len(unassigned.claims))
        refusals.append(Refusal(criterion="scattered" if place is None else "few", share=share))
        return None
    plane = _fitted_to_parts(
        plane, _thinned(near, _FIT_POINTS), raster, place, (first, *rest), freedom, unassigned.up
    )
    if plane is None:
        refusals.append(Refusal(criterion="scattered", share=0.0))
        return None
    n_held = float(sums.n_find[place.cells].sum())
    area_m2 = float(place.cells.sum()) * raster.cell_m**2
    return _Refined(plane=plane, cell_m=cell_for(n_held, area_m2))


def _thinned(points: NDArray[np.float64], n_most: int) -> NDArray[np.float64]:
    """Some of the points (m, 3), about so many if there are more."""
    return points[:: max(1, len(points) // n_most)]


def _fitted_to_parts(
    plane: Plane,
    near: NDArray[np.float64],
    raster: SurfaceRaster,
    place: Support,
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


def _cells_near(
    near: NDArray[np.float64], plane: Plane, unassigned: Unassigned, rules: Rules
) -> tuple[CellSums, SurfaceRaster]:
    """Cells of free points on a plane; their side follows from the points' own spread."""
    corners_m, up = unassigned.box_corners_m, unassigned.up
    probe = surface_raster(plane, corners_m, up, cell_m=rules.find_m)
    placed = near @ probe.axes.T
    low, high = _spread(placed) if len(near) else np.zeros((2, 2))
    cell_m = max(rules.find_m, cell_for(len(near), float(np.prod(high - low))))
    raster = surface_raster(plane, corners_m, up, cell_m=cell_m)
    points = unassigned.free().points
    sums = measure_cells(points, raster, find_m=rules.find_m, fit_m=rules.fit_m, parts=1)
    return sums, raster


def _spread(placed_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2, 2) where the middle 96 % of points (m, 2) begin and end along both axes."""
    some = _thinned(placed_m, _SPREAD_POINTS)
    return np.quantile(some, (0.02, 0.98), axis=0)


def _inside(
    points: NDArray[np.float64], raster: SurfaceRaster, cells: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """(m,) whether points project into cells that belong."""
    placed = np.floor((points @ raster.axes.T - raster.low_m) / raster.cell_m).astype(np.int64)
    n_rows, n_columns = raster.shape
    column = np.clip(placed[:, 0], 0, n_columns - 1)
    row = np.clip(placed[:, 1], 0, n_rows - 1)
    return cells[row, column]
