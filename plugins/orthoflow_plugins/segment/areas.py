"""Areas of a wall that are behind its face or empty, and the kind of opening of each area.

Empty cells are classified by rays from the scanner, which passed through the wall or ended in front
of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.slabs import Slab
from orthoflow.products import OpeningKind, PointCloud, SurfaceMask, Wall

# Areas connected only by a strip narrower than this are separate.
_NECK_CELLS: Final = 3
# An area is `through` if rays passed through at least this share of its cells.
_CROSSED_LEAST: Final = 0.1
# Otherwise, an area is `no data` if at least this share of its cells is empty.
_EMPTY_LEAST: Final = 0.5
# If more than this share of the measured cells is behind the plane, the plane is not the wall's
# face.
_FACE_LEAST: Final = 0.5
MAX_MEASURED_CELLS: Final = 1 << 25
# Approximate side length of the tiles in which rays are counted; a tile contains many rays.
_TILE_M: Final = 0.05
# Larger clouds are reduced by Fibonacci hashing to a sample of about this number of points.
_POINTS_MOST: Final = 1 << 22
_TURN: Final = np.uint64(0x9E3779B97F4A7C15)
BLOCK: Final = 1 << 18
# If stations are unknown, only points within these distances behind and in front of the plane are
# used.
_BEHIND_MOST_M: Final = 4.0
_BEFORE_MOST_M: Final = 1.5
# Minimum number and minimum share of the rays to a tile that pass through it or end in front of it.
# Fewer rays are ignored, because isolated distant points are gross errors.
_RAYS_LEAST: Final = 2
_SHARE_LEAST: Final = 0.2


@dataclass(frozen=True, kw_only=True)
class SightLines:
    """Results of tracing rays to a wall, on tiles of its raster.

    Attributes:
        side: number of cells along the side of a tile.
        crossed: (rows, cols) bool, True where rays passed through the wall.
        stopped: (rows, cols) bool, True where rays ended in front of the wall and none passed
            through.
    """

    side: int
    crossed: NDArray[np.bool_]
    stopped: NDArray[np.bool_]

    def over(
        self, tiles: NDArray[np.bool_], shape: tuple[int, int], step: int
    ) -> NDArray[np.bool_]:
        """Return the values of tiles for the cells in every `step`-th row and column."""
        rows, columns = (np.arange(0, count, step) // self.side for count in shape)
        return tiles[np.ix_(rows, columns)]


def sight_lines(cloud: PointCloud, slab: Slab) -> SightLines:
    """Trace the rays of a cloud to a wall.

    If the station of each point is known, the ray from the station to the point is intersected with
    the wall's plane, beyond the point if necessary. Otherwise, rays perpendicular to the wall are
    assumed.

    Args:
        cloud: the points, with their stations if known.
        slab: the raster of the wall, and its depth in front of and behind the plane.
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
            # Do not use rays that are parallel to the plane or come from behind it.
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
    """Yield the ends (n, 3) of rays in blocks, with the starts (n, 3), or None if unknown."""
    # Use only stations from the file, because a viewpoint set by the user may be wrong for some
    # scans.
    stations = cloud.stations if cloud.stations_source == "file" else None
    scan = cloud.scan
    every = -(-len(cloud) // _POINTS_MOST)
    for first in range(0, len(cloud), BLOCK * every):
        index = np.arange(first, min(first + BLOCK * every, len(cloud)), every)
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
    """Classes of the cells of a wall, or of only the cells in every nth row and column.

    Attributes:
        gsd_m: side length of these cells.
        step: number of cells of the wall along the side of one of these cells.
        is_face: (rows, cols) bool, True for measured cells that are not behind the wall's face.
        is_open: (rows, cols) bool, True for cells that are behind the face or empty, and not
            hidden.
        is_empty: (rows, cols) bool, True for cells without a depth.
        is_crossed: (rows, cols) bool, True where rays passed through the wall.
        depth_m: (rows, cols) float32 depth in front of the plane in metres; NaN where empty.
        face_m: depth of the wall's face in metres; 0 if the face is on the plane.
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
    """An opening as a set of cells.

    Attributes:
        corner: row and column, in the relief, of the first cell of `cells`.
        cells: (rows, cols) bool, True inside the opening; without holes, and with a margin around
            the opening.
        kind: kind of the opening.
        depth_m: distance from the wall's face to the back of the opening; None if not measured.
    """

    corner: tuple[int, int]
    cells: NDArray[np.bool_]
    kind: OpeningKind
    depth_m: float | None


def relief_of(wall: Wall, lines: SightLines | None, behind_m: float) -> Relief:
    """Classify cells as face, open or hidden.

    Args:
        wall: the wall. If it has more than 32 million cells, only every nth row and column is used.
        lines: results of tracing rays; if None, no cell is considered hidden.
        behind_m: cells at least this far behind the wall's face do not belong to it.
    """
    import cv2

    step = 1
    while wall.mask.size // step**2 > MAX_MEASURED_CELLS:
        step += 1
    depth_m = np.ascontiguousarray(wall.depth_m[::step, ::step])
    is_empty = np.ascontiguousarray(wall.mask[::step, ::step] == SurfaceMask.VOID)
    is_crossed = is_hidden = np.zeros(is_empty.shape, dtype=np.bool_)
    if lines is not None:
        is_crossed = lines.over(lines.crossed, wall.frame.shape, step) & is_empty
        is_hidden = lines.over(lines.stopped, wall.frame.shape, step) & is_empty
    # A detected plane may be at the front of pilasters, or between this front and the wall. The
    # face is then the median depth of the cells behind the plane.
    measured_m = depth_m[~is_empty]
    deeper_m = measured_m[measured_m <= -behind_m]
    is_deeper = len(deeper_m) > _FACE_LEAST * len(measured_m)
    face_m = float(np.median(deeper_m)) if is_deeper else 0.0
    with np.errstate(invalid="ignore"):
        is_behind = ~is_empty & (depth_m <= face_m - behind_m)
    # Ignore single cells, which are due to noise or gaps between points.
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
    """Yield areas that are large enough and contain a square of a given width, largest first."""
    import cv2

    neck = cv2.getStructuringElement(cv2.MORPH_RECT, (_NECK_CELLS, _NECK_CELLS))
    cells = cv2.morphologyEx(relief.is_open.astype(np.uint8), cv2.MORPH_OPEN, neck)
    wide = max(1, round(width_least_m / relief.gsd_m))
    square = cv2.getStructuringElement(cv2.MORPH_RECT, (wide, wide))
    # Cells outside the raster must not enlarge areas.
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
        # Include bars and panes inside the opening.
        outside = np.pad(own, 1).astype(np.uint8)
        cv2.floodFill(outside, None, (0, 0), 2)
        known = relief.depth_m[part][own & ~relief.is_empty[part]]
        yield Area(
            corner=(int(top) - 1, int(left) - 1),
            cells=np.asarray(outside != 2, dtype=np.bool_),
            kind=kind,
            depth_m=relief.face_m - float(np.median(known)) if known.size else None,
        )
