"""The page beside the tiles: pans, zooms, measures; one file, no server, nothing from elsewhere."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Final

from orthoflow.files.ortho_files import OrthoFile
from orthoflow.files.sidecars import numbers, write_text
from orthoflow.files.tiles.pyramid import SUFFIX, TILE_PX, last_level
from orthoflow.products import JsonValue

PAGE: Final = "index.html"
_PLACE: Final = "/*IMAGES*/[]"


def write_viewer(folder: Path, images: Mapping[str, OrthoFile]) -> None:
    """Write `index.html` for images whose tiles lie in the folder.

    Args:
        folder: existing folder.
        images: name of the tiles -> orthoimage.

    Raises:
        StoreError: the file cannot be written.
    """
    described = [_image(name, ortho) for name, ortho in images.items()]
    text = json.dumps(described, allow_nan=False)
    # Names come from records, and the page must not end within one.
    for letter in "<>&":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    page = files(__package__).joinpath("viewer.html").read_text(encoding="utf-8")
    write_text(folder / PAGE, page.replace(_PLACE, text))


def _image(name: str, ortho: OrthoFile) -> JsonValue:
    frame = ortho.frame
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
        # X and Y as in the GeoTIFF.
        "corner": list(frame.raster_corner_m),
        "crs": frame.map_crs,
    }
