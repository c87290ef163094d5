"""Which side of a plane the viewer is on: asked of the scanner stations, else guessed from points.

The wrong side mirrors every image of the wall, so a guess is always said to be one.
"""

from __future__ import annotations

from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane
from orthoflow.products import PointCloud

Viewpoint = Literal["stations", "view_from", "guess"]

# A station nearer to the plane than this stands in it, and says nothing about its side.
_CLEAR_M: Final = 0.05
# Beyond this distance a point says no more about the side of the room than a nearer one.
_FULL_SAY_M: Final = 1.0
# Points may project this far outside the rectangle: floor and ceiling lie at its edges.
_BESIDE_M: Final = 0.3
# A verdict below this share of all points, each just clear of the plane, is none.
_DOUBT: Final = 0.01


def known_viewpoint(cloud: PointCloud) -> Viewpoint:
    """Say what is known about where the cloud was seen from."""
    if cloud.stations is None or len(cloud.stations) == 0:
        return "guess"
    return "view_from" if cloud.stations_source == "view_from" else "stations"


def middle_viewpoint_m(cloud: PointCloud, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3,) middle of the stations, of some points of the cloud where none is known; offsets."""
    stations = cloud.stations
    if stations is None or len(stations) == 0:
        middle: NDArray[np.float64] = np.median(points_m, axis=0)
    else:
        middle = stations.mean(axis=0) - cloud.origin
    return middle


def side_of_stations(
    plane: Plane, centre_m: NDArray[np.float64], cloud: PointCloud, index: NDArray[np.int64]
) -> int:
    """Side of a plane on which its points were seen from.

    The scans of the plane's own points decide, each point with one voice; without that knowledge
    the station nearest to the middle of the plane does.

    Args:
        plane: in the cloud's offsets.
        centre_m: (3,) middle of the plane, offset.
        cloud: the cloud.
        index: (m,) some of the plane's points.

    Returns:
        1 for the side of the normal, -1 for the other, 0 when no station says.
    """
    if cloud.stations is None or len(cloud.stations) == 0:
        return 0
    stations_m = cloud.stations - cloud.origin
    distances_m = plane.distances_m(stations_m)
    sides = np.where(np.abs(distances_m) > _CLEAR_M, np.sign(distances_m), 0.0)
    if cloud.scan is not None and len(index) and int(cloud.scan[index].max()) < len(stations_m):
        voices = np.bincount(cloud.scan[index], minlength=len(stations_m))
        verdict = float(voices @ sides)
        if verdict != 0.0:
            return 1 if verdict > 0.0 else -1
    order = np.argsort(np.linalg.norm(stations_m - centre_m, axis=1), kind="stable")
    nearest = [int(sides[station]) for station in order if sides[station] != 0.0]
    return nearest[0] if nearest else 0


def side_of_remaining(
    plane: Plane,
    corners_m: NDArray[np.float64],
    points_m: NDArray[np.float64],
    is_parallel: NDArray[np.bool_],
    *,
    clear_m: float,
) -> int:
    """Side of a plane on which more of the other points lie: a room, or furniture and floor.

    Points on planes parallel to this one do not count at first: behind the front of a pilaster
    lies the whole wall, yet the room is on the other side, as floor, side walls and furniture know.
    Of the rest only points before or behind the plane's rectangle have a say, and a point next to
    the plane has less than one a metre away: relief and recesses are near, the room is far.

    Args:
        plane: in the cloud's offsets.
        corners_m: (4, 3) rectangle, offsets.
        points_m: (m, 3) sample of the cloud, offsets.
        is_parallel: (m,) whether a point belongs to a plane parallel to this one.
        clear_m: points nearer than this belong to the plane itself.

    Returns:
        1 for the side of the normal, -1 for the other, 0 when the points do not say.
    """
    along, down = corners_m[3] - corners_m[0], corners_m[1] - corners_m[0]
    relative = points_m - corners_m[0]
    within = np.ones(len(points_m), dtype=bool)
    for axis in (along, down):
        length_m = max(float(np.linalg.norm(axis)), 1e-9)
        position_m = relative @ axis / length_m
        within &= (position_m > -_BESIDE_M) & (position_m < length_m + _BESIDE_M)
    distances_m = plane.distances_m(points_m)
    clear = np.abs(distances_m) > clear_m
    for chosen in (within & ~is_parallel, within, ~is_parallel, np.ones_like(within)):
        voices = np.clip(distances_m[chosen & clear], -_FULL_SAY_M, _FULL_SAY_M)
        verdict = float(voices.sum())
        # Gross outliers on both sides of a bare wall leave a small difference that means nothing.
        if abs(verdict) > _DOUBT * len(points_m) * clear_m:
            return 1 if verdict > 0.0 else -1
    return 0
