"""Tiny analytic scenes for the tests: clouds whose planes, labels and colours are known exactly.

Use as `from tests import scenes`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane, WallFrame, angle_between_deg, frame_over, wall_axes
from orthoflow.products import PointCloud

UP_Z = np.array([0.0, 0.0, 1.0])
SURVEY_SHIFT_M = np.array([634512.347, 486215.781, 112.193])


@dataclass(frozen=True, kw_only=True)
class KnownCloud:
    """A cloud and the truth about it.

    Attributes:
        cloud: the points; `cloud.stations` holds the one viewpoint.
        planes: true planes, largest number of points first, normals towards the viewpoint.
        corners: (k, 4, 3) metres, corners of each plane's rectangle: top-left first,
            counter-clockwise for the viewer.
        labels: (n,) int16 index into `planes`, -1 for outliers.
    """

    cloud: PointCloud
    planes: tuple[Plane, ...]
    corners: NDArray[np.float64]
    labels: NDArray[np.int16]

    def frame(self, plane: int = 0, *, gsd_m: float) -> WallFrame:
        """The raster grid over one plane's rectangle."""
        return frame_over(self.corners[plane], self.planes[plane].normal, gsd_m=gsd_m)


def random_rotation(rng: np.random.Generator) -> NDArray[np.float64]:
    """A rotation matrix (3, 3), uniform over all rotations (QR of a Gaussian matrix)."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    rotation: NDArray[np.float64] = q if np.linalg.det(q) > 0 else -q
    return rotation


def rotation_about(axis: NDArray[np.float64], angle_deg: float) -> NDArray[np.float64]:
    """Rotation matrix (3, 3) about a unit vector (3,), right-handed (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = math.radians(angle_deg)
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross


def cloud_of(
    points_world: NDArray[np.float64],
    *,
    origin: NDArray[np.float64] | None = None,
    up: NDArray[np.float64] = UP_Z,
    viewpoint: NDArray[np.float64] | None = None,
    intensity: NDArray[np.float32] | None = None,
    rgb: NDArray[np.uint8] | None = None,
) -> PointCloud:
    """A cloud of given world points (n, 3); the origin is (0, 0, 0) unless given."""
    origin = np.zeros(3) if origin is None else origin
    offsets = (points_world - origin).astype(np.float32)
    return PointCloud(
        origin=origin.astype(np.float64),
        x=np.ascontiguousarray(offsets[:, 0]),
        y=np.ascontiguousarray(offsets[:, 1]),
        z=np.ascontiguousarray(offsets[:, 2]),
        up=np.asarray(up, dtype=np.float64),
        intensity=intensity,
        rgb=rgb,
        stations=None if viewpoint is None else viewpoint[None, :].astype(np.float64),
        stations_source=None if viewpoint is None else "file",
    )


def wall_cloud(
    seed: int,
    *,
    n_points: int = 20_000,
    noise_m: float = 0.002,
    outlier_share: float = 0.02,
    normal: tuple[float, float, float] = (0.0, -1.0, 0.0),
    offset_m: float = -3.0,
    size_m: tuple[float, float] = (4.0, 2.5),
) -> KnownCloud:
    """One wall: points evenly over a rectangle, noise along the normal, outliers around it.

    The rectangle is centred at `offset_m * normal`; the viewer stands 3 m in front. The outliers
    fill a box of 1 m before and behind the wall evenly.
    """
    rng = np.random.default_rng(seed)
    n = np.array(normal) / np.linalg.norm(normal)
    axes = wall_axes(n, UP_Z)
    centre = offset_m * n
    in_plane = (rng.random((n_points, 2)) - 0.5) * size_m
    n_outliers = round(outlier_share * n_points)
    depths = noise_m * rng.normal(size=n_points)
    depths[:n_outliers] = rng.uniform(-1.0, 1.0, n_outliers)
    labels = np.zeros(n_points, dtype=np.int16)
    labels[:n_outliers] = -1
    order = rng.permutation(n_points)
    points = (centre + in_plane @ axes + depths[:, None] * n)[order]
    cloud = cloud_of(
        points,
        viewpoint=centre + 3.0 * n,
        intensity=rng.random(n_points, dtype=np.float32),
        rgb=rng.integers(0, 256, (n_points, 3), dtype=np.uint8),
    )
    return KnownCloud(
        cloud=cloud,
        planes=(Plane(normal=n, offset_m=offset_m),),
        corners=_rectangle(centre, axes, size_m)[None],
        labels=labels[order],
    )


def box_room_cloud(
    seed: int,
    *,
    n_points: int = 40_000,
    size_m: tuple[float, float, float] = (6.0, 4.0, 3.0),
    noise_m: float = 0.002,
    outlier_share: float = 0.02,
    turn_deg: float = 12.0,
) -> KnownCloud:
    """A box room seen from its middle: four walls, floor and ceiling, evenly covered with points.

    Points go to the six sides by their areas, so `planes` begins with the largest side. The room
    is turned about the vertical; the viewpoint (and world origin) is the room's centre.
    """
    rng = np.random.default_rng(seed)
    turn = rotation_about(UP_Z, turn_deg)
    half = 0.5 * np.array(size_m)
    inward = [-s * turn[:, axis] for axis in range(3) for s in (1.0, -1.0)]
    offsets = [-half[axis] for axis in range(3) for _ in range(2)]
    n_inliers = n_points - round(outlier_share * n_points)
    sides = []
    for normal, offset in zip(inward, offsets, strict=True):
        axes = wall_axes(normal, UP_Z)
        if abs(normal[2]) > 0.5:
            # Edges of the room, not e1 and e2, bound floor and ceiling.
            axes = np.vstack([turn[:, 0], np.cross(turn[:, 0], normal)])
        extents = (2.0 * half @ np.abs(turn.T @ axes[0]), 2.0 * half @ np.abs(turn.T @ axes[1]))
        sides.append((Plane(normal=normal, offset_m=float(offset)), axes, extents))
    # Stable: equal sides keep their order, whatever the rounding of their areas.
    sides.sort(key=lambda side: -round(side[2][0] * side[2][1], 6))
    areas = np.array([extents[0] * extents[1] for _, _, extents in sides])
    labels = np.repeat(np.arange(6, dtype=np.int16), np.diff(_shares(n_inliers, areas), prepend=0))
    points = np.empty((n_points, 3))
    for index, (plane, axes, extents) in enumerate(sides):
        chosen = np.flatnonzero(labels == index)
        in_plane = (rng.random((chosen.size, 2)) - 0.5) * extents
        lifted = (plane.offset_m + noise_m * rng.normal(size=chosen.size))[:, None] * plane.normal
        points[chosen] = lifted + in_plane @ axes
    points[n_inliers:] = ((rng.random((n_points - n_inliers, 3)) - 0.5) * size_m) @ turn.T
    labels = np.concatenate([labels, np.full(n_points - n_inliers, -1, dtype=np.int16)])
    order = rng.permutation(n_points)
    return KnownCloud(
        cloud=cloud_of(points[order], viewpoint=np.zeros(3)),
        planes=tuple(plane for plane, _, _ in sides),
        corners=np.stack(
            [
                _rectangle(plane.offset_m * plane.normal, axes, extents)
                for plane, axes, extents in sides
            ]
        ),
        labels=labels[order],
    )


def coloured_grid_cloud(
    *,
    gsd_m: float = 0.01,
    width: int = 40,
    height: int = 30,
    normal: tuple[float, float, float] = (0.0, -1.0, 0.0),
    offset_m: float = -3.0,
    depth_m: float = 0.0,
) -> KnownCloud:
    """One point at each cell centre of a raster, row by row, its colour telling the cell.

    The colour of cell (row, column) is `grid_colours(width, height)[row, column]`; the cloud's
    one plane has a rectangle of exactly width x height cells.
    """
    n = np.array(normal) / np.linalg.norm(normal)
    axes = wall_axes(n, UP_Z)
    centre = offset_m * n
    corners = _rectangle(centre, axes, (width * gsd_m, height * gsd_m))
    frame = frame_over(corners, n, gsd_m=gsd_m)
    rows, columns = np.mgrid[0:height, 0:width]
    pixels = np.column_stack([columns.ravel() + 0.5, rows.ravel() + 0.5])
    rgb = grid_colours(width, height).reshape(-1, 3)
    cloud = cloud_of(
        frame.world_from_wall(pixels, depth_m),
        viewpoint=centre + 3.0 * n,
        intensity=(rgb.mean(axis=1) / 255.0).astype(np.float32),
        rgb=rgb,
    )
    return KnownCloud(
        cloud=cloud,
        planes=(Plane(normal=n, offset_m=offset_m),),
        corners=corners[None],
        labels=np.zeros(len(cloud), dtype=np.int16),
    )


def grid_colours(width: int, height: int) -> NDArray[np.uint8]:
    """Colours (height, width, 3): red grows along u, green along v, blue is a checker."""
    rows, columns = np.mgrid[0:height, 0:width]
    red = 255 * columns // max(1, width - 1)
    green = 255 * rows // max(1, height - 1)
    blue = np.where((rows + columns) % 2 == 0, 200, 40)
    return np.stack([red, green, blue], axis=-1).astype(np.uint8)


def moved(
    known: KnownCloud, rotation: NDArray[np.float64], shift_m: NDArray[np.float64]
) -> KnownCloud:
    """The scene after x -> rotation @ x + shift; a pure shift leaves the offsets as they are."""
    cloud = known.cloud
    stations = None if cloud.stations is None else cloud.stations @ rotation.T + shift_m
    if np.array_equal(rotation, np.eye(3)):
        new = replace(cloud, origin=cloud.origin + shift_m, stations=stations)
    else:
        offsets = np.column_stack([cloud.x, cloud.y, cloud.z]).astype(np.float64) @ rotation.T
        x, y, z = (np.ascontiguousarray(column, dtype=np.float32) for column in offsets.T)
        new = replace(
            cloud,
            origin=rotation @ cloud.origin + shift_m,
            x=x,
            y=y,
            z=z,
            up=rotation @ cloud.up,
            stations=stations,
        )
    return KnownCloud(
        cloud=new,
        planes=tuple(moved_plane(plane, rotation, shift_m) for plane in known.planes),
        corners=known.corners @ rotation.T + shift_m,
        labels=known.labels,
    )


def moved_plane(plane: Plane, rotation: NDArray[np.float64], shift_m: NDArray[np.float64]) -> Plane:
    """The plane after x -> rotation @ x + shift."""
    normal = rotation @ plane.normal
    normal = normal / np.linalg.norm(normal)
    return Plane(normal=normal, offset_m=plane.offset_m + float(normal @ shift_m))


@dataclass(frozen=True, kw_only=True)
class PlaneError:
    """How far a plane lies from the truth.

    Attributes:
        angle_deg: angle between the normals; 180 when the side is wrong.
        offset_m: signed distance of the plane from the centre of the true rectangle.
    """

    angle_deg: float
    offset_m: float


def plane_error(known: KnownCloud, found: Plane, plane: int = 0) -> PlaneError:
    """Compare a found plane with a true one at the centre of the true rectangle."""
    centre = known.corners[plane].mean(axis=0)
    return PlaneError(
        angle_deg=angle_between_deg(found.normal, known.planes[plane].normal),
        offset_m=found.offset_m - float(found.normal @ centre),
    )


def _rectangle(
    centre: NDArray[np.float64], axes: NDArray[np.float64], size_m: tuple[float, float]
) -> NDArray[np.float64]:
    u, v = 0.5 * size_m[0] * axes[0], 0.5 * size_m[1] * axes[1]
    return np.stack([centre - u - v, centre - u + v, centre + u + v, centre + u - v])


def _shares(total: int, weights: NDArray[np.float64]) -> NDArray[np.int64]:
    """Cumulative counts that divide a total by weights, the last one exactly the total."""
    counts: NDArray[np.int64] = np.round(np.cumsum(weights) / weights.sum() * total).astype(
        np.int64
    )
    return counts
