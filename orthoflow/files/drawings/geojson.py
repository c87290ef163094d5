"""Files for GIS programs: GeoJSON of walls and rooms, and a QGIS project of the walls.

Every wall has its own coordinate system, which cannot be transformed into another. The project
therefore opens each raster through a GDAL virtual raster that only shifts X; Y remains the height.
"""

from __future__ import annotations

import math
import os
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Final
from uuid import NAMESPACE_URL, uuid5

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.drawings.key_plans import DrawnWall, RoomLines, edges_of, numbered_openings
from orthoflow.files.geotiff import SITE_CRS, RasterParts
from orthoflow.files.polygons import Feature, outlines, write_features
from orthoflow.files.sidecars import numbers, write_text
from orthoflow.geometry.outlines import Edge
from orthoflow.products import JsonValue, Opening, Orthoimage, OutlineSource
from orthoflow.untrusted_text import shown

_DIGITS: Final = 6
_ROUNDED: Final = (
    *("depth_m", "width_m", "height_m", "sill_m", "area_m2", "edge_sigma_m", "seen_share"),
)
# Of an image with more cells, the seams are outlined in every nth row and column.
SEAM_CELLS: Final = 16_000_000


def write_wall_geojson(path: Path, wall: DrawnWall, lines: RoomLines | None) -> None:
    """Write a wall in the coordinates of its GeoTIFF."""
    own: dict[str, JsonValue] = {"wall": wall.number, "name": wall.name}
    features = [_polygon(wall.corners_m, {"kind": "frame", **own})]
    if lines is not None:
        if wall.plane_index is not None:
            corners = lines.planes.corners[wall.plane_index]
            features.append(_polygon(wall.place_m(corners), {"kind": "rectangle", **own}))
        features += [
            _feature("LineString", wall.place_m(edge.ends_world), _about(edge, lines))
            for edge in edges_of(lines, wall.plane_index)
        ]
        if lines.checkpoints is not None:
            near = np.flatnonzero(wall.near(lines.checkpoints.points_world))
            places = wall.place_m(lines.checkpoints.points_world[near])
            features += _points([lines.checkpoints.names[index] for index in near], places)
    features += [opening_feature(opening, place) for place, opening in enumerate(wall.openings)]
    write_features(path, features, wall.frame.crs)


def write_seams_geojson(path: Path, image: Orthoimage) -> None:
    """Write the area of a wall that each photo covers, in the coordinates of the wall's GeoTIFF.

    After editing, the file can be passed to `mosaic.seams` as the input `seams`; it then overrides
    the automatic seams.
    """
    # On very large walls, the corners of areas are accurate only to a few cells.
    step = max(1, math.ceil(math.sqrt(image.source.size / SEAM_CELLS)))
    source = np.ascontiguousarray(image.source[::step, ::step])
    features: list[Feature] = []
    for index, rings in outlines(source):
        places = [
            image.frame.raster_from_wall(step * ring).round(_DIGITS).tolist() for ring in rings
        ]
        about: dict[str, JsonValue] = {"photo": image.sources[index], "wall": image.number}
        geometry: dict[str, JsonValue] = {"type": "Polygon", "coordinates": places}
        features.append({"type": "Feature", "properties": about, "geometry": geometry})
    write_features(path, features, image.frame.crs, indent=None)


def write_room_geojson(path: Path, lines: RoomLines, map_crs: str | None) -> None:
    """Write a room in scan coordinates: planes, edges, corners, outline and openings."""
    features = [
        _polygon(corners, {"kind": "rectangle", "plane": index, "name": lines.planes.names[index]})
        for index, corners in enumerate(lines.planes.corners)
    ]
    features += [
        _feature("LineString", edge.ends_world, _about(edge, lines)) for edge in lines.edges
    ]
    features += [
        _feature("Point", corner.point_world, {"kind": "corner", "planes": list(corner.planes)})
        for corner in lines.corners
    ]
    outline = lines.outline
    for points, is_closed in zip(outline.chains_world, outline.closed, strict=True):
        about: Mapping[str, JsonValue] = {"kind": "outline", "floor_m": outline.floor_m}
        features.append(
            _polygon(points, about) if is_closed else _feature("LineString", points, about)
        )
    if lines.checkpoints is not None:
        features += _points(lines.checkpoints.names, lines.checkpoints.points_world)
    features += [
        opening_feature(opening, place, in_world=True)
        for place, opening in numbered_openings(lines.openings)
    ]
    write_features(path, features, map_crs or SITE_CRS)


def opening_feature(opening: Opening, place: int, *, in_world: bool = False) -> Feature:
    """Return an opening of a wall as a polygon with all its properties.

    Args:
        opening: the opening.
        place: index of the opening among those of its wall, from the left.
        in_world: whether to use scan coordinates x, y, z instead of those of the wall's GeoTIFF.
    """
    sources = [OutlineSource(source).name.lower() for source in opening.side_source.tolist()]
    about: dict[str, JsonValue] = {
        "kind": "opening",
        "opening": opening.kind,
        "wall": opening.wall,
        "name": opening.wall_name,
        "number": place,
        **{name: _rounded(getattr(opening, name)) for name in _ROUNDED},
        "side_sigma_mm": numbers(np.round(1e3 * opening.side_sigma_m, 3)),
        "side_source": list(sources),
    }
    return _polygon(opening.outline_world if in_world else opening.outline_m, about)


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, _DIGITS)


def _about(edge: Edge, lines: RoomLines) -> Mapping[str, JsonValue]:
    return {
        "kind": "edge",
        "planes": [edge.first, edge.second],
        "names": [lines.planes.names[edge.first], lines.planes.names[edge.second]],
        "length_m": round(edge.length_m, _DIGITS),
    }


def _points(names: Iterable[str], places: NDArray[np.float64]) -> list[Feature]:
    return [
        _feature("Point", place, {"kind": "check point", "name": name})
        for name, place in zip(names, places, strict=True)
    ]


def _polygon(corners: NDArray[np.float64], about: Mapping[str, JsonValue]) -> Feature:
    return _feature("Polygon", np.vstack([corners, corners[:1]])[None], about)


def _feature(
    kind: str, coordinates: NDArray[np.float64], about: Mapping[str, JsonValue]
) -> Feature:
    places: JsonValue = np.round(coordinates, _DIGITS).tolist()
    geometry: dict[str, JsonValue] = {"type": kind, "coordinates": places}
    return {"type": "Feature", "properties": dict(about), "geometry": geometry}


PROJECT: Final = "walls.qgs"
_GAP_M: Final = 1.0


@dataclass(frozen=True, kw_only=True)
class ProjectLayer:
    """A raster of a wall.

    Attributes:
        wall: name of the wall.
        kind: content of the raster: `ortho`, `intensity`, `depth` or `error`.
        raster: path of the GeoTIFF.
        about: one line of information, e.g. the accuracy of the raster.
        is_shown: whether the layer is visible when the project is opened.
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
        # Ids must be unique in the project, and reproducible for the same run.
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
    found: dict[str, float] = {}
    right = 0.0
    for layer in layers:
        if layer.wall not in found:
            with RasterParts(layer.raster) as raster:
                found[layer.wall] = right - raster.corner_m[0]
                right += raster.shape[1] * raster.gsd_m + _GAP_M
    return found


def _write_virtual(path: Path, raster: Path, shift_m: float) -> tuple[float, float, float, float]:
    """Write a virtual raster with X shifted; return its left, bottom, right and top edges."""
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
