"""Areas that users assign to photos by hand; they override the rule for seams."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.polygons import NamedPolygon, filled, read_polygons
from orthoflow.geometry import WallFrame
from orthoflow.products import InputFiles


@dataclass(frozen=True, kw_only=True)
class DrawnSeams:
    """Polygons of one wall, each assigned to a layer; where polygons overlap, the last one is used.

    Attributes:
        rings: corners (n, 2) of each polygon as (column, row).
        layers: index of the layer of each polygon.
        n_columns: number of columns of the wall.
    """

    rings: tuple[tuple[NDArray[np.float64], ...], ...]
    layers: tuple[int, ...]
    n_columns: int

    def chosen(self, rows: slice) -> NDArray[np.int16]:
        """Return the assigned layer (rows, cols) of the cells in the given rows; -1 if none."""
        chosen = np.full((rows.stop - rows.start, self.n_columns), -1, dtype=np.int16)
        for rings, layer in zip(self.rings, self.layers, strict=True):
            moved = tuple(ring - [0.0, rows.start] for ring in rings)
            lowest = min(float(ring[:, 1].min()) for ring in moved)
            highest = max(float(ring[:, 1].max()) for ring in moved)
            if highest >= 0.0 and lowest <= len(chosen):
                chosen[filled(moved, chosen.shape)] = layer
        return chosen


def read_seams(files: InputFiles | None, sources: Collection[str]) -> list[NamedPolygon]:
    """Read the polygons of all walls; their properties are `photo` and the number `wall`.

    Raises:
        InputError: a file has a different format, or refers to a photo without a layer.
    """
    if files is None:
        return []
    polygons = [
        polygon
        for path in files.paths
        for polygon in read_polygons(path, "photo", what="a file of seams")
    ]
    for polygon in polygons:
        if polygon.name not in sources:
            raise InputError(
                f"seams in the input {files.name} refer to the photo {polygon.name}, but the "
                f"layers come from {', '.join(sorted(sources))}"
            )
        wall = polygon.properties.get("wall")
        if not isinstance(wall, int) or isinstance(wall, bool):
            raise InputError(
                f'each seam in the input {files.name} needs the property "wall", the number of a '
                f"wall; got {wall!r}"
            )
    return polygons


def seams_of(
    polygons: Sequence[NamedPolygon], number: int, frame: WallFrame, sources: Sequence[str]
) -> DrawnSeams | None:
    """Return the polygons of a wall in cell coordinates; None if there are none.

    Args:
        polygons: polygons of all walls, in the coordinates of their GeoTIFFs (metres).
        number: number of the wall.
        frame: frame of the wall.
        sources: source of each layer of the wall.
    """
    mine = [
        polygon
        for polygon in polygons
        if polygon.properties["wall"] == number and polygon.name in sources
    ]
    if not mine:
        return None
    return DrawnSeams(
        rings=tuple(
            tuple(frame.wall_from_raster(ring) for ring in polygon.rings) for polygon in mine
        ),
        layers=tuple(sources.index(polygon.name) for polygon in mine),
        n_columns=frame.width,
    )
