"""Lines of a room, computed once for all formats, and key plans in which one wall is marked."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.geometry.frames import LEVEL_LIMIT_DEG, WallFrame, basis_from_up
from orthoflow.geometry.outlines import (
    REACH_M,
    Corner,
    Edge,
    RoomOutline,
    Surface,
    corners_between,
    edges_between,
    room_outline,
)
from orthoflow.products import CheckPoints, Opening, Planes

# All pairs and some triples of planes are compared, and a record may contain any number of them.
#: planes of a drawn room (`--to dxf`, `geojson`, `sheet`)
MOST_PLANES: Final = 200
#: connected parts of these planes
MOST_PARTS: Final = 20_000
# Label of the upwards direction of a plan in map coordinates; other plans name an axis of the scan.
NORTH: Final = "N"


@dataclass(frozen=True, kw_only=True)
class KeyPlan:
    """Lines of a plan, in metres to the right and upwards, relative to a nearby origin.

    Attributes:
        walls: (w, 2, 2) ends of upright walls as seen from above.
        numbers: numbers of these walls, as in files and reports.
        outlines: outlines of the room, (n, 2) each; closed ones end where they begin.
        marked: (n, 2) two ends of the marked wall, or four corners of a marked horizontal plane.
        arrow: (2, 2) from the viewer to the wall; None for horizontal planes.
        up_label: label of the upwards direction of the plan: `N` in map coordinates, otherwise an
            axis of the scan.
        number: number of the marked wall, -1 if none.
    """

    walls: NDArray[np.float64]
    numbers: tuple[int, ...]
    outlines: tuple[NDArray[np.float64], ...]
    marked: NDArray[np.float64]
    arrow: NDArray[np.float64] | None
    up_label: str
    number: int = -1


def surfaces_of(planes: Planes) -> tuple[Surface, ...]:
    """Return the planes, each with the rectangles of its parts or, without parts, its own.

    Raises:
        InputError: there are more than `MOST_PLANES` planes or `MOST_PARTS` parts.
    """
    _check_counts(planes)
    found = []
    for index in range(len(planes)):
        rectangles = planes.corners[index][None]
        if planes.part_corners is not None and planes.part_plane is not None:
            own = planes.part_corners[planes.part_plane == index]
            rectangles = own if len(own) else rectangles
        found.append(Surface(plane=planes.plane(index), rectangles_world=rectangles))
    return tuple(found)


def outline_of(planes: Planes) -> RoomOutline:
    """Return the outline of the room that the planes bound.

    Raises:
        InputError: there are more than `MOST_PLANES` planes.
    """
    _check_counts(planes)
    return room_outline(
        [planes.plane(index) for index in range(len(planes))], planes.corners, planes.up
    )


def _check_counts(planes: Planes) -> None:
    n_parts = 0 if planes.part_corners is None else len(planes.part_corners)
    if len(planes) > MOST_PLANES or n_parts > MOST_PARTS:
        raise InputError(
            f"the run has {len(planes)} planes with {n_parts} connected parts; at most "
            f"{MOST_PLANES} planes with {MOST_PARTS} parts can be drawn: run it with fewer "
            "planes, or choose another step with --step"
        )


def key_plan(planes: Planes, frame: WallFrame, number: int = -1) -> KeyPlan:
    """Return a plan of planes, seen from above, that marks the position of a raster."""
    corners = frame.corners_world()
    is_map = is_map_crs(frame.map_crs)
    if frame.bend is not None:
        return marked_plan(planes, frame.outline_world(), None, number, is_map=is_map)
    if abs(float(frame.normal_world @ planes.up)) > math.cos(math.radians(60.0)):
        return marked_plan(planes, corners, None, number, is_map=is_map)
    ends = np.array([corners[:2].mean(axis=0), corners[2:].mean(axis=0)])
    return marked_plan(planes, ends, frame.normal_world, number, is_map=is_map)


def is_map_crs(crs: str | None) -> bool:
    """Return whether world x and y are easting and northing."""
    return crs is not None and crs != "site"


def up_label(up: NDArray[np.float64], *, is_map: bool) -> str:
    """Return the label of the upwards direction of plans: `N`, or the axis of the scan."""
    return NORTH if is_map else axis_words(basis_from_up(up)[1])


def marked_plan(
    planes: Planes,
    marked_world: NDArray[np.float64],
    towards_world: NDArray[np.float64] | None,
    number: int = -1,
    *,
    is_map: bool = False,
) -> KeyPlan:
    """Return a plan of planes, seen from above, that marks a wall or a horizontal plane.

    Args:
        planes: planes of the room.
        marked_world: (2 or 4, 3) ends of the marked wall, or corners of the marked plane.
        towards_world: (3,) direction from the marked wall to the viewer; None for horizontal
            planes.
        number: number of the marked wall, -1 if none.
        is_map: whether world x and y are easting and northing.
    """
    outline = outline_of(planes)
    basis = basis_from_up(planes.up)
    near = marked_world.mean(axis=0)

    def seen(points_world: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray((points_world - near) @ basis[:2].T)

    upright = np.abs(planes.normal @ planes.up) < math.sin(math.radians(LEVEL_LIMIT_DEG))
    walls = [
        seen(np.array([quad[:2].mean(axis=0), quad[2:].mean(axis=0)]))
        for quad in planes.corners[upright]
    ]
    arrow = None
    if towards_world is not None:
        length_m = 0.25 * float(np.linalg.norm(marked_world[1] - marked_world[0]))
        towards = basis[:2] @ towards_world
        towards /= np.linalg.norm(towards)
        arrow = length_m * np.array([towards, 0.1 * towards])
    return KeyPlan(
        walls=np.array(walls).reshape(-1, 2, 2),
        numbers=tuple(int(one) for one in np.flatnonzero(upright)),
        outlines=tuple(
            seen(np.vstack([chain, chain[:1]]) if is_closed else chain)
            for chain, is_closed in zip(outline.chains_world, outline.closed, strict=True)
        ),
        marked=seen(marked_world),
        arrow=arrow,
        up_label=up_label(planes.up, is_map=is_map),
        number=number,
    )


def axis_words(direction: NDArray[np.float64]) -> str:
    """Return the axis of the scan nearest to a direction (3,), with its sign."""
    axis = int(np.argmax(np.abs(direction)))
    return f"{'-' if direction[axis] < 0.0 else ''}{'xyz'[axis]}"


@dataclass(frozen=True, kw_only=True)
class RoomLines:
    """The drawn elements of a room.

    Attributes:
        planes: the planes.
        checkpoints: surveyed points, or None.
        openings: openings of walls.
    """

    planes: Planes
    checkpoints: CheckPoints | None
    openings: tuple[Opening, ...] = ()

    @cached_property
    def surfaces(self) -> tuple[Surface, ...]:
        """Return the planes, each with the rectangles of its parts."""
        return surfaces_of(self.planes)

    @cached_property
    def edges(self) -> tuple[Edge, ...]:
        """Return the edges of the room, where two planes intersect."""
        return edges_between(self.surfaces)

    @cached_property
    def corners(self) -> tuple[Corner, ...]:
        """Return the corners of the room, where three planes intersect."""
        return corners_between(self.surfaces, self.edges)

    @cached_property
    def outline(self) -> RoomOutline:
        """Return the outline of the room."""
        return outline_of(self.planes)


@dataclass(frozen=True, kw_only=True)
class DrawnWall:
    """A wall in its own coordinates: X and Y of its GeoTIFF.

    Attributes:
        number: number of the wall.
        name: name of the wall.
        plane_index: index of the wall's plane, None if unknown.
        frame: frame of the wall's raster.
        image: file name of the wall's picture, next to the drawing; empty if there is no picture.
        openings: openings of the wall, from the left.
    """

    number: int
    name: str
    plane_index: int | None
    frame: WallFrame
    image: str = ""
    openings: tuple[Opening, ...] = ()

    def place_m(self, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return X and Y (n, 2) of points (n, 3)."""
        return self.frame.raster_from_wall(self.frame.wall_from_world(points_world)[:, :2])

    @property
    def corners_m(self) -> NDArray[np.float64]:
        """X and Y (4, 2) of the corners of the raster: top-left first, counter-clockwise."""
        if self.frame.bend is None:
            return self.place_m(self.frame.corners_world())
        # The ends of a whole turn are at the same place in the world.
        rows, columns = float(self.frame.height), float(self.frame.width)
        corners = np.array([[0.0, 0.0], [0.0, rows], [columns, rows], [columns, 0.0]])
        return self.frame.raster_from_wall(corners)

    def near(self, points_world: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which points (n, 3) are inside or near the raster's rectangle."""
        return self.frame.distances_m(points_world) <= REACH_M


def edges_of(lines: RoomLines, plane_index: int | None) -> Sequence[Edge]:
    """Return the edges of a plane."""
    return [edge for edge in lines.edges if plane_index in (edge.first, edge.second)]


def numbered_openings(openings: Sequence[Opening]) -> Iterator[tuple[int, Opening]]:
    """Yield each opening in order, with its index among the openings of its wall."""
    counts: dict[int, int] = {}
    for opening in openings:
        counts[opening.wall] = counts.get(opening.wall, -1) + 1
        yield counts[opening.wall], opening
