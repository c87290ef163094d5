"""Pictures referenced by CAD files: PNG of the size of the raster, written row by row."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Final, cast

import numpy as np

from orthoflow.errors import StoreError
from orthoflow.files.geotiff import RasterParts
from orthoflow.geometry.levels import eight_bits

if TYPE_CHECKING:
    from io import BufferedWriter

    from orthoflow.geometry.levels import Colours

_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
_BAND_CELLS: Final = 1 << 23
_UP: Final = 2
_LEVEL: Final = 4


def write_cad_picture(raster: Path, path: Path) -> tuple[int, int]:
    """Write an orthoimage as PNG, one pixel per cell, transparent where empty.

    Returns:
        Rows and columns.

    Raises:
        StoreError: the file cannot be written.
    """
    with RasterParts(raster) as source:
        rows, columns = source.shape
        step = max(1, _BAND_CELLS // columns)
        packer = zlib.compressobj(_LEVEL)
        before = np.zeros((1, 4 * columns), dtype=np.uint8)
        try:
            with path.open("wb") as stream:
                stream.write(_SIGNATURE)
                _write_chunk(stream, b"IHDR", struct.pack(">2I5B", columns, rows, 8, 6, 0, 0, 0))
                for first in range(0, rows, step):
                    last = min(rows, first + step)
                    box = (0.0, float(first), float(columns), float(last))
                    values, shown = source.read(box, (last - first, columns))
                    # White behind transparency, for programs that do not support it.
                    pixels = np.full((last - first, columns, 4), 255, dtype=np.uint8)
                    pixels[..., :3][shown] = eight_bits(cast("Colours", values))[shown]
                    pixels[..., 3] = np.where(shown, 255, 0)
                    flat = pixels.reshape(last - first, 4 * columns)
                    filtered = np.empty((last - first, 4 * columns + 1), dtype=np.uint8)
                    filtered[:, 0] = _UP
                    filtered[:, 1:] = flat - np.vstack([before, flat[:-1]])
                    before = flat[-1:].copy()
                    _write_chunk(stream, b"IDAT", packer.compress(filtered.tobytes()))
                _write_chunk(stream, b"IDAT", packer.flush())
                _write_chunk(stream, b"IEND", b"")
        except OSError as error:
            raise StoreError(f"{path.name} cannot be written: {error}; free some space") from error
    return rows, columns


def _write_chunk(stream: BufferedWriter, name: bytes, content: bytes) -> None:
    stream.write(struct.pack(">I", len(content)) + name + content)
    stream.write(struct.pack(">I", zlib.crc32(content, zlib.crc32(name))))
