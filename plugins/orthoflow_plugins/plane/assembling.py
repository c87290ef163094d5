"""Found planes turned into products: sides, order, names, rectangles in the world, labels.

Which side of a plane the viewer is on is asked of the scanner stations, else guessed from points.
The wrong side mirrors every image of the wall, so a guess is always said to be one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane, wall_axes
from orthoflow.geometry.frames import LEVEL_LIMIT_DEG
from orthoflow.products import JsonValue, Planes, PointCloud, SideSource, plane_name
from orthoflow.products.planes import PlaneKind
from orthoflow.sdk import StepContext
from orthoflow_plugins.plane.candidates import Candidate, FoundPlane
from orthoflow_plugins.plane.covariance import Stated
from orthoflow_plugins.plane.measuring import Deviations, Normality, normality
from orthoflow_plugins.plane.sample import PreparedCloud

Viewpoint = Literal["stations", "view_from", "guess"]

_VOTERS_MOST: Final = 5000
_WITNESSES_MOST: Final = 40_000
# Cosine of 20 degrees.
_PARALLEL: Final = 0.94
# A station nearer to the plane than this stands in it, and says nothing about its side.
_CLEAR_M: Final = 0.05
# Beyond this distance a point says no more about the side of the room than a nearer one.
_FULL_SAY_M: Final = 1.0
# Points may project this far outside the rectangle: floor and ceiling lie at its edges.
_BESIDE_M: Final = 0.3
# A verdict below this share of all points, each just clear of the plane, is none.
_DOUBT: Final = 0.01


@dataclass(frozen=True, kw_only=True)
class RawPlane:
    """What a detector itself said about a plane, before the common fit; world.

    Attributes:
        plane: its normal to the same side as that of the fit.
        votes: what spoke for it, by the detector's own count.
        own_tolerance_m: the tolerance that the detector found itself, or None.
    """

    plane: Plane
    votes: float
    own_tolerance_m: float | None

    def to_json(self) -> dict[str, JsonValue]:
        """Numbers for the planes' details."""
        return {
            "normal": [float(value) for value in self.plane.normal],
            "offset_m": self.plane.offset_m,
            "support": self.votes,
            "own_tolerance_m": self.own_tolerance_m,
        }


@dataclass(frozen=True, kw_only=True)
class Assembly:
    """The products of a detector, and what else is known about them.

    Attributes:
        planes: ordered by support.
        labels_from_claims: (k + 1,) int16 label of each claim; the last entry is for -1.
        deviations: of the planes in their final order.
        n_guessed: planes whose side was guessed.
        raw: of each plane what its detector itself said.
        normalities: of each plane how normal its deviations are, None where it has too few points.
        n_independent: of each plane, how many cells without common errors would fix it as well.
    """

    planes: Planes
    labels_from_claims: NDArray[np.int16]
    deviations: Deviations
    n_guessed: int
    raw: tuple[RawPlane, ...]
    normalities: tuple[Normality | None, ...]
    n_independent: tuple[float, ...]


def assemble(
    found: list[FoundPlane], prepared: PreparedCloud, deviations: Deviations, cloud: PointCloud
) -> Assembly:
    """Give planes their side, order and names."""
    order = np.argsort(-deviations.n_find, kind="stable")
    ordered = deviations.take(order)
    faced = [_faced(found, int(i), prepared, cloud, deviations) for i in order]
    # Histograms and means follow the normal when it was turned.
    flips = np.array(
        [
            float(item.plane.normal @ found[i].raster.plane.normal) < 0.0
            for item, i in zip(faced, order, strict=True)
        ]
    )
    ordered.histogram[flips] = ordered.histogram[flips][:, ::-1]
    ordered.mean_fit_m[flips] *= -1.0
    normalities = tuple(
        normality(row, find_m=ordered.find_m, fit_m=ordered.fit_m) for row in ordered.histogram
    )
    raw = tuple(_raw(found[i].candidate, item, cloud) for i, item in zip(order, faced, strict=True))
    viewpoint: Viewpoint = known_viewpoint(cloud)
    is_guessed = [item.is_guessed for item in faced]
    if all(is_guessed):
        viewpoint = "guess"
    planes = Planes(
        normal=np.array([item.plane.normal for item in faced]),
        offset=np.array([_world_offset(item.plane, cloud) for item in faced]),
        corners=np.array([cloud.origin + item.corners_m for item in faced]),
        covariance=np.array([_world_covariance(item.stated.covariance, cloud) for item in faced]),
        n_points=ordered.n_find,
        rms_m=ordered.rms_find_m,
        up=cloud.up.copy(),
        names=plane_names(
            np.array([item.plane.normal for item in faced]),
            np.array([item.corners_m.mean(axis=0) @ cloud.up for item in faced]),
            cloud.up,
        ),
        part_corners=np.concatenate([cloud.origin + item.part_corners_m for item in faced]),
        part_plane=np.repeat(
            np.arange(len(faced), dtype=np.int32), [len(item.part_corners_m) for item in faced]
        ),
        viewpoint=viewpoint,
        side_from=_sides(viewpoint, is_guessed) if len(set(is_guessed)) > 1 else (),
        tolerance_m=ordered.find_m,
        details=_details(faced, ordered, normalities, raw),
    )
    labels = np.full(len(found) + 1, -1, dtype=np.int16)
    labels[order] = np.arange(len(found), dtype=np.int16)
    return Assembly(
        planes=planes,
        labels_from_claims=labels,
        deviations=ordered,
        n_guessed=sum(item.is_guessed for item in faced),
        raw=raw,
        normalities=normalities,
        n_independent=tuple(item.stated.n_independent for item in faced),
    )


def plane_names(
    normals: NDArray[np.float64], heights_m: NDArray[np.float64], up: NDArray[np.float64]
) -> tuple[str, ...]:
    """Name planes by what they are: `wall 0`, `floor 1`, `ceiling 2`, `level 4`, `slope 5`.

    The number is the plane's position in the product, as in the files wall_<k>_*.tif. The floor is
    the lowest level plane that is seen from above, the ceiling the highest that is seen from below.

    Args:
        normals: (k, 3) towards the viewer.
        heights_m: (k,) along up.
        up: (3,) unit vector.
    """
    rises = normals @ up
    level = np.abs(rises) > math.cos(math.radians(LEVEL_LIMIT_DEG))
    kinds: list[PlaneKind] = [
        "level" if level[i] else "wall" if abs(rises[i]) < 0.5 else "slope"
        for i in range(len(normals))
    ]
    seen_from_above = np.flatnonzero(level & (rises > 0.0))
    seen_from_below = np.flatnonzero(level & (rises < 0.0))
    if len(seen_from_above):
        kinds[int(seen_from_above[np.argmin(heights_m[seen_from_above])])] = "floor"
    if len(seen_from_below):
        kinds[int(seen_from_below[np.argmax(heights_m[seen_from_below])])] = "ceiling"
    return tuple(plane_name(kind, place) for place, kind in enumerate(kinds))


def rectangle_m(
    plane: Plane, axes: NDArray[np.float64], bounds_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Corners (4, 3) on a plane: top-left first, counter-clockwise for the viewer.

    Args:
        plane: the plane, normal towards the viewer.
        axes: (2, 3) u to the viewer's right and v down (`wall_axes`).
        bounds_m: (4,) smallest and largest u, smallest and largest v.
    """
    left, right, top, bottom = bounds_m
    around = np.array([[left, top], [left, bottom], [right, bottom], [right, top]])
    return around @ axes + plane.offset_m * plane.normal


def enclosing(
    corners_m: NDArray[np.float64], plane: Plane, axes: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Give the rectangle along other axes of a plane that encloses one; for a flip the same one."""
    placed = corners_m @ axes.T
    low, high = placed.min(axis=0), placed.max(axis=0)
    return rectangle_m(plane, axes, np.array([low[0], high[0], low[1], high[1]]))


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


def warn_of_guesses(ctx: StepContext, n_guessed: int, n_planes: int) -> None:
    """Say that the side from which planes are seen was guessed, and how to state it."""
    ctx.warn(
        f"no scanner station says from which side {n_guessed} of {n_planes} planes were seen; the "
        "side with more of the other points was taken, unless photos decide later (face.photos): "
        "if an image comes out mirrored, set view_from of read.scan"
    )


@dataclass(frozen=True, kw_only=True)
class _Faced:
    """A found plane with its normal towards the viewer, in offsets."""

    plane: Plane
    stated: Stated
    corners_m: NDArray[np.float64]
    part_corners_m: NDArray[np.float64]
    is_guessed: bool


def _faced(
    found: list[FoundPlane],
    claim: int,
    prepared: PreparedCloud,
    cloud: PointCloud,
    deviations: Deviations,
) -> _Faced:
    raster, place = found[claim].raster, found[claim].support
    plane, axes = raster.plane, raster.axes
    extent_m = deviations.extents_m[claim]
    corners_m = rectangle_m(plane, axes, extent_m)
    claims = prepared.sample_claims
    members = prepared.sample.index[claims == claim]
    # Evenly thinned, since a plane's first points may all be from one scan.
    members = members[:: max(1, len(members) // _VOTERS_MOST)]
    side = side_of_stations(plane, corners_m.mean(axis=0), cloud, members)
    is_guessed = side == 0
    if is_guessed:
        # The last entry stands for points on no plane: a claim of -1 picks it.
        parallel = [
            abs(float(item.raster.plane.normal @ plane.normal)) > _PARALLEL for item in found
        ]
        every = max(1, len(claims) // _WITNESSES_MOST)
        side = side_of_remaining(
            plane,
            corners_m,
            prepared.sample.offsets_m[::every],
            np.array([*parallel, False])[claims[::every]],
            clear_m=deviations.find_m,
        )
    # Parts are known to a cell; none reaches beyond the points that are there.
    parts_m = [
        rectangle_m(plane, axes, np.clip(bounds, extent_m[[0, 0, 2, 2]], extent_m[[1, 1, 3, 3]]))
        for bounds in place.parts_m
    ]
    stated = found[claim].adjusted.stated()
    if side < 0:
        # Normal and offset change sign together, so their covariance stays as it is.
        plane = plane.flipped()
    turned = wall_axes(plane.normal, cloud.up)
    return _Faced(
        plane=plane,
        stated=stated,
        corners_m=enclosing(corners_m, plane, turned),
        part_corners_m=np.array([enclosing(part, plane, turned) for part in parts_m]),
        is_guessed=is_guessed,
    )


def _sides(viewpoint: Viewpoint, is_guessed: list[bool]) -> tuple[SideSource, ...]:
    known: SideSource = "given" if viewpoint == "view_from" else "stations"
    return tuple("guess" if guessed else known for guessed in is_guessed)


def _details(
    faced: list[_Faced],
    ordered: Deviations,
    normalities: tuple[Normality | None, ...],
    raw: tuple[RawPlane, ...],
) -> dict[str, JsonValue]:
    """What a detector says about its planes besides, for people."""
    return {
        "fit_n_points": [int(n) for n in ordered.n_fit],
        "fit_rms_m": [float(value) for value in ordered.rms_fit_m],
        "n_independent": [item.stated.n_independent for item in faced],
        "normality": [None if item is None else item.to_json() for item in normalities],
        "fit_tolerance_m": ordered.fit_m,
        "raw": [item.to_json() for item in raw],
        "guessed_sides": [index for index, item in enumerate(faced) if item.is_guessed],
    }


def _raw(candidate: Candidate, faced: _Faced, cloud: PointCloud) -> RawPlane:
    plane = candidate.plane
    if float(plane.normal @ faced.plane.normal) < 0.0:
        plane = plane.flipped()
    return RawPlane(
        plane=Plane(normal=plane.normal, offset_m=_world_offset(plane, cloud)),
        votes=float(candidate.votes),
        own_tolerance_m=candidate.own_tolerance_m,
    )


def _world_offset(plane: Plane, cloud: PointCloud) -> float:
    return plane.offset_m + float(plane.normal @ cloud.origin)


def _world_covariance(covariance: NDArray[np.float64], cloud: PointCloud) -> NDArray[np.float64]:
    """Covariance of (normal, offset) with the offset counted from the world's origin."""
    shift = np.eye(4)
    shift[3, :3] = cloud.origin
    moved: NDArray[np.float64] = shift @ covariance @ shift.T
    return 0.5 * (moved + moved.T)
