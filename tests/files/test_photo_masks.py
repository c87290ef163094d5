"""What is masked of a photo hides what lies behind it."""

from __future__ import annotations

import numpy as np
import pytest

from orthoflow.files.images import before_masks, decode_mask, encode_png
from orthoflow.geometry.depth_buffer_kernels import DepthBuffer
from orthoflow.products import Photo


def photo(used: np.ndarray | None) -> Photo:
    mask = None if used is None else encode_png(np.where(used, np.uint8(255), np.uint8(0)))
    return Photo(name="a.jpg", encoded=b"", width=7, height=5, mask=mask)


def test_without_a_mask_nothing_changes() -> None:
    buffer = DepthBuffer(nearest=np.ones((5, 7), dtype=np.float32), reduction=1.0)
    assert before_masks(buffer, photo(None)) is buffer


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


def test_what_is_as_light_as_grey_may_be_used() -> None:
    mask = np.array([[0, 127, 128, 255]], dtype=np.uint8)
    assert decode_mask(encode_png(mask), "a mask").tolist() == [[False, False, True, True]]
    # Of colours the brightest channel counts.
    coloured = np.array([[[0, 200, 0], [90, 90, 90]]], dtype=np.uint8)
    assert decode_mask(encode_png(coloured), "a mask").tolist() == [[True, False]]


@pytest.mark.parametrize(("width", "reduction"), [(2048, 1), (2049, 2), (4096, 2), (4097, 3)])
def test_an_empty_world_has_at_most_two_thousand_pixels_a_side(width: int, reduction: int) -> None:
    used = np.ones((3, width), dtype=np.bool_)
    used[0, -1] = False
    mask = encode_png(np.where(used, np.uint8(255), np.uint8(0)))
    wide = Photo(name="a.jpg", encoded=b"", width=width, height=3, mask=mask)
    nothing = DepthBuffer(nearest=np.full((1, 1), np.inf, dtype=np.float32), reduction=1e6)
    masked = before_masks(nothing, wide)
    assert masked.reduction == reduction
    assert masked.nearest.shape == (-(-3 // reduction), -(-width // reduction))
    assert np.argwhere(masked.nearest == -np.inf).tolist() == [[0, (width - 1) // reduction]]
