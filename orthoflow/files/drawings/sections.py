"""Plans and sections: the intersection of a plane with a room, as lines, and what is beyond it.

Cut lines are exact: each is the intersection of the cutting plane with a detected plane, between
the positions where its points end or another plane meets it. Points of the slab that no such line
explains are kept as points. X and Y of the drawing are metres: for a plan (e1, e2) of the
right-handed frame (e1, e2, up), for a section the distance from its first point and the height.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import ArgumentError
from orthoflow.files.drawings.key_plans import surfaces_of
from orthoflow.files.drawings.words import Language, label
from orthoflow.geometry.frames import basis_from_up
from orthoflow.geometry.outlines import edges_between
from orthoflow.products import Opening, Planes, PointCloud, PointLabels

# Planes that the cut meets at a smaller angle have no sharp line in it.
_LEAST_ANGLE_DEG: Final = 20.0
# Longer stretches without points are drawn as openings; shorter ones are gaps between points.
_LEAST_OPENING_M: Final = 0.15
# A line is extended to the corner with another if its points end this close, e.g. behind furniture.
_REACH_M: Final = 0.3
_SHORTEST_M: Final = 0.05
# The two sides of a wall face away from each other and are at most this far apart.
_THICKNESS_M: Final = (0.04, 1.5)
_MOST_POINTS: Final = 30_000
# Unexplained points are drawn if this many are in a cell: others are noise.
_CROWD_M: Final = 0.05
_CROWD_POINTS: Final = 3
_BLOCK: Final = 4_000_000
# Level planes with at least this share of the area of the largest count as floors.
_FLOOR_SHARE: Final = 0.2


@dataclass(frozen=True, kw_only=True)
class Cut:
    """A cutting plane.

    Attributes:
        origin_world: (3,) metres, where X and Y of the drawing are zero.
        x_world: (3,) unit vector to the right of the drawing.
        y_world: (3,) unit vector upwards on it.
        forward_world: (3,) unit vector, the direction of view.
        title: its title in the drawing.
    """

    origin_world: NDArray[np.float64]
    x_world: NDArray[np.float64]
    y_world: NDArray[np.float64]
    forward_world: NDArray[np.float64]
    title: str

    def place_m(self, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return X, Y and distance beyond the cut (n, 3), metres, of world points (n, 3)."""
        axes = np.array([self.x_world, self.y_world, self.forward_world])
        return np.asarray((points_world - self.origin_world) @ axes.T)


@dataclass(frozen=True, kw_only=True)
class CutLine:
    """A cut line.

    Attributes:
        plane: place of its plane in `planes.json`.
        ends_m: (2, 2) X and Y.
        behind: (2,) unit vector away from the room, into the solid.
        thickness_m: distance to the other side of the wall if that was found too; else NaN.
    """

    plane: int
    ends_m: NDArray[np.float64]
    behind: NDArray[np.float64]
    thickness_m: float

    @property
    def length_m(self) -> float:
        """Its length."""
        return float(np.linalg.norm(self.ends_m[1] - self.ends_m[0]))


@dataclass(frozen=True, kw_only=True)
class Section:
    """The content of a plan or section.

    Attributes:
        cut: the cutting plane.
        lines: the cut lines.
        gaps_m: (g, 2, 2) stretches of cut planes without points: doors, windows, shadows.
        beyond_m: (b, 2, 2) edges and outlines of openings beyond the cut.
        points_m: (p, 2) points of the slab that no line explains, thinned.
        slab_m: thickness of the slab whose points were used; 0 without a cloud.
        n_points: number of points in it.
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
    """Cut horizontally above the lowest large floor; without a floor at that world height."""
    e1, e2, up = basis_from_up(planes.up)
    area = _areas_m2(planes)
    level = planes.normal @ up > math.cos(math.radians(_LEAST_ANGLE_DEG))
    heights = planes.corners.mean(axis=1) @ up
    if level.any():
        large = np.flatnonzero(level & (area >= _FLOOR_SHARE * area[level].max()))
        floor = int(large[np.argmin(heights[large])])
        world_m = float(heights[floor]) + height_m
        floor_words = f"{label('floor', language)} {floor}"
        title = f"{height_m:.2f} m {label('above', language)} {floor_words}, "
    else:
        world_m, title = height_m, ""
    title += f"{label('height', language)} {world_m:.3f} m"
    return Cut(origin_world=world_m * up, x_world=e1, y_world=e2, forward_world=-up, title=title)


def section_cut(planes: Planes, through: Sequence[float], language: Language = "en") -> Cut:
    """Cut vertically through two points (x, y, x, y) of a plan; the first is on the left.

    Raises:
        ArgumentError: both points are the same.
    """
    e1, e2, up = basis_from_up(planes.up)
    first, second = (x * e1 + y * e2 for x, y in np.reshape(through, (2, 2)))
    length_m = float(np.linalg.norm(second - first))
    if length_m < 1e-6:
        raise ArgumentError("--through takes two different places, X,Y,X,Y, got one twice")
    right = (second - first) / length_m
    words = ", ".join(f"({x:.2f}, {y:.2f})" for x, y in np.reshape(through, (2, 2)))
    return Cut(
        origin_world=first,
        x_world=right,
        y_world=up,
        forward_world=np.cross(up, right),
        title=f"{label('through', language)} {words}",
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
        openings: of its walls.
        cloud: the points; without them lines extend as far as the rectangles of the planes.
        labels: the plane of each point.

    Raises:
        ArgumentError: nothing is cut.
    """
    slab_m, places, plane = _slab(cut, cloud, labels)
    drawn = _drawn(cut, planes, places, plane, slab_m)
    lines, gaps = drawn
    if not lines and len(places) == 0:
        raise ArgumentError(
            f"the cut ({cut.title}) meets no plane and no point of the room; "
            f"its places are in metres, in the coordinates of the scan"
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
    """Return the slab's thickness, X and Y of its points, and their planes (-1 for none)."""
    if cloud is None or len(cloud) == 0:
        return 0.0, np.empty((0, 2)), np.empty(0, dtype=np.int64)
    slab_m = 0.02
    found = []
    while True:
        found = list(_within(cut, cloud, labels, 0.5 * slab_m))
        n_points = sum(len(places) for places, _ in found)
        # Thin enough for a point every few centimetres along walls, and never a thick slice.
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
    """Return the cut lines, and the gaps in them."""
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
            # The plane's own noise, and its distance from the cut line within the slab.
            near = np.abs(offset) <= 3.0 * float(planes.rms_m[index]) + 0.5 * slab_m
            along = np.sort((own[near] - point) @ direction)
            seen = _runs(along, _LEAST_OPENING_M)
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
    """Return a point of the line in which a plane is cut, its direction, and the solid side."""
    normal = planes.normal[index]
    in_cut = np.array([normal @ cut.x_world, normal @ cut.y_world])
    size = float(np.linalg.norm(in_cut))
    if size < math.sin(math.radians(_LEAST_ANGLE_DEG)):
        return None
    middle = cut.place_m(planes.corners[index].mean(axis=0)[None])[0]
    # n . p = offset, with p in the cut: from the middle of the plane to the nearest point of the
    # line.
    away = float(normal @ cut.forward_world) * middle[2] / size**2
    point = middle[:2] + away * in_cut
    towards = in_cut / size
    return point, np.array([-towards[1], towards[0]]), -towards


def _crossed(cut: Cut, rectangle_world: NDArray[np.float64], trace: _Trace) -> _Span | None:
    """Return the part of a line in a rectangle (4, 3)."""
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


def _joined(spans: Sequence[_Span], gap_m: float) -> list[_Span]:
    """Merge sorted spans that overlap or nearly meet."""
    found: list[_Span] = []
    for begin, end in sorted(spans):
        if found and begin - found[-1][1] <= gap_m:
            found[-1] = (found[-1][0], max(found[-1][1], end))
        else:
            found.append((begin, end))
    return found


def _runs(along: NDArray[np.float64], gap_m: float) -> list[_Span]:
    """Return stretches of ascending numbers without a larger gap."""
    if len(along) == 0:
        return []
    breaks = np.flatnonzero(np.diff(along) > gap_m)
    begins, ends = along[np.r_[0, breaks + 1]], along[np.r_[breaks, len(along) - 1]]
    return [(float(b), float(e)) for b, e in zip(begins, ends, strict=True)]


def _shared(span: _Span, others: Sequence[_Span]) -> list[_Span]:
    """Return parts of a span that others cover."""
    parts = [(max(span[0], begin), min(span[1], end)) for begin, end in others]
    return [part for part in parts if part[1] > part[0]]


def _meeting(
    point: NDArray[np.float64], direction: NDArray[np.float64], other: _Trace
) -> float | None:
    """Return where a line meets another, along itself."""
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
    """Set the distance of lines to the other side of their wall, if that is among them."""
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
        yield CutLine(
            plane=line.plane,
            ends_m=line.ends_m,
            behind=line.behind,
            thickness_m=min(found, default=math.nan),
        )


def _beyond(cut: Cut, planes: Planes, openings: Sequence[Opening]) -> NDArray[np.float64]:
    """Return edges of the room and outlines of openings behind the cut."""
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
    """Return points away from all lines."""
    free = np.ones(len(places), dtype=bool)
    for line in lines:
        direction = (line.ends_m[1] - line.ends_m[0]) / max(line.length_m, 1e-9)
        relative = places - line.ends_m[0]
        along = relative @ direction
        near = np.abs(relative @ line.behind) <= max(0.03, slab_m)
        free &= ~(near & (along > -_SHORTEST_M) & (along < line.length_m + _SHORTEST_M))
    return places[free]


def _thinned(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return one point per cell of a grid adapted to their number, without isolated ones."""
    if len(places) == 0:
        return places
    _, cell, n_in_cell = np.unique(
        np.floor(places / _CROWD_M), axis=0, return_inverse=True, return_counts=True
    )
    places = places[n_in_cell[cell.ravel()] >= _CROWD_POINTS]
    step_m = 0.01
    while len(places):
        _, first = np.unique(np.floor(places / step_m), axis=0, return_index=True)
        if len(first) <= _MOST_POINTS:
            return places[np.sort(first)]
        step_m *= 1.5
    return places
