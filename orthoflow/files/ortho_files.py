"""Orthoimages that a run published, read from their files: any part, at any size."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.geotiff import RasterParts
from orthoflow.files.sidecars import accuracy_words, placed_raster
from orthoflow.geometry import WallFrame
from orthoflow.geometry.levels import eight_bits

_NAME: Final = re.compile(r"wall_(\d{1,5})_ortho\.tif")
_COLOURS: Final = 3


@dataclass(frozen=True, kw_only=True)
class OrthoFile:
    """One orthoimage.

    Attributes:
        path: its GeoTIFF.
        wall: number in its name.
        name: what the run calls the wall.
        frame: where its cells lie.
        digest: of the product, empty where the sidecar does not say it.
        accuracy: what is known of this image's, for people.
    """

    path: Path
    wall: int
    name: str
    frame: WallFrame
    digest: str
    accuracy: str = ""

    def shrunk(self, longest_px: int) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Colours (r, c, 3) and what is shown (r, c), averaged to at most so many pixels a side.

        Raises:
            InputError: the file cannot be read.
        """
        rows, columns = self.frame.shape
        factor = max(1.0, max(rows, columns) / longest_px)
        shape = (max(1, round(rows / factor)), max(1, round(columns / factor)))
        return self._read(slice(0, rows), shape)

    def bands(self, n_rows: int) -> Iterator[tuple[NDArray[np.uint8], NDArray[np.bool_]]]:
        """Give colours and what is shown, so many rows at a time from the top.

        Raises:
            InputError: the file cannot be read.
        """
        rows, columns = self.frame.shape
        for first in range(0, rows, n_rows):
            end = min(rows, first + n_rows)
            yield self._read(slice(first, end), (end - first, columns))

    def _read(
        self, rows: slice, shape: tuple[int, int]
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        part = (0.0, float(rows.start), float(self.frame.width), float(rows.stop))
        with RasterParts(self.path) as raster:
            if raster.bands < _COLOURS or raster.dtype not in ("uint8", "uint16"):
                raise InputError(
                    f"{self.path} has {raster.bands} bands of {raster.dtype}, expected "
                    f"{_COLOURS} of 8 or 16 bits"
                )
            bands, shown = raster.read(part, shape)
        return eight_bits(np.ascontiguousarray(bands[:, :, :_COLOURS])), shown


def ortho_files(paths: Iterable[Path]) -> tuple[OrthoFile, ...]:
    """Open those files that are orthoimages, in the order of their walls.

    Raises:
        InputError: one of them, or the sidecar beside it, cannot be read.
    """
    found = [_opened(path, int(name[1])) for path in paths if (name := _NAME.fullmatch(path.name))]
    return tuple(sorted(found, key=lambda ortho: ortho.wall))


def _opened(path: Path, wall: int) -> OrthoFile:
    frame, content = placed_raster(path)
    name, digest = content.get("name"), content.get("product_digest")
    return OrthoFile(
        path=path,
        wall=wall,
        name=name if isinstance(name, str) else f"wall {wall}",
        frame=frame,
        digest=digest if isinstance(digest, str) else "",
        accuracy=accuracy_words(content.get("accuracy")),
    )
