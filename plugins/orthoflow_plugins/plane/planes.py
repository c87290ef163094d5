"""Products from detected planes: deviations, visible sides, order, names and rectangles.

Deviations of all points are measured in one pass. markiewicz2015 regards a plane as correct if its
deviations appear normally distributed (Figures 6c to 14c). With a million points, every formal test
rejects normality. Instead, the departure from a normal distribution is reported: skewness, excess
kurtosis, shares within one, two and three standard deviations, and a quantile-quantile plot.

The visible side of a plane is determined from the scanner stations, or guessed from the points. If
the side is wrong, all images of the wall are mirrored, so guesses are always reported.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane, angle_between_deg, omega_phi_deg, wall_axes
from orthoflow.geometry.frames import LEVEL_LIMIT_DEG
from orthoflow.geometry.rows import Rows
from orthoflow.products import JsonValue, Planes, PointCloud, SideSource, plane_name
from orthoflow.products.planes import PlaneKind
from orthoflow.sdk import DiagnosticSpec, StepContext
from orthoflow_plugins.plane.cloud import PreparedCloud
from orthoflow_plugins.plane.fit import FoundPlane
from orthoflow_plugins.plane.kernels import (
    HISTOGRAM_BINS,
    STEPS_PER_TOLERANCE,
    each_part,
    measure_deviations,
    piece_of,
)
from orthoflow_plugins.plane.support import SurfaceRaster

Viewpoint = Literal["stations", "view_from", "guess"]

# Minimum number of points for the statistics of a distribution.
_DISTRIBUTION_LEAST: Final = 100
_PROBABILITIES: Final = (
    0.001, 0.0025, 0.005, 0.01, 0.025, *(0.05 * step for step in range(1, 20)),
    0.975, 0.99, 0.995, 0.9975, 0.999,
)  # fmt: skip
# The visible side of a plane is determined from at most this many of its points, and at most this
# many points of the cloud.
_MEMBERS_MOST: Final = 5000
_WITNESSES_MOST: Final = 40_000
# Planes count as parallel if the cosine of the angle between them exceeds this (cosine of 20
# degrees).
_PARALLEL: Final = 0.94
# A station closer to the plane than this does not determine its visible side.
_CLEAR_M: Final = 0.05
# The weight of a point in the vote for the visible side increases up to this distance from the
# plane.
_FULL_VOTE_M: Final = 1.0
# The projections of points may be this far outside the rectangle, because the floor and the ceiling
# are at its edges.
_BESIDE_M: Final = 0.3
# Minimum majority of the weighted votes, relative to the votes of all points if each were at the
# minimum distance from the plane.
_DOUBT: Final = 0.01
SIDES_GUESSED: Final = DiagnosticSpec(
    code="plane-sides-unknown",
    severity="warning",
    text="no scanner station shows from which side {n} of {n_planes} planes were seen; the side "
    "with more of the other points was assumed, unless photos decide later (face.photos)",
    remedy="if an image comes out mirrored, set {step[read.scan]}.view_from",
    rank_by="n",
    settled_by=("face.photos",),
)


@dataclass(frozen=True, kw_only=True)
class Deviations(Rows):
    """Deviations of points from their planes.

    Attributes:
        n_points: (k,) int64 number of points of each plane.
        rms_m: (k,) root mean square of the distances.
        n_fit: (k,) int64 number of points within the tolerance of the fit.
        rms_fit_m: (k,) root mean square of the distances within the tolerance of the fit.
        mean_fit_m: (k,) mean of the distances within the tolerance of the fit.
        histogram: (k, bins) number of points in bins between -tolerance_m and tolerance_m.
        extents_m: (k, 4) smallest u, largest u, smallest v and largest v of the points inside the
            plane's rectangle and the tolerance of the fit.
        tolerance_m: maximum distance of points that belong to a plane.
        fit_tolerance_m: maximum distance of points that are used in the fit.
    """

    n_points: NDArray[np.int64]
    rms_m: NDArray[np.float64]
    n_fit: NDArray[np.int64]
    rms_fit_m: NDArray[np.float64]
    mean_fit_m: NDArray[np.float64]
    histogram: NDArray[np.int64]
    extents_m: NDArray[np.float64]
    tolerance_m: float
    fit_tolerance_m: float


@dataclass(frozen=True, kw_only=True)
class Normality:
    """Shape of a distribution of distances.

    Attributes:
        mean_m: mean.
        sigma_m: standard deviation.
        skewness: third standardised moment; 0 for a normal distribution.
        excess_kurtosis: fourth standardised moment minus 3; 0 for a normal distribution.
        within: shares within 1, 2 and 3 sigma of the mean; 0.683, 0.954 and 0.997 for a normal
            distribution.
        expected_sigmas: (q,) quantiles of the standard normal distribution.
        found_sigmas: (q,) the same quantiles of the distances, minus the mean and divided by sigma.
    """

    mean_m: float
    sigma_m: float
    skewness: float
    excess_kurtosis: float
    within: tuple[float, ...]
    expected_sigmas: NDArray[np.float64]
    found_sigmas: NDArray[np.float64]

    def to_json(self) -> JsonValue:
        """Return the values as recorded in the details of the planes."""
        return {
            "mean_m": self.mean_m,
            "sigma_m": self.sigma_m,
            "skewness": self.skewness,
            "excess_kurtosis": self.excess_kurtosis,
            "within_sigmas": list(self.within),
        }


@dataclass(frozen=True, kw_only=True)
class FacedPlane:
    """A plane whose normal points towards the viewer, and its rectangles, in the cloud's offsets.

    Attributes:
        plane: the plane.
        corners_m: (4, 3) corners, top-left first, counter-clockwise for the viewer.
        part_corners_m: (p, 4, 3) corners of each connected part.
        is_guessed: whether the visible side was guessed, because no station determines it.
    """

    plane: Plane
    corners_m: NDArray[np.float64]
    part_corners_m: NDArray[np.float64]
    is_guessed: bool


def assemble(
    found: list[FoundPlane],
    prepared: PreparedCloud,
    cloud: PointCloud,
) -> tuple[Planes, Deviations, list[Normality | None], NDArray[np.intp]]:
    """Measure the deviations of planes, and determine their visible sides, order and names.

    Returns:
        The planes, largest first; their deviations; the normality of the deviations (None for a
        plane with too few points); and the index (k,) of each plane in `found`.
    """
    deviations = measure_planes(
        prepared,
        np.array([item.raster.slab() for item in found]),
        np.array([item.support.bounds_m for item in found]),
    )
    order = np.argsort(-deviations.n_points, kind="stable")
    ordered = deviations.take(order)
    faced = [_faced(found, int(k), deviations, prepared, cloud) for k in order]
    raw: list[JsonValue] = []
    for place, (k, side) in enumerate(zip(order, faced, strict=True)):
        candidate, own = found[k].candidate, _raw(found[k], side.plane, cloud)
        if float(side.plane.normal @ found[k].raster.plane.normal) < 0.0:
            # If the normal was reversed, reverse the histogram and the mean.
            ordered.histogram[place] = ordered.histogram[place, ::-1].copy()
            ordered.mean_fit_m[place] *= -1.0
        raw.append(
            {
                "normal": own.normal.tolist(),
                "offset_m": own.offset_m,
                "own_tolerance_m": candidate.own_tolerance_m,
            }
        )
    normalities = [
        normality(row, tolerance_m=prepared.tolerance_m, fit_tolerance_m=prepared.fit_tolerance_m)
        for row in ordered.histogram
    ]
    # If a normal is reversed, the offset changes sign, too, so the covariance does not change.
    covariances = [found[k].adjusted.stated()[0] for k in order]
    is_guessed = [item.is_guessed for item in faced]
    viewpoint: Viewpoint = "guess" if all(is_guessed) else known_viewpoint(cloud)
    known: SideSource = "given" if viewpoint == "view_from" else "stations"
    sides = tuple[SideSource, ...]("guess" if guessed else known for guessed in is_guessed)
    planes = planes_of(
        faced,
        ordered,
        cloud,
        covariances=covariances,
        viewpoint=viewpoint,
        side_from=sides if len(set(is_guessed)) > 1 else (),
        details={
            "fit_n_points": ordered.n_fit.tolist(),
            "fit_rms_m": ordered.rms_fit_m.tolist(),
            "normality": [None if item is None else item.to_json() for item in normalities],
            "fit_tolerance_m": ordered.fit_tolerance_m,
            "raw": raw,
        },
    )
    return planes, ordered, normalities, order


def planes_of(
    faced: Sequence[FacedPlane],
    deviations: Deviations,
    cloud: PointCloud,
    *,
    covariances: Sequence[NDArray[np.float64]],
    viewpoint: str,
    side_from: tuple[SideSource, ...] = (),
    details: dict[str, JsonValue] | None = None,
) -> Planes:
    """Return a product with planes in this order; covariances (4, 4) are of (normal, offset)."""
    normals = np.array([item.plane.normal for item in faced])
    heights_m = np.array([item.corners_m.mean(axis=0) @ cloud.up for item in faced])
    n_parts = [len(item.part_corners_m) for item in faced]
    # Convert the offsets to offsets from the world's origin.
    shift = np.eye(4)
    shift[3, :3] = cloud.origin
    moved = shift @ np.array(covariances) @ shift.T
    return Planes(
        normal=normals,
        offset=np.array([item.plane.offset_m for item in faced]) + normals @ cloud.origin,
        corners=np.array([cloud.origin + item.corners_m for item in faced]),
        covariance=0.5 * (moved + moved.transpose(0, 2, 1)),
        n_points=deviations.n_points,
        rms_m=deviations.rms_m,
        up=cloud.up.copy(),
        names=plane_names(normals, heights_m, cloud.up),
        part_corners=np.concatenate([cloud.origin + item.part_corners_m for item in faced]),
        part_plane=np.repeat(np.arange(len(faced), dtype=np.int32), n_parts),
        viewpoint=viewpoint,
        side_from=side_from,
        tolerance_m=deviations.tolerance_m,
        details=details or {},
    )


def _raw(item: FoundPlane, plane: Plane, cloud: PointCloud) -> Plane:
    own = item.candidate.plane
    if float(own.normal @ plane.normal) < 0.0:
        own = own.flipped()
    return Plane(normal=own.normal, offset_m=own.offset_m + float(own.normal @ cloud.origin))


def report_planes(
    ctx: StepContext, planes: Planes, deviations: Deviations, *, n_points: int
) -> None:
    """Report the number of planes, their share of points, the first plane, and guessed sides."""
    omega_deg, phi_deg = omega_phi_deg(planes.normal[0], planes.up)
    ctx.metric("n_planes", len(planes), "1")
    ctx.metric("labelled_share", float(deviations.n_points.sum()) / n_points, "1")
    ctx.metric("rms_mm", 1000.0 * float(planes.rms_m[0]), "mm")
    ctx.metric("omega_deg", omega_deg, "deg")
    ctx.metric("phi_deg", phi_deg, "deg")
    ctx.metric("offset_m", float(planes.offset[0]), "m")
    n_guessed = sum(planes.side_source(k) == "guess" for k in range(len(planes)))
    if n_guessed:
        ctx.report(SIDES_GUESSED, n=n_guessed, n_planes=len(planes))


def report_first(
    ctx: StepContext,
    planes: Planes,
    deviations: Deviations,
    shape: Normality | None,
    found: FoundPlane,
    cloud: PointCloud,
) -> None:
    """Report the fit of the first plane, and how far it displaced the detector's proposal."""
    raw = _raw(found, planes.plane(0), cloud)
    ctx.metric("first_share", float(planes.n_points[0]) / len(cloud), "1")
    ctx.metric("fit_rms_mm", 1000.0 * float(deviations.rms_fit_m[0]), "mm")
    ctx.metric("r_m", abs(float(planes.offset[0])), "m")
    ctx.metric("sigma_angle_deg", planes.sigma_angle_deg(0), "deg")
    ctx.metric("sigma_offset_mm", 1000.0 * planes.sigma_offset_m(0), "mm")
    ctx.metric("n_independent", found.adjusted.stated()[1], "1")
    if shape is not None:
        ctx.metric("skewness", shape.skewness, "1")
        ctx.metric("excess_kurtosis", shape.excess_kurtosis, "1")
        for reach, share in enumerate(shape.within, start=1):
            ctx.metric(f"within_{reach}_sigma", share, "1")
    omega_deg, phi_deg = omega_phi_deg(raw.normal, planes.up)
    miss_m = raw.offset_m - float(raw.normal @ planes.corners[0].mean(axis=0))
    ctx.metric("raw_omega_deg", omega_deg, "deg")
    ctx.metric("raw_phi_deg", phi_deg, "deg")
    ctx.metric("raw_r_m", abs(raw.offset_m), "m")
    ctx.metric("raw_angle_deg", angle_between_deg(raw.normal, planes.normal[0]), "deg")
    ctx.metric("raw_offset_mm", 1000.0 * miss_m, "mm")
    if found.candidate.own_tolerance_m is not None:
        ctx.metric("own_tolerance_mm", 1000.0 * found.candidate.own_tolerance_m, "mm")


def plane_names(
    normals: NDArray[np.float64], heights_m: NDArray[np.float64], up: NDArray[np.float64]
) -> tuple[str, ...]:
    """Name planes by kind, such as `wall 0`, `floor 1`, `ceiling 2`, `level 4` and `slope 5`.

    The number is the position of the plane in the product, as in the files wall_<k>_*.tif. The
    floor is the lowest horizontal plane seen from above, and the ceiling is the highest one seen
    from below.

    Args:
        normals: (k, 3) unit normals, towards the viewer.
        heights_m: (k,) heights of the planes along up, in metres.
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


def measure_planes(
    cloud: PreparedCloud, slabs: NDArray[np.float64], bounds_m: NDArray[np.float64]
) -> Deviations:
    """Measure the deviations of all points from their planes, in one pass.

    Args:
        cloud: the cloud with its claims.
        slabs: (k, 12) the planes.
        bounds_m: (k, 4) rectangles of the planes: smallest u, largest u, smallest v and largest v.
    """
    parts, count = cloud.parts, len(slabs)
    sums = np.zeros((parts, count, 6), dtype=np.int64)
    histogram = np.zeros((parts, count, HISTOGRAM_BINS), dtype=np.int64)
    extents = np.tile([np.inf, -np.inf, np.inf, -np.inf], (parts, count, 1))
    reaches_m = np.tile([cloud.tolerance_m, cloud.fit_tolerance_m], (count, 1))
    limits = np.column_stack([reaches_m, bounds_m])

    def measure(part: int, piece: slice) -> None:
        points, claims = piece_of(cloud.points, piece), cloud.claims[piece]
        tables = (sums[part], histogram[part], extents[part])
        measure_deviations(points, claims, slabs, limits, *tables)

    each_part(len(cloud.claims), parts, measure)
    n_points, _, squares, n_fit, steps_fit, squares_fit = sums.sum(axis=0).T
    step_m = cloud.fit_tolerance_m / STEPS_PER_TOLERANCE
    low, high = extents.min(axis=0), extents.max(axis=0)
    reached = np.column_stack([low[:, 0], high[:, 1], low[:, 2], high[:, 3]])
    return Deviations(
        n_points=n_points,
        rms_m=np.sqrt(squares / np.maximum(n_points, 1)) * step_m,
        n_fit=n_fit,
        rms_fit_m=np.sqrt(squares_fit / np.maximum(n_fit, 1)) * step_m,
        mean_fit_m=steps_fit / np.maximum(n_fit, 1) * step_m,
        histogram=histogram.sum(axis=0),
        # Use the rectangle of a plane if all points within the tolerance of the fit are nearer to
        # other planes.
        extents_m=np.where(np.isfinite(reached), reached, bounds_m),
        tolerance_m=cloud.tolerance_m,
        fit_tolerance_m=cloud.fit_tolerance_m,
    )


def normality(
    histogram: NDArray[np.int64], *, tolerance_m: float, fit_tolerance_m: float
) -> Normality | None:
    """Describe the distances within the fit tolerance, given their histogram over +-tolerance_m.

    Returns:
        The shape of the distribution; None if there are too few distances or all are in one bin.
    """
    edges_m = np.linspace(-tolerance_m, tolerance_m, len(histogram) + 1)
    middles_m = 0.5 * (edges_m[1:] + edges_m[:-1])
    held = np.abs(middles_m) <= fit_tolerance_m
    counts, middles_m = histogram[held].astype(np.float64), middles_m[held]
    total = float(counts.sum())
    if total < _DISTRIBUTION_LEAST:
        return None
    width_m = 2.0 * tolerance_m / len(histogram)
    mean_m = float(counts @ middles_m) / total
    away_m = middles_m - mean_m
    second, third, fourth = (float(counts @ away_m**power) / total for power in (2, 3, 4))
    # Apply Sheppard's corrections for the distribution of points within a bin.
    fourth += -0.5 * second * width_m**2 + 7.0 / 240.0 * width_m**4
    second -= width_m**2 / 12.0
    if second <= 0.0:
        return None
    sigma_m = math.sqrt(second)
    below = np.concatenate([[0.0], np.cumsum(counts)]) / total
    rims_m = np.append(middles_m - 0.5 * width_m, middles_m[-1] + 0.5 * width_m)
    quantiles_m = np.interp(_PROBABILITIES, below, rims_m)

    def share(reach: float) -> float:
        low, high = np.interp([mean_m - reach * sigma_m, mean_m + reach * sigma_m], rims_m, below)
        return float(high - low)

    return Normality(
        mean_m=mean_m,
        sigma_m=sigma_m,
        skewness=third / sigma_m**3,
        excess_kurtosis=fourth / second**2 - 3.0,
        within=(share(1.0), share(2.0), share(3.0)),
        expected_sigmas=np.array([NormalDist().inv_cdf(p) for p in _PROBABILITIES]),
        found_sigmas=(quantiles_m - mean_m) / sigma_m,
    )


def known_viewpoint(cloud: PointCloud) -> Viewpoint:
    """Return the source of the viewpoints: `stations`, `view_from`, or `guess` if unknown."""
    if cloud.stations is None or len(cloud.stations) == 0:
        return "guess"
    return "view_from" if cloud.stations_source == "view_from" else "stations"


def rectangle_m(
    plane: Plane, axes: NDArray[np.float64], bounds_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the corners (4, 3) on a plane: top-left first, counter-clockwise for the viewer.

    Args:
        plane: the plane, with its normal towards the viewer.
        axes: (2, 3) u to the viewer's right and v down (`wall_axes`).
        bounds_m: (4,) smallest u, largest u, smallest v and largest v.
    """
    left, right, top, bottom = bounds_m
    around = np.array([[left, top], [left, bottom], [right, bottom], [right, top]])
    return around @ axes + plane.offset_m * plane.normal


def face(
    raster: SurfaceRaster,
    extent_m: NDArray[np.float64],
    parts_m: NDArray[np.float64],
    side: int,
    up: NDArray[np.float64],
    *,
    is_guessed: bool,
) -> FacedPlane:
    """Turn a plane to a side, and return it with rectangles around its points and its parts.

    Parts consist of whole cells, so they are clipped to the extent of the points.
    """
    parts_m = np.clip(parts_m, extent_m[[0, 0, 2, 2]], extent_m[[1, 1, 3, 3]])
    corners = [rectangle_m(raster.plane, raster.axes, bounds) for bounds in (extent_m, *parts_m)]
    plane = raster.plane.flipped() if side < 0 else raster.plane
    axes = wall_axes(plane.normal, up)
    around = []
    for corners_m in corners:
        # Compute the bounding rectangle along the new axes; if the plane was turned, it is the same
        # rectangle.
        placed = corners_m @ axes.T
        low, high = placed.min(axis=0), placed.max(axis=0)
        around.append(rectangle_m(plane, axes, np.array([low[0], high[0], low[1], high[1]])))
    return FacedPlane(
        plane=plane,
        corners_m=around[0],
        part_corners_m=np.array(around[1:]),
        is_guessed=is_guessed,
    )


def side_of_stations(
    plane: Plane, centre_m: NDArray[np.float64], cloud: PointCloud, index: NDArray[np.int64]
) -> int:
    """Return the side of a plane from which its points were seen.

    Each point of the plane votes for the side on which the station of its scan is. If scans are
    unknown, only the station nearest to the centre of the plane is used.

    Args:
        plane: the plane in the cloud's offsets.
        centre_m: (3,) offset of the centre of the plane.
        cloud: the cloud.
        index: (m,) indices of some points of the plane.

    Returns:
        1 for the side of the normal, -1 for the other side, 0 if no station determines the side.
    """
    if cloud.stations is None or len(cloud.stations) == 0:
        return 0
    stations_m = cloud.stations - cloud.origin
    distances_m = plane.distances_m(stations_m)
    sides = np.where(np.abs(distances_m) > _CLEAR_M, np.sign(distances_m), 0.0)
    if cloud.scan is not None and len(index) and int(cloud.scan[index].max()) < len(stations_m):
        votes = np.bincount(cloud.scan[index], minlength=len(stations_m))
        verdict = float(votes @ sides)
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
    """Return the side of a plane with more of the other points, which probably faces the room.

    Points vote for the side on which they are. At first, points on parallel planes are excluded,
    because the whole wall is behind the front of a pilaster, although the room is in front of it.
    Also, only points in front of or behind the plane's rectangle vote. If they do not determine the
    side, more points are used. The weight of a vote increases with the distance from the plane up
    to a metre, because relief and recesses are near the plane, but the room is not.

    Args:
        plane: the plane in the cloud's offsets.
        corners_m: (4, 3) offsets of the corners of the plane's rectangle.
        points_m: (m, 3) offsets of a sample of the cloud.
        is_parallel: (m,) whether a point belongs to a plane parallel to this one.
        clear_m: points closer to the plane than this are on the plane and do not vote.

    Returns:
        1 for the side of the normal, -1 for the other side, 0 if the points do not determine the
        side.
    """
    relative = points_m - corners_m[0]
    within = np.ones(len(points_m), dtype=bool)
    for axis in (corners_m[3] - corners_m[0], corners_m[1] - corners_m[0]):
        length_m = max(float(np.linalg.norm(axis)), 1e-9)
        position_m = relative @ axis / length_m
        within &= (position_m > -_BESIDE_M) & (position_m < length_m + _BESIDE_M)
    distances_m = plane.distances_m(points_m)
    clear = np.abs(distances_m) > clear_m
    for chosen in (within & ~is_parallel, within, ~is_parallel, np.ones_like(within)):
        verdict = float(np.clip(distances_m[chosen & clear], -_FULL_VOTE_M, _FULL_VOTE_M).sum())
        # Ignore small majorities, which gross outliers on both sides of a bare wall cause.
        if abs(verdict) > _DOUBT * len(points_m) * clear_m:
            return 1 if verdict > 0.0 else -1
    return 0


def _faced(
    found: list[FoundPlane],
    claim: int,
    deviations: Deviations,
    prepared: PreparedCloud,
    cloud: PointCloud,
) -> FacedPlane:
    raster, plane = found[claim].raster, found[claim].raster.plane
    extent_m = deviations.extents_m[claim]
    corners_m = rectangle_m(plane, raster.axes, extent_m)
    claims = prepared.sample_claims
    members = prepared.sample.index[claims == claim]
    # Use points distributed over the whole plane, because its first points may all be from one
    # scan.
    members = members[:: max(1, len(members) // _MEMBERS_MOST)]
    side = side_of_stations(plane, corners_m.mean(axis=0), cloud, members)
    is_guessed = side == 0
    if is_guessed:
        # The last entry is for points on no plane, whose index is -1.
        turns = [abs(float(item.raster.plane.normal @ plane.normal)) for item in found]
        every = max(1, len(claims) // _WITNESSES_MOST)
        side = side_of_remaining(
            plane,
            corners_m,
            prepared.sample.offsets_m[::every],
            np.array([*turns, 0.0])[claims[::every]] > _PARALLEL,
            clear_m=deviations.tolerance_m,
        )
    parts_m = found[claim].support.parts_m
    return face(raster, extent_m, parts_m, side, cloud.up, is_guessed=is_guessed)
