"""A sample of a cloud in voxels, with a normal for each."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.rows import Rows
from orthoflow.products import PointCloud
from orthoflow_plugins.surface.kernels import (
    MOMENTS,
    VoxelTable,
    fill_voxels,
    find_normals,
)

# Points of the cloud that are searched; the final fit uses all points.
SAMPLE_POINTS: Final = 400_000
_GOLDEN: Final = 0.6180339887498949
# Fewest points of a normal, and the largest ratio of its scatter across and along the surface.
_NORMAL_POINTS: Final = 8
_FLATNESS: Final = 0.4
# Largest scatter across a surface: noise, and the sagitta of the smallest radius searched.
_THICKEST_NOISES: Final = 3.0
_THICKEST_VOXELS: Final = 0.09
# A larger scene would need more bits per coordinate of a voxel.
_MOST_VOXELS: Final = 1_000_000
_NOISE_QUANTILE: Final = 0.3


@dataclass(frozen=True, kw_only=True)
class Sample(Rows):
    """Points that represent the cloud.

    Attributes:
        index: (m,) int64 indices of the points in the cloud.
        offsets_m: (m, 3) float64 metres from the cloud's origin.
        label: (m,) int16 plane of each point, -1 for none.
    """

    index: NDArray[np.int64]
    offsets_m: NDArray[np.float64]
    label: NDArray[np.int16]


@dataclass(frozen=True, kw_only=True)
class Voxels(Rows):
    """Occupied voxels with a normal.

    Attributes:
        points: (v, 3) float64 mean of the points of each voxel, metres from the cloud's origin.
        normals: (v, 3) float64 unit vectors, towards the viewer if stations are known.
        spread_m: (v,) float64 standard deviation of the points along the normal.
        block: (v, 3) int64 position of each voxel in a coarser grid.
        n_occupied: number of voxels, including those without a normal.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    spread_m: NDArray[np.float64]
    block: NDArray[np.int64]
    n_occupied: int


def draw_sample(cloud: PointCloud, labels: NDArray[np.int16] | None) -> Sample:
    """Draw points in even steps through the cloud, at positions that follow the golden ratio."""
    count = min(SAMPLE_POINTS, len(cloud))
    stretch = len(cloud) / max(1, count)
    ordinal = np.arange(count)
    within = np.modf(ordinal * _GOLDEN)[0] if stretch > 1.0 else np.zeros(count)
    index = np.minimum((ordinal + within) * stretch, len(cloud) - 1).astype(np.int64)
    offsets = np.column_stack([cloud.x[index], cloud.y[index], cloud.z[index]])
    label = np.full(count, -1, dtype=np.int16) if labels is None else np.asarray(labels[index])
    return Sample(index=index, offsets_m=offsets.astype(np.float64), label=label)


def in_voxels(
    sample: Sample,
    cloud: PointCloud,
    voxel_m: float,
    block_voxels: int,
    noise_m: float | None = None,
) -> Voxels:
    """Sort a sample into voxels and find the normals of those with enough points in a plane.

    Args:
        sample: the points.
        cloud: their cloud, for the stations.
        voxel_m: size of a voxel.
        block_voxels: size of a block of voxels.
        noise_m: standard deviation of points across surfaces, if known; much thicker voxels are at
            edges.
    """
    points = sample.offsets_m
    low = points.min(axis=0)
    # Points that are very far away are errors; voxel numbers have 20 bits.
    near = ((points - low) < voxel_m * (_MOST_VOXELS - 2)).all(axis=1)
    points, first_of = points[near] - low, np.flatnonzero(near)
    size = 1 << max(4, math.ceil(math.log2(2 * len(points) + 1)))
    table = VoxelTable(
        keys=np.full(size, -1, dtype=np.int64),
        slots=np.zeros(size, dtype=np.int32),
        places=np.zeros((len(points), 3), dtype=np.int32),
        moments=np.zeros((len(points), MOMENTS)),
        first=np.zeros(len(points), dtype=np.int32),
    )
    count = fill_voxels(points, voxel_m, table)
    normals, spreads = np.zeros((count, 3)), np.zeros((count, 4))
    find_normals(table, count, normals, spreads)
    is_flat = (spreads[:, 3] >= _NORMAL_POINTS) & (spreads[:, 0] < _FLATNESS * spreads[:, 1])
    if noise_m is not None:
        is_flat &= spreads[:, 0] < _THICKEST_NOISES * noise_m + _THICKEST_VOXELS * voxel_m
    chosen = np.flatnonzero(is_flat)
    moments = table.moments[chosen]
    means = moments[:, 1:4] / moments[:, :1] + low
    normals = normals[chosen]
    if cloud.stations is not None and len(cloud.stations):
        own = sample.index[first_of[table.first[chosen]]]
        scan = np.zeros(len(own), dtype=np.int64) if cloud.scan is None else cloud.scan[own]
        stations = cloud.stations[np.minimum(scan, len(cloud.stations) - 1)] - cloud.origin
        facing = np.einsum("ij,ij->i", stations - means, normals)
        normals *= np.where(facing < 0.0, -1.0, 1.0)[:, None]
    return Voxels(
        points=means,
        normals=normals,
        spread_m=spreads[chosen, 0],
        block=table.places[chosen].astype(np.int64) // block_voxels,
        n_occupied=count,
    )


def noise_of(voxels: Voxels) -> float:
    """Estimate the noise of a cloud across its surfaces; 0 without flat voxels."""
    if not len(voxels.spread_m):
        return 0.0
    return float(np.quantile(voxels.spread_m, _NOISE_QUANTILE))
