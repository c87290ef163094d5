"""The whole cloud as seen from a photo: what stands free before a wall hides it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.point_kernels import Offsets, in_threads, read_only
from orthoflow.geometry.visibility_kernels import (
    DepthBuffer,
    VoxelGrid,
    count_in_voxels,
    splat_points,
)
from orthoflow.products import PointCloud, Walls

_LONGEST_SIDE_PX: Final = 2048
_VOXELS_MOST: Final = 1 << 24
# Small enough to tell a chair's legs apart, large enough to hold a few points of each surface.
_VOXEL_CELLS: Final = 6.0
# No scanner measures nearer to itself; what it reports from there are errors, and many in little
# space.
_BLIND_M: Final = 0.3


@dataclass(frozen=True, kw_only=True)
class Occluders:
    """A cloud ready to be looked at from any of the photos.

    Attributes:
        origin: (3,) float64 metres.
        points: float32 offsets from the origin.
        around: how many points lie about each.
        n_least: points with fewer about them are outliers.
        threads: how many threads look at once; it does not show in the result.
    """

    origin: NDArray[np.float64]
    points: Offsets
    around: VoxelGrid
    n_least: int
    threads: int


def nothing_in_the_way(camera: ViewingCamera) -> DepthBuffer:
    """Give the depth buffer of an empty world."""
    return DepthBuffer(
        nearest=np.full((1, 1), np.inf, dtype=np.float32),
        reduction=float(max(camera.width, camera.height)),
    )


def find_occluders(
    cloud: PointCloud,
    walls: Walls,
    cameras: Sequence[ViewingCamera],
    *,
    n_least: int,
    threads: int,
) -> Occluders:
    """Count the points between cameras and walls, to know outliers and the gaps between points.

    Args:
        cloud: the whole cloud.
        walls: nothing beyond the box about walls and cameras can hide a wall.
        cameras: all of them.
        n_least: see `Occluders`.
        threads: see `Occluders`.
    """
    points = read_only(cloud.x, cloud.y, cloud.z)
    low, high = _box_between(cloud, walls, cameras)
    side = _VOXEL_CELLS * _spacing_m(walls)
    size = np.maximum(high - low, side)
    while np.prod(np.ceil(size / side)) > _VOXELS_MOST:
        side *= 1.1
    shape = np.ceil(size / side).astype(np.int64)
    counts = np.zeros((int(shape[0]), int(shape[1]), int(shape[2])), dtype=np.uint16)
    grid = VoxelGrid(low=low, side_m=float(side), counts=counts)
    count_in_voxels(points, grid)
    _sum_neighbours(counts)
    if cloud.stations is not None:
        _forget_around(grid, cloud.stations - cloud.origin)
    return Occluders(
        origin=cloud.origin, points=points, around=grid, n_least=n_least, threads=threads
    )


def depth_buffer(occluders: Occluders, camera: ViewingCamera) -> DepthBuffer:
    """Look at the cloud through a camera."""
    import cv2

    reduction = max(1, -(-max(camera.width, camera.height) // _LONGEST_SIDE_PX))
    shape = (-(-camera.height // reduction), -(-camera.width // reduction))
    flat = camera.shifted(occluders.origin).flat
    buffers = [
        DepthBuffer(nearest=np.full(shape, np.inf, dtype=np.float32), reduction=float(reduction))
        for _ in range(occluders.threads)
    ]
    edges = np.linspace(0, len(occluders.points.x), occluders.threads + 1).astype(np.int64)
    in_threads(
        [
            partial(
                splat_points,
                _part(occluders.points, slice(int(edges[k]), int(edges[k + 1]))),
                flat,
                occluders.around,
                occluders.n_least,
                buffer,
            )
            for k, buffer in enumerate(buffers)
        ]
    )
    nearest = np.minimum.reduce([buffer.nearest for buffer in buffers])
    # Closed: a hole of a pixel or two in something near does not let the wall shine through.
    window = np.ones((3, 3), dtype=np.uint8)
    closed = cv2.dilate(cv2.erode(nearest, window), window)
    return DepthBuffer(nearest=np.asarray(closed, dtype=np.float32), reduction=float(reduction))


def _part(points: Offsets, piece: slice) -> Offsets:
    return Offsets(points.x[piece], points.y[piece], points.z[piece])


def _spacing_m(walls: Walls) -> float:
    """The coarser of the finest raster's cells and the points' spacing on it."""
    wall = min(walls.walls, key=lambda wall: wall.frame.gsd_m)
    known = np.isfinite(wall.depth_m)
    density = float(wall.count[known].mean()) if known.any() else 1.0
    return wall.frame.gsd_m / math.sqrt(min(1.0, max(density, 0.1)))


def _box_between(
    cloud: PointCloud, walls: Walls, cameras: Sequence[ViewingCamera]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    places = [camera.centre_world for camera in cameras]
    for wall in walls.walls:
        corners = wall.frame.corners_world()
        places += [*(corners + walls.buffer_front_m * wall.frame.normal_world), *corners]
    between = np.array(places) - cloud.origin
    return between.min(axis=0), between.max(axis=0)


def _forget_around(grid: VoxelGrid, stations: NDArray[np.float64]) -> None:
    """Take no surface to be where a scanner is blind."""
    for station in stations:
        middle = (station - grid.low) / grid.side_m - 0.5
        reach = _BLIND_M / grid.side_m
        first = np.maximum(np.floor(middle - reach), 0).astype(np.int64)
        end = np.maximum(np.ceil(middle + reach) + 1, 0).astype(np.int64)
        part = tuple(slice(a, b) for a, b in zip(first, end, strict=True))
        ranges = np.indices(grid.counts[part].shape) + first[:, None, None, None]
        squares = ((ranges - middle[:, None, None, None]) ** 2).sum(axis=0)
        grid.counts[part][squares < reach**2] = 0


def _sum_neighbours(counts: NDArray[np.uint16]) -> None:
    """Replace each count by the sum over 3 x 3 x 3 voxels, in place."""
    for axis in range(3):
        view = np.moveaxis(counts, axis, 0)
        before = view.copy()
        view[1:] += before[:-1]
        view[:-1] += before[1:]
