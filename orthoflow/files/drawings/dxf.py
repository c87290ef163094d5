"""CAD files: each wall in its own plane, and the room in space, in metres."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import StoreError
from orthoflow.files.drawings.room_lines import DrawnWall, Residuals, RoomLines, edges_of
from orthoflow.foreign_text import shown

if TYPE_CHECKING:
    from ezdxf.document import Drawing
    from ezdxf.layouts.layout import Modelspace

# Name and colour, as CAD programs number them.
LAYERS: Final = {
    "IMAGE": 7,
    "FRAME": 8,
    "RECTANGLE": 3,
    "PARTS": 9,
    "EDGES": 1,
    "CORNERS": 1,
    "OPENINGS": 4,
    "OUTLINE": 5,
    "FACES": 252,
    "CHECKPOINTS": 6,
    "RESIDUALS": 30,
    "TEXT": 7,
}
_TEXT_M: Final = 0.05
_METRES: Final = 6
_VERSION: Final = "R2010"


def write_wall_dxf(path: Path, wall: DrawnWall, lines: RoomLines | None) -> None:
    """Write a wall in the coordinates of its GeoTIFF, its picture in exact scale.

    Layers: IMAGE, FRAME of the cells, RECTANGLE of the plane's points, PARTS of it, EDGES to other
    planes, OPENINGS of it, CHECKPOINTS near it, RESIDUALS found on it (enlarged, as a text says).

    Raises:
        StoreError: it cannot be written.
    """
    document, space = _new_document()
    frame = wall.frame
    corners = wall.place_m(frame.corners_world())
    _add_polygon(space, corners, "FRAME")
    if wall.image:
        definition = document.add_image_def(wall.image, (frame.width, frame.height))
        size = (frame.width * frame.gsd_m, frame.height * frame.gsd_m)
        image = space.add_image(definition, tuple(corners[1]), size, dxfattribs={"layer": "IMAGE"})
        # The rows of a ceiling go up along Y.
        image.dxf.v_pixel = (0.0, -frame.raster_down * frame.gsd_m, 0.0)
    for opening in wall.openings:
        _add_polygon(space, opening.outline_m, "OPENINGS")
        left, top = opening.outline_m[:, 0].min(), opening.outline_m[:, 1].max()
        for row, part in enumerate(opening.said.split(", "), start=1):
            place = np.array([left + _TEXT_M, top - 2.0 * row * _TEXT_M])
            _add_text(space, part, place, "OPENINGS")
    if lines is not None:
        if wall.plane_index is not None:
            _add_polygon(space, wall.place_m(lines.planes.corners[wall.plane_index]), "RECTANGLE")
            for part in lines.surfaces[wall.plane_index].rectangles_world:
                _add_polygon(space, wall.place_m(part), "PARTS")
        for edge in edges_of(lines, wall.plane_index):
            begin, end = wall.place_m(edge.ends_world)
            space.add_line(tuple(begin), tuple(end), dxfattribs={"layer": "EDGES"})
        if lines.checkpoints is not None:
            near = np.flatnonzero(wall.near(lines.checkpoints.points_world))
            _add_points(
                space,
                [lines.checkpoints.names[index] for index in near],
                wall.place_m(lines.checkpoints.points_world[near]),
            )
        for residuals in lines.residuals:
            own = residuals.wall == wall.number
            begins = wall.place_m(residuals.points_world[own])
            shifts = residuals.displacement_m[own] * [1.0, frame.raster_down]
            _add_residuals(space, residuals, begins, begins + residuals.times * shifts)
    save_document(document, path)


def write_room_dxf(path: Path, walls: Sequence[DrawnWall], lines: RoomLines) -> None:
    """Write a room in the coordinates of its scan, with a coordinate system `wall_<k>` per wall.

    Layers: IMAGE of each wall in its place, RECTANGLE of each plane, PARTS, EDGES, CORNERS,
    OPENINGS, OUTLINE from above at the height of the floor, FACES of the walls between floor and
    ceiling, CHECKPOINTS, RESIDUALS.

    Raises:
        StoreError: it cannot be written.
    """
    document, space = _new_document()
    for wall in walls:
        _add_placed_wall(document, space, wall)
    for index, surface in enumerate(lines.surfaces):
        corners = lines.planes.corners[index]
        _add_polygon(space, corners, "RECTANGLE")
        for part in surface.rectangles_world:
            _add_polygon(space, part, "PARTS")
        _add_text(space, lines.planes.names[index], corners.mean(axis=0), "TEXT")
    for edge in lines.edges:
        begin, end = edge.ends_world
        space.add_line(tuple(begin), tuple(end), dxfattribs={"layer": "EDGES"})
    for corner in lines.corners:
        space.add_point(tuple(corner.point_world), dxfattribs={"layer": "CORNERS"})
    for opening in lines.openings:
        _add_polygon(space, opening.outline_world, "OPENINGS")
        _add_text(space, opening.said, opening.outline_world.mean(axis=0), "OPENINGS")
    _add_outline(space, lines)
    if lines.checkpoints is not None:
        _add_points(space, lines.checkpoints.names, lines.checkpoints.points_world)
    for residuals in lines.residuals:
        ends = residuals.points_world.copy()
        for wall in walls:
            own = residuals.wall == wall.number
            axes = np.array([wall.frame.u_world, wall.frame.v_world])
            ends[own] += residuals.times * residuals.displacement_m[own] @ axes
        _add_residuals(space, residuals, residuals.points_world, ends)
    save_document(document, path)


def _new_document() -> tuple[Drawing, Modelspace]:
    from ezdxf.filemanagement import new

    document = new(_VERSION, units=_METRES)
    for name, colour in LAYERS.items():
        document.layers.add(name, color=colour)
    # Crosses of 5 cm: a dot is not seen on a picture.
    document.header["$PDMODE"] = 2
    document.header["$PDSIZE"] = _TEXT_M
    # LibreCAD takes the limits of paper space for its paper, and them for metres: A3.
    document.paperspace().dxf.limmax = (0.42, 0.297)
    return document, document.modelspace()


def _add_placed_wall(document: Drawing, space: Modelspace, wall: DrawnWall) -> None:
    """Add a wall's coordinate system, and its picture where it belongs."""
    frame = wall.frame
    axes = {"origin": frame.origin_world, "xaxis": frame.u_world, "yaxis": -frame.v_world}
    document.ucs.add(
        f"wall_{wall.number}",
        dxfattribs={name: tuple(vector.tolist()) for name, vector in axes.items()},
    )
    if wall.image:
        definition = document.add_image_def(wall.image, (frame.width, frame.height))
        bottom_left = frame.corners_world()[1]
        image = space.add_image(
            definition, tuple(bottom_left.tolist()), (1.0, 1.0), dxfattribs={"layer": "IMAGE"}
        )
        image.dxf.u_pixel = tuple((frame.gsd_m * frame.u_world).tolist())
        image.dxf.v_pixel = tuple((-frame.gsd_m * frame.v_world).tolist())


def _add_outline(space: Modelspace, lines: RoomLines) -> None:
    outline = lines.outline
    is_upright = float(lines.planes.up[2]) == 1.0
    for points, is_closed in zip(outline.chains_world, outline.closed, strict=True):
        layer = {"layer": "OUTLINE"}
        if is_upright:
            flat = space.add_lwpolyline(points[:, :2].tolist(), close=is_closed, dxfattribs=layer)
            flat.dxf.elevation = outline.floor_m
        else:
            space.add_polyline3d(points.tolist(), close=is_closed, dxfattribs=layer)
    for face in outline.faces_world:
        space.add_3dface(face.tolist(), dxfattribs={"layer": "FACES"})


def _add_polygon(space: Modelspace, corners: NDArray[np.float64], layer: str) -> None:
    if corners.shape[1] == 2:
        space.add_lwpolyline(corners.tolist(), close=True, dxfattribs={"layer": layer})
    else:
        space.add_polyline3d(corners.tolist(), close=True, dxfattribs={"layer": layer})


def _add_points(space: Modelspace, names: Iterable[str], places: NDArray[np.float64]) -> None:
    for name, place in zip(names, places, strict=True):
        space.add_point(tuple(place.tolist()), dxfattribs={"layer": "CHECKPOINTS"})
        _add_text(space, name, place, "CHECKPOINTS")


def _add_residuals(
    space: Modelspace,
    residuals: Residuals,
    begins: NDArray[np.float64],
    ends: NDArray[np.float64],
) -> None:
    for begin, end in zip(begins.tolist(), ends.tolist(), strict=True):
        space.add_line(begin, end, dxfattribs={"layer": "RESIDUALS"})
    if len(begins):
        said = f"{residuals.cell}: residuals, shown - true, {residuals.times:g} times enlarged"
        lowest = begins.min(axis=0) - 2 * _TEXT_M
        _add_text(space, said, lowest, "RESIDUALS")


def _add_text(space: Modelspace, text: str, place: NDArray[np.float64], layer: str) -> None:
    added = space.add_text(shown(text), height=_TEXT_M, dxfattribs={"layer": layer})
    added.set_placement(tuple(place.tolist()))


def save_document(document: Drawing, path: Path) -> None:
    """Write a document.

    Raises:
        StoreError: it cannot be written.
    """
    try:
        document.saveas(path)
    except OSError as error:
        raise StoreError(f"{path.name} cannot be written: {error}; free some space") from error
