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
from orthoflow.geometry.rotations import cross_matrices, cross_matrix, rotation_from_vector

_POSE_PARAMETERS: Final = 6
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
class LensFreedom:
    """How far an adjustment may move the interior orientation; 0 holds it.

    Attributes:
        focal_sigma: standard deviation of ln(focal length) beforehand, common to fx and fy.
        k1_sigma: standard deviation of k1 beforehand.
    """

    focal_sigma: float = 0.0
    k1_sigma: float = 0.0

    @property
    def sigmas(self) -> NDArray[np.float64]:
        """Standard deviations of the free ones, focal length first."""
        return np.array([s for s in (self.focal_sigma, self.k1_sigma) if s > 0.0])


@dataclass(frozen=True, kw_only=True)
class Resection:
    """An adjusted camera and how good it is.

    Attributes:
        camera: the camera.
        covariance: (p, p) float64 of rotation vector (left of camera_from_world), translation,
            then ln(focal length) and k1 where they were free; as large as the residuals say.
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


@dataclass(frozen=True, kw_only=True)
class _Linear:
    """The projection of points at a camera: pixels and derivatives."""

    pixels: NDArray[np.float64]
    by_camera_point: NDArray[np.float64]  # (n, 2, 3)
    by_parameters: NDArray[np.float64]  # (n, 2, p)


def adjust(
    seen: SeenPoints,
    start: ViewingCamera,
    *,
    lens: LensFreedom | None = None,
    groups: NDArray[np.intp] | None = None,
    soft_limit: float = math.inf,
) -> Resection:
    """Adjust a camera to the points it sees.

    Args:
        seen: the points, at least as many as the unknowns need.
        start: the camera to start from; its interior orientation is the prior of `lens`.
        lens: what of the interior orientation is free; nothing by default.
        groups: (n,) group of each point, e.g. a cell of the image, within which residuals may be
            correlated; None takes all as independent.
        soft_limit: residuals beyond so many standard deviations count less (Huber).

    Raises:
        GeometryError: too few points, or they do not determine the pose.
    """
    lens = LensFreedom() if lens is None else lens
    n_free = _POSE_PARAMETERS + lens.sigmas.size
    if 2 * len(seen) < n_free + 2:
        raise GeometryError(f"a resection with {n_free} unknowns got only {len(seen)} points")
    # Relative to the middle of the points: survey coordinates would cost digits.
    middle = seen.points_world.mean(axis=0)
    local = replace(seen, points_world=seen.points_world - middle)
    problem = _Problem(local, lens, start, soft_limit)
    camera = problem.solve(start.shifted(middle))
    normal, errors = problem.normal_matrix(camera), problem.whitened(camera)
    redundancy = 2 * len(seen) - _POSE_PARAMETERS
    sigma0 = math.sqrt(float((errors.residuals**2).sum()) / redundancy)
    try:
        cofactors = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise GeometryError("the points of a photo do not determine its pose") from error
    covariance = honest_covariance(
        errors.jacobian, errors.residuals, cofactors, groups, sigma0=sigma0
    )
    factor = float(np.trace(np.linalg.solve(cofactors, covariance))) / n_free
    camera = camera.shifted(-middle)
    to_world = _moved_origin(camera, middle, n_free)
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
    linear = _linearised(near, seen.points_world - middle, LensFreedom())
    with np.errstate(invalid="ignore"):
        whitened = _whiten(_pixel_covariances(linear, seen), residuals[:, :, None])[:, :, 0]
        normalised = np.linalg.norm(whitened, axis=1)
    return Misfit(
        residuals_px=residuals, normalised=np.where(np.isfinite(normalised), normalised, np.inf)
    )


def predicted_covariances(
    resection: Resection, points_world: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Covariances (n, 2, 2) in pixels squared of where the camera sees points (n, 3)."""
    by_parameters = _linearised(resection.camera, points_world, resection.lens).by_parameters
    predicted: NDArray[np.float64] = (
        by_parameters @ resection.covariance @ by_parameters.transpose(0, 2, 1)
    )
    return predicted


def pixels_by_point(
    camera: ViewingCamera, points_world: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Derivatives (n, 2, 3) in pixels per metre of the pixels of world points (n, 3)."""
    linear = _linearised(camera, points_world, LensFreedom())
    derivatives: NDArray[np.float64] = linear.by_camera_point @ camera.rotation
    return derivatives


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
            right[_POSE_PARAMETERS:] += self._prior_weights * self._from_prior(camera)
            while damping < _DAMPING_MOST:
                damped = normal + damping * np.diag(np.diag(normal))
                step = np.linalg.lstsq(damped, right, rcond=None)[0]
                moved = _stepped(camera, step, self._lens)
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
        linear = _linearised(camera, seen.points_world, self._lens)
        residuals = seen.pixels_photo - linear.pixels
        both = np.concatenate([residuals[:, :, None], linear.by_parameters], axis=2)
        both = _whiten(_pixel_covariances(linear, seen), both)
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
        free = np.arange(_POSE_PARAMETERS, len(normal))
        normal[free, free] += self._prior_weights
        return normal

    def _cost(self, camera: ViewingCamera) -> float:
        linear = _linearised(camera, self._seen.points_world, self._lens)
        residuals = self._seen.pixels_photo - linear.pixels
        covariances = _pixel_covariances(linear, self._seen)
        length = np.linalg.norm(_whiten(covariances, residuals[:, :, None])[:, :, 0], axis=1)
        limit = self._soft_limit
        if math.isinf(limit):
            loss = length**2
        else:
            loss = np.where(length <= limit, length**2, limit * (2.0 * length - limit))
        prior = float((self._prior_weights * self._from_prior(camera) ** 2).sum())
        return float(loss.sum()) + prior

    def _from_prior(self, camera: ViewingCamera) -> NDArray[np.float64]:
        """Prior - current value of the free interior parameters."""
        values = []
        if self._lens.focal_sigma > 0.0:
            values.append(math.log(self._prior.fx / camera.fx))
        if self._lens.k1_sigma > 0.0:
            values.append(float(self._prior.distortion[0] - camera.distortion[0]))
        return np.array(values, dtype=np.float64)


def _stepped(camera: ViewingCamera, step: NDArray[np.float64], lens: LensFreedom) -> ViewingCamera:
    scale, distortion = 1.0, camera.distortion
    free = list(step[_POSE_PARAMETERS:])
    if lens.focal_sigma > 0.0:
        scale = math.exp(min(1.0, max(-1.0, free.pop(0))))
    if lens.k1_sigma > 0.0:
        distortion = distortion.copy()
        distortion[0] += free.pop(0)
    turned = rotation_from_vector(step[:3]) @ camera.rotation
    left, _, right = np.linalg.svd(turned)  # keeps rounding from adding up
    return replace(
        camera,
        fx=camera.fx * scale,
        fy=camera.fy * scale,
        distortion=distortion,
        rotation=left @ right,
        translation=camera.translation + step[3:6],
    )


def _linearised(camera: ViewingCamera, points: NDArray[np.float64], lens: LensFreedom) -> _Linear:
    turned = points @ camera.rotation.T
    x, y, z = (turned + camera.translation).T
    with np.errstate(divide="ignore", invalid="ignore"):
        # Behind the camera there is no pixel: NaN makes its cost infinite.
        z = np.where(z > 1e-9, z, np.nan)
        a, b = x / z, y / z
    k1, k2, p1, p2, k3 = camera.distortion
    r2 = a * a + b * b
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
    ad = a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a)
    bd = b * radial + p1 * (r2 + 2.0 * b * b) + 2.0 * p2 * a * b
    ad_by_a = radial + a * a * slope + 2.0 * p1 * b + 6.0 * p2 * a
    ad_by_b = a * b * slope + 2.0 * p1 * a + 2.0 * p2 * b
    bd_by_b = radial + b * b * slope + 6.0 * p1 * b + 2.0 * p2 * a
    by_point = np.empty((len(points), 2, 3))
    by_point[:, 0, 0] = camera.fx * ad_by_a / z
    by_point[:, 0, 1] = camera.fx * ad_by_b / z
    by_point[:, 0, 2] = -camera.fx * (ad_by_a * a + ad_by_b * b) / z
    by_point[:, 1, 0] = camera.fy * ad_by_b / z
    by_point[:, 1, 1] = camera.fy * bd_by_b / z
    by_point[:, 1, 2] = -camera.fy * (ad_by_b * a + bd_by_b * b) / z
    columns = [-by_point @ cross_matrices(turned), by_point]
    if lens.focal_sigma > 0.0:
        columns.append(np.column_stack([camera.fx * ad, camera.fy * bd])[:, :, None])
    if lens.k1_sigma > 0.0:
        columns.append(np.column_stack([camera.fx * a * r2, camera.fy * b * r2])[:, :, None])
    return _Linear(
        pixels=np.column_stack([camera.fx * ad + camera.cx, camera.fy * bd + camera.cy]),
        by_camera_point=by_point,
        by_parameters=np.concatenate(columns, axis=2),
    )


def _pixel_covariances(linear: _Linear, seen: SeenPoints) -> NDArray[np.float64]:
    by_point = linear.by_camera_point
    covariances = (seen.sigma_m**2)[:, None, None] * (by_point @ by_point.transpose(0, 2, 1))
    covariances[:, [0, 1], [0, 1]] += (seen.sigma_px**2)[:, None]
    result: NDArray[np.float64] = covariances
    return result


def _whiten(covariances: NDArray[np.float64], columns: NDArray[np.float64]) -> NDArray[np.float64]:
    """Columns (n, 2, c) in units of standard deviation: the inverse Cholesky factor applied."""
    first = np.sqrt(covariances[:, 0, 0])
    mixed = covariances[:, 0, 1] / first
    second = np.sqrt(covariances[:, 1, 1] - mixed**2)
    whitened = np.empty_like(columns)
    whitened[:, 0] = columns[:, 0] / first[:, None]
    whitened[:, 1] = (columns[:, 1] - mixed[:, None] * whitened[:, 0]) / second[:, None]
    return whitened


def _moved_origin(
    camera: ViewingCamera, middle: NDArray[np.float64], n_free: int
) -> NDArray[np.float64]:
    """Derivative of the world's parameters by those around the points' middle.

    t = t_local - R middle; a turn w left of R moves R middle by w x (R middle).
    """
    derivative = np.eye(n_free)
    derivative[3:6, :3] = cross_matrix(camera.rotation @ middle)
    return derivative
