"""A cloud made ready for detection: blocks, an even sample of it, and what of that is unassigned.

Detectors look for planes in the sample alone. Fits and labels then take all points.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry.point_kernels import read_only
from orthoflow.products import PointCloud
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
class Claim:
    """A plane that took points.

    Attributes:
        slab: (12,) the plane, see `slab_kernels`.
        bounds_m: (5,) find tolerance, then smallest and largest u and v of its rectangle.
    """

    slab: NDArray[np.float64]
    bounds_m: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class PreparedCloud:
    """A cloud as the passes take it, and the plane of each of its points.

    Attributes:
        points: all points.
        sample: the sample of them.
        grid: plan cells and storeys.
        up: (3,) unit vector.
        parts: parts of parallel passes.
        claims: (n,) int8, plane of each point, -1 for none yet; `final_fit.label` and `claim_alone`
            fill them.
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

    def claim_alone(self, claim: Claim) -> None:
        """Give one plane all points that it holds, and leave the others unclaimed."""
        self.claims.fill(-1)

        def take(_part: int, piece: slice) -> None:
            points = piece_of(self.points, piece)
            claim_slab(points, self.claims[piece], claim.slab[None], claim.bounds_m)

        each_part(len(self.claims), self.parts, take)


@dataclass(frozen=True, kw_only=True)
class FreePoints:
    """The points of a sample that no plane has.

    Attributes:
        offsets_m: (m, 3) offsets.
        points: the same for the compiled passes.
    """

    offsets_m: NDArray[np.float64]
    points: BlockedPoints


@dataclass(kw_only=True)
class Unassigned:
    """A sample while planes are taken from it, which is where detectors look for them.

    Attributes:
        sample: its points.
        box_corners_m: (8, 3) offsets of the corners of the cloud's robust box.
        up: (3,) unit vector.
        parts: parts of parallel passes.
        claims: (m,) int8, plane of each point, -1 for none yet.
        taken: the planes that took points, in their order.
        n_points: points that no plane holds.
    """

    sample: Sample
    box_corners_m: NDArray[np.float64]
    up: NDArray[np.float64]
    parts: int
    claims: NDArray[np.int8] = field(init=False)
    taken: list[Claim] = field(init=False, default_factory=list)
    n_points: int = field(init=False)
    _free: FreePoints | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self.n_points = len(self.sample.index)
        self.claims = np.full(self.n_points, -1, dtype=np.int8)

    @classmethod
    def of(cls, cloud: PreparedCloud) -> Unassigned:
        """Begin with a cloud of which no plane has anything."""
        return cls(
            sample=cloud.sample, box_corners_m=cloud.box_corners(), up=cloud.up, parts=cloud.parts
        )

    def free(self) -> FreePoints:
        """The points that no plane has; kept until the next claim."""
        if self._free is None:
            offsets_m = self.sample.offsets_m.take(np.flatnonzero(self.claims < 0), axis=0)
            self._free = FreePoints(offsets_m=offsets_m, points=boxed(offsets_m))
        return self._free

    def claim(self, claim: Claim) -> None:
        """Give a plane its points, but for those that an earlier one has and is nearer to."""
        self.taken.append(claim)
        slabs = np.array([item.slab for item in self.taken])
        self.n_points -= claim_slab(self.sample.points, self.claims, slabs, claim.bounds_m)
        self._free = None


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
    """Keep every n-th point, spread as those of a sample; at least three if there are any."""
    if every == 1:
        return cloud
    return picked(cloud, _spread_index(len(cloud), min(len(cloud), max(3, len(cloud) // every))))


def picked(cloud: PointCloud, index: NDArray[np.int64]) -> PointCloud:
    """Give some of the points, without intensity, colour and place in the scan."""
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
    """Give points (m, 3) of a sample in blocks."""
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
    return PlanGrid(
        basis=basis,
        low_m=low,
        cell_m=cell_m,
        shape=(int(cells[0]), int(cells[1]), int(cells[2])),
    )
