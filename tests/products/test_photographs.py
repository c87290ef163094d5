"""Ties, lenses and orientations: walls of ties, cameras that project, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from orthoflow.errors import ProductError
from orthoflow.products import Camera, Intrinsics, Ties, TieWall
from orthoflow.testing.photographed import camera_before, oriented
from tests import samples

WALL = samples.tie_wall(samples.facing_south(0.01, 300, 200).corners_world(), 0.01)


def ties(**more: object) -> Ties:
    known = {"points_world": np.ones((2, 3)), "sigma_px": np.ones(2), "sigma_m": np.ones(2)}
    return samples.ties(np.ones((2, 2)), photo_names=("a.jpg", "b.jpg"), **known, **more)


@pytest.mark.parametrize("value", [np.nan, -1.0])
def test_impossible_ties_are_refused(value: float) -> None:
    ties().check_against({})
    with pytest.raises(ProductError, match=r"ties\.sigma_px"):
        replace(ties(), sigma_px=np.full(2, value)).check_against({})


def test_what_ties_say_of_a_wall_is_what_its_raster_says() -> None:
    frame = samples.facing_south(0.01, 4, 3, (1.0, 2.0, 3.0))
    raster = np.zeros(frame.shape, np.float32)
    wall = samples.wall(
        frame, name="north", depth_m=raster, sigma_m=raster, mask=np.zeros(frame.shape, np.uint8)
    )
    found = TieWall.of(wall)
    assert (found.name, found.gsd_m, found.normal_world) == ("north", 0.01, (0.0, -1.0, 0.0))
    np.testing.assert_array_equal(found.corners_world, frame.corners_world())


def test_walls_and_radii_of_another_shape_are_refused() -> None:
    with pytest.raises(ProductError, match=r"4 corners and a normal, .*; got the shapes \(1, 3\)"):
        TieWall(corners_world=((0.0, 0.0, 0.0),), normal_world=(0.0, -1.0, 0.0))
    with pytest.raises(ProductError, match="one value per photo, got 1 values for 2 photos"):
        ties(search_radius_px=(22.0,))


@pytest.mark.parametrize(("wall", "number"), [(0, 7), (1, 1), (2, 2), (-1, -1)])
def test_people_know_a_wall_of_ties_by_its_plane_where_that_is_said(wall: int, number: int) -> None:
    said = ties(walls=(replace(WALL, plane_index=7), WALL))
    assert said.number(wall) == number


TRUE = camera_before()


def test_a_lens_comes_back_from_its_camera() -> None:
    lens = Intrinsics.of(TRUE, source="exif")
    assert lens == Intrinsics(
        **{name: getattr(TRUE, name) for name in ("width", "height", "fx", "fy", "cx", "cy")},
        distortion=tuple(TRUE.distortion.tolist()),
        source="exif",
    )
    assert Intrinsics.of(TRUE).source == "calibration"
    again = lens.posed(TRUE.rotation, TRUE.translation)
    points = np.array([[1.2, 0.1, 1.0], [1.9, 0.0, 0.4], [0.9, -0.1, 1.6]])
    np.testing.assert_array_equal(again.project(points), TRUE.project(points))
    assert Intrinsics.of(again, source="exif") == lens
    # A lens has a skew where its axes are not perpendicular.
    assert lens.skew is None
    skewed = Intrinsics.of(replace(TRUE, skew=0.75))
    assert skewed.skew == skewed.posed().skew == 0.75


def test_without_a_pose_a_lens_looks_along_its_own_axis() -> None:
    own = replace(Intrinsics.of(TRUE), distortion=(0.0,) * 5).posed()
    u, v, depth = own.project(np.array([[0.5, -0.25, 2.0]]))[0]
    assert (u, v) == (TRUE.cx + TRUE.fx * 0.25, TRUE.cy - TRUE.fy * 0.125)
    assert depth == 2.0
    np.testing.assert_array_equal(own.centre_world, np.zeros(3))


def test_an_oriented_photo_views_as_its_camera_does() -> None:
    viewing = oriented(TRUE).viewing()
    np.testing.assert_array_equal(viewing.centre_world, TRUE.centre_world)
    np.testing.assert_array_equal(viewing.rotation, TRUE.rotation)


@pytest.mark.parametrize(
    "missing", ["intrinsics", "rotation_camera_from_world", "translation_camera_from_world"]
)
def test_a_photo_without_all_of_it_is_not_oriented(missing: str) -> None:
    camera: Camera = replace(oriented(TRUE), status="too few ties", **{missing: None})
    with pytest.raises(ProductError, match=r"photo a.png is not oriented: too few ties"):
        camera.viewing()
