"""Look into photo files without decoding them: format, wholeness, EXIF block, colour profile."""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Literal

from orthoflow.files.tiff_tags import read_directory

ImageFormat = Literal["JPEG", "PNG", "TIFF"]

_PNG_MAGIC: Final = b"\x89PNG\r\n\x1a\n"
_EXIF_MAGIC: Final = b"Exif\x00"
# In entropy-coded data FF 00 is a stuffed FF and FF D0..D7 are restarts; anything else is a marker.
_MARKER: Final = re.compile(rb"\xff([\x01-\xcf\xd8-\xfe])")
_END: Final = 0xD9
_SCAN: Final = 0xDA
_APP1: Final = 0xE1
_APP2: Final = 0xE2
_ICC_MAGIC: Final = b"ICC_PROFILE\x00"
# Start of frame, all kinds; between them lie tables.
_FRAMES: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_WIDTH_TAG: Final = 0x100
_HEIGHT_TAG: Final = 0x101
_BITS_TAG: Final = 0x102
_ICC_TAG: Final = 34675
# Profiles of cameras take some kilobytes; a packed one that grows beyond this is none.
_ICC_MOST: Final = 1 << 24
_WITHOUT_LENGTH: Final = frozenset({0x01, *range(0xD0, 0xD9)})


@dataclass(frozen=True, kw_only=True)
class _Segment:
    """A JPEG marker or a PNG chunk, and where its content lies; a JPEG scan has none."""

    kind: int | bytes
    start: int
    end: int


def image_format(encoded: bytes) -> ImageFormat | None:
    """Tell the format of a file by its first bytes; None for anything but JPEG, PNG and TIFF.

    >>> image_format(bytes.fromhex("ffd8ffe000104a464946"))
    'JPEG'
    """
    if encoded.startswith(b"\xff\xd8\xff"):
        return "JPEG"
    if encoded.startswith(_PNG_MAGIC):
        return "PNG"
    if encoded[:4] in (b"II*\x00", b"MM\x00*"):
        return "TIFF"
    return None


def is_webp(encoded: bytes) -> bool:
    """Whether a file begins as WebP, which figures are kept in; it has at most 16383 x 16383 px."""
    return encoded[:4] == b"RIFF" and encoded[8:12] == b"WEBP"


def stated_size(encoded: bytes) -> tuple[int, int] | None:
    """Width and height as a JPEG, PNG or TIFF file states them; None where it does not."""
    match image_format(encoded):
        case "PNG":
            chunk = next(_png_chunks(encoded), None)
            if chunk is not None and chunk.kind == b"IHDR" and chunk.end - chunk.start >= 8:
                return _two_numbers(encoded[chunk.start : chunk.start + 8])
        case "JPEG":
            for segment in _jpeg_segments(encoded):
                if segment.kind in _FRAMES and segment.end - segment.start >= 5:
                    height, width = _two_numbers(encoded[segment.start + 1 : segment.start + 5])
                    return width, height
        case "TIFF":
            main = read_directory(encoded, most_bytes=len(encoded))
            width_px, height_px = main.number(_WIDTH_TAG), main.number(_HEIGHT_TAG)
            if width_px is not None and height_px is not None:
                return int(width_px), int(height_px)
    return None


def stated_bits(encoded: bytes) -> int | None:
    """Bits per channel as a PNG or TIFF file states them; None where it does not."""
    match image_format(encoded):
        case "PNG":
            chunk = next(_png_chunks(encoded), None)
            if chunk is not None and chunk.kind == b"IHDR" and chunk.end - chunk.start >= 9:
                return encoded[chunk.start + 8]
        case "TIFF":
            bits = read_directory(encoded, most_bytes=len(encoded)).number(_BITS_TAG)
            return None if bits is None else int(bits)
    return None


def is_cut_off(encoded: bytes) -> bool:
    """Whether a JPEG or PNG file ends before its image does.

    Decoders fill the rest of a short JPEG with grey and say nothing, or refuse without a reason.
    Bytes after the end of the image (previews, video of phones) do no harm. The directories of a
    TIFF file may lie anywhere: its decoder finds out.
    """
    match image_format(encoded):
        case "JPEG":
            return not any(segment.kind == _END for segment in _jpeg_segments(encoded))
        case "PNG":
            return not any(segment.kind == b"IEND" for segment in _png_chunks(encoded))
        case _:
            return False


def exif_block(encoded: bytes) -> bytes | None:
    """Give the EXIF data of a file, which are laid out like a small TIFF file; None without any."""
    match image_format(encoded):
        case "TIFF":
            return encoded
        case "PNG":
            for segment in _png_chunks(encoded):
                if segment.kind == b"eXIf":
                    return encoded[segment.start : segment.end]
        case "JPEG":
            for segment in _jpeg_segments(encoded):
                if segment.kind == _SCAN:
                    break
                content = encoded[segment.start : segment.end]
                # Other data (XMP) travel in segments of the same kind.
                if segment.kind == _APP1 and content.startswith(_EXIF_MAGIC):
                    return content[len(_EXIF_MAGIC) + 1 :]
    return None


def icc_profile(encoded: bytes) -> bytes | None:
    """Give the ICC colour profile of a JPEG, PNG or TIFF file; None without a whole one.

    Layout as in ICC.1:2022, annex B: a JPEG may hold it in several numbered segments.
    """
    match image_format(encoded):
        case "TIFF":
            return read_directory(encoded, most_bytes=len(encoded)).content(_ICC_TAG)
        case "PNG":
            for segment in _png_chunks(encoded):
                if segment.kind == b"iCCP":
                    return _unpacked(encoded[segment.start : segment.end])
        case "JPEG":
            parts: dict[int, bytes] = {}
            count = 0
            for segment in _jpeg_segments(encoded):
                if segment.kind == _SCAN:
                    break
                content = encoded[segment.start : segment.end]
                if segment.kind == _APP2 and content.startswith(_ICC_MAGIC) and len(content) > 14:
                    number, count = content[12], content[13]
                    parts[number] = content[14:]
            if parts and sorted(parts) == list(range(1, count + 1)):
                return b"".join(parts[number] for number in sorted(parts))
    return None


def _unpacked(content: bytes) -> bytes | None:
    """Profile of a PNG chunk: a name, the method of compression, and the compressed profile."""
    _, _, packed = content.partition(b"\x00")
    unpacking = zlib.decompressobj()
    try:
        profile = unpacking.decompress(packed[1:], _ICC_MOST)
    except zlib.error:
        return None
    return profile if profile and unpacking.eof else None


def _two_numbers(content: bytes) -> tuple[int, int]:
    half = len(content) // 2
    return int.from_bytes(content[:half], "big"), int.from_bytes(content[half:], "big")


def _jpeg_segments(encoded: bytes) -> Iterator[_Segment]:
    """Walk from marker to marker; stops where the file breaks off."""
    position = 2
    while (found := _MARKER.search(encoded, position)) is not None:
        kind, position = found.group(1)[0], found.end()
        if kind in _WITHOUT_LENGTH:
            continue
        if kind == _END:
            yield _Segment(kind=kind, start=position, end=position)
            return
        length = int.from_bytes(encoded[position : position + 2], "big")
        if length < 2 or position + length > len(encoded):
            return
        yield _Segment(kind=kind, start=position + 2, end=position + length)
        position += length


def _png_chunks(encoded: bytes) -> Iterator[_Segment]:
    position = len(_PNG_MAGIC)
    while position + 12 <= len(encoded):
        length = int.from_bytes(encoded[position : position + 4], "big")
        start = position + 8
        if start + length + 4 > len(encoded):
            return
        yield _Segment(kind=encoded[position + 4 : start], start=start, end=start + length)
        position = start + length + 4
