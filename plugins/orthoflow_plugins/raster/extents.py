"""The extent of a wall, up to adjoining surfaces and including its relief.

markiewicz2015 (section 6) rasterises the points within a given range in front of and behind each
plane. Here, both this range and the rectangle are determined from the points connected to the wall:
a sample of the cloud is divided into voxels, and from the voxels on the plane, a region grows along
the wall and in depth. If a detected plane adjoins the wall, the rectangle ends at the nearest point
of that plane, because a larger rectangle would show the adjoining plane. Otherwise, the rectangle
ends where the points end.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import WallFrame
from orthoflow.geometry.slabs import Slab
from orthoflow.geometry.unrolling import unrolled
from orthoflow.products import Planes, PointCloud
from orthoflow_plugins.raster.selection import area_m2, frame_of

Side = Literal["left", "right", "top", "bottom"]
_SIDES: Final[tuple[Side, ...]] = ("left", "right", "top", "bottom")

# Maximum number of points in the sample, which consists of one in n points, chosen by hashing.
_POINTS_MOST: Final = 1 << 21
# Multiplier of Fibonacci hashing, which makes the sample independent of the rows and columns of a
# scan.
_TURN: Final = np.uint64(0x9E3779B97F4A7C15)
# Maximum growth of a rectangle on each side.
_GROWTH_MOST_M: Final = 1.0
# Maximum depths of relief in front of and behind the plane.
_FRONT_MOST_M: Final = 0.5
_BEHIND_MOST_M: Final = 1.0
# Maximum number of voxels.
_VOXELS_MOST: Final = 1 << 22
# Minimum side of a voxel along the wall, in metres and as a multiple of the spacing of sample
# points.
_SIDE_LEAST_M: Final = 0.03
_SIDE_STEPS: Final = 3.0
# Side of a voxel in depth.
_DEPTH_STEP_M: Final = 0.025
# Surfaces up to this number of depth steps apart are connected, because the sides of relief are
# seldom scanned.
_BRIDGED_STEPS: Final = 5
# Connected voxels belong to the wall if at least this number of them are on the plane.
_SEEDS_LEAST: Final = 4
# A row or column of cells outside the rectangle belongs to the wall if at least this share of it is
# covered.
_COVERED_LEAST: Final = 0.2
# This share of the outermost points is ignored, because these may be stray points.
_STRAY_SHARE: Final = 0.02
# Additional depth that is searched beyond the maximum depth of relief. An object that extends into
# this depth, such as a cornice of an adjoining wall or the side of a piece of furniture, is not
# relief.
_BEYOND_MOST_M: Final = 0.1
# An object that is connected to a wall but extends farther in front of it than relief, such as a
# fountain on a facade, belongs to the wall up to this distance.
_FAR_FRONT_MOST_M: Final = 3.0
# Such an object belongs to the wall only if it covers more than this share of the wall.
_FAR_SHARE_LEAST: Final = 0.03
# The depth of such an object is at most this share of the distance from the wall to a surface that
# faces it, or to a scanner.
_HALFWAY: Final = 0.5
# A surface faces the wall if the cosine of the angle between the normals is smaller than this.
_FACING_COSINE: Final = -0.7
# Minimum ratio of the areas of opposite walls of a room, which are similar; objects in front of a
# wall cover only a few per cent of it.
_OPPOSITE_SHARE: Final = 0.25
_UPRIGHT_SINE: Final = math.sin(math.radians(10.0))
# Points less than this distance from the lowest or highest points in front of a wall are ignored,
# because the ground and the ceiling connect all objects.
_GROUND_M: Final = 0.15
# Relief that covers less than this share of the wall does not influence the buffer.
_RELIEF_LEAST: Final = 5e-4
_BEYOND_RELIEF_M: Final = 0.02
_RELIEF_USUAL_M: Final = 0.15
# Maximum cosine of the angle between the normals of a wall and an adjoining plane.
_ADJOINING_COSINE: Final = 0.7
_BESIDE_SINE: Final = 0.9
# Points of an adjoining plane must cover at least this share of the wall's side, in this range of
# depths in front of or behind the wall. The undersides of cornices do not extend to these depths.
_BESIDE_SHARE: Final = 0.3
_STANDING_M: Final = (0.35, 1.0)
_BESIDE_STEP_M: Final = 0.1
# The intersection with an adjoining plane may be this far inside the rectangle of the points.
_WITHIN_M: Final = 0.1
# Maximum distance of the points of an adjoining surface from its plane, in standard deviations and
# in metres.
_NOISE_SIGMAS: Final = 3.0
_NOISE_MOST_M: Final = 0.02


@dataclass(frozen=True, kw_only=True)
class SampledPoints:
    """A sample of the points of a cloud.

    Attributes:
        origin: (3,) origin of the cloud, metres.
        x: (n,) float32 x coordinates relative to the origin, metres.
        y: (n,) float32 y coordinates relative to the origin, metres.
        z: (n,) float32 z coordinates relative to the origin, metres.
        n_represented: number of points of the cloud per sample point.
    """

    origin: NDArray[np.float64]
    x: NDArray[np.float32]
    y: NDArray[np.float32]
    z: NDArray[np.float32]
    n_represented: float

    @property
    def boxes_m(self) -> None:
        """None, because the bounding boxes of blocks of sampled points would be too large."""


@dataclass(frozen=True, kw_only=True)
class PointsInside:
    """Points inside the raster and the buffer of a wall.

    Attributes:
        places: (n, 2) column and row, fractional.
        depth_m: (n,) metres in front of the plane.
        cells: (n,) row * width + column of their cell.
    """

    places: NDArray[np.float64]
    depth_m: NDArray[np.float64]
    cells: NDArray[np.int64]


def sampled(cloud: PointCloud) -> SampledPoints:
    """Return a sample of one in n points, so that walls are examined quickly."""
    every = -(-len(cloud) // _POINTS_MOST)
    index = np.arange(0, len(cloud), every)
    if every > 1:
        chance = (np.arange(index.size, dtype=np.uint64) * _TURN) >> np.uint64(32)
        index += (chance % np.uint64(every)).astype(np.int64)
        np.minimum(index, len(cloud) - 1, out=index)
    x, y, z = (np.ascontiguousarray(axis[index]) for axis in (cloud.x, cloud.y, cloud.z))
    return SampledPoints(origin=cloud.origin, x=x, y=y, z=z, n_represented=float(every))


def points_in(points: SampledPoints, slab: Slab, *, threads: int) -> PointsInside:
    """Find the points that are inside the raster and the buffer of a wall."""
    from orthoflow.geometry.rastering import entries_inside, wall_from_offset

    if slab.frame.bend is not None:
        near = unrolled(points, slab)
        points = SampledPoints(
            origin=near.origin, x=near.x, y=near.y, z=near.z, n_represented=points.n_represented
        )
        slab = replace(slab, frame=slab.frame.flat)
    found = [
        (entries.points, entries.cells) for entries in entries_inside(points, slab, threads=threads)
    ]
    own = np.concatenate([np.empty(0, np.uint32), *(some for some, _ in found)])
    cells = np.concatenate([np.empty(0, np.int32), *(some for _, some in found)])
    offsets_m = np.column_stack([points.x[own], points.y[own], points.z[own]]).astype(np.float64)
    matrix = wall_from_offset(slab.frame, points.origin)
    on_wall = offsets_m @ matrix[:, :3].T + matrix[:, 3]
    return PointsInside(places=on_wall[:, :2], depth_m=on_wall[:, 2], cells=cells.astype(np.int64))


@dataclass(frozen=True, kw_only=True)
class Extent:
    """Extent of a wall.

    Attributes:
        growth_m: growth beyond the rectangle of the points at the left, right, top and bottom.
        front_m: depth in front of the plane, positive.
        behind_m: depth behind the plane, positive.
        cut_m: for each side, the maximum width of the part of the wall that is excluded because the
            adjoining plane is oblique to the side.
    """

    growth_m: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    front_m: float
    behind_m: float
    cut_m: Mapping[Side, float] = field(default_factory=dict)

    def widened(self, frame: WallFrame) -> WallFrame:
        """Extend a raster on each side by whole cells, so that other cells keep their positions."""
        # The tolerance is 1e-6 cells, as in `frame_over`.
        left, right, top, bottom = (int(grown / frame.gsd_m + 1e-6) for grown in self.growth_m)
        return frame.part(
            np.array([-left, -top], dtype=np.float64),
            width=frame.width + left + right,
            height=frame.height + top + bottom,
        )


@dataclass(frozen=True, kw_only=True)
class Reach:
    """Buffers of a wall as set by the user, and the minimum buffer.

    Attributes:
        front_m: buffer in front of the plane; None if it is to be determined.
        behind_m: buffer behind the plane; None if it is to be determined.
        least_m: minimum of a buffer that is determined.
    """

    front_m: float | None
    behind_m: float | None
    least_m: float

    @property
    def is_set(self) -> bool:
        """Whether both buffers are set."""
        return self.front_m is not None and self.behind_m is not None

    @property
    def as_set(self) -> Extent:
        """Return an extent with the set buffers and no growth."""
        return Extent(
            front_m=self.least_m if self.front_m is None else self.front_m,
            behind_m=self.least_m if self.behind_m is None else self.behind_m,
        )


def extent_of(
    points: SampledPoints,
    planes: Planes,
    index: int,
    reach: Reach,
    *,
    stations: NDArray[np.float64] | None = None,
    threads: int,
) -> Extent:
    """Determine the extent of a wall, given its plane.

    Args:
        points: sample of the cloud.
        planes: all detected planes.
        index: index of the wall's plane.
        reach: buffers as set by the user.
        stations: (k, 3) world coordinates of scanners; None if unknown.
        threads: number of threads.
    """
    search = _Search.of(points, planes, index, reach)
    inside = points_in(points, search.slab, threads=threads)
    surface = _surface(inside, search)
    if surface is None:
        return reach.as_set
    front_m, behind_m = reach.as_set.front_m, reach.as_set.behind_m
    if reach.front_m is None:
        relief_m = _relief_m(surface.front_m, _FRONT_MOST_M, search)
        front_m = max(front_m, min(round(relief_m + _BEYOND_RELIEF_M, 3), _FRONT_MOST_M))
        far_m = _far_front_m(
            points, planes, index, search, stations, near_m=front_m, threads=threads
        )
        front_m = max(front_m, far_m)
    if reach.behind_m is None:
        relief_m = _relief_m(-surface.behind_m, _BEHIND_MOST_M, search)
        behind_m = max(behind_m, min(round(relief_m + _BEYOND_RELIEF_M, 3), _BEHIND_MOST_M))
    left, right, top, bottom = (_growth_m(side, surface, inside, search) for side in _SIDES)
    growth_m = dict(zip(_SIDES, (left, right, top, bottom), strict=True))
    return Extent(
        growth_m=(left, right, top, bottom),
        front_m=front_m,
        behind_m=behind_m,
        cut_m={
            bound.side: bound.askew_m
            for bound in search.bounds
            if 0.0 < growth_m[bound.side] == bound.line_m
        },
    )


@dataclass(frozen=True, kw_only=True)
class Bound:
    """An adjoining plane, given as a linear function of position: the distance from the plane.

    Attributes:
        side: side of the rectangle that the plane bounds.
        slopes: (3,) derivatives of the distance with respect to metres to the right, downwards and
            in front of the wall's plane. The distance is positive on the wall's side.
        offset_m: distance of the top-left corner of the rectangle of the points.
        noise_m: maximum distance of the points of the adjoining surface from the plane.
        beyond_m: smallest distance between the plane and the rectangle's side, positive outside.
        askew_m: difference between the largest and the smallest distance between the plane and the
            rectangle's side.
    """

    side: Side
    slopes: NDArray[np.float64]
    offset_m: float
    noise_m: float
    beyond_m: float
    askew_m: float

    @property
    def line_m(self) -> float:
        """Distance by which a wall that this plane bounds extends beyond the rectangle's side."""
        # Points closer to the plane may belong to either surface.
        return self.beyond_m - self.noise_m


@dataclass(frozen=True, kw_only=True)
class _Search:
    """The region that is searched for points of a wall.

    Attributes:
        slab: raster whose cells are the sides of the voxels along the wall, and range of depths.
        width_m: width of the rectangle of the points.
        height_m: height of the rectangle of the points.
        seed_m: maximum distance from the plane of points that count as on the plane.
        bounds: adjoining planes.
    """

    slab: Slab
    width_m: float
    height_m: float
    seed_m: float
    bounds: tuple[Bound, ...]

    @classmethod
    def of(cls, points: SampledPoints, planes: Planes, index: int, reach: Reach) -> _Search:
        rectangle = frame_of(planes, index, gsd_m=1.0, margin_m=0.0)
        corners = planes.corners[index]
        width_m = float(np.linalg.norm(corners[3] - corners[0]))
        height_m = float(np.linalg.norm(corners[1] - corners[0]))
        front_m = _searched_m(reach.front_m, _FRONT_MOST_M)
        behind_m = _searched_m(reach.behind_m, _BEHIND_MOST_M)
        n_sampled = max(1.0, float(planes.n_points[index]) / points.n_represented)
        step_m = math.sqrt(_covered_m2(planes, index) / n_sampled)
        n_steps = (front_m + behind_m) / _DEPTH_STEP_M + 2.0
        searched_m2 = (width_m + 2.0 * _GROWTH_MOST_M) * (height_m + 2.0 * _GROWTH_MOST_M)
        side_m = max(
            min(max(_SIDE_LEAST_M, _SIDE_STEPS * step_m), 0.25 * min(width_m, height_m)),
            math.sqrt(searched_m2 * n_steps / _VOXELS_MOST),
        )
        size_m = width_m, height_m
        around = PointsAround.of(points, rectangle, size_m)
        # Grow by whole cells, so that the rectangle's corner is also a corner of a cell.
        growth_m = side_m * math.ceil(_GROWTH_MOST_M / side_m)
        frame = frame_of(planes, index, gsd_m=side_m, margin_m=growth_m)
        return cls(
            slab=Slab(frame=frame, front_m=front_m, behind_m=behind_m),
            width_m=width_m,
            height_m=height_m,
            seed_m=planes.tolerance_m,
            bounds=tuple(adjoining_bounds(planes, index, rectangle, size_m, around)),
        )

    def places_m(self, points: PointsInside) -> NDArray[np.float64]:
        """Return positions (2, n), in metres right of and below the rectangle's top-left corner."""
        return self.slab.frame.gsd_m * (points.places - self.n_beside).T

    @property
    def n_beside(self) -> int:
        """Number of cells between the left side of the frame and the left side of the rectangle."""
        return math.ceil(_GROWTH_MOST_M / self.slab.frame.gsd_m)

    @property
    def inside(self) -> tuple[slice, slice]:
        """Rows and columns of the cells in the rectangle of the points."""
        side_m, first = self.slab.frame.gsd_m, self.n_beside
        rows, columns = (
            max(1, int(length_m / side_m)) for length_m in (self.height_m, self.width_m)
        )
        return slice(first, first + rows), slice(first, first + columns)


@dataclass(frozen=True, kw_only=True)
class _Surface:
    """The points connected to the wall.

    Attributes:
        is_covered: (rows, cols) True for cells of the surface, except isolated cells.
        front_m: (rows, cols) largest depth of the surface in metres; -inf where there is no
            surface.
        behind_m: (rows, cols) smallest depth of the surface in metres; inf where there is no
            surface.
        is_own: (n,) True for points on the surface.
    """

    is_covered: NDArray[np.bool_]
    front_m: NDArray[np.float64]
    behind_m: NDArray[np.float64]
    is_own: NDArray[np.bool_]


def _far_front_m(
    points: SampledPoints,
    planes: Planes,
    index: int,
    search: _Search,
    stations: NDArray[np.float64] | None,
    *,
    near_m: float,
    threads: int,
) -> float:
    """Return the depth of objects that are connected to a wall and hide much of it; 0 if none.

    Args:
        points: sample of the cloud.
        planes: all detected planes.
        index: index of the wall's plane.
        search: the region of the wall.
        stations: (k, 3) world coordinates of scanners; None if unknown.
        near_m: relief up to this depth always belongs to the wall.
        threads: number of threads.
    """
    from scipy import ndimage

    # Objects that stand on a floor are not part of the floor.
    is_upright = abs(float(planes.normal[index] @ planes.up)) < _UPRIGHT_SINE
    most_m = min(_FAR_FRONT_MOST_M, free_before_m(planes, index, stations))
    if not is_upright or most_m <= near_m + _BEYOND_RELIEF_M:
        return 0.0
    far = replace(search, slab=replace(search.slab, front_m=most_m))
    inside = _without_ground(points_in(points, far.slab, threads=threads), far, near_m)
    surface = _surface(inside, far)
    if surface is None:
        return 0.0
    is_far = surface.front_m > near_m
    is_far &= ~(surface.behind_m <= near_m)
    # Remove thin parts, because they belong to objects such as adjoining walls, which extend
    # farther in depth.
    is_far = np.asarray(ndimage.binary_opening(is_far, np.ones((3, 3), dtype=np.bool_)))
    rows, columns = far.inside
    gained_m = surface.front_m[rows, columns][is_far[rows, columns]]
    n_wall = (rows.stop - rows.start) * (columns.stop - columns.start)
    if gained_m.size < _FAR_SHARE_LEAST * n_wall:
        return 0.0
    reach_m = float(np.quantile(gained_m, 1.0 - _STRAY_SHARE)) + 0.5 * _DEPTH_STEP_M
    return min(round(reach_m + _BEYOND_RELIEF_M, 3), most_m)


def free_before_m(planes: Planes, index: int, stations: NDArray[np.float64] | None) -> float:
    """Return half the distance from a wall to the nearest facing surface or scanner, or infinity.

    Objects farther in front of the wall may belong to the facing surface. If the visible side of a
    plane was only guessed, the plane may be the front of an object on the wall. Such planes are
    considered to face the wall only if, together with nearer ones, they are large enough to be the
    opposite wall of a room.
    """
    normal, offset_m = planes.normal[index], float(planes.offset[index])
    facing = [
        (float((planes.corners[other] @ normal - offset_m).max()), other)
        for other in range(len(planes))
        if float(planes.normal[other] @ normal) < _FACING_COSINE
    ]
    distances_m = [math.inf]
    opposite_m2 = 0.0
    for distance_m, other in sorted(one for one in facing if one[0] > 0.0):
        opposite_m2 += _covered_m2(planes, other)
        is_known = planes.side_source(other) != "guess"
        if is_known or opposite_m2 >= _OPPOSITE_SHARE * _covered_m2(planes, index):
            distances_m.append(distance_m)
            break
    if stations is not None and len(stations):
        distances_m += (stations @ normal - offset_m).tolist()
    return _HALFWAY * min(distance_m for distance_m in distances_m if distance_m > 0.0)


def _without_ground(inside: PointsInside, search: _Search, near_m: float) -> PointsInside:
    """Remove the ground and the ceiling in front of a wall, because they connect objects to it."""
    _, down_m = search.places_m(inside)
    is_before = inside.depth_m > near_m
    if not is_before.any():
        return inside
    highest_m, lowest_m = np.quantile(down_m[is_before], (0.005, 0.995))
    is_level = (down_m < highest_m + _GROUND_M) | (down_m > lowest_m - _GROUND_M)
    kept = ~(is_before & is_level)
    return PointsInside(
        places=inside.places[kept], depth_m=inside.depth_m[kept], cells=inside.cells[kept]
    )


def _surface(inside: PointsInside, search: _Search) -> _Surface | None:
    """Return the surface connected to the voxels on the plane; None if there are no such voxels."""
    from scipy import ndimage

    slab = search.slab
    n_steps = int((slab.front_m + slab.behind_m) / _DEPTH_STEP_M) + 2
    shape = (*slab.frame.shape, n_steps)
    right_m, down_m = search.places_m(inside)
    is_before = np.ones(len(inside.cells), dtype=np.bool_)
    for bound in search.bounds:
        right, down, depth = bound.slopes
        distance_m = bound.offset_m + right * right_m + down * down_m + depth * inside.depth_m
        is_before &= distance_m > bound.noise_m
    steps = np.floor((inside.depth_m + slab.behind_m) / _DEPTH_STEP_M).astype(np.int64).clip(0)
    voxels = inside.cells * n_steps + steps
    occupied = np.zeros(math.prod(shape), dtype=np.bool_)
    occupied[voxels[is_before]] = True
    bridged = ndimage.maximum_filter1d(
        occupied.reshape(shape).view(np.uint8), _BRIDGED_STEPS, axis=2
    )
    labels, _ = ndimage.label(bridged, structure=np.ones((3, 3, 3)))
    is_near = np.zeros(shape, dtype=np.bool_)
    depths_m = (np.arange(n_steps) + 0.5) * _DEPTH_STEP_M - slab.behind_m
    is_near[(*search.inside, np.abs(depths_m) <= search.seed_m)] = True
    seeds = np.bincount(labels[is_near & occupied.reshape(shape)])
    is_wall = seeds >= min(_SEEDS_LEAST, seeds[1:].max(initial=_SEEDS_LEAST))
    is_wall[:1] = False
    if not is_wall.any():
        return None
    of_wall = np.zeros(int(labels.max()) + 1, dtype=np.bool_)
    of_wall[: len(is_wall)] = is_wall
    is_own = is_before & of_wall[labels.ravel()[voxels]]
    surface = occupied.reshape(shape) & of_wall[labels]
    shown = np.asarray(surface.any(axis=2), dtype=np.bool_)
    front_m = np.where(shown, depths_m[n_steps - 1 - surface[:, :, ::-1].argmax(axis=2)], -np.inf)
    behind_m = np.where(shown, depths_m[surface.argmax(axis=2)], np.inf)
    square = np.ones((3, 3), dtype=np.bool_)
    closed = shown | ndimage.binary_closing(shown, square)
    return _Surface(
        is_covered=ndimage.binary_opening(closed, square),
        front_m=front_m,
        behind_m=behind_m,
        is_own=is_own,
    )


def _searched_m(set_m: float | None, most_m: float) -> float:
    return most_m + _BEYOND_MOST_M if set_m is None else min(set_m, most_m)


def _relief_m(depth_m: NDArray[np.float64], most_m: float, search: _Search) -> float:
    """Return the depth of the wall's relief; thin and very small parts are ignored."""
    from scipy import ndimage

    inner = np.where(np.isfinite(depth_m) & (depth_m <= most_m), depth_m, -np.inf)
    # Seen along the normal, undetected floors and ceilings and the sides of relief are thin.
    opened = np.asarray(ndimage.minimum_filter(inner, 3, mode="constant", cval=-np.inf))
    opened = np.sort(opened[np.isfinite(opened)])
    rows, columns = search.inside
    n_wall = (rows.stop - rows.start) * (columns.stop - columns.start)
    n_least = max(1, round(_RELIEF_LEAST * n_wall))
    if len(opened) < n_least:
        return 0.0
    return float(opened[-n_least]) + 0.5 * _DEPTH_STEP_M


def _growth_m(side: Side, surface: _Surface, inside: PointsInside, search: _Search) -> float:
    """Return how far the wall extends beyond a side of the rectangle of its points."""
    side_m, first = search.slab.frame.gsd_m, search.n_beside
    rows, columns = search.inside
    is_covered = surface.is_covered
    right_m, down_m = search.places_m(inside)
    if side in {"left", "right"}:
        is_within = (down_m >= 0.0) & (down_m <= search.height_m)
    else:
        is_within = (right_m >= 0.0) & (right_m <= search.width_m)
    # Rows or columns of cells outside the rectangle, from the inside out; the first may be partly
    # inside.
    lines, beyond_m, within_m = {
        "left": (is_covered[rows, :first].T[::-1], -right_m, 0.0),
        "right": (
            is_covered[rows, columns.stop :].T,
            right_m - search.width_m,
            search.width_m - side_m * (columns.stop - first),
        ),
        "top": (is_covered[:first, columns][::-1], -down_m, 0.0),
        "bottom": (
            is_covered[rows.stop :, columns],
            down_m - search.height_m,
            search.height_m - side_m * (rows.stop - first),
        ),
    }[side]
    n_lines = int(np.argmin(np.append(lines.mean(axis=1) >= _COVERED_LEAST, [False])))
    most_m = min(n_lines * side_m - within_m, _GROWTH_MOST_M)
    is_outer = surface.is_own & is_within & (beyond_m <= most_m)
    outer_m = beyond_m[is_outer & (beyond_m > most_m - 2.0 * side_m)]
    if n_lines == 0 or not outer_m.size:
        return 0.0
    grown_m = float(np.quantile(outer_m, 1.0 - _STRAY_SHARE))
    for bound in search.bounds:
        if bound.side == side and grown_m > bound.line_m - side_m:
            grown_m = bound.line_m
    return max(0.0, grown_m)


def _covered_m2(planes: Planes, index: int) -> float:
    """Return the area of the connected parts of a plane, but at most that of its rectangle."""
    whole = area_m2(planes.corners[index])
    parts = sum(area_m2(corners) for corners in _parts(planes, index))
    return min(whole, parts) if parts > 0.0 else whole


def _parts(planes: Planes, index: int) -> NDArray[np.float64]:
    if planes.part_corners is None or planes.part_plane is None:
        return planes.corners[[index]]
    own: NDArray[np.float64] = planes.part_corners[planes.part_plane == index]
    return own if len(own) else planes.corners[[index]]


def adjoining_bounds(
    planes: Planes,
    index: int,
    rectangle: WallFrame,
    size_m: tuple[float, float],
    around: PointsAround,
) -> Iterator[Bound]:
    """Yield the adjoining plane of each side of a wall: the innermost one, if there are several.

    If the wall has points beyond the innermost plane, the plane does not bound the wall, and the
    next one is used. An example is the side of a chimney breast on the adjoining wall.
    """
    found: dict[Side, list[Bound]] = {}
    for other in range(len(planes)):
        if other == index or abs(float(planes.normal[other] @ rectangle.normal_world)) > (
            _ADJOINING_COSINE
        ):
            continue
        bound = adjoining_bound(planes, other, rectangle, size_m)
        if bound is None or not stands_beside(bound, size_m, around):
            continue
        found.setdefault(bound.side, []).append(bound)
    for bounds in found.values():
        bounds.sort(key=lambda bound: bound.beyond_m)
        while len(bounds) > 1 and _goes_on(bounds[0], bounds[1], size_m, around):
            del bounds[0]
        yield bounds[0]


def adjoining_bound(
    planes: Planes, other: int, rectangle: WallFrame, size_m: tuple[float, float]
) -> Bound | None:
    """Return how another plane bounds a wall; None if it is not beside, above or below the wall."""
    normal = planes.normal[other]
    slopes = rectangle.axes_world @ normal
    offset_m = float(normal @ rectangle.origin_world - planes.offset[other])
    across = float(np.hypot(slopes[0], slopes[1]))
    axis = int(np.argmax(np.abs(slopes[:2])))
    if abs(slopes[axis]) < _BESIDE_SINE * across:
        return None
    middle = np.array([0.5 * size_m[0], 0.5 * size_m[1], 0.0])
    if offset_m + float(slopes @ middle) < 0.0:
        slopes, offset_m = -slopes, -offset_m
    # The inside, where distances are positive, is to the right of an adjoining wall on the left and
    # below a ceiling.
    sides: tuple[Side, Side] = ("left", "right") if axis == 0 else ("top", "bottom")
    is_first = bool(slopes[axis] > 0.0)
    along = 1 - axis
    ends_m = np.array([0.0, size_m[along]])
    line_m = -(offset_m + slopes[along] * ends_m) / slopes[axis]
    distances_m = -line_m if is_first else line_m - size_m[axis]
    beyond_m = float(distances_m.min())
    if not -_WITHIN_M <= beyond_m <= _GROWTH_MOST_M:
        return None
    noise_m = min(_NOISE_SIGMAS * _sigma_m(planes, other), _NOISE_MOST_M)
    return Bound(
        side=sides[0] if is_first else sides[1],
        slopes=slopes,
        offset_m=offset_m,
        noise_m=noise_m,
        beyond_m=beyond_m,
        askew_m=float(distances_m.max()) - beyond_m,
    )


@dataclass(frozen=True, kw_only=True)
class PointsAround:
    """Points in and around a wall, in metres relative to its rectangle.

    Attributes:
        places_m: (3, n) points clearly in front of or behind the plane: metres to the right of and
            below the top-left corner, and in front of the plane.
        own_m: (3, n) points on the plane or on relief of usual depth, in the same coordinates.
    """

    places_m: NDArray[np.float64]
    own_m: NDArray[np.float64]

    @classmethod
    def of(
        cls, points: SampledPoints, rectangle: WallFrame, size_m: tuple[float, float]
    ) -> PointsAround:
        """Select the points that are near enough to a rectangle of this size to bound its wall."""
        growth_m = _GROWTH_MOST_M
        corner = rectangle.world_from_wall(np.array([[-growth_m, -growth_m]]) / rectangle.gsd_m)[0]
        width_m, height_m = (length_m + 2.0 * growth_m for length_m in size_m)
        # Use 32 x 32 cells; the size is arbitrary, because only positions are used.
        gsd_m = max(width_m, height_m) / 32.0
        frame = replace(
            rectangle,
            origin_world=corner,
            gsd_m=gsd_m,
            width=math.ceil(width_m / gsd_m),
            height=math.ceil(height_m / gsd_m),
        )
        nearest_m, farthest_m = _STANDING_M
        found = points_in(
            points, Slab(frame=frame, front_m=farthest_m, behind_m=farthest_m), threads=1
        )
        right_m, down_m = gsd_m * found.places.T - growth_m
        places_m, off_m = np.stack([right_m, down_m, found.depth_m]), np.abs(found.depth_m)
        return cls(
            places_m=places_m[:, off_m > nearest_m], own_m=places_m[:, off_m < _RELIEF_USUAL_M]
        )


def stands_beside(bound: Bound, size_m: tuple[float, float], around: PointsAround) -> bool:
    """Return whether a plane has points along a wall's side, in front of or behind the wall."""
    places_m = around.places_m
    is_near = np.abs(bound.offset_m + bound.slopes @ places_m) <= bound.noise_m
    return any(
        _runs_along(bound, places_m[:, is_there], size_m)
        for is_there in (is_near & (places_m[2] > 0.0), is_near & (places_m[2] < 0.0))
    )


def _goes_on(inner: Bound, outer: Bound, size_m: tuple[float, float], around: PointsAround) -> bool:
    """Return whether a wall has points between two planes that adjoin the same side."""
    places_m = around.own_m
    is_between = inner.offset_m + inner.slopes @ places_m < -inner.noise_m
    is_between &= outer.offset_m + outer.slopes @ places_m > outer.noise_m
    return _runs_along(inner, places_m[:, is_between], size_m)


def _runs_along(bound: Bound, places_m: NDArray[np.float64], size_m: tuple[float, float]) -> bool:
    """Return whether positions (3, n) cover a sufficient share of the side that a plane bounds."""
    along = 1 if bound.side in {"left", "right"} else 0
    length_m = size_m[along]
    n_steps = max(1, round(length_m / _BESIDE_STEP_M))
    steps = np.floor(places_m[along] / length_m * n_steps).astype(np.int64)
    steps = steps[(steps >= 0) & (steps < n_steps)]
    return len(np.unique(steps)) >= _BESIDE_SHARE * n_steps


def _sigma_m(planes: Planes, index: int) -> float:
    thickness = planes.thickness[index] if planes.thickness else None
    return float(planes.rms_m[index]) if thickness is None else thickness.sigma_m
