"""Projection of photos onto wall rasters, with occlusion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.images import photo_grey, photo_rgb, reduced
from orthoflow.geometry import WallFrame
from orthoflow.geometry.cameras import ViewingCamera, to_opencv
from orthoflow.products import Photo, Wall

if TYPE_CHECKING:
    from orthoflow.geometry.occluders import Occluders

# Parts of a wall are matched if the cosine of the angle of incidence is at least this.
_GRAZING_COSINE: Final = 0.15
# Cell size of the depth buffer, in wall cells; it is large enough to avoid gaps in projected
# surfaces.
_BUFFER_CELLS: Final = 2.0
# A surface is hidden if it is more than this many wall cells behind the nearest one.
_HIDDEN_CELLS: Final = 6.0
_ROWS_AT_ONCE: Final = 256
# Cells this close to hidden cells may also be hidden: objects in front of a wall were scanned from
# other positions, and the pose is only accurate to a few cells.
_BESIDE_CELLS: Final = 3
# Step, in cells, of the first search for the part of a wall that a photo shows.
_COARSE: Final = 8
_MIN_CELLS: Final = 100
# Photo coordinate at which OpenCV samples cells outside the photo; the result is not used.
_OUTSIDE_PX: Final = -10.0


@dataclass(frozen=True, kw_only=True)
class Projection:
    """Photo positions of the cells of a wall, for the part of the wall that the photo shows.

    Attributes:
        part: rows and columns of the raster that the arrays cover.
        u: (rows, cols) float32 photo column, NaN where the cell is not in the photo.
        v: (rows, cols) float32 photo row, NaN where the cell is not in the photo.
        distance: (rows, cols) float32 distance from the camera along the optical axis, in metres.
        pixels_per_cell: median size of the cells in the photo, in pixels.
    """

    part: tuple[slice, slice]
    u: NDArray[np.float32]
    v: NDArray[np.float32]
    distance: NDArray[np.float32]
    pixels_per_cell: float

    @property
    def corner(self) -> NDArray[np.intp]:
        """The first column and row of the part."""
        return np.array([self.part[1].start, self.part[0].start], dtype=np.intp)

    def pixels_at(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return photo pixels (n, 2) at fractional cells (n, 2); NaN near void cells."""
        return np.column_stack([between(self.u, at), between(self.v, at)])

    def hide(self, mask: NDArray[np.bool_]) -> None:
        """Mark cells (rows, cols) as hidden."""
        self.u[mask] = np.nan
        self.v[mask] = np.nan


@dataclass(frozen=True, kw_only=True)
class Before:
    """Points in front of the walls that may hide them.

    Attributes:
        occluders: the points.
        front_m: for each wall, the distance in front of its plane up to which points belong to its
            raster.
    """

    occluders: Occluders
    front_m: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class View:
    """A photo projected onto the walls with a given pose.

    Attributes:
        index: index of the photo.
        grey: (height, width) grey values of the photo.
        colours: function that returns the colours (height, width, 3) of the photo; they are only
            needed for some photos.
        camera: the pose.
        projections: projection of each wall, None if the photo does not show it.
        hidden: cells of each wall that are hidden by points in front of it; empty if unknown.
        warped: grey values of the photo in the raster of each wall, computed on demand.
    """

    index: int
    grey: NDArray[np.uint8]
    colours: Callable[[], NDArray[np.uint8]]
    camera: ViewingCamera
    projections: Sequence[Projection | None]
    hidden: Sequence[NDArray[np.bool_]] = ()
    warped: dict[int, NDArray[np.float32]] = field(default_factory=dict)

    def on_wall(self, index: int, projection: Projection) -> NDArray[np.float32]:
        """Return the grey values of the photo in the raster of a wall."""
        if index not in self.warped:
            self.warped[index] = warp_photo(self.grey, projection)
        return self.warped[index]

    def colours_on_wall(self, projection: Projection) -> NDArray[np.float32]:
        """Return the colours (rows, cols, 3) of the photo in the raster of a wall."""
        return warp_photo(self.colours(), projection)

    def posed(self, camera: ViewingCamera, walls: Sequence[Wall]) -> View:
        """Project the photo onto the walls with another pose."""
        projections = _bared(project_walls(camera, walls), self.hidden)
        return replace(self, camera=camera, projections=projections, warped={})


def view_of(
    index: int,
    photo: Photo,
    camera: ViewingCamera,
    walls: Sequence[Wall],
    before: Before | None = None,
) -> View:
    """Project a photo onto the walls with a given pose.

    Args:
        index: index of the photo.
        photo: the photo.
        camera: the pose.
        walls: all walls.
        before: points in front of the walls, which may hide them; None if unknown.
    """
    projections = project_walls(camera, walls)
    hidden = [] if before is None else _hidden(projections, camera, walls, before)
    return View(
        index=index,
        grey=photo_grey(photo),
        # Decode the colours only once for all rounds and walls.
        colours=cache(partial(photo_rgb, photo)),
        camera=camera,
        projections=_bared(projections, hidden),
        hidden=hidden,
    )


def _hidden(
    projections: Sequence[Projection | None],
    camera: ViewingCamera,
    walls: Sequence[Wall],
    before: Before,
) -> list[NDArray[np.bool_]]:
    """Find the cells of each wall hidden by points in front of it, and cells close to these."""
    import cv2

    from orthoflow.geometry.occluders import depth_buffer

    buffer = depth_buffer(before.occluders, camera)
    side = 2 * _BESIDE_CELLS + 1
    hidden = []
    for wall, projection, front_m in zip(walls, projections, before.front_m, strict=True):
        mask = np.zeros(wall.frame.shape, dtype=np.uint8)
        if projection is not None:
            seen = np.isfinite(projection.u)
            # Rounding to single precision may move a pixel exactly onto the right or lower border.
            rows, columns = (
                np.minimum((pixels[seen] / buffer.reduction).astype(np.intp), length - 1)
                for pixels, length in zip(
                    (projection.v, projection.u), buffer.nearest.shape, strict=True
                )
            )
            # Position of the nearest point on the ray from the camera to the cell, 0 at the camera,
            # 1 at the cell.
            along = np.minimum(buffer.nearest[rows, columns] / projection.distance[seen], 1.0)
            frame = wall.frame
            depths_m = wall.depth_m[projection.part][seen]
            if frame.bend is None:
                camera_m = float((camera.centre_world - frame.origin_world) @ frame.normal_world)
                above_m = (1.0 - along) * camera_m + along * depths_m
            else:
                rows, columns = np.nonzero(seen)
                cells = (np.column_stack([columns, rows]) + projection.corner).astype(np.float64)
                points = frame.world_from_wall(cells + 0.5, depths_m.astype(np.float64))
                above_m = _highest_m(frame, points, camera.centre_world, 1.0 - along)
            mask[projection.part][seen] = above_m > front_m + frame.gsd_m
        dilated = cv2.dilate(mask, np.ones((side, side), dtype=np.uint8))
        hidden.append(np.asarray(dilated, dtype=np.bool_))
    return hidden


def _highest_m(
    frame: WallFrame,
    points: NDArray[np.float64],
    centre: NDArray[np.float64],
    shares: NDArray[np.float32],
) -> NDArray[np.float64]:
    """Return the largest depths (n,) on the rays from points (n, 3) of a curved wall to a camera.

    A ray from the inside of a curved surface rises first and then falls again.

    Args:
        frame: the raster of the wall.
        points: the starts of the rays.
        centre: (3,) the camera.
        shares: (n,) parts of the rays, from the start.
    """
    rays = centre - points
    if frame.bend is not None and frame.bend.is_concave:
        axes = frame.axes_world.T
        highest = frame.bend.highest_shares((points - frame.origin_world) @ axes, rays @ axes)
        shares = np.minimum(shares, np.maximum(highest, 0.0)).astype(np.float32)
    return frame.wall_from_world(points + shares[:, None] * rays)[:, 2]


def _bared(
    projections: Sequence[Projection | None], hidden: Sequence[NDArray[np.bool_]]
) -> Sequence[Projection | None]:
    for projection, mask in zip(projections, hidden, strict=bool(hidden)):
        if projection is not None:
            projection.hide(mask[projection.part])
    return projections


def project_walls(camera: ViewingCamera, walls: Sequence[Wall]) -> list[Projection | None]:
    """Project the surfaces of all walls into a photo; the result is None for walls outside it.

    Cells hidden by a surface of the same wall or of another wall are NaN.
    """
    seen = [_in_photo(camera, wall) for wall in walls]
    shown = [(wall, item) for wall, item in zip(walls, seen, strict=True) if item is not None]
    if not shown:
        return list(seen)
    step = _BUFFER_CELLS * max(1.0, *(item.pixels_per_cell for _, item in shown))
    shape = (int(camera.height / step) + 1, int(camera.width / step) + 1)
    nearest = np.full(shape, np.inf, dtype=np.float32)
    buffered = []
    for _, item in shown:
        known = np.isfinite(item.u)
        cells = tuple((pixels[known] / step).astype(np.intp) for pixels in (item.v, item.u))
        np.minimum.at(nearest, cells, item.distance[known])
        buffered.append((known, cells))
    for (wall, item), (known, cells) in zip(shown, buffered, strict=True):
        hidden = np.zeros(known.shape, dtype=np.bool_)
        limit = nearest[cells] + _HIDDEN_CELLS * wall.frame.gsd_m
        hidden[known] = item.distance[known] > limit
        item.hide(hidden)
    return list(seen)


def warp_photo(picture: NDArray[np.uint8], projection: Projection) -> NDArray[np.float32]:
    """Resample a photo at the cells of a wall, after reducing the photo to their resolution.

    Args:
        picture: (height, width) or (height, width, c).
        projection: positions of the cells in the photo.

    Returns:
        (rows, cols) or (rows, cols, c) over `projection.part`, 0..255; NaN outside the photo.
    """
    import cv2

    factor = min(1.0, 1.0 / max(projection.pixels_per_cell, 1e-6))
    small = reduced(picture, factor)
    known = np.isfinite(projection.u)
    map_u, map_v = (
        np.where(known, to_opencv(pixels * factor), _OUTSIDE_PX).astype(np.float32)
        for pixels in (projection.u, projection.v)
    )
    warped = np.asarray(
        cv2.remap(
            small.astype(np.float32), map_u, map_v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
        ),
        dtype=np.float32,
    )
    warped[~known] = np.nan
    return warped


def _in_photo(camera: ViewingCamera, wall: Wall) -> Projection | None:
    frame = wall.frame
    towards = (
        camera.centre_world
        - frame.world_from_wall(np.array([[0.5 * frame.width, 0.5 * frame.height]]))[0]
    )
    if frame.bend is None and float(towards @ frame.normal_world) <= 0.0:
        return None
    # Use an origin on the wall, since large survey coordinates would reduce the precision.
    near = camera.shifted(frame.origin_world)
    coarse = _project_cells(near, wall, (slice(0, frame.height), slice(0, frame.width)), _COARSE)
    part = _part_in_photo(np.isfinite(coarse[0]), frame.shape)
    if part is None:
        return None
    u, v, distance = _project_cells(near, wall, part, 1)
    with np.errstate(invalid="ignore"):
        across = np.hypot(np.diff(u, axis=1), np.diff(v, axis=1))[:-1]
        down = np.hypot(np.diff(u, axis=0), np.diff(v, axis=0))[:, :-1]
        size = np.sqrt(across * down)
    size = size[np.isfinite(size)]
    if np.isfinite(u).sum() < _MIN_CELLS or not size.size:
        return None
    per_cell = float(np.median(size))
    return Projection(part=part, u=u, v=v, distance=distance, pixels_per_cell=per_cell)


def _part_in_photo(seen: NDArray[np.bool_], shape: tuple[int, int]) -> tuple[slice, slice] | None:
    """Return the rows and columns of the coarse cells in the photo, with a margin of one cell."""
    if not seen.any():
        return None
    spans = []
    for axis, length in enumerate(shape):
        hit = np.flatnonzero(seen.any(axis=1 - axis))
        first, last = int(hit[0]) - 1, int(hit[-1]) + 2
        spans.append(slice(max(0, first * _COARSE), min(length, last * _COARSE)))
    return spans[0], spans[1]


def _project_cells(
    near: ViewingCamera, wall: Wall, part: tuple[slice, slice], step: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return u, v and the distance of every step-th cell; the origin of `near` is on the wall."""
    frame = wall.frame
    rows = np.arange(part[0].start, part[0].stop, step)
    columns = np.arange(part[1].start, part[1].stop, step)
    u, v, distance = (np.full((rows.size, columns.size), np.nan, np.float32) for _ in range(3))
    for first in range(0, rows.size, _ROWS_AT_ONCE):
        some = rows[first : first + _ROWS_AT_ONCE]
        grid = np.stack(np.meshgrid(columns + 0.5, some + 0.5), axis=-1).reshape(-1, 2)
        depth = wall.depth_m[np.ix_(some, columns)].astype(np.float64).ravel()
        points = frame.world_from_wall(grid, depth) - frame.origin_world
        seen = near.project(points)
        rays = near.centre_world - points
        if frame.bend is None:
            lifts = rays @ frame.normal_world
        else:
            lifts = np.einsum("ij,ij->i", rays, frame.axes_at(grid)[:, 2])
        cosine = lifts / np.linalg.norm(rays, axis=1)
        seen[~near.sees(seen[:, :2]) | ~(cosine > _GRAZING_COSINE)] = np.nan
        for raster, values in zip((u, v, distance), seen.T, strict=True):
            raster[first : first + some.size] = values.reshape(some.size, columns.size)
    return u, v, distance


def between(raster: NDArray[np.float32], at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Interpolate values at fractional cells (n, 2) = (column, row); NaN near unknown cells."""
    height, width = raster.shape
    inside = (at >= 0.0).all(axis=1) & (at[:, 0] < width - 1) & (at[:, 1] < height - 1)
    left = np.where(inside, at[:, 0], 0.0).astype(np.intp)
    top = np.where(inside, at[:, 1], 0.0).astype(np.intp)
    a, b = at[:, 0] - left, at[:, 1] - top
    right, below = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    corners = raster[[top, top, below, below], [left, right, left, right]].astype(np.float64)
    weights = np.array([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
    values: NDArray[np.float64] = (corners * weights).sum(axis=0)
    return np.where(inside, values, np.nan)
