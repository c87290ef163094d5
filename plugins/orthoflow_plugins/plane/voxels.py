"""The points of a cloud per voxel, for the 3D Hough transform."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.point_kernels import (
    BLOCK_POINTS,
    BlockedPoints,
    PlanGrid,
    each_part,
    piece_of,
    plan_frame,
)
from orthoflow.geometry.voxel_kernels import BRICK_SIDE, gather_voxels
from orthoflow_plugins.plane.remainders import Remainder, Taking

T = TypeVar("T", bound=np.generic)

# More bricks than this in the table of a scene cost more than they show; the voxels grow instead.
_BRICKS_MOST: Final = 8_000_000
# Rows that a table begins with.
_ROWS_FIRST: Final = 2_048


@dataclass(frozen=True, kw_only=True)
class Places:
    """Where votes come from.

    Attributes:
        places_m: (3, m) float32 e1, e2 and height from the middle of the box.
        weights: (m,) int32 votes of each.
    """

    places_m: NDArray[np.float32]
    weights: NDArray[np.int32]


def coarsened(cell_m: float, extent_m: NDArray[np.float64]) -> float:
    """Enlarge cells until a scene of (3,) this size has at most `_BRICKS_MOST` bricks of them."""
    brick_m3 = float(np.prod(extent_m + BRICK_SIDE * cell_m)) / _BRICKS_MOST
    return max(cell_m, math.cbrt(brick_m3) / BRICK_SIDE)


def with_room(values: NDArray[T], n_used: int, n_free: int) -> NDArray[T]:
    """Enlarge a table unless so many of its rows are free; what is in use stays."""
    if n_used + n_free <= len(values):
        return values
    larger = np.zeros((max(2 * n_used, n_used + n_free), *values.shape[1:]), dtype=values.dtype)
    larger[:n_used] = values[:n_used]
    return larger


class VoxelCounts:
    """Counts the points of a cloud per voxel, in one pass.

    Attributes:
        cell_m: side of a voxel.
        middle_m: (3,) middle of the box in the (e1, e2, up) frame of the cloud's offsets.
        extent_m: (3,) size of the box.
        basis: (3, 3) rows e1, e2, up.
        middles_m: (3, m) float32 middles of the voxels with points, from the middle of the box.
        left: (m,) int32 points in them that no plane has taken.
    """

    def __init__(self, remainder: Remainder, cell_m: float) -> None:
        """Count all points; voxels grow where a scene would have too many."""
        grid = remainder.grid
        self.basis = grid.basis
        self.extent_m = np.array(grid.shape) * grid.cell_m
        self.cell_m = coarsened(cell_m, self.extent_m)
        self.middle_m = grid.low_m + 0.5 * self.extent_m
        a, b, c = np.ceil(self.extent_m / (BRICK_SIDE * self.cell_m)).astype(int).tolist()
        shape = (a, b, c)
        self._low_m = grid.low_m
        self._frame = plan_frame(
            PlanGrid(basis=grid.basis, low_m=grid.low_m, cell_m=self.cell_m, shape=shape)
        )
        tables = [_Table(int(np.prod(shape))) for _ in range(remainder.parts)]

        def count(part: int, piece: slice) -> None:
            tables[part].gather(piece_of(remainder.points, piece), self._frame, shape)

        each_part(len(remainder.claims), remainder.parts, count)
        bricks = np.max([table.bricks for table in tables], axis=0) >= 0
        counts = np.zeros((np.count_nonzero(bricks), BRICK_SIDE**3), dtype=np.int32)
        for table in tables:
            rows = table.bricks[bricks]
            counts[rows >= 0] += table.counts[rows[rows >= 0]]
        self._corners = np.column_stack(np.unravel_index(np.flatnonzero(bricks), shape))
        brick, voxel = np.divmod(np.flatnonzero(counts), BRICK_SIDE**3)
        self.left = counts[brick, voxel]
        self.middles_m = self._middles_m(brick, voxel)
        self._n_takings = 0

    def take(self, takings: list[Taking]) -> Places:
        """Take points away for the planes that are new, and give what they took, negative.

        A plane takes a voxel whose middle is near enough, as a whole: that is the paper's zeroing
        of counters, and costs no pass over the points.
        """
        taken = np.zeros(len(self.left), dtype=bool)
        for taking in takings[self._n_takings :]:
            taken |= self._is_within(taking)
        self._n_takings = len(takings)
        index = np.flatnonzero(taken & (self.left > 0))
        weights = -self.left[index]
        self.left[index] = 0
        return Places(places_m=self.middles_m[:, index], weights=weights)

    def near(self, axis: NDArray[np.float64], distance_m: float, reach_m: float) -> Places:
        """Voxels with points left whose middle is near a plane of the box's frame."""
        heights = axis.astype(np.float32) @ self.middles_m - np.float32(distance_m)
        index = np.flatnonzero((np.abs(heights) < reach_m) & (self.left > 0))
        return Places(places_m=self.middles_m[:, index], weights=self.left[index])

    def _middles_m(self, brick: NDArray[np.int64], voxel: NDArray[np.int64]) -> NDArray[np.float32]:
        within = np.unravel_index(voxel, (BRICK_SIDE,) * 3)
        places_m = np.empty((3, len(brick)), dtype=np.float32)
        for axis in range(3):
            shift_m = self._low_m[axis] - self.middle_m[axis]
            cells = self._corners[brick, axis] * BRICK_SIDE + within[axis] + 0.5
            places_m[axis] = cells * self.cell_m + shift_m
        return places_m

    def _is_within(self, taking: Taking) -> NDArray[np.bool_]:
        """(m,) whether the occupied voxels are within a plane's tolerance and rectangle."""
        slab, bounds = taking.slabs[-1], taking.bounds
        within = np.ones(len(self.left), dtype=bool)
        for row in range(3):
            axis = self.basis @ slab[4 * row : 4 * row + 3]
            shift = slab[4 * row + 3] - float(axis @ self.middle_m)
            along_m = axis.astype(np.float32) @ self.middles_m
            # A voxel that the plane runs through holds points of it, however large it is.
            half_m = 0.5 * self.cell_m * float(np.abs(axis).sum())
            reach_m = max(bounds[0], half_m)
            low_m = -reach_m if row == 0 else bounds[2 * row - 1] - half_m
            high_m = reach_m if row == 0 else bounds[2 * row] + half_m
            within &= (along_m >= shift + low_m) & (along_m <= shift + high_m)
        return within

    def raw_places(self, remainder: Remainder) -> Places:
        """All points with their own coordinates; the claimed ones have no vote."""
        points = remainder.points
        places_m = np.empty((3, len(points.x)), dtype=np.float32)
        for row, (axis, middle) in enumerate(zip(self.basis, self.middle_m, strict=True)):
            a, b, c = axis.astype(np.float32)
            places_m[row] = a * points.x + b * points.y + c * points.z - np.float32(middle)
        return Places(places_m=places_m, weights=(remainder.claims < 0).astype(np.int32))


class _Table:
    """Bricks as one part of the pass met them."""

    def __init__(self, n_bricks: int) -> None:
        self.bricks = np.full(n_bricks, -1, dtype=np.int32)
        self.counts = np.zeros((_ROWS_FIRST, BRICK_SIDE**3), dtype=np.int32)
        self._n_used = np.zeros(1, dtype=np.int64)

    def gather(
        self, points: BlockedPoints, frame: NDArray[np.float32], shape: tuple[int, int, int]
    ) -> None:
        """Count points, with more room whenever the table is full."""
        start = 0
        while start < len(points.x):
            self.counts = with_room(self.counts, int(self._n_used[0]), BLOCK_POINTS)
            start = gather_voxels(
                points, start, frame, shape, self.bricks, self.counts, self._n_used
            )
