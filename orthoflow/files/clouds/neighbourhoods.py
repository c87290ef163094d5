"""Neighbourhoods of points in a cloud: surface normal, and whether a point is isolated.

The cloud is read in sections. Each voxel accumulates the number and the moments of its points, so
memory depends only on the number of voxels, which is about a million at most.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.clouds.photo_colours import spacing_of
from orthoflow.products import PointCloud

# Side of a voxel in point spacings; a voxel with its 26 neighbours is twelve spacings wide.
_VOXEL_SPACINGS: Final = 4.0
_VOXELS_MOST: Final = 1_000_000
# To detect outliers, 3 x 3 x 3 voxels are merged, since points in sparse, distant parts of a scan
# also have few neighbours.
_COARSER: Final = 3
_ALONE_FEWER_THAN: Final = 10
_POINTS_LEAST: Final = 6
# On a surface, the smallest principal variance is less than this share of the second smallest.
_FLAT: Final = 0.25
_AT_ONCE: Final = 1 << 20
# A voxel index has 21 bits per axis.
_LARGEST: Final = (1 << 21) - 8
_MOMENTS: Final = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


@dataclass(frozen=True, kw_only=True)
class Neighbourhoods:
    """The neighbourhoods of the voxels of a cloud.

    Attributes:
        low: (3,) float64 lowest corner in metres from the cloud's origin.
        side_m: side of a voxel.
        keys: (v,) int64 keys of the voxels, sorted.
        normals: (v, 3) float32 unit vectors of arbitrary sign, 0 0 0 where there is no surface.
        alone: (v,) True if there are fewer than 10 points within about 18 spacings.
    """

    low: NDArray[np.float64]
    side_m: float
    keys: NDArray[np.int64]
    normals: NDArray[np.float32]
    alone: NDArray[np.bool_]

    def places(self, offsets: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the voxel (n,) of each point (n, 3), given in metres from the cloud's origin."""
        return np.searchsorted(self.keys, _keys(offsets, self.low, self.side_m))


def neighbourhoods_of(cloud: PointCloud) -> Neighbourhoods:
    """Compute the neighbourhoods of a cloud in one pass."""
    spacing_m = spacing_of(cloud)
    per_voxel = max(_VOXEL_SPACINGS**2, len(cloud) / _VOXELS_MOST)
    side_m = spacing_m * float(np.sqrt(per_voxel))
    low = np.array([float(axis.min()) for axis in (cloud.x, cloud.y, cloud.z)]) - 4.0 * side_m
    keys, moments = _moments(cloud, low, side_m)
    return Neighbourhoods(
        low=low,
        side_m=side_m,
        keys=keys,
        normals=_normals(keys, moments),
        alone=_alone(keys, moments[:, 0]),
    )


def offsets_of(cloud: PointCloud, part: slice) -> NDArray[np.float64]:
    """Return the points (n, 3) of a section in metres from the cloud's origin."""
    return np.column_stack([cloud.x[part], cloud.y[part], cloud.z[part]]).astype(np.float64)


def _keys(
    offsets: NDArray[np.float64], low: NDArray[np.float64], side_m: float
) -> NDArray[np.int64]:
    places = np.clip(np.floor((offsets - low) / side_m), 3, _LARGEST).astype(np.int64)
    return (places[:, 0] << 42) | (places[:, 1] << 21) | places[:, 2]


def _moments(
    cloud: PointCloud, low: NDArray[np.float64], side_m: float
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return sorted voxel keys, and the count, sums and sums of products of a voxel's points."""
    keys = np.zeros(0, dtype=np.int64)
    moments = np.zeros((0, 10))
    for first in range(0, len(cloud), _AT_ONCE):
        offsets = offsets_of(cloud, slice(first, first + _AT_ONCE))
        found, inverse = np.unique(_keys(offsets, low, side_m), return_inverse=True)
        columns = [None, *offsets.T, *(offsets[:, a] * offsets[:, b] for a, b in _MOMENTS)]
        sums = np.column_stack([np.bincount(inverse, column, len(found)) for column in columns])
        both = np.concatenate([keys, found])
        order = np.argsort(both, kind="stable")
        both = both[order]
        starts = np.flatnonzero(np.diff(both, prepend=-1))
        moments = np.add.reduceat(np.concatenate([moments, sums])[order], starts, axis=0)
        keys = both[starts]
    return keys, moments


def _neighbour_sums(keys: NDArray[np.int64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return sums over 3 x 3 x 3 voxels."""
    sums = np.zeros_like(values)
    for dx, dy, dz in product((-1, 0, 1), repeat=3):
        wanted = keys + ((dx << 42) + (dy << 21) + dz)
        at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        is_there = keys[at] == wanted
        sums[is_there] += values[at[is_there]]
    return sums


def _normals(keys: NDArray[np.int64], moments: NDArray[np.float64]) -> NDArray[np.float32]:
    normals = np.zeros((len(keys), 3), dtype=np.float32)
    if len(keys) == 0:
        return normals
    sums = _neighbour_sums(keys, moments)
    count = sums[:, :1]
    mean = sums[:, 1:4] / count
    scatter = np.empty((len(keys), 3, 3))
    for column, (a, b) in enumerate(_MOMENTS):
        spread = sums[:, 4 + column] / count[:, 0] - mean[:, a] * mean[:, b]
        scatter[:, a, b] = scatter[:, b, a] = spread
    values, vectors = np.linalg.eigh(scatter)
    is_surface = (count[:, 0] >= _POINTS_LEAST) & (values[:, 0] < _FLAT * values[:, 1])
    normals[is_surface] = vectors[is_surface, :, 0]
    return normals


def _alone(keys: NDArray[np.int64], counts: NDArray[np.float64]) -> NDArray[np.bool_]:
    mask = (1 << 21) - 1
    parts = [(keys >> 42) // _COARSER, ((keys >> 21) & mask) // _COARSER, (keys & mask) // _COARSER]
    coarse, inverse = np.unique((parts[0] << 42) | (parts[1] << 21) | parts[2], return_inverse=True)
    about = _neighbour_sums(coarse, np.bincount(inverse, counts, len(coarse)).astype(np.float64))
    return (about < _ALONE_FEWER_THAN)[inverse]
