"""A sample of a cloud in voxels, each with a normal."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from orthoflow.geometry.rows import Rows, spread_index
from orthoflow.geometry.threads import in_order, in_parts
from orthoflow.products import PointCloud
from orthoflow_plugins.surface.kernels import KEY_BITS, MOMENTS, fill_voxels, find_normals

# Maximum number of points used in the search; the final fit uses all points.
SAMPLE_POINTS: Final = 250_000
# Minimum number of points for a normal, and maximum ratio of the scatter across the surface to that
# along it.
_NORMAL_POINTS: Final = 8
_FLATNESS: Final = 0.4
# Largest scatter across a surface: noise, and the sagitta of the smallest radius searched.
_THICKEST_NOISES: Final = 3.0
_THICKEST_VOXELS: Final = 0.09
# A larger scene would need more bits per coordinate of a voxel.
_MOST_VOXELS: Final = 1_000_000 - 4
_NOISE_QUANTILE: Final = 0.3


@dataclass(frozen=True, kw_only=True)
class Sample(Rows):
    """Points that represent the cloud.

    Attributes:
        index: (m,) int64 indices of the points in the cloud.
        offsets_m: (m, 3) float64 metres from the cloud's origin.
        label: (m,) int16 index of the plane of each point; -1 for none.
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
        places: (v, 3) int64 position of each voxel in the grid, in ascending order.
        low: (3,) point from which positions are counted, metres from the cloud's origin.
        size_m: size of a voxel.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    spread_m: NDArray[np.float64]
    places: NDArray[np.int64]
    low: tuple[float, ...]
    size_m: float

    def without_edges(self, noise_m: float) -> Voxels:
        """Return the voxels with little more scatter than the noise of points."""
        thickest_m = _THICKEST_NOISES * noise_m + _THICKEST_VOXELS * self.size_m
        return self.take(self.spread_m < thickest_m)

    def at(self, points: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the index (m,) of the voxel of each point (m, 3), -1 for none."""
        keys = keys_of(self.places)
        wanted = keys_of(np.floor((points - self.low) / self.size_m).astype(np.int64) + 1)
        found = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        return np.where(keys[found] == wanted, found, -1)


def draw_sample(cloud: PointCloud, labels: NDArray[np.int16] | None, *, cores: int) -> Sample:
    """Draw one point from each of `SAMPLE_POINTS` equal parts of a cloud (see `spread_index`)."""
    count = min(SAMPLE_POINTS, len(cloud))
    index = spread_index(len(cloud), count)
    columns = in_order(lambda values: values[index], (cloud.x, cloud.y, cloud.z), threads=cores)
    offsets = np.column_stack(list(columns))
    label = np.full(count, -1, dtype=np.int16) if labels is None else np.asarray(labels[index])
    return Sample(index=index, offsets_m=offsets.astype(np.float64), label=label)


@dataclass(frozen=True, kw_only=True)
class VoxelGrid:
    """Occupied voxels of one size, ordered by their positions.

    Attributes:
        places: (v, 3) int64 position of each voxel in the grid.
        moments: (v, 10) float64 sums over the points of each voxel (see `kernels`).
        first: (v,) int64 index in the cloud of a point of each voxel.
        size_m: size of a voxel.
        low: (3,) point from which the moments are computed, metres from the cloud's origin.
    """

    places: NDArray[np.int64]
    moments: NDArray[np.float64]
    first: NDArray[np.int64]
    size_m: float
    low: NDArray[np.float64]

    def coarser(self) -> VoxelGrid:
        """Return voxels of twice the size."""
        places = (self.places + 1) >> 1
        keys = keys_of(places)
        order = np.argsort(keys, kind="stable")
        starts = np.flatnonzero(np.diff(keys[order], prepend=-1))
        ones = np.ones(len(order))
        return VoxelGrid(
            places=places[order[starts]],
            moments=sparse.csr_array((ones, order, np.append(starts, len(order)))) @ self.moments,
            first=self.first[order[starts]],
            size_m=2.0 * self.size_m,
            low=self.low,
        )

    def voxels(self, cloud: PointCloud, *, cores: int) -> Voxels:
        """Return the voxels that have a normal, i.e. enough points close to a plane.

        Args:
            cloud: the cloud, for the stations.
            cores: number of threads.
        """
        normals, spreads = np.zeros((len(self.first), 3)), np.zeros((len(self.first), 4))
        keys = keys_of(self.places)

        def find(first: int, end: int) -> None:
            find_normals(keys, self.moments, (first, end), _NORMAL_POINTS, normals, spreads)

        in_parts(find, len(keys), threads=cores)
        is_flat = (spreads[:, 3] >= _NORMAL_POINTS) & (spreads[:, 0] < _FLATNESS * spreads[:, 1])
        chosen = np.flatnonzero(is_flat)
        moments = self.moments[chosen]
        means = moments[:, 1:4] / moments[:, :1] + self.low
        normals = normals[chosen]
        if cloud.stations is not None and len(cloud.stations):
            own = self.first[chosen]
            scan = np.zeros(len(own), dtype=np.int64) if cloud.scan is None else cloud.scan[own]
            stations = cloud.stations[np.minimum(scan, len(cloud.stations) - 1)] - cloud.origin
            facing = np.einsum("ij,ij->i", stations - means, normals)
            normals *= np.where(facing < 0.0, -1.0, 1.0)[:, None]
        return Voxels(
            points=means,
            normals=normals,
            spread_m=spreads[chosen, 0],
            places=self.places[chosen],
            low=tuple(self.low.tolist()),
            size_m=self.size_m,
        )


def in_voxels(sample: Sample, voxel_m: float) -> VoxelGrid:
    """Sort a sample into voxels of a size."""
    points = np.ascontiguousarray(sample.offsets_m)
    # Points that are very far away are errors; voxel numbers have 20 bits.
    low = np.array([column.min() for column in points.T])
    high = np.array([column.max() for column in points.T])
    index = sample.index
    if ((high - low) >= voxel_m * _MOST_VOXELS).any():
        near = ((points - low) < voxel_m * _MOST_VOXELS).all(axis=1)
        points, index = points[near], index[near]
    table = np.full(1 << max(4, math.ceil(math.log2(1.5 * len(points) + 1))), -1, dtype=np.int32)
    keys = np.empty(len(points), dtype=np.int64)
    moments = np.zeros((len(points), MOMENTS))
    first = np.empty(len(points), dtype=np.int64)
    count = fill_voxels(points, low, voxel_m, table, keys, moments, first)
    order = np.argsort(keys[:count])
    keys = keys[order]
    mask = (1 << KEY_BITS) - 1
    return VoxelGrid(
        places=np.column_stack([keys >> 2 * KEY_BITS, (keys >> KEY_BITS) & mask, keys & mask]),
        moments=moments[order],
        first=index[first[order]],
        size_m=voxel_m,
        low=low,
    )


def keys_of(places: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the keys (v,) of positions (v, 3); they are in the order of the positions."""
    return np.asarray(((places[:, 0] << KEY_BITS) + places[:, 1] << KEY_BITS) + places[:, 2])


def noise_of(voxels: Voxels) -> float:
    """Estimate the noise of a cloud normal to its surfaces; 0 if there are no flat voxels."""
    if not len(voxels.spread_m):
        return 0.0
    return float(np.quantile(voxels.spread_m, _NOISE_QUANTILE))
