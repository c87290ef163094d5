"""The lines of a room, computed once for all formats that draw them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.drawings.key_plans import outline_of, surfaces_of
from orthoflow.geometry import WallFrame
from orthoflow.geometry.outlines import (
    REACH_M,
    Corner,
    Edge,
    RoomOutline,
    Surface,
    corners_between,
    edges_between,
)
from orthoflow.products import CheckPoints, Opening, Planes


@dataclass(frozen=True, kw_only=True)
class RoomLines:
    """The drawn elements of a room.

    Attributes:
        planes: the planes.
        surfaces: each with the rectangles of its parts.
        edges: intersections of two planes.
        corners: intersections of three planes.
        outline: outline of the room.
        checkpoints: surveyed points, or None.
        openings: openings of walls.
    """

    planes: Planes
    surfaces: tuple[Surface, ...]
    edges: tuple[Edge, ...]
    corners: tuple[Corner, ...]
    outline: RoomOutline
    checkpoints: CheckPoints | None
    openings: tuple[Opening, ...] = ()


@dataclass(frozen=True, kw_only=True)
class DrawnWall:
    """A wall in its own coordinates: X and Y of its GeoTIFF.

    Attributes:
        number: of the wall.
        name: what it is called.
        plane_index: its plane, None if unknown.
        frame: of its raster.
        image: file name of its picture, beside the drawing; empty without one.
        openings: its openings, from the left.
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

    def near(self, points_world: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Report which points (n, 3) are on the raster's rectangle, or near it."""
        return self.frame.distances_m(points_world) <= REACH_M


def room_lines(
    planes: Planes,
    checkpoints: CheckPoints | None,
    openings: tuple[Opening, ...] = (),
) -> RoomLines:
    """Compute the lines of a room."""
    surfaces = surfaces_of(planes)
    edges = edges_between(surfaces)
    return RoomLines(
        planes=planes,
        surfaces=surfaces,
        edges=edges,
        corners=corners_between(surfaces, edges),
        outline=outline_of(planes),
        checkpoints=checkpoints,
        openings=openings,
    )


def edges_of(lines: RoomLines, plane_index: int | None) -> Sequence[Edge]:
    """Return the edges that lie on a plane."""
    return [edge for edge in lines.edges if plane_index in (edge.first, edge.second)]


def numbered_openings(openings: Sequence[Opening]) -> Iterator[tuple[int, Opening]]:
    """Yield openings with their indices among those of their wall, in order."""
    counts: dict[int, int] = {}
    for opening in openings:
        counts[opening.wall] = counts.get(opening.wall, -1) + 1
        yield counts[opening.wall], opening
