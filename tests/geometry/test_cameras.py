"""The distorted camera against OpenCV and against itself."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from orthoflow.errors import GeometryError
from orthoflow.geometry.camera_kernels import largest_radius, project_point
from orthoflow.geometry.cameras import LensFreedom, ViewingCamera, linearised, looking_at, stepped
from orthoflow.geometry.compiling import interpreted
from tests import samples
from tests.long_loops import seeds

UP = np.array([0.0, 0.0, 1.0])


def camera(seed: int, *, distorted: bool = True) -> ViewingCamera:
    rng = np.random.default_rng(seed)
    centre = rng.uniform(-1.0, 1.0, 3) - [0.0, 4.0, 0.0]
    rotation = looking_at(centre, rng.uniform(-0.3, 0.3, 3), UP)
    distortion = np.array([-0.11, 0.04, 1.2e-3, -8e-4, -5e-3]) if distorted else np.zeros(5)
    return samples.camera(
        rotation,
        centre,
        width=3000,
        height=2000,
        fx=2500.0 + rng.uniform(-100, 100),
        fy=2510.0,
        cx=1510.3,
        cy=992.7,
        distortion=distortion,
    )


def skewed(seed: int) -> ViewingCamera:
    return replace(camera(seed), skew=35.0)


def points(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform([-1.5, -0.3, -1.0], [1.5, 0.3, 1.0], (200, 3))


@pytest.mark.parametrize("seed", seeds(6))
def test_projection_is_opencvs_half_a_pixel_on(seed: int) -> None:
    viewer = camera(seed)
    matrix = np.array([[viewer.fx, 0, viewer.cx - 0.5], [0, viewer.fy, viewer.cy - 0.5], [0, 0, 1]])
    rotation_vector, _ = cv2.Rodrigues(viewer.rotation)
    expected, _ = cv2.projectPoints(
        points(seed), rotation_vector, viewer.translation, matrix, viewer.distortion
    )
    found = viewer.project(points(seed))
    np.testing.assert_allclose(found[:, :2] - 0.5, expected[:, 0], atol=1e-8)  # pixels


@pytest.mark.parametrize("seed", seeds(6))
def test_the_ray_of_a_points_pixel_leads_back_to_the_point(seed: int) -> None:
    viewer = camera(seed)
    scene = points(seed)
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


@pytest.mark.parametrize("viewer", [camera(2), skewed(2)], ids=["square", "skewed"])
def test_kernels_project_as_the_camera_does(viewer: ViewingCamera) -> None:
    kernel = interpreted(project_point)
    found = np.array([kernel(viewer.flat, *point) for point in points(2)])
    np.testing.assert_allclose(found, viewer.project(points(2)), atol=1e-9)


def test_derivatives_of_a_skewed_lens_are_those_of_its_projection() -> None:
    lens = LensFreedom(
        focal_sigma=1.0,
        aspect_sigma=1.0,
        centre_sigma_px=1.0,
        k1_sigma=1.0,
        k2_sigma=1.0,
        tangential_sigma=1.0,
        skew_sigma_px=1.0,
    )
    viewer, scene = skewed(3), points(3)
    linear = linearised(viewer, scene, lens)
    np.testing.assert_allclose(linear.pixels, viewer.project(scene)[:, :2], atol=1e-9)
    for column in range(6 + len(lens.names)):
        step = np.zeros(6 + len(lens.names))
        step[column] = 1e-6
        there, back = (stepped(viewer, sign * step, lens).project(scene) for sign in (1.0, -1.0))
        slope = (there - back)[:, :2] / 2e-6
        np.testing.assert_allclose(
            linear.by_parameters[:, :, column], slope, rtol=1e-5, atol=1e-3, err_msg=str(column)
        )
    np.testing.assert_allclose(
        linear.by_camera_point, linear.by_parameters[:, :, 3:6], err_msg="by the point"
    )


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
    lens = {"fx": 1500.0, "fy": 1500.0, "cx": 1500.0, "cy": 1000.0, "width": 3000, "height": 2000}
    centre, bent = np.array([0.0, -4.0, 0.0]), np.array([-0.35, 0.0, 0.0, 0.0, 0.0])
    viewer = samples.camera(looking_at(centre, np.zeros(3), UP), centre, distortion=bent, **lens)
    # r (1 - 0.35 r^2) turns back at r = 0.976; r = 1.6 would appear at 0.17, near the centre.
    seen = viewer.project(np.array([[4.0 * 1.6, 0.0, 0.0], [4.0 * 0.9, 0.0, 0.0]]))
    assert np.isnan(seen[0, 0])
    assert np.isfinite(seen[1, 0])


def test_a_level_camera_has_level_rows() -> None:
    rotation = looking_at(np.array([1.0, -4.0, 0.5]), np.zeros(3), UP)
    assert rotation[0] @ UP == pytest.approx(0.0)
    assert rotation[1] @ UP < 0.0
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_a_mirroring_rotation_is_refused() -> None:
    with pytest.raises(GeometryError, match="mirrors the world"):
        ViewingCamera(
            width=3, height=2, fx=1, fy=1, cx=1, cy=1, distortion=np.zeros(5),
            rotation=np.diag([1.0, 1.0, -1.0]), translation=np.zeros(3),
        )  # fmt: skip


@pytest.mark.parametrize("stretched", [1.0 + 2e-6, np.nan])
def test_a_rotation_that_stretches_is_refused(stretched: float) -> None:
    with pytest.raises(GeometryError, match="orthonormal"):
        ViewingCamera(
            width=3, height=2, fx=1, fy=1, cx=1, cy=1, distortion=np.zeros(5),
            rotation=np.diag([1.0, 1.0, stretched]), translation=np.zeros(3),
        )  # fmt: skip


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
def test_a_lens_is_used_to_where_it_folds_and_no_farther_than_ten(
    distortion: list[float], radius: float
) -> None:
    assert largest_radius(np.array(distortion)) == pytest.approx(radius)
