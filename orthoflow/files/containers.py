"""Look into photo files without decoding them: format, page, size, EXIF, profile, transparency.

Pillow reads the containers, simplejpeg (libjpeg-turbo) finds damage inside the scan data of a JPEG,
which other decoders fill with grey or noise.
"""

from __future__ import annotations

import io
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

# What can be decoded; HEIC and AVIF where Pillow can.
READABLE: Final = frozenset({"JPEG", "PNG", "TIFF", "BigTIFF", "WebP", "HEIC", "AVIF"})
HOW_TO_DEVELOP: Final = "develop to TIFF of 16 bits or JPEG first, without lens corrections"
HOW_TO_READ_HEIC: Final = "install orthoflow-tls[heic], or convert it to JPEG at full size"
# 800 MB as RGB: twice what the largest sensors have. A PNG of a hundred kilobytes can state more.
MOST_PIXELS: Final = 1 << 28

_PNG_MAGIC: Final = b"\x89PNG\r\n\x1a\n"
_TIFF_MAGICS: Final = {b"II*\0": "TIFF", b"MM\0*": "TIFF", b"II+\0": "BigTIFF", b"MM\0+": "BigTIFF"}
# First bytes of what is met under the name of a photo and is not read.
_MAGICS: Final[tuple[tuple[bytes, str], ...]] = (
    (b"GIF8", "GIF"),
    (b"BM", "BMP"),
    (b"%PDF", "PDF"),
    (b"8BPS", "Photoshop (PSD)"),
    (b"\xff\x0a", "JPEG XL"),
    (b"\0\0\0\x0cJXL ", "JPEG XL"),
    (b"\0\0\0\x0cjP  ", "JPEG 2000"),
    (b"\xff\x4f\xff\x51", "JPEG 2000"),
    (b"v/1\x01", "OpenEXR"),
    (b"FUJIFILMCCD-RAW", "camera raw (Fujifilm)"),
    (b"IIRO", "camera raw (Olympus)"),
    (b"IIRS", "camera raw (Olympus)"),
    (b"MMOR", "camera raw (Olympus)"),
    (b"IIU\0", "camera raw (Panasonic)"),
    (b"FOVb", "camera raw (Sigma)"),
    (b"\0MRM", "camera raw (Minolta)"),
)
# Of the ISO base media container: brands by format.
_HEIC_BRANDS: Final = frozenset({b"heic", b"heix", b"heim", b"heis", b"hevc", b"mif1", b"msf1"})
_AVIF_BRANDS: Final = frozenset({b"avif", b"avis"})

_SUBFILE_TAG: Final = 254
_WIDTH_TAG, _HEIGHT_TAG, _BITS_TAG, _PHOTOMETRIC_TAG, _ORIENTATION_TAG = 256, 257, 258, 262, 274
_SUB_IFDS_TAG: Final = 330
_DNG_TAG: Final = 50706
_COLOUR_FILTER_ARRAY, _LINEAR_RAW = 32803, 34892
_MAX_PAGES: Final = 200
# What libjpeg says of data that end, or whose codes make no sense; the rest of the photo is noise.
_LOST_DATA: Final = ("premature end", "bad huffman code", "invalid component", "corrupt")
_EXTRA_BYTES: Final = "extraneous bytes"
_ANY_SIZE: Final = threading.Lock()


def photo_format(encoded: bytes) -> str | None:
    """Return the format of a file by its content; None where nobody knows it.

    >>> photo_format(bytes.fromhex("ffd8ffe000104a464946"))
    'JPEG'
    """
    if encoded.startswith(b"\xff\xd8\xff"):
        return "JPEG"
    if encoded.startswith(_PNG_MAGIC):
        return "PNG"
    if encoded[:4] == b"RIFF" and encoded[8:12] == b"WEBP":
        return "WebP"
    if encoded[4:8] == b"ftyp":
        return _media_format(encoded)
    if encoded[:4] in _TIFF_MAGICS:
        return _raw_in_tiff(encoded) or _TIFF_MAGICS[encoded[:4]]
    return next((name for magic, name in _MAGICS if encoded.startswith(magic)), None)


def _media_format(encoded: bytes) -> str:
    end = min(max(int.from_bytes(encoded[:4], "big"), 16), 256)
    brands = {encoded[at : at + 4] for at in range(8, end, 4)}
    if b"crx " in brands:
        return "camera raw (Canon CR3)"
    if brands & _AVIF_BRANDS:
        return "AVIF"
    return "HEIC" if brands & _HEIC_BRANDS else "video (MP4 or MOV)"


def _raw_in_tiff(encoded: bytes) -> str | None:
    """The name of the camera raw that is laid out as TIFF, else None."""
    if encoded[8:10] == b"CR":
        return "camera raw (Canon CR2)"
    pages = tiff_pages(encoded)
    for _, page in pages:
        if _DNG_TAG in page:
            is_raw = page.get(_PHOTOMETRIC_TAG) in (_COLOUR_FILTER_ARRAY, _LINEAR_RAW)
            return "camera raw (DNG)" if is_raw or _SUB_IFDS_TAG in page else None
        if page.get(_PHOTOMETRIC_TAG) == _COLOUR_FILTER_ARRAY:
            return "camera raw"
    # NEF, ARW, PEF: only previews in the pages, the picture itself below them.
    if pages and all(_is_reduced(page) and _SUB_IFDS_TAG in page for _, page in pages[:1]):
        return None if any(not _is_reduced(page) for _, page in pages) else "camera raw"
    return None


def tiff_pages(encoded: bytes) -> list[tuple[int, ImageFileDirectory_v2]]:
    """Return the directories of a TIFF file with their positions, as far as they can be read."""
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    is_big = encoded[2:4] in (b"+\0", b"\0+")
    header = encoded[: 16 if is_big else 8]
    pages: list[tuple[int, ImageFileDirectory_v2]] = []
    source = io.BytesIO(encoded)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            start = ImageFileDirectory_v2(header).next
            while 0 < start < len(encoded) and len(pages) < _MAX_PAGES:
                if any(start == earlier for earlier, _ in pages):
                    break
                source.seek(start)
                page = ImageFileDirectory_v2(header)
                page.load(source)
                pages.append((start, page))
                start = page.next
        except Exception:  # noqa: BLE001 - Pillow raises whatever its parsing of damaged tags meets
            return pages
    return pages


def _is_reduced(page: ImageFileDirectory_v2) -> bool:
    kind = page.get(_SUBFILE_TAG)
    return isinstance(kind, int) and bool(kind & 1)


def _number(page: ImageFileDirectory_v2, tag: int) -> int:
    value = page.get(tag)
    first = value[0] if isinstance(value, tuple) and value else value
    return int(first) if isinstance(first, int) else 0


def photo_page(encoded: bytes) -> tuple[int, ImageFileDirectory_v2] | None:
    """Return the page of a TIFF file that holds the photo: the largest that is no preview."""
    pages = tiff_pages(encoded)
    whole = [item for item in pages if not _is_reduced(item[1])] or pages
    return max(
        whole,
        key=lambda item: _number(item[1], _WIDTH_TAG) * _number(item[1], _HEIGHT_TAG),
        default=None,
    )


def count_pages(encoded: bytes) -> int:
    """Return how many pages of a TIFF file are no previews; 1 for another format."""
    if encoded[:4] not in _TIFF_MAGICS:
        return 1
    return max(1, sum(not _is_reduced(page) for _, page in tiff_pages(encoded)))


def as_decoded(encoded: bytes, *, is_upright: bool = True) -> bytes:
    """Return a TIFF file that begins with the page of the photo; others as they are.

    Decoders take the first page, which may be a preview, and OpenCV and Pillow turn TIFF images by
    their orientation even when they are not asked to.

    Args:
        encoded: the file's bytes.
        is_upright: whether to set the orientation to 1, so that nobody turns it.
    """
    if encoded[:4] not in _TIFF_MAGICS:
        return encoded
    found = photo_page(encoded)
    if found is None:
        return encoded
    start, page = found
    order: Literal["little", "big"] = "little" if encoded[:2] == b"II" else "big"
    is_big = encoded[2:4] in (b"+\0", b"\0+")
    place, size = (8, 8) if is_big else (4, 4)
    changed = bytearray(encoded)
    changed[place : place + size] = start.to_bytes(size, order)
    if is_upright and _number(page, _ORIENTATION_TAG) > 1:
        _stand_upright(changed, start, order, is_big=is_big)
    return bytes(changed)


def _stand_upright(
    content: bytearray, start: int, order: Literal["little", "big"], *, is_big: bool
) -> None:
    """Set the orientation in the directory of a TIFF file to 1."""
    count_size, entry_size, value_at = (8, 20, 12) if is_big else (2, 12, 8)
    first = start + count_size
    last = first + entry_size * int.from_bytes(content[start:first], order)
    for entry in range(first, min(last, len(content) - entry_size + 1), entry_size):
        if int.from_bytes(content[entry : entry + 2], order) == _ORIENTATION_TAG:
            content[entry + value_at : entry + value_at + 2] = (1).to_bytes(2, order)
            return


@contextmanager
def opened(encoded: bytes, *, is_upright: bool = True) -> Iterator[Image | None]:
    """Open a photo by Pillow, without decoding it; None where it cannot. As for `as_decoded`."""
    from PIL import Image

    if photo_format(encoded) == "HEIC":
        _register_heic()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with _ANY_SIZE:
            # Pillow refuses less than `MOST_PIXELS`, which all who decode look at.
            most, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
            try:
                image = Image.open(io.BytesIO(as_decoded(encoded, is_upright=is_upright)))
            except Exception:  # noqa: BLE001 - Pillow's plugins raise anything on damaged files
                image = None
            finally:
                Image.MAX_IMAGE_PIXELS = most
        try:
            yield image
        finally:
            if image is not None:
                image.close()


def _register_heic() -> None:
    """Teach Pillow HEIC, where its plugin is installed."""
    try:
        from pillow_heif import register_heif_opener
    except ImportError:
        return
    register_heif_opener()


def stated_size(encoded: bytes) -> tuple[int, int] | None:
    """Return width and height as a file states them; None where it does not."""
    if encoded.startswith(_PNG_MAGIC):
        # Pillow refuses what is larger than it decodes.
        width, height = (int.from_bytes(encoded[at : at + 4], "big") for at in (16, 20))
        return (width, height) if encoded[12:16] == b"IHDR" else None
    if encoded[:4] in _TIFF_MAGICS:
        found = photo_page(encoded)
        if found is None:
            return None
        width, height = (_number(found[1], tag) for tag in (_WIDTH_TAG, _HEIGHT_TAG))
        return (width, height) if min(width, height) > 0 else None
    with opened(encoded) as image:
        return None if image is None else (image.width, image.height)


def stated_bits(encoded: bytes) -> int | None:
    """Return the bits per channel as a PNG or TIFF file states them; None where it does not."""
    if encoded.startswith(_PNG_MAGIC):
        return encoded[24] if encoded[12:16] == b"IHDR" and len(encoded) > 24 else None
    if encoded[:4] in _TIFF_MAGICS:
        found = photo_page(encoded)
        return None if found is None else _number(found[1], _BITS_TAG) or None
    return None


def icc_profile(encoded: bytes) -> bytes | None:
    """Return the ICC colour profile of a photo; None without a whole one."""
    with opened(encoded) as image:
        found = None if image is None else image.info.get("icc_profile")
    return found if isinstance(found, bytes) and found else None


def opaque_pixels(encoded: bytes) -> NDArray[np.bool_] | None:
    """Return which pixels (height, width) are not transparent; None where all are opaque."""
    with opened(encoded) as image:
        if image is None or not image.has_transparency_data:
            return None
        try:
            alpha = np.asarray(image.convert("RGBA").getchannel("A"))
        except Exception:  # noqa: BLE001 - damage is found by whoever decodes the colours
            return None
    opaque: NDArray[np.bool_] = alpha >= 128
    return None if opaque.all() else opaque


def is_whole_png(encoded: bytes) -> bool:
    """Whether the chunks of a PNG file lead to its end: decoders make room for what they state."""
    position = len(_PNG_MAGIC)
    while position + 12 <= len(encoded):
        if encoded[position + 4 : position + 8] == b"IEND":
            return True
        position += 12 + int.from_bytes(encoded[position : position + 4], "big")
    return False


def damage(encoded: bytes) -> tuple[str, bool]:
    """Decode a photo and return what is damaged in it, and whether pixels are lost by that.

    Returns:
        What was found, empty for a sound file; True where a part of the photo is missing or noise.
    """
    size = stated_size(encoded)
    if size is not None and size[0] * size[1] > MOST_PIXELS:
        # It is not decoded, here or later.
        return "", False
    if photo_format(encoded) == "JPEG":
        import simplejpeg

        try:
            _, _, colours, _ = simplejpeg.decode_jpeg_header(encoded, strict=False)
            space = "CMYK" if colours in ("CMYK", "YCCK") else "GRAY"
            smallest = {"min_height": 1, "min_width": 1, "min_factor": 8}
            simplejpeg.decode_jpeg(encoded, colorspace=space, **smallest)
        except ValueError as error:
            text = str(error)
            if _EXTRA_BYTES in text:
                return text, False
            # Others are oddities that cost nothing.
            is_lost = any(part in text.lower() for part in _LOST_DATA)
            return (text, True) if is_lost else ("", False)
        except KeyError:
            # It names the kinds of sub-sampling that it knows; Pillow sees truncation.
            pass
        else:
            return "", False
    found = ""
    with opened(encoded) as image:
        if image is None:
            found = "its header cannot be read"
        else:
            try:
                image.load()
            except Exception as error:  # noqa: BLE001 - Pillow's plugins raise anything
                found = str(error) or type(error).__name__
    return found, bool(found)
