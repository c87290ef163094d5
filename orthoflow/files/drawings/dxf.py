"""CAD files: each wall in its plane, with grid, heights and dimensions, and the room in 3D.

Openings are drawn as rectangles or arches where these fit.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.drawings.key_plans import DrawnWall, RoomLines, edges_of
from orthoflow.files.drawings.sheet_contents import nice_step
from orthoflow.files.sidecars import write_text
from orthoflow.untrusted_text import shown

if TYPE_CHECKING:
    from ezdxf.document import Drawing
    from ezdxf.layouts.layout import Modelspace

# Content, AutoCAD colour and line weight (in 1/100 mm, as in ISO 128) by layer name of the US
# National CAD Standard.
Layers = Mapping[str, tuple[str, int, int]]
# Walls are elevations (A-ELEV); the room in 3D is a surface model (A-WALL).
LAYERS: Final[Layers] = {
    "A-ELEV-IMAG": ("orthoimages", 7, 13),
    "A-ELEV-OTLN": ("outline of the orthoimage", 8, 13),
    "A-ELEV-EDGE": ("edges to neighbouring planes", 7, 35),
    "A-ELEV-OPNG": ("openings, regularised", 4, 35),
    "A-WALL-EDGE": ("edges where planes meet", 1, 35),
    "A-WALL-OTLN": ("outline of the room at the floor", 5, 50),
    "A-WALL-FACE": ("wall faces", 252, 13),
    "A-WALL-OPNG": ("openings in 3D", 4, 35),
    "A-SURV-PNTS": ("surveyed points", 6, 25),
    "A-ANNO-GRID": ("grid with coordinates", 9, 13),
    "A-ANNO-LEVL": ("height marks", 3, 18),
    "A-ANNO-DIMS": ("dimensions", 2, 18),
    "A-ANNO-TEXT": ("names and notes", 7, 18),
}
# Text height: 2.5 mm at 1:50.
_TEXT_M: Final = 0.125
_LETTER_M: Final = 0.9 * _TEXT_M
_ROW_M: Final = 1.8 * _TEXT_M
_METRES: Final = 6
_VERSION: Final = "R2010"
# Attributes are hidden and their content is repeated as text, because some programs do not show
# attributes.
_UNSEEN: Final = {"flags": 1}
_MOST_LINES: Final = 12
DIMENSION_STYLE: Final = "ORTHOFLOW"
_POINT_BLOCK: Final = "SURVEY-POINT"
_LEVEL_BLOCK: Final = "LEVEL"


def write_wall_dxf(path: Path, wall: DrawnWall, lines: RoomLines | None) -> None:
    """Write a wall in the coordinates of its GeoTIFF, with its orthoimage to scale.

    The layers are those of `LAYERS` for elevations. Openings are rectangles or arches if these fit;
    a label states their deviation from the detected outline. Marks are blocks with attributes.

    Raises:
        StoreError: the file cannot be written.
    """
    document, space = _wall_document()
    frame = wall.frame
    corners = wall.corners_m
    _add_polygon(space, corners, "A-ELEV-OTLN")
    if wall.image:
        definition = document.add_image_def(wall.image, (frame.width, frame.height))
        size = (frame.width * frame.gsd_m, frame.height * frame.gsd_m)
        image = space.add_image(
            definition, tuple(corners[1]), size, dxfattribs={"layer": "A-ELEV-IMAG"}
        )
        # For a ceiling, Y increases with the row number.
        image.dxf.v_pixel = (0.0, -frame.raster_down * frame.gsd_m, 0.0)
    low, high = corners.min(axis=0), corners.max(axis=0)
    is_upright = frame.raster_axes == "wall"
    _add_grid(space, low, high)
    if is_upright:
        _add_level(space, high[0], low[1])
        _add_level(space, high[0], high[1])
    for opening in wall.openings:
        _add_opening(space, opening.outline_m, opening.edge_sigma_m, opening.said)
    _add_dimension(space, low, np.array([high[0], low[1]]), -6 * _TEXT_M)
    _add_dimension(space, low, np.array([low[0], high[1]]), 6 * _TEXT_M)
    _add_text(space, wall.name, low - [0.0, 10 * _TEXT_M], "A-ANNO-TEXT")
    if lines is not None:
        for edge in edges_of(lines, wall.plane_index):
            begin, end = wall.place_m(edge.ends_world)
            space.add_line(tuple(begin), tuple(end), dxfattribs={"layer": "A-ELEV-EDGE"})
        if lines.checkpoints is not None:
            near = np.flatnonzero(wall.near(lines.checkpoints.points_world))
            _add_points(
                space,
                [lines.checkpoints.names[index] for index in near],
                wall.place_m(lines.checkpoints.points_world[near]),
            )
    save_document(document, path)


def write_room_dxf(path: Path, walls: Sequence[DrawnWall], lines: RoomLines) -> None:
    """Write a room in scan coordinates, with a user coordinate system `wall_<k>` per wall.

    The layers are those of `LAYERS` for walls: edges, the outline at floor height, faces between
    floor and ceiling, openings, surveyed points, and each orthoimage at its position.

    Raises:
        StoreError: the file cannot be written.
    """
    document, space = _wall_document()
    for wall in walls:
        _add_placed_wall(document, space, wall)
    for index, name in enumerate(lines.planes.names):
        middle = lines.planes.corners[index].mean(axis=0)
        _add_text(space, name, middle, "A-ANNO-TEXT")
    for edge in lines.edges:
        begin, end = edge.ends_world
        space.add_line(tuple(begin), tuple(end), dxfattribs={"layer": "A-WALL-EDGE"})
    for opening in lines.openings:
        _add_polygon(space, opening.outline_world, "A-WALL-OPNG")
    _add_outline(space, lines)
    if lines.checkpoints is not None:
        _add_points(space, lines.checkpoints.names, lines.checkpoints.points_world)
    save_document(document, path)


def new_document(layers: Layers, text_m: float, version: str = _VERSION) -> Drawing:
    """Return a new document in metres, with layers and a dimension style with this text height."""
    from ezdxf.filemanagement import new

    document = new(version, setup=True, units=_METRES)
    for name, (description, colour, weight) in layers.items():
        document.layers.add(name, color=colour, lineweight=weight).description = description
    _add_dimension_style(document, text_m)
    return document


def _wall_document() -> tuple[Drawing, Modelspace]:
    document = new_document(LAYERS, _TEXT_M)
    _add_blocks(document)
    # LibreCAD uses the limits of paper space, in metres, as the paper size: A3.
    document.paperspace().dxf.limmax = (0.42, 0.297)
    return document, document.modelspace()


def _add_dimension_style(document: Drawing, text_m: float) -> None:
    """Define the dimension style: metres with three decimals, text above the line.

    The header contains the same values, because some programs redraw dimensions using only the
    header.
    """
    style = document.dimstyles.add(DIMENSION_STYLE)
    values = {
        "dimtxt": text_m,
        "dimasz": 0.8 * text_m,
        "dimexe": 0.4 * text_m,
        "dimexo": 0.4 * text_m,
        "dimgap": 0.3 * text_m,
        "dimdec": 3,
        "dimdsep": ord("."),
        "dimzin": 0,
        "dimlfac": 1.0,
        "dimtad": 1,
        "dimtih": 0,
        "dimtoh": 0,
    }
    for name, value in values.items():
        setattr(style.dxf, name, value)
        document.header[f"${name.upper()}"] = value
    document.header["$DIMSTYLE"] = DIMENSION_STYLE
    style.set_arrows(blk="OBLIQUE")


def _add_blocks(document: Drawing) -> None:
    size = 0.4 * _TEXT_M
    point = document.blocks.new(_POINT_BLOCK)
    point.add_line((-size, 0), (size, 0))
    point.add_line((0, -size), (0, size))
    point.add_circle((0, 0), 0.6 * size)
    point.add_attdef("NAME", (1.2 * size, 0.4 * size), height=_TEXT_M, dxfattribs=_UNSEEN)
    level = document.blocks.new(_LEVEL_BLOCK)
    level.add_lwpolyline([(0, 0), (size, 1.4 * size), (-size, 1.4 * size)], close=True)
    level.add_line((-size, 0), (10 * size, 0))
    level.add_attdef("HEIGHT", (1.6 * size, 0.4 * size), height=_TEXT_M, dxfattribs=_UNSEEN)


def _add_grid(space: Modelspace, low: NDArray[np.float64], high: NDArray[np.float64]) -> None:
    longest = float((high - low).max())
    step = nice_step(longest / _MOST_LINES)
    for axis in (0, 1):
        first = math.ceil(low[axis] / step - 1e-9)
        for k in range(first, math.floor(high[axis] / step + 1e-9) + 1):
            begin, end = low.copy(), high.copy()
            begin[axis] = end[axis] = k * step
            grid = {"layer": "A-ANNO-GRID"}
            space.add_line(tuple(begin), tuple(end), dxfattribs=grid)
            place = begin - ([0.0, 2 * _TEXT_M] if axis == 0 else [5 * _TEXT_M, 0.5 * _TEXT_M])
            _add_text(space, f"{k * step:g}", place, "A-ANNO-GRID")


def _add_level(space: Modelspace, x: float, height_m: float) -> None:
    mark = space.add_blockref(
        _LEVEL_BLOCK, (x + 2 * _TEXT_M, height_m), dxfattribs={"layer": "A-ANNO-LEVL"}
    )
    mark.add_auto_attribs({"HEIGHT": f"{height_m:+.3f}"})
    place = np.array([x + 2.8 * _TEXT_M, height_m + 0.3 * _TEXT_M])
    _add_text(space, f"{height_m:+.3f}", place, "A-ANNO-LEVL")


def _add_opening(
    space: Modelspace, outline_m: NDArray[np.float64], sigma_m: float | None, words: str
) -> None:
    regular = regular_opening(outline_m, sigma_m)
    _add_polygon(space, regular.outline_m, "A-ELEV-OPNG")
    low, high = regular.outline_m.min(axis=0), regular.outline_m.max(axis=0)
    if min(high - low) > 6 * _TEXT_M:
        _add_dimension(space, low, np.array([high[0], low[1]]), 2 * _TEXT_M)
        _add_dimension(space, low, np.array([low[0], high[1]]), -2 * _TEXT_M)
    rows = words.split(", ")
    if regular.kind != "outline":
        rows.append(f"{regular.kind}, deviation {1e3 * regular.deviation_m:.0f} mm")
    for row, text in enumerate(rows, start=1):
        place = np.array([low[0] + 3 * _TEXT_M, high[1] - row * _ROW_M])
        _add_text(space, text, place, "A-ANNO-TEXT")


def _add_dimension(
    space: Modelspace, begin: NDArray[np.float64], end: NDArray[np.float64], distance_m: float
) -> None:
    space.add_aligned_dim(
        p1=tuple(begin),
        p2=tuple(end),
        distance=distance_m,
        dimstyle=DIMENSION_STYLE,
        dxfattribs={"layer": "A-ANNO-DIMS"},
    ).render()


def _add_placed_wall(document: Drawing, space: Modelspace, wall: DrawnWall) -> None:
    frame = wall.frame
    axes = {"origin": frame.origin_world, "xaxis": frame.u_world, "yaxis": -frame.v_world}
    document.ucs.add(
        f"wall_{wall.number}",
        dxfattribs={name: tuple(vector.tolist()) for name, vector in axes.items()},
    )
    if frame.bend is not None:
        # Images are flat, so a curved wall is placed by its outline.
        outline = frame.outline_world().tolist()
        space.add_polyline3d(outline, dxfattribs={"layer": "A-WALL-OTLN"})
    elif wall.image:
        definition = document.add_image_def(wall.image, (frame.width, frame.height))
        bottom_left = frame.corners_world()[1]
        layer = {"layer": "A-ELEV-IMAG"}
        image = space.add_image(
            definition, tuple(bottom_left.tolist()), (1.0, 1.0), dxfattribs=layer
        )
        image.dxf.u_pixel = tuple((frame.gsd_m * frame.u_world).tolist())
        image.dxf.v_pixel = tuple((-frame.gsd_m * frame.v_world).tolist())


def _add_outline(space: Modelspace, lines: RoomLines) -> None:
    outline = lines.outline
    is_upright = float(lines.planes.up[2]) == 1.0
    for points, is_closed in zip(outline.chains_world, outline.closed, strict=True):
        layer = {"layer": "A-WALL-OTLN"}
        if is_upright:
            flat = space.add_lwpolyline(points[:, :2].tolist(), close=is_closed, dxfattribs=layer)
            flat.dxf.elevation = outline.floor_m
        else:
            space.add_polyline3d(points.tolist(), close=is_closed, dxfattribs=layer)
    for face in outline.faces_world:
        space.add_3dface(face.tolist(), dxfattribs={"layer": "A-WALL-FACE"})


def _add_polygon(space: Modelspace, corners: NDArray[np.float64], layer: str) -> None:
    if corners.shape[1] == 2:
        space.add_lwpolyline(corners.tolist(), close=True, dxfattribs={"layer": layer})
    else:
        space.add_polyline3d(corners.tolist(), close=True, dxfattribs={"layer": layer})


def _add_points(space: Modelspace, names: Iterable[str], places: NDArray[np.float64]) -> None:
    for name, place in zip(names, places, strict=True):
        mark = space.add_blockref(
            _POINT_BLOCK, tuple(place.tolist()), dxfattribs={"layer": "A-SURV-PNTS"}
        )
        mark.add_auto_attribs({"NAME": shown(name)})
        beside = place + np.array([0.6, 0.3, 0.0])[: len(place)] * _TEXT_M
        _add_text(space, name, beside, "A-SURV-PNTS")


def _add_text(space: Modelspace, text: str, place: NDArray[np.float64], layer: str) -> None:
    """Add a label with a leader, moved down until it overlaps no other label in plan view."""
    added = space.add_text(shown(text), height=_TEXT_M, dxfattribs={"layer": layer})
    placed = space.query("TEXT")[:-1]
    others = [(*one.dxf.insert.vec2, len(one.dxf.text)) for one in placed]
    left, low, n_letters = np.array(others, dtype=np.float64).reshape(-1, 3).T
    wanted, place = place, place.copy()
    while np.any(
        (left < place[0] + _LETTER_M * len(text))
        & (place[0] < left + _LETTER_M * n_letters)
        & (np.abs(low - place[1]) < _ROW_M - 1e-9)
    ):
        place[1] -= _ROW_M
    added.set_placement(tuple(place.tolist()))
    if place[1] < wanted[1]:
        space.add_line(tuple(wanted.tolist()), tuple(place.tolist()), dxfattribs={"layer": layer})


def save_document(document: Drawing, path: Path) -> None:
    """Write a document.

    Raises:
        StoreError: the file cannot be written.
    """
    stream = StringIO()
    document.write(stream)
    write_text(path, stream.getvalue())


_SAMPLE_M: Final = 0.01
# Permitted deviation of a side from a straight line, which is about the accuracy of masonry and of
# outlines.
_TOLERANCE_M: Final = 0.02
_SPRINGINGS: Final = 40
_ARC_POINTS: Final = 33


@dataclass(frozen=True, kw_only=True)
class RegularOpening:
    """A wall opening, approximated by a regular form.

    Attributes:
        kind: `rectangle`, `arch` (a rectangle under a circular segment), or `outline` if neither
            fits.
        outline_m: (n, 2) X and Y, counter-clockwise, not closed; arcs are divided into chords.
        deviation_m: maximum distance between the detected outline and this one.
    """

    kind: Literal["rectangle", "arch", "outline"]
    outline_m: NDArray[np.float64]
    deviation_m: float


def regular_opening(outline_m: NDArray[np.float64], sigma_m: float | None) -> RegularOpening:
    """Fit a rectangle, or else an arch, to an outline.

    Args:
        outline_m: (n, 2) X and Y on an upright wall, counter-clockwise.
        sigma_m: standard deviation of the positions of its sides, None if unknown.

    A form is accepted if 95 % of the outline is within three sigma or 20 mm, whichever is larger.
    """
    limit_m = max(_TOLERANCE_M, 3.0 * (sigma_m or 0.0))
    samples, directions = _sampled(outline_m)
    left, bottom, right, top = _sides(samples, directions)
    forms: dict[Literal["rectangle", "arch"], list[NDArray[np.float64]]] = {}
    if right > left and top > bottom:
        box = np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
        forms = {"rectangle": [box], "arch": _arches(samples, left, bottom, right)}
    for kind, candidates in forms.items():
        distances = [_distances(samples, form) for form in candidates]
        best = int(np.argmin(np.percentile(distances, 95.0, axis=1)))
        if np.percentile(distances[best], 95.0) <= limit_m:
            largest_m = float(distances[best].max())
            return RegularOpening(kind=kind, outline_m=candidates[best], deviation_m=largest_m)
    return RegularOpening(kind="outline", outline_m=outline_m, deviation_m=0.0)


def _sampled(outline_m: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return points sampled along an outline, and the direction of each point's side."""
    points, directions = [], []
    for begin, end in zip(outline_m, np.roll(outline_m, -1, axis=0), strict=True):
        length = float(np.linalg.norm(end - begin))
        if length > 0.0:
            count = max(2, int(length / _SAMPLE_M))
            shares = (np.arange(count) + 0.5) / count
            points.append(begin + shares[:, None] * (end - begin))
            directions.append(np.tile((end - begin) / length, (count, 1)))
    return np.concatenate(points), np.concatenate(directions)


def _sides(
    samples: NDArray[np.float64], directions: NDArray[np.float64]
) -> tuple[float, float, float, float]:
    """Return the left, bottom, right and top coordinate, each the median of that side's samples.

    In a counter-clockwise outline, the left side runs down, the bottom side to the right, and so
    on.
    """
    found = []
    for axis, direction in ((0, (0.0, -1.0)), (1, (1.0, 0.0)), (0, (0.0, 1.0)), (1, (-1.0, 0.0))):
        own = samples[directions @ np.array(direction) > 0.9, axis]
        is_low = direction in ((0.0, -1.0), (1.0, 0.0))
        edge = samples[:, axis].min() if is_low else samples[:, axis].max()
        found.append(float(np.median(own)) if len(own) else float(edge))
    return found[0], found[1], found[2], found[3]


def _arches(
    samples: NDArray[np.float64], left: float, bottom: float, right: float
) -> list[NDArray[np.float64]]:
    """Return candidate arches with the outline's apex, in descending order of springing height."""
    apex = float(samples[:, 1].max())
    half = 0.5 * (right - left)
    rises = np.linspace(0.0, min(half, apex - bottom), _SPRINGINGS + 1)[1:]
    found = []
    for rise in rises.tolist():
        radius = (half**2 + rise**2) / (2.0 * rise)
        middle = np.array([left + half, apex - radius])
        angle = np.arcsin(min(1.0, half / radius))
        turns = np.linspace(angle, -angle, _ARC_POINTS)
        arc = middle + radius * np.column_stack([np.sin(turns), np.cos(turns)])
        found.append(np.vstack([[left, bottom], [right, bottom], arc]))
    return found


def _distances(points: NDArray[np.float64], outline: NDArray[np.float64]) -> NDArray[np.float64]:
    nearest = np.full(len(points), np.inf)
    for begin, end in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        side = end - begin
        square = float(side @ side)
        if square > 0.0:
            share = np.clip((points - begin) @ side / square, 0.0, 1.0)
            away = points - begin - share[:, None] * side
            nearest = np.minimum(nearest, np.linalg.norm(away, axis=1))
    return nearest
