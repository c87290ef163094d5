"""Positions of check points in images: measured, found as targets, or found by the true scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import WallFrame
from orthoflow.geometry.levels import REC_601
from orthoflow.geometry.robust import median_deviation
from orthoflow.products import CheckPoints, Orthoimage, Truth, Wall, Walls
from orthoflow_plugins.inspect.patches import (
    PATCH_CELLS,
    GreyCells,
    GreyImage,
    correlations,
    refine_shifts,
    unrefined,
)
from orthoflow_plugins.inspect.targets import find_crossing

How = Literal["measured", "target", "truth", "not found", "outside"]

# Standard deviation of the Gaussian weight, which reduces the influence of texture far from the
# point.
_FOCUS_CELLS: Final = 5.0
_LEAST_VALID: Final = 0.6
_LEAST_CORRELATION: Final = 0.6
_SIGMA_MOST_CELLS: Final = 1.0
# Targets are not quite flat, so the depth of the centre is computed from depths within this share
# of the radius.
_DEPTH_SHARE: Final = 0.5


@dataclass(frozen=True, kw_only=True)
class ShownPoint:
    """A check point in an image.

    Attributes:
        how: how the point was found, or why it was not found.
        wall: index of the wall in `Walls`; -1 if the point is on no wall.
        expected: (2,) column and row of the surveyed position; NaN if the point is on no wall.
        place: (2,) column and row at which the image shows the point; NaN if not found.
        point_world: (3,) surface point at `place`, in metres; NaN if unknown.
    """

    how: How
    wall: int = -1
    expected: NDArray[np.float64] = field(default_factory=lambda: np.full(2, np.nan))
    place: NDArray[np.float64] = field(default_factory=lambda: np.full(2, np.nan))
    point_world: NDArray[np.float64] = field(default_factory=lambda: np.full(3, np.nan))


@dataclass(frozen=True, kw_only=True)
class Picture:
    """An image in which points are searched for.

    Attributes:
        wall: index of the wall in `Walls`.
        frame: grid of the cells.
        grey: grey levels of the cells.
        surface: the wall, on the grid of the image.
        image: background of the figure of residuals.
    """

    wall: int
    frame: WallFrame
    grey: GreyCells
    surface: Wall
    image: Orthoimage


@dataclass(frozen=True, kw_only=True)
class PointFinder:
    """Finds check points one by one.

    Attributes:
        pictures: images that may show points.
        checkpoints: the surveyed points.
        walls: walls of the images.
        truth: truth of a simulated room, or None to search for targets.
        search_m: search radius.
        target_radius_m: radius of the targets, or of their inner part if only that part is used.
    """

    pictures: Sequence[Picture]
    checkpoints: CheckPoints
    walls: Walls
    truth: Truth | None
    search_m: float
    target_radius_m: float

    def find(self, index: int) -> ShownPoint:
        """Find the position at which an image shows a point."""
        points = self.checkpoints
        world = points.points_world[index]
        wall = int(points.wall[index])
        picture = self._picture_of(world, wall if wall >= 0 else None)
        if picture is None:
            return ShownPoint(how="outside")
        frame = picture.frame
        expected = frame.wall_from_world(world[None])[0, :2]
        measured = points.pixels_wall[index]
        if points.places_m is not None and np.isfinite(points.places_m[index]).all():
            measured = frame.wall_from_raster(points.places_m[index])
        if points.shown_world is not None and np.isfinite(points.shown_world[index]).all():
            measured = frame.wall_from_world(points.shown_world[index][None])[0, :2]
        if np.isfinite(measured).all():
            return ShownPoint(how="measured", wall=picture.wall, expected=expected, place=measured)
        if self.truth is not None:
            return self._by_truth(picture, expected, self.truth)
        return self._target(picture, expected)

    def _picture_of(self, world: NDArray[np.float64], wall: int | None) -> Picture | None:
        """Return the image of the wall with a given number, or of the wall nearest to a point."""
        best, nearest = None, np.inf
        for picture in self.pictures:
            if wall is not None and picture.image.number == wall:
                return picture
            column, row, depth = picture.frame.wall_from_world(world[None])[0]
            inside = 0 <= column < picture.frame.width and 0 <= row < picture.frame.height
            slab = self.walls.slab(picture.wall)
            within = -slab.behind_m <= depth <= slab.front_m
            if wall is None and inside and within and abs(depth) < nearest:
                best, nearest = picture, abs(float(depth))
        return best

    def _by_truth(
        self, picture: Picture, expected: NDArray[np.float64], truth: Truth
    ) -> ShownPoint:
        slab = self.walls.slab(picture.wall)
        place = find_by_truth(
            picture.grey,
            picture.frame,
            expected,
            truth,
            buffers_m=(slab.front_m, slab.behind_m),
            search_cells=int(np.clip(np.ceil(self.search_m / picture.frame.gsd_m), 2, 12)),
        )
        if place is None:
            return ShownPoint(how="not found", wall=picture.wall, expected=expected)
        return ShownPoint(how="truth", wall=picture.wall, expected=expected, place=place)

    def _target(self, picture: Picture, expected: NDArray[np.float64]) -> ShownPoint:
        gsd_m = picture.frame.gsd_m
        crossing = find_crossing(
            picture.grey,
            expected,
            search_cells=self.search_m / gsd_m,
            radius_cells=self.target_radius_m / gsd_m,
        )
        if crossing is None:
            return ShownPoint(how="not found", wall=picture.wall, expected=expected)
        radius_m = _DEPTH_SHARE * self.target_radius_m
        found = ShownPoint(how="target", wall=picture.wall, expected=expected, place=crossing)
        point = point_on_surface(picture.surface, crossing, radius_m)
        return found if point is None else replace(found, point_world=point)


def find_by_truth(
    picture: GreyCells,
    frame: WallFrame,
    expected: NDArray[np.float64],
    truth: Truth,
    *,
    buffers_m: tuple[float, float],
    search_cells: int,
) -> NDArray[np.float64] | None:
    """Find a point by its surroundings, which are rendered from the scene.

    Args:
        picture: the image to inspect.
        frame: grid of the image.
        expected: (2,) column and row of the surveyed position.
        truth: the simulated scene.
        buffers_m: depths in front of and behind the plane that belong to the wall.
        search_cells: search radius.

    Returns:
        (2,) column and row, or None if the correlation is too low everywhere.
    """
    from orthoflow.geometry.scene_views import render

    rim = search_cells + 4
    side = PATCH_CELLS + 2 * rim
    corner = np.floor(expected).astype(np.int64) - side // 2
    part = frame.part(corner.astype(np.float64), width=side, height=side)
    true = render(truth.scene, part, front_m=buffers_m[0], behind_m=buffers_m[1])
    known = np.asarray(np.isfinite(true.rgb).all(axis=2), dtype=np.bool_)
    reference = GreyImage(
        grey=np.where(known, np.nan_to_num(true.rgb) @ REC_601, 0.0), valid=known, region=known
    )
    shown = picture.square(corner, side)
    whole = _whole_shift(shown, reference, rim, search_cells)
    if whole is None:
        return None
    # Centre the patch on the shown position, so that its displacement is that of the point.
    centre = np.full(2, side // 2) + whole
    found = refine_shifts(
        shown,
        reference,
        unrefined(centre[None].astype(np.float64), whole[None].astype(np.float64)),
        sigma_most_cells=_SIGMA_MOST_CELLS,
        focus_cells=_FOCUS_CELLS,
    )
    if len(found.shift) == 0 or found.correlation[0] < _LEAST_CORRELATION:
        return None
    return np.asarray(expected + found.shift[0])


def point_on_surface(
    wall: Wall, place: NDArray[np.float64], radius_m: float
) -> NDArray[np.float64] | None:
    """Return the world point (3,) of a position, on the plane that fits nearby depths, or None.

    The plane is fitted robustly, because a target on a holder is flat even if the wall around it is
    not.
    """
    radius = radius_m / wall.frame.gsd_m
    low = np.maximum(np.floor(place - radius).astype(np.int64), 0)
    high = np.ceil(place + radius).astype(np.int64)
    part = (slice(low[1], high[1]), slice(low[0], high[0]))
    depth = wall.depth_m[part].astype(np.float64)
    rows, columns = np.nonzero(np.isfinite(depth))
    aside = np.column_stack([columns + 0.5 + low[0], rows + 0.5 + low[1]]) - place
    near = np.hypot(aside[:, 0], aside[:, 1]) <= radius
    aside, values = aside[near], depth[rows, columns][near]
    if len(values) < 12:
        return None
    design = np.column_stack([np.ones(len(values)), aside])
    kept = np.abs(values - np.median(values)) <= 0.02
    for _ in range(8):
        if np.count_nonzero(kept) < 12:
            return None
        plane = np.linalg.lstsq(design[kept], values[kept], rcond=None)[0]
        off = values - design @ plane
        spread = median_deviation(off[kept], 0.0)
        kept = np.abs(off) <= max(2.5 * spread, 1e-4)
    return np.asarray(wall.frame.world_from_wall(place[None], float(plane[0]))[0])


def _whole_shift(
    shown: GreyImage, true: GreyImage, rim: int, search: int
) -> NDArray[np.int64] | None:
    """Return the displacement (right, down), in whole cells, of the middle of `true` in `shown`."""
    middle = slice(rim, rim + PATCH_CELLS)
    down, right = np.mgrid[:PATCH_CELLS, :PATCH_CELLS] - 0.5 * (PATCH_CELLS - 1)
    focus = np.exp(-0.5 * (down**2 + right**2) / _FOCUS_CELLS**2)
    pattern = true.grey[middle, middle]
    best, best_shift = _LEAST_CORRELATION - 0.2, None
    for row in range(-search, search + 1):
        for column in range(-search, search + 1):
            part = (
                slice(rim + row, rim + row + PATCH_CELLS),
                slice(rim + column, rim + column + PATCH_CELLS),
            )
            weight = focus * (shown.valid[part] & true.valid[middle, middle])
            if weight.sum() < _LEAST_VALID * focus.sum():
                continue
            flat = (grey.reshape(1, -1) for grey in (shown.grey[part], pattern, weight))
            likeness = float(correlations(*flat)[0])
            if likeness > best:
                best, best_shift = likeness, np.array([column, row], dtype=np.int64)
    return best_shift
