"""The lines of a room, worked out once for all formats that draw them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.drawings.key_plans import outline_of, surfaces_of
from orthoflow.files.drawings.papers import nice_step
from orthoflow.geometry import WallFrame
from orthoflow.geometry.adjoining import (
    REACH_M,
    Corner,
    Edge,
    Surface,
    corners_between,
    edges_between,
)
from orthoflow.geometry.outlines import RoomOutline
from orthoflow.products import CheckPoints, Inspection, Opening, Planes

# Residuals are drawn so much longer that those of this share of them have this length at most.
_SHARE_PERCENT: Final = 95.0
_LENGTH_M: Final = 0.1
_MOST_RESIDUALS: Final = 5000


@dataclass(frozen=True, kw_only=True)
class Residuals:
    """Displacements that an inspection found.

    Attributes:
        cell: address of the inspection.
        wall: (n,) numbers of walls.
        points_world: (n, 3) metres.
        displacement_m: (n, 2) metres along u and v, shown - true.
        times: how much longer they are drawn.
    """

    cell: str
    wall: NDArray[np.int32]
    points_world: NDArray[np.float64]
    displacement_m: NDArray[np.float64]
    times: float


@dataclass(frozen=True, kw_only=True)
class RoomLines:
    """What is drawn of a room.

    Attributes:
        planes: the planes.
        surfaces: each with the rectangles of its parts.
        edges: where two planes meet.
        corners: where three meet.
        outline: of the room.
        checkpoints: surveyed points, None without.
        residuals: of inspections.
        openings: of walls.
    """

    planes: Planes
    surfaces: tuple[Surface, ...]
    edges: tuple[Edge, ...]
    corners: tuple[Corner, ...]
    outline: RoomOutline
    checkpoints: CheckPoints | None
    residuals: tuple[Residuals, ...]
    openings: tuple[Opening, ...] = ()


@dataclass(frozen=True, kw_only=True)
class DrawnWall:
    """A wall that is drawn in its own coordinates: X and Y of its GeoTIFF.

    Attributes:
        number: of the wall.
        name: what it is called.
        plane_index: its plane, None where it is unknown.
        frame: of its raster.
        image: file name of its picture, beside the drawing; empty without one.
        openings: of it, from the left.
    """

    number: int
    name: str
    plane_index: int | None
    frame: WallFrame
    image: str = ""
    openings: tuple[Opening, ...] = ()

    def place_m(self, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """X and Y (n, 2) of points (n, 3)."""
        return self.frame.raster_from_wall(self.frame.wall_from_world(points_world)[:, :2])

    def near(self, points_world: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which of some points (n, 3) lie on the raster's rectangle, or near it."""
        return self.frame.distances_m(points_world) <= REACH_M


def room_lines(
    planes: Planes,
    checkpoints: CheckPoints | None,
    inspections: dict[str, Inspection],
    openings: tuple[Opening, ...] = (),
) -> RoomLines:
    """Work out the lines of a room."""
    surfaces = surfaces_of(planes)
    edges = edges_between(surfaces)
    return RoomLines(
        planes=planes,
        surfaces=surfaces,
        edges=edges,
        corners=corners_between(surfaces, edges),
        outline=outline_of(planes),
        checkpoints=checkpoints,
        residuals=tuple(
            _residuals(address, inspection) for address, inspection in inspections.items()
        ),
        openings=openings,
    )


def edges_of(lines: RoomLines, plane_index: int | None) -> Sequence[Edge]:
    """Edges that lie on a plane."""
    return [edge for edge in lines.edges if plane_index in (edge.first, edge.second)]


def numbered_openings(openings: Sequence[Opening]) -> Iterator[tuple[int, Opening]]:
    """Openings with their places among those of their wall, as they come."""
    counts: dict[int, int] = {}
    for opening in openings:
        counts[opening.wall] = counts.get(opening.wall, -1) + 1
        yield counts[opening.wall], opening


def _residuals(address: str, inspection: Inspection) -> Residuals:
    known = np.flatnonzero(np.isfinite(inspection.displacement_m).all(axis=1))
    # Evenly over all of them: an inspection of the truth has one per traced cell.
    kept = known[:: max(1, -(-len(known) // _MOST_RESIDUALS))]
    shifts = inspection.displacement_m[kept]
    typical_m = 0.0
    if len(kept):
        typical_m = float(np.percentile(np.linalg.norm(shifts, axis=1), _SHARE_PERCENT))
    # Half of the next round number is at most what is wanted.
    times = 1.0 if typical_m <= 0.0 else max(1.0, 0.5 * nice_step(_LENGTH_M / typical_m))
    return Residuals(
        cell=address,
        wall=inspection.wall[kept],
        points_world=inspection.points_world[kept],
        displacement_m=shifts,
        times=times,
    )
