"""Cameras with distortion: projection, rays through pixels, and lens derivatives.

The centre of the first pixel is at (0.5, 0.5), but at (0, 0) in OpenCV. All conversions between the
two conventions use the functions of this module.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError
from orthoflow.geometry.frames import rotation_from_vector

# orthoflow's pixel coordinates minus OpenCV's.
HALF_PIXEL: Final = 0.5


def to_opencv(pixels: NDArray[Any]) -> NDArray[Any]:
    """Convert orthoflow's pixel coordinates to OpenCV's; the data type is kept."""
    return pixels - HALF_PIXEL


def from_opencv(pixels: NDArray[Any]) -> NDArray[Any]:
    """Convert OpenCV's pixel coordinates to orthoflow's; the data type is kept."""
    return pixels + HALF_PIXEL


_ITERATIONS: Final = 30
_CONVERGED: Final = 1e-12
_RAYS_AT_ONCE: Final = 1 << 14
# Points with a smaller depth are considered to be behind the camera.
_NEAREST_M: Final = 1e-9
_PROJECTED_AT_ONCE: Final = 1 << 15
_UNTURNED: Final = np.eye(3)


@dataclass(frozen=True, kw_only=True)
class ViewingCamera:
    """A photo's camera: interior and exterior orientation.

    The camera axes are x right, y down, z forward. Pixels are (u, v) = (column, row), with the
    centre of the first at (0.5, 0.5).

    Attributes:
        width: image width in pixels.
        height: image height in pixels.
        fx: focal length along u, in pixels.
        fy: focal length along v, in pixels.
        cx: principal point along u, in pixels.
        cy: principal point along v, in pixels.
        distortion: (5,) float64 k1, k2, p1, p2, k3 (Brown 1971, as in OpenCV).
        rotation: (3, 3) float64 camera_from_world, determinant +1.
        translation: (3,) float64 metres, camera_from_world.
        skew: pixels along u per unit of y / z; 0 if pixel rows and columns are perpendicular.
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
        # The comparison is negated, so that NaN is refused.
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
        """Return the camera as an array for compiled kernels (see `camera_kernels`)."""
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
        """Return the same camera in coordinates whose origin is at `origin_world` (3,).

        Use this camera to project offsets from an origin if survey coordinates are about 10^6 m:
        with such coordinates, R x + t is a sum of large numbers that cancel, which loses precision.
        """
        return replace(self, translation=self.rotation @ origin_world + self.translation)

    def at_opencv_pose(
        self, turn: NDArray[Any], shift: NDArray[Any], middle: NDArray[np.float64]
    ) -> ViewingCamera:
        """Return a camera with the same lens and a pose from OpenCV.

        Args:
            turn: rotation vector in radians, (3,) or (3, 1).
            shift: translation in metres, (3,) or (3, 1).
            middle: (3,) metres, subtracted from the points that were passed to OpenCV.
        """
        rotation = rotation_from_vector(np.asarray(turn, dtype=np.float64).ravel())
        local = replace(self, rotation=rotation, translation=np.asarray(shift).ravel())
        return local.shifted(-middle)

    def project(self, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Project world points (n, 3) to (n, 3) = (u, v, depth in metres).

        u and v are NaN for points behind the camera or outside the valid range of the lens model.
        Points may be projected outside the image.
        """
        points = np.asarray(points_world, dtype=np.float64)
        projected = np.empty((len(points), 3))
        for start in range(0, len(points), _PROJECTED_AT_ONCE):
            part = slice(start, start + _PROJECTED_AT_ONCE)
            projected[part] = self._project(points[part].T)
        return projected

    def _project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        k1, k2, p1, p2, k3 = self.distortion
        # Suppress NumPy's warnings: infinite and missing points become NaN.
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
        """Return a mask (n,) of the pixels (n, 2) inside the image; NaN counts as outside."""
        u, v = pixels_photo[:, 0], pixels_photo[:, 1]
        return (u >= 0) & (u < self.width) & (v >= 0) & (v < self.height)

    def rays_camera(self, pixels_photo: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the directions (n, 3) of rays through pixels (n, 2), in camera axes with z = 1.

        Raises:
            GeometryError: the distortion cannot be inverted, for example beyond the radius at which
                the model folds back.
        """
        # Four times as fast as in one piece, which does not fit into the processor's cache.
        pieces = np.array_split(pixels_photo, 1 + len(pixels_photo) // _RAYS_AT_ONCE)
        found = np.hstack(
            [undistorted(*self.bent_rays(piece.T), self.distortion) for piece in pieces]
        )
        if found.size and not np.abs(found[2]).max() < 1e-9:
            raise GeometryError(
                "the lens distortion cannot be inverted at the border of the image: the "
                f"calibration {self.distortion.tolist()} is not monotonic inside it"
            )
        return np.column_stack([found[0], found[1], np.ones(found.shape[1])])

    def bent_rays(
        self, pixels_photo: NDArray[np.floating]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the distorted coordinates (2, n) = (x / z, y / z) of pixels (2, n) = (u, v)."""
        u, v = np.asarray(pixels_photo, dtype=np.float64)
        b = (v - self.cy) / self.fy
        return (u - self.cx - self.skew * b) / self.fx, b

    def rays_world(self, pixels_photo: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the unit directions (n, 3) of rays through pixels (n, 2), in world axes."""
        rays = self.rays_camera(pixels_photo) @ self.rotation
        unit: NDArray[np.float64] = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        return unit


def undistorted(
    wanted_a: NDArray[np.float64], wanted_b: NDArray[np.float64], distortion: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Invert a lens distortion by Newton's method.

    Args:
        wanted_a: (n,) distorted x / z, NaN where missing.
        wanted_b: (n,) distorted y / z.
        distortion: (5,) k1, k2, p1, p2, k3.

    Returns:
        (3, n) with the rows x / z, y / z, and the size of the last step, which remains large where
        the distortion cannot be inverted.
    """
    found = np.empty((3, len(wanted_a)))
    a, b, last_step = found
    a[:], b[:], last_step[:] = wanted_a, wanted_b, 0.0
    with np.errstate(all="ignore"):
        for _ in range(_ITERATIONS):
            bent = _bent(a, b, distortion)
            error_a, error_b = bent.a - wanted_a, bent.b - wanted_b
            determinant = bent.a_by_a * bent.b_by_b - bent.a_by_b**2
            step_a = (bent.b_by_b * error_a - bent.a_by_b * error_b) / determinant
            step_b = (bent.a_by_a * error_b - bent.a_by_b * error_a) / determinant
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
    """Return the rotation (3, 3) camera_from_world of a levelled camera aimed at a point.

    Raises:
        GeometryError: the camera would look straight up or down, so it cannot be levelled.
    """
    forward = target_world - centre_world
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, up)
    length = float(np.linalg.norm(right))
    if not length > 1e-9:
        raise GeometryError(
            "a camera that looks straight up or down has no horizontal viewing direction"
        )
    right = right / length
    return np.vstack([right, np.cross(forward, right), forward])


def opencv_matrix(lens: ViewingCamera) -> NDArray[np.float64]:
    """Return the camera matrix (3, 3) for OpenCV; OpenCV's functions ignore its skew."""
    cx, cy = lens.cx - HALF_PIXEL, lens.cy - HALF_PIXEL
    return np.array([[lens.fx, lens.skew, cx], [0.0, lens.fy, cy], [0.0, 0.0, 1.0]])


POSE_PARAMETERS: Final = 6
# Standard deviation of ln(focal length) with EXIF, which contains the focal length in whole
# millimetres or as a full-frame equivalent, but not the focus distance.
_EXIF_SIGMA: Final = 0.05
# Standard deviation of ln(focal length) without EXIF: the range of common lenses.
_UNKNOWN_SIGMA: Final = 0.35
# Standard deviations of the other parameters of an uncalibrated lens. Fixing these parameters at
# zero distorts the pose: photo errors were then 2.4 times the predicted errors, and 1.7 times the
# errors with free parameters. The sides of pixels are equal to within 1/1000, which still displaces
# pixels at the edge of an image by more than a pixel.
_ASPECT_SIGMA: Final = 1e-3
_CENTRE_SHARE: Final = 0.01
_K1_SIGMA: Final = 0.1
_K2_SIGMA: Final = 0.1
_TANGENTIAL_SIGMA: Final = 1e-3
# Positions of coefficients in the array k1, k2, p1, p2, k3.
_COEFFICIENTS: Final = {"k1": 0, "k2": 1, "p1": 2, "p2": 3}


@dataclass(frozen=True, kw_only=True)
class LensFreedom:
    """Prior standard deviations of the interior orientation; 0 fixes a parameter.

    Attributes:
        focal_sigma: standard deviation of ln(focal length), common to fx and fy.
        aspect_sigma: standard deviation of ln(fy / fx).
        centre_sigma_px: standard deviation of each coordinate of the principal point, pixels.
        k1_sigma: standard deviation of k1.
        k2_sigma: standard deviation of k2.
        tangential_sigma: standard deviation of p1 and p2.
        skew_sigma_px: standard deviation of the skew, pixels.
    """

    focal_sigma: float = 0.0
    aspect_sigma: float = 0.0
    centre_sigma_px: float = 0.0
    k1_sigma: float = 0.0
    k2_sigma: float = 0.0
    tangential_sigma: float = 0.0
    skew_sigma_px: float = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters, in the order used in all vectors and matrices."""
        return tuple(name for name, sigma in self._all() if sigma > 0.0)

    @property
    def sigmas(self) -> NDArray[np.float64]:
        """Prior standard deviations of the free parameters."""
        return np.array([sigma for _, sigma in self._all() if sigma > 0.0])

    def _all(self) -> tuple[tuple[str, float], ...]:
        return (
            ("focal", self.focal_sigma),
            ("aspect", self.aspect_sigma),
            ("cx", self.centre_sigma_px),
            ("cy", self.centre_sigma_px),
            ("k1", self.k1_sigma),
            ("k2", self.k2_sigma),
            ("p1", self.tangential_sigma),
            ("p2", self.tangential_sigma),
            ("skew", self.skew_sigma_px),
        )


def unmeasured(longer_px: int, *, has_exif: bool) -> LensFreedom:
    """Return the prior standard deviations of an uncalibrated lens.

    Args:
        longer_px: longer side of the photos, pixels.
        has_exif: whether the EXIF data contain the focal length.
    """
    return LensFreedom(
        focal_sigma=_EXIF_SIGMA if has_exif else _UNKNOWN_SIGMA,
        aspect_sigma=_ASPECT_SIGMA,
        centre_sigma_px=_CENTRE_SHARE * longer_px,
        k1_sigma=_K1_SIGMA,
        k2_sigma=_K2_SIGMA,
        tangential_sigma=_TANGENTIAL_SIGMA,
    )


@dataclass(frozen=True, kw_only=True)
class Linear:
    """The projection of points through a camera, with derivatives.

    Attributes:
        pixels: (n, 2) pixels; NaN behind the camera.
        by_camera_point: (n, 2, 3) derivatives with respect to the point in camera axes, pixels per
            metre.
        by_parameters: (n, 2, 6 + free) derivatives with respect to the rotation vector (its
            rotation multiplies camera_from_world from the left), the translation, and the free lens
            parameters.
    """

    pixels: NDArray[np.float64]
    by_camera_point: NDArray[np.float64]
    by_parameters: NDArray[np.float64]


def lens_values(camera: ViewingCamera, lens: LensFreedom) -> NDArray[np.float64]:
    """Return the free lens parameters of a camera, with the logarithm of the focal length."""
    values = {
        "focal": math.log(camera.fx),
        "aspect": math.log(camera.fy / camera.fx),
        "cx": camera.cx,
        "cy": camera.cy,
        "skew": camera.skew,
    }
    return np.array(
        [
            values[name] if name in values else camera.distortion[_COEFFICIENTS[name]]
            for name in lens.names
        ],
        dtype=np.float64,
    )


def stepped(camera: ViewingCamera, step: NDArray[np.float64], lens: LensFreedom) -> ViewingCamera:
    """Return the camera after an adjustment step (6 + free,)."""
    moves = dict(zip(lens.names, step[POSE_PARAMETERS:].tolist(), strict=True))
    scale = _factor(moves.get("focal", 0.0))
    distortion = camera.distortion.copy()
    for name, index in _COEFFICIENTS.items():
        distortion[index] += moves.get(name, 0.0)
    turned = rotation_from_vector(step[:3]) @ camera.rotation
    left, _, right = np.linalg.svd(turned)  # keeps rounding errors from accumulating
    return replace(
        camera,
        fx=camera.fx * scale,
        fy=camera.fy * scale * _factor(moves.get("aspect", 0.0)),
        cx=camera.cx + moves.get("cx", 0.0),
        cy=camera.cy + moves.get("cy", 0.0),
        distortion=distortion,
        rotation=left @ right,
        translation=camera.translation + step[3:6],
        skew=camera.skew + moves.get("skew", 0.0),
    )


def linearised(camera: ViewingCamera, points: NDArray[np.float64], lens: LensFreedom) -> Linear:
    """Project points (n, 3) and compute the derivatives."""
    turned = (camera.rotation @ points.T).T
    x, y, z = turned.T + camera.translation[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        # Points behind the camera have no pixel; their NaN makes the cost infinite.
        z = np.where(z > 1e-9, z, np.nan)
        a, b = x / z, y / z
    bent = _bent(a, b, camera.distortion)
    ad, bd = bent.a, bent.b
    # Points are the last axis in memory, so that the operations below are vectorised over points.
    by_point = np.empty((2, 3, len(points))).transpose(2, 0, 1)
    by_point[:, 0, 0] = camera.fx * bent.a_by_a / z
    by_point[:, 0, 1] = camera.fx * bent.a_by_b / z
    by_point[:, 0, 2] = -camera.fx * (bent.a_by_a * a + bent.a_by_b * b) / z
    by_point[:, 1, 0] = camera.fy * bent.a_by_b / z
    by_point[:, 1, 1] = camera.fy * bent.b_by_b / z
    by_point[:, 1, 2] = -camera.fy * (bent.b_by_b * b + bent.a_by_b * a) / z
    # Contribution of y / z to u.
    leaning = camera.skew / camera.fy
    by_point[:, 0] += leaning * by_point[:, 1]
    n_free = POSE_PARAMETERS + len(lens.names)
    by_parameters = np.empty((2, n_free, len(points))).transpose(2, 0, 1)
    # Derivatives with respect to the rotation: -by_point times the cross product matrix, expanded.
    for axis in range(3):
        after, last = (axis + 1) % 3, (axis + 2) % 3
        by_parameters[:, :, axis] = (
            by_point[:, :, last] * turned[:, None, after]
            - by_point[:, :, after] * turned[:, None, last]
        )
    by_parameters[:, :, 3:6] = by_point
    lens_columns = _lens_columns(a, b, bent) if lens.names else {}
    for column, name in enumerate(lens.names, start=POSE_PARAMETERS):
        if name in lens_columns:
            along, down = lens_columns[name]
            by_parameters[:, 0, column] = camera.fx * along
            by_parameters[:, 1, column] = camera.fy * down
            if name in _COEFFICIENTS:
                by_parameters[:, 0, column] += camera.skew * down
        elif name == "skew":
            by_parameters[:, 0, column], by_parameters[:, 1, column] = bd, 0.0
        else:
            by_parameters[:, :, column] = (1.0, 0.0) if name == "cx" else (0.0, 1.0)
    return Linear(
        pixels=np.column_stack(
            [camera.fx * ad + camera.cx + camera.skew * bd, camera.fy * bd + camera.cy]
        ),
        by_camera_point=by_point,
        by_parameters=by_parameters,
    )


@dataclass(frozen=True, kw_only=True)
class _Bent:
    """Rays x / z and y / z after distortion, with derivatives (1 and 0 without distortion)."""

    a: NDArray[np.float64]
    b: NDArray[np.float64]
    a_by_a: NDArray[np.float64] | float
    a_by_b: NDArray[np.float64] | float  # also of b by a
    b_by_b: NDArray[np.float64] | float


def _bent(a: NDArray[np.float64], b: NDArray[np.float64], distortion: NDArray[np.float64]) -> _Bent:
    if not distortion.any():
        return _Bent(a=a, b=b, a_by_a=1.0, a_by_b=0.0, b_by_b=1.0)
    k1, k2, p1, p2, k3 = distortion
    aa, ab, bb = a * a, a * b, b * b
    r2 = aa + bb
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))  # d radial / d r2, times 2
    return _Bent(
        a=a * radial + 2.0 * p1 * ab + p2 * (r2 + 2.0 * aa),
        b=b * radial + p1 * (r2 + 2.0 * bb) + 2.0 * p2 * ab,
        a_by_a=radial + aa * slope + 2.0 * p1 * b + 6.0 * p2 * a,
        a_by_b=ab * slope + 2.0 * p1 * a + 2.0 * p2 * b,
        b_by_b=radial + bb * slope + 6.0 * p1 * b + 2.0 * p2 * a,
    )


def _lens_columns(
    a: NDArray[np.float64], b: NDArray[np.float64], bent: _Bent
) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    r2 = a * a + b * b
    return {
        "focal": (bent.a, bent.b),
        "aspect": (0.0 * a, bent.b),
        "k1": (a * r2, b * r2),
        "k2": (a * r2 * r2, b * r2 * r2),
        "p1": (2.0 * a * b, r2 + 2.0 * b * b),
        "p2": (r2 + 2.0 * a * a, 2.0 * a * b),
    }


def _factor(logarithm: float) -> float:
    """Limit the factor to the range 1 / e to e, to prevent divergence."""
    return math.exp(min(1.0, max(-1.0, logarithm)))
