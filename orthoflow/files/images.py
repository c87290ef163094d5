"""Encoding and decoding of photos and pictures, and small previews for the report.

Arrays are RGB; OpenCV's BGR is only used internally. The EXIF orientation is never applied: pixel
coordinates refer to the stored array.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError, MethodError, ProductError
from orthoflow.files.photo_files import (
    MOST_PIXELS,
    is_whole_png,
    opened,
    photo_format,
    stated_size,
    tiff_pixels,
    unreadable,
)
from orthoflow.geometry.cameras import HALF_PIXEL
from orthoflow.geometry.levels import Colours, eight_bits
from orthoflow.products import Photo

if TYPE_CHECKING:
    from orthoflow.geometry.depth_buffer_kernels import DepthBuffer

# Suffixes of photos that can be read; other files are not photos, or must be converted first.
PHOTO_SUFFIXES: Final = (
    *(".jpg", ".jpeg", ".jpe", ".jfif", ".mpo", ".png", ".tif", ".tiff"),
    *(".webp", ".heic", ".heif", ".hif", ".avif"),
)
# Suffixes of camera raw files.
RAW_SUFFIXES: Final = frozenset(
    {".3fr", ".arw", ".cr2", ".cr3", ".dng", ".iiq", ".nef"}
    | {".nrw", ".orf", ".pef", ".raf", ".raw", ".rw2", ".srw"}
)
PREVIEW_SIDE_PX: Final = 1600
# Images with more pixels are averaged before they are reduced, in bands of `BAND_PX` rows of the
# result.
IN_MEMORY_PX: Final = 1 << 26
BAND_PX: Final = 64
STRETCH_PERCENTILES: Final = (1.0, 99.0)

Shrunk = TypeVar("Shrunk", np.float32, np.uint8)
Sampled = TypeVar("Sampled", bound=np.generic)
Part = tuple[slice, slice]
# Function that returns a part of an image (rows, cols[, 3]), and its mask, True for cells with
# content.
Cells = Callable[[Part], tuple[NDArray[np.uint8], NDArray[np.bool_]]]


def decode_image(encoded: bytes, name: str = "image") -> NDArray[np.uint8]:
    """Decode a JPEG, PNG, TIFF or WebP file to 8-bit RGB (rows, cols, 3).

    Args:
        encoded: content of the file.
        name: name of the image in error messages.

    Raises:
        InputError: the data are not JPEG, PNG, TIFF or WebP, are incomplete, or have too many
            pixels.
    """
    return eight_bits(_decoded(encoded, name, is_deep=False))


def decode_levels(encoded: bytes, name: str = "image") -> Colours:
    """Decode like `decode_image`, but to uint16 if a PNG or TIFF has more than 8 bits per channel.

    Raises:
        InputError: the same conditions as for `decode_image`.
    """
    return _decoded(encoded, name, is_deep=True)


def _decoded(encoded: bytes, name: str, *, is_deep: bool) -> Colours:
    import cv2

    problem = unreadable(encoded)
    if problem:
        raise InputError(f"{name} {problem}")
    kind = photo_format(encoded)
    # OpenCV allocates memory for PNG chunks of any declared length.
    if kind == "PNG" and not is_whole_png(encoded):
        raise InputError(_not_an_image(encoded, name))
    size = stated_size(encoded)
    if size is not None and size[0] * size[1] > MOST_PIXELS:
        raise InputError(
            f"{name} is too large: {size[0]} x {size[1]} pixels; the limit is {MOST_PIXELS}; "
            "reduce it or cut it into parts"
        )
    try:
        if kind in ("TIFF", "BigTIFF"):
            return tiff_pixels(encoded)
        if kind in ("HEIC", "AVIF"):
            with opened(encoded) as image:
                decoded = None if image is None else np.asarray(image.convert("RGB"))
        else:
            depth = cv2.IMREAD_ANYDEPTH if is_deep else 0
            flags = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION | depth
            decoded = cv2.imdecode(np.frombuffer(encoded, dtype=np.uint8), flags)
    except Exception as error:  # cv2.error, or any error of a Pillow plugin
        reason = "" if kind in ("JPEG", "PNG", "WebP") else str(error)
        raise InputError(_not_an_image(encoded, name, reason)) from error
    if decoded is None:
        raise InputError(_not_an_image(encoded, name))
    return np.ascontiguousarray(decoded)


def encode_png(image: Colours) -> bytes:
    """Encode grey, RGB or RGBA (rows, cols[, 3 or 4]) as PNG with the same bit depth."""
    return _encode(".png", image, [])


def encode_pdf(image: Colours, *, dpi: int) -> bytes:
    """Encode a picture as a PDF with one page of the picture's size."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(eight_bits(image)).convert("RGB").save(stream, format="PDF", resolution=dpi)
    return stream.getvalue()


def encode_jpeg(image: NDArray[np.uint8], *, quality: int = 90) -> bytes:
    """Encode (rows, cols) grey or (rows, cols, 3) RGB as JPEG; quality 1..100."""
    import cv2

    return _encode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])


def encode_webp(image: NDArray[np.uint8], *, quality: int = 85) -> bytes:
    """Encode an image as lossy WebP, which for photos is a tenth of the size of PNG.

    Args:
        image: (rows, cols) grey, (rows, cols, 3) RGB or (rows, cols, 4) RGBA.
        quality: WebP quality, 1..100.
    """
    import cv2

    colour = np.dstack([image] * 3) if image.ndim == 2 else image
    return _encode(".webp", colour, [cv2.IMWRITE_WEBP_QUALITY, quality])


def cells_per_preview_px(shape: tuple[int, ...]) -> tuple[float, float]:
    """Return the numbers of raster rows and columns per pixel of a preview."""
    if max(shape) <= PREVIEW_SIDE_PX:
        return 1.0, 1.0
    factor = _averaged_px(shape, PREVIEW_SIDE_PX)
    rows, columns = shape[0] // factor, shape[1] // factor
    small = _shrunk_shape((rows, columns), PREVIEW_SIDE_PX)
    return factor * rows / small[0], factor * columns / small[1]


def stretch_to_grey(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return a grey picture of a raster, from black (1st percentile and NaN) to white (99th)."""
    return _stretched(values, _stretch_of(values))


def grey_cells(values: NDArray[np.floating]) -> Cells:
    """Return a function that computes parts of `stretch_to_grey`'s picture; NaN cells are empty.

    For a raster (rows, cols) of more than 64 million cells, percentiles are estimated from some of
    its rows.
    """
    stretch = _stretch_of(sampled_rows(values))
    return lambda part: (_stretched(values[part], stretch), np.isfinite(values[part]))


def sampled_rows(values: NDArray[Sampled]) -> NDArray[Sampled]:
    """Return evenly spaced rows of a raster, with at most 64 million cells in total."""
    return values[:: max(1, -(-values.size // IN_MEMORY_PX))]


def _stretch_of(values: NDArray[np.floating]) -> tuple[float, float] | None:
    """Return the value shown as black and its distance to white; None if there are no data."""
    known = values[np.isfinite(values)]
    if not known.size:
        return None
    low, high = np.percentile(known, STRETCH_PERCENTILES)
    return low, max(float(high - low), 1e-12)


def _stretched(
    values: NDArray[np.floating], stretch: tuple[float, float] | None
) -> NDArray[np.uint8]:
    if stretch is None:
        return np.zeros(values.shape, dtype=np.uint8)
    low, span = stretch
    scaled = (np.where(np.isfinite(values), values, low) - low) / span
    return np.rint(np.clip(scaled, 0.0, 1.0) * 255.0).astype(np.uint8)


def cells_png(shape: tuple[int, ...], cells: Cells) -> bytes:
    """Return a small PNG of a raster computed in parts, transparent where it is empty.

    A raster larger than `PREVIEW_SIDE_PX` is averaged down to this size.
    """
    return encode_png(_preview(shape, cells, PREVIEW_SIDE_PX))


def cells_webp(
    shape: tuple[int, ...], cells: Cells, *, longest_side_px: int, least_px: int = 0
) -> bytes:
    """Return the picture of `cells_png` as lossy WebP, with a given maximum side length.

    If the longer side has fewer than `least_px` cells, each cell becomes a square of pixels.
    """
    image = _preview(shape, cells, longest_side_px)
    factor = min(-(-least_px // max(shape)), longest_side_px // max(shape))
    return encode_webp(image.repeat(factor, axis=0).repeat(factor, axis=1) if factor > 1 else image)


def shrunk_webp(encoded: bytes, name: str, *, longest_side_px: int) -> bytes:
    """Return an encoded image as WebP, reduced to a maximum side length.

    Raises:
        InputError: the bytes are not an image.
    """
    image = decode_image(encoded, name)
    if max(image.shape[:2]) > longest_side_px:
        image = _shrink(image, longest_side_px)
    return encode_webp(image, quality=80)


def _preview(shape: tuple[int, ...], cells: Cells, longest_side_px: int) -> NDArray[np.uint8]:
    if max(shape) > longest_side_px:
        # Average only cells with content, so that black empty cells do not darken the border.
        summed, weight = _weighted(shape, cells, _averaged_px(shape, longest_side_px))
        summed = _shrink(summed, longest_side_px)
        weight = _shrink(weight, longest_side_px)
        colour = np.rint(summed / np.maximum(weight, 1e-6)[:, :, None]).astype(np.uint8)
    else:
        image, shown = cells((slice(None), slice(None)))
        colour = np.dstack([image] * 3) if image.ndim == 2 else image
        weight = shown.astype(np.float32)
    alpha = np.rint(weight * 255.0).astype(np.uint8)
    return np.dstack([colour, alpha])


def _weighted(
    shape: tuple[int, ...], cells: Cells, factor: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return weighted colours and weights, averaged over squares of `factor` pixels.

    The squares are averaged one band at a time, since a large image would not fit into memory as
    float32. Incomplete squares at the right and bottom are cut off.
    """
    import cv2

    rows, columns = (side // factor for side in shape)
    summed = np.empty((rows, columns, 3), dtype=np.float32)
    weight = np.empty((rows, columns), dtype=np.float32)
    step = rows if factor == 1 else BAND_PX
    for first in range(0, rows, step):
        last = min(rows, first + step)
        part = (slice(first * factor, last * factor), slice(0, columns * factor))
        image, shown = cells(part)
        seen = shown.astype(np.float32)
        colours = image if image.ndim == 3 else np.dstack([image] * 3)
        for values, into in ((colours * seen[:, :, None], summed), (seen, weight)):
            into[first:last] = (
                values
                if factor == 1
                else cv2.resize(values, (columns, last - first), interpolation=cv2.INTER_AREA)
            )
    return summed, weight


def _averaged_px(shape: tuple[int, ...], longest_side_px: int) -> int:
    """Return the side of the squares that are averaged before a picture is reduced."""
    return max(shape) // (2 * longest_side_px) if math.prod(shape) > IN_MEMORY_PX else 1


def _shrunk_shape(shape: tuple[int, ...], longest_side_px: int) -> tuple[int, int]:
    scale = longest_side_px / max(shape[:2])
    return max(1, round(shape[0] * scale)), max(1, round(shape[1] * scale))


def _shrink(values: NDArray[Shrunk], longest_side_px: int) -> NDArray[Shrunk]:
    import cv2

    rows, columns = _shrunk_shape(values.shape, longest_side_px)
    size = (columns, rows)
    small = cv2.resize(values, size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=values.dtype)


def _encode(suffix: str, image: Colours, options: list[int]) -> bytes:
    import cv2

    deepest = (np.uint8, np.uint16) if suffix == ".png" else (np.uint8,)
    if image.dtype not in deepest or not (
        image.ndim == 2 or (image.ndim == 3 and image.shape[2] in (3, 4))
    ):
        raise ProductError(
            f"an image to encode must be {' or '.join(level.__name__ for level in deepest)} of "
            f"shape (rows, cols[, 3 or 4]), got {image.dtype} of shape {image.shape}"
        )
    if image.ndim == 3:
        code = cv2.COLOR_RGBA2BGRA if image.shape[2] == 4 else cv2.COLOR_RGB2BGR
        image = np.asarray(cv2.cvtColor(np.ascontiguousarray(image), code), dtype=image.dtype)
    done, encoded = cv2.imencode(suffix, np.ascontiguousarray(image), options)
    if not done:
        raise ProductError(f"an image of shape {image.shape} could not be encoded as {suffix}")
    return encoded.tobytes()


def _not_an_image(encoded: bytes, name: str, reason: str = "") -> str:
    return (
        f"{name} cannot be decoded as an image ({len(encoded)} bytes"
        f"{f': {reason}' if reason else ''}): expected a complete JPEG, PNG or TIFF file; open it "
        "in an image viewer, or copy it again from the camera"
    )


# Masks are black and white; this threshold removes compression artefacts.
_USED_LEAST: Final = 128
_LONGEST_SIDE_PX: Final = 2048


def photo_rgb(photo: Photo) -> NDArray[np.uint8]:
    """Return a photo's colours (height, width, 3).

    Raises:
        InputError: the file is not an image.
        MethodError: the size of the image differs from that of the photo.
    """
    rgb = decode_image(photo.encoded, f"photo {photo.name}")
    if rgb.shape[:2] != (photo.height, photo.width):
        raise MethodError(
            f"photo {photo.name} has {rgb.shape[1]} x {rgb.shape[0]} pixels, but is listed with "
            f"{photo.width} x {photo.height}"
        )
    return rgb


def photo_grey(photo: Photo) -> NDArray[np.uint8]:
    """Return a photo's grey values (height, width; Rec. 601); raise the errors of `photo_rgb`."""
    import cv2

    return np.asarray(cv2.cvtColor(photo_rgb(photo), cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def reduced(grey: NDArray[np.uint8], factor: float) -> NDArray[np.uint8]:
    """Low-pass filter a picture and scale it by a factor below 1; (u, v) becomes factor * (u, v).

    The image is warped, because resizing would scale it by the ratio of rounded sizes.
    """
    import cv2

    if factor >= 1.0:
        return grey
    width, height = (max(1, int(side * factor)) for side in (grey.shape[1], grey.shape[0]))
    # The width of the Gaussian matches the resolution of the coarser grid.
    sigma = 0.5 * np.sqrt(max(0.0, factor**-2 - 1.0))
    soft = cv2.GaussianBlur(grey, (0, 0), sigma) if sigma > 0.1 else grey
    # In OpenCV's pixel convention, this is the centre of the first pixel of the reduced image.
    shift = HALF_PIXEL / factor - HALF_PIXEL
    matrix = np.array([[1.0 / factor, 0.0, shift], [0.0, 1.0 / factor, shift]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(
        cv2.warpAffine(soft, matrix, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE),
        dtype=np.uint8,
    )


def decode_mask(encoded: bytes, name: str) -> NDArray[np.bool_]:
    """Decode a black and white picture: (height, width) True for usable pixels.

    Raises:
        InputError: the bytes are not a picture.
    """
    return np.asarray(decode_image(encoded, name).max(axis=2) >= _USED_LEAST, dtype=np.bool_)


def used_pixels(photo: Photo) -> NDArray[np.bool_] | None:
    """Return the usable pixels (height, width) of a photo; None for all."""
    return None if photo.mask is None else decode_mask(photo.mask, f"the mask of {photo.name}")


def before_masks(buffer: DepthBuffer, photo: Photo) -> DepthBuffer:
    """Set the depth buffer to a surface directly in front of the lens where the photo is masked."""
    used = used_pixels(photo)
    if used is None:
        return buffer
    nearest, reduction = buffer.nearest, int(buffer.reduction)
    if nearest.shape == (1, 1):
        reduction = max(1, -(-max(used.shape) // _LONGEST_SIDE_PX))
        shape = [-(-side // reduction) for side in used.shape]
        nearest = np.full(shape, buffer.nearest[0, 0], dtype=np.float32)
    rows, columns = (np.arange(0, side, reduction) for side in used.shape)
    whole = np.logical_and.reduceat(np.logical_and.reduceat(used, rows, axis=0), columns, axis=1)
    # Minus infinity is nearer than any surface, even if the camera is within the buffer of a wall.
    nearest = np.where(whole, nearest, np.float32(-np.inf))
    return buffer._replace(nearest=np.ascontiguousarray(nearest), reduction=float(reduction))
