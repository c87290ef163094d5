"""Intersections of the planes of a room, and outlines of rooms in plan and in space."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.frames import LEVEL_LIMIT_DEG, Plane, basis_from_up

# The rectangle of a plane's points may end this far before a corner that is hidden by furniture, or
# extend this far beyond a corner with a reveal.
REACH_M: Final = 0.3
SHORTEST_M: Final = 0.1
# The intersection of two planes at a smaller angle is poorly determined.
_LEAST_ANGLE_DEG: Final = 20.0

Interval = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A plane and the region where it was measured.

    Attributes:
        plane: the plane.
        rectangles_world: (m, 4, 3) metres, corners of the rectangles around its connected parts.
    """

    plane: Plane
    rectangles_world: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Edge:
    """A segment of the intersection line of two planes.

    Attributes:
        first: index of one plane.
        second: index of the other plane, which is larger than the first index.
        ends_world: (2, 3) end points in metres.
    """

    first: int
    second: int
    ends_world: NDArray[np.float64]

    @property
    def length_m(self) -> float:
        """Length of the segment."""
        return float(np.linalg.norm(self.ends_world[1] - self.ends_world[0]))


@dataclass(frozen=True, kw_only=True)
class Corner:
    """Intersection point of three planes.

    Attributes:
        planes: indices of the planes, ascending.
        point_world: (3,) metres.
    """

    planes: tuple[int, int, int]
    point_world: NDArray[np.float64]


def line_of(first: Plane, second: Plane) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return the intersection of two planes: the point nearest to the origin, and the direction.

    The result is None if the planes are nearly parallel.
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
    """Return the segments of intersection lines along which planes adjoin.

    Along a segment, both planes have points within `reach_m` of the line.

    Args:
        surfaces: planes with their rectangles.
        reach_m: maximum distance from the line.
    """
    found = []
    for (i, first), (j, second) in combinations(enumerate(surfaces), 2):
        line = line_of(first.plane, second.plane)
        if line is None:
            continue
        # Use coordinates relative to a point near both planes, because large survey coordinates
        # reduce the precision.
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
    """Return the points at which three planes intersect and adjoin."""
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
    # Use coordinates relative to a nearby point, because large survey coordinates reduce the
    # precision.
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
    """Return the disjoint, ascending intervals of a line that are near a measured surface."""
    relative = surface.rectangles_world - start
    along = relative @ direction
    aside = relative @ np.cross(surface.plane.normal, direction)
    # The ends of an interval are at corners within the maximum distance, and where the sides of the
    # rectangle cross this limit.
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
    begin, end = edge.ends_world
    along = float(np.clip((point - begin) @ (end - begin) / edge.length_m**2, 0.0, 1.0))
    return float(np.linalg.norm(point - begin - along * (end - begin)))


# Maximum distance between the end of the points of a wall and the corner with the next wall.
_JOINED_M: Final = 1.0
# Parallel walls whose distance is smaller than this are one wall with relief.
_RELIEF_M: Final = 0.5


@dataclass(frozen=True, kw_only=True)
class RoomOutline:
    """The boundary of a room.

    Attributes:
        walls: indices of the bounding planes that adjoin another wall, in the order of the chains.
        chains_world: outlines (n, 3) in metres at the height of the floor; consecutive walls share
            a point.
        closed: for each chain, whether it is closed, so that the last point is joined to the first.
        faces_world: (w, 4, 3) metres, corners of the faces of `walls` from floor to ceiling: top
            left, bottom left, bottom right and top right for the viewer.
        floor_m: height of the floor, or of the lower edge of the lowest wall if no floor was found.
    """

    walls: tuple[int, ...]
    chains_world: tuple[NDArray[np.float64], ...]
    closed: tuple[bool, ...]
    faces_world: NDArray[np.float64]
    floor_m: float


@dataclass(frozen=True, kw_only=True)
class _Wall:
    """A wall in plan.

    Attributes:
        index: index of its plane.
        plane: the plane.
        corners: (4, 3) corners of its rectangle, top left first, counter-clockwise for the viewer.
        ends: (2, 2) left and right ends in plan.
    """

    index: int
    plane: Plane
    corners: NDArray[np.float64]
    ends: NDArray[np.float64]

    @property
    def length_m(self) -> float:
        return float(np.linalg.norm(self.ends[1] - self.ends[0]))


# Index of a wall in the list, and one of its ends (0: left, 1: right).
_End = tuple[int, int]


def room_outline(
    planes: Sequence[Plane], corners_world: NDArray[np.float64], up: NDArray[np.float64]
) -> RoomOutline:
    """Join the walls of a room into its outline.

    If a wall with relief has several planes, only the first is used. A wall ends at its
    intersection with the next wall if its points extend to within a metre of this intersection, and
    otherwise at the end of its points.

    Args:
        planes: planes whose normals point into the room, in descending order of the number of
            points.
        corners_world: (k, 4, 3) metres, corners of the rectangles of their points, top left first,
            counter-clockwise for the viewer.
        up: (3,) unit vector.
    """
    basis = basis_from_up(up)
    floor, ceiling = (_level(planes, corners_world, sign * up) for sign in (1.0, -1.0))
    walls = _bounding(planes, corners_world, basis)
    joints = _joints(walls)
    lowest = min((float((wall.corners @ up).min()) for wall in walls), default=0.0)
    floor_m = lowest if floor is None else float((corners_world[floor] @ up).mean())
    levels = [None if k is None else planes[k] for k in (ceiling, floor)]
    chains = _chains(len(walls), joints)
    joined = [place for chain, _ in chains for place, _ in chain]
    faces = [_face(walls, place, joints, levels) for place in joined]
    return RoomOutline(
        walls=tuple(walls[place].index for place in joined),
        chains_world=tuple(
            _chain_points(walls, chain, joints, basis, floor_m) for chain, _ in chains
        ),
        closed=tuple(is_closed for _, is_closed in chains),
        faces_world=np.array(faces).reshape(-1, 4, 3),
        floor_m=floor_m,
    )


def _level(
    planes: Sequence[Plane], corners: NDArray[np.float64], up: NDArray[np.float64]
) -> int | None:
    """Return the largest plane whose normal is within 10 degrees of `up`."""
    limit = math.cos(math.radians(LEVEL_LIMIT_DEG))
    areas = {
        k: float(np.linalg.norm(np.cross(quad[1] - quad[0], quad[3] - quad[0])))
        for k, (plane, quad) in enumerate(zip(planes, corners, strict=True))
        if float(plane.normal @ up) > limit
    }
    return max(areas, key=areas.__getitem__, default=None)


def _bounding(
    planes: Sequence[Plane], corners: NDArray[np.float64], basis: NDArray[np.float64]
) -> list[_Wall]:
    limit = math.sin(math.radians(LEVEL_LIMIT_DEG))
    upright = [
        _Wall(
            index=k,
            plane=plane,
            corners=quad,
            ends=np.array([quad[:2].mean(axis=0), quad[2:].mean(axis=0)]) @ basis[:2].T,
        )
        for k, (plane, quad) in enumerate(zip(planes, corners, strict=True))
        if abs(float(plane.normal @ basis[2])) < limit
    ]
    kept: list[_Wall] = []
    for wall in upright:
        # A rectangle of zero width has no direction in plan.
        if wall.length_m > 0.0 and not any(_is_relief(wall, larger) for larger in kept):
            kept.append(wall)
    return kept


def _is_relief(wall: _Wall, larger: _Wall) -> bool:
    """Return whether most of a wall is just in front of or behind a larger, parallel wall."""
    if float(wall.plane.normal @ larger.plane.normal) < math.cos(math.radians(LEVEL_LIMIT_DEG)):
        return False
    middle = wall.corners.mean(axis=0)
    along = (larger.ends[1] - larger.ends[0]) / larger.length_m
    places = np.clip((wall.ends - larger.ends[0]) @ along, 0.0, larger.length_m)
    overlap_m = float(np.ptp(places))
    return (
        abs(float(larger.plane.distances_m(middle[None])[0])) < _RELIEF_M
        and overlap_m > 0.5 * wall.length_m
    )


def _joints(walls: Sequence[_Wall]) -> dict[_End, _End]:
    """Return the wall ends that meet, as a mapping from each end to the other."""
    candidates: list[tuple[float, _End, _End]] = []
    for (i, first), (j, second) in combinations(enumerate(walls), 2):
        crossing = _crossing(first, second)
        if crossing is None:
            continue
        for here, there in product((0, 1), repeat=2):
            gaps = (
                float(np.linalg.norm(crossing - first.ends[here])),
                float(np.linalg.norm(crossing - second.ends[there])),
            )
            limits = (min(_JOINED_M, 0.5 * wall.length_m) for wall in (first, second))
            if all(gap <= limit for gap, limit in zip(gaps, limits, strict=True)):
                candidates.append((sum(gaps), (i, here), (j, there)))
    joints: dict[_End, _End] = {}
    for _, one, other in sorted(candidates):
        if one not in joints and other not in joints:
            joints[one], joints[other] = other, one
    return joints


def _crossing(first: _Wall, second: _Wall) -> NDArray[np.float64] | None:
    along = [wall.ends[1] - wall.ends[0] for wall in (first, second)]
    matrix = np.column_stack([along[0], -along[1]])
    size = first.length_m * second.length_m
    if size == 0.0 or abs(float(np.linalg.det(matrix))) < 0.3 * size:
        return None
    return np.asarray(
        first.ends[0] + np.linalg.solve(matrix, second.ends[0] - first.ends[0])[0] * along[0]
    )


def _chains(count: int, joints: dict[_End, _End]) -> list[tuple[list[_End], bool]]:
    """Return chains of walls, each with its first end, and whether the chains are closed."""
    left = set(range(count))
    chains: list[tuple[list[_End], bool]] = []
    # Begin at free ends, so that open chains are followed from one end to the other.
    free = [(k, side) for k, side in product(range(count), (0, 1)) if (k, side) not in joints]
    for start in [*free, *((k, 0) for k in range(count))]:
        if start[0] not in left:
            continue
        chain: list[_End] = []
        entered: _End | None = start
        while entered is not None and entered[0] in left:
            left.remove(entered[0])
            chain.append(entered)
            entered = joints.get((entered[0], 1 - entered[1]))
        if len(chain) > 1:
            chains.append((chain, entered == start and len(chain) > 2))
    return chains


def _chain_points(
    walls: Sequence[_Wall],
    chain: Sequence[_End],
    joints: dict[_End, _End],
    basis: NDArray[np.float64],
    floor_m: float,
) -> NDArray[np.float64]:
    points = []
    for place, side in chain:
        points.append(_corner_in_plan(walls, (place, side), joints))
    last = (chain[-1][0], 1 - chain[-1][1])
    if joints.get(last) != chain[0]:
        points.append(_corner_in_plan(walls, last, joints))
    heights = np.full((len(points), 1), floor_m)
    return np.asarray(np.hstack([np.array(points), heights]) @ basis)


def _corner_in_plan(
    walls: Sequence[_Wall], end: _End, joints: dict[_End, _End]
) -> NDArray[np.float64]:
    own = walls[end[0]]
    other = joints.get(end)
    crossing = None if other is None else _crossing(own, walls[other[0]])
    return own.ends[end[1]] if crossing is None else crossing


def _face(
    walls: Sequence[_Wall], place: int, joints: dict[_End, _End], levels: Sequence[Plane | None]
) -> NDArray[np.float64]:
    """Return the corners (4, 3) of a wall that ends at adjoining walls, ceiling and floor."""
    own = walls[place]
    sides = []
    for side, (top, bottom) in enumerate(((0, 1), (3, 2))):
        line = (own.corners[top], own.corners[bottom] - own.corners[top])
        other = joints.get((place, side))
        met = None if other is None else line_of(own.plane, walls[other[0]].plane)
        if met is not None:
            line = met
        sides.append(
            [
                _on_line(line, level, own.corners[k])
                for level, k in zip(levels, (top, bottom), strict=True)
            ]
        )
    (top_left, bottom_left), (top_right, bottom_right) = sides
    return np.array([top_left, bottom_left, bottom_right, top_right])


def _on_line(
    line: tuple[NDArray[np.float64], NDArray[np.float64]],
    level: Plane | None,
    near: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the point of a line on a plane; without a plane, the point nearest to `near`."""
    point, direction = line
    if level is None:
        return np.asarray(point + (near - point) @ direction / (direction @ direction) * direction)
    share = (level.offset_m - level.normal @ point) / (level.normal @ direction)
    return np.asarray(point + share * direction)
