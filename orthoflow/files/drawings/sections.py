"""Plans and sections: the intersection of a cutting plane with a room, and lines beyond it.

Cut lines are exact intersections of the cutting plane with detected planes; they end where the
points end or where another plane meets them. Points in a thin slab around the cutting plane that
are not near such a line are kept as points. X and Y of the drawing are metres: for a plan, (e1, e2)
of the right-handed frame (e1, e2, up); for a section, the distance from its first point and the
height.
"""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import ArgumentError
from orthoflow.files.drawings import pens
from orthoflow.files.drawings.dxf import DIMENSION_STYLE, Layers, new_document, save_document
from orthoflow.files.drawings.key_plans import is_map_crs, marked_plan, surfaces_of, up_label
from orthoflow.files.drawings.sheet_contents import (
    Axes,
    Drawing,
    Picture,
    Placed,
    SheetText,
    up_words,
)
from orthoflow.files.drawings.words import Language, Phrase, label, numerals
from orthoflow.geometry.frames import basis_from_up
from orthoflow.geometry.outlines import edges_between
from orthoflow.products import Opening, Planes, PointCloud, PointLabels
from orthoflow.untrusted_text import shown

if TYPE_CHECKING:
    from ezdxf.document import Drawing as Document
    from ezdxf.layouts.layout import Modelspace
    from ezdxf.math import Vec2

# Planes that meet the cutting plane at a smaller angle have no well-defined line of intersection.
_LEAST_ANGLE_DEG: Final = 20.0
# Longer stretches without points are drawn as openings; shorter ones are gaps between points.
_LEAST_OPENING_M: Final = 0.15
# Furniture may hide the end of a line. If its points end within this distance of the corner with
# another line, it is extended to the corner.
_REACH_M: Final = 0.3
_SHORTEST_M: Final = 0.05
# Minimum and maximum thickness of a wall, between two sides that face away from each other.
_THICKNESS_M: Final = (0.04, 1.5)
_MOST_POINTS: Final = 30_000
# Points away from lines are drawn if a cell of this side has at least this many; fewer are noise.
_CROWD_M: Final = 0.05
_CROWD_POINTS: Final = 3
_BLOCK: Final = 4_000_000
# Horizontal planes with at least this share of the largest one's area count as floors.
_FLOOR_SHARE: Final = 0.2


@dataclass(frozen=True, kw_only=True)
class Cut:
    """A cutting plane.

    Attributes:
        origin_world: (3,) metres, where X and Y of the drawing are zero.
        x_world: (3,) unit vector to the right of the drawing.
        y_world: (3,) unit vector upwards on it.
        forward_world: (3,) unit vector, the direction of view.
        title: title in the drawing.
    """

    origin_world: NDArray[np.float64]
    x_world: NDArray[np.float64]
    y_world: NDArray[np.float64]
    forward_world: NDArray[np.float64]
    title: str

    def place_m(self, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return X, Y and the distance beyond the cut (n, 3), in metres, of world points (n, 3)."""
        axes = np.array([self.x_world, self.y_world, self.forward_world])
        return np.asarray((points_world - self.origin_world) @ axes.T)


@dataclass(frozen=True, kw_only=True)
class CutLine:
    """A cut line.

    Attributes:
        plane: index of the line's plane in `planes.json`.
        ends_m: (2, 2) X and Y of both ends.
        behind: (2,) unit vector away from the room, into the wall.
        thickness_m: distance to the other side of the wall; NaN if the other side was not detected.
    """

    plane: int
    ends_m: NDArray[np.float64]
    behind: NDArray[np.float64]
    thickness_m: float

    @property
    def length_m(self) -> float:
        """Length of the line in metres."""
        return float(np.linalg.norm(self.ends_m[1] - self.ends_m[0]))


@dataclass(frozen=True, kw_only=True)
class Section:
    """The content of a plan or section.

    Attributes:
        cut: the cutting plane.
        lines: the cut lines.
        gaps_m: (g, 2, 2) stretches of cut planes without points: doors, windows and occlusions.
        beyond_m: (b, 2, 2) edges and outlines of openings beyond the cut.
        points_m: (p, 2) thinned points of the slab that are not near any line.
        slab_m: thickness of the slab from which points were used; 0 if there is no cloud.
        n_points: number of points in the slab.
    """

    cut: Cut
    lines: tuple[CutLine, ...]
    gaps_m: NDArray[np.float64]
    beyond_m: NDArray[np.float64]
    points_m: NDArray[np.float64]
    slab_m: float
    n_points: int

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """Return left, bottom, right and top of the drawing."""
        drawn = [line.ends_m for line in self.lines]
        drawn += [self.gaps_m.reshape(-1, 2), self.beyond_m.reshape(-1, 2), self.points_m]
        places = np.concatenate(drawn)
        (left, bottom), (right, top) = places.min(axis=0), places.max(axis=0)
        return float(left), float(bottom), float(right), float(top)


def plan_cut(planes: Planes, height_m: float, language: Language = "en") -> Cut:
    """Return a horizontal cut, `height_m` above the lowest large floor or, without one, above 0."""
    e1, e2, up = basis_from_up(planes.up)
    area = _areas_m2(planes)
    level = planes.normal @ up > math.cos(math.radians(_LEAST_ANGLE_DEG))
    heights = planes.corners.mean(axis=1) @ up
    if level.any():
        large = np.flatnonzero(level & (area >= _FLOOR_SHARE * area[level].max()))
        floor = int(large[np.argmin(heights[large])])
        world_m = float(heights[floor]) + height_m
        floor_words = f"{label('floor', language)} {floor}"
        title = label("above", language, height=f"{height_m:.2f} m", floor=floor_words) + ", "
    else:
        world_m, title = height_m, ""
    title += f"{label('height', language)} {numerals(f'{world_m:.3f} m', language)}"
    return Cut(origin_world=world_m * up, x_world=e1, y_world=e2, forward_world=-up, title=title)


def section_cut(planes: Planes, through: Sequence[float], language: Language = "en") -> Cut:
    """Return a vertical cut through two points (x, y, x, y) of a plan; the first is on the left.

    Raises:
        ArgumentError: the two points are identical.
    """
    e1, e2, up = basis_from_up(planes.up)
    first, second = (x * e1 + y * e2 for x, y in np.reshape(through, (2, 2)))
    length_m = float(np.linalg.norm(second - first))
    if length_m < 1e-6:
        raise ArgumentError(
            "--through must be two different points, X,Y,X,Y, but both are the same"
        )
    right = (second - first) / length_m
    values = dict(zip("abcd", (f"{value:.2f}" for value in through), strict=True))
    return Cut(
        origin_world=first,
        x_world=right,
        y_world=up,
        forward_world=np.cross(up, right),
        title=label("through", language, **values),
    )


def section_of(
    cut: Cut,
    planes: Planes,
    openings: Sequence[Opening] = (),
    cloud: PointCloud | None = None,
    labels: PointLabels | None = None,
) -> Section:
    """Compute the content of a cut.

    Args:
        cut: the cutting plane.
        planes: planes of the room.
        openings: openings of the walls.
        cloud: the points; if None, lines extend as far as the rectangles of the planes.
        labels: the plane of each point.

    Raises:
        ArgumentError: the cut meets no plane.
    """
    slab_m, places, plane = _slab(cut, cloud, labels)
    lines, gaps = _drawn(cut, planes, places, plane, slab_m)
    if not lines and len(places) == 0:
        raise ArgumentError(
            f"the cut ({cut.title}) does not intersect the room; use scan coordinates, in metres"
        )
    return Section(
        cut=cut,
        lines=tuple(_with_thickness(lines)),
        gaps_m=np.array(gaps).reshape(-1, 2, 2),
        beyond_m=_beyond(cut, planes, openings),
        points_m=_thinned(_unexplained(places, lines, slab_m)),
        slab_m=slab_m,
        n_points=len(places),
    )


def _areas_m2(planes: Planes) -> NDArray[np.float64]:
    sides = planes.corners[:, 1] - planes.corners[:, 0], planes.corners[:, 3] - planes.corners[:, 0]
    return np.asarray(np.linalg.norm(sides[0], axis=1) * np.linalg.norm(sides[1], axis=1))


def _slab(
    cut: Cut, cloud: PointCloud | None, labels: PointLabels | None
) -> tuple[float, NDArray[np.float64], NDArray[np.int64]]:
    """Return the slab's thickness, X and Y of its points, and the plane of each point, or -1."""
    if cloud is None or len(cloud) == 0:
        return 0.0, np.empty((0, 2)), np.empty(0, dtype=np.int64)
    slab_m = 0.02
    found = []
    while True:
        found = list(_within(cut, cloud, labels, 0.5 * slab_m))
        n_points = sum(len(places) for places, _ in found)
        # Enlarge the slab until there is a point every few centimetres along walls, up to a
        # maximum.
        if n_points >= 2000 or slab_m >= 0.16:
            break
        slab_m *= 2.0
    places = np.concatenate([places for places, _ in found])
    return slab_m, places, np.concatenate([plane for _, plane in found])


def _within(
    cut: Cut, cloud: PointCloud, labels: PointLabels | None, reach_m: float
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.int64]]]:
    for first in range(0, len(cloud), _BLOCK):
        block = slice(first, min(len(cloud), first + _BLOCK))
        forward = cut.forward_world.astype(np.float32)
        away = np.float32((cloud.origin - cut.origin_world) @ cut.forward_world)
        beyond = away + (
            forward[0] * cloud.x[block] + forward[1] * cloud.y[block] + forward[2] * cloud.z[block]
        )
        index = first + np.flatnonzero(np.abs(beyond) <= reach_m)
        places = cut.place_m(cloud.points_world(index))[:, :2]
        plane = np.full(len(index), -1) if labels is None else labels.plane_index[index]
        yield places, np.asarray(plane, dtype=np.int64)


def _drawn(
    cut: Cut,
    planes: Planes,
    places: NDArray[np.float64],
    plane: NDArray[np.int64],
    slab_m: float,
) -> tuple[list[CutLine], list[NDArray[np.float64]]]:
    traces = {}
    for index, surface in enumerate(surfaces_of(planes)):
        trace = _trace(cut, planes, index)
        if trace is not None:
            spans = [
                span
                for rectangle in surface.rectangles_world
                if (span := _crossed(cut, rectangle, trace)) is not None
            ]
            if spans:
                traces[index] = (trace, _joined(spans, _LEAST_OPENING_M))
    lines, gaps = [], []
    for index, ((point, direction, behind), spans) in traces.items():
        if len(places):
            own = places[plane == index] if (plane >= 0).any() else places
            offset = (own - point) @ behind
            # The tolerance covers the noise of the plane and its inclination within the slab.
            near = np.abs(offset) <= 3.0 * float(planes.rms_m[index]) + 0.5 * slab_m
            # Rounding to millimetres leaves few values.
            along = np.unique(np.round((own[near] - point) @ direction, 3)).tolist()
            seen = _joined(zip(along, along, strict=True), _LEAST_OPENING_M)
            known = [part for span in spans for part in _shared(span, seen)]
        else:
            known = spans
        others = [trace for other, (trace, _) in traces.items() if other != index]
        meets = [s for trace in others if (s := _meeting(point, direction, trace)) is not None]
        ends = [_snapped(span, meets) for span in known]
        ends = _joined([span for span in ends if span[1] - span[0] >= _SHORTEST_M], 1e-6)
        lines += [
            CutLine(
                plane=index,
                ends_m=point + np.outer(span, direction),
                behind=behind,
                thickness_m=math.nan,
            )
            for span in ends
        ]
        gaps += [
            point + np.outer([before[1], after[0]], direction)
            for before, after in itertools.pairwise(ends)
        ]
    return lines, gaps


_Trace = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
_Span = tuple[float, float]


def _trace(cut: Cut, planes: Planes, index: int) -> _Trace | None:
    """Return a point on a plane's cut line, the line's direction, and the side of the solid."""
    normal = planes.normal[index]
    in_cut = np.array([normal @ cut.x_world, normal @ cut.y_world])
    size = float(np.linalg.norm(in_cut))
    if size < math.sin(math.radians(_LEAST_ANGLE_DEG)):
        return None
    middle = cut.place_m(planes.corners[index].mean(axis=0)[None])[0]
    # Of the points on both the plane and the cut, this is the nearest to the middle of the plane.
    away = float(normal @ cut.forward_world) * middle[2] / size**2
    point = middle[:2] + away * in_cut
    towards = in_cut / size
    return point, np.array([-towards[1], towards[0]]), -towards


def _crossed(cut: Cut, rectangle_world: NDArray[np.float64], trace: _Trace) -> _Span | None:
    """Return the part of a line that is inside a rectangle (4, 3)."""
    places = cut.place_m(rectangle_world)
    crossings = []
    for begin, end in zip(places, np.roll(places, -1, axis=0), strict=True):
        if (begin[2] > 0.0) != (end[2] > 0.0):
            share = begin[2] / (begin[2] - end[2])
            crossings.append(begin[:2] + share * (end[:2] - begin[:2]))
    if len(crossings) < 2:
        return None
    point, direction, _ = trace
    along = [float((crossing - point) @ direction) for crossing in crossings]
    return min(along), max(along)


def _joined(spans: Iterable[_Span], gap_m: float) -> list[_Span]:
    found: list[_Span] = []
    for begin, end in sorted(spans):
        if found and begin - found[-1][1] <= gap_m:
            found[-1] = (found[-1][0], max(found[-1][1], end))
        else:
            found.append((begin, end))
    return found


def _shared(span: _Span, others: Sequence[_Span]) -> list[_Span]:
    parts = [(max(span[0], begin), min(span[1], end)) for begin, end in others]
    return [part for part in parts if part[1] > part[0]]


def _meeting(
    point: NDArray[np.float64], direction: NDArray[np.float64], other: _Trace
) -> float | None:
    """Return the position along a line where it meets another."""
    other_point, _, normal = other
    slope = float(direction @ normal)
    if abs(slope) < math.sin(math.radians(_LEAST_ANGLE_DEG)):
        return None
    return float((other_point - point) @ normal) / slope


def _snapped(span: _Span, meets: Sequence[float]) -> _Span:
    """Move the ends of a span to nearby corners."""

    def moved(end: float) -> float:
        near = [place for place in meets if abs(place - end) <= _REACH_M]
        return min(near, key=lambda place: abs(place - end)) if near else end

    begin, end = moved(span[0]), moved(span[1])
    return (begin, end) if end > begin else span


def _with_thickness(lines: Sequence[CutLine]) -> Iterator[CutLine]:
    """Set the thickness of walls whose other side was also detected."""
    for line in lines:
        middle = line.ends_m.mean(axis=0)
        found = []
        for other in lines:
            if float(other.behind @ line.behind) > -math.cos(math.radians(5.0)):
                continue
            apart = float((other.ends_m.mean(axis=0) - middle) @ line.behind)
            direction = (line.ends_m[1] - line.ends_m[0]) / line.length_m
            own, its = (
                sorted(float(end @ direction) for end in one.ends_m) for one in (line, other)
            )
            overlap = min(own[1], its[1]) - max(own[0], its[0])
            if _THICKNESS_M[0] <= apart <= _THICKNESS_M[1] and overlap >= 0.5 * line.length_m:
                found.append(apart)
        yield replace(line, thickness_m=min(found, default=math.nan))


def _beyond(cut: Cut, planes: Planes, openings: Sequence[Opening]) -> NDArray[np.float64]:
    ends = [edge.ends_world for edge in edges_between(surfaces_of(planes))]
    for opening in openings:
        corners = opening.outline_world
        ends += [np.array(pair) for pair in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    found = []
    for pair in ends:
        begin, end = cut.place_m(pair)
        if max(begin[2], end[2]) <= 1e-9:
            continue
        low, high = (begin, end) if begin[2] < end[2] else (end, begin)
        if low[2] < 0.0:
            low += (high - low) * (-low[2] / (high[2] - low[2]))
        if np.linalg.norm(end[:2] - begin[:2]) >= _SHORTEST_M:
            found.append([begin[:2], end[:2]])
    return np.array(found).reshape(-1, 2, 2)


def _unexplained(
    places: NDArray[np.float64], lines: Sequence[CutLine], slab_m: float
) -> NDArray[np.float64]:
    free = np.ones(len(places), dtype=bool)
    for line in lines:
        direction = (line.ends_m[1] - line.ends_m[0]) / max(line.length_m, 1e-9)
        relative = places - line.ends_m[0]
        along = relative @ direction
        near = np.abs(relative @ line.behind) <= max(0.03, slab_m)
        free &= ~(near & (along > -_SHORTEST_M) & (along < line.length_m + _SHORTEST_M))
    return places[free]


def _thinned(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return one point per cell of a grid adapted to the number of points; omit isolated points."""
    if len(places) == 0:
        return places
    _, cell, n_in_cell = np.unique(
        np.floor(places / _CROWD_M), axis=0, return_inverse=True, return_counts=True
    )
    places = places[n_in_cell[cell.ravel()] >= _CROWD_POINTS]
    _, first = np.unique(np.floor(places / 0.01), axis=0, return_index=True)
    return places[np.sort(first)][:: math.ceil(len(first) / _MOST_POINTS) or 1]


LAYERS: Final[Layers] = {
    "A-SECT-MCUT": ("cut lines", 7, 50),
    "A-SECT-MBND": ("edges beyond the cut", 8, 13),
    "A-SECT-PATT": ("hatching of solid parts", 8, 13),
    "A-SECT-HIDN": ("cut lines without scan points", 8, 13),
    "A-SECT-SCAN": ("scan points away from the lines", 9, 13),
    "A-ANNO-DIMS": ("dimensions", 7, 18),
}
# Text height on paper in millimetres.
_TEXT_MM: Final = 2.5
_SOLID_MM: Final = 3.0
# Margin around the cut lines for hatching and dimensions.
_AROUND_MM: Final = 2.0 + _SOLID_MM
_DIMENSIONS_MM: Final = 14.0
# Line widths of ISO 128 used on the page.
_WIDTHS_MM: Final = np.array([0.13, 0.25, 0.35, 0.5])


@dataclass(frozen=True, kw_only=True)
class SectionDrawing:
    """A plan or section to draw.

    Attributes:
        kind: `plan` or `section`.
        section: content of the plan or section.
        scale: denominator n of the scale 1 : n.
        origin: one line about the origin of the data.
        has_dimensions: whether cut lines are labelled with their lengths.
        language: language of labels.
    """

    kind: Literal["plan", "section"]
    section: Section
    scale: int
    origin: str
    has_dimensions: bool = False
    language: Language = "en"

    def mm(self, value: float) -> float:
        """Convert a length in millimetres on paper to metres in the drawing."""
        return 1e-3 * self.scale * value

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """Left, bottom, right and top of the drawing, with the margin around the cut lines."""
        around = self.mm(_DIMENSIONS_MM if self.has_dimensions else _AROUND_MM)
        left, bottom, right, top = self.section.bounds_m
        return left - around, bottom - around, right + around, top + around

    @property
    def notes(self) -> tuple[Phrase, ...]:
        """Notes on the content of the drawing and the number of points used."""
        if not self.section.slab_m:
            return (Phrase(key="thickness"),)
        values = {"mm": f"{1e3 * self.section.slab_m:.0f}", "count": f"{self.section.n_points:,}"}
        return Phrase(key="slab", values=values), Phrase(key="gaps"), Phrase(key="thickness")


def section_sheet(
    stem: str,
    drawing: SectionDrawing,
    planes: Planes,
    text: SheetText,
    *,
    grid: float,
    crs: str | None = None,
) -> Drawing:
    """Return the sheet of a plan or section.

    Args:
        stem: name of the sheet's files without suffix.
        drawing: the plan or section.
        planes: planes of the room, for the key plan.
        text: text on the sheet.
        grid: spacing of the grid crosses; 0 for no crosses.
        crs: coordinate system of the scan, None if it is not a map.
    """
    left, bottom, right, top = drawing.bounds_m
    cut, language = drawing.section.cut, drawing.language
    is_plan = drawing.kind == "plan"
    plan = None
    if not is_plan:
        x_m = np.array([drawing.section.bounds_m[0], drawing.section.bounds_m[2]])
        ends_world = cut.origin_world + np.outer(x_m, cut.x_world)
        plan = marked_plan(planes, ends_world, -cut.forward_world, is_map=is_map_crs(crs))
        phrase = Phrase(key="axes_section", values={"up": up_words(np.array(planes.up))})
    elif is_map_crs(crs):
        phrase = Phrase(key="axes_map", values={"crs": crs})
    else:
        phrase = Phrase(key="axes_level")
    return Drawing(
        stem=stem,
        size_m=(right - left, top - bottom),
        pictures={label(drawing.kind, language): Picture(draw=partial(_draw, drawing))},
        axes=Axes(across=(left, 1.0), down=(top, -1.0), phrase=phrase),
        text=replace(text, name=cut.title, notes=drawing.notes),
        scale=drawing.scale,
        plan=plan,
        grid=grid,
        language=language,
        north=(0.0, 1.0) if is_plan else None,
        up_label=up_label(planes.up, is_map=is_map_crs(crs)),
    )


def write_section(folder: Path, name: str, drawing: SectionDrawing) -> None:
    """Write `<name>.dxf` and `<name>.svg`."""
    document = _document(drawing)
    save_document(document, folder / f"{name}.dxf")
    _write_svg(folder / f"{name}.svg", document, drawing)


def _draw(drawing: SectionDrawing, placed: Placed) -> None:
    from ezdxf.addons.drawing import recorder

    left, _, _, top = drawing.bounds_m
    found = recorder.Recorder()
    _render(_document(drawing), found)

    def on_paper(points: Iterable[Vec2]) -> NDArray[np.float64]:
        return placed.on_paper(np.array([(point.x - left, top - point.y) for point in points]))

    with placed.clipped() as canvas:
        for record in found.records:
            weight = found.properties[record.property_hash].lineweight
            width_mm = float(_WIDTHS_MM[np.argmin(np.abs(_WIDTHS_MM - weight))])
            filled: list[NDArray[np.float64]] = []
            if isinstance(record, recorder.FilledPathsRecord):
                filled = [on_paper(path.flattening(drawing.mm(0.05))) for path in record.paths]
            elif isinstance(record, recorder.PathRecord):
                pens.line(
                    canvas, on_paper(record.path.flattening(drawing.mm(0.05))), width_mm=width_mm
                )
            elif isinstance(record, recorder.SolidLinesRecord):
                for ends in on_paper(record.lines.vertices()).reshape(-1, 2, 2):
                    pens.line(canvas, ends, width_mm=width_mm)
            elif isinstance(record, recorder.PointsRecord):
                points = on_paper(record.points.vertices())
                if len(points) == 1:
                    pens.box(
                        canvas, (*(points[0] - 0.5 * pens.FINE_MM), pens.FINE_MM, pens.FINE_MM)
                    )
                elif len(points) == 2:
                    pens.line(canvas, points, width_mm=width_mm)
                else:
                    filled = [points]
            pens.fill(canvas, filled)


def _render(document: Document, backend: Any) -> None:
    from ezdxf.addons.drawing import config
    from ezdxf.addons.drawing.frontend import Frontend
    from ezdxf.addons.drawing.properties import RenderContext

    configuration = config.Configuration(
        background_policy=config.BackgroundPolicy.WHITE,
        color_policy=config.ColorPolicy.BLACK,
        lineweight_policy=config.LineweightPolicy.ABSOLUTE,
    )
    # ezdxf shifts hatches by a small random amount; the output must be reproducible.
    state = random.getstate()
    random.seed(0)
    Frontend(RenderContext(document), backend, config=configuration).draw_layout(
        document.modelspace()
    )
    random.setstate(state)


def _document(drawing: SectionDrawing) -> Document:
    document = new_document(LAYERS, drawing.mm(_TEXT_MM), "R2018")
    document.layers.get("A-SECT-HIDN").dxf.linetype = "DASHED"
    document.header["$LTSCALE"] = drawing.mm(8.0)
    document.header["$PDMODE"] = 0
    space = document.modelspace()
    section = drawing.section
    for cut in section.lines:
        _add_solid(space, cut, drawing)
    for cut in section.lines:
        begin, end = cut.ends_m
        space.add_line(tuple(begin), tuple(end), dxfattribs={"layer": "A-SECT-MCUT"})
        if drawing.has_dimensions and cut.length_m >= drawing.mm(10.0):
            _add_dimension(space, cut, drawing)
    for holder, pairs in (("A-SECT-HIDN", section.gaps_m), ("A-SECT-MBND", section.beyond_m)):
        for begin, end in pairs:
            space.add_line(tuple(begin), tuple(end), dxfattribs={"layer": holder})
    for place in section.points_m:
        space.add_point(tuple(place), dxfattribs={"layer": "A-SECT-SCAN"})
    document.header.custom_vars.append("Title", shown(section.cut.title))
    document.header.custom_vars.append("Origin", shown(drawing.origin))
    return document


def _add_solid(space: Modelspace, cut: CutLine, drawing: SectionDrawing) -> None:
    """Hatch the solid behind a line up to the wall's other side, or a strip if it is unknown.

    If both sides of a wall were detected, it is hatched from the first one only.
    """
    is_known = math.isfinite(cut.thickness_m)
    if is_known and cut.behind @ [0.83, 0.56] < 0.0:
        return
    deep_m = cut.thickness_m if is_known else drawing.mm(_SOLID_MM)
    begin, end = cut.ends_m
    outline = [begin, end, end + deep_m * cut.behind, begin + deep_m * cut.behind]
    hatch = space.add_hatch(dxfattribs={"layer": "A-SECT-PATT"})
    # Lines of the pattern are 3.175 units apart, but must be 1.3 mm apart on paper.
    hatch.set_pattern_fill("ANSI31", scale=drawing.mm(1.3) / 3.175)
    hatch.paths.add_polyline_path([tuple(place) for place in outline], is_closed=True)


def _add_dimension(space: Modelspace, cut: CutLine, drawing: SectionDrawing) -> None:
    begin, end = cut.ends_m
    # Orient the dimension rightwards or upwards, so that its text is not upside down.
    if (end[0] - begin[0], end[1] - begin[1]) < (-1e-9 * cut.length_m, 0.0):
        begin, end = end, begin
    direction = (end - begin) / cut.length_m
    left = np.array([-direction[1], direction[0]])
    # Place the dimension outside the room, behind the cut line.
    side = 1.0 if left @ cut.behind >= 0.0 else -1.0
    space.add_aligned_dim(
        p1=tuple(begin),
        p2=tuple(end),
        distance=side * drawing.mm(8.0),
        dimstyle=DIMENSION_STYLE,
        dxfattribs={"layer": "A-ANNO-DIMS"},
    ).render()


def _write_svg(path: Path, document: Document, drawing: SectionDrawing) -> None:
    from ezdxf.addons.drawing import layout
    from ezdxf.addons.drawing.svg import SVGBackend
    from ezdxf.math import BoundingBox2d

    backend = SVGBackend()
    _render(document, backend)
    left, bottom, right, top = drawing.bounds_m
    size_mm = (1e3 * (right - left) / drawing.scale, 1e3 * (top - bottom) / drawing.scale)
    page = layout.Page(*size_mm, layout.Units.mm)
    settings = layout.Settings(fit_page=False, scale=1e3 / drawing.scale)
    shown_box = BoundingBox2d([(left, bottom), (right, top)])
    text = backend.get_string(page, settings=settings, render_box=shown_box)
    path.write_text(text, encoding="utf-8")
