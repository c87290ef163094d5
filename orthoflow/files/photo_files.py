"""Photo files: format, page, size, EXIF, colour profile, transparency, damage, and TIFF pixels.

Pillow reads the containers, GDAL the pages of TIFF files. simplejpeg (libjpeg-turbo) detects damage
in the scan data of a JPEG, which other decoders fill with grey or noise. EXIF tags are as in CIPA
DC-008 (Exif 2.32); a damaged EXIF block is read as far as possible, without an error.
"""

from __future__ import annotations

import io
import math
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from numbers import Real
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.geotiff import let_go_of_untrusted_text
from orthoflow.geometry.levels import Colours

if TYPE_CHECKING:
    from PIL.Image import Exif as PillowExif
    from PIL.Image import Image
    from PIL.TiffImagePlugin import ImageFileDirectory_v2
    from rasterio.io import DatasetReader

# Formats that can be decoded; HEIC and AVIF only if Pillow supports them.
READABLE: Final = frozenset({"JPEG", "PNG", "TIFF", "BigTIFF", "WebP", "HEIC", "AVIF"})
HOW_TO_DEVELOP: Final = "develop it first to 16-bit TIFF or JPEG, without lens corrections"
HOW_TO_READ_HEIC: Final = "install orthoflow-tls[heic], or convert it to JPEG at full size"
# As RGB, a photo of this size takes 800 MB; it has twice as many pixels as the largest sensors. A
# PNG of 100 kB can declare more.
#: pixels declared by a photo, before it is decoded
MOST_PIXELS: Final = 1 << 28

_PNG_MAGIC: Final = b"\x89PNG\r\n\x1a\n"
_TIFF_MAGICS: Final = {b"II*\0": "TIFF", b"MM\0*": "TIFF", b"II+\0": "BigTIFF", b"MM\0+": "BigTIFF"}
# First bytes of unsupported formats that may have a photo's suffix.
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
# Brands of ISO base media files that identify a format.
_HEIC_BRANDS: Final = frozenset({b"heic", b"heix", b"heim", b"heis", b"hevc", b"mif1", b"msf1"})
_AVIF_BRANDS: Final = frozenset({b"avif", b"avis"})

_SUBFILE_TAG: Final = 254
_PREVIEW, _MASK = 1, 4
_WIDTH_TAG, _HEIGHT_TAG, _BITS_TAG, _PHOTOMETRIC_TAG = 256, 257, 258, 262
# Values of the photometric interpretation: grey, RGB, palette, CMYK (which GDAL converts to RGB)
# and YCbCr.
_WHITE_IS_ZERO, _PALETTE = 0, 3
_COLOURS_OF_TIFF: Final = (_WHITE_IS_ZERO, 1, 2, _PALETTE, 5, 6)
_SUB_IFDS_TAG: Final = 330
_DNG_TAG: Final = 50706
_COLOUR_FILTER_ARRAY, _LINEAR_RAW = 32803, 34892
_MAX_PAGES: Final = 200
# libjpeg warnings about headers; these do not affect the pixels. After any other warning, the rest
# of the photo is noise.
_HARMLESS: Final = ("jfif revision", "adobe color transform", "icc marker")
_EXTRA_BYTES: Final = "extraneous bytes before marker 0xd9"
_PADDING: Final = b"\0\xff"
_FEW_BYTES: Final = 8
_ANY_SIZE: Final = threading.Lock()


def photo_format(encoded: bytes) -> str | None:
    """Return the format of a file from its content; None if it is unknown.

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


def unreadable(encoded: bytes) -> str:
    """Return the format of an unreadable file and how to convert it; empty for readable photos."""
    kind = photo_format(encoded)
    if kind is None:
        return (
            f"is not a JPEG, PNG, TIFF, WebP or HEIC file ({len(encoded)} bytes), despite its "
            "name: copy "
            "it again, or remove it"
        )
    if kind == "HEIC":
        with opened(encoded) as image:
            return "" if image is not None else f"is a HEIC file: {HOW_TO_READ_HEIC}"
    if kind in READABLE:
        return ""
    way_out = HOW_TO_DEVELOP if "raw" in kind else "convert it to JPEG or TIFF, at full size"
    return f"is {kind}, which is not supported: {way_out}"


def _media_format(encoded: bytes) -> str:
    end = min(max(int.from_bytes(encoded[:4], "big"), 16), 256)
    brands = {encoded[at : at + 4] for at in range(8, end, 4)}
    if b"crx " in brands:
        return "camera raw (Canon CR3)"
    if brands & _AVIF_BRANDS:
        return "AVIF"
    return "HEIC" if brands & _HEIC_BRANDS else "video (MP4 or MOV)"


def _raw_in_tiff(encoded: bytes) -> str | None:
    if encoded[8:10] == b"CR":
        return "camera raw (Canon CR2)"
    pages = tiff_pages(encoded)
    for _, page in pages:
        if _DNG_TAG in page:
            is_raw = page.get(_PHOTOMETRIC_TAG) in (_COLOUR_FILTER_ARRAY, _LINEAR_RAW)
            return "camera raw (DNG)" if is_raw or _SUB_IFDS_TAG in page else None
        if page.get(_PHOTOMETRIC_TAG) == _COLOUR_FILTER_ARRAY:
            return "camera raw"
    # In NEF, ARW and PEF files, the pages contain only previews; the image itself is in a sub-IFD.
    is_below = bool(pages) and _SUB_IFDS_TAG in pages[0][1]
    return "camera raw" if is_below and not any(_is_photo(page) for _, page in pages) else None


def tiff_pages(encoded: bytes) -> list[tuple[int, ImageFileDirectory_v2]]:
    """Return the directories of a TIFF file with their offsets, as far as they can be read."""
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
        except Exception:  # noqa: BLE001 - Pillow raises various errors for damaged tags
            return pages
    return pages


def _number(page: ImageFileDirectory_v2, tag: int) -> int:
    value = page.get(tag)
    first = value[0] if isinstance(value, tuple) and value else value
    return int(first) if isinstance(first, int) else 0


def _is_photo(page: ImageFileDirectory_v2) -> bool:
    return not _number(page, _SUBFILE_TAG) & (_PREVIEW | _MASK)


def photo_page(encoded: bytes) -> tuple[int, ImageFileDirectory_v2] | None:
    """Return the photo's page in a TIFF file: the largest page that is not a preview."""
    pages = tiff_pages(encoded)
    return max(
        [item for item in pages if _is_photo(item[1])] or pages,
        key=lambda item: _number(item[1], _WIDTH_TAG) * _number(item[1], _HEIGHT_TAG),
        default=None,
    )


def count_pages(encoded: bytes) -> int:
    """Return the number of pages of a TIFF file, except previews and masks; 1 for other formats."""
    if encoded[:4] not in _TIFF_MAGICS:
        return 1
    return max(1, sum(_is_photo(page) for _, page in tiff_pages(encoded)))


def _from_page(encoded: bytes, start: int) -> bytes:
    """Return a TIFF file that begins with a given page, because decoders read only the first."""
    order: Literal["little", "big"] = "little" if encoded[:2] == b"II" else "big"
    place, size = (8, 8) if encoded[2:4] in (b"+\0", b"\0+") else (4, 4)
    return encoded[:place] + start.to_bytes(size, order) + encoded[place + size :]


@contextmanager
def _tiff_page(encoded: bytes, start: int) -> Iterator[DatasetReader]:
    """Open a page of a TIFF file with GDAL, which supports more layouts than OpenCV and Pillow.

    Raises:
        ValueError: the page cannot be opened or read.
    """
    from rasterio.errors import RasterioError, RasterioIOError
    from rasterio.io import MemoryFile

    let_go_of_untrusted_text()
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
    """Decode the photo in a TIFF file to (rows, cols, 3) with 8 or 16 bits.

    Raises:
        ValueError: the file is damaged, or not a photo.
    """
    found = photo_page(encoded)
    if found is None:
        raise ValueError("it has no readable image")
    start, tags = found
    kind = tags.get(_PHOTOMETRIC_TAG)
    if kind not in _COLOURS_OF_TIFF:
        raise ValueError(f"its colours (photometric {kind}) are not supported: save it as RGB")
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
    """Return the opaque pixels of a TIFF file, from its alpha band, nodata value or mask page."""
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
        is_stated = ColorInterp.alpha in page.colorinterp
        # Some programs do not declare the meaning of the last of two or four bands. If all values
        # of this band are 0 or the maximum, it is an alpha band rather than, for example, infrared.
        band = page.colorinterp.index(ColorInterp.alpha) + 1 if is_stated else page.count
        if is_stated or (band in (2, 4) and page.dtypes[0] in ("uint8", "uint16")):
            alpha = page.read(band)
            full = np.iinfo(alpha.dtype).max
            if is_stated or np.isin(alpha, (0, full)).all():
                opaque = alpha > full // 2
        if opaque is None and page.nodata is not None:
            # This evaluates GDAL's nodata tag, which marks, for example, the margins of undistorted
            # photos.
            opaque = page.dataset_mask() > 0
    for at in masks:
        with _tiff_page(encoded, at) as page:
            shown: NDArray[np.bool_] = page.read(1) > 0
        opaque = shown if opaque is None else opaque & shown
    return opaque


@contextmanager
def opened(encoded: bytes) -> Iterator[Image | None]:
    """Open a photo with Pillow without decoding it; yield None if this fails."""
    from PIL import Image

    found = photo_page(encoded) if encoded[:4] in _TIFF_MAGICS else None
    if photo_format(encoded) == "HEIC":
        _register_heic()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with _ANY_SIZE:
            # Pillow's limit is below `MOST_PIXELS`, which all decoders here check.
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
    try:
        from pillow_heif import register_heif_opener
    except ImportError:
        return
    register_heif_opener()


def stated_size(encoded: bytes) -> tuple[int, int] | None:
    """Return width and height declared in a file, or None."""
    if encoded.startswith(_PNG_MAGIC):
        # The size is not read with Pillow, which refuses large files.
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
    """Return the bits per channel declared in a PNG or TIFF file, or None."""
    if encoded.startswith(_PNG_MAGIC):
        return encoded[24] if encoded[12:16] == b"IHDR" and len(encoded) > 24 else None
    if encoded[:4] in _TIFF_MAGICS:
        found = photo_page(encoded)
        return None if found is None else _number(found[1], _BITS_TAG) or None
    return None


def icc_profile(encoded: bytes) -> bytes | None:
    """Return the ICC colour profile of a photo; None if there is none or it is incomplete."""
    with opened(encoded) as image:
        found = None if image is None else image.info.get("icc_profile")
    return found if isinstance(found, bytes) and found else None


def opaque_pixels(encoded: bytes) -> NDArray[np.bool_] | None:
    """Return the pixels (height, width) that are not transparent; None if all are opaque."""
    opaque: NDArray[np.bool_] | None = None
    # Damage is reported when the colours are decoded.
    if encoded[:4] in _TIFF_MAGICS:
        with suppress(ValueError):
            opaque = _tiff_alpha(encoded)
    else:
        with opened(encoded) as image, suppress(Exception):
            if image is not None and image.has_transparency_data:
                opaque = np.asarray(image.convert("RGBA").getchannel("A")) > 127
    return None if opaque is None or opaque.all() else opaque


def is_whole_png(encoded: bytes) -> bool:
    """Return whether a PNG is complete; decoders allocate the declared sizes of its chunks."""
    position = len(_PNG_MAGIC)
    while position + 12 <= len(encoded):
        if encoded[position + 4 : position + 8] == b"IEND":
            return True
        position += 12 + int.from_bytes(encoded[position : position + 4], "big")
    return False


def damage(encoded: bytes) -> tuple[str, bool]:
    """Decode a photo; return a description of its damage, and whether pixels are lost.

    Returns:
        The description, empty for an intact file, and True if a part of the photo is missing or
        noise. The description is always empty for TIFF files; `tiff_pixels` raises an error for
        damaged ones.
    """
    if encoded[:4] in _TIFF_MAGICS:
        return "", False
    size = stated_size(encoded)
    if size is not None and size[0] * size[1] > MOST_PIXELS:
        # The photo is too large to be decoded, here or later.
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
            # simplejpeg does not support all kinds of subsampling; for the others, Pillow at least
            # detects truncation.
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
    """Return whether libjpeg only skipped bytes after the scan, which some cameras write.

    Some cameras write a few arbitrary bytes, or a long padding. If libjpeg decoded a part of the
    padding as pixels, however, a part of the scan is missing.
    """
    if _EXTRA_BYTES not in text:
        return False
    passed_over = int(text.partition(_EXTRA_BYTES)[0].split()[-1])
    scan = encoded[: encoded.rfind(b"\xff\xd9")]
    n_padding = len(scan) - len(scan.rstrip(_PADDING))
    return abs(passed_over - n_padding) <= _FEW_BYTES


# Minimum step between two blocks of a JPEG, in grey levels beyond the gradient on both sides, and
# minimum share of such steps in one direction along a row of blocks. None of 32 intact photos
# exceeds a share of 0.13; 20 of 23 photos with a visible flipped bit exceed 0.5.
_STEP_LEVELS: Final = 3
_SHIFTED_SHARE: Final = 0.4
_SHORTEST_SEAM: Final = 0.05
_FEWEST_PARTS: Final = 8
# If a larger share of rows has such steps, they belong to the image content.
_MOST_ROWS: Final = 0.05
_SEAM_PX: Final = 16


def shifted_row(encoded: bytes, rgb: NDArray[np.uint8]) -> int | None:
    """Return the first row of a JPEG with a colour shift due to damage; None if there is none.

    A flipped bit that decoders do not detect changes all subsequent blocks by the same amount.
    Therefore, the colours have a step along the upper edge of the blocks to the right of the
    flipped bit, and along the lower edge of the blocks to its left. Photographed objects are not
    aligned with the block grid in this way.

    Args:
        encoded: content of the file.
        rgb: (rows, cols, 3) decoded pixels.
    """
    if photo_format(encoded) != "JPEG":
        return None
    import simplejpeg

    try:
        sampling = simplejpeg.decode_jpeg_header(encoded, strict=False)[3]
    except (ValueError, KeyError):
        return None
    side = 16 if sampling in ("420", "440") else 8
    rows = np.arange(side, len(rgb) - 1, side)
    n_parts = rgb.shape[1] // _SEAM_PX
    ends = max(_FEWEST_PARTS, round(_SHORTEST_SEAM * n_parts))
    if len(rows) < 2 or n_parts <= 2 * ends:
        return None
    above2, above, below, below2 = (
        rgb[rows + k, : n_parts * _SEAM_PX].astype(np.int16) for k in (-2, -1, 0, 1)
    )
    beyond = 2 * (below - above) - (above - above2) - (below2 - below)
    ways = np.where(np.abs(beyond) >= 2 * _STEP_LEVELS, np.sign(beyond), 0)
    parts = ways.reshape(len(rows), n_parts, _SEAM_PX, 3).mean(axis=2)
    summed = np.cumsum(parts, axis=1)
    count = np.arange(1, n_parts + 1)[:, None]
    left = (summed / count)[1:, ends - 1 : n_parts - ends]
    right = ((summed[:, -1:] - summed) / np.maximum(n_parts - count, 1))[:-1]
    right = right[:, ends - 1 : n_parts - ends]
    share = np.maximum(np.minimum(left, right), np.minimum(-left, -right)).max(axis=(1, 2))
    n_shifted = np.count_nonzero(share >= _SHIFTED_SHARE)
    is_damage = 0 < n_shifted <= max(2.0, _MOST_ROWS * len(rows))
    return int(rows[share.argmax()]) if is_damage else None


# Diagonal of 36 x 24 mm. CIPA DCG-001 defines the 35 mm equivalent by an equal diagonal angle of
# view, and the tested cameras comply: a Redmi Note 9S (4.74 mm, sensor diagonal 8.0 mm) writes 26,
# where the diagonal gives 25.6 and the width 26.7; a Kodak C743 (6.0 mm, 7.18 mm) writes 36, where
# the diagonal gives 36.2 and the width 37.5. For an aspect ratio of 3:2, both are the same.
FULL_FRAME_DIAGONAL_MM: Final = math.hypot(36.0, 24.0)

_ORIENTATION: Final = 0x0112
# EXIF orientations are 1 to 8.
_ORIENTATIONS: Final = 9.0
_MAKE: Final = 0x010F
_MODEL: Final = 0x0110
_EXIF_DIRECTORY: Final = 0x8769
_FOCAL_LENGTH: Final = 0x920A
_WIDTH: Final = 0xA002
_HEIGHT: Final = 0xA003
_RESOLUTION_X: Final = 0xA20E
_RESOLUTION_Y: Final = 0xA20F
_RESOLUTION_UNIT: Final = 0xA210
_FOCAL_LENGTH_35MM: Final = 0xA405

_TAGS: Final = frozenset(
    {_ORIENTATION, _MAKE, _MODEL, _FOCAL_LENGTH, _FOCAL_LENGTH_35MM}
    | {_WIDTH, _HEIGHT, _RESOLUTION_X, _RESOLUTION_Y, _RESOLUTION_UNIT}
)
_MAX_TEXT: Final = 200
# Maximum length of an EXIF block.
_ZEROS_BEHIND: Final = 1 << 16
_UNIT_MM: Final = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_INCH: Final = 2
# Range of the longer side of sensors, from the smallest phones to large-format scanning backs.
_SENSOR_MM: Final = (1.5, 130.0)
# Range from fisheye to telephoto lenses, for any sensor; cameras without a value write 0, 1 or
# 65535.
_FOCAL_MM: Final = (0.5, 3000.0)
_EQUIVALENT_MM: Final = (4.0, 3000.0)
_CROPPED: Final = 0.02
_CONTRADICTION: Final = 1.15


@dataclass(frozen=True, kw_only=True)
class Exif:
    """The EXIF data of a photo; missing values are None or empty strings.

    Attributes:
        orientation: 1..8, rotation and reflection of the stored array for display.
        make: manufacturer of the camera.
        model: model of the camera.
        focal_mm: focal length in millimetres.
        focal_35mm: full-frame equivalent of the focal length in millimetres.
        resolution_px_per_mm: pixels of the original image per millimetre on the sensor.
        width: width in pixels of the original image, which may have been reduced afterwards.
        height: height in pixels of the original image.
        is_damaged: whether some of the data could not be read.
    """

    orientation: int = 1
    make: str = ""
    model: str = ""
    focal_mm: float | None = None
    focal_35mm: float | None = None
    resolution_px_per_mm: float | None = None
    width: int | None = None
    height: int | None = None
    is_damaged: bool = False

    @property
    def camera(self) -> str:
        """Manufacturer and model of the camera, with the manufacturer named only once."""
        first_word = self.make.partition(" ")[0].lower()
        is_repeated = bool(first_word) and self.model.lower().startswith(first_word)
        return self.model if is_repeated else f"{self.make} {self.model}".strip()


@dataclass(frozen=True, kw_only=True)
class FocalLength:
    """A focal length from EXIF.

    Attributes:
        value_px: focal length in pixels of the stored array, or None if unknown.
        reason: data from which the focal length was computed, or the reason why it is unknown.
        doubt: message about an impossible EXIF value, which is ignored; empty otherwise.
    """

    value_px: float | None
    reason: str
    doubt: str = ""


def read_exif(encoded: bytes) -> Exif:
    """Read the EXIF data of a photo; all fields are empty if there are none.

    EXIF data are not read from photos of more than `MOST_PIXELS` pixels, which are refused anyway:
    Pillow would decode a PNG file to find data after its pixels.
    """
    with opened(encoded) as image:
        if image is None or image.width * image.height > MOST_PIXELS:
            return Exif()
        found, is_damaged = _tags(image)
    orientation = _positive(found.get(_ORIENTATION)) or 1.0
    return Exif(
        orientation=int(orientation) if 1.0 <= orientation < _ORIENTATIONS else 1,
        make=_text(found.get(_MAKE)),
        model=_text(found.get(_MODEL)),
        focal_mm=_positive(found.get(_FOCAL_LENGTH)),
        focal_35mm=_positive(found.get(_FOCAL_LENGTH_35MM)),
        resolution_px_per_mm=_resolution(found),
        width=_whole(_positive(found.get(_WIDTH))),
        height=_whole(_positive(found.get(_HEIGHT))),
        is_damaged=is_damaged,
    )


def _tags(image: Image) -> tuple[Mapping[int, object], bool]:
    """Return the relevant tags, if readable, and whether the EXIF block is damaged."""
    block = image.info.get("exif")
    if not isinstance(block, bytes):
        return _readable_tags(image.getexif)
    found, is_damaged = _readable_tags(lambda: _loaded(block))
    if is_damaged:
        # Replace missing bytes by zeros, so that reading does not stop at the first bad tag.
        found = _readable_tags(lambda: _loaded(block + bytes(_ZEROS_BEHIND)))[0] | found
    return found, is_damaged


def _loaded(block: bytes) -> PillowExif:
    from PIL.Image import Exif as PillowExif

    exif = PillowExif()
    exif.load(block)
    return exif


def _readable_tags(read: Callable[[], PillowExif]) -> tuple[dict[int, object], bool]:
    """Return the tags of the main and Exif directories, and whether some could not be read."""
    tags: dict[int, object] = {}
    is_damaged = False
    with warnings.catch_warnings(record=True) as noticed:
        warnings.simplefilter("always")
        try:
            main = read()
            directories: list[Callable[[], Mapping[int, object]]] = [
                lambda: main,
                lambda: main.get_ifd(_EXIF_DIRECTORY),
            ]
            for directory in directories:
                content = directory()
                for tag in _TAGS & set(content):
                    tags[tag] = content[tag]
        except Exception:  # noqa: BLE001 - Pillow raises various errors for damaged tags
            is_damaged = True
    return tags, is_damaged or bool(noticed)


def focal_length(exif: Exif, width: int, height: int) -> FocalLength:
    """Return the focal length of a photo in pixels of its stored array.

    The pixel pitch in the focal plane has priority, since a correct pitch is exact; it is adapted
    if the image was reduced or rotated after it was taken. It is ignored if it contradicts the 35
    mm equivalent, which does not depend on the image size and refers to the diagonal (see
    `FULL_FRAME_DIAGONAL_MM`). Impossible values are reported and ignored.

    Args:
        exif: the EXIF data.
        width: width of the stored array in pixels.
        height: height of the stored array in pixels.
    """
    of_length = _doubt("focal length", exif.focal_mm, _FOCAL_MM)
    of_equivalent = _doubt("35 mm equivalent", exif.focal_35mm, _EQUIVALENT_MM)
    doubt = "; ".join(filter(None, (of_length, of_equivalent)))
    believed = replace(
        exif,
        focal_mm=None if of_length else exif.focal_mm,
        focal_35mm=None if of_equivalent else exif.focal_35mm,
    )
    found = _believed_focal_length(believed, width, height)
    reason = doubt if found.value_px is None and doubt else found.reason
    return FocalLength(value_px=found.value_px, reason=reason, doubt=doubt)


def _doubt(what: str, value_mm: float | None, possible_mm: tuple[float, float]) -> str:
    """Return the reason why a value is impossible; empty if it is possible or missing."""
    shortest, longest = possible_mm
    if value_mm is None or shortest <= value_mm <= longest:
        return ""
    limits = f"{shortest:g} to {longest:g} mm"
    return f"EXIF contains a {what} of {value_mm:g} mm, outside the possible range ({limits})"


def _believed_focal_length(exif: Exif, width: int, height: int) -> FocalLength:
    if exif.focal_mm is None and exif.focal_35mm is None:
        return FocalLength(value_px=None, reason="no EXIF focal length")
    if _is_cropped(exif, width, height):
        return FocalLength(
            value_px=None,
            reason=f"the photo was cropped after it was taken ({exif.width} x {exif.height} became "
            f"{width} x {height}), so its EXIF data no longer apply",
        )
    by_pitch = _by_pitch(exif, max(width, height))
    by_equivalent = (
        None
        if exif.focal_35mm is None
        else exif.focal_35mm / FULL_FRAME_DIAGONAL_MM * math.hypot(width, height)
    )
    ratio = 1.0 if by_pitch is None or by_equivalent is None else by_pitch / by_equivalent
    if by_pitch is not None and max(ratio, 1.0 / ratio) <= _CONTRADICTION:
        return FocalLength(value_px=by_pitch, reason="pixel pitch of the focal plane")
    if by_equivalent is not None:
        return FocalLength(value_px=by_equivalent, reason="35 mm equivalent over the diagonal")
    return FocalLength(
        value_px=None,
        reason=f"EXIF contains a focal length of {exif.focal_mm:g} mm, but neither the pixel pitch "
        "nor the 35 mm equivalent",
    )


def _positive(value: object) -> float | None:
    """Return the first number in a tag if it is finite and positive, else None."""
    if isinstance(value, bytes):
        value = tuple(value)
    first = value[0] if isinstance(value, tuple) and value else value
    number = float(first) if isinstance(first, Real) else math.nan
    return number if 0.0 < number < math.inf else None


def _text(value: object) -> str:
    """Return the text of a tag up to its first NUL; empty if missing, too long or a number."""
    if not isinstance(value, str) or len(value) >= _MAX_TEXT:
        return ""
    # Pillow decodes strings as Latin-1, but EXIF strings are ASCII.
    plain = value.encode("latin-1", "replace").decode("ascii", "replace")
    return plain.split("\0")[0].strip()


def _is_cropped(exif: Exif, width: int, height: int) -> bool:
    if exif.width is None or exif.height is None:
        return False
    taken = max(exif.width, exif.height) / min(exif.width, exif.height)
    stored = max(width, height) / min(width, height)
    # The tolerance includes a rounding error of one pixel, for strongly reduced images.
    return abs(taken / stored - 1.0) > _CROPPED + 1.0 / min(width, height)


def _by_pitch(exif: Exif, longest_px: int) -> float | None:
    if exif.focal_mm is None or exif.resolution_px_per_mm is None:
        return None
    taken_px = max(exif.width or 0, exif.height or 0) or longest_px
    smallest, largest = _SENSOR_MM
    if not smallest <= taken_px / exif.resolution_px_per_mm <= largest:
        return None
    return exif.focal_mm * exif.resolution_px_per_mm * longest_px / taken_px


def _whole(value: float | None) -> int | None:
    return int(value) if value is not None and value >= 1.0 else None


def _resolution(tags: Mapping[int, object]) -> float | None:
    """Return pixels per millimetre, averaged over both axes if both are present."""
    unit_mm = _UNIT_MM.get(int(_positive(tags.get(_RESOLUTION_UNIT)) or _INCH))
    known = [
        value
        for tag in (_RESOLUTION_X, _RESOLUTION_Y)
        if (value := _positive(tags.get(tag))) is not None
    ]
    if unit_mm is None or not known:
        return None
    return math.fsum(known) / len(known) / unit_mm
