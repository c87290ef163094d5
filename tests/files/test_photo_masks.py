"""What is masked of a photo hides what lies behind it."""

from __future__ import annotations

import numpy as np
import pytest

from orthoflow.files.images import before_masks, encode_png
from orthoflow.geometry.depth_buffer_kernels import DepthBuffer
from orthoflow.products import Photo


def photo(used: np.ndarray | None) -> Photo:
    mask = None if used is None else encode_png(np.where(used, np.uint8(255), np.uint8(0)))
    return Photo(name="a.jpg", encoded=b"", width=7, height=5, mask=mask)


@pytest.mark.parametrize("reduction", [1, 2, 3])
def test_a_masked_pixel_hides_the_pixel_of_the_buffer_that_it_lies_in(reduction: int) -> None:
    used = np.ones((5, 7), dtype=np.bool_)
    used[4, 6] = used[1, 2] = False
    shape = (-(-5 // reduction), -(-7 // reduction))
    nearest = np.full(shape, 3.0, dtype=np.float32)
    masked = before_masks(DepthBuffer(nearest=nearest, reduction=float(reduction)), photo(used))
    expected = nearest.copy()
    expected[4 // reduction, 6 // reduction] = expected[1 // reduction, 2 // reduction] = -np.inf
    np.testing.assert_array_equal(masked.nearest, expected)


def test_an_empty_world_gets_the_pixels_of_the_photo() -> None:
    used = np.ones((5, 7), dtype=np.bool_)
    used[:, :3] = False
    nothing = DepthBuffer(nearest=np.full((1, 1), np.inf, dtype=np.float32), reduction=7.0)
    masked = before_masks(nothing, photo(used))
    assert (masked.nearest[:, :3] == -np.inf).all()
    assert (masked.nearest[:, 3:] == np.inf).all()
