"""Photo files made by hand: images with EXIF blocks of any content, and their pieces."""

from __future__ import annotations

import io
import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from orthoflow.files.images import encode_jpeg

ORIENTATION, MAKE, MODEL = 0x0112, 0x010F, 0x0110
FOCAL, FOCAL_35MM, MAKER_NOTE = 0x920A, 0xA405, 0x927C
WIDTH, HEIGHT = 0xA002, 0xA003
RESOLUTION_X, RESOLUTION_Y, RESOLUTION_UNIT = 0xA20E, 0xA20F, 0xA210

Value = int | str | tuple[int, int]


def picture(width: int = 64, height: int = 48, seed: int = 0) -> NDArray[np.uint8]:
    """Blocks of 8 pixels in random colours: JPEG keeps them."""
    colours = np.random.default_rng(seed).integers(0, 256, (-(-height // 8), -(-width // 8), 3))
    return np.repeat(np.repeat(colours, 8, axis=0), 8, axis=1)[:height, :width].astype(np.uint8)


def exif_block(
    main: Mapping[int, Value], inner: Mapping[int, Value] | None = None, order: str = "<"
) -> bytes:
    """EXIF data: a main directory and, behind it, the one for what the camera did."""
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8)
    if inner is None:
        return head + _directory(main, 8, order)
    length = len(_directory({**main, 0x8769: 0}, 8, order))
    return (
        head
        + _directory({**main, 0x8769: 8 + length}, 8, order)
        + _directory(inner, 8 + length, order)
    )


def _directory(values: Mapping[int, Value], start: int, order: str) -> bytes:
    entries, heap = b"", b""
    heap_start = start + 2 + 12 * len(values) + 4
    for tag, value in sorted(values.items()):
        kind, count, raw = _encoded(value, order)
        if len(raw) > 4:
            entries += struct.pack(order + "HHII", tag, kind, count, heap_start + len(heap))
            heap += raw
        else:
            entries += struct.pack(order + "HHI", tag, kind, count) + raw.ljust(4, b"\0")
    return struct.pack(order + "H", len(values)) + entries + struct.pack(order + "I", 0) + heap


def _encoded(value: Value, order: str) -> tuple[int, int, bytes]:
    if isinstance(value, str):
        raw = value.encode() + b"\0"
        return 2, len(raw), raw
    if isinstance(value, tuple):
        return 5, 1, struct.pack(order + "II", *value)
    if value < 1 << 16:
        return 3, 1, struct.pack(order + "H", value)
    return 4, 1, struct.pack(order + "I", value)


def jpeg(image: NDArray[np.uint8], exif: bytes | None = None) -> bytes:
    """A JPEG file, with an EXIF segment behind one of another kind."""
    encoded = encode_jpeg(image, quality=95)
    if exif is None:
        return encoded
    return (
        encoded[:2]
        + _app1(b"http://ns.adobe.com/xap/1.0/\0<x/>")
        + _app1(b"Exif\0\0" + exif)
        + (encoded[2:])
    )


def _app1(content: bytes) -> bytes:
    return b"\xff\xe1" + struct.pack(">H", len(content) + 2) + content


def png(image: NDArray[np.uint8], exif: bytes) -> bytes:
    """A PNG file with an EXIF chunk."""
    return _saved(image, "PNG", exif=exif)


def tiff(image: NDArray[np.uint8], orientation: int = 1, **more: object) -> bytes:
    """An uncompressed RGB TIFF file, its directory in front."""
    is_several = "append_images" in more
    return _saved(image, "TIFF", tiffinfo={ORIENTATION: orientation}, save_all=is_several, **more)


def _saved(image: NDArray[np.uint8], kind: str, **more: object) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, kind, **more)
    return stream.getvalue()


def write(folder: Path, files: Mapping[str, bytes]) -> tuple[Path, ...]:
    """Write files and give their paths in the order given."""
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return tuple(folder / name for name in files)
