"""Intersections of the planes of a room: lines between two of them, corners between three."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.planes import Plane

# Rectangles of points end before a corner that furniture hides, and extend past one at a reveal.
REACH_M: Final = 0.3
SHORTEST_M: Final = 0.1
# The intersection of planes that are closer to parallel is poorly determined.
_LEAST_ANGLE_DEG: Final = 20.0

Interval = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A plane and the region where it was measured.

    Attributes:
        plane: it.
        rectangles_world: (m, 4, 3) metres, corners of the connected parts.
    """

    plane: Plane
    rectangles_world: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Edge:
    """A segment of the line in which two planes intersect.

    Attributes:
        first: index of one plane.
        second: index of the other, larger plane.
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
    """A point in which three planes intersect.

    Attributes:
        planes: their indices, ascending.
        point_world: (3,) metres.
    """

    planes: tuple[int, int, int]
    point_world: NDArray[np.float64]


def line_of(first: Plane, second: Plane) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return the intersection line of two planes: its point (3,) nearest the origin, its direction.

    None for nearly parallel planes.
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
    """Return the segments of the lines along which planes adjoin.

    A segment is where both planes were measured within `reach_m` of the line.

    Args:
        surfaces: planes with their rectangles.
        reach_m: maximum distance from the line.
    """
    found = []
    for (i, first), (j, second) in combinations(enumerate(surfaces), 2):
        line = line_of(first.plane, second.plane)
        if line is None:
            continue
        # Solve about a point near both planes, so that survey coordinates lose no precision.
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
    """Return the points in which three planes that adjoin there intersect."""
    by_pair: dict[tuple[int, int], list[Edge]] = {}
    for edge in edges:
        by_pair.setdefault((edge.first, edge.second), []).append(edge)
    beyond: dict[int, set[int]] = {}
    for i, j in by_pair:
        beyond.setdefault(i, set()).add(j)
    triples = [
        (i, j, k) for i, j in sorted(by_pair) for k in sorted(beyond[i] & beyond.get(j, set()))
    ]
    if not triples:
        return ()
    at = np.array(triples)
    normals = np.array([surface.plane.normal for surface in surfaces])[at]
    offsets = np.array([surface.plane.offset_m for surface in surfaces])[at]
    meet = np.abs(np.linalg.det(normals)) >= math.sin(math.radians(_LEAST_ANGLE_DEG)) ** 2
    # Solve about a nearby point, so that survey coordinates lose no precision.
    middles = np.array([surface.rectangles_world.mean(axis=(0, 1)) for surface in surfaces])
    near = middles[at[meet, 0]]
    rest = offsets[meet] - np.einsum("nij,nj->ni", normals[meet], near)
    points = near + np.linalg.solve(normals[meet], rest[..., None])[..., 0]
    found = []
    for (i, j, k), point in zip(at[meet].tolist(), points, strict=True):
        pairs = [by_pair[pair] for pair in ((i, j), (i, k), (j, k))]
        if all(min(_distance(edge, point) for edge in pair) <= reach_m for pair in pairs):
            found.append(Corner(planes=(i, j, k), point_world=point))
    return tuple(found)


def _spans(
    surface: Surface, start: NDArray[np.float64], direction: NDArray[np.float64], reach_m: float
) -> list[Interval]:
    """Return the intervals of a line near which a surface was measured: disjoint, ascending."""
    relative = surface.rectangles_world - start
    along = relative @ direction
    aside = relative @ np.cross(surface.plane.normal, direction)
    # The part within reach of the line has its corners there and where its sides cross the limit.
    places = [np.where(np.abs(aside) <= reach_m, along, np.nan)]
    over = np.roll(aside, -1, axis=1) - aside
    for limit in (-reach_m, reach_m):
        with np.errstate(divide="ignore", invalid="ignore"):
            share = (limit - aside) / over
            crossing = along + share * (np.roll(along, -1, axis=1) - along)
        places.append(np.where((share > 0.0) & (share < 1.0), crossing, np.nan))
    reached = np.concatenate(places, axis=1)
    reached = reached[~np.isnan(reached).all(axis=1)]
    ends = np.column_stack([np.nanmin(reached, axis=1), np.nanmax(reached, axis=1)])
    return _merged([(low, high) for low, high in ends.tolist()])


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
    """Return the distance of a point from a line segment."""
    begin, end = edge.ends_world
    along = float(np.clip((point - begin) @ (end - begin) / edge.length_m**2, 0.0, 1.0))
    return float(np.linalg.norm(point - begin - along * (end - begin)))
