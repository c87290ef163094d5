"""Candidates moved to the surface near them, verified to be planes, fitted to all points, labelled.

The same for every detector, so that methods differ in how they look, not in how they fit. A
candidate is refined on the free points of the sample with a shrinking tolerance, must hold crowded
cells of enough of them, and is fitted to those cells. Then all points take part, one pass for all
planes; or of more than 24 million every so many'th block of neighbours, drawn over the whole cloud:
neighbours share their errors, so that those left out say the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane, wall_axes
from orthoflow.geometry.threads import in_threads
from orthoflow_plugins.plane.cloud import Claim, Criterion, PreparedCloud, Search
from orthoflow_plugins.plane.detector import Candidate, leans_as_asked
from orthoflow_plugins.plane.fit import (
    SETTLED_M,
    AdjustedPlane,
    Freedom,
    adjust_plane,
    refine_plane,
    shrinking_tolerances,
)
from orthoflow_plugins.plane.kernels import BLOCK_POINTS, each_part, piece_of
from orthoflow_plugins.plane.slab_kernels import assign_points, name_labels, sum_assigned
from orthoflow_plugins.plane.support import (
    INNER_SHARE,
    CellSums,
    Support,
    SurfaceRaster,
    cell_for,
    covering_rectangles,
    crowded_cells,
    measure_cells,
    support_of,
)

# Share of the points in a plane's slab and rectangle that must lie in crowded cells.
_CROWDED_LEAST: Final = 0.5
# Cells that form a line, about which a plane may turn as it likes, are narrower than this.
_STRIP_CELLS: Final = 2.5
# Surfaces rounder than this radius are no planes, when the rounding is what shows in their cells.
_RADIUS_LEAST_M: Final = 5.0
_BENT_SHARE: Final = 0.5
# Passes over the points that one plane may take, and the share of the fit tolerance by which a fit
# may move without asking for another.
_PASSES_MOST: Final = 3
_SETTLED_SHARE: Final = 0.1
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
# Points that fix every plane better than its surface is plane; of larger clouds a part is fitted.
_FITTED_MOST: Final = 12_000_000
# No plane of the size asked for lies in the cells of candidates that were refused so.
_SET_ASIDE: Final[frozenset[Criterion]] = frozenset({"small", "strip", "bent"})
# Rectangles that one plane is cut into at most: a frame has four sides. Claims are bytes.
_RECTANGLES_MOST: Final = 8
_SLABS_MOST: Final = 127


class Refusal(NamedTuple):
    """Why a candidate is no plane, and the cells that it has."""

    criterion: Criterion
    support: Support | None


# The cells that belong to a plane and how it fits them, or why it is none.
Verdict = tuple[Support, AdjustedPlane] | Refusal


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

    def claim(self, tolerance_m: float) -> Claim:
        """What it takes: points within the tolerance of its plane and of its rectangle."""
        return _claim_of(self.raster, self.support, tolerance_m)

    def as_proposed(self, up: NDArray[np.float64]) -> FoundPlane:
        """Return it back as its detector proposed it, with the rectangle that was found for it."""
        plane = self.candidate.plane
        if float(plane.normal @ self.raster.plane.normal) < 0.0:
            plane = plane.flipped()
        return replace(self, raster=self.raster.moved_to(plane, up))


def verify(candidate: Candidate, search: Search) -> FoundPlane | None:
    """Refine a candidate and see whether it is a plane of points that no other has.

    None when it is not; `search.refusals` then says by which criterion.
    """
    up, params = search.cloud.up, search.params
    freedom = _freedom_of(candidate, search)
    refined = _refined(candidate, search, freedom)
    if refined is None:
        return None
    plane, cell_m = refined
    leans = leans_as_asked(plane.normal[None], up, candidate.constraint, params.max_tilt_deg)
    if not leans.all():
        search.refuse("tilt")
        return None
    for _ in range(_PASSES_MOST):
        raster = SurfaceRaster.over(plane, search.box_corners_m, up, cell_m)
        sums = _cells_of(search, raster, search.cloud.parts)
        verdict = _verdict(
            raster, sums, search, freedom, search.least_points, settled_m=_SETTLED_ON_SAMPLE_M
        )
        if isinstance(verdict, Refusal):
            if verdict.support is not None and verdict.criterion in _SET_ASIDE:
                search.set_aside(_claim_of(raster, verdict.support, search.tolerance_m))
            return None
        support, adjusted = verdict
        plane, cell_m = adjusted.plane, raster.cell_m
        # A plane that moved saw its points through a tolerance that lay askew: look again.
        if adjusted.moved_m < _SETTLED_SHARE * search.fit_tolerance_m:
            break
    return FoundPlane(
        raster=raster.moved_to(plane, up),
        support=support,
        adjusted=adjusted,
        candidate=candidate,
        freedom=freedom,
    )


def _claim_of(raster: SurfaceRaster, support: Support, tolerance_m: float) -> Claim:
    grown = support.bounds_m + tolerance_m * np.array([-1.0, 1.0, -1.0, 1.0])
    return Claim(raster.slab(), np.concatenate([[tolerance_m], grown]))


def fit_to_all(found: list[FoundPlane], search: Search) -> list[FoundPlane]:
    """Fit planes of the sample to all points; those that these do not bear out are left out."""
    cloud = search.cloud
    every = max(1, len(cloud.claims) // _FITTED_MOST)
    least_points = search.params.min_share * len(cloud.claims) / every
    is_open = [True] * len(found)
    for _ in range(_PASSES_MOST):
        rasters = [_fine_raster(item, search, every) for item in found]
        sums = _sums_of_all(found, rasters, is_open, search, every)
        verdicts = _verdicts(found, rasters, sums, is_open, search, least_points)
        kept, moves = [], []
        for item, raster, verdict in zip(found, rasters, verdicts, strict=True):
            if verdict is None:
                kept.append(item)
                moves.append(False)
            elif not isinstance(verdict, Refusal):
                support, adjusted = verdict
                moved = raster.moved_to(adjusted.plane, cloud.up)
                kept.append(replace(item, raster=moved, support=support, adjusted=adjusted))
                moves.append(adjusted.moved_m > _SETTLED_SHARE * search.fit_tolerance_m)
        found, is_open = kept, moves
        if not any(is_open):
            break
    return found


def label(found: list[FoundPlane], cloud: PreparedCloud, tolerance_m: float) -> None:
    """Claim all points for the nearest plane in whose rectangles they lie."""
    slabs, bounds, plane_of_slab = _slabs(found, tolerance_m)
    # The last entry is for a claim of -1.
    names = np.append(plane_of_slab, -1).astype(np.int8)

    def give(_part: int, piece: slice) -> None:
        claims = cloud.claims[piece]
        assign_points(piece_of(cloud.points, piece), claims, slabs, bounds)
        if len(slabs) > len(found):
            claims[:] = names[claims]

    each_part(len(cloud.claims), cloud.parts, give)


def name_points(cloud: PreparedCloud, names: NDArray[np.int16], labels: NDArray[np.int16]) -> None:
    """Write the label (n,) of each point; the last of (k + 1,) names is for points on no plane."""
    by_byte = np.full(256, names[-1], dtype=np.int16)
    by_byte[: len(names) - 1] = names[:-1]
    claims = cloud.claims.view(np.uint8)

    def write(_part: int, piece: slice) -> None:
        name_labels(claims[piece], by_byte, labels[piece])

    each_part(len(labels), cloud.parts, write)


def _freedom_of(candidate: Candidate, search: Search) -> Freedom:
    """What the fit of a candidate may change."""
    normal, up, limit_deg = (
        candidate.plane.normal[None],
        search.cloud.up,
        search.params.max_tilt_deg,
    )
    if not search.params.exact:
        return "free"
    if (
        candidate.constraint == "vertical"
        or leans_as_asked(normal, up, "vertical", limit_deg).all()
    ):
        return "vertical"
    return "horizontal" if leans_as_asked(normal, up, "horizontal", limit_deg).all() else "free"


def _refined(candidate: Candidate, search: Search, freedom: Freedom) -> tuple[Plane, float] | None:
    """Move a candidate to the surface near it; gives the side of the cells that suit it, too.

    None where too few points of the sample crowd there.
    """
    free_points, up = search.free().offsets_m, search.cloud.up
    first, *rest = shrinking_tolerances(search.tolerance_m, search.fit_tolerance_m)
    start = candidate.plane if candidate.start is None else candidate.start
    plane = refine_plane(_some(free_points, _FIT_POINTS), start, first, freedom=freedom, up=up)
    if plane is None:
        search.refuse("scattered")
        return None
    distances_m = free_points @ plane.normal - plane.offset_m
    near = free_points.take(np.flatnonzero(np.abs(distances_m) <= search.tolerance_m), axis=0)
    raster = _raster_for(near, plane, search)
    sums = _cells_of(search, raster, 1)
    support = support_of(raster, crowded_cells(sums), sums, join_parts=search.params.join_parts)
    if support is None or support.n_points < _SAMPLE_CAUTION * search.least_points:
        search.refuse("scattered" if support is None else "few", support.n_points if support else 0)
        return None
    # A door and a niche in one wall, at different depths, both lie near one plane that leans by
    # some degrees and runs through them askew; fitted alone, the largest shows that it does not.
    fit = partial(refine_plane, freedom=freedom, up=up)
    near = _some(near, _FIT_POINTS)
    together = fit(near[raster.covers(near, support.cells)], plane, first, *rest)
    if len(support.parts_m) > 1:
        largest = near[raster.covers(near, support.part_of_cell == 0)]
        alone = fit(largest, plane, first, *rest)
        if together is None or alone is None or _is_askew(together, alone, largest):
            together = alone
    if together is None:
        search.refuse("scattered")
        return None
    area_m2 = float(support.cells.sum()) * raster.cell_m**2
    return together, cell_for(float(sums.n_near[support.cells].sum()), area_m2)


def _is_askew(plane: Plane, own: Plane, points: NDArray[np.float64]) -> bool:
    """Whether a plane lies much further from points than their own does."""
    joint_m, own_m = (float(np.median(np.abs(p.distances_m(points)))) for p in (plane, own))
    return joint_m > _ASKEW * own_m + _SAME_M


def _some(points: NDArray[np.float64], most: int) -> NDArray[np.float64]:
    """Some of the points (m, 3), about so many if there are more."""
    return points[:: max(1, len(points) // most)]


def _raster_for(near: NDArray[np.float64], plane: Plane, search: Search) -> SurfaceRaster:
    """Cells on a plane; their side follows from the spread of the points (m, 3) near it."""
    placed = _some(near @ wall_axes(plane.normal, search.cloud.up).T, _SPREAD_POINTS)
    low, high = np.quantile(placed, (0.02, 0.98), axis=0) if len(near) else np.zeros((2, 2))
    cell_m = max(search.tolerance_m, cell_for(len(near), float(np.prod(high - low))))
    return SurfaceRaster.over(plane, search.box_corners_m, search.cloud.up, cell_m)


def _cells_of(search: Search, raster: SurfaceRaster, parts: int) -> CellSums:
    """Sums of the free points of the sample in the cells on a plane."""
    return measure_cells(
        search.free().points,
        raster,
        tolerance_m=search.tolerance_m,
        fit_tolerance_m=search.fit_tolerance_m,
        parts=parts,
    )


def _verdict(
    raster: SurfaceRaster,
    sums: CellSums,
    search: Search,
    freedom: Freedom,
    least_points: float,
    *,
    settled_m: float = SETTLED_M,
) -> Verdict:
    """The cells that belong to a plane and how it fits them, or the criterion that refuses it."""
    support = support_of(raster, crowded_cells(sums), sums, join_parts=search.params.join_parts)
    if support is None:
        search.refuse("scattered")
        return Refusal("scattered", None)
    adjusted = None
    criterion: Criterion | None = None
    u, v = raster.centres_m()
    left, right, top, bottom = support.bounds_m
    if support.n_points < least_points:
        criterion = "few"
    elif min(right - left, bottom - top) < _STRIP_CELLS * raster.cell_m:
        criterion = "strip"
    elif support.area_m2 < search.min_area_m2:
        criterion = "small"
    elif support.n_points < _CROWDED_LEAST * int(
        sums.n_near[(u > left) & (u < right) & (v > top) & (v < bottom)].sum()
    ):
        criterion = "smear"
    else:
        adjusted = adjust_plane(
            raster,
            sums,
            support.cells,
            fit_tolerance_m=search.fit_tolerance_m,
            freedom=freedom,
            settled_m=settled_m,
        )
        # On a column or barrel that the plane only touches.
        if adjusted is None or (
            adjusted.bend_per_m > 1.0 / _RADIUS_LEAST_M and adjusted.bend_share > _BENT_SHARE
        ):
            criterion = "bent"
    if adjusted is not None and criterion is None:
        return support, adjusted
    # As a share of all points, however many of them were asked.
    share = search.params.min_share * support.n_points / max(least_points, 1e-9)
    search.refusals.append((criterion or "bent", share))
    return Refusal(criterion or "bent", support)


def _verdicts(
    found: list[FoundPlane],
    rasters: list[SurfaceRaster],
    sums: list[CellSums],
    is_open: list[bool],
    search: Search,
    least_points: float,
) -> list[Verdict | None]:
    """What the sums say of each plane that is open, several planes at a time."""
    verdicts: list[Verdict | None] = [None] * len(found)
    parts = search.cloud.parts

    def judge(first: int) -> None:
        for k in range(first, len(found), parts):
            if is_open[k]:
                freedom = found[k].freedom
                verdicts[k] = _verdict(rasters[k], sums[k], search, freedom, least_points)

    in_threads([partial(judge, first) for first in range(parts)])
    return verdicts


def _fine_raster(item: FoundPlane, search: Search, every: int) -> SurfaceRaster:
    """Cells over the plane's rectangle alone, as fine as the points that are summed allow."""
    area_m2 = float(item.support.cells.sum()) * item.raster.cell_m**2
    cloud = search.cloud
    share = len(cloud.claims) / max(1, len(cloud.sample.index)) / every
    cell_m = min(item.raster.cell_m, cell_for(item.support.n_points * share, area_m2))
    left, right, top, bottom = item.claim(search.tolerance_m).bounds_m[1:]
    rows, columns = math.ceil((bottom - top) / cell_m), math.ceil((right - left) / cell_m)
    return replace(
        item.raster,
        low_m=np.array([left, top]),
        cell_m=cell_m,
        shape=(max(1, rows), max(1, columns)),
    )


def _sums_of_all(
    found: list[FoundPlane],
    rasters: list[SurfaceRaster],
    is_open: list[bool],
    search: Search,
    every: int,
) -> list[CellSums]:
    """Sums of all points in the cells of each plane that is open; others give no cells."""
    cloud = search.cloud
    shapes = [r.shape if wanted else (0, 0) for r, wanted in zip(rasters, is_open, strict=True)]
    starts = np.concatenate([[0], np.cumsum([rows * columns for rows, columns in shapes])])
    reaches_m = (search.fit_tolerance_m, INNER_SHARE * search.tolerance_m)
    rows = np.array(
        [
            (*r.low_m, 1.0 / r.cell_m, *shape, start, *reaches_m)
            for r, shape, start in zip(rasters, shapes, starts, strict=False)
        ]
    ).reshape(-1, 8)
    # Flat tables over the cells of all rasters, of each part its own.
    counts = np.zeros((cloud.parts, int(starts[-1]), 3), dtype=np.int32)
    sums = np.zeros((cloud.parts, int(starts[-1]), 2), dtype=np.int64)
    slabs, bounds, plane_of_slab = _slabs(found, search.tolerance_m)
    rows = rows[plane_of_slab]

    def add(part: int, piece: slice) -> None:
        points, drawn = piece_of(cloud.points, piece), (every, piece.start // BLOCK_POINTS)
        sum_assigned(points, slabs, bounds, rows, counts[part], sums[part], drawn)

    each_part(len(cloud.claims), cloud.parts, add)
    all_counts, all_sums = counts.sum(axis=0, dtype=np.int64), sums.sum(axis=0)
    return [
        CellSums.of(
            all_counts[start:end].reshape(*shape, 3), all_sums[start:end].reshape(*shape, 2)
        )
        for shape, start, end in zip(shapes, starts[:-1], starts[1:], strict=True)
    ]


def _slabs(
    found: list[FoundPlane], tolerance_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Return slabs (k, 12), their bounds (k, 5), and (k,) the plane that each slab is of.

    A plane has one slab over its rectangle, or several where its cells cover little of that.
    """
    bounds: list[NDArray[np.float64]] = []
    n_spare = _SLABS_MOST - len(found)
    for item in found:
        most = min(_RECTANGLES_MOST, n_spare + 1)
        own = covering_rectangles(item.raster, item.support.cells, most)
        n_spare -= len(own) - 1
        own = own + tolerance_m * np.array([-1.0, 1.0, -1.0, 1.0])
        own = np.column_stack([np.full(len(own), tolerance_m), own])
        bounds.append(own if len(own) > 1 else item.claim(tolerance_m).bounds_m[None])
    counts = [len(own) for own in bounds]
    slabs = np.array([item.raster.slab() for item in found]).reshape(-1, 12)
    return (
        np.repeat(slabs, counts, axis=0),
        np.concatenate(bounds) if bounds else np.zeros((0, 5)),
        np.repeat(np.arange(len(found), dtype=np.int64), counts),
    )
