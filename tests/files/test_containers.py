"""Colour profiles in photo files: whole ones are found, broken ones are none."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest
from orthoflow_plugins.ortho.photos_on_walls import shared_profile

from orthoflow.files.containers import icc_profile, is_webp, stated_bits, stated_size
from orthoflow.files.images import encode_jpeg, encode_png
from orthoflow.products import Photo
from orthoflow.sdk import StepContext

PROFILE = bytes(range(256)) * 700
GREY = np.full((8, 8, 3), 90, dtype=np.uint8)


def jpeg_with(parts: list[tuple[int, int, bytes]]) -> bytes:
    """A JPEG with profile segments given by number, count and content."""
    plain = encode_jpeg(GREY)
    segments = b""
    for number, count, part in parts:
        content = b"ICC_PROFILE\x00" + bytes([number, count]) + part
        segments += b"\xff\xe2" + (len(content) + 2).to_bytes(2, "big") + content
    return plain[:2] + segments + plain[2:]


def png_with(packed: bytes) -> bytes:
    plain = encode_png(GREY)
    content = b"name\x00\x00" + packed
    chunk = b"iCCP" + content
    # The header is 8 + 25 bytes.
    full = len(content).to_bytes(4, "big") + chunk + zlib.crc32(chunk).to_bytes(4, "big")
    return plain[:33] + full + plain[33:]


def test_a_profile_is_found_whole_in_any_order_of_its_segments() -> None:
    parts = [PROFILE[:60_000], PROFILE[60_000:120_000], PROFILE[120_000:]]
    numbered = [(k + 1, 3, part) for k, part in enumerate(parts)]
    assert icc_profile(jpeg_with([numbered[2], numbered[0], numbered[1]])) == PROFILE
    assert icc_profile(png_with(zlib.compress(PROFILE))) == PROFILE


def tiff_with(order: str, place: int | None = None) -> bytes:
    """The head of a TIFF file whose only tag is a profile after its directory."""
    mark, place = {"<": b"II*\x00", ">": b"MM\x00*"}[order], 26 if place is None else place
    directory = struct.pack(order + "HHHIII", 1, 34675, 7, len(PROFILE), place, 0)
    return mark + struct.pack(order + "I", 8) + directory + PROFILE


@pytest.mark.parametrize("order", ["<", ">"], ids=["little-endian", "big-endian"])
def test_the_profile_of_a_tiff_file_is_found(order: str) -> None:
    assert icc_profile(tiff_with(order)) == PROFILE
    assert icc_profile(tiff_with(order)[:-1]) is None
    assert icc_profile(tiff_with(order)[:15]) is None
    assert icc_profile(tiff_with(order, place=1 << 30)) is None


@pytest.mark.parametrize(
    "encoded",
    [
        encode_jpeg(GREY),
        encode_png(GREY),
        jpeg_with([(1, 2, b"half")]),
        jpeg_with([(2, 2, b"half")]),
        png_with(zlib.compress(PROFILE)[:-20]),
        png_with(b"no zlib"),
        png_with(zlib.compress(bytes(1 << 25))),
        b"something else",
    ],
    ids=["jpeg", "png", "second half", "first half", "cut", "unpacked", "bomb", "no image"],
)
def test_what_is_no_whole_profile_is_none(encoded: bytes) -> None:
    assert icc_profile(encoded) is None


def test_photos_of_different_profiles_share_none_and_that_is_said(tmp_path) -> None:
    def photo(name: str, encoded: bytes) -> Photo:
        return Photo(name=name, encoded=encoded, width=8, height=8)

    one, other = (photo(name, jpeg_with([(1, 1, name.encode())])) for name in ("a", "b"))
    ctx = StepContext(rng=np.random.default_rng(1), cores=1, scratch=tmp_path)
    assert shared_profile([one, one], ctx) == b"a"
    assert shared_profile([photo("c", encode_jpeg(GREY))], ctx) is None
    assert not ctx.warnings
    assert shared_profile([one, other], ctx) is None
    assert any("2 different colour profiles" in warning for warning in ctx.warnings)


def png_of(side: int = 8, *, header: bytes | None = None) -> bytes:
    """A PNG file, with another header chunk where one is given."""
    plain = encode_png(np.zeros((side, 2 * side, 3), dtype=np.uint8))
    if header is None:
        return plain
    chunk = b"IHDR" + header
    return plain[:8] + struct.pack(">I", len(header)) + chunk + bytes(4) + plain[33:]


def tiff_of(tags: dict[int, int]) -> bytes:
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items())
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(4)


def jpeg_of(*segments: tuple[int, bytes]) -> bytes:
    parts = (
        bytes([0xFF, kind]) + struct.pack(">H", len(content) + 2) + content
        for kind, content in segments
    )
    return b"\xff\xd8" + b"".join(parts) + b"\xff\xd9"


FRAME = b"\x08" + struct.pack(">HH", 300, 400) + b"\x01"


@pytest.mark.parametrize(
    ("encoded", "size"),
    [
        (png_of(8), (16, 8)),
        (png_of(header=struct.pack(">II", 70_000, 3)), (70_000, 3)),
        (png_of(header=b"\0" * 7), None),
        (png_of().replace(b"IHDR", b"IHDX"), None),
        (tiff_of({0x100: 70_000, 0x101: 3}), (70_000, 3)),
        (tiff_of({0x100: 70_000}), None),
        (tiff_of({0x101: 3}), None),
        (jpeg_of((0xE0, b"JFIF"), (0xC0, FRAME)), (400, 300)),
        (jpeg_of((0xE0, b"JFIF"), (0xCF, FRAME)), (400, 300)),
        # Tables and arithmetic conditioning stand between the frames' numbers.
        *((jpeg_of((kind, FRAME), (0xC2, b"\x08\0\1\0\2")), (2, 1)) for kind in (0xC4, 0xC8, 0xCC)),
        (jpeg_of((0xD9, b"")), None),
        (jpeg_of((0xBF, FRAME)), None),
        (jpeg_of((0xC0, FRAME[:4])), None),
        (b"BM" + bytes(60), None),
    ],
)
def test_a_size_is_what_the_file_states(encoded: bytes, size: tuple[int, int] | None) -> None:
    assert stated_size(encoded) == size


@pytest.mark.parametrize(
    ("encoded", "bits"),
    [
        (png_of(), 8),
        (png_of(header=struct.pack(">IIB", 4, 4, 16)), 16),
        (png_of(header=struct.pack(">II", 4, 4)), None),
        (tiff_of({0x102: 16}), 16),
        (tiff_of({0x100: 16}), None),
        (jpeg_of((0xC0, FRAME)), None),
        (b"", None),
    ],
)
def test_bits_per_channel_are_what_the_file_states(encoded: bytes, bits: int | None) -> None:
    assert stated_bits(encoded) == bits


def test_a_figures_format_is_told_by_its_first_bytes() -> None:
    assert is_webp(b"RIFF\x10\0\0\0WEBPVP8 ")
    assert not is_webp(b"RIFF\x10\0\0\0WAVEfmt ")
    assert not is_webp(b"RIFX\x10\0\0\0WEBPVP8 ")


@pytest.mark.parametrize("kind", [0x01, *range(0xD0, 0xD8)])
def test_markers_without_a_length_are_stepped_over(kind: int) -> None:
    encoded = b"\xff\xd8" + bytes([0xFF, kind]) + jpeg_of((0xC0, FRAME))[2:]
    assert stated_size(encoded) == (400, 300)


def test_a_profile_behind_the_start_of_the_scan_is_none() -> None:
    profile = b"ICC_PROFILE\x00\x01\x01" + PROFILE[:100]
    assert icc_profile(jpeg_of((0xE2, profile), (0xDA, b""))) == PROFILE[:100]
    assert icc_profile(jpeg_of((0xDA, b""), (0xE2, profile))) is None
    assert icc_profile(jpeg_of((0xE1, profile))) is None
    assert icc_profile(jpeg_of((0xE2, profile[:14]))) is None
