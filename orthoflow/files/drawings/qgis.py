"""A QGIS project with the walls of a room side by side, each at its true height.

Every wall has a coordinate system of its own, which cannot be transformed into another. So each
raster is opened through a GDAL virtual raster beside the project that shifts X only: Y stays the
height.
"""

from __future__ import annotations

import os
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Final
from uuid import NAMESPACE_URL, uuid5

import numpy as np

from orthoflow.files.geotiff import RasterParts
from orthoflow.files.sidecars import write_text
from orthoflow.untrusted_text import shown

PROJECT: Final = "walls.qgs"
_GAP_M: Final = 1.0


@dataclass(frozen=True, kw_only=True)
class ProjectLayer:
    """A raster of a wall.

    Attributes:
        wall: name of the wall.
        kind: content of the raster: `ortho`, `intensity`, `depth`, `error`.
        raster: its GeoTIFF.
        about: one line on it, e.g. its accuracy.
        is_shown: it is visible when the project opens.
    """

    wall: str
    kind: str
    raster: Path
    about: str
    is_shown: bool


def write_project(folder: Path, title: str, layers: Sequence[ProjectLayer]) -> None:
    """Write `walls.qgs` and a virtual raster per layer, with the walls from left to right.

    Raises:
        InputError: a raster cannot be read.
        StoreError: a file cannot be written.
    """
    import jinja2

    places = _places(layers)
    boxes, described = [], []
    for number, layer in enumerate(layers):
        vrt = folder / f"{number:02d}_{layer.raster.stem}.vrt"
        boxes.append(_write_virtual(vrt, layer.raster, places[layer.wall]))
        # Ids must be unique in the project; the same run gives the same project.
        identity = f"{layer.raster.stem}_{uuid5(NAMESPACE_URL, vrt.name).hex}"
        described.append({**vars(layer), "file": vrt.name, "identity": identity})
    extent = np.array(boxes)
    corners = (*extent[:, :2].min(axis=0), *extent[:, 2:].max(axis=0))
    environment = jinja2.Environment(
        autoescape=True,
        trim_blocks=True,
        keep_trailing_newline=True,
        finalize=lambda value: shown(value) if isinstance(value, str) else value,
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
    )
    text = environment.get_template("walls.qgs.j2").render(
        title=title,
        layers=described,
        walls=[(wall, list(own)) for wall, own in groupby(described, itemgetter("wall"))],
        extent=zip(("xmin", "ymin", "xmax", "ymax"), corners, strict=True),
    )
    write_text(folder / PROJECT, text)


def _places(layers: Sequence[ProjectLayer]) -> dict[str, float]:
    """Return the offset of X of each wall."""
    found: dict[str, float] = {}
    right = 0.0
    for layer in layers:
        if layer.wall not in found:
            with RasterParts(layer.raster) as raster:
                found[layer.wall] = right - raster.corner_m[0]
                right += raster.shape[1] * raster.gsd_m + _GAP_M
    return found


def _write_virtual(path: Path, raster: Path, shift_m: float) -> tuple[float, float, float, float]:
    """Write a virtual raster that shifts X; return left, bottom, right and top."""
    from rasterio.shutil import copy

    with RasterParts(raster) as parts:
        rows, columns = parts.shape
        left, top, gsd_m = parts.corner_m[0] + shift_m, parts.corner_m[1], parts.gsd_m
    copy(raster, path, driver="VRT")
    root = ET.parse(path).getroot()
    # Coordinate systems of walls cannot be transformed into each other.
    for element in root.findall("SRS"):
        root.remove(element)
    for element in root.iter("GeoTransform"):
        element.text = f"{left!r}, {gsd_m!r}, 0, {top!r}, 0, {-gsd_m!r}"
    for element in root.iter("SourceFilename"):
        element.text = os.path.relpath(raster, path.parent)
        element.set("relativeToVRT", "1")
    write_text(path, ET.tostring(root, encoding="unicode") + "\n")
    return left, top - rows * gsd_m, left + columns * gsd_m, top
