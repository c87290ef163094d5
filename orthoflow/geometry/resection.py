"""Resection: the pose of a camera from points in its photo with known world coordinates.

The method is a weighted least-squares adjustment (Gauss-Markov model with Levenberg-Marquardt
damping) with the full lens model. The observations are pixel coordinates, whose covariances include
the uncertainty of the points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError
from orthoflow.geometry.cameras import (
    POSE_PARAMETERS,
    LensFreedom,
    Linear,
    ViewingCamera,
    lens_values,
    linearised,
    stepped,
)
from orthoflow.geometry.covariances import (
    AdjustedPoints,
    honest_covariance,
    outwards,
)
from orthoflow.geometry.frames import cross_matrix
from orthoflow.geometry.rows import Rows

_ITERATIONS: Final = 40
# Relative change of the sum of squares at convergence. With a few hundred points, such a step
# changes no parameter by more than 1 % of its standard deviation, and the next step is far smaller.
_CONVERGED: Final = 1e-7
_DAMPING_START: Final = 1e-6
_DAMPING_MOST: Final = 1e8
# Points whose uncertainty in pixels exceeds this share of the image's longer side are not used,
# since they would agree with any pixel.
_BLUR_MOST_SHARE: Final = 0.02


@dataclass(frozen=True, kw_only=True)
class SeenPoints(Rows):
    """Points seen in one photo with known world coordinates.

    Attributes:
        pixels_photo: (n, 2) float64 (u, v), first pixel centre at (0.5, 0.5).
        points_world: (n, 3) float64 metres.
        sigma_px: (n,) float64, standard deviation of each pixel coordinate.
        sigma_m: (n,) float64, standard deviation of each world coordinate.
        scan_errors: (n, 3, q) metres, errors of the positions due to the registration of the scans:
            the most probable one, followed by one for each direction in which it is uncertain, with
            the size of its standard deviation. None if unknown.
    """

    pixels_photo: NDArray[np.float64]
    points_world: NDArray[np.float64]
    sigma_px: NDArray[np.float64]
    sigma_m: NDArray[np.float64]
    scan_errors: NDArray[np.float64] | None = None

    def scaled(self, factor: float) -> SeenPoints:
        """Return the points with multiplied standard deviations."""
        return replace(self, sigma_px=factor * self.sigma_px, sigma_m=factor * self.sigma_m)


@dataclass(frozen=True, kw_only=True)
class Resection:
    """An adjusted camera and its covariance.

    Attributes:
        camera: the camera.
        covariance: (p, p) float64 covariance of the rotation vector in radians (its rotation
            multiplies camera_from_world from the left), the translation in metres, and the free
            lens parameters in the order of `LensFreedom.names`; scaled by the residuals.
        sigma0: standard deviation of unit weight; 1 if the sigmas of the points are correct.
        variance_factor: mean ratio of `covariance` to the covariance that the given sigmas predict.
            It is the square of `sigma0`, or larger if neighbouring points have similar residuals
            and are therefore not independent.
        lens: the free lens parameters.
    """

    camera: ViewingCamera
    covariance: NDArray[np.float64]
    sigma0: float
    variance_factor: float
    lens: LensFreedom


@dataclass(frozen=True, kw_only=True)
class Misfit:
    """The fit of points to a camera.

    Attributes:
        residuals_px: (n, 2) float64 observed minus computed pixel coordinates; NaN if the camera
            cannot see the point.
        normalised: (n,) float64 length of the residual in units of its expected standard deviation
            (chi distribution with 2 degrees of freedom). It is inf if the camera cannot see the
            point, or if the point is so close that its uncertainty would allow any pixel.
    """

    residuals_px: NDArray[np.float64]
    normalised: NDArray[np.float64]


def adjust(
    seen: SeenPoints,
    start: ViewingCamera,
    *,
    prior: ViewingCamera | None = None,
    lens: LensFreedom | None = None,
    independent: bool = True,
    soft_limit: float = math.inf,
) -> Resection:
    """Adjust a camera to the points it sees.

    Args:
        seen: the points; their number must suffice for the pose.
        start: initial camera.
        prior: camera whose interior orientation is the prior of the free lens parameters; `start`
            by default.
        lens: standard deviations of the free parameters of the interior orientation; all fixed by
            default.
        independent: whether the errors of the points are independent. If false, neighbouring points
            may have common errors (see `geometry.covariances`).
        soft_limit: residuals larger than this number of standard deviations get less weight
            (Huber).

    Raises:
        GeometryError: there are too few points, or they do not determine the pose.
    """
    camera = fitted(seen, start, prior=prior, lens=lens, soft_limit=soft_limit)
    prior = start if prior is None else prior
    return stated(
        seen, camera, prior=prior, lens=lens, independent=independent, soft_limit=soft_limit
    )


def stated(
    seen: SeenPoints,
    camera: ViewingCamera,
    *,
    prior: ViewingCamera | None = None,
    lens: LensFreedom | None = None,
    independent: bool = True,
    soft_limit: float = math.inf,
) -> Resection:
    """Compute the covariance of a camera that `fitted` returned; for the arguments, see `adjust`.

    Raises:
        GeometryError: there are too few points, or they do not determine the pose.
    """
    middle, problem = _problem(seen, camera if prior is None else prior, lens, soft_limit)
    lens, n_free = problem.lens, problem.n_free
    errors = problem.errors(camera.shifted(middle))
    normal = problem.normal(errors)
    try:
        cofactors = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise GeometryError("the points of a photo do not determine its pose") from error
    # The prior determines this number of unknowns, so the points determine only the others.
    from_prior = float((np.diag(cofactors)[POSE_PARAMETERS:] / lens.sigmas**2).sum())
    redundancy = 2 * len(seen) - n_free + from_prior
    sigma0 = math.sqrt(float((errors.residuals**2).sum()) / redundancy)
    covariance = sigma0**2 * cofactors
    if not independent:
        local = camera.shifted(middle)
        covariance = honest_covariance(problem.adjusted_points(local, errors, cofactors), sigma0)
    factor = float(np.trace(np.linalg.solve(cofactors, covariance))) / n_free
    to_world = moved_origin(camera, middle, n_free)
    return Resection(
        camera=camera,
        covariance=to_world @ covariance @ to_world.T,
        sigma0=sigma0,
        variance_factor=factor,
        lens=lens,
    )


def fitted(
    seen: SeenPoints,
    start: ViewingCamera,
    *,
    prior: ViewingCamera | None = None,
    lens: LensFreedom | None = None,
    soft_limit: float = math.inf,
) -> ViewingCamera:
    """Return the camera that `adjust` finds, without its covariance.

    Raises:
        GeometryError: there are too few points, or they do not determine the pose.
    """
    middle, problem = _problem(seen, start if prior is None else prior, lens, soft_limit)
    return problem.solve(start.shifted(middle)).shifted(-middle)


def misfit(seen: SeenPoints, camera: ViewingCamera) -> Misfit:
    """Compute the residuals of points, also in units of their expected standard deviations."""
    middle = seen.points_world.mean(axis=0) if len(seen) else np.zeros(3)
    near = camera.shifted(middle)
    linear = linearised(near, seen.points_world - middle, LensFreedom())
    # Beyond the radius at which it folds back, a lens model gives no pixels.
    folds = camera.distortion.any()
    pixels = near.project(seen.points_world - middle)[:, :2] if folds else linear.pixels
    residuals = seen.pixels_photo - pixels
    with np.errstate(invalid="ignore"):
        whitened = whiten(_pixel_covariances(linear, seen), residuals[:, :, None])[:, :, 0]
        normalised = np.linalg.norm(whitened, axis=1)
        blur_px = seen.sigma_m * np.linalg.norm(linear.by_camera_point, axis=2).max(axis=1)
        tells = blur_px <= _BLUR_MOST_SHARE * max(camera.width, camera.height)
    known = tells & np.isfinite(normalised)
    return Misfit(residuals_px=residuals, normalised=np.where(known, normalised, np.inf))


def predicted_covariances(
    resection: Resection, points_world: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the covariances (n, 2, 2), in pixels squared, of the projections of points (n, 3)."""
    by_parameters = linearised(resection.camera, points_world, resection.lens).by_parameters
    return by_parameters @ resection.covariance @ by_parameters.transpose(0, 2, 1)


def pixels_by_point(
    camera: ViewingCamera, points_world: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the derivatives (n, 2, 3), pixels per metre, of the pixels of points (n, 3)."""
    linear = linearised(camera, points_world, LensFreedom())
    return linear.by_camera_point @ camera.rotation


def moved_origin(
    camera: ViewingCamera, middle: NDArray[np.float64], n_free: int
) -> NDArray[np.float64]:
    """Return the derivatives of a camera's parameters with respect to those of a shifted camera.

    The coordinates of the shifted camera have their origin at `middle`, so t = t_local - R middle.
    If a small rotation w multiplies R from the left, R middle changes by w x (R middle).
    """
    derivative = np.eye(n_free)
    derivative[3:6, :3] = cross_matrix(camera.rotation @ middle)
    return derivative


def whiten(covariances: NDArray[np.float64], columns: NDArray[np.float64]) -> NDArray[np.float64]:
    """Multiply columns (n, 2, c) by the inverse Cholesky factors of covariances (n, 2, 2)."""
    first = np.sqrt(covariances[:, 0, 0])
    mixed = covariances[:, 0, 1] / first
    second = np.sqrt(covariances[:, 1, 1] - mixed**2)
    whitened = np.empty_like(columns)
    whitened[:, 0] = columns[:, 0] / first[:, None]
    whitened[:, 1] = (columns[:, 1] - mixed[:, None] * whitened[:, 0]) / second[:, None]
    return whitened


@dataclass(frozen=True, kw_only=True)
class _Errors:
    residuals: NDArray[np.float64]  # (n, 2), in units of their standard deviation
    jacobian: NDArray[np.float64]  # (n, 2, p)
    cost: float


class _Problem:
    """The adjustment of a camera, in coordinates whose origin is near the points."""

    def __init__(
        self, seen: SeenPoints, lens: LensFreedom, prior: ViewingCamera, soft_limit: float
    ) -> None:
        self.lens, self.n_free = lens, POSE_PARAMETERS + lens.sigmas.size
        self._seen, self._prior = seen, prior
        self._soft_limit = soft_limit
        self._prior_weights = 1.0 / lens.sigmas**2

    def solve(self, camera: ViewingCamera) -> ViewingCamera:
        damping = _DAMPING_START
        errors = self.errors(camera)
        if not math.isfinite(errors.cost):
            raise GeometryError("the initial camera of a resection does not see the points")
        for _ in range(_ITERATIONS):
            while damping < _DAMPING_MOST:
                moved = stepped(camera, self.step(camera, errors, damping=damping), self.lens)
                after = self.errors(moved)
                if after.cost <= errors.cost:
                    break
                damping *= 10.0
            else:
                return camera
            gain = errors.cost - after.cost
            camera, errors, damping = moved, after, max(damping * 0.1, 1e-12)
            if gain <= _CONVERGED * max(errors.cost, 1e-30):
                break
        return camera

    def step(
        self, camera: ViewingCamera, errors: _Errors, *, damping: float
    ) -> NDArray[np.float64]:
        normal = self.normal(errors)
        right = np.einsum("nij,ni->j", errors.jacobian, errors.residuals)
        right[POSE_PARAMETERS:] += self._prior_weights * self._from_prior(camera)
        damped = normal + damping * np.diag(np.diag(normal))
        step: NDArray[np.float64] = np.linalg.lstsq(damped, right, rcond=None)[0]
        return step

    def errors(self, camera: ViewingCamera) -> _Errors:
        """Return whitened residuals and derivatives, with less weight for large residuals."""
        seen = self._seen
        linear = linearised(camera, seen.points_world, self.lens)
        residuals = seen.pixels_photo - linear.pixels
        both = np.empty((2, 1 + self.n_free, len(seen))).transpose(2, 0, 1)
        both[:, :, 0], both[:, :, 1:] = residuals, linear.by_parameters
        both = whiten(_pixel_covariances(linear, seen), both)
        squares = (both[:, :, 0] ** 2).sum(axis=1)
        limit, loss = self._soft_limit, squares
        if not math.isinf(limit):
            length = np.sqrt(squares)
            loss = np.where(length <= limit, squares, limit * (2.0 * length - limit))
            weight = np.minimum(1.0, limit / np.maximum(length, 1e-12))
            both *= np.sqrt(weight)[:, None, None]
        prior = float((self._prior_weights * self._from_prior(camera) ** 2).sum())
        return _Errors(
            residuals=both[:, :, 0], jacobian=both[:, :, 1:], cost=float(loss.sum()) + prior
        )

    def adjusted_points(
        self, camera: ViewingCamera, errors: _Errors, cofactors: NDArray[np.float64]
    ) -> AdjustedPoints:
        """Return the points, including the effect of their errors on the unknowns."""
        linear = linearised(camera, self._seen.points_world, LensFreedom())
        by_place = whiten(
            _pixel_covariances(linear, self._seen), linear.by_camera_point @ camera.rotation
        )
        follows = np.zeros((1, self.n_free, 3))
        follows[0, 3:POSE_PARAMETERS] = camera.rotation
        return AdjustedPoints(
            photo=np.zeros(len(self._seen), dtype=np.intp),
            places=self._seen.points_world,
            residuals=errors.residuals,
            jacobian=errors.jacobian,
            by_place=by_place,
            pulls=np.einsum("nip,nid->npd", errors.jacobian, by_place),
            follows=follows,
            towards=np.tile(
                outwards(self._seen.points_world, camera.centre_world), (len(self._seen), 1)
            ),
            cofactors=cofactors,
            scan_errors=self._seen.scan_errors,
        )

    def normal(self, errors: _Errors) -> NDArray[np.float64]:
        along, down = errors.jacobian.transpose(1, 2, 0)
        # Use einsum, because the order of summation in BLAS depends on the number of threads.
        normal: NDArray[np.float64] = np.einsum("jn,kn->jk", along, along)
        normal += np.einsum("jn,kn->jk", down, down)
        free = np.arange(POSE_PARAMETERS, len(normal))
        normal[free, free] += self._prior_weights
        return normal

    def _from_prior(self, camera: ViewingCamera) -> NDArray[np.float64]:
        return lens_values(self._prior, self.lens) - lens_values(camera, self.lens)


def _problem(
    seen: SeenPoints, prior: ViewingCamera, lens: LensFreedom | None, soft_limit: float
) -> tuple[NDArray[np.float64], _Problem]:
    """Return the centroid of the points, and the adjustment in coordinates relative to this.

    Large survey coordinates would reduce the precision.
    """
    freedom = LensFreedom() if lens is None else lens
    # The prior determines the lens parameters, so the points only need to determine the pose.
    if 2 * len(seen) < POSE_PARAMETERS + 2:
        raise GeometryError(
            f"a resection needs at least {POSE_PARAMETERS // 2 + 1} points, got {len(seen)}"
        )
    middle = seen.points_world.mean(axis=0)
    local = replace(seen, points_world=seen.points_world - middle)
    return middle, _Problem(local, freedom, prior, soft_limit)


def _pixel_covariances(linear: Linear, seen: SeenPoints) -> NDArray[np.float64]:
    along, down = linear.by_camera_point[:, 0], linear.by_camera_point[:, 1]
    from_pixel, from_point = seen.sigma_px**2, seen.sigma_m**2
    covariances = np.empty((len(seen), 2, 2))
    covariances[:, 0, 0] = from_pixel + from_point * (along**2).sum(axis=1)
    covariances[:, 1, 1] = from_pixel + from_point * (down**2).sum(axis=1)
    covariances[:, 0, 1] = covariances[:, 1, 0] = from_point * (along * down).sum(axis=1)
    return covariances
