"""A small plan of a room with one wall marked, to show which wall a sheet is of."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.geometry.adjoining import Surface
from orthoflow.geometry.directions import basis_from_up
from orthoflow.geometry.frames import LEVEL_LIMIT_DEG, WallFrame
from orthoflow.geometry.outlines import RoomOutline, room_outline
from orthoflow.products import Planes

# Every pair and some triples are compared, and a record may state any number.
#: planes of a drawn room (`--to dxf`, `geojson`, `sheet`)
MOST_PLANES: Final = 200
#: connected parts of them
MOST_PARTS: Final = 20_000


@dataclass(frozen=True, kw_only=True)
class KeyPlan:
    """Lines of a plan, in metres to the right and upwards, relative to a nearby origin.

    Attributes:
        walls: (w, 2, 2) rectangles of upright walls from above.
        numbers: numbers of these walls, as in files and reports.
        outlines: outlines of the room, (n, 2) each; closed ones end where they begin.
        marked: (n, 2) the marked wall: two ends, or the four corners of a level plane.
        arrow: (2, 2) from the viewer to the wall; None for level planes.
        up_label: label of the upwards direction of the plan: `N` in a map, else an axis.
    """

    walls: NDArray[np.float64]
    numbers: tuple[int, ...]
    outlines: tuple[NDArray[np.float64], ...]
    marked: NDArray[np.float64]
    arrow: NDArray[np.float64] | None
    up_label: str


def surfaces_of(planes: Planes) -> tuple[Surface, ...]:
    """Return planes with the rectangles of their parts, or of all their points without parts.

    Raises:
        InputError: there are more than `MOST_PLANES`, or `MOST_PARTS` of them.
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
    """Return the outline of the room bounded by planes.

    Raises:
        InputError: there are more than `MOST_PLANES`.
    """
    _check_counts(planes)
    return room_outline(
        [planes.plane(index) for index in range(len(planes))], planes.corners, planes.up
    )


def _check_counts(planes: Planes) -> None:
    n_parts = 0 if planes.part_corners is None else len(planes.part_corners)
    if len(planes) > MOST_PLANES or n_parts > MOST_PARTS:
        raise InputError(
            f"the run has {len(planes)} planes of {n_parts} connected parts, at most {MOST_PLANES} "
            f"of {MOST_PARTS} are drawn: run it with fewer planes, or name another step by --step"
        )


def key_plan(planes: Planes, frame: WallFrame) -> KeyPlan:
    """Draw planes from above, and mark the position of a raster."""
    outline = outline_of(planes)
    basis = basis_from_up(planes.up)
    corners = frame.corners_world()
    near = corners.mean(axis=0)

    def seen(points_world: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray((points_world - near) @ basis[:2].T)

    upright = np.abs(planes.normal @ planes.up) < math.sin(math.radians(LEVEL_LIMIT_DEG))
    walls = [
        seen(np.array([quad[:2].mean(axis=0), quad[2:].mean(axis=0)]))
        for quad in planes.corners[upright]
    ]
    is_level = abs(float(frame.normal_world @ planes.up)) > math.cos(math.radians(60.0))
    marked = corners if is_level else np.array([corners[:2].mean(axis=0), corners[2:].mean(axis=0)])
    arrow = None
    if not is_level:
        length_m = 0.25 * float(np.linalg.norm(corners[3] - corners[0]))
        middle = seen(near[None])[0]
        towards = seen((near + frame.normal_world)[None])[0] - middle
        towards /= np.linalg.norm(towards)
        arrow = np.array([middle + length_m * towards, middle + 0.1 * length_m * towards])
    is_map = frame.map_crs is not None and frame.map_crs != "site"
    axis = int(np.argmax(np.abs(basis[1])))
    return KeyPlan(
        walls=np.array(walls).reshape(-1, 2, 2),
        numbers=tuple(int(number) for number in np.flatnonzero(upright)),
        outlines=tuple(
            seen(np.vstack([chain, chain[:1]]) if is_closed else chain)
            for chain, is_closed in zip(outline.chains_world, outline.closed, strict=True)
        ),
        marked=seen(marked),
        arrow=arrow,
        up_label="N" if is_map else f"{'-' if basis[1][axis] < 0 else ''}{'xyz'[axis]}",
    )
