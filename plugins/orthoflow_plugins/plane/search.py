"""The search common to all detectors: candidates are refined, verified and fitted.

Detectors differ only in the way in which they propose planes, not in the fit. A candidate is
refined, with a decreasing tolerance, on the points of the sample that are not yet assigned to a
plane (free points). It is accepted if there are enough points in cells in which points concentrate
on the plane, and is fitted to these cells. Finally, all planes are fitted to all points in one
pass. For clouds of more than 24 million points, randomly drawn blocks are used: neighbouring points
have common errors, so the other blocks would add little information.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry import Plane, wall_axes
from orthoflow.geometry.threads import in_order
from orthoflow.products import Planes, PointCloud, PointLabels
from orthoflow.sdk import DiagnosticSpec, StepContext
from orthoflow_plugins.plane.cloud import (
    MARGIN_M,
    PreparedCloud,
    blocked,
    draw_sample,
    measure_noise,
    prepare,
    thinned,
)
from orthoflow_plugins.plane.figures import draw_deviations, draw_planes, draw_thickness
from orthoflow_plugins.plane.fit import (
    SETTLED_M,
    AdjustedPlane,
    FoundPlane,
    adjust_plane,
    refine_plane,
    shrinking_tolerances,
)
from orthoflow_plugins.plane.kernels import BlockedPoints
from orthoflow_plugins.plane.planes import assemble, report_first, report_planes
from orthoflow_plugins.plane.proposing import (
    Candidate,
    Constraint,
    DetectorParams,
    Proposer,
    leans_as_asked,
)
from orthoflow_plugins.plane.support import (
    CellSums,
    Support,
    SurfaceRaster,
    cell_for,
    covering_rectangles,
    crowded_cells,
    measure_cells,
    support_of,
)
from orthoflow_plugins.plane.thickness import measure_thickness, report_thickness, row_points

# Minimum share of the points within a plane's tolerance and rectangle that are in cells in which
# points concentrate on the plane.
_CROWDED_LEAST: Final = 0.5
# Minimum width of a plane in cells; a narrower strip does not determine the rotation of the plane
# about the axis of the strip.
_STRIP_CELLS: Final = 2.5
# A surface is rejected as curved if its radius is smaller than _RADIUS_LEAST_M and its curvature
# explains at least _BENT_SHARE of the variance of its cells.
_RADIUS_LEAST_M: Final = 5.0
_BENT_SHARE: Final = 0.3
# Maximum number of passes over the points for a plane. Another pass is needed if a fit moves the
# plane by _SETTLED_SHARE of the fit tolerance or more.
_PASSES_MOST: Final = 3
_SETTLED_SHARE: Final = 0.1
# Convergence limit for planes in the sample, which are fitted to all points later.
_SETTLED_ON_SAMPLE_M: Final = 2e-5
# Minimum number of points before the cells of a candidate are fitted, as a share of the required
# number.
_SAMPLE_CAUTION: Final = 0.7
# Parts belong to the same plane if the residuals of the common fit on the largest part do not
# exceed _ASKEW times those of a fit to this part alone, plus _SAME_M.
_ASKEW: Final = 1.5
_SAME_M: Final = 2e-4
# Number of points used to move a candidate to the surface near it. Later fits, to cells of the
# sample and then of the cloud, use all points.
_FIT_POINTS: Final = 20_000
# Number of points from which the extent of a candidate is estimated.
_SPREAD_POINTS: Final = 5_000
# With this number of points, the uncertainty of planes is smaller than the deviations of surfaces
# from a plane, so only part of a larger cloud is used.
MAX_FITTED: Final = 12_000_000
# For small scenes, the minimum area is reduced to this share of the largest face of the box.
_SIDE_SHARE: Final = 0.02
# Maximum number of rectangles per plane (a frame has four sides), and of slabs, whose indices are
# stored in bytes.
_RECTANGLES_MOST: Final = 8
_SLABS_MOST: Final = 127
# Number of consecutive rejected candidates after which the search ends.
_REJECTED_MOST: Final = 60

# Reasons to reject a candidate: too few points, too small an area, no concentration of points on
# the plane, a narrow strip, points that only pass through the plane, a curved surface, or a tilt
# outside the constraint.
Criterion = Literal["few", "small", "scattered", "strip", "smear", "bent", "tilt"]
# If a candidate is rejected for one of these reasons, its points contain no plane of the required
# size.
_SET_ASIDE: Final[frozenset[Criterion]] = frozenset({"small", "strip", "bent"})

_NO_PLANE: Final = (
    "no plane was found in {count} points ({size}) with tolerance_m {tolerance:.3g} and min_share "
    "{share:.2%}: {why}; {advice} ({method})"
)
CRITERIA: Final[Mapping[Criterion, str]] = {
    "few": "the largest candidate has {share:.2%} of the points",
    "small": "the largest candidate, which has {share:.2%} of the points, covers less than "
    "{area:.2g} m2",
    "scattered": "no points concentrate on any candidate",
    "strip": "the candidates are strips too narrow for a plane",
    "smear": "most points near the largest candidate, which has {share:.2%} of all points, "
    "are not on a plane but on a surface that crosses it, such as a rounded body, or the "
    "cloud is noisier than the tolerance",
    "bent": "the largest candidate, which has {share:.2%} of the points, is a curved surface",
    "tilt": "the candidates are tilted by more than max_tilt_deg",
}
_NO_CANDIDATE: Final = "no candidate was proposed"
_ADVICE: Final = (
    "tolerances up to {wider:.3g} m find none either: lower min_area_m2 for "
    "small planes, min_share for sparse ones, or raise max_tilt_deg"
)
_ADVICE_WIDER: Final = "with tolerance_m {wider:.3g} one is found"
# If no plane is found, the search is repeated with these multiples of the tolerance, so that the
# message can recommend one of them.
_WIDER: Final = (1.5, 2.0, 3.0, 4.0, 6.0)
_NO_INTENSITY: Final = (
    "materials are distinguished by the intensity of points, which this cloud does not have: omit "
    "materials, or read a scan with intensity ({method})"
)
UNEXPLAINED: Final = DiagnosticSpec(
    code="points-on-no-plane",
    severity="warning",
    text="{share:.0%} of the points are on no plane, more than on the largest plane "
    "({largest:.0%}): walls may be missing, unless these points are vegetation, furniture or "
    "curved surfaces",
    remedy="{step}.min_share={min_share:.2g} finds smaller planes, "
    "{step}.tolerance_m={tolerance_m:.2g} rougher ones",
    rank_by="share",
)


@dataclass(kw_only=True)
class Search:
    """State of a greedy search for planes in a sample.

    Attributes:
        cloud: the cloud.
        params: criteria for planes and for the end of the search.
        is_free: (m,) True for points of the sample that are not yet assigned to a plane.
        n_points: number of these points.
        refusals: the criterion for each rejected candidate, and its share of all points.
    """

    cloud: PreparedCloud
    params: DetectorParams
    is_free: NDArray[np.bool_] = field(init=False)
    n_points: int = field(init=False)
    refusals: list[tuple[Criterion, float]] = field(init=False, default_factory=list)
    _free: tuple[NDArray[np.float64], BlockedPoints] | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self.n_points = len(self.cloud.sample.index)
        self.is_free = np.ones(self.n_points, dtype=np.bool_)
        self.box_corners_m = self.cloud.box_corners()

    @property
    def min_area_m2(self) -> float:
        """Minimum area of a plane."""
        _, middle, high = np.sort(self.cloud.extent_m - 2.0 * MARGIN_M)
        return min(self.params.min_area_m2, _SIDE_SHARE * float(middle * high))

    @property
    def least_points(self) -> float:
        """Minimum number of sample points on a plane."""
        return self.params.min_share * len(self.is_free)

    def free(self) -> tuple[NDArray[np.float64], BlockedPoints]:
        """Return the points that are not yet assigned, as offsets (m, 3) and in blocks."""
        if self._free is None:
            offsets_m = self.cloud.sample.offsets_m.take(np.flatnonzero(self.is_free), axis=0)
            self._free = offsets_m, blocked(offsets_m)
        return self._free

    def claim(self, raster: SurfaceRaster, support: Support) -> None:
        """Assign the free points near a plane, or a rejected candidate, to it."""
        points_m, bounds_m = self.cloud.sample.offsets_m, self.cloud.bounds_of(support.bounds_m)
        (x, y, z), (a, b, c) = points_m.T, raster.plane.normal
        # The sum of products is faster than a matrix product.
        away_m = np.abs(a * x + b * y + c * z - raster.plane.offset_m)
        near = np.flatnonzero((away_m <= bounds_m[0]) & self.is_free)
        u, v = (points_m[near] @ raster.axes.T).T
        held = (u >= bounds_m[1]) & (u <= bounds_m[2]) & (v >= bounds_m[3]) & (v <= bounds_m[4])
        self.is_free[near[held]] = False
        self.n_points = int(np.count_nonzero(self.is_free))
        self._free = None

    def refuse(self, criterion: Criterion, n_points: float = 0.0) -> None:
        """Record the criterion that rejects a candidate with `n_points` points of the sample."""
        self.refusals.append((criterion, n_points / max(1, len(self.is_free))))


def detect(
    cloud: PointCloud,
    params: DetectorParams,
    ctx: StepContext,
    proposer_of: Callable[[Search], Proposer],
    *,
    method: str,
) -> tuple[Planes, PointLabels]:
    """Find the planes of a cloud, and return them as products.

    Args:
        cloud: the cloud.
        params: parameters of the detector.
        ctx: the step's context.
        proposer_of: function that creates the proposer at the beginning of a search.
        method: id of the detector, for messages.

    Raises:
        ProductError: the cloud has fewer than three points, or coordinates that are not finite.
        MethodError: the points determine no plane, no plane has enough points, or `materials` is
            set although the cloud has no intensity.
    """
    if params.materials and cloud.intensity is None:
        raise MethodError(_NO_INTENSITY.format(method=method))
    moments_s = [(ctx.clock_s(), ctx.processor_s())]
    ctx.progress(0.0, "preparing the points")
    part = thinned(cloud, params.thinning)
    noise_m = measure_noise(draw_sample(part).offsets_m)
    single_m, shared_m = noise_m or (0.0, 0.0)
    tolerances_m = params.tolerances_m(single_m, shared_m)
    whole = prepare(part, *tolerances_m, parts=ctx.cores, noise_m=single_m)
    search = Search(cloud=whole, params=params)
    proposer = proposer_of(search)

    def on_found(n_found: int) -> None:
        moments_s.append((ctx.clock_s(), ctx.processor_s()))
        ctx.progress(0.8 - 0.7 * 0.9**n_found, f"plane {n_found}")

    found = find_planes(search, proposer, on_found)
    if not found:
        wider_m = _wider_tolerance_m(search, (single_m, shared_m), proposer_of)
        raise MethodError(_why_none(cloud, search, wider_m, method))
    if params.thinning > 1:
        whole = prepare(cloud, *tolerances_m, parts=ctx.cores, noise_m=single_m)
    if not params.refit:
        found = [_as_proposed(item, whole.up) for item in found]
    if params.thinning > 1 or not params.refit:
        label(found, whole)
    proposer.relabel(found, whole)
    _report_times(ctx, np.diff([*moments_s, (ctx.clock_s(), ctx.processor_s())], axis=0))
    if noise_m is not None:
        ctx.metric("noise_mm", 1000.0 * noise_m[0], "mm")
    ctx.metric("tolerance_m", tolerances_m[0], "m")
    ctx.metric("fit_tolerance_m", tolerances_m[1], "m")
    ctx.metric("thinning", params.thinning, "1")
    planes, labels = _products(cloud, whole, found, search, ctx)
    proposer.draw(ctx, planes, cloud)
    return planes, labels


def _products(
    cloud: PointCloud,
    whole: PreparedCloud,
    found: list[FoundPlane],
    search: Search,
    ctx: StepContext,
) -> tuple[Planes, PointLabels]:
    ctx.progress(0.8, "measuring deviations")
    planes, deviations, normalities, order = assemble(found, whole, cloud)
    # The last entry is for points on no plane, whose claim is -1.
    names = np.append(np.argsort(order), -1).astype(np.int16)
    labels = ctx.allocate("labels", "plane_index", (len(cloud),), np.int16).view(np.int16)
    whole.write_labels(names, labels)
    report_planes(ctx, planes, deviations, n_points=len(cloud))
    report_first(ctx, planes, deviations, normalities[0], found[order[0]], cloud)
    n_left = len(cloud) - int(deviations.n_points.sum())
    largest = int(deviations.n_points.max())
    if n_left > largest:
        ctx.report(
            UNEXPLAINED,
            share=n_left / len(cloud),
            largest=largest / len(cloud),
            min_share=search.params.min_share / 2.0,
            tolerance_m=2.0 * whole.tolerance_m,
        )
    ctx.progress(0.9, "drawing")
    draw_deviations(ctx, planes, deviations, normalities)
    plane_of_sample = names[whole.sample_claims].astype(np.int64)
    draw_planes(ctx, planes, whole.sample.offsets_m, plane_of_sample, cloud)
    materials = search.params.materials
    thickness = measure_thickness(planes, plane_of_sample, whole, cloud, materials)
    row = row_points(planes, plane_of_sample, whole, cloud)
    report_thickness(ctx, thickness)
    draw_thickness(ctx, planes, thickness, row, materials)
    scan_row = None if row is None else row.measured(materials)
    planes = replace(planes, thickness=thickness, scan_row=scan_row)
    return planes, PointLabels(plane_index=labels)


def find_planes(
    search: Search, proposer: Proposer, on_found: Callable[[int], None] = lambda _: None
) -> list[FoundPlane]:
    """Find all planes in the sample of a cloud, fit them to all points, and label the points.

    Args:
        search: the search; its free points and the claims of its cloud are set.
        proposer: the detector.
        on_found: function that is called after each plane, with the number of planes so far.
    """
    found = fit_to_all(greedy_search(search, proposer, on_found), search)
    label(found, search.cloud)
    return found


def greedy_search(
    search: Search, proposer: Proposer, on_found: Callable[[int], None] = lambda _: None
) -> list[FoundPlane]:
    """Find planes in the sample one by one until a stopping rule applies; see `find_planes`."""
    params, found, n_rejected = search.params, list[FoundPlane](), 0
    least_left = params.stop_unclassified_share * len(search.is_free)
    while len(found) < params.n_planes_max and n_rejected < _REJECTED_MOST:
        if search.n_points < least_left:
            break
        candidate = proposer.propose(search)
        if candidate is None:
            break
        plane = verify(candidate, search)
        if plane is None:
            proposer.reject()
            n_rejected += 1
            continue
        found.append(plane)
        n_rejected = 0
        search.claim(plane.raster, plane.support)
        on_found(len(found))
    return found


def verify(candidate: Candidate, search: Search) -> FoundPlane | None:
    """Refine a candidate, and check whether the free points near it form a plane.

    If they do not, the result is None, and the criterion is added to `search.refusals`. Clutter
    near the scanner has more points than a distant wall, and its many slightly different candidates
    would delay or prevent finding the wall. If a candidate is rejected for its size or shape, its
    points are therefore removed from the search. When all points are labelled, those of them that
    are on a plane are assigned to it.
    """
    up, params = search.cloud.up, search.params
    leans = partial(leans_as_asked, up=up, max_tilt_deg=params.max_tilt_deg)
    freedom: Constraint = "any"
    if params.exact:
        normal = candidate.plane.normal[None]
        if candidate.constraint == "vertical" or leans(normal, constraint="vertical").all():
            freedom = "vertical"
        elif leans(normal, constraint="horizontal").all():
            freedom = "horizontal"
    refined = _refined(candidate, search, freedom)
    if refined is None:
        return None
    plane, cell_m = refined
    if not leans(plane.normal[None], constraint=candidate.constraint).all():
        search.refuse("tilt")
        return None
    for nth in range(_PASSES_MOST):
        raster, sums, support = _observed(search, plane, cell_m)
        adjusted = _judged(raster, sums, support, search, freedom, settled_m=_SETTLED_ON_SAMPLE_M)
        if adjusted is None or support is None:
            if support is not None and search.refusals[-1][0] in _SET_ASIDE:
                search.claim(raster, support)
            return None
        plane, cell_m = adjusted.plane, raster.cell_m
        # If the fit moved the plane, its points were selected around a wrong plane, so repeat.
        if _is_settled(adjusted, search) or nth == _PASSES_MOST - 1:
            raster = raster.moved_to(plane, up)
            return FoundPlane(raster, support, adjusted, candidate, freedom)
    return None


def _is_settled(adjusted: AdjustedPlane, search: Search) -> bool:
    return adjusted.moved_m < _SETTLED_SHARE * search.cloud.fit_tolerance_m


def _observed(
    search: Search, plane: Plane, cell_m: float
) -> tuple[SurfaceRaster, CellSums, Support | None]:
    """Return a raster on a plane, sums of the free points in its cells, and the plane's cells."""
    raster = SurfaceRaster.over(plane, search.box_corners_m, search.cloud.up, cell_m)
    (sums,) = measure_cells(search.cloud, [raster], points=search.free()[1])
    join_parts = search.params.join_parts
    return raster, sums, support_of(raster, crowded_cells(sums), sums, join_parts=join_parts)


def _refined(
    candidate: Candidate, search: Search, freedom: Constraint
) -> tuple[Plane, float] | None:
    """Move a candidate to the surface near it; return the plane and a suitable cell size.

    The result is None if too few points of the sample concentrate on this surface.
    """
    cloud, free_points = search.cloud, search.free()[0]
    fit = partial(refine_plane, freedom=freedom, up=cloud.up)
    first, *rest = shrinking_tolerances(cloud.tolerance_m, cloud.fit_tolerance_m)
    start = candidate.plane if candidate.start is None else candidate.start
    plane = fit(_some(free_points, _FIT_POINTS), start, first)
    if plane is None:
        search.refuse("scattered")
        return None
    near = np.abs(free_points @ plane.normal - plane.offset_m) <= cloud.tolerance_m
    near_m = free_points.take(np.flatnonzero(near), axis=0)
    # Compute the cell size from the extent of the points.
    placed = _some(near_m @ wall_axes(plane.normal, cloud.up).T, _SPREAD_POINTS)
    low, high = np.quantile(placed, (0.02, 0.98), axis=0) if len(near_m) else np.zeros((2, 2))
    cell_m = max(cloud.tolerance_m, cell_for(len(near_m), float(np.prod(high - low)), cloud))
    raster, sums, support = _observed(search, plane, cell_m)
    if support is None or support.n_points < _SAMPLE_CAUTION * search.least_points:
        search.refuse("scattered" if support is None else "few", support.n_points if support else 0)
        return None
    # A slightly tilted plane may pass near both a door and a niche at different depths; this is
    # detected by a fit to the largest part alone.
    near_m = _some(near_m, _FIT_POINTS)
    together = fit(near_m[raster.covers(near_m, support.cells)], plane, first, *rest)
    if len(support.parts_m) > 1:
        largest_m = near_m[raster.covers(near_m, support.part_of_cell == 0)]
        alone = fit(largest_m, plane, first, *rest)
        away_m = [
            math.inf if fitted is None else float(np.median(np.abs(fitted.distances_m(largest_m))))
            for fitted in (together, alone)
        ]
        if away_m[0] > _ASKEW * away_m[1] + _SAME_M or alone is None:
            together = alone
    if together is None:
        search.refuse("scattered")
        return None
    area_m2 = float(support.cells.sum()) * raster.cell_m**2
    return together, cell_for(float(sums.n_near[support.cells].sum()), area_m2, cloud)


def _some(points: NDArray[np.float64], most: int) -> NDArray[np.float64]:
    """Return every n-th of the points (m, 3), about `most` in total."""
    return points[:: max(1, len(points) // most)]


def _judged(
    raster: SurfaceRaster,
    sums: CellSums,
    support: Support | None,
    search: Search,
    freedom: Constraint,
    *,
    every: float | None = None,
    settled_m: float = SETTLED_M,
) -> AdjustedPlane | None:
    """Fit a plane to its cells, or record the criterion by which it is rejected.

    Args:
        raster: raster on the plane.
        sums: sums over the points in each cell.
        support: cells that belong to the plane.
        search: receives the criterion.
        freedom: constraint on the orientation, which the fit keeps exactly.
        every: number of points of the cloud per point in the sums; None if the sums are over free
            points of the sample.
        settled_m: the fit has converged if it moves no cell by more than this.
    """
    if support is None:
        search.refuse("scattered")
        return None
    scale = 1.0 if every is None else every / search.cloud.sample.n_represented
    n_points, adjusted = scale * support.n_points, None
    u, v = raster.centres_m()
    left, right, top, bottom = support.bounds_m
    near_it = sums.n_near[(u > left) & (u < right) & (v > top) & (v < bottom)]
    criterion: Criterion = "bent"
    if n_points < search.least_points:
        criterion = "few"
    elif min(right - left, bottom - top) < _STRIP_CELLS * raster.cell_m:
        criterion = "strip"
    elif support.area_m2 < search.min_area_m2:
        criterion = "small"
    elif support.n_points < _CROWDED_LEAST * int(near_it.sum()):
        criterion = "smear"
    else:
        adjusted = adjust_plane(
            raster,
            sums,
            support.cells,
            fit_tolerance_m=search.cloud.fit_tolerance_m,
            freedom=freedom,
            settled_m=settled_m,
        )
    # The surface may be a column or a barrel vault that the plane only touches.
    if adjusted is None or (
        adjusted.bend_per_m > 1.0 / _RADIUS_LEAST_M and adjusted.bend_share > _BENT_SHARE
    ):
        search.refuse(criterion, n_points)
        return None
    return adjusted


def fit_to_all(found: list[FoundPlane], search: Search) -> list[FoundPlane]:
    """Fit planes of the sample to all points; omit planes that these points do not confirm."""
    cloud = search.cloud
    every = max(1, len(cloud.claims) // MAX_FITTED)
    # Draw blocks at random, because a fixed step could coincide with the columns of a scan and omit
    # stripes.
    drawn = np.random.default_rng(0).permutation(len(cloud.points.boxes)) % every == 0
    settled = [False] * len(found)
    for _ in range(_PASSES_MOST):
        rasters = [
            replace(item.raster, shape=(0, 0)) if done else _fine_raster(item, cloud, every)
            for item, done in zip(found, settled, strict=True)
        ]
        sums = measure_cells(cloud, rasters, bounds_m=_bounds(found, cloud), drawn=drawn)

        refit = partial(_refitted, search=search, every=every)
        fitted = in_order(refit, zip(found, rasters, sums, strict=True), threads=cloud.parts)
        found = [item for item in fitted if item is not None]
        settled = [_is_settled(item.adjusted, search) for item in found]
        if all(settled):
            break
    return found


def _refitted(
    part: tuple[FoundPlane, SurfaceRaster, CellSums], search: Search, every: int
) -> FoundPlane | None:
    """Return a plane fitted to its cells; unchanged without sums, None if it is rejected."""
    item, raster, sums = part
    if not math.prod(raster.shape):
        return item
    join_parts = search.params.join_parts
    support = support_of(raster, crowded_cells(sums), sums, join_parts=join_parts)
    adjusted = _judged(raster, sums, support, search, item.freedom, every=every)
    if adjusted is None or support is None:
        return None
    raster = raster.moved_to(adjusted.plane, search.cloud.up)
    return replace(item, raster=raster, support=support, adjusted=adjusted)


def _fine_raster(item: FoundPlane, cloud: PreparedCloud, every: int) -> SurfaceRaster:
    """Return a raster over the plane's rectangle, as fine as the number of points allows."""
    area_m2 = float(item.support.cells.sum()) * item.raster.cell_m**2
    share = cloud.sample.n_represented / every
    cell_m = min(item.raster.cell_m, cell_for(item.support.n_points * share, area_m2, cloud))
    _, left, right, top, bottom = cloud.bounds_of(item.support.bounds_m)
    rows, columns = math.ceil((bottom - top) / cell_m), math.ceil((right - left) / cell_m)
    shape = (max(1, rows), max(1, columns))
    return replace(item.raster, low_m=np.array([left, top]), cell_m=cell_m, shape=shape)


def _bounds(found: list[FoundPlane], cloud: PreparedCloud) -> list[NDArray[np.float64]]:
    """Return bounds (r, 5) of each plane: a rectangle, or several if it is sparsely covered."""
    bounds, n_spare = [], _SLABS_MOST - len(found)
    for item in found:
        most = min(_RECTANGLES_MOST, n_spare + 1)
        own = covering_rectangles(item.raster, item.support.cells, most)
        n_spare -= len(own) - 1
        bounds.append(cloud.bounds_of(own if len(own) > 1 else item.support.bounds_m[None]))
    return bounds


def label(found: list[FoundPlane], cloud: PreparedCloud) -> None:
    """Assign each point to the nearest plane that has a rectangle around the point."""
    bounds = _bounds(found, cloud)
    plane_of_slab = np.repeat(np.arange(len(found)), [len(own) for own in bounds])
    slabs = np.array([item.raster.slab() for item in found]).reshape(-1, 12)[plane_of_slab]
    cloud.assign(slabs, np.concatenate([np.zeros((0, 5)), *bounds]))
    if len(slabs) > len(found):
        # The last entry is for points on no plane, whose claim is -1.
        cloud.write_labels(np.append(plane_of_slab, -1).astype(np.int8), cloud.claims)


def _as_proposed(item: FoundPlane, up: NDArray[np.float64]) -> FoundPlane:
    plane = item.candidate.plane
    if float(plane.normal @ item.raster.plane.normal) < 0.0:
        plane = plane.flipped()
    return replace(item, raster=item.raster.moved_to(plane, up))


def _wider_tolerance_m(
    search: Search, noise_m: tuple[float, float], proposer_of: Callable[[Search], Proposer]
) -> float | None:
    for times in _WIDER:
        update = {"n_planes_max": 1, "tolerance_m": times * search.cloud.tolerance_m}
        params = search.params.model_copy(update=update)
        tolerance_m, fit_m = params.tolerances_m(*noise_m)
        cloud = replace(search.cloud, tolerance_m=tolerance_m, fit_tolerance_m=fit_m)
        wider = replace(search, cloud=cloud, params=params)
        if fit_to_all(greedy_search(wider, proposer_of(wider)), wider):
            return tolerance_m
    return None


def _why_none(cloud: PointCloud, search: Search, wider_m: float | None, method: str) -> str:
    why, tolerance_m = _NO_CANDIDATE, search.cloud.tolerance_m
    if search.refusals:
        criterion, share = max(search.refusals, key=lambda refusal: refusal[1])
        why = CRITERIA[criterion].format(share=share, area=search.min_area_m2)
    advice = _ADVICE.format(wider=_WIDER[-1] * tolerance_m)
    if wider_m is not None:
        advice = _ADVICE_WIDER.format(wider=wider_m)
    sides_m = (float(np.ptp(axis)) for axis in (cloud.x, cloud.y, cloud.z))
    return _NO_PLANE.format(
        count=len(cloud),
        size=" x ".join(f"{side_m:.3g}" for side_m in sides_m) + " m",
        tolerance=tolerance_m,
        share=search.params.min_share,
        why=why,
        advice=advice,
        method=method,
    )


def _report_times(ctx: StepContext, passed_s: NDArray[np.float64]) -> None:
    """Report the times of a detection, excluding loading, as in Table 1 of markiewicz2015.

    Args:
        ctx: receives the metrics.
        passed_s: (n, 2) elapsed and processor seconds: a row for each plane, and a row for the time
            from the last plane until all points are labelled.
    """
    times_s = {"detection": passed_s.sum(axis=0), "first_plane": passed_s[0]}
    if len(passed_s) > 2:
        times_s["next_plane"] = passed_s[1:-1].mean(axis=0)
    for name, (clock_s, processor_s) in times_s.items():
        ctx.metric(f"{name}_s", clock_s, "s")
        ctx.metric(f"{name}_cpu_s", processor_s, "s")
