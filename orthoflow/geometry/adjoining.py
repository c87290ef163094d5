"""Where planes of a room meet: lines between two of them, corners between three."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.planes import Plane

# Rectangles of points end before a corner that furniture hides, and reach past one at a reveal.
REACH_M: Final = 0.3
SHORTEST_M: Final = 0.1
# Planes that are nearer to parallel meet somewhere, but their line is not known well.
_LEAST_ANGLE_DEG: Final = 20.0

Interval = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A plane, and where it is known.

    Attributes:
        plane: it.
        rectangles_world: (m, 4, 3) metres, corners of the connected parts.
    """

    plane: Plane
    rectangles_world: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Edge:
    """A piece of the line in which two planes meet.

    Attributes:
        first: index of one plane.
        second: index of the other, larger.
        ends_world: (2, 3) metres.
    """

    first: int
    second: int
    ends_world: NDArray[np.float64]

    @property
    def length_m(self) -> float:
        """Its length."""
        return float(np.linalg.norm(self.ends_world[1] - self.ends_world[0]))


@dataclass(frozen=True, kw_only=True)
class Corner:
    """A point in which three planes meet.

    Attributes:
        planes: their indices, rising.
        point_world: (3,) metres.
    """

    planes: tuple[int, int, int]
    point_world: NDArray[np.float64]


def line_of(first: Plane, second: Plane) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """The line in which two planes meet: the point (3,) nearest to the origin, and its direction.

    None for planes that are nearly parallel.
    """
    direction = np.cross(first.normal, second.normal)
    size = float(np.linalg.norm(direction))
    if size < math.sin(math.radians(_LEAST_ANGLE_DEG)):
        return None
    direction /= size
    rows = np.array([first.normal, second.normal, direction])
    point = np.linalg.solve(rows, np.array([first.offset_m, second.offset_m, 0.0]))
    return point, direction


def edges_between(surfaces: Sequence[Surface], *, reach_m: float = REACH_M) -> tuple[Edge, ...]:
    """Pieces of the lines along which planes adjoin.

    A piece is where both planes are known within a distance of the line.

    Args:
        surfaces: planes with their rectangles.
        reach_m: that distance.
    """
    found = []
    for (i, first), (j, second) in combinations(enumerate(surfaces), 2):
        line = line_of(first.plane, second.plane)
        if line is None:
            continue
        # From a point near both, so that survey coordinates lose nothing.
        point, direction = line
        middle = first.rectangles_world.mean(axis=(0, 1))
        start = point + ((middle - point) @ direction) * direction
        spans = [_spans(surface, start, direction, reach_m) for surface in (first, second)]
        found += [
            Edge(first=i, second=j, ends_world=start + np.outer(span, direction))
            for span in _common(*spans)
        ]
    return tuple(found)


def corners_between(
    surfaces: Sequence[Surface], edges: Sequence[Edge], *, reach_m: float = REACH_M
) -> tuple[Corner, ...]:
    """Points in which three planes meet that adjoin each other there."""
    by_pair: dict[tuple[int, int], list[Edge]] = {}
    for edge in edges:
        by_pair.setdefault((edge.first, edge.second), []).append(edge)
    used = sorted({index for pair in by_pair for index in pair})
    found = []
    for i, j, k in combinations(used, 3):
        pairs = [by_pair.get(pair) for pair in ((i, j), (i, k), (j, k))]
        if not all(pairs):
            continue
        planes = [surfaces[index].plane for index in (i, j, k)]
        normals = np.array([plane.normal for plane in planes])
        if abs(float(np.linalg.det(normals))) < math.sin(math.radians(_LEAST_ANGLE_DEG)) ** 2:
            continue
        # About a point nearby, so that survey coordinates lose nothing.
        near = surfaces[i].rectangles_world.mean(axis=(0, 1))
        rest = [plane.offset_m - float(plane.normal @ near) for plane in planes]
        point = near + np.linalg.solve(normals, np.array(rest))
        if all(min(_distance(edge, point) for edge in pair or ()) <= reach_m for pair in pairs):
            found.append(Corner(planes=(i, j, k), point_world=point))
    return tuple(found)


def _spans(
    surface: Surface, start: NDArray[np.float64], direction: NDArray[np.float64], reach_m: float
) -> list[Interval]:
    """Where along a line a surface is known near it: separate intervals, rising."""
    aside = np.cross(surface.plane.normal, direction)
    spans = []
    for corners in surface.rectangles_world:
        relative = corners - start
        outline = np.column_stack([relative @ direction, relative @ aside])
        for sign in (1.0, -1.0):
            outline = _clipped(outline, sign, reach_m)
        if len(outline):
            spans.append((float(outline[:, 0].min()), float(outline[:, 0].max())))
    return _merged(spans)


def _clipped(outline: NDArray[np.float64], sign: float, limit: float) -> NDArray[np.float64]:
    """The part of a polygon (n, 2) where `sign * y` is at most a limit."""
    kept: list[NDArray[np.float64]] = []
    for here, there in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        over, next_over = sign * here[1] - limit, sign * there[1] - limit
        if over <= 0.0:
            kept.append(here)
        if (over <= 0.0) != (next_over <= 0.0):
            kept.append(here + over / (over - next_over) * (there - here))
    return np.array(kept).reshape(-1, 2)


def _merged(spans: list[Interval]) -> list[Interval]:
    merged: list[Interval] = []
    for low, high in sorted(spans):
        if merged and low <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(high, merged[-1][1]))
        else:
            merged.append((low, high))
    return merged


def _common(first: list[Interval], second: list[Interval]) -> Iterator[Interval]:
    for (low, high), (other_low, other_high) in product(first, second):
        begin, end = max(low, other_low), min(high, other_high)
        if end - begin >= SHORTEST_M:
            yield begin, end


def _distance(edge: Edge, point: NDArray[np.float64]) -> float:
    """Distance of a point from a piece of a line."""
    begin, end = edge.ends_world
    along = float(np.clip((point - begin) @ (end - begin) / edge.length_m**2, 0.0, 1.0))
    return float(np.linalg.norm(point - begin - along * (end - begin)))
