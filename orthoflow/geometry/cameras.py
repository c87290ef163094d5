"""A camera with distortion: world points to pixels, and pixels to rays."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError

_ITERATIONS: Final = 30
_CONVERGED: Final = 1e-12
# Points closer than this to the plane of the projection centre count as behind the camera.
_NEAREST_M: Final = 1e-9
_PROJECTED_AT_ONCE: Final = 1 << 15
_UNTURNED: Final = np.eye(3)


@dataclass(frozen=True, kw_only=True)
class ViewingCamera:
    """A photo's camera: interior and exterior orientation.

    Camera axes: x right, y down, z forward. Pixels (u, v) = (column, row), first centre at
    (0.5, 0.5).

    Attributes:
        width: pixels.
        height: pixels.
        fx: focal length in pixels along u; fy along v.
        cx: principal point in pixels; cy along v.
        distortion: (5,) float64 k1, k2, p1, p2, k3 (Brown 1971, as OpenCV).
        rotation: (3, 3) float64 camera_from_world, det +1.
        translation: (3,) float64 metres, camera_from_world.
        skew: pixels along u per unit of y / z; 0 where rows and columns of pixels are square.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: NDArray[np.float64]
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    skew: float = 0.0

    def __post_init__(self) -> None:
        # Written as a negated comparison, so that NaN fails it.
        if not np.abs(self.rotation @ self.rotation.T - _UNTURNED).max() <= 1e-6:
            raise GeometryError("a camera's rotation must be orthonormal")
        if np.linalg.det(self.rotation) < 0.0:
            raise GeometryError("a camera's rotation has determinant -1: it mirrors the world")

    @property
    def centre_world(self) -> NDArray[np.float64]:
        """Return the projection centre (3,) in metres."""
        return -self.rotation.T @ self.translation

    @cached_property
    def flat(self) -> NDArray[np.float64]:
        """Return the camera as the array that compiled kernels take, see `camera_kernels`."""
        from orthoflow.geometry.camera_kernels import largest_radius  # noqa: PLC0415 - numba

        return np.concatenate(
            [
                self.rotation.ravel(),
                self.translation,
                [self.fx, self.fy, self.cx, self.cy],
                self.distortion,
                [self.width, self.height, largest_radius(self.distortion), self.skew],
            ]
        )

    def shifted(self, origin_world: NDArray[np.float64]) -> ViewingCamera:
        """Return the same camera in a world with its origin at `middle` (3,) of this one.

        With survey coordinates of 10^6 m, project offsets through the shifted camera: the sum R x +
        t of large numbers would lose the precision of float32 offsets.
        """
        return replace(self, translation=self.rotation @ origin_world + self.translation)

    def project(self, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels and depth (n, 3) = (u, v, depth in metres) of world points (n, 3).

        u and v are NaN for points behind the camera or beyond the lens model; points outside the
        image have pixels outside it.
        """
        points = np.asarray(points_world, dtype=np.float64)
        projected = np.empty((len(points), 3))
        for start in range(0, len(points), _PROJECTED_AT_ONCE):
            part = slice(start, start + _PROJECTED_AT_ONCE)
            projected[part] = self._project(points[part].T)
        return projected

    def _project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Project points (3, n); the formula of `camera_kernels.project_point`."""
        k1, k2, p1, p2, k3 = self.distortion
        # Infinite and missing points become NaN without a warning.
        with np.errstate(all="ignore"):
            x, y, z = (
                row[0] * points[0] + row[1] * points[1] + row[2] * points[2] + shift
                for row, shift in zip(self.rotation, self.translation, strict=True)
            )
            a, b = x / z, y / z
            r2 = a * a + b * b
            radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
            bd = b * radial + p1 * (r2 + 2.0 * b * b) + 2.0 * p2 * a * b
            u = self.fx * (a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a)) + self.cx
            u += self.skew * bd
            v = self.fy * bd + self.cy
            hidden = ~(z > _NEAREST_M) | (r2 > self.flat[23] ** 2)
        u[hidden] = np.nan
        v[hidden] = np.nan
        return np.column_stack([u, v, z])

    def sees(self, pixels_photo: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Report which pixels (n, 2) lie inside the image; NaN does not."""
        u, v = pixels_photo[:, 0], pixels_photo[:, 1]
        return (u >= 0) & (u < self.width) & (v >= 0) & (v < self.height)

    def rays_camera(self, pixels_photo: NDArray[np.float64]) -> NDArray[np.float64]:
        """Directions (n, 3) with z = 1 in camera axes of pixels (n, 2).

        Raises:
            GeometryError: the distortion cannot be undone there, e.g. beyond the radius where the
                model folds back.
        """
        found = undistorted(*self.bent_rays(pixels_photo.T), self.distortion)
        if found.size and not np.abs(found[2]).max() < 1e-9:
            raise GeometryError(
                "the lens distortion cannot be undone at the border of the image: the calibration "
                f"{self.distortion.tolist()} folds back inside it"
            )
        return np.column_stack([found[0], found[1], np.ones(found.shape[1])])

    def bent_rays(
        self, pixels_photo: NDArray[np.floating]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the distorted directions x / z and y / z of pixels (2, n) = (u, v)."""
        u, v = np.asarray(pixels_photo, dtype=np.float64)
        b = (v - self.cy) / self.fy
        return (u - self.cx - self.skew * b) / self.fx, b

    def rays_world(self, pixels_photo: NDArray[np.float64]) -> NDArray[np.float64]:
        """Unit directions (n, 3) in world axes of pixels (n, 2)."""
        rays = self.rays_camera(pixels_photo) @ self.rotation
        unit: NDArray[np.float64] = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        return unit


def undistorted(
    wanted_a: NDArray[np.float64], wanted_b: NDArray[np.float64], distortion: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Undo a distortion by Newton steps.

    Args:
        wanted_a: (n,) distorted x / z, NaN where missing.
        wanted_b: (n,) distorted y / z.
        distortion: (5,) k1, k2, p1, p2, k3.

    Returns:
        (3, n) rows: x / z, y / z, and the last step, which stays large where the distortion cannot
        be undone.
    """
    k1, k2, p1, p2, k3 = distortion
    found = np.empty((3, len(wanted_a)))
    a, b, last_step = found
    a[:], b[:], last_step[:] = wanted_a, wanted_b, 0.0
    with np.errstate(all="ignore"):
        for _ in range(_ITERATIONS):
            aa, ab, bb = a * a, a * b, b * b
            r2 = aa + bb
            radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
            slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))  # d radial / d r2, times 2
            error_a = a * radial + 2.0 * p1 * ab + p2 * (r2 + 2.0 * aa) - wanted_a
            error_b = b * radial + p1 * (r2 + 2.0 * bb) + 2.0 * p2 * ab - wanted_b
            slope_a = radial + aa * slope + 2.0 * p1 * b + 6.0 * p2 * a
            slope_b = radial + bb * slope + 6.0 * p1 * b + 2.0 * p2 * a
            mixed = ab * slope + 2.0 * p1 * a + 2.0 * p2 * b
            determinant = slope_a * slope_b - mixed * mixed
            step_a = (slope_b * error_a - mixed * error_b) / determinant
            step_b = (slope_a * error_b - mixed * error_a) / determinant
            a -= step_a
            b -= step_b
            np.maximum(np.abs(step_a), np.abs(step_b), out=last_step)
            if not np.any(last_step >= _CONVERGED):
                break
    return found


def looking_at(
    centre_world: NDArray[np.float64],
    target_world: NDArray[np.float64],
    up: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the rotation (3, 3) camera_from_world of a level camera aimed at a point.

    Raises:
        GeometryError: the camera would look straight up or down, where level is undefined.
    """
    forward = target_world - centre_world
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, up)
    length = float(np.linalg.norm(right))
    if not length > 1e-9:
        raise GeometryError("a camera that looks straight up or down has no level orientation")
    right = right / length
    return np.vstack([right, np.cross(forward, right), forward])
