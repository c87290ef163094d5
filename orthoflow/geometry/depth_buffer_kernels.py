"""Kernels that render the points of a cloud into the depth buffer of a photo."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.camera_kernels import project_point
from orthoflow.geometry.compiling import compiled
from orthoflow.geometry.slabs import Offsets

# Maximum count per voxel, so that sums over 3 x 3 x 3 voxels fit into 16 bits.
COUNT_MOST: Final = 2000

# Points closer to the projection centre belong to the camera or its tripod.
_NEAREST_M: Final = 0.05
_LARGEST_SPLAT_PX: Final = 24.0


class DepthBuffer(NamedTuple):
    """Depths of the nearest points of a cloud, at a reduced scale of a photo.

    Attributes:
        nearest: (rows, cols) float32 depth along the optical axis in metres; infinite if there is
            no point.
        reduction: photo pixels per pixel of the buffer.
    """

    nearest: NDArray[np.float32]
    reduction: float


class VoxelGrid(NamedTuple):
    """Numbers of points in voxels.

    Attributes:
        low: (3,) float64 lower corner of the first voxel, metres from the origin of the cloud.
        side_m: side of a voxel.
        counts: (nx, ny, nz) uint16 number of points in each voxel, or in each voxel and its 26
            neighbours.
    """

    low: NDArray[np.float64]
    side_m: float
    counts: NDArray[np.uint16]


@compiled
def count_in_voxels(points: Offsets, grid: VoxelGrid) -> None:
    """Count points in voxels, up to `COUNT_MOST`; points outside the grid are ignored."""
    nx, ny, nz = grid.counts.shape
    low_x, low_y, low_z, per_m = grid.low[0], grid.low[1], grid.low[2], 1.0 / grid.side_m
    for i in range(points.x.shape[0]):
        a = math.floor((points.x[i] - low_x) * per_m)
        b = math.floor((points.y[i] - low_y) * per_m)
        c = math.floor((points.z[i] - low_z) * per_m)
        if 0 <= a < nx and 0 <= b < ny and 0 <= c < nz and grid.counts[a, b, c] < COUNT_MOST:
            grid.counts[a, b, c] += 1


@compiled
def splat_points(
    points: Offsets,
    camera: NDArray[np.float64],
    around: VoxelGrid,
    n_least: int,
    buffer: DepthBuffer,
) -> None:
    """Render points into a depth buffer as squares with the size of the point spacing.

    Args:
        points: offsets from the origin of the cloud.
        camera: (25,) parameters of a camera for these offsets.
        around: number of points in 3 x 3 x 3 voxels. A surface covers about 9 voxel faces in these,
            so the number determines the point spacing.
        n_least: minimum number of points around a point, including itself; other points are
            outliers.
        buffer: nearest depths so far, updated in place.
    """
    nx, ny, nz = around.counts.shape
    rows, columns = buffer.nearest.shape
    low_x, low_y, low_z, per_m = around.low[0], around.low[1], around.low[2], 1.0 / around.side_m
    focal = math.sqrt(camera[12] * camera[13])
    for i in range(points.x.shape[0]):
        x, y, z = float(points.x[i]), float(points.y[i]), float(points.z[i])
        a = math.floor((x - low_x) * per_m)
        b = math.floor((y - low_y) * per_m)
        c = math.floor((z - low_z) * per_m)
        if not (0 <= a < nx and 0 <= b < ny and 0 <= c < nz):
            continue
        n_around = around.counts[a, b, c]
        if n_around < n_least:
            continue
        u, v, distance = project_point(camera, x, y, z)
        if not distance > _NEAREST_M or math.isnan(u):
            continue
        spacing_m = 3.0 * around.side_m / math.sqrt(n_around)
        half = min(spacing_m * focal / (distance * buffer.reduction), _LARGEST_SPLAT_PX)
        u, v = u / buffer.reduction, v / buffer.reduction
        first_row, end_row = max(0, math.floor(v - half)), min(rows, math.floor(v + half) + 1)
        first, end = max(0, math.floor(u - half)), min(columns, math.floor(u + half) + 1)
        nearest = np.float32(distance)
        for row in range(first_row, end_row):
            for column in range(first, end):
                buffer.nearest[row, column] = min(buffer.nearest[row, column], nearest)
