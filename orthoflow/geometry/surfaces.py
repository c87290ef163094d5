"""Curved surfaces in the world: cylinders, cones and spheres, seen from inside or outside."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError
from orthoflow.geometry.frames import basis_from_up

# The middle of a dome of which windows or a part are missing is within this angle of the zenith.
_ZENITH_COSINE: Final = math.cos(math.radians(20.0))
_SHORTEST_MEAN: Final = 0.05


@dataclass(frozen=True, kw_only=True)
class Cylinder:
    """A circular cylinder of infinite length.

    Attributes:
        point_world: (3,) float64 metres, a point on the axis.
        axis_world: (3,) float64 unit vector of the axis.
        radius_m: radius in metres.
        is_concave: whether the cylinder is seen from inside, like a vault or an apse; towers and
            columns are seen from outside.
    """

    point_world: NDArray[np.float64]
    axis_world: NDArray[np.float64]
    radius_m: float
    is_concave: bool

    def __post_init__(self) -> None:
        _require_axis("a cylinder", self.point_world, self.axis_world)
        if not 0.0 < self.radius_m < math.inf:
            raise GeometryError(f"a cylinder needs a positive radius, got {self.radius_m}")

    def distances_m(self, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return signed distances (n,) of points (n, 3) in metres, positive towards the viewer."""
        _, across = along_and_across(points_world, self.point_world, self.axis_world)
        outwards = np.linalg.norm(across, axis=1) - self.radius_m
        return np.asarray(-outwards if self.is_concave else outwards)

    def normals(self, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return unit normals (n, 3), towards the viewer, at the places nearest to points."""
        _, across = along_and_across(points_world, self.point_world, self.axis_world)
        outwards = across / np.linalg.norm(across, axis=1, keepdims=True)
        return np.asarray(-outwards if self.is_concave else outwards)


@dataclass(frozen=True, kw_only=True)
class Cone:
    """One nappe of a circular cone, which opens from the apex in the direction of the axis.

    Attributes:
        apex_world: (3,) float64 metres.
        axis_world: (3,) float64 unit vector from the apex into the cone.
        half_angle_rad: angle between the axis and the surface, between 0 and 90 degrees, radians.
        is_concave: whether the cone is seen from inside.
    """

    apex_world: NDArray[np.float64]
    axis_world: NDArray[np.float64]
    half_angle_rad: float
    is_concave: bool

    def __post_init__(self) -> None:
        _require_axis("a cone", self.apex_world, self.axis_world)
        if not 0.0 < self.half_angle_rad < 0.5 * math.pi:
            raise GeometryError(
                "a cone needs a half angle between 0 and 90 degrees, got "
                f"{math.degrees(self.half_angle_rad):g}"
            )

    def distances_m(self, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return signed distances (n,) of points (n, 3) in metres, positive towards the viewer.

        Distances are measured perpendicular to the nearest generatrix, extended beyond the apex.
        """
        along, across = along_and_across(points_world, self.apex_world, self.axis_world)
        radius = np.linalg.norm(across, axis=1)
        outwards = radius * math.cos(self.half_angle_rad) - along * math.sin(self.half_angle_rad)
        return np.asarray(-outwards if self.is_concave else outwards)

    def normals(self, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return unit normals (n, 3), towards the viewer, at the places nearest to points."""
        _, across = along_and_across(points_world, self.apex_world, self.axis_world)
        radial = across / np.linalg.norm(across, axis=1, keepdims=True)
        outwards = radial * math.cos(self.half_angle_rad)
        outwards -= math.sin(self.half_angle_rad) * self.axis_world
        return np.asarray(-outwards if self.is_concave else outwards)


@dataclass(frozen=True, kw_only=True)
class Sphere:
    """A sphere.

    Attributes:
        centre_world: (3,) float64 metres.
        radius_m: radius in metres.
        is_concave: whether the sphere is seen from inside, like a dome from below.
    """

    centre_world: NDArray[np.float64]
    radius_m: float
    is_concave: bool

    def __post_init__(self) -> None:
        if self.centre_world.shape != (3,) or not np.isfinite(self.centre_world).all():
            raise GeometryError(f"a sphere needs a finite centre (3,), got {self.centre_world!r}")
        if not 0.0 < self.radius_m < math.inf:
            raise GeometryError(f"a sphere needs a positive radius, got {self.radius_m}")

    def distances_m(self, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return signed distances (n,) of points (n, 3) in metres, positive towards the viewer."""
        outwards = np.linalg.norm(points_world - self.centre_world, axis=1) - self.radius_m
        return np.asarray(-outwards if self.is_concave else outwards)

    def normals(self, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return unit normals (n, 3), towards the viewer, at the places nearest to points."""
        outwards = points_world - self.centre_world
        outwards = outwards / np.linalg.norm(outwards, axis=1, keepdims=True)
        return np.asarray(-outwards if self.is_concave else outwards)


CurvedShape: TypeAlias = Cylinder | Cone | Sphere


def transformed(
    shape: CurvedShape, rotation: NDArray[np.float64], shift_m: NDArray[np.float64]
) -> CurvedShape:
    """Return a surface after a rotation (3, 3) about the origin and then a translation (3,)."""
    if isinstance(shape, Sphere):
        return replace(shape, centre_world=rotation @ shape.centre_world + shift_m)
    axis = rotation @ shape.axis_world
    if isinstance(shape, Cylinder):
        return replace(shape, point_world=rotation @ shape.point_world + shift_m, axis_world=axis)
    return replace(shape, apex_world=rotation @ shape.apex_world + shift_m, axis_world=axis)


def along_and_across(
    points_world: NDArray[np.float64],
    point_world: NDArray[np.float64],
    axis_world: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the positions (n,) of points along an axis, and vectors (n, 3) from the axis to them.

    Args:
        points_world: (n, 3) points.
        point_world: (3,) point on the axis from which positions are measured.
        axis_world: (3,) unit vector.
    """
    relative = points_world - point_world
    along = relative @ axis_world
    return along, relative - along[:, None] * axis_world


def zero_direction(axis_world: NDArray[np.float64], up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the direction (3,) of angle 0 around an axis, a unit vector perpendicular to it.

    If the axis is at most 45 degrees from the vertical, the result is the component of the
    horizontal direction e1 (see `basis_from_up`) perpendicular to the axis. Otherwise, it is that
    of `up`, so that angle 0 is at the crown of a vault.

    Args:
        axis_world: (3,) unit vector of the axis.
        up: (3,) unit vector.
    """
    is_steep = abs(float(axis_world @ up)) >= math.sqrt(0.5)
    start = basis_from_up(up)[0] if is_steep else up
    perpendicular = start - (start @ axis_world) * axis_world
    return np.asarray(perpendicular / np.linalg.norm(perpendicular))


def middle_direction(
    directions: NDArray[np.float64], up: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the mean (3,) of unit vectors (n, 3), or `up` if it is within 20 degrees of it.

    The mean of a whole sphere has no direction, and is also replaced by `up`.
    """
    mean = directions.mean(axis=0)
    length = float(np.linalg.norm(mean))
    if float(mean @ up) >= _ZENITH_COSINE * length or length < _SHORTEST_MEAN:
        return up
    return np.asarray(mean / length)


def angles_around(
    points_world: NDArray[np.float64],
    point_world: NDArray[np.float64],
    axis_world: NDArray[np.float64],
    zero_world: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the angles (n,), -pi to pi, of points (n, 3) around an axis, by the right-hand rule.

    Args:
        points_world: (n, 3) points.
        point_world: (3,) point on the axis.
        axis_world: (3,) unit vector of the axis.
        zero_world: (3,) unit vector perpendicular to the axis, the direction of angle 0.
    """
    relative = points_world - point_world
    return np.arctan2(relative @ np.cross(axis_world, zero_world), relative @ zero_world)


def _require_axis(
    what: str, point_world: NDArray[np.float64], axis_world: NDArray[np.float64]
) -> None:
    if point_world.shape != (3,) or not np.isfinite(point_world).all():
        raise GeometryError(f"{what} needs a finite point of shape (3,), got {point_world!r}")
    if axis_world.shape != (3,) or abs(float(np.linalg.norm(axis_world)) - 1.0) > 1e-9:
        raise GeometryError(f"{what} needs a unit axis of shape (3,), got {axis_world!r}")
