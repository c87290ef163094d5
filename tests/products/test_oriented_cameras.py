"""A photo's orientation as a camera that projects, and back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from orthoflow.errors import ProductError
from orthoflow.products import Camera, Intrinsics
from orthoflow.testing.photographed import camera_before, oriented, textured_wall

TRUE = camera_before(textured_wall(1))


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
