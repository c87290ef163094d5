"""A tile pyramid of an orthoimage, in the Deep Zoom format.

`NAME.dzi` contains the size, and `NAME_files/LEVEL/COLUMN_ROW.webp` are the tiles. The last level
has full resolution, each lower level has half the resolution of the next, and level 0 is one pixel.
Tiles are transparent where the orthoimage is empty. The page next to the tiles can be panned and
zoomed, and measures distances; it is a single file that needs neither a server nor external
resources.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import numpy as np

from orthoflow.files.geotiff import local_crs_name
from orthoflow.files.images import encode_webp
from orthoflow.files.sidecars import OrthoFile, numbers, write_bytes, write_text
from orthoflow.products import JsonValue

TILE_PX: Final = 512
SUFFIX: Final = "webp"
PAGE: Final = "index.html"
_PLACE: Final = "/*IMAGES*/[]"


def write_tiles(folder: Path, name: str, ortho: OrthoFile) -> int:
    """Write the tiles of an orthoimage and return their number.

    Only one tile at a time is in memory.

    Args:
        folder: existing folder.
        name: name of the image, used as the stem of its files.
        ortho: the orthoimage.

    Raises:
        StoreError: a file cannot be written.
        InputError: the orthoimage cannot be read.
    """
    rows, columns = ortho.frame.shape
    last, count = last_level(columns, rows), 0
    for level in range(last + 1):
        target = folder / f"{name}_files" / str(level)
        target.mkdir(parents=True)
        factor = 2 ** (last - level)
        step = TILE_PX * factor
        for row, top in enumerate(range(0, rows, step)):
            for column, left in enumerate(range(0, columns, step)):
                right, bottom = min(left + step, columns), min(top + step, rows)
                shape = (-(-(bottom - top) // factor), -(-(right - left) // factor))
                rgb, shown = ortho.part((left, top, right, bottom), shape)
                tile = np.dstack([rgb, np.where(shown, np.uint8(255), np.uint8(0))])
                write_bytes(target / f"{column}_{row}.{SUFFIX}", encode_webp(tile))
                count += 1
    write_text(folder / f"{name}.dzi", _descriptor(columns, rows))
    return count


def last_level(width: int, height: int) -> int:
    """Return the number of the level with full resolution.

    >>> last_level(1, 1), last_level(1024, 3), last_level(1025, 3)
    (0, 10, 11)
    """
    return (max(width, height) - 1).bit_length()


def _descriptor(width: int, height: int) -> str:
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<Image xmlns="http://schemas.microsoft.com/deepzoom/2008" '
        f'Format="{SUFFIX}" Overlap="0" TileSize="{TILE_PX}">\n'
        f'  <Size Width="{width}" Height="{height}"/>\n</Image>\n'
    )


def write_viewer(folder: Path, images: Mapping[str, OrthoFile]) -> None:
    """Write `index.html` for images whose tiles are in the folder.

    Args:
        folder: existing folder.
        images: orthoimages by the name of their tile set.

    Raises:
        StoreError: the file cannot be written.
    """
    described = [_image(name, ortho) for name, ortho in images.items()]
    text = json.dumps(described, allow_nan=False)
    # Escape names, which come from records, so that they cannot end the script element.
    for letter in "<>&":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    page = files(__package__).joinpath("viewer.html").read_text(encoding="utf-8")
    write_text(folder / PAGE, page.replace(_PLACE, text))


def _image(name: str, ortho: OrthoFile) -> JsonValue:
    frame = ortho.frame
    curved: dict[str, Any] = {}
    if frame.bend is not None:
        curved = {"n": numbers(frame.normal_world), "bend": frame.bend.revolution.numbers}
    return {
        "file": name,
        "title": ortho.name,
        "width": frame.width,
        "height": frame.height,
        "gsd": frame.gsd_m,
        "tile": TILE_PX,
        "suffix": SUFFIX,
        "last": last_level(frame.width, frame.height),
        "origin": numbers(frame.origin_world),
        "u": numbers(frame.u_world),
        "v": numbers(frame.v_world),
        **curved,
        # X and Y of the corner, as in the GeoTIFF.
        "corner": list(frame.raster_corner_m),
        "down": frame.raster_down,
        "axes": "E, N" if frame.map_crs else "X, H" if frame.raster_axes == "wall" else "X, Y",
        "crs": frame.map_crs or local_crs_name(frame.crs),
        "about": ortho.about.sentence,
    }
