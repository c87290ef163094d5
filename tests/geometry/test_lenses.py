"""Derivatives of pixels by pose and lens, against differences, and steps of an adjustment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.geometry.cameras import LensFreedom, ViewingCamera, lens_values, linearised, stepped
from orthoflow.geometry.frames import rotation_from_vector
from tests import scenes

ALL = LensFreedom(
    focal_sigma=0.1,
    aspect_sigma=0.01,
    centre_sigma_px=20.0,
    k1_sigma=0.2,
    k2_sigma=0.3,
    tangential_sigma=0.01,
    skew_sigma_px=2.0,
)
NAMES = ("focal", "aspect", "cx", "cy", "k1", "k2", "p1", "p2", "skew")


def camera(*, skew: float = 1.5, bends: bool = True) -> ViewingCamera:
    return ViewingCamera(
        width=640,
        height=480,
        fx=510.0,
        fy=500.0,
        cx=322.0,
        cy=238.0,
        distortion=np.array([-0.12, 0.05, 1e-3, -2e-3, 0.01]) * bends,
        rotation=scenes.random_rotation(np.random.default_rng(4)),
        translation=np.array([0.1, -0.2, 0.3]),
        skew=skew,
    )


def points_before(viewing: ViewingCamera, n: int = 12) -> NDArray[np.float64]:
    rng = np.random.default_rng(5)
    own = rng.uniform([-1.5, -1.0, 3.0], [1.5, 1.0, 6.0], (n, 3))
    return np.asarray((own - viewing.translation) @ viewing.rotation)


@pytest.mark.parametrize("skew", [0.0, 1.5])
@pytest.mark.parametrize("bends", [True, False])
def test_pixels_are_those_of_the_camera(skew: float, bends: bool) -> None:
    viewing = camera(skew=skew, bends=bends)
    points = points_before(viewing)
    found = linearised(viewing, points, ALL).pixels
    np.testing.assert_allclose(found, viewing.project(points)[:, :2], atol=1e-9)
    behind = viewing.centre_world - (points - viewing.centre_world)
    assert np.isnan(linearised(viewing, behind, ALL).pixels).all()


@pytest.mark.parametrize("skew", [0.0, 1.5])
@pytest.mark.parametrize("bends", [True, False])
@pytest.mark.parametrize("column", range(6 + len(NAMES)))
def test_derivatives_are_what_a_small_step_changes(skew: float, bends: bool, column: int) -> None:
    viewing = camera(skew=skew, bends=bends)
    points = points_before(viewing)
    step = np.zeros(6 + len(NAMES))
    step[column] = 1e-6
    ahead, back = (stepped(viewing, way * step, ALL).project(points)[:, :2] for way in (1.0, -1.0))
    found = linearised(viewing, points, ALL).by_parameters[:, :, column]
    # Pixels of hundreds have 1e-13 in float64, which differences of 2e-6 blow up.
    np.testing.assert_allclose(found, (ahead - back) / 2e-6, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("axis", range(3))
def test_derivatives_by_the_point_are_along_the_axes_of_the_camera(axis: int) -> None:
    viewing = camera()
    points = points_before(viewing)
    move = 1e-6 * viewing.rotation[axis]
    ahead, back = (viewing.project(points + way * move)[:, :2] for way in (1.0, -1.0))
    found = linearised(viewing, points, LensFreedom()).by_camera_point[:, :, axis]
    np.testing.assert_allclose(found, (ahead - back) / 2e-6, rtol=1e-5, atol=1e-4)


def test_what_is_free_has_its_names_in_one_order_and_nothing_is_by_itself() -> None:
    assert ALL.names == NAMES
    np.testing.assert_array_equal(ALL.sigmas, [0.1, 0.01, 20.0, 20.0, 0.2, 0.3, 0.01, 0.01, 2.0])
    assert LensFreedom().names == ()
    assert LensFreedom().sigmas.size == 0
    assert LensFreedom(k1_sigma=0.1, centre_sigma_px=3.0).names == ("cx", "cy", "k1")
    some = linearised(camera(), points_before(camera()), LensFreedom(k2_sigma=0.1))
    every = linearised(camera(), points_before(camera()), ALL)
    np.testing.assert_array_equal(some.by_parameters[:, :, 6], every.by_parameters[:, :, 11])
    assert some.by_parameters.shape == (12, 2, 7)


def test_a_step_moves_what_it_names_and_holds_the_rest() -> None:
    viewing = camera()
    step = np.array([0.01, -0.02, 0.03, 0.4, 0.5, -0.6])
    moved = stepped(viewing, step, LensFreedom())
    np.testing.assert_allclose(moved.rotation, rotation_from_vector(step[:3]) @ viewing.rotation)
    np.testing.assert_allclose(moved.translation, viewing.translation + step[3:])
    held = replace(moved, rotation=viewing.rotation, translation=viewing.translation)
    np.testing.assert_array_equal(lens_values(held, ALL), lens_values(viewing, ALL))
    assert (held.fx, held.fy, held.distortion[4]) == (viewing.fx, viewing.fy, 0.01)
    lens_step = np.array([0.02, -0.01, 3.0, -4.0, 0.01, 0.02, 1e-3, 2e-3, 0.5])
    freed = stepped(viewing, np.concatenate([np.zeros(6), lens_step]), ALL)
    np.testing.assert_allclose(lens_values(freed, ALL) - lens_values(viewing, ALL), lens_step)
    assert freed.distortion[4] == viewing.distortion[4]
    np.testing.assert_allclose(freed.rotation, viewing.rotation, atol=1e-12)


def test_values_of_a_lens_are_logarithms_and_numbers() -> None:
    np.testing.assert_allclose(
        lens_values(camera(), ALL),
        [np.log(510.0), np.log(500.0 / 510.0), 322.0, 238.0, -0.12, 0.05, 1e-3, -2e-3, 1.5],
    )


@pytest.mark.parametrize(
    ("logarithm", "factor"), [(0.5, 0.5), (0.9, 0.9), (1.1, 1.0), (-0.9, -0.9), (-7.0, -1.0)]
)
def test_a_focal_length_grows_to_its_e_fold_in_one_step_at_most(
    logarithm: float, factor: float
) -> None:
    viewing = camera()
    moved = stepped(viewing, np.array([*np.zeros(6), logarithm]), LensFreedom(focal_sigma=0.1))
    assert moved.fx / viewing.fx == pytest.approx(np.exp(factor))
    assert moved.fy / viewing.fy == pytest.approx(np.exp(factor))
