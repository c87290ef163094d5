"""Tiny analytic scenes for the tests: clouds whose planes, labels and colours are known exactly.

Use as `from tests import scenes`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane, WallFrame, frame_over
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
