"""A pyramid of tiles of one orthoimage, as Deep Zoom images have it, made band by band.

`NAME.dzi` states the size, `NAME_files/LEVEL/COLUMN_ROW.webp` are the tiles: the last level has the
cells as they are, each before it half as many a side, level 0 is one pixel. Tiles are transparent
where the orthoimage is empty. The page beside them pans, zooms and measures: one file, no server,
nothing from elsewhere.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.geotiff import local_crs_name
from orthoflow.files.images import encode_webp
from orthoflow.files.sidecars import OrthoFile, numbers, write_bytes, write_text
from orthoflow.products import JsonValue

TILE_PX: Final = 512
SUFFIX: Final = "webp"
PAGE: Final = "index.html"
_PLACE: Final = "/*IMAGES*/[]"


def write_tiles(folder: Path, name: str, ortho: OrthoFile) -> int:
    """Write the tiles of an orthoimage; gives their number.

    Memory holds two bands of 512 rows, however large the orthoimage is.

    Args:
        folder: existing folder.
        name: of the image: the stem of its files.
        ortho: the orthoimage.

    Raises:
        StoreError: a file cannot be written.
        InputError: the orthoimage cannot be read.
    """
    rows, columns = ortho.frame.shape
    levels = _Levels(folder=folder / f"{name}_files", width=columns, height=rows)
    levels.write(ortho.bands(TILE_PX))
    write_text(folder / f"{name}.dzi", _descriptor(columns, rows))
    return levels.counts[0]


def last_level(width: int, height: int) -> int:
    """Number of the level that has the cells as they are.

    >>> last_level(1, 1), last_level(1024, 3), last_level(1025, 3)
    (0, 10, 11)
    """
    return (max(width, height) - 1).bit_length()


@dataclass(frozen=True, kw_only=True)
class _Levels:
    """The levels of a pyramid while rows come in from the top.

    Attributes:
        folder: of all tiles.
        width: columns of the last level.
        height: rows of it.
        waiting: rows of each level that are no whole row of tiles yet, (r, c, 4) uint8.
        done: rows of tiles that are written, by level.
        counts: how many tiles are.
    """

    folder: Path
    width: int
    height: int
    waiting: dict[int, NDArray[np.uint8]] = field(default_factory=dict)
    done: dict[int, int] = field(default_factory=dict)
    counts: list[int] = field(default_factory=lambda: [0])

    def write(self, bands: Iterable[tuple[NDArray[np.uint8], NDArray[np.bool_]]]) -> None:
        """Take all bands of the orthoimage."""
        level = last_level(self.width, self.height)
        for number in range(level + 1):
            (self.folder / str(number)).mkdir(parents=True)
        for rgb, shown in bands:
            alpha = np.where(shown, np.uint8(255), np.uint8(0))
            self._take(level, np.dstack([rgb, alpha]))
        for number in range(level, -1, -1):
            self._flush(number)

    def _take(self, level: int, rows: NDArray[np.uint8]) -> None:
        waiting = self.waiting.pop(level, None)
        rows = rows if waiting is None else np.concatenate([waiting, rows])
        while len(rows) >= TILE_PX:
            self._row_of_tiles(level, rows[:TILE_PX])
            rows = rows[TILE_PX:]
        if len(rows):
            self.waiting[level] = rows.copy()

    def _flush(self, level: int) -> None:
        rows = self.waiting.pop(level, None)
        if rows is not None:
            self._row_of_tiles(level, rows)

    def _row_of_tiles(self, level: int, rows: NDArray[np.uint8]) -> None:
        """Write rows of a level as tiles, and hand them on at half the size."""
        place = self.done.get(level, 0)
        self.done[level] = place + 1
        for column in range(-(-rows.shape[1] // TILE_PX)):
            tile = np.ascontiguousarray(rows[:, column * TILE_PX : (column + 1) * TILE_PX])
            path = self.folder / str(level) / f"{column}_{place}.{SUFFIX}"
            write_bytes(path, encode_webp(tile))
            self.counts[0] += 1
        if level > 0:
            self._take(level - 1, halved(rows))


def halved(cells: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Average 2 x 2 cells (r, c, 4), colours by those that are not transparent.

    At an odd border the last row or column stands alone.
    """
    rows, columns = cells.shape[:2]
    padded = np.zeros((rows + rows % 2, columns + columns % 2, 4), dtype=np.uint16)
    padded[:rows, :columns] = cells
    alpha = padded[:, :, 3:] // 255
    padded[:, :, :3] *= alpha
    quarters = [padded[a::2, b::2] for a in (0, 1) for b in (0, 1)]
    # 16 bits hold four times 255.
    sums = quarters[0] + quarters[1] + quarters[2] + quarters[3]
    weights = sums[:, :, 3:] // 255
    half = np.zeros((*sums.shape[:2], 4), dtype=np.uint8)
    half[:, :, :3] = (sums[:, :, :3] + weights // 2) // np.maximum(weights, 1)
    # Shown where at least half of what there is of the four is; a border has fewer.
    there = np.full(weights.shape, 4, dtype=np.uint16)
    there[-1:] //= 1 + rows % 2
    there[:, -1:] //= 1 + columns % 2
    half[:, :, 3] = np.where(2 * weights >= there, 255, 0)[:, :, 0]
    return half


def _descriptor(width: int, height: int) -> str:
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<Image xmlns="http://schemas.microsoft.com/deepzoom/2008" '
        f'Format="{SUFFIX}" Overlap="0" TileSize="{TILE_PX}">\n'
        f'  <Size Width="{width}" Height="{height}"/>\n</Image>\n'
    )


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
        "down": frame.raster_down,
        "axes": "E, N" if frame.map_crs else "X, H" if frame.raster_axes == "wall" else "X, Y",
        "crs": frame.map_crs or local_crs_name(frame.crs),
        "about": ortho.about.sentence,
    }
