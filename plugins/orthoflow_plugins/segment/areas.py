"""Areas of a wall that lie behind its face or are empty, and the kind of opening of each.

Lines of sight that crossed the wall, or ended in front of it, classify empty cells.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.slabs import Slab
from orthoflow.products import OpeningKind, PointCloud, SurfaceMask, Wall

# Narrower connections do not join areas.
_NECK_CELLS: Final = 3
# Shares of the cells of an area, crossed by rays or empty, that decide its kind.
_CROSSED_LEAST: Final = 0.1
_EMPTY_LEAST: Final = 0.5
# If this share of the measured cells lies behind a plane, the plane is not the wall's face.
_FACE_LEAST: Final = 0.5
_CELLS_TOLD: Final = 1 << 25
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


@dataclass(frozen=True, kw_only=True)
class Relief:
    """The class of each cell of a wall, or of every nth of its rows and columns.

    Attributes:
        gsd_m: side of these cells.
        step: cells of the wall per cell of these.
        is_face: (rows, cols) bool, measured, and not behind the wall.
        is_open: (rows, cols) bool, behind it or empty, and not hidden.
        is_empty: (rows, cols) bool, depth unknown.
        is_crossed: (rows, cols) bool, rays passed through.
        depth_m: (rows, cols) float32 in front of the plane, NaN where empty.
        face_m: depth of the wall's face, 0 where that is the plane.
    """

    gsd_m: float
    step: int
    is_face: NDArray[np.bool_]
    is_open: NDArray[np.bool_]
    is_empty: NDArray[np.bool_]
    is_crossed: NDArray[np.bool_]
    depth_m: NDArray[np.float32]
    face_m: float


@dataclass(frozen=True, kw_only=True)
class Area:
    """An opening as cells.

    Attributes:
        corner: row and column of the first cell of `cells` in the relief.
        cells: (rows, cols) bool, those of the opening, without holes, with a margin.
        kind: see `OpeningKind`.
        depth_m: distance of its back behind the wall's face; None if nothing was measured.
    """

    corner: tuple[int, int]
    cells: NDArray[np.bool_]
    kind: OpeningKind
    depth_m: float | None


def relief_of(wall: Wall, lines: SightLines | None, behind_m: float) -> Relief:
    """Classify cells as face, open or hidden.

    Args:
        wall: the wall; with more than 32 million cells every nth row and column is used.
        lines: what rays show about empty cells; without them (None) no cell is hidden.
        behind_m: cells at least this far behind the wall's face do not belong to it.
    """
    import cv2

    step = 1
    while wall.mask.size // step**2 > _CELLS_TOLD:
        step += 1
    depth_m = np.ascontiguousarray(wall.depth_m[::step, ::step])
    is_empty = np.ascontiguousarray(wall.mask[::step, ::step] == SurfaceMask.VOID)
    is_crossed = is_hidden = np.zeros(is_empty.shape, dtype=np.bool_)
    if lines is not None:
        is_crossed = lines.over(lines.crossed, wall.frame.shape, step) & is_empty
        is_hidden = lines.over(lines.stopped, wall.frame.shape, step) & is_empty
    # A detector may have placed the plane on the fronts of pilasters, or between them and the wall:
    # then the face is the median of the cells behind it.
    measured_m = depth_m[~is_empty]
    deeper_m = measured_m[measured_m <= -behind_m]
    is_deeper = len(deeper_m) > _FACE_LEAST * len(measured_m)
    face_m = float(np.median(deeper_m)) if is_deeper else 0.0
    with np.errstate(invalid="ignore"):
        is_behind = ~is_empty & (depth_m <= face_m - behind_m)
    # Single cells, from noise or between points, are ignored.
    is_open = cv2.medianBlur((is_behind | (is_empty & ~is_hidden)).astype(np.uint8), 5) > 0
    return Relief(
        gsd_m=step * wall.frame.gsd_m,
        step=step,
        is_face=~is_empty & ~is_behind,
        is_open=is_open,
        is_empty=is_empty,
        is_crossed=is_crossed,
        depth_m=depth_m,
        face_m=face_m,
    )


def open_areas(relief: Relief, width_least_m: float, area_least_m2: float) -> Iterator[Area]:
    """Return the areas that are large enough and hold a square of some width, largest first."""
    import cv2

    neck = cv2.getStructuringElement(cv2.MORPH_RECT, (_NECK_CELLS, _NECK_CELLS))
    cells = cv2.morphologyEx(relief.is_open.astype(np.uint8), cv2.MORPH_OPEN, neck)
    wide = max(1, round(width_least_m / relief.gsd_m))
    square = cv2.getStructuringElement(cv2.MORPH_RECT, (wide, wide))
    # Cells beyond the raster must not widen an area.
    cores = cv2.erode(cells, square, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    n_areas, labels, boxes, _ = cv2.connectedComponentsWithStats(cells, connectivity=4)
    is_wide = np.zeros(n_areas, dtype=np.bool_)
    is_wide[np.unique(labels[cores > 0])] = True
    is_wide[0] = False
    n_least = area_least_m2 / relief.gsd_m**2
    sizes = boxes[:, cv2.CC_STAT_AREA]
    for label in sorted(np.flatnonzero(is_wide & (sizes >= n_least)), key=lambda k: -sizes[k]):
        left, top, width, height, _ = boxes[label]
        part = (slice(top, top + height), slice(left, left + width))
        own = labels[part] == label
        kind: OpeningKind = "niche"
        if np.count_nonzero(relief.is_crossed[part] & own) >= _CROSSED_LEAST * sizes[label]:
            kind = "through"
        elif np.count_nonzero(relief.is_empty[part] & own) >= _EMPTY_LEAST * sizes[label]:
            kind = "no data"
        # Bars and panes across are included.
        outside = np.pad(own, 1).astype(np.uint8)
        cv2.floodFill(outside, None, (0, 0), 2)
        known = relief.depth_m[part][own & ~relief.is_empty[part]]
        yield Area(
            corner=(int(top) - 1, int(left) - 1),
            cells=np.asarray(outside != 2, dtype=np.bool_),
            kind=kind,
            depth_m=relief.face_m - float(np.median(known)) if known.size else None,
        )
