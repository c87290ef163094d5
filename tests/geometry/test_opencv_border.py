"""OpenCV's pixel convention: half a pixel, once, at its border."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from orthoflow.geometry.cameras import HALF_PIXEL, from_opencv, opencv_matrix, to_opencv
from orthoflow.products import Intrinsics

LENS = Intrinsics(width=900, height=640, fx=840.0, fy=843.0, cx=455.2, cy=316.4)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_first_pixels_centre_is_opencvs_origin(dtype: type[np.floating]) -> None:
    ours = np.array([[HALF_PIXEL, HALF_PIXEL], [3.25, 700.75]], dtype=dtype)
    theirs = to_opencv(ours)
    np.testing.assert_array_equal(theirs, np.array([[0.0, 0.0], [2.75, 700.25]], dtype=dtype))
    assert theirs.dtype == dtype
    back = from_opencv(theirs)
    np.testing.assert_array_equal(back, ours)
    assert back.dtype == dtype


def test_the_camera_matrix_projects_as_ours_does() -> None:
    matrix = opencv_matrix(LENS.posed())
    np.testing.assert_array_equal(
        matrix, [[840.0, 0.0, 454.7], [0.0, 843.0, 315.9], [0.0, 0.0, 1.0]]
    )
    assert matrix.dtype == np.float64
    points = np.random.default_rng(2).uniform([-1, -1, 2], [1, 1, 5], (50, 3))
    projected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, None)
    slopes = points[:, :2] / points[:, 2:]
    expected = slopes * [LENS.fx, LENS.fy] + [LENS.cx, LENS.cy]
    np.testing.assert_allclose(from_opencv(projected[:, 0]), expected, atol=1e-9)  # pixels
