"""Selection of the planes that become walls."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry import WallFrame, frame_over
from orthoflow.products import Planes
from orthoflow_plugins.raster.parameters import Constraint, RasterParams

# Maximum angle between a vertical or horizontal plane and the exact direction.
_LEAN_DEG: Final = 10.0
# A plane is part of the relief of a larger wall if the angle between the two is less than
# _PARALLEL_DEG and the wall contains more than _COVERED_SHARE of the plane's area.
_PARALLEL_DEG: Final = 5.0
_COVERED_SHARE: Final = 0.8


# Function that returns the buffers in front of and behind a plane, given its index.
BufferOf = Callable[[int], tuple[float, float]]
NO_SURFACES: Final[Mapping[int, WallFrame]] = MappingProxyType({})


def chosen_walls(
    planes: Planes,
    params: RasterParams,
    buffer_m: BufferOf,
    curved: Mapping[int, WallFrame] = NO_SURFACES,
) -> list[int]:
    """Return the indices of the planes to rasterise, those with the most points first.

    Args:
        planes: all planes.
        params: the criteria.
        buffer_m: function that returns the buffers of walls.
        curved: rasters of curved surfaces, by index after that of the last plane. They follow the
            planes, all of them unless only those nearest to points are requested.

    Raises:
        MethodError: there are no planes, none has the requested orientation, or a requested rank
            does not exist.
    """
    if len(planes) == 0 and not curved:
        raise MethodError("no plane was found in the cloud, but at least one is needed for a wall")
    if params.ranks:
        indices = [*range(len(planes)), *curved]
        missing = sorted(rank for rank in params.ranks if rank not in indices)
        if missing:
            raise MethodError(
                f"ranks contains {missing[0]}, but only planes 0 to {len(planes) - 1} were "
                "found: see planes.json"
            )
        return sorted(set(params.ranks))
    fitting = [k for k in range(len(planes)) if _fits(planes, k, params.constraint)]
    if not fitting and not curved:
        raise MethodError(
            f"none of the {len(planes)} planes is {params.constraint} within {_LEAN_DEG:g} deg: "
            "set constraint to any, or detect other planes"
        )
    if params.near:
        among = [*fitting, *curved]
        places = [np.array(place) for place in params.near]
        return sorted({nearest_wall(planes, among, curved, place)[0] for place in places})
    large = [k for k in fitting if area_m2(planes.corners[k]) >= params.min_area_m2]
    # The minimum area does not apply to the plane with the most points, so that a scan of a small
    # object has a wall.
    chosen: list[int] = []
    for index in sorted({*fitting[:1], *large}):
        if len(chosen) == params.n_walls_max:
            break
        if params.skip_covered and any(_covers(planes, wall, index, buffer_m) for wall in chosen):
            continue
        chosen.append(index)
    if not params.skip_covered:
        return [*chosen, *curved]
    # A wall that was selected later, because it has fewer points, may be larger and cover an
    # earlier one.
    kept = [
        index
        for index in chosen
        if index == chosen[0]
        or not any(
            _is_larger(planes, wall, index) and _covers(planes, wall, index, buffer_m)
            for wall in chosen
        )
    ]
    return [*kept, *curved]


def covered_planes(
    planes: Planes, params: RasterParams, buffer_m: BufferOf, chosen: Sequence[int]
) -> dict[int, int]:
    """Return the wall that contains each omitted plane, by the index of the plane.

    Args:
        planes: all planes, those with the most points first.
        params: criteria for the selection.
        buffer_m: function that returns the buffers of walls.
        chosen: indices of the planes that become walls.
    """
    if not params.skip_covered or params.ranks or params.near:
        return {}
    found: dict[int, int] = {}
    for index in sorted(set(range(len(planes))) - set(chosen)):
        is_large = area_m2(planes.corners[index]) >= params.min_area_m2
        if not is_large or not _fits(planes, index, params.constraint):
            continue
        walls = (
            wall
            for wall in chosen
            if (wall < index or _is_larger(planes, wall, index))
            and _covers(planes, wall, index, buffer_m)
        )
        if (wall := next(walls, None)) is not None:
            found[index] = wall
    return found


def nearest_wall(
    planes: Planes,
    among: Sequence[int],
    curved: Mapping[int, WallFrame],
    place: NDArray[np.float64],
) -> tuple[int, float]:
    """Return the wall nearest to a point (3,) and its distance; if tied, the first.

    Args:
        planes: all planes.
        among: indices of planes and of curved surfaces.
        curved: rasters of curved surfaces, by index; others are ignored.
        place: the point.
    """
    distances_m = {
        index: distance_m(planes, index, place)
        if index < len(planes)
        else float(curved[index].distances_m(place[None])[0])
        for index in among
    }
    nearest = min(among, key=lambda index: (round(distances_m[index], 6), index))
    return nearest, distances_m[nearest]


def distance_m(planes: Planes, index: int, place: NDArray[np.float64]) -> float:
    """Return the distance between a point (3,) and the measured surface of a plane.

    The measured surface consists of the connected parts of the plane, or of its rectangle if no
    parts are known.
    """
    rectangles = planes.corners[index][None]
    if planes.part_corners is not None and planes.part_plane is not None:
        own = planes.part_corners[planes.part_plane == index]
        rectangles = own if len(own) else rectangles
    return min(_distance_m(corners, place) for corners in rectangles)


def area_m2(corners: NDArray[np.float64]) -> float:
    """Return the area of a rectangle given by its corners (4, 3), top-left first."""
    down, right = corners[1] - corners[0], corners[3] - corners[0]
    return float(np.linalg.norm(np.cross(down, right)))


def frame_of(planes: Planes, index: int, *, gsd_m: float, margin_m: float) -> WallFrame:
    """Return the frame over the rectangle of a plane, extended by a margin on all sides."""
    corners = planes.corners[index]
    right = _unit(corners[3] - corners[0])
    down = _unit(corners[1] - corners[0])
    steps = np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, 1.0], [1.0, -1.0]])
    widened = corners + margin_m * (steps[:, :1] * right + steps[:, 1:] * down)
    frame = frame_over(widened, planes.normal[index], gsd_m=gsd_m)
    east, north, top = planes.up.tolist()
    return replace(frame, up=(east, north, top), name=planes.names[index])


def _distance_m(corners: NDArray[np.float64], place: NDArray[np.float64]) -> float:
    sides = np.array([corners[3] - corners[0], corners[1] - corners[0]])
    shares = (place - corners[0]) @ sides.T / np.maximum((sides**2).sum(axis=1), 1e-12)
    nearest = corners[0] + np.clip(shares, 0.0, 1.0) @ sides
    return float(np.linalg.norm(place - nearest))


def _covers(planes: Planes, wall: int, index: int, buffer_m: BufferOf) -> bool:
    """Return whether a plane is parallel to a wall, in its buffer and mostly inside its frame."""
    normal = planes.normal[wall]
    if float(normal @ planes.normal[index]) < math.cos(math.radians(_PARALLEL_DEG)):
        return False
    depths_m = planes.corners[index] @ normal - planes.offset[wall]
    front_m, behind_m = buffer_m(wall)
    if depths_m.min() < -behind_m or depths_m.max() > front_m:
        return False
    corners = planes.corners[wall]
    axes = np.vstack([_unit(corners[3] - corners[0]), _unit(corners[1] - corners[0])])
    outer, inner = corners @ axes.T, planes.corners[index] @ axes.T
    shared_m = np.minimum(outer.max(axis=0), inner.max(axis=0)) - np.maximum(
        outer.min(axis=0), inner.min(axis=0)
    )
    extent_m = inner.max(axis=0) - inner.min(axis=0)
    share = np.clip(shared_m, 0.0, None).prod() / max(float(extent_m.prod()), 1e-12)
    return bool(share >= _COVERED_SHARE)


def _is_larger(planes: Planes, wall: int, index: int) -> bool:
    return area_m2(planes.corners[wall]) > area_m2(planes.corners[index])


def _fits(planes: Planes, index: int, constraint: Constraint) -> bool:
    upright = abs(float(planes.normal[index] @ planes.up))
    if constraint == "vertical":
        return upright <= math.sin(math.radians(_LEAN_DEG))
    if constraint == "horizontal":
        return upright >= math.cos(math.radians(_LEAN_DEG))
    return True


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    length = float(np.linalg.norm(vector))
    return vector / length if length > 0.0 else vector
