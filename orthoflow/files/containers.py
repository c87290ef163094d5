"""Look into photo files without decoding them: format, page, size, EXIF, profile, transparency.

Pillow reads the containers, simplejpeg (libjpeg-turbo) finds damage inside the scan data of a JPEG,
which other decoders fill with grey or noise.
"""

from __future__ import annotations

import io
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.rasterio_guard import let_go_of_foreign_text
from orthoflow.geometry.levels import Colours

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.TiffImagePlugin import ImageFileDirectory_v2
    from rasterio.io import DatasetReader

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
_PREVIEW, _MASK = 1, 4
_WIDTH_TAG, _HEIGHT_TAG, _BITS_TAG, _PHOTOMETRIC_TAG = 256, 257, 258, 262
# Grey, RGB, palette, CMYK (which GDAL turns into RGB) and YCbCr.
_WHITE_IS_ZERO, _PALETTE = 0, 3
_COLOURS_OF_TIFF: Final = (_WHITE_IS_ZERO, 1, 2, _PALETTE, 5, 6)
_SUB_IFDS_TAG: Final = 330
_DNG_TAG: Final = 50706
_COLOUR_FILTER_ARRAY, _LINEAR_RAW = 32803, 34892
_MAX_PAGES: Final = 200
# What libjpeg says of headers that cost no pixel; of anything else the rest of the photo is noise.
_HARMLESS: Final = ("jfif revision", "adobe color transform", "icc marker")
_EXTRA_BYTES: Final = "extraneous bytes before marker 0xd9"
_PADDING: Final = b"\0\xff"
_FEW_BYTES: Final = 8
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
    is_below = bool(pages) and _SUB_IFDS_TAG in pages[0][1]
    return "camera raw" if is_below and not any(_is_photo(page) for _, page in pages) else None


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


def _number(page: ImageFileDirectory_v2, tag: int) -> int:
    value = page.get(tag)
    first = value[0] if isinstance(value, tuple) and value else value
    return int(first) if isinstance(first, int) else 0


def _is_photo(page: ImageFileDirectory_v2) -> bool:
    return not _number(page, _SUBFILE_TAG) & (_PREVIEW | _MASK)


def photo_page(encoded: bytes) -> tuple[int, ImageFileDirectory_v2] | None:
    """Return the page of a TIFF file that holds the photo: the largest that is no preview."""
    pages = tiff_pages(encoded)
    return max(
        [item for item in pages if _is_photo(item[1])] or pages,
        key=lambda item: _number(item[1], _WIDTH_TAG) * _number(item[1], _HEIGHT_TAG),
        default=None,
    )


def count_pages(encoded: bytes) -> int:
    """Return how many pages of a TIFF file are no previews or masks; 1 for another format."""
    if encoded[:4] not in _TIFF_MAGICS:
        return 1
    return max(1, sum(_is_photo(page) for _, page in tiff_pages(encoded)))


def _from_page(encoded: bytes, start: int) -> bytes:
    """Return a TIFF file that begins with one of its pages: decoders take the first."""
    order: Literal["little", "big"] = "little" if encoded[:2] == b"II" else "big"
    place, size = (8, 8) if encoded[2:4] in (b"+\0", b"\0+") else (4, 4)
    return encoded[:place] + start.to_bytes(size, order) + encoded[place + size :]


@contextmanager
def _tiff_page(encoded: bytes, start: int) -> Iterator[DatasetReader]:
    """Open a page of a TIFF file by GDAL, which knows more layouts than OpenCV and Pillow.

    Raises:
        ValueError: it cannot be opened or read.
    """
    from rasterio.errors import RasterioError, RasterioIOError
    from rasterio.io import MemoryFile

    let_go_of_foreign_text()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            with (
                MemoryFile(_from_page(encoded, start)) as memory,
                memory.open(driver="GTiff") as page,
            ):
                yield page
        except (RasterioError, RasterioIOError) as error:
            raise ValueError(str(error.__cause__ or error)) from error


def tiff_pixels(encoded: bytes) -> Colours:
    """Decode the photo of a TIFF file, (rows, cols, 3) of 8 or 16 bits.

    Raises:
        ValueError: it is damaged, or of a kind that is no photo.
    """
    found = photo_page(encoded)
    if found is None:
        raise ValueError("it has no page that can be read")
    start, tags = found
    kind = tags.get(_PHOTOMETRIC_TAG)
    if kind not in _COLOURS_OF_TIFF:
        raise ValueError(f"its colours (photometric {kind}) are not read: save it as RGB")
    with _tiff_page(encoded, start) as page:
        if page.dtypes[0] not in ("uint8", "uint16"):
            raise ValueError(f"its samples are {page.dtypes[0]}: save it with 8 or 16 bits")
        bands: NDArray[Any] = page.read([1, 2, 3] if page.count > 2 else [1])
        most = (1 << min(_number(tags, _BITS_TAG) or 1, 16)) - 1
        if kind == _PALETTE:
            table = page.colormap(1)
            shades = [table.get(at, (0, 0, 0))[:3] for at in range(256)]
            return np.asarray(np.array(shades, dtype=np.uint8)[bands[0]])
    full = np.iinfo(bands.dtype).max
    if most < full:
        bands = (bands.astype(np.float32) * (full / most)).round().clip(0, full).astype(bands.dtype)
    if kind == _WHITE_IS_ZERO:
        bands = full - bands
    return np.ascontiguousarray(np.broadcast_to(np.moveaxis(bands, 0, 2), (*bands.shape[1:], 3)))


def _tiff_alpha(encoded: bytes) -> NDArray[np.bool_] | None:
    """Which pixels of a TIFF file are opaque, by its alpha or by a page that is a mask."""
    from rasterio.enums import ColorInterp

    found = photo_page(encoded)
    if found is None:
        return None
    start, photo = found
    size = [_number(photo, tag) for tag in (_WIDTH_TAG, _HEIGHT_TAG)]
    masks = [
        at
        for at, page in tiff_pages(encoded)
        if _number(page, _SUBFILE_TAG) & _MASK
        and [_number(page, tag) for tag in (_WIDTH_TAG, _HEIGHT_TAG)] == size
    ]
    opaque: NDArray[np.bool_] | None = None
    with _tiff_page(encoded, start) as page:
        if ColorInterp.alpha in page.colorinterp:
            alpha = page.read(page.colorinterp.index(ColorInterp.alpha) + 1)
            opaque = alpha > np.iinfo(alpha.dtype).max // 2
    for at in masks:
        with _tiff_page(encoded, at) as page:
            shown: NDArray[np.bool_] = page.read(1) > 0
        opaque = shown if opaque is None else opaque & shown
    return opaque


@contextmanager
def opened(encoded: bytes) -> Iterator[Image | None]:
    """Open a photo by Pillow, without decoding it; None where it cannot."""
    from PIL import Image

    found = photo_page(encoded) if encoded[:4] in _TIFF_MAGICS else None
    if photo_format(encoded) == "HEIC":
        _register_heic()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with _ANY_SIZE:
            # Pillow refuses less than `MOST_PIXELS`, which all who decode look at.
            most, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
            try:
                image = Image.open(
                    io.BytesIO(encoded if found is None else _from_page(encoded, found[0]))
                )
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
    opaque: NDArray[np.bool_] | None = None
    # Damage is found by whoever decodes the colours.
    if encoded[:4] in _TIFF_MAGICS:
        with suppress(ValueError):
            opaque = _tiff_alpha(encoded)
    else:
        with opened(encoded) as image, suppress(Exception):
            if image is not None and image.has_transparency_data:
                opaque = np.asarray(image.convert("RGBA").getchannel("A")) > 127
    return None if opaque is None or opaque.all() else opaque


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
        Of TIFF files nothing: `tiff_pixels` raises.
    """
    if encoded[:4] in _TIFF_MAGICS:
        return "", False
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
            if any(part in text.lower() for part in _HARMLESS):
                return "", False
            return text, not _is_padded(encoded, text)
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


def _is_padded(encoded: bytes, text: str) -> bool:
    """Whether libjpeg only passed over bytes between the scan and the end, as cameras write them.

    These are a few of any kind, or many of padding; where it took a part of the padding for
    pixels, that stands in the place of the scan.
    """
    if _EXTRA_BYTES not in text:
        return False
    passed_over = int(text.partition(_EXTRA_BYTES)[0].split()[-1])
    scan = encoded[: encoded.rfind(b"\xff\xd9")]
    n_padding = len(scan) - len(scan.rstrip(_PADDING))
    return abs(passed_over - n_padding) <= _FEW_BYTES
