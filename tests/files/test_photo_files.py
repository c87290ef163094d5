"""What a photo's file is and holds, read without decoding it: made by Pillow, OpenCV and others."""

from __future__ import annotations

import dataclasses
import io
import math
import struct
import time
import tracemalloc
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from PIL import Image
from rasterio.transform import Affine

from orthoflow.errors import InputError
from orthoflow.files.images import decode_image, encode_jpeg, encode_png
from orthoflow.files.photo_files import (
    Exif,
    count_pages,
    damage,
    focal_length,
    icc_profile,
    opaque_pixels,
    photo_format,
    read_exif,
    shifted_row,
    stated_size,
)
from tests import photo_files as made
from tests.optional import skip_unless

PICTURE = made.picture(128, 96)


def saved(kind: str, image: NDArray[np.uint8] | Image.Image = PICTURE, **options: object) -> bytes:
    """A file as Pillow writes it."""
    stream = io.BytesIO()
    picture = image if isinstance(image, Image.Image) else Image.fromarray(image)
    picture.save(stream, kind, **options)
    return stream.getvalue()


def pages(*images: NDArray[np.uint8], subfiles: tuple[int, ...], big: bool = False) -> bytes:
    """A TIFF file of several pages, with the kind of each (1: a preview)."""
    first, *others = (Image.fromarray(image) for image in images)
    for frame, subfile in zip(others, subfiles[1:], strict=True):
        frame.encoderinfo = {"tiffinfo": {254: subfile}}
    more = {"append_images": others, "tiffinfo": {254: subfiles[0]}, "big_tiff": big}
    return saved("TIFF", first, save_all=True, **more)


@pytest.mark.parametrize(
    ("encoded", "kind"),
    [
        (saved("JPEG"), "JPEG"),
        (saved("PNG"), "PNG"),
        (saved("TIFF"), "TIFF"),
        (saved("TIFF", big_tiff=True), "BigTIFF"),
        (saved("WEBP"), "WebP"),
        (saved("GIF"), "GIF"),
        (saved("BMP"), "BMP"),
        (saved("JPEG2000"), "JPEG 2000"),
        (b"\0\0\0\x1cftypheic\0\0\0\0mif1heic", "HEIC"),
        (b"\0\0\0\x1cftypmif1\0\0\0\0mif1heic", "HEIC"),
        (b"\0\0\0\x1cftypavif\0\0\0\0mif1avif", "AVIF"),
        (b"\0\0\0\x18ftypcrx \0\0\0\1crx isom", "camera raw (Canon CR3)"),
        (b"\0\0\0\x18ftypmp42\0\0\0\0mp42isom", "video (MP4 or MOV)"),
        (b"II*\0\x10\0\0\0CR\2\0", "camera raw (Canon CR2)"),
        (b"FUJIFILMCCD-RAW 0201", "camera raw (Fujifilm)"),
        (made.exif_block({254: 0, 256: 60, 257: 40, 262: 32803}), "camera raw"),
        (made.exif_block({254: 1, 256: 16, 257: 12, 262: 2, 330: 200}), "camera raw"),
        (made.exif_block({254: 0, 262: 32803, 50706: 1}), "camera raw (DNG)"),
        (b"%PDF-1.7", "PDF"),
        (b"<html>", None),
        (b"", None),
    ],
)
def test_a_format_is_known_by_its_content(encoded: bytes, kind: str | None) -> None:
    assert photo_format(encoded) == kind


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "TIFF", "WEBP"])
def test_size_profile_and_exif_are_read_of_every_format(kind: str) -> None:
    exif = Image.Exif()
    exif[made.MODEL], exif[made.ORIENTATION] = "X100", 6
    encoded = saved(kind, icc_profile=b"profile" * 20, exif=exif)
    assert stated_size(encoded) == (128, 96)
    assert icc_profile(encoded) == b"profile" * 20
    assert (read_exif(encoded).model, read_exif(encoded).orientation) == ("X100", 6)
    assert decode_image(encoded).shape == (96, 128, 3)


@pytest.mark.parametrize("big", [False, True], ids=["TIFF", "BigTIFF"])
@pytest.mark.parametrize(
    "order", [(1, 0), (0, 1), (1, 0, 1)], ids=["preview-first", "last", "both"]
)
def test_the_photo_of_a_tiff_is_its_largest_page_that_is_no_preview(
    order: tuple[int, ...], big: bool
) -> None:
    images = [np.ascontiguousarray(PICTURE[::8, ::8]) if kind else PICTURE for kind in order]
    encoded = pages(*images, subfiles=order, big=big)
    assert stated_size(encoded) == (128, 96)
    assert count_pages(encoded) == 1
    np.testing.assert_array_equal(decode_image(encoded), PICTURE)


@pytest.mark.parametrize("order", [(0, 4), (4, 0), (1, 4, 0)], ids=["last", "first", "preview"])
def test_a_page_of_a_tiff_that_is_a_mask_is_its_alpha(order: tuple[int, ...]) -> None:
    mask = np.full(PICTURE.shape[:2], 255, dtype=np.uint8)
    mask[:, 100:] = 0
    images = {0: PICTURE, 1: np.ascontiguousarray(PICTURE[::8, ::8]), 4: mask}
    encoded = pages(*(images[kind] for kind in order), subfiles=order)
    assert count_pages(encoded) == 1
    np.testing.assert_array_equal(decode_image(encoded), PICTURE)
    np.testing.assert_array_equal(opaque_pixels(encoded), mask > 0)


@pytest.mark.parametrize("mode", ["1", "L", "P", "CMYK"])
def test_the_colours_of_a_tiff_are_those_that_pillow_sees(mode: str) -> None:
    picture = Image.fromarray(PICTURE).convert(mode)
    expected = np.asarray(picture.convert("RGB")).astype(int)
    assert np.abs(decode_image(saved("TIFF", picture)) - expected).max() <= 1


def transparent(kind: str) -> bytes:
    """PICTURE with its left third transparent."""
    alpha = np.full(PICTURE.shape[:2], 255, dtype=np.uint8)
    alpha[:, :40] = 0
    if kind == "palette":
        image = Image.fromarray(np.where(alpha > 0, 7, 3).astype(np.uint8)).convert("P")
        return saved("PNG", image, transparency=3)
    if kind not in ("TIFF", "nodata"):
        return saved(kind, np.dstack([PICTURE, alpha]), lossless=True)
    bands = np.moveaxis(np.dstack([PICTURE, alpha]), -1, 0)
    options: dict[str, object] = {"photometric": "RGB", "alpha": "yes"}
    if kind == "nodata":
        bands, options = np.where(alpha > 0, np.maximum(bands[:3], 1), 0), {"nodata": 0}
    memory = rasterio.MemoryFile()
    count, height, width = bands.shape
    options |= {"count": count, "height": height, "width": width, "dtype": "uint8"}
    with memory.open(driver="GTiff", transform=Affine.scale(2, -2), **options) as out:
        out.write(bands.astype(np.uint8))
    return bytes(memory.getbuffer())


@pytest.mark.parametrize("kind", ["PNG", "TIFF", "nodata", "WEBP", "palette"])
def test_what_is_transparent_is_known_in_every_format(kind: str) -> None:
    opaque = opaque_pixels(transparent(kind))
    assert opaque is not None
    expected = np.ones((96, 128), dtype=np.bool_)
    expected[:, :40] = False
    np.testing.assert_array_equal(opaque, expected)


@pytest.mark.parametrize("is_alpha", [True, False])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_a_fourth_sample_of_a_tiff_that_is_off_or_full_is_its_alpha(
    kind: type[np.unsignedinteger], is_alpha: bool
) -> None:
    # OpenCV states nothing of it; infrared, that it is grey.
    full = np.iinfo(kind).max
    fourth = np.full(PICTURE.shape[:2], full, dtype=kind)
    fourth[:, :40] = 0 if is_alpha else full // 3
    image = np.dstack([PICTURE.astype(kind) * (full // 255), fourth])
    opaque = opaque_pixels(cv2.imencode(".tif", image)[1].tobytes())
    assert (opaque is not None) is is_alpha
    if opaque is not None:
        np.testing.assert_array_equal(opaque, fourth > 0)


PHOTO: NDArray[np.uint8] = np.asarray(
    cv2.GaussianBlur(
        np.random.default_rng(1).integers(0, 256, (400, 600, 3)).astype(np.uint8), (0, 0), 2
    ),
    dtype=np.uint8,
)


def jpeg(*options: int) -> bytes:
    return cv2.imencode(".jpg", PHOTO, list(options))[1].tobytes()


JPEGS = {
    "baseline": jpeg(),
    "progressive": jpeg(cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
    "restarts": jpeg(cv2.IMWRITE_JPEG_RST_INTERVAL, 4),
    "optimised": jpeg(cv2.IMWRITE_JPEG_OPTIMIZE, 1),
    "grey": encode_jpeg(PHOTO[..., 0]),
    "cmyk": saved("JPEG", Image.fromarray(PHOTO).convert("CMYK")),
}


@pytest.mark.parametrize("encoded", JPEGS.values(), ids=JPEGS)
def test_sound_photos_are_not_called_damaged(encoded: bytes) -> None:
    assert damage(encoded) == ("", False)
    # A phone's video may follow.
    assert not damage(encoded + b"video of a phone")[1]


def _replaced(encoded: bytes, content: bytes) -> bytes:
    at = len(encoded) // 2
    return encoded[:at] + content + encoded[at + len(content) :]


NOISE = np.random.default_rng(4).bytes(1500)
DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "cut": lambda encoded: encoded[: len(encoded) * 6 // 10],
    "cut with an end marker": lambda encoded: encoded[: len(encoded) * 6 // 10] + b"\xff\xd9",
    "zeros": lambda encoded: _replaced(encoded, bytes(2000)),
    "zeros to the end": lambda encoded: encoded[: len(encoded) // 2] + bytes(len(encoded) // 2),
    "ones": lambda encoded: _replaced(encoded, b"\xff" * 300),
    "noise": lambda encoded: _replaced(encoded, NOISE),
    "noise without markers": lambda encoded: _replaced(encoded, NOISE.replace(b"\xff", b"\x7f")),
    "a hole": lambda encoded: encoded[: len(encoded) // 2] + encoded[len(encoded) // 2 + 4096 :],
}


@pytest.mark.parametrize("harm", DAMAGES.values(), ids=DAMAGES)
@pytest.mark.parametrize("kind", JPEGS)
def test_damage_in_the_scan_of_a_jpeg_is_found(kind: str, harm: Callable[[bytes], bytes]) -> None:
    found, is_lost = damage(harm(JPEGS[kind]))
    assert found
    assert is_lost


def flipped(encoded: bytes, seed: int) -> bytes:
    """A JPEG with one bit of its scan flipped."""
    rng = np.random.default_rng(seed)
    at = int(rng.integers(encoded.rindex(b"\xff\xda") + 20, len(encoded) * 9 // 10))
    return encoded[:at] + bytes([encoded[at] ^ 1 << int(rng.integers(8))]) + encoded[at + 1 :]


def test_flipped_bits_that_no_decoder_notices_shift_what_is_behind_them() -> None:
    found = []
    for kind in ("baseline", "optimised", "grey", "cmyk"):
        whole = decode_image(JPEGS[kind])
        assert shifted_row(JPEGS[kind], whole) is None
        for encoded in (flipped(JPEGS[kind], seed) for seed in range(15)):
            image = decode_image(encoded) if not damage(encoded)[0] else whole
            is_off = (np.abs(image.astype(int) - whole) > 12).any(axis=2)
            if is_off.mean() > 0.02:
                row = shifted_row(encoded, image)
                found.append(row is not None and abs(row - np.argmax(is_off.any(axis=1))) <= 32)
    assert len(found) >= 6
    assert np.mean(found) >= 0.8


@skip_unless(find_spec("pillow_heif") is not None, "program", "pillow_heif")
def test_heic_is_read_by_its_plugin_or_named_with_the_way_out(tmp_path: Path) -> None:
    heif = import_module("pillow_heif")
    stream = io.BytesIO()
    heif.from_pillow(Image.fromarray(PHOTO)).save(stream, quality=95)
    encoded = stream.getvalue()
    assert photo_format(encoded) == "HEIC"
    assert stated_size(encoded) == (600, 400)
    assert np.abs(decode_image(encoded).astype(int) - PHOTO).mean() < 6.0
    with pytest.raises(InputError, match=r"is a HEIC file.*orthoflow-tls\[heic\]"):
        decode_image(encoded[:40], "IMG_1.heic")


# EXIF ---------------------------------------------------------------------------------------------


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
