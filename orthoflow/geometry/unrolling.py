"""Unrolling of points near a curved surface onto a plane, to rasterise them like a wall."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.bends import NARROWEST
from orthoflow.geometry.slabs import OffsetPoints, Slab

# So many points fit into the processor's cache.
_CHUNK: Final = 1 << 14
# Number of positions along the arc from which the bounding box of a curved slab is computed.
_PLACES: Final = 65


@dataclass(frozen=True, kw_only=True)
class UnrolledPoints:
    """Points of a curved slab, moved to the same cells and depths of its flat frame.

    Attributes:
        index: (n,) int64 index of the points in their cloud, ascending.
        origin: (3,) metres, origin of the frame.
        x: (n,) float32 offsets from the origin along x, metres; y and z likewise.
        y: see x.
        z: see x.
    """

    index: NDArray[np.int64]
    origin: NDArray[np.float64]
    x: NDArray[np.float32]
    y: NDArray[np.float32]
    z: NDArray[np.float32]

    @property
    def boxes_m(self) -> None:
        """Return None, because all points are inside the slab."""


def unrolled(points: OffsetPoints, slab: Slab) -> UnrolledPoints:
    """Unroll the points inside the slab of a curved wall.

    `slab.frame.flat` has the same raster and depths for the result as `slab.frame` for the points.

    Args:
        points: points of the cloud.
        slab: slab around a curved surface. Points near its axis are left out.
    """
    frame, flat = slab.frame, slab.frame.flat
    low, high = box_around(slab)
    indices, offsets = [np.empty(0, dtype=np.int64)], [np.empty((0, 3), dtype=np.float32)]
    for first in range(0, points.x.size, _CHUNK):
        axes = [
            np.asarray(axis[first : first + _CHUNK], dtype=np.float64)
            for axis in (points.x, points.y, points.z)
        ]
        is_near = np.ones(axes[0].size, dtype=np.bool_)
        for axis, least, most in zip(axes, low - points.origin, high - points.origin, strict=True):
            is_near &= (axis >= least) & (axis <= most)
        near = np.flatnonzero(is_near)
        on_wall = frame.wall_from_world(
            np.column_stack([axis[near] for axis in axes]) + points.origin
        )
        is_inside = frame.shows(on_wall[:, :2])
        is_inside &= (on_wall[:, :2] < [frame.width, frame.height]).all(axis=1)
        is_inside &= (on_wall[:, 2] >= -slab.behind_m) & (on_wall[:, 2] <= slab.front_m)
        if frame.bend is not None:
            widths = frame.bend.widths(frame.gsd_m * on_wall[:, :2], on_wall[:, 2])
            is_inside &= widths >= NARROWEST
        on_wall = on_wall[is_inside]
        moved = flat.world_from_wall(on_wall[:, :2], on_wall[:, 2]) - flat.origin_world
        indices.append(first + near[is_inside])
        offsets.append(moved.astype(np.float32))
    x, y, z = (np.ascontiguousarray(axis) for axis in np.concatenate(offsets).T)
    return UnrolledPoints(
        index=np.concatenate(indices), origin=flat.origin_world.copy(), x=x, y=y, z=z
    )


def box_around(slab: Slab) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lower and upper corners of a box around a curved slab."""
    frame = slab.frame
    columns, rows = (
        np.linspace(0.0, size, _PLACES) for size in (float(frame.width), float(frame.height))
    )
    grid = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    places = np.vstack(
        [frame.world_from_wall(grid, depth_m) for depth_m in (-slab.behind_m, slab.front_m)]
    )
    # Between two of these positions, the arc of a full turn exceeds their box by less than 0.2 % of
    # its radius.
    bend = frame.bend
    slack_m = 1e-3 + (
        0.0 if bend is None else 2e-3 * (bend.deepest_m + max(slab.behind_m, slab.front_m))
    )
    return places.min(axis=0) - slack_m, places.max(axis=0) + slack_m
