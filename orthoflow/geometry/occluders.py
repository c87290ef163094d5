"""Points of a cloud that hide other points in photos."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.depth_buffer_kernels import (
    DepthBuffer,
    VoxelGrid,
    count_in_voxels,
    splat_points,
)
from orthoflow.geometry.slabs import OffsetPoints, Offsets, Slab, read_only
from orthoflow.geometry.threads import even_parts, in_threads
from orthoflow.geometry.unrolling import box_around

_LONGEST_SIDE_PX: Final = 2048
_VOXELS_MOST: Final = 1 << 24
# Side of a voxel in point spacings: small enough to separate the legs of a chair, and large enough
# for several points of a surface.
_VOXEL_CELLS: Final = 6.0
# Scanners do not measure shorter ranges, so points at these ranges are errors, even if they are
# dense.
_BLIND_M: Final = 0.3
# A voxel is considered empty if fewer than one in this many rays from a station end in it. A rod of
# 1 mm stops a larger share of the rays through a cube of 0.2 m.
_PASSING_RAYS: Final = 200
_N_ELEVATIONS: Final = 90
# Half the number of points in 3 x 3 x 3 voxels that are crossed by a surface with the point spacing
# of the wall.
_FEW_POINTS: Final = 0.5 * (3.0 * _VOXEL_CELLS) ** 2
# Compared with the interior of a surface, there are a quarter as many points around a corner, and
# half as many along an edge.
_CORNER_SHARE: Final = 0.25
# The points in 3 x 3 x 3 voxels are considered scattered if both points of less than this share of
# their pairs are in the same voxel. The limit is closer to 1/27 (scattered points) than to 1/9 (a
# surface).
_SPREAD_SHARE: Final = 0.07
_SAMPLED_MOST: Final = 1 << 20
# Points with fewer points around them (including the point itself) are outliers and hide nothing.
POINTS_LEAST: Final = 6


@dataclass(frozen=True, kw_only=True)
class Box:
    """Region in which points may hide others, and the point spacing in it.

    Attributes:
        low: (3,) float64 lower corner, metres from the origin of the cloud.
        high: (3,) float64 upper corner, metres from the origin of the cloud.
        spacing_m: approximate spacing of neighbouring points of a surface.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    spacing_m: float


@dataclass(frozen=True, kw_only=True)
class Occluders:
    """A cloud prepared for rendering from any position.

    Attributes:
        origin: (3,) float64 metres.
        points: float32 offsets from the origin.
        around: number of points in 3 x 3 x 3 voxels.
        n_least: points with fewer points in the 3 x 3 x 3 voxels around them are outliers.
        threads: number of threads per view; does not affect the result.
    """

    origin: NDArray[np.float64]
    points: Offsets
    around: VoxelGrid
    n_least: int
    threads: int


def occluders_before(
    cloud: OffsetPoints,
    slabs: Sequence[Slab],
    cameras: Sequence[ViewingCamera],
    *,
    spacing_m: float,
    stations_world: NDArray[np.float64] | None,
    n_least: int = POINTS_LEAST,
    threads: int,
) -> Occluders:
    """Count the points between cameras and walls, to detect outliers and estimate point spacing.

    Args:
        cloud: the whole cloud.
        slabs: slabs of the walls; only points in the bounding box of walls and cameras can hide
            walls.
        cameras: all cameras.
        spacing_m: approximate point spacing on a wall. Do not pass the size of coarser cells,
            because in a dense scan, larger voxels contain more stray points.
        stations_world: (s, 3) metres, positions of the scanner; None if unknown.
        n_least: points with fewer points around them are outliers. The number is increased for
            large boxes, whose voxels are larger.
        threads: see `Occluders`.
    """
    places = [camera.centre_world for camera in cameras]
    for slab in slabs:
        if slab.frame.bend is not None:
            places += [*box_around(slab)]
            continue
        corners = slab.frame.corners_world()
        places += [*(corners + slab.front_m * slab.frame.normal_world), *corners]
    between = np.array(places) - cloud.origin
    box = Box(low=between.min(axis=0), high=between.max(axis=0), spacing_m=spacing_m)
    return occluders_in(cloud, box, stations_world, n_least=n_least, threads=threads)


def occluders_in(
    cloud: OffsetPoints,
    box: Box,
    stations_world: NDArray[np.float64] | None,
    *,
    n_least: int = POINTS_LEAST,
    threads: int,
) -> Occluders:
    """Count the points in a box, to detect outliers and estimate point spacing.

    Args:
        cloud: the whole cloud.
        box: region in which points may hide others.
        stations_world: (s, 3) metres, positions of the scanner; None if unknown.
        n_least: see `Occluders`.
        threads: see `Occluders`.
    """
    points = read_only(cloud.x, cloud.y, cloud.z)
    side = _VOXEL_CELLS * box.spacing_m
    size = np.maximum(box.high - box.low, side)
    while np.prod(np.ceil(size / side)) > _VOXELS_MOST:
        side *= 1.1
    shape = np.ceil(size / side).astype(np.int64)
    counts = np.zeros((int(shape[0]), int(shape[1]), int(shape[2])), dtype=np.uint16)
    grid = VoxelGrid(low=box.low, side_m=float(side), counts=counts)
    count_in_voxels(points, grid)
    larger = float(side) / (_VOXEL_CELLS * box.spacing_m)
    n_few = _FEW_POINTS * larger**2
    if stations_world is None or not len(stations_world):
        squares = counts.astype(np.uint32) ** 2
        _sum_neighbours(counts)
        _forget_spread(counts, squares, n_few)
    else:
        _sum_neighbours(counts)
        stations = np.unique(stations_world, axis=0) - cloud.origin
        _forget_passed(grid, points, stations, _CORNER_SHARE * n_few)
        _forget_around(grid, stations)
    # On a linear object, larger voxels contain more points, by this factor.
    n_asked = math.ceil(n_least * larger)
    return Occluders(
        origin=cloud.origin, points=points, around=grid, n_least=n_asked, threads=threads
    )


def depth_buffer(occluders: Occluders, camera: ViewingCamera) -> DepthBuffer:
    """Render the cloud as seen by a camera."""
    reduction = max(1, -(-max(camera.width, camera.height) // _LONGEST_SIDE_PX))
    shape = (-(-camera.height // reduction), -(-camera.width // reduction))
    flat = camera.shifted(occluders.origin).flat
    buffers = [
        DepthBuffer(nearest=np.full(shape, np.inf, dtype=np.float32), reduction=float(reduction))
        for _ in range(occluders.threads)
    ]
    parts = even_parts(len(occluders.points.x), occluders.threads)
    in_threads(
        [
            partial(
                splat_points,
                _part(occluders.points, part),
                flat,
                occluders.around,
                occluders.n_least,
                buffer,
            )
            for part, buffer in zip(parts, buffers, strict=True)
        ]
    )
    nearest = np.minimum.reduce([buffer.nearest for buffer in buffers])
    return DepthBuffer(nearest=_closed(nearest), reduction=float(reduction))


def nothing_in_the_way(camera: ViewingCamera) -> DepthBuffer:
    """Return a depth buffer without points, so that nothing is hidden."""
    return DepthBuffer(
        nearest=np.full((1, 1), np.inf, dtype=np.float32),
        reduction=float(max(camera.width, camera.height)),
    )


def _closed(nearest: NDArray[np.float32]) -> NDArray[np.float32]:
    """Fill holes of one or two pixels, so that no wall is visible through a nearer surface.

    Apply a minimum filter and then a maximum filter, each with 3 x 3 pixels.
    """
    for choose in (np.minimum, np.maximum):
        for axis in range(2):
            before = np.moveaxis(nearest, axis, 0)
            nearest = nearest.copy()
            after = np.moveaxis(nearest, axis, 0)
            choose(after[1:], before[:-1], out=after[1:])
            choose(after[:-1], before[1:], out=after[:-1])
    return nearest


def _part(points: Offsets, piece: slice) -> Offsets:
    return Offsets(points.x[piece], points.y[piece], points.z[piece])


def _forget_spread(counts: NDArray[np.uint16], squares: NDArray[np.uint32], n_few: float) -> None:
    """Set counts to 0 where a few points are spread over all 27 voxels, unlike a surface.

    If points are scattered, both points of one in 27 pairs are in the same voxel; on a surface, it
    is one in 9 pairs, and along a line, one in 3.

    Args:
        counts: numbers of points in 3 x 3 x 3 voxels, changed in place.
        squares: squared numbers of points in single voxels, changed in place.
        n_few: voxels with more points are not checked.
    """
    _sum_neighbours(squares)
    places = np.nonzero((counts > 1) & (counts < n_few))
    around = counts[places].astype(np.float64)
    is_spread = squares[places] - around < _SPREAD_SHARE * around * (around - 1.0)
    counts[tuple(axis[is_spread] for axis in places)] = 0


def _forget_passed(
    grid: VoxelGrid, points: Offsets, stations: NDArray[np.float64], n_few: float
) -> None:
    """Set counts to 0 in voxels through which nearly all rays from the stations pass.

    Stray points of a dense scan can be as dense as points of a surface, especially near a station,
    but only a small share of the rays in their direction end at stray points. In a thinned cloud, a
    surface near a station also has few points, but as many as there are rays in its direction.
    """
    every = slice(None, None, max(1, len(points.x) // _SAMPLED_MOST))
    places = np.column_stack([axis[every] for axis in points]).astype(np.float64)
    weight = len(points.x) / max(1, len(places))
    filled = np.flatnonzero(grid.counts)
    middles = grid.low + grid.side_m * (
        np.array(np.unravel_index(filled, grid.counts.shape)).T + 0.5
    )
    # It is unknown which station measured a point, so assume that all stations measured equal
    # shares.
    rays = np.zeros(len(filled))
    for station in stations:
        per_sr = weight * _points_per_sr(places - station) / len(stations)
        ways = middles - station
        squares = np.maximum((ways**2).sum(axis=1), grid.side_m**2)
        rays += per_sr[_directions(ways)] * (3.0 * grid.side_m) ** 2 / squares
    counts = grid.counts.reshape(-1)
    counts[filled[counts[filled] < np.minimum(rays / _PASSING_RAYS, n_few)]] = 0


def _points_per_sr(ways: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return point densities per steradian; rows are elevations and columns are azimuths."""
    counts = np.zeros((_N_ELEVATIONS, 2 * _N_ELEVATIONS))
    np.add.at(counts, _directions(ways), 1.0)
    edges = np.sin(np.linspace(-0.5 * math.pi, 0.5 * math.pi, _N_ELEVATIONS + 1))
    return counts / (np.diff(edges)[:, None] * math.pi / _N_ELEVATIONS)


def _directions(ways: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the rows (elevation) and columns (azimuth) of directions (n, 3)."""
    elevation = np.arctan2(ways[:, 2], np.hypot(ways[:, 0], ways[:, 1])) / math.pi + 0.5
    azimuth = np.arctan2(ways[:, 1], ways[:, 0]) / math.pi + 1.0
    rows, columns = ((_N_ELEVATIONS * each).astype(np.intp) for each in (elevation, azimuth))
    return np.minimum(rows, _N_ELEVATIONS - 1), np.minimum(columns, 2 * _N_ELEVATIONS - 1)


def _forget_around(grid: VoxelGrid, stations: NDArray[np.float64]) -> None:
    """Set counts to 0 in voxels closer to a station than the minimum range of scanners."""
    for station in stations:
        middle = (station - grid.low) / grid.side_m - 0.5
        reach = _BLIND_M / grid.side_m
        first = np.maximum(np.floor(middle - reach), 0).astype(np.int64)
        end = np.maximum(np.ceil(middle + reach) + 1, 0).astype(np.int64)
        part = tuple(slice(a, b) for a, b in zip(first, end, strict=True))
        ranges = np.indices(grid.counts[part].shape) + first[:, None, None, None]
        squares = ((ranges - middle[:, None, None, None]) ** 2).sum(axis=0)
        grid.counts[part][squares < reach**2] = 0


def _sum_neighbours(counts: NDArray[np.uint16] | NDArray[np.uint32]) -> None:
    """Replace each count by the sum over 3 x 3 x 3 voxels, in place."""
    for axis in range(3):
        view = np.moveaxis(counts, axis, 0)
        before = view.copy()
        view[1:] += before[:-1]
        view[:-1] += before[1:]
