"""A camera with distortion: from world points to pixels, and from pixels to rays."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError

_ITERATIONS: Final = 30
_CONVERGED: Final = 1e-12


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

    def __post_init__(self) -> None:
        if not np.allclose(self.rotation @ self.rotation.T, np.eye(3), atol=1e-6):
            raise GeometryError("a camera's rotation must be orthonormal")
        if np.linalg.det(self.rotation) < 0.0:
            raise GeometryError("a camera's rotation has determinant -1: it mirrors the world")

    @property
    def centre_world(self) -> NDArray[np.float64]:
        """Projection centre (3,) in metres."""
        centre: NDArray[np.float64] = -self.rotation.T @ self.translation
        return centre

    @cached_property
    def flat(self) -> NDArray[np.float64]:
        """The camera as the compiled kernels take it, see `camera_kernels`."""
        from orthoflow.geometry.camera_kernels import largest_radius  # noqa: PLC0415 - numba

        return np.concatenate(
            [
                self.rotation.ravel(),
                self.translation,
                [self.fx, self.fy, self.cx, self.cy],
                self.distortion,
                [self.width, self.height, largest_radius(self.distortion)],
            ]
        )

    def shifted(self, origin_world: NDArray[np.float64]) -> ViewingCamera:
        """Give the same camera in a world whose origin is at (3,) of this one.

        With survey coordinates of 10^6 m, project offsets through the shifted camera: the sum
        R x + t of large numbers would lose what float32 offsets keep.
        """
        return replace(self, translation=self.rotation @ origin_world + self.translation)

    def project(self, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels and depth (n, 3) = (u, v, depth in metres) of world points (n, 3).

        u and v are NaN for points behind the camera or beyond the lens model; points outside the
        image have pixels outside it.
        """
        from orthoflow.geometry.camera_kernels import project_points  # noqa: PLC0415 - numba

        points = np.ascontiguousarray(points_world, dtype=np.float64)
        pixels = np.empty((len(points), 2))
        depths = np.empty(len(points))
        project_points(self.flat, points, pixels, depths)
        return np.column_stack([pixels, depths])

    def sees(self, pixels_photo: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which pixels (n, 2) lie inside the image; NaN does not."""
        u, v = pixels_photo[:, 0], pixels_photo[:, 1]
        inside: NDArray[np.bool_] = (u >= 0) & (u < self.width) & (v >= 0) & (v < self.height)
        return inside

    def rays_camera(self, pixels_photo: NDArray[np.float64]) -> NDArray[np.float64]:
        """Directions (n, 3) with z = 1 in camera axes of pixels (n, 2).

        Raises:
            GeometryError: the distortion cannot be undone there, e.g. beyond the fold of the lens
                model.
        """
        centre, focal = np.array([self.cx, self.cy]), np.array([self.fx, self.fy])
        wanted = np.asarray((pixels_photo - centre) / focal, dtype=np.float64)
        found = wanted.copy()
        step = np.zeros_like(found)
        for _ in range(_ITERATIONS):
            error, jacobian = self._distortion_error(found, wanted)
            step[:] = np.linalg.solve(jacobian, error[:, :, None])[:, :, 0]
            found = np.asarray(found - step, dtype=np.float64)
            if not step.size or np.abs(step).max() < _CONVERGED:
                break
        if step.size and not np.abs(step).max() < 1e-9:
            raise GeometryError(
                "the lens distortion cannot be undone at the border of the image: the calibration "
                f"{self.distortion.tolist()} folds back inside it"
            )
        return np.column_stack([found, np.ones(len(found))])

    def rays_world(self, pixels_photo: NDArray[np.float64]) -> NDArray[np.float64]:
        """Unit directions (n, 3) in world axes of pixels (n, 2)."""
        rays = self.rays_camera(pixels_photo) @ self.rotation
        unit: NDArray[np.float64] = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        return unit

    def _distortion_error(
        self, found: NDArray[np.float64], wanted: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        k1, k2, p1, p2, k3 = self.distortion
        a, b = found[:, 0], found[:, 1]
        r2 = a * a + b * b
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))  # d radial / d r2, times 2
        error = np.column_stack(
            [
                a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a) - wanted[:, 0],
                b * radial + p1 * (r2 + 2.0 * b * b) + 2.0 * p2 * a * b - wanted[:, 1],
            ]
        )
        jacobian = np.empty((len(found), 2, 2))
        jacobian[:, 0, 0] = radial + a * a * slope + 2.0 * p1 * b + 6.0 * p2 * a
        jacobian[:, 0, 1] = a * b * slope + 2.0 * p1 * a + 2.0 * p2 * b
        jacobian[:, 1, 0] = jacobian[:, 0, 1]
        jacobian[:, 1, 1] = radial + b * b * slope + 6.0 * p1 * b + 2.0 * p2 * a
        return error, jacobian


def looking_at(
    centre_world: NDArray[np.float64],
    target_world: NDArray[np.float64],
    up: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Rotation (3, 3) camera_from_world of a level camera at a point that looks at another.

    Raises:
        GeometryError: the camera would look straight up or down, where level has no meaning.
    """
    forward = target_world - centre_world
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, up)
    length = float(np.linalg.norm(right))
    if not length > 1e-9:
        raise GeometryError("a camera that looks straight up or down has no level orientation")
    right = right / length
    return np.vstack([right, np.cross(forward, right), forward])
