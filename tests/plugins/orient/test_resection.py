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
from tests.tied_photos import SCENE, seen_by

CAMERA = ms.camera_before(SCENE)


def test_a_point_beside_the_projection_centre_agrees_with_nothing() -> None:
    ahead = CAMERA.rotation[2]
    # 2 mm and 2 m before the camera, known to 3 mm: the first may be anywhere in the image.
    points = CAMERA.centre_world + np.array([[0.002], [2.0]]) * ahead
    seen = SeenPoints(
        pixels_photo=CAMERA.project(points)[:, :2] + [1.0, 0.0],
        points_world=points,
        sigma_px=np.full(2, 0.5),
        sigma_m=np.full(2, 0.003),
    )
    near, far = misfit(seen, CAMERA).normalised
    assert np.isinf(near)
    assert 0.5 < far < 1.5


def test_survey_coordinates_lose_nothing() -> None:
    seen = seen_by(CAMERA, 120, noise_px=0.5)
    near = adjust(seen, CAMERA)
    shifted = replace(seen, points_world=seen.points_world + SURVEY_SHIFT_M)
    far = adjust(shifted, CAMERA.shifted(-SURVEY_SHIFT_M))
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
    at = np.array([[0.5, 0.0, 0.4], [2.5, 0.0, 1.6], [1.5, 0.0, 1.0]])
    exact = CAMERA.project(at)[:, :2]
    ratios = []
    for seed in range(60):
        noise = {"noise_px": 0.6, "noise_m": 0.002, "sigma_px": 0.6, "sigma_m": 0.002}
        seen = seen_by(CAMERA, 120, seed=seed, **noise)
        result = adjust(seen, CAMERA)
        error = result.camera.project(at)[:, :2] - exact
        covariances = predicted_covariances(result, at)
        ratios.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariances), error))
    # Chi-squared with 2 degrees of freedom has mean 2; 60 runs of correlated triples leave 15 %.
    assert np.mean(ratios) == pytest.approx(2.0, rel=0.3)


def test_a_soft_limit_bears_outliers() -> None:
    seen = seen_by(CAMERA, 120, noise_px=0.3, sigma_px=0.3)
    pixels = seen.pixels_photo.copy()
    pixels[:12] += 40.0
    spoilt = replace(seen, pixels_photo=pixels)
    soft = adjust(spoilt, CAMERA, soft_limit=2.0).camera
    hard = adjust(spoilt, CAMERA).camera

    def miss(found: ViewingCamera) -> float:
        return float(np.linalg.norm(found.centre_world - CAMERA.centre_world))

    assert miss(soft) < 0.25 * miss(hard)


def test_too_few_points_and_a_start_that_looks_away_are_refused() -> None:
    with pytest.raises(GeometryError, match=r"6 unknowns got only 3 points"):
        adjust(seen_by(CAMERA, 3), CAMERA)
    adjust(seen_by(CAMERA, 4), CAMERA)
    turned = ms.nudged(CAMERA, (0.0, np.pi, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(GeometryError, match=r"cannot see its points"):
        adjust(seen_by(CAMERA, 120), turned)
