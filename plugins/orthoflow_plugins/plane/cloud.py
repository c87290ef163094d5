"""A cloud made ready for detection: blocks, noise, an even sample, and what of that is on no plane.

Detectors look for planes in the sample alone. Fits and labels then take all points.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field, replace
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry.point_kernels import read_only
from orthoflow.products import PointCloud
from orthoflow_plugins.plane.detector import DetectorParams
from orthoflow_plugins.plane.kernels import (
    BlockedPoints,
    PlanCounts,
    PlanGrid,
    blocked,
    box_blocks,
    count_over_plan,
    each_part,
    piece_of,
)
from orthoflow_plugins.plane.slab_kernels import claim_slab

SAMPLE_POINTS: Final = 200_000
# More cells than this cost more than they show; the cell grows instead.
PLAN_CELLS_MOST: Final = 8_000_000
# Points that are enough to see where a scene ends.
_BOX_POINTS: Final = 20_000
_TAIL_SHARE: Final = 0.05
_GOLDEN: Final = 0.6180339887498949
# Thread-private plans and surface rasters must stay small beside the cloud.
_PARTS_MOST: Final = 8
# Clouds thinner than this in two directions are a line or a point.
_THINNEST_M: Final = 1e-4

# Noise is measured at so many places, in neighbourhoods of these radii and so many points.
_NOISE_SEEDS: Final = 600
_RADII_M: Final = (0.05, 0.1, 0.2, 0.4, 0.8)
_NEAR_LEAST: Final = 12
_NEAR_MOST: Final = 400
# A neighbourhood is flat where it spreads that many times as far along its plane as across it.
_FLATNESS: Final = 5.0
# Fewer flat places do not speak for a cloud.
_FLAT_LEAST: Final = 20
_QUARTER: Final = 0.25


# What may refuse a candidate: too few points, too little surface, none that crowd about it, a strip
# as narrow as a line, points that only pass through, a rounded surface, or a tilt not asked for.
Criterion = Literal["few", "small", "scattered", "strip", "smear", "bent", "tilt"]
# In a small cloud a plane need not show more than this share of the largest side of its box.
_SIDE_SHARE: Final = 0.02
# Claims are bytes.
_CLAIMS_MOST: Final = 127


class Claim(NamedTuple):
    """A plane that takes points.

    Attributes:
        slab: (12,) the plane, see `slab_kernels`.
        bounds_m: (5,) tolerance, then smallest and largest u and v of its rectangle.
    """

    slab: NDArray[np.float64]
    bounds_m: NDArray[np.float64]


class FreePoints(NamedTuple):
    """Points that no plane has: (m, 3) offsets, and the same for the compiled passes."""

    offsets_m: NDArray[np.float64]
    points: BlockedPoints


@dataclass(frozen=True, kw_only=True)
class Sample:
    """A few hundred thousand points that stand for all.

    Attributes:
        index: (m,) int64 positions in the cloud, ascending.
        offsets_m: (m, 3) float64 metres from the cloud's origin.
        points: the same for the compiled passes.
        n_represented: points of the cloud that one sample point stands for.
    """

    index: NDArray[np.int64]
    offsets_m: NDArray[np.float64]
    points: BlockedPoints
    n_represented: float


@dataclass(frozen=True, kw_only=True)
class PreparedCloud:
    """A cloud as the passes take it, and the plane of each of its points.

    Attributes:
        points: all points.
        sample: the sample of them.
        grid: plan cells and storeys.
        up: (3,) unit vector.
        parts: parts of parallel passes.
        claims: (n,) int8, plane of each point, -1 for none yet; `candidates.label` fills them.
        plan: all points per plan cell and per storey, where they were counted.
    """

    points: BlockedPoints
    sample: Sample
    grid: PlanGrid
    up: NDArray[np.float64]
    parts: int
    claims: NDArray[np.int8]
    plan: PlanCounts | None = None

    @property
    def sample_claims(self) -> NDArray[np.int8]:
        """(m,) int8, plane of each sample point, -1 for none yet."""
        if len(self.sample.index) == len(self.claims):
            return self.claims
        return self.claims[self.sample.index]

    def box_corners(self) -> NDArray[np.float64]:
        """(8, 3) offsets of the corners of the robust box, metres."""
        extent = np.array(self.grid.shape) * self.grid.cell_m
        steps = np.array(list(itertools.product((0.0, 1.0), repeat=3)))
        return (self.grid.low_m + steps * extent) @ self.grid.basis

    def claim_in_turn(self, slabs: NDArray[np.float64], bounds_m: NDArray[np.float64]) -> None:
        """Assign each point to the nearest of some slabs (k, 12) that hold it, the first of equals.

        In float64, unlike `slab_kernels.assign_points`; all slabs have the same (5,) bounds.
        """
        self.claims.fill(-1)

        def take(_part: int, piece: slice) -> None:
            for k in range(len(slabs)):
                points, claims = piece_of(self.points, piece), self.claims[piece]
                claim_slab(points, claims, slabs[: k + 1], bounds_m)

        each_part(len(self.claims), self.parts, take)


@dataclass(kw_only=True)
class Search:
    """A greedy search for planes: the sample while they are taken from it, and what counts as one.

    Attributes:
        cloud: the cloud.
        params: what is looked for, and when the search ends.
        tolerance_m: `params.tolerance_m`, measured where that is `auto`.
        fit_tolerance_m: `params.fit_tolerance_m`, likewise.
        claims: (m,) int8, plane of each point of the sample, -1 for none yet.
        taken: the planes that took points, in their order.
        n_points: points of the sample that no plane holds.
        refusals: what refused candidates, and the share of all points that each held.
    """

    cloud: PreparedCloud
    params: DetectorParams
    tolerance_m: float
    fit_tolerance_m: float
    claims: NDArray[np.int8] = field(init=False)
    taken: list[Claim] = field(init=False, default_factory=list)
    n_points: int = field(init=False)
    refusals: list[tuple[Criterion, float]] = field(init=False, default_factory=list)
    _free: FreePoints | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self.n_points = len(self.cloud.sample.index)
        self.claims = np.full(self.n_points, -1, dtype=np.int8)
        self.box_corners_m = self.cloud.box_corners()

    @property
    def min_area_m2(self) -> float:
        """Surface that a plane must show."""
        _, middle, high = np.sort(np.ptp(self.box_corners_m @ self.cloud.grid.basis.T, axis=0))
        return min(self.params.min_area_m2, _SIDE_SHARE * float(middle * high))

    @property
    def least_points(self) -> float:
        """Points of the sample that a plane must hold."""
        return self.params.min_share * len(self.claims)

    def free(self) -> FreePoints:
        """The points that no plane has; kept until the next claim."""
        if self._free is None:
            offsets_m = self.cloud.sample.offsets_m.take(np.flatnonzero(self.claims < 0), axis=0)
            self._free = FreePoints(offsets_m, boxed(offsets_m))
        return self._free

    def claim(self, claim: Claim) -> None:
        """Return a plane its points, but for those that an earlier one has and is nearer to."""
        self.taken.append(claim)
        slabs = np.array([item.slab for item in self.taken])
        self.n_points -= claim_slab(self.cloud.sample.points, self.claims, slabs, claim.bounds_m)
        self._free = None

    def set_aside(self, claim: Claim) -> None:
        """Let the points of a candidate that is no plane propose no other.

        Clutter near the scanner holds more points than a wall far away: its candidates, a little
        different each time, would hide that wall. Points that lie on a plane are given to it in the
        end, when all points are labelled.
        """
        if len(self.taken) < _CLAIMS_MOST - self.params.n_planes_max:
            self.claim(claim)

    def refuse(self, criterion: Criterion, n_points: float = 0.0) -> None:
        """Note what refused a candidate that holds so many points of the sample."""
        self.refusals.append((criterion, n_points / max(1, len(self.claims))))


def prepare(
    cloud: PointCloud,
    basis: NDArray[np.float64],
    *,
    cell_m: float,
    least_share: float,
    parts: int,
    counts_plan: bool = False,
) -> PreparedCloud:
    """Sample a cloud and see where its blocks lie; nothing is claimed yet.

    Args:
        cloud: the cloud.
        basis: (3, 3) rows e1, e2, up.
        cell_m: side of a plan cell.
        least_share: share of the points that a plane must hold.
        parts: threads.
        counts_plan: count the points over the plan in the same pass.

    Raises:
        ProductError: the cloud has fewer than three points, or coordinates that are not finite.
        MethodError: the points coincide or lie on one line.
    """
    sample = draw_sample(cloud)
    centred = sample.offsets_m - sample.offsets_m.mean(axis=0)
    spread_m2 = np.linalg.eigvalsh(centred.T @ centred) / len(sample.index)
    if spread_m2[1] < _THINNEST_M**2:
        where = "coincide" if spread_m2[2] < _THINNEST_M**2 else "lie on one line"
        raise MethodError(f"the {len(cloud)} points of the cloud {where}, which fixes no plane")
    grid = plan_grid(sample, basis, cell_m=cell_m, outside_share=0.25 * least_share)
    parts = max(1, min(parts, _PARTS_MOST))
    offsets = read_only(cloud.x, cloud.y, cloud.z)
    plan = count_over_plan(offsets, grid, parts=parts) if counts_plan else None
    boxes = box_blocks(offsets, parts=parts) if plan is None else plan.boxed
    if boxes.n_unusable:
        cloud.require_points(3)
    return PreparedCloud(
        points=blocked(offsets, boxes.boxes),
        sample=sample,
        grid=grid,
        up=basis[2],
        parts=parts,
        claims=np.full(len(cloud), -1, dtype=np.int8),
        plan=plan,
    )


def draw_sample(cloud: PointCloud) -> Sample:
    """Take one point from each of `SAMPLE_POINTS` equal stretches of the cloud, all of a small one.

    The place within a stretch follows the golden ratio: a fixed stride would fall in step with the
    columns of a scan, and random places would need a seed.

    Raises:
        ProductError: the cloud has fewer than three points, or coordinates that are not finite.
    """
    if len(cloud) < 3:
        cloud.require_points(3)
    index = _spread_index(len(cloud), min(SAMPLE_POINTS, len(cloud)))
    offsets = read_only(cloud.x[index], cloud.y[index], cloud.z[index])
    offsets_m = np.column_stack(offsets).astype(np.float64)
    if not np.isfinite(offsets_m).all():
        cloud.require_points(3)
    return Sample(
        index=index,
        offsets_m=offsets_m,
        points=boxed(offsets_m),
        n_represented=len(cloud) / len(index),
    )


def thinned(cloud: PointCloud, every: int) -> PointCloud:
    """Keep every n-th point, at least three, spread as those of a sample: coordinates and scan."""
    if every == 1:
        return cloud
    index = _spread_index(len(cloud), min(len(cloud), max(3, len(cloud) // every)))
    return replace(
        cloud,
        x=cloud.x[index],
        y=cloud.y[index],
        z=cloud.z[index],
        scan=None if cloud.scan is None else cloud.scan[index],
        intensity=None,
        rgb=None,
        row=None,
        column=None,
    )


def _spread_index(n_points: int, count: int) -> NDArray[np.int64]:
    stretch = n_points / max(count, 1)
    ordinal = np.arange(count)
    within = np.modf(ordinal * _GOLDEN)[0] if stretch > 1.0 else np.zeros(count)
    return np.minimum((ordinal + within) * stretch, n_points - 1).astype(np.int64)


def boxed(offsets_m: NDArray[np.float64]) -> BlockedPoints:
    """Return points (m, 3) of a sample in blocks."""
    offsets = read_only(*np.ascontiguousarray(offsets_m.T, dtype=np.float32))
    return blocked(offsets, box_blocks(offsets, parts=1).boxes)


def plan_grid(
    sample: Sample, basis: NDArray[np.float64], *, cell_m: float, outside_share: float
) -> PlanGrid:
    """Lay plan cells over the cloud without its gross outliers.

    Args:
        sample: points of the cloud.
        basis: (3, 3) rows e1, e2, up.
        cell_m: side of a cell wanted; grows when the plan would have too many.
        outside_share: share of the points that may lie outside on each side, so that mirror ghosts
            and stray points do not blow up the grid. It is well below the share a plane must have,
            so no plane worth finding is cut off.
    """
    framed = sample.offsets_m[:: max(1, len(sample.index) // _BOX_POINTS)] @ basis.T
    low, high = np.quantile(framed, (_TAIL_SHARE, 1.0 - _TAIL_SHARE), axis=0)
    # The tails may be a side room or stray echoes; only what is far beyond the scene's own size
    # can be told to be stray. A lone wall is thin one way, so the largest extent is the measure.
    reach_m = float((high - low).max())
    framed = framed[((framed >= low - reach_m) & (framed <= high + reach_m)).all(axis=1)]
    low = np.quantile(framed, outside_share, axis=0)
    high = np.quantile(framed, 1.0 - outside_share, axis=0)
    margin = 0.02 * (high - low) + 5.0 * cell_m
    low, high = low - margin, high + margin
    extent = high - low
    cell_m = max(cell_m, math.sqrt(float(extent[0] * extent[1]) / PLAN_CELLS_MOST))
    # A long, thin plan, or a tall tower, must not ask for millions of storeys either.
    cell_m = max(cell_m, float(extent.max()) / PLAN_CELLS_MOST)
    cells = np.maximum(1, np.ceil(extent / cell_m)).astype(int)
    shape = (int(cells[0]), int(cells[1]), int(cells[2]))
    return PlanGrid(basis=basis, low_m=low, cell_m=cell_m, shape=shape)


class CloudNoise(NamedTuple):
    """Noise of a cloud across its surfaces, standard deviations in metres.

    Attributes:
        single_m: of single points against their neighbours.
        shared_m: with errors that the points within 0.8 m share.
    """

    single_m: float
    shared_m: float


def measure_noise(points_m: NDArray[np.float64]) -> CloudNoise | None:
    """Measure the noise of a cloud on a sample (n, 3) of its points; None where nothing is flat.

    The points around a seed are fitted by a plane (principal components); their scatter across it
    is noise where they are flat: spread at least five times as far along the plane as across it.
    Small neighbourhoods show the noise of single points. Large ones show, too, errors that
    neighbouring points share (a bent trajectory, stereo, scans that do not fit), but also relief:
    of them the flatter quarter counts.
    """
    from scipy.spatial import cKDTree

    if len(points_m) < _NEAR_LEAST:
        return None
    tree = cKDTree(points_m)
    seeds = points_m[:: max(1, len(points_m) // _NOISE_SEEDS)]
    single = np.full(len(seeds), np.nan)
    shared = np.full(len(seeds), np.nan)
    for radius_m in _RADII_M:
        is_last = radius_m == _RADII_M[-1]
        for k in np.flatnonzero(np.isnan(single) | is_last).tolist():
            near = tree.query_ball_point(seeds[k], radius_m)
            if len(near) < _NEAR_LEAST:
                continue
            across_m = _flat_scatter_m(points_m[near[:: max(1, len(near) // _NEAR_MOST)]])
            if np.isnan(single[k]):
                single[k] = across_m
            if is_last:
                shared[k] = across_m
    known, large = single[np.isfinite(single)], shared[np.isfinite(shared)]
    if len(known) < _FLAT_LEAST:
        return None
    single_m = float(np.median(known))
    is_known = len(large) >= _FLAT_LEAST
    shared_m = float(np.quantile(large, _QUARTER)) if is_known else single_m
    return CloudNoise(single_m=single_m, shared_m=max(single_m, shared_m))


def _flat_scatter_m(points_m: NDArray[np.float64]) -> float:
    """Robust scatter across the plane of some points; NaN where they are not flat.

    The median deviation from the plane of principal components, 1.4826 times: a second surface or
    an edge among them widens the components, so such places fall out by the flatness.
    """
    relative = points_m - points_m.mean(axis=0)
    values, axes = np.linalg.eigh(relative.T @ relative / (len(points_m) - 3))
    if values[1] < _FLATNESS**2 * values[0]:
        return math.nan
    across_m = relative @ axes[:, 0]
    return float(1.4826 * np.median(np.abs(across_m - np.median(across_m))))
