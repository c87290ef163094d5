"""Pictures as bytes: colours and their order, previews that fade at rims, and what is refused."""

from __future__ import annotations

import io
import math
import struct

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from orthoflow.errors import InputError
from orthoflow.files import images
from orthoflow.files.images import before_masks, encode_png
from orthoflow.geometry.depth_buffer_kernels import DepthBuffer
from orthoflow.products import Photo
from tests.photo_files import picture


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_colours_keep_their_order_in_a_png(channels: int) -> None:
    image = np.random.default_rng(1).integers(0, 256, (5, 7, channels), dtype=np.uint8)
    image = image[..., 0] if channels == 1 else image
    encoded = images.encode_png(image)
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(encoded))), image)
    rgb = np.dstack([image] * 3) if channels == 1 else image[..., :3]
    np.testing.assert_array_equal(images.decode_image(encoded), rgb)


def test_a_file_that_states_more_pixels_than_anyone_has_is_not_decoded() -> None:
    plain = images.encode_png(picture(8, 8))

    def stating(width: int, height: int) -> bytes:
        return plain[:16] + struct.pack(">II", width, height) + plain[24:]

    with pytest.raises(
        InputError, match=r"a\.png is too large: 16385 x 16384 pixels; the limit is"
    ):
        images.decode_image(stating(16_385, 16_384), "a.png")
    # As many as are decoded, but they are not in the file.
    with pytest.raises(InputError, match=r"a\.png cannot be decoded as an image \(\d+ bytes\)"):
        images.decode_image(stating(16_384, 16_384), "a.png")


def test_no_room_is_made_for_what_a_png_only_says_that_it_has(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    whole = images.encode_png(picture(16, 16))
    at = whole.index(b"IDAT") - 4
    monkeypatch.setattr("cv2.imdecode", lambda *_: pytest.fail("it was handed to the decoder"))
    for stated in (2**31 - 1, 3_332_046_943):
        hostile = whole[:at] + struct.pack(">I", stated) + whole[at + 4 :]
        with pytest.raises(InputError, match="expected a complete JPEG, PNG or TIFF file"):
            images.decode_image(hostile)


def test_the_first_percentile_is_black_and_the_last_one_white() -> None:
    values = np.append(np.arange(101.0), np.nan)
    grey = images.stretch_to_grey(values)
    assert grey[[0, 1, 50, 99, 100, 101]].tolist() == [0, 0, 128, 255, 255, 0]
    # Straight in between: 255 steps over 98.
    np.testing.assert_allclose(grey[1:100], 255.0 * np.arange(99) / 98.0, atol=0.51)


@pytest.mark.parametrize("band_px", [1, 5, 1000])
def test_a_very_large_one_is_averaged_band_by_band(
    monkeypatch: pytest.MonkeyPatch, band_px: int
) -> None:
    monkeypatch.setattr(images, "IN_MEMORY_PX", 1000)
    monkeypatch.setattr(images, "BAND_PX", band_px)
    # Squares of 4 pixels, the left half of each of them shown, what is not is black.
    shown = np.broadcast_to(np.arange(48) % 4 < 2, (64, 48))
    image = np.where(shown[..., None], picture(96, 128)[::2, ::2], 0).astype(np.uint8)
    asked = []

    def cells(part: images.Part) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        asked.append(part)
        return image[part], shown[part]

    # Squares of 64 / (2 * 16) pixels first: two, of which 32 rows are made.
    monkeypatch.setattr(images, "PREVIEW_SIDE_PX", 16)
    with Image.open(io.BytesIO(images.cells_png(shown.shape, cells))) as png:
        preview = np.asarray(png)
    assert preview.shape == (16, 12, 4)
    # The black that is not shown does not darken what is.
    np.testing.assert_array_equal(preview[..., :3], image[::4, ::4])
    assert np.isin(preview[..., 3], (127, 128)).all()
    assert len(asked) == math.ceil(32 / band_px)
    assert asked[0] == (slice(0, 2 * min(32, band_px)), slice(0, 48))


def test_levels_are_as_deep_as_the_file_and_in_the_order_of_colours() -> None:
    deep = np.random.default_rng(5).integers(0, 1 << 16, (6, 9, 3), dtype=np.uint16)
    for image in (deep, (deep >> 8).astype(np.uint8)):
        found = images.decode_levels(images.encode_png(image))
        np.testing.assert_array_equal(found, image)
        assert found.dtype == image.dtype


# What is masked of a photo hides what lies behind it


def photo(used: np.ndarray | None) -> Photo:
    mask = None if used is None else encode_png(np.where(used, np.uint8(255), np.uint8(0)))
    return Photo(name="a.jpg", encoded=b"", width=7, height=5, mask=mask)


@pytest.mark.parametrize("reduction", [1, 3])
def test_a_masked_pixel_hides_the_pixel_of_the_buffer_that_it_lies_in(reduction: int) -> None:
    used = np.ones((5, 7), dtype=np.bool_)
    used[4, 6] = used[1, 2] = False
    shape = (-(-5 // reduction), -(-7 // reduction))
    expected = np.full(shape, 3.0, dtype=np.float32)
    buffer = DepthBuffer(nearest=expected.copy(), reduction=float(reduction))
    expected[4 // reduction, 6 // reduction] = expected[1 // reduction, 2 // reduction] = -np.inf
    np.testing.assert_array_equal(before_masks(buffer, photo(used)).nearest, expected)


def test_an_empty_world_gets_the_pixels_of_the_photo() -> None:
    used = np.ones((5, 7), dtype=np.bool_)
    used[:, :3] = False
    nothing = DepthBuffer(nearest=np.full((1, 1), np.inf, dtype=np.float32), reduction=7.0)
    masked = before_masks(nothing, photo(used))
    assert (masked.nearest[:, :3] == -np.inf).all()
    assert (masked.nearest[:, 3:] == np.inf).all()
