"""Planes in space: construction, signed distances, angles as in the literature, rectangles."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError
from orthoflow.geometry.directions import basis_from_up


@dataclass(frozen=True, kw_only=True)
class Plane:
    """The points x with `normal . x = offset_m`.

    Attributes:
        normal: (3,) float64 unit vector in world axes, towards the viewer.
        offset_m: distance of the plane from the world origin along the normal, metres, signed.
    """

    normal: NDArray[np.float64]
    offset_m: float

    def __post_init__(self) -> None:
        if self.normal.shape != (3,) or abs(float(np.linalg.norm(self.normal)) - 1.0) > 1e-9:
            raise GeometryError(f"a plane needs a unit normal of shape (3,), got {self.normal!r}")

    def distances_m(self, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return signed distances (n,) of points (n, 3), metres, positive on the viewer's side."""
        return points_world @ self.normal - self.offset_m

    def flipped(self) -> Plane:
        """Return the same plane seen from the other side."""
        return Plane(normal=-self.normal, offset_m=-self.offset_m)

    def towards(self, viewpoint_world: NDArray[np.float64]) -> Plane:
        """Return the same plane with its normal on the side of a viewpoint (3,)."""
        signed_m = float(viewpoint_world @ self.normal) - self.offset_m
        return self if signed_m >= 0.0 else self.flipped()


def plane_through(points_world: NDArray[np.float64]) -> Plane:
    """Return the plane through three points (3, 3); its normal follows the right-hand rule.

    Raises:
        GeometryError: the points coincide or lie on one line.
    """
    first, second, third = points_world
    normal = np.cross(second - first, third - first)
    length = float(np.linalg.norm(normal))
    extent = float(np.linalg.norm(points_world - first, axis=1).max())
    if not math.isfinite(length) or length <= 1e-9 * extent * extent or length == 0.0:
        raise GeometryError(
            f"three points must span a plane, got {points_world.tolist()}, which lie on one line"
        )
    normal = normal / length
    return Plane(normal=normal, offset_m=float(normal @ points_world.mean(axis=0)))


def angle_between_deg(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Return the angle of two unit vectors in degrees, 0..180, accurate if small too."""
    cross = float(np.linalg.norm(np.cross(first, second)))
    return math.degrees(math.atan2(cross, float(first @ second)))


def omega_phi_deg(normal: NDArray[np.float64], up: NDArray[np.float64]) -> tuple[float, float]:
    """Direction (omega 0..360) and inclination (phi -90..90) of a normal, in degrees.

    markiewicz2015 equation 3: n = (cos phi cos omega, cos phi sin omega, sin phi), in the (e1, e2,
    up) frame of `basis_from_up`.
    """
    first, second, height = basis_from_up(up) @ normal
    omega = math.degrees(math.atan2(second, first)) % 360.0
    return omega, math.degrees(math.asin(max(-1.0, min(1.0, height))))
