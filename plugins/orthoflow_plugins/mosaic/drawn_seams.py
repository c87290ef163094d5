"""Areas that a person assigns to photos, regardless of the rule for seams."""

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
    """Polygons of one wall, each for one of its layers; of overlapping ones the last counts.

    Attributes:
        rings: of each polygon, (n, 2) corners as (column, row).
        layers: index of the layer of each.
        n_columns: of the wall.
    """

    rings: tuple[tuple[NDArray[np.float64], ...], ...]
    layers: tuple[int, ...]
    n_columns: int

    def chosen(self, rows: slice) -> NDArray[np.int16]:
        """Return the layer (rows, cols) that a person chose in some rows; -1 without a choice."""
        chosen = np.full((rows.stop - rows.start, self.n_columns), -1, dtype=np.int16)
        for rings, layer in zip(self.rings, self.layers, strict=True):
            moved = tuple(ring - [0.0, rows.start] for ring in rings)
            lowest = min(float(ring[:, 1].min()) for ring in moved)
            highest = max(float(ring[:, 1].max()) for ring in moved)
            if highest >= 0.0 and lowest <= len(chosen):
                chosen[filled(moved, chosen.shape)] = layer
        return chosen


def read_seams(files: InputFiles | None, sources: Collection[str]) -> list[NamedPolygon]:
    """Read the polygons of all walls, with the properties `photo` and `wall`, its number.

    Raises:
        InputError: a file has other content, or names something that is not a layer.
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
                f"seams of the input {files.name} name the photo {polygon.name}, but the layers "
                f"are of {', '.join(sorted(sources))}"
            )
        wall = polygon.properties.get("wall")
        if not isinstance(wall, int) or isinstance(wall, bool):
            raise InputError(
                f'seams of the input {files.name} need the property "wall", the number of a wall, '
                f"beside every photo, got {wall!r}"
            )
    return polygons


def seams_of(
    polygons: Sequence[NamedPolygon], number: int, frame: WallFrame, sources: Sequence[str]
) -> DrawnSeams | None:
    """Return the polygons of a wall in its cells; None if it has none.

    Args:
        polygons: of all walls, in the metres of their GeoTIFFs.
        number: of the wall.
        frame: of the wall.
        sources: of its layers, in their order.
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
