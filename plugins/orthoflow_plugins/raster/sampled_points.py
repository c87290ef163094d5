"""A sample of a cloud for quick checks: extents of walls, and causes of empty cells."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.slabs import Slab
from orthoflow.products import PointCloud

# Maximum number of points that are read, one of every n, chosen by hashing.
_POINTS_MOST: Final = 1 << 21
# Multiples of this do not coincide with rows or columns of a scan (Fibonacci hashing).
_TURN: Final = np.uint64(0x9E3779B97F4A7C15)


@dataclass(frozen=True, kw_only=True)
class SampledPoints:
    """A sample of the points of a cloud.

    Attributes:
        origin: (3,) metres, of the cloud.
        x: (n,) float32 metres from the origin along x.
        y: (n,) likewise along y.
        z: (n,) likewise along z.
        n_represented: number of points of the cloud that each represents.
    """

    origin: NDArray[np.float64]
    x: NDArray[np.float32]
    y: NDArray[np.float32]
    z: NDArray[np.float32]
    n_represented: float

    @property
    def boxes_m(self) -> None:
        """Return no boxes: points drawn from the whole cloud are everywhere."""


@dataclass(frozen=True, kw_only=True)
class PointsInside:
    """Points in the raster of a wall.

    Attributes:
        places: (n, 2) column and row.
        depth_m: (n,) metres in front of the plane.
        cells: (n,) row * width + column of their cell.
    """

    places: NDArray[np.float64]
    depth_m: NDArray[np.float64]
    cells: NDArray[np.int64]


def sampled(cloud: PointCloud) -> SampledPoints:
    """Take one point of every n, so that all walls are checked quickly."""
    every = -(-len(cloud) // _POINTS_MOST)
    index = np.arange(0, len(cloud), every)
    if every > 1:
        chance = (np.arange(index.size, dtype=np.uint64) * _TURN) >> np.uint64(32)
        index += (chance % np.uint64(every)).astype(np.int64)
        np.minimum(index, len(cloud) - 1, out=index)
    x, y, z = (np.ascontiguousarray(axis[index]) for axis in (cloud.x, cloud.y, cloud.z))
    return SampledPoints(origin=cloud.origin, x=x, y=y, z=z, n_represented=float(every))


def points_in(points: SampledPoints, slab: Slab, *, threads: int) -> PointsInside:
    """Find the points in the raster of a wall and its buffer."""
    from orthoflow.geometry.raster_kernels import BLOCK
    from orthoflow.geometry.rastering import entries_inside, wall_from_offset

    found, cells = [np.empty(0, dtype=np.int64)], [np.empty(0, dtype=np.int64)]
    for entries in entries_inside(points, slab, threads=threads):
        for block, n_inside in enumerate(entries.n_inside):
            part = slice(block * BLOCK, block * BLOCK + int(n_inside))
            found.append(entries.points[part].astype(np.int64))
            cells.append(entries.cells[part].astype(np.int64))
    own = np.concatenate(found)
    offsets_m = np.column_stack([points.x[own], points.y[own], points.z[own]]).astype(np.float64)
    matrix = wall_from_offset(slab.frame, points.origin)
    on_wall = offsets_m @ matrix[:, :3].T + matrix[:, 3]
    return PointsInside(places=on_wall[:, :2], depth_m=on_wall[:, 2], cells=np.concatenate(cells))
