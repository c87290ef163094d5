"""The adjustment of one camera: exact for exact points, honest about noise, blind to the origin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from orthoflow.errors import GeometryError
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.resection import (
    SeenPoints,
    adjust,
    misfit,
    predicted_covariances,
)
from orthoflow.testing import photographed as ms
from tests.scenes import SURVEY_SHIFT_M


def true_camera() -> ViewingCamera:
    return ms.camera_before(ms.textured_wall(0))


def seen_by(
    camera: ViewingCamera, seed: int, *, noise_px: float = 0.0, noise_m: float = 0.0, n: int = 120
) -> SeenPoints:
    rng = np.random.default_rng(seed)
    points = rng.uniform([0.2, -0.3, 0.2], [2.8, 0.1, 1.8], (4 * n, 3))
    pixels = camera.project(points)[:, :2]
    inside = np.flatnonzero(camera.sees(pixels))[:n]
    return SeenPoints(
        pixels_photo=pixels[inside] + noise_px * rng.normal(size=(len(inside), 2)),
        points_world=points[inside] + noise_m * rng.normal(size=(len(inside), 3)),
        sigma_px=np.full(len(inside), max(noise_px, 0.1)),
        sigma_m=np.full(len(inside), noise_m),
    )


def test_a_point_beside_the_projection_centre_agrees_with_nothing() -> None:
    camera = true_camera()
    ahead = camera.rotation[2]
    # 2 mm and 2 m before the camera, known to 3 mm: the first may be anywhere in the image.
    points = camera.centre_world + np.array([[0.002], [2.0]]) * ahead
    seen = SeenPoints(
        pixels_photo=camera.project(points)[:, :2] + [1.0, 0.0],
        points_world=points,
        sigma_px=np.full(2, 0.5),
        sigma_m=np.full(2, 0.003),
    )
    near, far = misfit(seen, camera).normalised
    assert np.isinf(near)
    assert 0.5 < far < 1.5


def test_survey_coordinates_lose_nothing() -> None:
    camera = true_camera()
    seen = seen_by(camera, 3, noise_px=0.5)
    near = adjust(seen, camera)
    shifted = replace(seen, points_world=seen.points_world + SURVEY_SHIFT_M)
    far = adjust(shifted, camera.shifted(-SURVEY_SHIFT_M))
    np.testing.assert_allclose(
        far.camera.centre_world - SURVEY_SHIFT_M, near.camera.centre_world, atol=2e-6
    )
    at = seen.points_world[:5]
    np.testing.assert_allclose(
        predicted_covariances(far, at + SURVEY_SHIFT_M),
        predicted_covariances(near, at),
        # The lever of 10^6 m costs eleven digits of sixteen; 1e-5 square pixels remain.
        atol=1e-5,
    )


def test_the_stated_covariance_is_the_scatter_of_repeated_adjustments() -> None:
    camera = true_camera()
    at = np.array([[0.5, 0.0, 0.4], [2.5, 0.0, 1.6], [1.5, 0.0, 1.0]])
    exact = camera.project(at)[:, :2]
    ratios = []
    for seed in range(60):
        result = adjust(seen_by(camera, seed, noise_px=0.6, noise_m=0.002), camera)
        error = result.camera.project(at)[:, :2] - exact
        covariances = predicted_covariances(result, at)
        ratios.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariances), error))
    # Chi-squared with 2 degrees of freedom has mean 2; 60 runs of correlated triples leave 15 %.
    assert np.mean(ratios) == pytest.approx(2.0, rel=0.3)


def test_a_soft_limit_bears_outliers() -> None:
    camera = true_camera()
    seen = seen_by(camera, 6, noise_px=0.3)
    pixels = seen.pixels_photo.copy()
    pixels[:12] += 40.0
    spoilt = replace(seen, pixels_photo=pixels)
    soft = adjust(spoilt, camera, soft_limit=2.0).camera
    hard = adjust(spoilt, camera).camera

    def miss(found: ViewingCamera) -> float:
        return float(np.linalg.norm(found.centre_world - camera.centre_world))

    assert miss(soft) < 0.25 * miss(hard)


def test_too_few_points_are_refused() -> None:
    camera = true_camera()
    with pytest.raises(GeometryError, match=r"6 unknowns got only 3 points"):
        adjust(seen_by(camera, 8).take(np.arange(3)), camera)


def test_a_start_that_looks_away_is_refused() -> None:
    camera = true_camera()
    turned = ms.nudged(camera, (0.0, np.pi, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(GeometryError, match=r"cannot see its points"):
        adjust(seen_by(camera, 9), turned)
