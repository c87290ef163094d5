"""The distorted camera against OpenCV and against itself."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from orthoflow.errors import GeometryError
from orthoflow.geometry.camera_kernels import largest_radius, project_point
from orthoflow.geometry.cameras import (
    HALF_PIXEL,
    LensFreedom,
    ViewingCamera,
    from_opencv,
    lens_values,
    linearised,
    looking_at,
    opencv_matrix,
    stepped,
    to_opencv,
)
from orthoflow.geometry.compiling import interpreted
from orthoflow.geometry.frames import rotation_from_vector
from tests import samples
from tests.long_loops import seeds


def camera(seed: int) -> ViewingCamera:
    rng = np.random.default_rng(seed)
    centre = rng.uniform(-1.0, 1.0, 3) - [0.0, 4.0, 0.0]
    target, focal_px = rng.uniform(-0.3, 0.3, 3), 2500.0 + rng.uniform(-100, 100)
    bent = np.array([-0.11, 0.04, 1.2e-3, -8e-4, -5e-3])
    lens = {"fy": 2510.0, "cx": 1510.3, "cy": 992.7, "distortion": bent}
    return samples.aimed(centre, target, focal_px, (3000, 2000), **lens)


def skewed(seed: int) -> ViewingCamera:
    return replace(camera(seed), skew=35.0)


def points(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform([-1.5, -0.3, -1.0], [1.5, 0.3, 1.0], (200, 3))


@pytest.mark.parametrize("seed", seeds(6))
def test_projection_is_opencvs_half_a_pixel_on(seed: int) -> None:
    viewer = camera(seed)
    rotation_vector, _ = cv2.Rodrigues(viewer.rotation)
    lens = (opencv_matrix(viewer), viewer.distortion)
    expected, _ = cv2.projectPoints(points(seed), rotation_vector, viewer.translation, *lens)
    found = viewer.project(points(seed))
    np.testing.assert_allclose(found[:, :2] - 0.5, expected[:, 0], atol=1e-8)  # pixels


@pytest.mark.parametrize("seed", seeds(6))
def test_the_ray_of_a_points_pixel_leads_back_to_the_point(seed: int) -> None:
    viewer = camera(seed)
    scene = np.repeat(points(seed), 200, axis=0)
    seen = viewer.project(scene)
    rays = viewer.rays_world(seen[:, :2])
    expected = scene - viewer.centre_world
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(rays, expected, atol=1e-10)


def test_skew_moves_pixels_along_their_rows_and_rays_lead_back() -> None:
    square, leaning = camera(1), skewed(1)
    scene = points(1)
    seen, moved = square.project(scene), leaning.project(scene)
    expected = seen + np.outer((seen[:, 1] - square.cy) / square.fy, [35.0, 0.0, 0.0])
    np.testing.assert_allclose(moved, expected, atol=1e-9)
    assert np.ptp(moved[:, 0] - seen[:, 0]) > 5.0
    rays = leaning.rays_world(moved[:, :2])
    np.testing.assert_allclose(rays, square.rays_world(seen[:, :2]), atol=1e-12)


def test_kernels_project_as_the_camera_does() -> None:
    viewer, kernel = skewed(2), interpreted(project_point)
    found = np.array([kernel(viewer.flat, *point) for point in points(2)])
    np.testing.assert_allclose(found, viewer.project(points(2)), atol=1e-9)


def test_survey_coordinates_lose_nothing_through_a_shifted_camera() -> None:
    shift = np.array([634512.347, 486215.781, 112.193])
    near = camera(1)
    far = camera(1).shifted(-shift)
    np.testing.assert_allclose(far.centre_world, near.centre_world + shift, atol=1e-8)
    np.testing.assert_allclose(
        far.shifted(shift).project(points(1)), near.project(points(1)), atol=1e-6
    )


def test_points_behind_the_camera_are_not_seen() -> None:
    viewer = camera(2)
    behind = 2.0 * viewer.centre_world[None] - points(2)
    assert np.isnan(viewer.project(behind)[:, :2]).all()
    assert not viewer.sees(viewer.project(behind)[:, :2]).any()


def test_a_point_beyond_the_fold_of_the_lens_does_not_come_back_into_the_image() -> None:
    bent = np.array([-0.35, 0.0, 0.0, 0.0, 0.0])
    viewer = samples.aimed((0, -4, 0), (0, 0, 0), 1500.0, (3000, 2000), distortion=bent)
    # r (1 - 0.35 r^2) turns back at r = 0.976; r = 1.6 would appear at 0.17, near the centre.
    seen = viewer.project(np.array([[4.0 * 1.6, 0.0, 0.0], [4.0 * 0.9, 0.0, 0.0]]))
    assert np.isnan(seen[0, 0])
    assert np.isfinite(seen[1, 0])


def test_a_level_camera_has_level_rows() -> None:
    rotation = looking_at(np.array([1.0, -4.0, 0.5]), np.zeros(3), samples.UP)
    assert rotation[0] @ samples.UP == pytest.approx(0.0)
    assert rotation[1] @ samples.UP < 0.0
    assert np.linalg.det(rotation) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("scale", "reason"),
    [(-1.0, "mirrors the world"), (1.0 + 2e-6, "orthonormal"), (np.nan, "orthonormal")],
)
def test_a_rotation_that_mirrors_or_stretches_is_refused(scale: float, reason: str) -> None:
    with pytest.raises(GeometryError, match=reason):
        replace(camera(0), rotation=np.diag([1.0, 1.0, scale]))


@pytest.mark.parametrize(
    ("distortion", "radius"),
    [
        ([0.0, 0.0, 0.0, 0.0, 0.0], 10.0),
        # 1 + 3 k1 r^2, 1 + 5 k2 r^4 and 1 + 7 k3 r^6 are zero.
        ([-1.0 / 3.0, 0.0, 0.0, 0.0, 0.0], 1.0),
        ([0.0, -1.0 / 80.0, 0.01, 0.01, 0.0], 2.0),
        ([0.0, 0.0, 0.0, 0.0, -1.0 / 7.0], 1.0),
        ([-1.0 / 2700.0, 0.0, 0.0, 0.0, 0.0], 10.0),
        ([0.2, 0.0, 0.0, 0.0, 0.0], 10.0),
    ],
)
def test_lenses_are_used_up_to_their_fold(distortion: list[float], radius: float) -> None:
    assert largest_radius(np.array(distortion)) == pytest.approx(radius)


# --- lenses that are adjusted ---


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


def test_derivatives_are_what_a_small_step_changes() -> None:
    viewer, scene = skewed(3), points(3)
    linear = linearised(viewer, scene, ALL)
    np.testing.assert_allclose(linear.pixels, viewer.project(scene)[:, :2], atol=1e-9)
    behind = 2.0 * viewer.centre_world - scene
    assert np.isnan(linearised(viewer, behind, ALL).pixels).all()
    for step in 1e-6 * np.eye(6 + len(NAMES)):
        ahead, back = (stepped(viewer, way * step, ALL).project(scene) for way in (1.0, -1.0))
        found = linear.by_parameters @ step / 1e-6
        # Pixels of thousands have 1e-12 in float64, which differences of 2e-6 blow up.
        np.testing.assert_allclose(found, (ahead - back)[:, :2] / 2e-6, rtol=1e-5, atol=1e-3)
    # A shift of the camera moves all points along its axes.
    np.testing.assert_allclose(linear.by_camera_point, linear.by_parameters[:, :, 3:6])


def test_what_is_free_has_its_names_in_one_order_and_nothing_is_by_itself() -> None:
    assert ALL.names == NAMES
    np.testing.assert_array_equal(ALL.sigmas, [0.1, 0.01, 20.0, 20.0, 0.2, 0.3, 0.01, 0.01, 2.0])
    assert LensFreedom().names == ()
    assert LensFreedom().sigmas.size == 0
    assert LensFreedom(k1_sigma=0.1, centre_sigma_px=3.0).names == ("cx", "cy", "k1")
    some = linearised(skewed(3), points(3), LensFreedom(k2_sigma=0.1))
    every = linearised(skewed(3), points(3), ALL)
    np.testing.assert_array_equal(some.by_parameters[:, :, 6], every.by_parameters[:, :, 11])
    assert some.by_parameters.shape == (200, 2, 7)


def test_a_step_moves_what_it_names_and_holds_the_rest() -> None:
    viewing = skewed(3)
    step = np.array([0.01, -0.02, 0.03, 0.4, 0.5, -0.6])
    moved = stepped(viewing, step, LensFreedom())
    np.testing.assert_allclose(moved.rotation, rotation_from_vector(step[:3]) @ viewing.rotation)
    np.testing.assert_allclose(moved.translation, viewing.translation + step[3:])
    held = replace(moved, rotation=viewing.rotation, translation=viewing.translation)
    np.testing.assert_array_equal(lens_values(held, ALL), lens_values(viewing, ALL))
    assert (held.fx, held.fy, held.distortion[4]) == (viewing.fx, viewing.fy, -5e-3)
    lens_step = np.array([0.02, -0.01, 3.0, -4.0, 0.01, 0.02, 1e-3, 2e-3, 0.5])
    freed = stepped(viewing, np.concatenate([np.zeros(6), lens_step]), ALL)
    np.testing.assert_allclose(lens_values(freed, ALL) - lens_values(viewing, ALL), lens_step)
    assert freed.distortion[4] == viewing.distortion[4]
    np.testing.assert_allclose(freed.rotation, viewing.rotation, atol=1e-12)


def test_values_of_a_lens_are_logarithms_and_numbers() -> None:
    found = lens_values(replace(skewed(3), fx=2500.0), ALL)
    expected = [np.log(2500.0), np.log(2510.0 / 2500.0), 1510.3, 992.7, -0.11, 0.04, 1.2e-3, -8e-4]
    np.testing.assert_allclose(found, [*expected, 35.0])


@pytest.mark.parametrize(
    ("logarithm", "factor"), [(0.5, 0.5), (0.9, 0.9), (1.1, 1.0), (-0.9, -0.9), (-7.0, -1.0)]
)
def test_steps_of_focal_lengths_are_limited(logarithm: float, factor: float) -> None:
    viewing = skewed(3)
    moved = stepped(viewing, np.array([*np.zeros(6), logarithm]), LensFreedom(focal_sigma=0.1))
    assert moved.fx / viewing.fx == pytest.approx(np.exp(factor))
    assert moved.fy / viewing.fy == pytest.approx(np.exp(factor))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_first_pixels_centre_is_opencvs_origin(dtype: type[np.floating]) -> None:
    ours = np.array([[HALF_PIXEL, HALF_PIXEL], [3.25, 700.75]], dtype=dtype)
    theirs = to_opencv(ours)
    np.testing.assert_array_equal(theirs, np.array([[0.0, 0.0], [2.75, 700.25]], dtype=dtype))
    assert theirs.dtype == dtype
    back = from_opencv(theirs)
    np.testing.assert_array_equal(back, ours)
    assert back.dtype == dtype
