"""Resection: the pose of one camera from points of its photo that are known in the world.

A weighted least-squares adjustment (Gauss-Markov, damped after Levenberg and Marquardt) with the
full lens model. The observations are the pixels; that the points themselves are uncertain enters
each pixel's covariance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.covariances import honest_covariance
from orthoflow.geometry.lenses import (
    POSE_PARAMETERS,
    LensFreedom,
    Linear,
    lens_values,
    linearised,
    stepped,
)
from orthoflow.geometry.rotations import cross_matrix

_ITERATIONS: Final = 40
_CONVERGED: Final = 1e-12
_DAMPING_START: Final = 1e-6
_DAMPING_MOST: Final = 1e8


@dataclass(frozen=True, kw_only=True)
class SeenPoints:
    """Points seen in one photo and known in the world.

    Attributes:
        pixels_photo: (n, 2) float64 (u, v), first pixel centre at (0.5, 0.5).
        points_world: (n, 3) float64 metres.
        sigma_px: (n,) float64, of each pixel coordinate.
        sigma_m: (n,) float64, of each world coordinate.
    """

    pixels_photo: NDArray[np.float64]
    points_world: NDArray[np.float64]
    sigma_px: NDArray[np.float64]
    sigma_m: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.pixels_photo)

    def take(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> SeenPoints:
        """Give some of the points."""
        return SeenPoints(
            pixels_photo=self.pixels_photo[chosen],
            points_world=self.points_world[chosen],
            sigma_px=self.sigma_px[chosen],
            sigma_m=self.sigma_m[chosen],
        )


@dataclass(frozen=True, kw_only=True)
class Resection:
    """An adjusted camera and how good it is.

    Attributes:
        camera: the camera.
        covariance: (p, p) float64 of rotation vector (left of camera_from_world), translation,
            then what was free of the lens in the order of `LensFreedom.names`; as large as the
            residuals say.
        sigma0: standard deviation of unit weight: 1 where the sigmas of the points were right.
        variance_factor: how much larger `covariance` is than for sigmas taken as they are, mean
            over its axes: sigma0 squared, or more where residuals of neighbouring points agree, so
            that the points are not independent.
        lens: what was free.
    """

    camera: ViewingCamera
    covariance: NDArray[np.float64]
    sigma0: float
    variance_factor: float
    lens: LensFreedom


@dataclass(frozen=True, kw_only=True)
class Misfit:
    """How points fit a camera.

    Attributes:
        residuals_px: (n, 2) float64 observed - computed; NaN where the camera cannot see the point.
        normalised: (n,) float64 length of the residual in units of its expected standard
            deviation (chi with 2 degrees of freedom); inf where the camera cannot see the point.
    """

    residuals_px: NDArray[np.float64]
    normalised: NDArray[np.float64]


def adjust(
    seen: SeenPoints,
    start: ViewingCamera,
    *,
    prior: ViewingCamera | None = None,
    lens: LensFreedom | None = None,
    groups: NDArray[np.intp] | None = None,
    soft_limit: float = math.inf,
) -> Resection:
    """Adjust a camera to the points it sees.

    Args:
        seen: the points, at least as many as the unknowns need.
        start: the camera to start from.
        prior: its interior orientation is what is known beforehand of what is free of the lens;
            that of `start` by default.
        lens: what of the interior orientation is free; nothing by default.
        groups: (n,) group of each point, e.g. a cell of the image, within which residuals may be
            correlated; None takes all as independent.
        soft_limit: residuals beyond so many standard deviations count less (Huber).

    Raises:
        GeometryError: too few points, or they do not determine the pose.
    """
    lens = LensFreedom() if lens is None else lens
    n_free = POSE_PARAMETERS + lens.sigmas.size
    if 2 * len(seen) < n_free + 2:
        raise GeometryError(f"a resection with {n_free} unknowns got only {len(seen)} points")
    # Relative to the middle of the points: survey coordinates would cost digits.
    middle = seen.points_world.mean(axis=0)
    local = replace(seen, points_world=seen.points_world - middle)
    problem = _Problem(local, lens, start if prior is None else prior, soft_limit)
    camera = problem.solve(start.shifted(middle))
    normal, errors = problem.normal_matrix(camera), problem.whitened(camera)
    try:
        cofactors = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise GeometryError("the points of a photo do not determine its pose") from error
    # What the prior says of the lens, the points need not.
    from_prior = float((np.diag(cofactors)[POSE_PARAMETERS:] / lens.sigmas**2).sum())
    redundancy = 2 * len(seen) - n_free + from_prior
    sigma0 = math.sqrt(float((errors.residuals**2).sum()) / redundancy)
    covariance = honest_covariance(
        errors.jacobian, errors.residuals, cofactors, groups, sigma0=sigma0
    )
    factor = float(np.trace(np.linalg.solve(cofactors, covariance))) / n_free
    camera = camera.shifted(-middle)
    to_world = moved_origin(camera, middle, n_free)
    return Resection(
        camera=camera,
        covariance=to_world @ covariance @ to_world.T,
        sigma0=sigma0,
        variance_factor=factor,
        lens=lens,
    )


def misfit(seen: SeenPoints, camera: ViewingCamera) -> Misfit:
    """Tell how points fit a camera, each against its own expected deviation."""
    middle = seen.points_world.mean(axis=0) if len(seen) else np.zeros(3)
    near = camera.shifted(middle)
    pixels = near.project(seen.points_world - middle)[:, :2]
    residuals = seen.pixels_photo - pixels
    linear = linearised(near, seen.points_world - middle, LensFreedom())
    with np.errstate(invalid="ignore"):
        whitened = whiten(_pixel_covariances(linear, seen), residuals[:, :, None])[:, :, 0]
        normalised = np.linalg.norm(whitened, axis=1)
    return Misfit(
        residuals_px=residuals, normalised=np.where(np.isfinite(normalised), normalised, np.inf)
    )


def predicted_covariances(
    resection: Resection, points_world: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Covariances (n, 2, 2) in pixels squared of where the camera sees points (n, 3)."""
    by_parameters = linearised(resection.camera, points_world, resection.lens).by_parameters
    predicted: NDArray[np.float64] = (
        by_parameters @ resection.covariance @ by_parameters.transpose(0, 2, 1)
    )
    return predicted


def pixels_by_point(
    camera: ViewingCamera, points_world: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Derivatives (n, 2, 3) in pixels per metre of the pixels of world points (n, 3)."""
    linear = linearised(camera, points_world, LensFreedom())
    derivatives: NDArray[np.float64] = linear.by_camera_point @ camera.rotation
    return derivatives


def moved_origin(
    camera: ViewingCamera, middle: NDArray[np.float64], n_free: int
) -> NDArray[np.float64]:
    """Derivative (n_free, n_free) of a camera by the parameters of the one shifted by `middle`.

    t = t_local - R middle; a turn w left of R moves R middle by w x (R middle).
    """
    derivative = np.eye(n_free)
    derivative[3:6, :3] = cross_matrix(camera.rotation @ middle)
    return derivative


def whiten(covariances: NDArray[np.float64], columns: NDArray[np.float64]) -> NDArray[np.float64]:
    """Columns (n, 2, c) in units of standard deviation: the inverse Cholesky factor applied."""
    first = np.sqrt(covariances[:, 0, 0])
    mixed = covariances[:, 0, 1] / first
    second = np.sqrt(covariances[:, 1, 1] - mixed**2)
    whitened = np.empty_like(columns)
    whitened[:, 0] = columns[:, 0] / first[:, None]
    whitened[:, 1] = (columns[:, 1] - mixed[:, None] * whitened[:, 0]) / second[:, None]
    return whitened


@dataclass(frozen=True, kw_only=True)
class _Whitened:
    residuals: NDArray[np.float64]  # (n, 2)
    jacobian: NDArray[np.float64]  # (n, 2, p)


class _Problem:
    """The adjustment of one camera, in a world whose origin is near the points."""

    def __init__(
        self, seen: SeenPoints, lens: LensFreedom, prior: ViewingCamera, soft_limit: float
    ) -> None:
        self._seen, self._lens, self._prior = seen, lens, prior
        self._soft_limit = soft_limit
        self._prior_weights = 1.0 / lens.sigmas**2

    def solve(self, camera: ViewingCamera) -> ViewingCamera:
        damping = _DAMPING_START
        cost = self._cost(camera)
        if not math.isfinite(cost):
            raise GeometryError("a resection starts from a camera that cannot see its points")
        for _ in range(_ITERATIONS):
            errors = self.whitened(camera)
            normal = self._normal(errors)
            right = np.einsum("nij,ni->j", errors.jacobian, errors.residuals)
            right[POSE_PARAMETERS:] += self._prior_weights * self._from_prior(camera)
            while damping < _DAMPING_MOST:
                damped = normal + damping * np.diag(np.diag(normal))
                step = np.linalg.lstsq(damped, right, rcond=None)[0]
                moved = stepped(camera, step, self._lens)
                new_cost = self._cost(moved)
                if new_cost <= cost:
                    break
                damping *= 10.0
            else:
                return camera
            gain = cost - new_cost
            camera, cost, damping = moved, new_cost, max(damping * 0.1, 1e-12)
            if gain <= _CONVERGED * max(cost, 1e-30):
                break
        return camera

    def whitened(self, camera: ViewingCamera) -> _Whitened:
        """Residuals and derivatives in units of their standard deviation."""
        seen = self._seen
        linear = linearised(camera, seen.points_world, self._lens)
        residuals = seen.pixels_photo - linear.pixels
        both = np.concatenate([residuals[:, :, None], linear.by_parameters], axis=2)
        both = whiten(_pixel_covariances(linear, seen), both)
        length = np.linalg.norm(both[:, :, 0], axis=1)
        weight = np.minimum(1.0, self._soft_limit / np.maximum(length, 1e-12))
        both *= np.sqrt(weight)[:, None, None]
        return _Whitened(residuals=both[:, :, 0], jacobian=both[:, :, 1:])

    def normal_matrix(self, camera: ViewingCamera) -> NDArray[np.float64]:
        return self._normal(self.whitened(camera))

    def _normal(self, errors: _Whitened) -> NDArray[np.float64]:
        flat = errors.jacobian.reshape(-1, errors.jacobian.shape[2])
        # Not by BLAS: its sums depend on the number of threads.
        normal: NDArray[np.float64] = np.einsum("ij,ik->jk", flat, flat)
        free = np.arange(POSE_PARAMETERS, len(normal))
        normal[free, free] += self._prior_weights
        return normal

    def _cost(self, camera: ViewingCamera) -> float:
        linear = linearised(camera, self._seen.points_world, self._lens)
        residuals = self._seen.pixels_photo - linear.pixels
        covariances = _pixel_covariances(linear, self._seen)
        length = np.linalg.norm(whiten(covariances, residuals[:, :, None])[:, :, 0], axis=1)
        limit = self._soft_limit
        if math.isinf(limit):
            loss = length**2
        else:
            loss = np.where(length <= limit, length**2, limit * (2.0 * length - limit))
        prior = float((self._prior_weights * self._from_prior(camera) ** 2).sum())
        return float(loss.sum()) + prior

    def _from_prior(self, camera: ViewingCamera) -> NDArray[np.float64]:
        """Prior - current value of the free interior parameters."""
        return lens_values(self._prior, self._lens) - lens_values(camera, self._lens)


def _pixel_covariances(linear: Linear, seen: SeenPoints) -> NDArray[np.float64]:
    by_point = linear.by_camera_point
    covariances = (seen.sigma_m**2)[:, None, None] * (by_point @ by_point.transpose(0, 2, 1))
    covariances[:, [0, 1], [0, 1]] += (seen.sigma_px**2)[:, None]
    result: NDArray[np.float64] = covariances
    return result
