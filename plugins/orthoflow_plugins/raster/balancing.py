"""Adjustment of the intensities of several scans to a common scale, using their overlaps.

Intensity decreases with range and incidence angle, and each scan may have its own scale. Where two
scans overlap, the surface is the same, so the ratios of their intensities separate the three
effects, independently of the texture. On a single wall, range and incidence are coupled: the cosine
of the incidence angle times the range is the distance of the station from the plane. Only their
joint effect can then be determined, which suffices for this wall.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.robust import least_absolute
from orthoflow.geometry.slabs import Slab
from orthoflow.products import PointCloud
from orthoflow.sdk import DiagnosticSpec, StepContext

# Side of the squares in which scans are compared. A square contains many points of each scan, but
# usually only one colour.
_PLACE_M: Final = 0.05
_POINTS_MOST: Final = 2_000_000
_PLACES_LEAST: Final = 20
_COSINE_LEAST: Final = 0.05
# Intensities of the first scan that were measured at this range with perpendicular incidence do not
# change.
_RANGE_M: Final = 3.0
_DARKEST: Final = 1.0e-4
_CHUNK: Final = 1 << 21
NOT_BALANCED: Final = DiagnosticSpec(
    code="intensity-not-balanced",
    severity="warning",
    text="intensities are unchanged: {reason}",
)


@dataclass(frozen=True)
class _Trend:
    """log intensity = scan scale + range_power * log(m) + cosine_power * log(cosine) + texture.

    Attributes:
        scales: (scans,) logarithms of the scales of the scans; the first is 0.
        range_power: exponent of the range.
        cosine_power: exponent of the cosine of the incidence angle.
    """

    scales: NDArray[np.float64]
    range_power: float
    cosine_power: float


def balanced(cloud: PointCloud, slabs: list[Slab], ctx: StepContext) -> PointCloud:
    """Return the cloud with intensities as if all points were measured under identical conditions.

    Only points on walls are corrected. If the scans do not overlap, the cloud is returned unchanged
    and a warning is reported.
    """
    if cloud.intensity is None or cloud.scan is None or cloud.stations is None:
        ctx.report(NOT_BALANCED, reason="balancing needs scans with known stations")
        return cloud
    samples = [_places(cloud, slab) for slab in slabs]
    table = np.vstack(samples)
    n_scans = len(cloud.stations)
    trend = _trend(table, n_scans)
    if trend is None:
        ctx.report(NOT_BALANCED, reason="no two scans overlap on the walls")
        return cloud
    ctx.metric("intensity_range_power", trend.range_power, "1")
    ctx.metric("intensity_cosine_power", trend.cosine_power, "1")
    ctx.metric("intensity_scale_spread", float(np.ptp(np.exp(trend.scales))), "1")
    intensity = np.array(cloud.intensity, dtype=np.float32)
    for slab in slabs:
        for first in range(0, len(cloud), _CHUNK):
            looks = _looks(cloud, slab, np.arange(first, min(first + _CHUNK, len(cloud))))
            inside = looks.points
            change = (
                trend.scales[looks.scan]
                + trend.range_power * np.log(looks.range_m / _RANGE_M)
                + trend.cosine_power * np.log(looks.cosine)
            )
            intensity[inside] = np.clip(cloud.intensity[inside] * np.exp(-change), 0.0, 1.0)
    return replace(cloud, intensity=intensity)


@dataclass(frozen=True)
class _Looks:
    """Scan geometry of n points in a slab."""

    points: NDArray[np.int64]
    place: NDArray[np.int64]
    scan: NDArray[np.int64]
    range_m: NDArray[np.float64]
    cosine: NDArray[np.float64]


def _looks(cloud: PointCloud, slab: Slab, points: NDArray[np.int64]) -> _Looks:
    if cloud.scan is None or cloud.stations is None:
        raise AssertionError("balancing needs a cloud with stations")
    frame = slab.frame
    from_corner = cloud.origin - frame.origin_world
    offsets = np.column_stack([cloud.x[points], cloud.y[points], cloud.z[points]])
    world = offsets.astype(np.float64) + from_corner
    if frame.bend is None:
        u, v, depth = world @ frame.u_world, world @ frame.v_world, world @ frame.normal_world
        normals = frame.normal_world[None]
    else:
        on_wall = frame.wall_from_world(world + frame.origin_world)
        u, v, depth = frame.gsd_m * on_wall[:, 0], frame.gsd_m * on_wall[:, 1], on_wall[:, 2]
        normals = frame.axes_at(on_wall[:, :2])[:, 2]
    size = frame.size_m
    inside = (u >= 0) & (u < size[0]) & (v >= 0) & (v < size[1])
    inside &= (depth >= -slab.behind_m) & (depth <= slab.front_m)
    if cloud.intensity is not None:
        inside &= np.isfinite(cloud.intensity[points])
    scan = cloud.scan[points[inside]].astype(np.int64)
    rays = (cloud.stations - frame.origin_world)[scan] - world[inside]
    range_m = np.maximum(np.linalg.norm(rays, axis=1), 1e-3)
    if frame.bend is None:
        lifts = rays @ frame.normal_world
    else:
        lifts = np.einsum("ij,ij->i", rays, normals[inside])
    cosine = np.clip(np.abs(lifts) / range_m, _COSINE_LEAST, 1.0)
    per_row = int(np.ceil(size[0] / _PLACE_M)) + 1
    place = np.floor(v[inside] / _PLACE_M) * per_row + np.floor(u[inside] / _PLACE_M)
    return _Looks(points[inside], place.astype(np.int64), scan, range_m, cosine)


def _places(cloud: PointCloud, slab: Slab) -> NDArray[np.float64]:
    """Return the differences between scans in the same square, one row per pair of scans.

    Returns:
        (n, 5) with the columns first scan, second scan, and the differences (first minus second)
        between their mean log intensities, log ranges and log cosines.
    """
    if cloud.intensity is None:
        raise AssertionError("balancing needs a cloud with intensity")
    every = max(1, len(cloud) // _POINTS_MOST)
    looks = _looks(cloud, slab, np.arange(0, len(cloud), every))
    n_scans = 0 if cloud.stations is None else len(cloud.stations)
    keys, members = np.unique(looks.place * n_scans + looks.scan, return_inverse=True)
    counts = np.bincount(members)
    logs = (
        np.log(np.maximum(cloud.intensity[looks.points].astype(np.float64), _DARKEST)),
        np.log(looks.range_m),
        np.log(looks.cosine),
    )
    means = np.column_stack([np.bincount(members, values) / counts for values in logs])
    # Keys are sorted, so the scans of a square are consecutive.
    pairs = np.flatnonzero(keys[1:] // n_scans == keys[:-1] // n_scans)
    scans = np.column_stack([keys[pairs] % n_scans, keys[pairs + 1] % n_scans])
    return np.column_stack([scans, means[pairs] - means[pairs + 1]])


def _trend(table: NDArray[np.float64], n_scans: int) -> _Trend | None:
    """Fit the differences in the L1 norm, which is robust to edges in the texture."""
    if len(table) < _PLACES_LEAST:
        return None
    first, second = table[:, 0].astype(np.int64), table[:, 1].astype(np.int64)
    design = np.zeros((len(table), n_scans + 2))
    rows = np.arange(len(table))
    design[rows, first] += 1.0
    design[rows, second] -= 1.0
    design[:, n_scans:] = table[:, 3:]
    # The first scan defines the scale; scans without overlap are unchanged.
    held = np.full(n_scans + 2, 1e-3)
    held[0] += 1e3
    solution = least_absolute(design, table[:, 2], held)
    return _Trend(
        scales=solution[:n_scans],
        range_power=float(solution[n_scans]),
        cosine_power=float(solution[n_scans + 1]),
    )
