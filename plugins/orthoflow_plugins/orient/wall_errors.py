"""What an orientation's uncertainty means on the wall: metres where its photo would be laid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.resection import Resection, pixels_by_point, predicted_covariances
from orthoflow.products import Ties, plane_name
from orthoflow_plugins.orient.lenses import camera_rays

_SIDE: Final = 15
# A view flatter than this onto the wall paints nothing useful.
_GRAZING_COSINE: Final = 0.1


@dataclass(frozen=True, kw_only=True)
class KnownWall:
    """A wall as ties describe it.

    Attributes:
        index: of the wall.
        number: for people: the place of its plane in `planes.json`.
        name: for people.
        corners_world: (4, 3) metres: top-left, then counter-clockwise for the viewer.
        normal: (3,) unit vector towards the viewer.
        gsd_m: cell of its raster, or None when the ties do not say.
        has_side: whether the normal is known to point to the viewer.
    """

    index: int
    number: int
    name: str
    corners_world: NDArray[np.float64]
    normal: NDArray[np.float64]
    gsd_m: float | None
    has_side: bool


@dataclass(frozen=True, kw_only=True)
class WallError:
    """Predicted error of a photo on the walls it shows.

    Attributes:
        rms_m: standard deviation of a coordinate in the wall's plane, RMS over the footprint.
        worst_m: the largest one in the footprint, and at the corners of the image.
        corners_m: (4,) the same at the corners of the image, top-left, top-right, bottom-left,
            bottom-right; NaN where a corner shows none of the walls.
        footprint_px: (n, 2) pixels of the grid points that lie in the footprint.
        sigmas_m: (n,) standard deviation of a coordinate in the wall's plane at these.
    """

    rms_m: float
    worst_m: float
    corners_m: NDArray[np.float64]
    footprint_px: NDArray[np.float64]
    sigmas_m: NDArray[np.float64]


def known_walls(ties: Ties, chosen: NDArray[np.bool_]) -> list[KnownWall]:
    """Describe the walls of some ties: from what their matcher says, else from the points."""
    walls = []
    for index in np.unique(ties.wall[chosen & (ties.wall >= 0)]):
        if int(index) < len(ties.walls):
            walls.append(_described(int(index), ties))
        else:
            points = ties.points_world[chosen & (ties.wall == index)]
            if len(points) >= 3:
                walls.append(_fitted(int(index), points))
    return walls


def wall_error(resection: Resection, walls: Sequence[KnownWall]) -> WallError | None:
    """Predict the error on the walls from the covariance; None when the photo shows no wall."""
    parts = [_on_one_wall(resection, wall) for wall in walls]
    variances = np.concatenate([np.empty(0), *(part[0] for part in parts)])
    if not variances.size:
        return None
    corners = _at_corners(resection, walls)
    return WallError(
        rms_m=float(np.sqrt(variances.mean())),
        worst_m=float(np.sqrt(np.fmax.reduce(corners, initial=variances.max()))),
        corners_m=np.sqrt(corners),
        footprint_px=np.vstack([part[1] for part in parts]),
        sigmas_m=np.sqrt(variances),
    )


def sigmas_on_wall(
    resection: Resection, wall: KnownWall, shape: tuple[int, int]
) -> NDArray[np.float64]:
    """Predicted standard deviation of a coordinate in a wall's plane, on a grid over the wall.

    Returns:
        (rows, cols) metres, the first row at the top, NaN where the photo does not show the wall.
    """
    variances, _ = _variances(resection, wall, _grid(wall, shape))
    return np.sqrt(variances).reshape(shape)


def _on_one_wall(
    resection: Resection, wall: KnownWall
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Variances (n,) in metres squared per coordinate, and pixels (n, 2), over the footprint."""
    variances, pixels = _variances(resection, wall, _grid(wall, (_SIDE, _SIDE)))
    shown = np.isfinite(variances)
    return variances[shown], pixels[shown]


def _at_corners(resection: Resection, walls: Sequence[KnownWall]) -> NDArray[np.float64]:
    """Variances (4,) where the corners of the image show a wall, of several the largest."""
    camera, worst = resection.camera, np.full(4, np.nan)
    # The middles of the outermost pixels, which the image holds for certain.
    corners_px = np.array(
        [[u, v] for v in (0.5, camera.height - 0.5) for u in (0.5, camera.width - 0.5)]
    )
    rays = camera_rays(camera, corners_px) @ camera.rotation
    for wall in walls:
        top_left, bottom_left, _, top_right = wall.corners_world
        sides = np.array([top_right - top_left, bottom_left - top_left])
        with np.errstate(divide="ignore", invalid="ignore"):
            along = ((top_left - camera.centre_world) @ wall.normal) / (rays @ wall.normal)
            points = camera.centre_world + along[:, None] * rays
        shares = ((points - top_left) @ sides.T) / (sides**2).sum(axis=1)
        hit = np.flatnonzero((along > 0.0) & ((shares >= 0.0) & (shares <= 1.0)).all(axis=1))
        variances, _ = _variances(resection, wall, points[hit])
        worst[hit] = np.fmax(worst[hit], variances)
    return worst


def _grid(wall: KnownWall, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Centres (rows * cols, 3) of the cells of a grid over a wall's rectangle."""
    top_left, bottom_left, _, top_right = wall.corners_world
    down, along = (
        axis.ravel()
        for axis in np.meshgrid(*((np.arange(n) + 0.5) / n for n in shape), indexing="ij")
    )
    points: NDArray[np.float64] = (
        top_left
        + along[:, None] * (top_right - top_left)
        + down[:, None] * (bottom_left - top_left)
    )
    return points


def _variances(
    resection: Resection, wall: KnownWall, points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Variances (n,) per coordinate and pixels (n, 2) of wall points; NaN where not shown."""
    pixels = _seen(resection.camera, points, wall.normal)
    variances = np.full(len(points), np.nan)
    shown = np.isfinite(pixels[:, 0])
    if not shown.any():
        return variances, pixels
    top_left, bottom_left, _, top_right = wall.corners_world
    axes = np.vstack(
        [
            (top_right - top_left) / np.linalg.norm(top_right - top_left),
            (bottom_left - top_left) / np.linalg.norm(bottom_left - top_left),
        ]
    )
    plane_by_pixel = np.linalg.inv(pixels_by_point(resection.camera, points[shown]) @ axes.T)
    covariances = plane_by_pixel @ predicted_covariances(resection, points[shown])
    covariances = covariances @ plane_by_pixel.transpose(0, 2, 1)
    variances[shown] = 0.5 * np.trace(covariances, axis1=1, axis2=2)
    return variances, pixels


def _seen(
    camera: ViewingCamera, points: NDArray[np.float64], normal: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Pixels (n, 2) of wall points; NaN outside the image or under a grazing view."""
    pixels = camera.project(points)[:, :2]
    towards = camera.centre_world - points
    cosine = np.abs(towards @ normal) / np.linalg.norm(towards, axis=1)
    pixels[~camera.sees(pixels) | (cosine < _GRAZING_COSINE)] = np.nan
    return pixels


def _described(index: int, ties: Ties) -> KnownWall:
    wall, number = ties.walls[index], ties.number(index)
    return KnownWall(
        index=index,
        number=number,
        name=wall.name or plane_name("wall", number),
        corners_world=np.array(wall.corners_world, dtype=np.float64),
        normal=np.array(wall.normal_world, dtype=np.float64),
        gsd_m=wall.gsd_m,
        has_side=True,
    )


def _fitted(index: int, points: NDArray[np.float64]) -> KnownWall:
    """The bounding rectangle of points in their own plane, the side unknown."""
    middle = points.mean(axis=0)
    axes = np.linalg.svd(points - middle, full_matrices=False)[2]
    local = (points - middle) @ axes[:2].T
    low, high = local.min(axis=0), local.max(axis=0)
    order = np.array([[low[0], low[1]], [low[0], high[1]], high, [high[0], low[1]]])
    return KnownWall(
        index=index,
        number=index,
        name=plane_name("wall", index),
        corners_world=middle + order @ axes[:2],
        normal=axes[2],
        gsd_m=None,
        has_side=False,
    )
