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
from pathlib import Path
from typing import Final
from uuid import NAMESPACE_URL, uuid5

import numpy as np

from orthoflow.files.geotiff import RasterParts
from orthoflow.files.sidecars import write_text

PROJECT: Final = "walls.qgs"
_VERSION: Final = "3.22.0"
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
    places = _places(layers)
    root = ET.Element("qgis", {"projectname": title, "version": _VERSION})
    ET.SubElement(root, "title").text = title
    tree = ET.SubElement(root, "layer-tree-group")
    holder = ET.SubElement(root, "projectlayers")
    groups: dict[str, ET.Element] = {}
    boxes = []
    for number, layer in enumerate(layers):
        vrt = folder / f"{number:02d}_{layer.raster.stem}.vrt"
        boxes.append(_write_virtual(vrt, layer.raster, places[layer.wall]))
        # Ids must be unique in the project; the same run gives the same project.
        identity = f"{layer.raster.stem}_{uuid5(NAMESPACE_URL, vrt.name).hex}"
        group = groups.get(layer.wall)
        if group is None:
            group = ET.SubElement(tree, "layer-tree-group", {"name": layer.wall})
            groups[layer.wall] = group
        ET.SubElement(
            group,
            "layer-tree-layer",
            {
                "id": identity,
                "name": f"{layer.wall}: {layer.kind}",
                "checked": "Qt::Checked" if layer.is_shown else "Qt::Unchecked",
                "providerKey": "gdal",
                "source": f"./{vrt.name}",
            },
        )
        described = ET.SubElement(holder, "maplayer", {"type": "raster"})
        for name, text in (
            ("id", identity),
            ("datasource", f"./{vrt.name}"),
            ("layername", f"{layer.wall}: {layer.kind}"),
            ("provider", "gdal"),
            ("abstract", layer.about),
        ):
            ET.SubElement(described, name).text = text
    extent = np.array(boxes)
    canvas = ET.SubElement(root, "mapcanvas", {"name": "theMapCanvas"})
    ET.SubElement(canvas, "units").text = "meters"
    box = ET.SubElement(canvas, "extent")
    corners = (*extent[:, :2].min(axis=0), *extent[:, 2:].max(axis=0))
    for name, value in zip(("xmin", "ymin", "xmax", "ymax"), corners, strict=True):
        ET.SubElement(box, name).text = f"{value:.6f}"
    properties = ET.SubElement(root, "properties")
    paths = ET.SubElement(properties, "Paths")
    ET.SubElement(paths, "Absolute", {"type": "bool"}).text = "false"
    ET.indent(root)
    head = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
    write_text(folder / PROJECT, head + ET.tostring(root, encoding="unicode") + "\n")


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
