"""The cloud while planes are taken from it: who has which point, and how many have none."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.plane_kernels import claim_slab
from orthoflow.geometry.point_kernels import (
    BlockedPoints,
    PlanCounts,
    PlanGrid,
    each_part,
    piece_of,
)
from orthoflow_plugins.plane.sampling import Sample, boxed


@dataclass(frozen=True, kw_only=True)
class Taking:
    """A plane that took points.

    Attributes:
        slabs: (k, 12) all planes so far, this one last.
        bounds: (5,) find tolerance, then smallest and largest u and v of its rectangle, metres.
    """

    slabs: NDArray[np.float64]
    bounds: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class FreeSample:
    """The points of a sample that no plane has.

    Attributes:
        offsets_m: (m, 3) offsets.
        points: the same for the compiled passes.
        claims: (m,) int8, -1 each.
        n_takings: planes that had taken points.
    """

    offsets_m: NDArray[np.float64]
    points: BlockedPoints
    claims: NDArray[np.int8]
    n_takings: int


@dataclass(kw_only=True)
class Remainder:
    """The cloud while planes are taken from it.

    Attributes:
        points: all points.
        sample: the sample of them.
        grid: plan cells and storeys.
        up: (3,) unit vector.
        parts: parts of parallel passes.
        claims: (n,) int8, plane of each point, -1 for none yet.
        plan: all points per plan cell and per storey, claimed or not, where they were counted.
        takings: the planes that took points, in their order.
        n_unclaimed: points no plane holds.
    """

    points: BlockedPoints
    sample: Sample
    grid: PlanGrid
    up: NDArray[np.float64]
    parts: int
    claims: NDArray[np.int8]
    plan: PlanCounts | None = None
    takings: list[Taking] = field(default_factory=list)
    n_unclaimed: int = field(init=False)
    _free: FreeSample | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self.n_unclaimed = len(self.claims)

    def free_sample(self) -> FreeSample:
        """The sample points that no plane has; kept until the next claim."""
        if self._free is None or self._free.n_takings != len(self.takings):
            index = np.flatnonzero(self.sample_claims < 0)
            offsets_m = self.sample.offsets_m.take(index, axis=0)
            self._free = FreeSample(
                offsets_m=offsets_m,
                points=boxed(offsets_m),
                claims=np.full(len(index), -1, dtype=np.int8),
                n_takings=len(self.takings),
            )
        return self._free

    def asked(self) -> tuple[BlockedPoints, NDArray[np.int8]]:
        """Points that a pass over what no plane has must ask, and the claims of each.

        All of the cloud, or the free points alone where the sample is all of it.
        """
        if len(self.sample.index) != len(self.claims):
            return self.points, self.claims
        free = self.free_sample()
        return free.points, free.claims

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
        corners: NDArray[np.float64] = (self.grid.low_m + steps * extent) @ self.grid.basis
        return corners

    def claim(self, slabs: NDArray[np.float64], bounds: NDArray[np.float64]) -> None:
        """Give the points of the last slab to it, and count what is left."""
        taken = np.zeros(self.parts, dtype=np.int64)

        def take(part: int, piece: slice) -> None:
            taken[part] = claim_slab(
                piece_of(self.points, piece), self.claims[piece], slabs, bounds
            )

        each_part(len(self.claims), self.parts, take)
        self.n_unclaimed -= int(taken.sum())
        self.takings.append(Taking(slabs=slabs, bounds=bounds))

    def catch_up(self, other: Remainder) -> None:
        """Let the planes take points that took them from another remainder of the same cloud."""
        for taking in other.takings[len(self.takings) :]:
            self.claim(taking.slabs, taking.bounds)
