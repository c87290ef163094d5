"""The camera parameters that an adjustment may change, and the derivatives of pixels by them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.rotations import rotation_from_vector

POSE_PARAMETERS: Final = 6
# EXIF states the focal length in whole millimetres, or as the full-frame equivalent, and not the
# focusing distance; without it the range of usual lenses remains.
_EXIF_SIGMA: Final = 0.05
_UNKNOWN_SIGMA: Final = 0.35
# Further properties of an uncalibrated lens. Fixed at zero they distort the pose: photos had 2.4
# times the error that they stated, and 1.7 times the error that was necessary. Pixels are square to
# a thousandth, which at the edge of a picture is more than a pixel.
_ASPECT_SIGMA: Final = 1e-3
_CENTRE_SHARE: Final = 0.01
_K1_SIGMA: Final = 0.1
_K2_SIGMA: Final = 0.1
_TANGENTIAL_SIGMA: Final = 1e-3
# Which of the five distortion coefficients k1, k2, p1, p2, k3 a name refers to.
_COEFFICIENTS: Final = {"k1": 0, "k2": 1, "p1": 2, "p2": 3}


@dataclass(frozen=True, kw_only=True)
class LensFreedom:
    """Prior standard deviations of the interior orientation; 0 fixes a parameter.

    Attributes:
        focal_sigma: prior standard deviation of ln(focal length), common to fx and fy.
        aspect_sigma: of ln(fy / fx).
        centre_sigma_px: of each coordinate of the principal point, pixels.
        k1_sigma: of k1.
        k2_sigma: of k2.
        tangential_sigma: of p1 and of p2.
        skew_sigma_px: of the skew, pixels.
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
        """Names of the free parameters, in the order of every vector and matrix."""
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
    """Return how far an uncalibrated lens may deviate from an ideal one.

    Args:
        longer_px: longer side of its photos.
        has_exif: whether their EXIF states the focal length.
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
    """The projection of points by a camera.

    Attributes:
        pixels: (n, 2); NaN behind the camera.
        by_camera_point: (n, 2, 3) derivatives by the point in camera axes, pixels per metre.
        by_parameters: (n, 2, 6 + free) by rotation vector (left of camera_from_world), translation,
            then the free parameters of the lens.
    """

    pixels: NDArray[np.float64]
    by_camera_point: NDArray[np.float64]
    by_parameters: NDArray[np.float64]


def lens_values(camera: ViewingCamera, lens: LensFreedom) -> NDArray[np.float64]:
    """Return the free lens parameters of a camera, the focal length as its logarithm."""
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
    """Return a camera after a step (6 + free,) of an adjustment."""
    moves = dict(zip(lens.names, step[POSE_PARAMETERS:].tolist(), strict=True))
    scale = _factor(moves.get("focal", 0.0))
    distortion = camera.distortion.copy()
    for name, index in _COEFFICIENTS.items():
        distortion[index] += moves.get(name, 0.0)
    turned = rotation_from_vector(step[:3]) @ camera.rotation
    left, _, right = np.linalg.svd(turned)  # keeps rounding from adding up
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
    """Project points (n, 3), with derivatives."""
    turned = (camera.rotation @ points.T).T
    x, y, z = turned.T + camera.translation[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        # Behind the camera there is no pixel: NaN makes the cost infinite.
        z = np.where(z > 1e-9, z, np.nan)
        a, b = x / z, y / z
    bent = _bent(a, b, camera.distortion)
    ad, bd = bent.a, bent.b
    # Points are the last axis in memory, so every operation below runs over all of them.
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
    # Derivative by a rotation: -by_point times the matrix of the cross product, written out.
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
    """Rays x / z and y / z after distortion, with derivatives; 1 and 0 without distortion."""

    a: NDArray[np.float64]
    b: NDArray[np.float64]
    a_by_a: NDArray[np.float64] | float
    a_by_b: NDArray[np.float64] | float  # and of b by a
    b_by_b: NDArray[np.float64] | float


def _bent(a: NDArray[np.float64], b: NDArray[np.float64], distortion: NDArray[np.float64]) -> _Bent:
    if not distortion.any():
        return _Bent(a=a, b=b, a_by_a=1.0, a_by_b=0.0, b_by_b=1.0)
    k1, k2, p1, p2, k3 = distortion
    r2 = a * a + b * b
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
    return _Bent(
        a=a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a),
        b=b * radial + p1 * (r2 + 2.0 * b * b) + 2.0 * p2 * a * b,
        a_by_a=radial + a * a * slope + 2.0 * p1 * b + 6.0 * p2 * a,
        a_by_b=a * b * slope + 2.0 * p1 * a + 2.0 * p2 * b,
        b_by_b=radial + b * b * slope + 6.0 * p1 * b + 2.0 * p2 * a,
    )


def _lens_columns(
    a: NDArray[np.float64], b: NDArray[np.float64], bent: _Bent
) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return derivatives of the distorted ray by all lens parameters except the centre."""
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
    """Return the change limited to a factor of e, so that an excessive step cannot diverge."""
    return math.exp(min(1.0, max(-1.0, logarithm)))
