"""EXIF and file structure: what a camera wrote, whether a file is whole, focal length in pixels."""

from __future__ import annotations

import dataclasses
import math
import struct
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.files.images import decode_image, encode_jpeg, encode_png
from orthoflow.files.photo_files import Exif, focal_length, icc_profile, read_exif
from tests import photo_files as made

MAIN: dict[int, made.Value] = {
    made.ORIENTATION: 6,
    made.MAKE: "NIKON CORPORATION",
    made.MODEL: "NIKON D3X",
}
INNER: dict[int, made.Value] = {
    made.FOCAL: (285, 10),
    made.FOCAL_35MM: 43,
    made.WIDTH: 70_000,
    made.HEIGHT: 4032,
    made.RESOLUTION_X: (4000, 1),
    made.RESOLUTION_Y: (4000, 1),
    made.RESOLUTION_UNIT: 3,
}
DIAGONAL_MM = math.hypot(36.0, 24.0)


WHOLE = Exif(
    orientation=6,
    make="NIKON CORPORATION",
    model="NIKON D3X",
    focal_mm=28.5,
    focal_35mm=43.0,
    resolution_px_per_mm=400.0,
    width=70_000,
    height=4032,
)


@pytest.mark.parametrize("order", ["<", ">"], ids=["little-endian", "big-endian"])
@pytest.mark.parametrize("write", [made.jpeg, made.png])
def test_every_tag_comes_out_as_it_was_written(
    write: Callable[[NDArray[np.uint8], bytes], bytes], order: str
) -> None:
    exif = read_exif(write(made.picture(), made.exif_block(MAIN, INNER, order)))
    assert exif == WHOLE
    assert exif.camera == "NIKON D3X"


def test_a_photo_without_exif_says_nothing_and_a_damaged_block_what_is_left_of_it() -> None:
    for encoded in (encode_jpeg(made.picture()), encode_png(made.picture()), b"no image"):
        assert read_exif(encoded) == Exif()
    exif = read_exif(made.jpeg(made.picture(), made.exif_block(MAIN, INNER)[:-30]))
    assert exif.is_damaged
    assert (exif.orientation, exif.model) == (6, "NIKON D3X")
    # Notes of the maker that lie outside the block hide nothing else.
    block = made.exif_block(MAIN, INNER | {made.MAKER_NOTE: "notes of the maker"})
    at = block.index(b"notes of the maker")
    entry = struct.pack("<HHII", made.MAKER_NOTE, 2, 19, at)
    moved = block.replace(entry, struct.pack("<HHII", made.MAKER_NOTE, 7, 19, len(block) + 5))
    exif = read_exif(made.jpeg(made.picture(), moved))
    assert exif == dataclasses.replace(WHOLE, is_damaged=True)


@pytest.mark.parametrize(
    ("tag", "kind", "unit"),
    [(made.ORIENTATION, 5, 8), (made.ORIENTATION, 3, 2), (made.MAKE, 2, 1), (0x8773, 5, 8)],
    ids=["rationals", "shorts", "text", "profile"],
)
def test_a_tag_as_large_as_its_file_is_not_taken_apart(tag: int, kind: int, unit: int) -> None:
    # Pillow would make objects of them for a minute.
    count = 20_000_000 // unit
    head = b"II*\0" + struct.pack("<IHHHIII", 8, 1, tag, kind, count, 26, 0)
    started = time.process_time()
    assert read_exif(head + b"\1" * (count * unit)) == Exif()
    assert icc_profile(head + b"\1" * (count * unit)) is None
    assert time.process_time() - started < 20.0


def test_tags_that_share_the_bytes_of_a_file_take_no_more_memory_than_it() -> None:
    entries = b"".join(struct.pack("<HHII", tag, 7, 5_000_000, 8) for tag in range(1, 1000))
    file = b"II*\0" + struct.pack("<IH", 8, 999) + entries + bytes(4)
    tracemalloc.start()
    read_exif(file.ljust(5_000_100, b"\1"))
    icc_profile(file.ljust(5_000_100, b"\1"))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 30_000_000


# Focal length

# Made smaller after it was taken.
SMALL = Exif(focal_mm=50, resolution_px_per_mm=160, width=6000, height=4000)
BOTH = {"focal_mm": 50.0, "focal_35mm": 50.0}


@pytest.mark.parametrize(
    ("exif", "size", "expected_px", "rule"),
    [
        (Exif(focal_35mm=28), (1500, 1000), 28 / 36 * 1500, "35 mm"),
        (Exif(focal_35mm=28), (1000, 1500), 28 / 36 * 1500, "35 mm"),
        (Exif(focal_mm=4.74, focal_35mm=26), (4000, 3000), 26 / DIAGONAL_MM * 5000, "35 mm"),
        (Exif(focal_mm=50, resolution_px_per_mm=160), (6000, 4000), 8000.0, "pixel pitch"),
        (SMALL, (1500, 1000), 2000.0, "pixel pitch"),
        (SMALL, (1000, 1500), 2000.0, "pixel pitch"),
        # Pitches that do not fit the equivalent, or any sensor.
        (Exif(**BOTH, resolution_px_per_mm=160), (1500, 1000), 50 / 36 * 1500, "35 mm"),
        (Exif(**BOTH, resolution_px_per_mm=0.003), (1500, 1000), 50 / 36 * 1500, "35 mm"),
    ],
)
def test_the_focal_length_follows_the_stored_array(
    exif: Exif, size: tuple[int, int], expected_px: float, rule: str
) -> None:
    focal = focal_length(exif, *size)
    assert focal.value_px == pytest.approx(expected_px, rel=1e-12)
    assert rule in focal.reason


@pytest.mark.parametrize("said_mm", [0.01, 65535])
def test_a_focal_length_that_no_lens_has_is_not_multiplied_by_the_pitch(said_mm: float) -> None:
    focal = focal_length(Exif(focal_mm=said_mm, resolution_px_per_mm=160), 6000, 4000)
    assert focal.value_px is None
    assert (
        f"EXIF contains a focal length of {said_mm:g} mm, outside the possible range" in focal.doubt
    )
    both = Exif(focal_mm=said_mm, focal_35mm=28, resolution_px_per_mm=160)
    assert focal_length(both, 1500, 1000).value_px == pytest.approx(28 / 36 * 1500, rel=1e-12)


def test_real_photos_give_their_cameras(shared_data: Path) -> None:
    phone = read_exif((shared_data / "ceiling-808/808_db_photo.jpg").read_bytes())
    assert (phone.orientation, phone.camera) == (6, "Xiaomi Redmi Note 9S")
    assert focal_length(phone, 4000, 3000).value_px == pytest.approx(3004.6, abs=0.1)
    portrait = read_exif((shared_data / "cyprus-arch-photos/images/DSC_6471.JPG").read_bytes())
    assert (portrait.width, portrait.height) == (6048, 4032)
    assert focal_length(portrait, 1000, 1500).value_px == pytest.approx(1166.7, abs=0.1)


# Orientation


def test_no_format_is_turned_by_its_orientation() -> None:
    image = made.picture(24, 16)
    block = made.exif_block({made.ORIENTATION: 6})
    np.testing.assert_array_equal(decode_image(made.tiff(image, 6)), image)
    np.testing.assert_array_equal(decode_image(made.png(image, block)), image)
    plain = decode_image(encode_jpeg(image, quality=95))
    np.testing.assert_array_equal(decode_image(made.jpeg(image, block)), plain)


TAKEN = Exif(focal_mm=30.0, focal_35mm=43.3, resolution_px_per_mm=200.0, width=4000, height=3000)


def test_two_percent_of_another_shape_is_a_photo_that_was_cut() -> None:
    for size in ((4000, 3000), (2000, 1500), (3000, 4000), (4000, 2950), (3950, 3000), (40, 31)):
        # Of 40 x 31 pixels one more or less is rounding.
        assert focal_length(TAKEN, *size).value_px is not None
    for size in ((4000, 2900), (3900, 3000)):
        found = focal_length(TAKEN, *size)
        assert found.value_px is None
        assert found.reason.startswith("the photo was cropped")


def test_a_pitch_belongs_to_a_sensor_that_there_is() -> None:
    for sensor_mm, is_sensor in ((1.6, True), (1.4, False), (125.0, True), (135.0, False)):
        px_per_mm = 4000 / sensor_mm
        exif = dataclasses.replace(TAKEN, resolution_px_per_mm=px_per_mm, focal_35mm=None)
        found = focal_length(exif, 4000, 3000)
        assert (found.value_px is not None) is is_sensor
        assert is_sensor or "neither the pixel pitch nor the 35 mm equivalent" in found.reason
