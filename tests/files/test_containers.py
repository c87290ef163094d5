"""Colour profiles in photo files: whole ones are found, broken ones are none."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest
from orthoflow_plugins.ortho.photos_on_walls import shared_profile

from orthoflow.files.containers import icc_profile
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
