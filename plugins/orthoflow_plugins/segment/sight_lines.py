"""Where lines of sight crossed a wall or ended in front of it, to classify empty cells."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.slabs import Slab
from orthoflow.products import PointCloud

# Rays are counted on tiles of about this side, which hold many rays.
_TILE_M: Final = 0.05
# Of larger clouds one point of this many is used, spread by Fibonacci hashing.
_POINTS_MOST: Final = 1 << 22
_TURN: Final = np.uint64(0x9E3779B97F4A7C15)
_BLOCK: Final = 1 << 18
# Without stations, points this far behind or in front of an empty place decide.
_BEHIND_MOST_M: Final = 4.0
_BEFORE_MOST_M: Final = 1.5
# Isolated distant points are gross errors: this many rays of a tile must agree.
_RAYS_LEAST: Final = 2
_SHARE_LEAST: Final = 0.2


@dataclass(frozen=True, kw_only=True)
class SightLines:
    """What lines of sight show about a wall, on tiles of its raster.

    Attributes:
        side: cells along the side of a tile.
        crossed: (rows, cols) bool, rays passed through the wall here.
        stopped: (rows, cols) bool, rays ended in front of it here, and none passed through.
    """

    side: int
    crossed: NDArray[np.bool_]
    stopped: NDArray[np.bool_]

    def over(
        self, tiles: NDArray[np.bool_], shape: tuple[int, int], step: int
    ) -> NDArray[np.bool_]:
        """Return tiles as cells of the wall's raster (rows, cols), of every nth row and column."""
        rows, columns = (np.arange(0, count, step) // self.side for count in shape)
        return tiles[np.ix_(rows, columns)]


def sight_lines(cloud: PointCloud, slab: Slab) -> SightLines:
    """Follow the rays of a cloud to a wall.

    If the station of each point is known, the point is the end of a ray that is followed from there
    to the wall's plane, or extended to it. Otherwise rays perpendicular to the wall are assumed.

    Args:
        cloud: the points.
        slab: the wall's raster, and its depths in front of and behind its plane.
    """
    frame = slab.frame
    side = max(1, min(round(_TILE_M / frame.gsd_m), *frame.shape))
    rows, columns = (-(-count // side) for count in frame.shape)
    tiles = replace(frame, gsd_m=side * frame.gsd_m, width=columns, height=rows)
    counts = np.zeros((3, rows * columns), dtype=np.int64)
    for ends, starts in _rays(cloud):
        places = tiles.wall_from_world(ends)
        depth_m = places[:, 2].copy()
        if starts is None:
            asked = (depth_m > -_BEHIND_MOST_M) & (depth_m < _BEFORE_MOST_M)
        else:
            from_station = tiles.wall_from_world(starts)
            # A ray from behind, or along the plane, shows nothing.
            asked = (from_station[:, 2] > np.maximum(depth_m, 0.0)) & (from_station[:, 2] > 0.0)
            fall = np.where(asked, from_station[:, 2] - depth_m, 1.0)
            share = np.where(asked, from_station[:, 2] / fall, 0.0)[:, None]
            places = from_station + share * (places - from_station)
        tile = np.floor(places[:, :2])
        asked &= ((tile >= 0) & (tile < (columns, rows))).all(axis=1)
        cells = (tile[asked, 1] * columns + tile[asked, 0]).astype(np.int64)
        of_rays = depth_m[asked]
        for what, chosen in enumerate(
            (
                of_rays < -slab.behind_m,
                of_rays > slab.front_m,
                (of_rays >= -slab.behind_m) & (of_rays <= slab.front_m),
            )
        ):
            counts[what] += np.bincount(cells[chosen], minlength=rows * columns)
    crossed, stopped, met = counts.reshape(3, rows, columns)
    is_crossed = (crossed >= _RAYS_LEAST) & (crossed >= _SHARE_LEAST * (crossed + met))
    return SightLines(
        side=side,
        crossed=is_crossed,
        stopped=~is_crossed
        & (stopped >= _RAYS_LEAST)
        & (stopped >= _SHARE_LEAST * (stopped + met)),
    )


def _rays(
    cloud: PointCloud,
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64] | None]]:
    """Yield ends (n, 3) of rays, block by block, and their starts if known."""
    # Without the scan of each point, some scans may have been taken from elsewhere.
    stations = cloud.stations if cloud.stations_source == "file" else None
    scan = cloud.scan
    every = -(-len(cloud) // _POINTS_MOST)
    for first in range(0, len(cloud), _BLOCK * every):
        index = np.arange(first, min(first + _BLOCK * every, len(cloud)), every)
        if every > 1:
            chance = (index.astype(np.uint64) * _TURN) >> np.uint64(32)
            index = np.minimum(index + (chance % np.uint64(every)).astype(np.int64), len(cloud) - 1)
        starts = None
        if stations is not None and scan is not None:
            of_scan = scan[index].astype(np.int64)
            known = of_scan < len(stations)
            index, starts = index[known], stations[of_scan[known]]
        yield cloud.points_world(index), starts
