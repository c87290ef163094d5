"""Causes of empty cells of a wall: points outside the buffer, occlusion, or few or no points."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import WallFrame
from orthoflow.geometry.slabs import Slab
from orthoflow.products import SurfaceMask, Wall
from orthoflow_plugins.raster.curved import limits_m
from orthoflow_plugins.raster.extents import SampledPoints, points_in

Cause = Literal["behind", "before", "hidden", "sparse", "unseen"]

# Side of the tiles for which causes are determined. A tile usually contains several sample points.
_TILE_M: Final = 0.05
# Tiles with fewer sample points than this contain no surface.
_POINTS_LEAST: Final = 2
# Points farther than this behind a wall belong to another room or the street.
_BEHIND_MOST_M: Final = 4.0
# Objects farther than this in front of a wall, such as a portico or a balcony, are considered
# occluders only if the stations are known.
_BEFORE_MOST_M: Final = 5.0
# Percentage of the points in front of a wall that a suggested buffer includes.
_BEFORE_PERCENT: Final = 95.0
# Side of the voxels through which rays from the wall to the stations are traced.
_VOXEL_M: Final = 0.1
# Maximum numbers of voxels in total and along an axis.
_VOXELS_MOST: Final = 1 << 24
_VOXELS_MOST_ALONG: Final = 1 << 11
# Length that is not tested at each end of a ray.
_ENDS_M: Final = 0.35
# Maximum number of tested tiles.
_RAYS_MOST: Final = 4000


@dataclass(frozen=True, kw_only=True)
class Emptiness:
    """Shares of the empty cells among all cells of a wall, by cause.

    Attributes:
        shares: share of the cells for each cause. `behind`: the points of the cell are behind the
            buffer; `before`: objects are directly in front of the wall, beyond the buffer;
            `hidden`: objects hide the cell from every station; `sparse`: the cell is close to
            points of the wall (gaps, shadows of relief and borders); `unseen`: nothing was scanned
            there.
        behind_m: median depth behind the plane of the points behind the buffer; NaN if there are
            none.
        before_m: depth in front of the plane up to which 95 % of the points directly in front of
            the wall are included; NaN if there are none.
    """

    shares: Mapping[Cause, float]
    behind_m: float
    before_m: float

    @property
    def share(self) -> float:
        """Share of the cells that are empty, for any cause."""
        return sum(self.shares.values())


@dataclass(frozen=True, kw_only=True)
class Sight:
    """Points of the cloud, and the stations.

    Attributes:
        points: sample of the cloud.
        stations: (k, 3) world coordinates; None if unknown.
    """

    points: SampledPoints
    stations: NDArray[np.float64] | None

    @cached_property
    def room(self) -> _Room:
        """Voxels that contain points; computed on demand, because few walls need them."""
        return _Room.of(self.points)


def emptiness_of(
    wall: Wall, slab: Slab, sight: Sight, *, free_m: float = math.inf, threads: int
) -> Emptiness:
    """Determine the causes of the empty cells of a wall.

    Args:
        wall: the wall.
        slab: its raster and buffer.
        sight: the scanned points and the stations.
        free_m: objects farther than this in front of the wall belong to a surface that faces it.
        threads: number of threads.
    """
    points = sight.points
    tiles = _tiles(wall, points)
    n_void = tiles.n_void
    behind_m, before_m = limits_m(wall.frame)
    before_m = min(_BEFORE_MOST_M, free_m, before_m)
    reach = Slab(frame=tiles.frame, front_m=before_m, behind_m=min(_BEHIND_MOST_M, behind_m))
    around = points_in(points, reach, threads=threads)
    is_behind, is_before = around.depth_m < -slab.behind_m, around.depth_m > slab.front_m
    n_behind, n_before = (
        np.bincount(around.cells[chosen], minlength=n_void.size)
        for chosen in (is_behind, is_before)
    )
    is_sparse, is_void = tiles.n_measured.ravel() > 0, n_void.ravel() > 0
    is_hidden = np.zeros(n_void.size, dtype=np.bool_)
    open_tiles = np.flatnonzero(is_void & ~is_sparse & (n_before < _POINTS_LEAST))
    if sight.stations is not None and len(sight.stations) and len(open_tiles):
        is_hidden[open_tiles] = _blocked(tiles.frame, open_tiles, sight, sight.stations)
    causes: tuple[Cause, ...] = ("sparse", "before", "hidden", "behind", "unseen")
    cause = np.select(
        [is_sparse, n_before >= _POINTS_LEAST, is_hidden, n_behind >= _POINTS_LEAST],
        causes[:4],
        causes[4],
    )
    of_point = cause[around.cells]
    standing = around.depth_m[is_before & (of_point == "before") & is_void[around.cells]]
    beyond = around.depth_m[is_behind & (of_point == "behind")]
    return Emptiness(
        shares={one: float(n_void.ravel()[cause == one].sum()) / wall.mask.size for one in causes},
        behind_m=-float(np.median(beyond)) if beyond.size else math.nan,
        before_m=float(np.percentile(standing, _BEFORE_PERCENT)) if standing.size else math.nan,
    )


@dataclass(frozen=True, kw_only=True)
class _Tiles:
    """Square blocks of cells of a wall.

    Attributes:
        frame: raster with one cell per tile; tiles at the right and bottom edges may be incomplete.
        n_void: (rows, cols) number of void cells.
        n_measured: (rows, cols) number of cells with a point.
    """

    frame: WallFrame
    n_void: NDArray[np.int64]
    n_measured: NDArray[np.int64]


def _tiles(wall: Wall, points: SampledPoints) -> _Tiles:
    frame = wall.frame
    rows, columns = frame.shape
    n_points = max(1.0, float(wall.count.sum(dtype=np.int64)) / points.n_represented)
    # The side is at least three times the spacing of sample points distributed over the entire
    # wall.
    side_m = max(_TILE_M, 3.0 * frame.gsd_m * math.sqrt(rows * columns / n_points))
    side = max(1, min(round(side_m / frame.gsd_m), rows, columns))
    starts = np.arange(0, columns, side)
    void: list[NDArray[np.int64]] = []
    measured: list[NDArray[np.int64]] = []
    for first in range(0, rows, side):
        band = slice(first, first + side)
        is_void = wall.mask[band] == SurfaceMask.VOID
        if frame.bend is not None:
            is_void &= frame.shown_cells(band)
        for cells, sums in (
            (is_void, void),
            (wall.count[band] > 0, measured),
        ):
            sums.append(np.add.reduceat(cells.sum(axis=0, dtype=np.int64), starts))
    return _Tiles(
        frame=replace(frame, gsd_m=side * frame.gsd_m, width=len(starts), height=len(void)),
        n_void=np.array(void),
        n_measured=np.array(measured),
    )


def _blocked(
    frame: WallFrame,
    tiles: NDArray[np.int64],
    sight: Sight,
    stations: NDArray[np.float64],
) -> NDArray[np.bool_]:
    every = -(-len(tiles) // _RAYS_MOST)
    asked = tiles[::every]
    places = np.column_stack([asked % frame.width, asked // frame.width]).astype(np.float64) + 0.5
    starts = frame.world_from_wall(places) - sight.points.origin
    room, normals = sight.room, frame.axes_at(places)[:, 2]
    is_blocked = np.ones(len(asked), dtype=np.bool_)
    for station in np.unique(stations, axis=0):
        rays = station - sight.points.origin - starts
        lengths_m = np.linalg.norm(rays, axis=1)
        is_met = np.einsum("ij,ij->i", rays, normals) <= 0.0
        rays /= np.maximum(lengths_m, 1e-9)[:, None]
        # Follow rays only inside the voxel grid, because a station may be far from all points or
        # (wrongly) at the origin of a survey grid.
        enter_m, leave_m = room.crossed_m(starts, rays)
        enter_m = np.maximum(enter_m, _ENDS_M)
        leave_m = np.minimum(leave_m, lengths_m - _ENDS_M)
        step_m = 0.5 * room.side_m
        n_steps = np.ceil(np.maximum(leave_m - enter_m, 0.0) / step_m)
        for step in range(int(n_steps.max(initial=0.0))):
            going = np.flatnonzero(~is_met & (step < n_steps))
            along_m = enter_m[going] + step * step_m
            is_met[going] = room.holds(starts[going] + along_m[:, None] * rays[going])
        is_blocked &= is_met
    return np.repeat(is_blocked, every)[: len(tiles)]


@dataclass(frozen=True, kw_only=True)
class _Room:
    """A grid of voxels that contain points or not; positions are relative to the cloud's origin."""

    low_m: NDArray[np.float64]
    side_m: float
    occupied: NDArray[np.bool_]

    @classmethod
    def of(cls, points: SampledPoints) -> _Room:
        axes = (points.x, points.y, points.z)
        # Use quantiles, so that isolated distant points do not enlarge the voxel grid.
        low, high = np.array([np.percentile(axis, (0.1, 99.9)) for axis in axes]).T
        low, high = low - 2.0 * _VOXEL_M, high + 2.0 * _VOXEL_M
        side_m = max(
            _VOXEL_M,
            float(np.cbrt((high - low).prod() / _VOXELS_MOST)),
            float((high - low).max()) / _VOXELS_MOST_ALONG,
        )
        shape = np.ceil((high - low) / side_m).astype(np.int64) + 1
        places = np.column_stack(
            [(axis - start) / side_m for axis, start in zip(axes, low, strict=True)]
        )
        inside = ((places >= 0.0) & (places < shape)).all(axis=1)
        voxels = np.ravel_multi_index(tuple(places[inside].astype(np.int64).T), tuple(shape))
        # A single point in a voxel is a stray point and does not hide a wall.
        counts = np.bincount(voxels, minlength=int(shape.prod())).reshape(tuple(shape))
        return cls(low_m=low, side_m=side_m, occupied=counts >= _POINTS_LEAST)

    def crossed_m(
        self, starts: NDArray[np.float64], ways: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the distances in metres at which rays (n, 3) enter and leave the voxel grid.

        If a ray misses the grid, the second distance is smaller than the first.
        """
        high_m = self.low_m + self.side_m * np.array(self.occupied.shape)
        with np.errstate(divide="ignore", invalid="ignore"):
            first_m, second_m = (self.low_m - starts) / ways, (high_m - starts) / ways
        # For a ray in a face of the grid, 0 / 0 is NaN; the other axes bound it.
        enter_m = np.nanmax(np.fmin(first_m, second_m), axis=1)
        leave_m = np.nanmin(np.fmax(first_m, second_m), axis=1)
        return enter_m, leave_m

    def holds(self, places: NDArray[np.float64]) -> NDArray[np.bool_]:
        voxels = np.floor((places - self.low_m) / self.side_m).astype(np.int64)
        inside = ((voxels >= 0) & (voxels < self.occupied.shape)).all(axis=1)
        held = np.zeros(len(places), dtype=np.bool_)
        held[inside] = self.occupied[tuple(voxels[inside].T)]
        return held
