"""The cloud while planes are taken from it: who has which point, and what is left per plan cell."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.plane_kernels import claim_slab
from orthoflow.geometry.point_kernels import (
    BlockedPoints,
    PlanGrid,
    each_part,
    piece_of,
    plan_frame,
)
from orthoflow_plugins.plane.sampling import Sample


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
        cells: (e1, e2) int64, unclaimed points per plan cell.
        heights: (storeys,) int64, unclaimed points per storey.
        n_unclaimed: points no plane holds.
    """

    points: BlockedPoints
    sample: Sample
    grid: PlanGrid
    up: NDArray[np.float64]
    parts: int
    claims: NDArray[np.int8]
    cells: NDArray[np.int64]
    heights: NDArray[np.int64]
    n_unclaimed: int = field(init=False)

    def __post_init__(self) -> None:
        self.n_unclaimed = len(self.claims)

    @property
    def sample_claims(self) -> NDArray[np.int8]:
        """(m,) int8, plane of each sample point, -1 for none yet."""
        return self.claims[self.sample.index]

    def box_corners(self) -> NDArray[np.float64]:
        """(8, 3) offsets of the corners of the robust box, metres."""
        extent = np.array(self.grid.shape) * self.grid.cell_m
        steps = np.array(list(itertools.product((0.0, 1.0), repeat=3)))
        corners: NDArray[np.float64] = (self.grid.low_m + steps * extent) @ self.grid.basis
        return corners

    def claim(self, slabs: NDArray[np.float64], bounds: NDArray[np.float64]) -> None:
        """Give the points of the last slab to it, and count what is left."""
        taken = np.zeros((self.parts, *self.cells.shape), dtype=np.int32)
        taken_heights = np.zeros((self.parts, len(self.heights) + 1), dtype=np.int32)
        frame = plan_frame(self.grid)

        def take(part: int, piece: slice) -> None:
            claim_slab(
                piece_of(self.points, piece),
                self.claims[piece],
                slabs,
                bounds,
                frame,
                taken[part],
                taken_heights[part],
            )

        each_part(len(self.claims), self.parts, take)
        self.cells -= taken.sum(axis=0)
        in_all = taken_heights.sum(axis=0, dtype=np.int64)
        self.heights -= in_all[:-1]
        self.n_unclaimed -= int(in_all[-1])
