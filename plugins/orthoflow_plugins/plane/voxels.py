"""The unclaimed points of a cloud per voxel, for the 3D Hough transform."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.point_kernels import PlanGrid, each_part, piece_of, plan_frame
from orthoflow.geometry.voxel_kernels import BRICK_SIDE, count_voxels, touch_bricks
from orthoflow_plugins.plane.remainders import Remainder

# More bricks than this in the table of a scene cost more than they show; the voxels grow instead.
_BRICKS_MOST: Final = 8_000_000


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


class VoxelCounts:
    """Counts the unclaimed points of a cloud per voxel.

    Attributes:
        cell_m: side of a voxel.
        middle_m: (3,) middle of the box in the (e1, e2, up) frame of the cloud's offsets.
        extent_m: (3,) size of the box.
        basis: (3, 3) rows e1, e2, up.
    """

    def __init__(self, remainder: Remainder, cell_m: float) -> None:
        """Find which bricks have points; voxels grow where a scene would have too many."""
        grid = remainder.grid
        self.basis = grid.basis
        self.extent_m = np.array(grid.shape) * grid.cell_m
        self.cell_m = coarsened(cell_m, self.extent_m)
        self.middle_m = grid.low_m + 0.5 * self.extent_m
        shape = np.ceil(self.extent_m / (BRICK_SIDE * self.cell_m)).astype(int)
        self._low_m = grid.low_m
        self._frame = plan_frame(
            PlanGrid(
                basis=grid.basis, low_m=grid.low_m, cell_m=self.cell_m, shape=tuple(shape.tolist())
            )
        )
        touched = np.zeros((remainder.parts, *shape), dtype=np.uint8)

        def touch(part: int, piece: slice) -> None:
            touch_bricks(piece_of(remainder.points, piece), self._frame, touched[part])

        each_part(len(remainder.claims), remainder.parts, touch)
        occupied = touched.max(axis=0) > 0
        self._bricks = np.full(shape, -1, dtype=np.int32)
        self._bricks[occupied] = np.arange(np.count_nonzero(occupied), dtype=np.int32)
        self._corners = np.argwhere(occupied) * BRICK_SIDE

    def counted(self, remainder: Remainder) -> NDArray[np.int32]:
        """(bricks, voxels) unclaimed points."""
        counts = np.zeros((remainder.parts, len(self._corners), BRICK_SIDE**3), dtype=np.int32)

        def count(part: int, piece: slice) -> None:
            count_voxels(
                piece_of(remainder.points, piece),
                remainder.claims[piece],
                self._frame,
                self._bricks,
                counts[part],
            )

        each_part(len(remainder.claims), remainder.parts, count)
        total: NDArray[np.int32] = counts[0]
        for part in counts[1:]:
            total += part
        return total

    def places(self, counts: NDArray[np.int32]) -> Places:
        """Centres and counts of the voxels that have any."""
        flat = counts.reshape(-1)
        occupied = np.flatnonzero(flat)
        brick, voxel = np.divmod(occupied, BRICK_SIDE**3)
        within = np.unravel_index(voxel, (BRICK_SIDE,) * 3)
        places_m = np.empty((3, len(occupied)), dtype=np.float32)
        for axis in range(3):
            shift_m = self._low_m[axis] - self.middle_m[axis]
            cells = self._corners[brick, axis] + within[axis] + 0.5
            places_m[axis] = cells * self.cell_m + shift_m
        return Places(places_m=places_m, weights=flat[occupied])

    def raw_places(self, remainder: Remainder) -> Places:
        """All points with their own coordinates; the claimed ones have no vote."""
        points = remainder.points
        places_m = np.empty((3, len(points.x)), dtype=np.float32)
        for row, (axis, middle) in enumerate(zip(self.basis, self.middle_m, strict=True)):
            a, b, c = axis.astype(np.float32)
            places_m[row] = a * points.x + b * points.y + c * points.z - np.float32(middle)
        return Places(places_m=places_m, weights=(remainder.claims < 0).astype(np.int32))
