"""How the points of planes lie about them: deviations, their distribution, thickness, a scan row.

Deviations are of all points, in one pass.

markiewicz2015 takes a plane as correct when its deviations look normal (Figures 6c to 14c). With a
million points every formal test rejects, so the departure itself is stated: skewness, excess
kurtosis, shares within one, two and three standard deviations, and quantile against quantile.

Thickness is the scanner's noise as the wall shows it; markiewicz2015 urges to look at this before
anything else (3.1, Figure 3). Relief and bow are not thickness, so distances are taken from the
mean of a small tile of the wall. It is measured on the sample. Along one row of a scan, which is
read from the whole cloud, there is no footprint and no second station to blur the picture: what is
left is the noise of single distances, on one material after the other.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import wall_axes
from orthoflow.geometry.robust import median_deviation
from orthoflow.geometry.rows import Rows
from orthoflow.products import JsonValue, Planes, PointCloud, ScanRow, Spread, Thickness
from orthoflow_plugins.plane.kernels import each_part, piece_of
from orthoflow_plugins.plane.sample import PreparedCloud
from orthoflow_plugins.plane.slab_kernels import (
    HISTOGRAM_BINS,
    STEPS_PER_TOLERANCE,
    measure_deviations,
)

# Lowest and highest intensity of each material.
Materials = Mapping[str, tuple[float, float]]

# Points that are too few to speak of a distribution.
_DISTRIBUTION_LEAST: Final = 100
_PROBABILITIES: Final = (
    0.001, 0.0025, 0.005, 0.01, 0.025, *(0.05 * step for step in range(1, 20)),
    0.975, 0.99, 0.995, 0.9975, 0.999,
)  # fmt: skip
# Side of a tile of a wall, and length of a piece of a row, from whose mean distances are taken.
_TILE_M: Final = 0.1
_TILE_LEAST: Final = 4
# Fewer points do not show a spread.
_SPREAD_LEAST: Final = 50
_INCIDENCE_DEG: Final = tuple(float(edge) for edge in range(0, 91, 10))
_CLASSES: Final = 6
# Half the share of a normal distribution that lies outside the width reported.
_TAIL: Final = 0.025
# Points a scan row needs on a plane to be worth drawing.
_ROW_LEAST: Final = 20


@dataclass(frozen=True, kw_only=True)
class Deviations(Rows):
    """How far the points of each plane lie from it.

    Attributes:
        n_find: (k,) int64 points that belong to the plane.
        rms_find_m: (k,) root mean square of their distances.
        n_fit: (k,) int64 those of them within the fit tolerance.
        rms_fit_m: (k,) root mean square of the distances of those.
        mean_fit_m: (k,) mean of the distances of those.
        histogram: (k, bins) points per bin of -find_m..find_m.
        extents_m: (k, 4) smallest and largest u, smallest and largest v of the points within the
            fit tolerance in the plane's rectangle.
        find_m: find tolerance.
        fit_m: fit tolerance.
    """

    n_find: NDArray[np.int64]
    rms_find_m: NDArray[np.float64]
    n_fit: NDArray[np.int64]
    rms_fit_m: NDArray[np.float64]
    mean_fit_m: NDArray[np.float64]
    histogram: NDArray[np.int64]
    extents_m: NDArray[np.float64]
    find_m: float
    fit_m: float


def measure_planes(
    cloud: PreparedCloud,
    slabs: NDArray[np.float64],
    bounds_m: NDArray[np.float64],
    *,
    find_m: float,
    fit_m: float,
) -> Deviations:
    """Measure the deviations of all claimed points in one pass.

    Args:
        cloud: the cloud with its claims.
        slabs: (k, 12) the planes.
        bounds_m: (k, 4) their rectangles, smallest and largest u, smallest and largest v.
        find_m: find tolerance.
        fit_m: fit tolerance.
    """
    parts, count = cloud.parts, len(slabs)
    sums = np.zeros((parts, count, 6), dtype=np.int64)
    histogram = np.zeros((parts, count, HISTOGRAM_BINS), dtype=np.int64)
    extents = np.tile([np.inf, -np.inf, np.inf, -np.inf], (parts, count, 1))
    fit_m = min(fit_m, find_m)
    limits = np.column_stack([np.full(count, find_m), np.full(count, fit_m), bounds_m])

    def measure(part: int, piece: slice) -> None:
        measure_deviations(
            piece_of(cloud.points, piece),
            cloud.claims[piece],
            slabs,
            limits,
            sums[part],
            histogram[part],
            extents[part],
        )

    each_part(len(cloud.claims), parts, measure)
    total = sums.sum(axis=0)
    step_m = fit_m / STEPS_PER_TOLERANCE
    n_find, n_fit = total[:, 0], total[:, 3]
    low, high = extents.min(axis=0), extents.max(axis=0)
    reached = np.column_stack([low[:, 0], high[:, 1], low[:, 2], high[:, 3]])
    return Deviations(
        n_find=n_find,
        rms_find_m=np.sqrt(total[:, 2] / np.maximum(n_find, 1)) * step_m,
        n_fit=n_fit,
        rms_fit_m=np.sqrt(total[:, 5] / np.maximum(n_fit, 1)) * step_m,
        mean_fit_m=total[:, 4] / np.maximum(n_fit, 1) * step_m,
        histogram=histogram.sum(axis=0),
        # A later, nearer plane may have taken every point within the fit tolerance.
        extents_m=np.where(np.isfinite(reached), reached, bounds_m),
        find_m=find_m,
        fit_m=fit_m,
    )


@dataclass(frozen=True, kw_only=True)
class Normality:
    """Shape of a distribution of distances.

    Attributes:
        mean_m: their mean.
        sigma_m: their standard deviation.
        skewness: third standardised moment, 0 for a normal distribution.
        excess_kurtosis: fourth standardised moment less 3, 0 for a normal distribution.
        within: shares within 1, 2 and 3 sigma of the mean; 0.683, 0.954, 0.997 if normal.
        expected_sigmas: (q,) quantiles of the normal distribution.
        found_sigmas: (q,) the same quantiles of the distances from their mean, over sigma.
    """

    mean_m: float
    sigma_m: float
    skewness: float
    excess_kurtosis: float
    within: tuple[float, ...]
    expected_sigmas: NDArray[np.float64]
    found_sigmas: NDArray[np.float64]

    def to_json(self) -> JsonValue:
        """Numbers for the planes' details."""
        return {
            "mean_m": self.mean_m,
            "sigma_m": self.sigma_m,
            "skewness": self.skewness,
            "excess_kurtosis": self.excess_kurtosis,
            "within_sigmas": list(self.within),
        }


def normality(histogram: NDArray[np.int64], *, find_m: float, fit_m: float) -> Normality | None:
    """Judge the distances that a histogram over -find_m..find_m holds within the fit tolerance.

    Returns:
        Their shape, or None where there are too few, or all in one bin.
    """
    edges_m = np.linspace(-find_m, find_m, len(histogram) + 1)
    middles_m = 0.5 * (edges_m[1:] + edges_m[:-1])
    held = np.abs(middles_m) <= fit_m
    counts, middles_m = histogram[held].astype(np.float64), middles_m[held]
    total = float(counts.sum())
    if total < _DISTRIBUTION_LEAST:
        return None
    width_m = 2.0 * find_m / len(histogram)
    mean_m = float(counts @ middles_m) / total
    away_m = middles_m - mean_m
    second, third, fourth = (float(counts @ away_m**power) / total for power in (2, 3, 4))
    # Sheppard's corrections: within a bin, points spread over its width.
    fourth += -0.5 * second * width_m**2 + 7.0 / 240.0 * width_m**4
    second -= width_m**2 / 12.0
    if second <= 0.0:
        return None
    sigma_m = math.sqrt(second)
    below = np.concatenate([[0.0], np.cumsum(counts)]) / total
    rims_m = np.append(middles_m - 0.5 * width_m, middles_m[-1] + 0.5 * width_m)

    def share(reach: float) -> float:
        low, high = np.interp([mean_m - reach * sigma_m, mean_m + reach * sigma_m], rims_m, below)
        return float(high - low)

    quantiles_m = np.interp(_PROBABILITIES, below, rims_m)
    return Normality(
        mean_m=mean_m,
        sigma_m=sigma_m,
        skewness=third / sigma_m**3,
        excess_kurtosis=fourth / second**2 - 3.0,
        within=(share(1.0), share(2.0), share(3.0)),
        expected_sigmas=np.array([NormalDist().inv_cdf(p) for p in _PROBABILITIES]),
        found_sigmas=(quantiles_m - mean_m) / sigma_m,
    )


def measure_thickness(
    planes: Planes,
    plane_of_sample: NDArray[np.int64],
    prepared: PreparedCloud,
    cloud: PointCloud,
    *,
    reach_m: float,
    materials: Materials,
) -> tuple[Thickness | None, ...]:
    """Measure the thickness of each plane; None where too few points are on it.

    Args:
        planes: the planes, world.
        plane_of_sample: (s,) plane of each point of the sample, -1 for none.
        prepared: the cloud as the passes take it, and its sample.
        cloud: the cloud.
        reach_m: points further than this from their plane are relief or belong to something else.
        materials: lowest and highest intensity of each material.
    """
    seen = _Seen(prepared=prepared, cloud=cloud, materials=materials)
    found: list[Thickness | None] = []
    for k in range(len(planes)):
        members = np.flatnonzero(plane_of_sample == k)
        offset_m = planes.offset[k] - float(planes.normal[k] @ cloud.origin)
        distance_m = prepared.sample.offsets_m[members] @ planes.normal[k] - offset_m
        near = np.abs(distance_m) <= reach_m
        found.append(_measured(planes, k, members[near], distance_m[near], seen))
    return tuple(found)


@dataclass(frozen=True, kw_only=True)
class RowPoints:
    """The points of one row of one scan on the first plane.

    Attributes:
        row: its number.
        scan: the scan it is from.
        along_m: (n,) place along the plane, to the viewer's right; ascending.
        distance_m: (n,) distance from the plane, positive towards the viewer.
        intensity: (n,) 0..1, or None where the cloud has none.
    """

    row: int
    scan: int
    along_m: NDArray[np.float64]
    distance_m: NDArray[np.float64]
    intensity: NDArray[np.float64] | None

    def measured(self, materials: Materials) -> ScanRow:
        """Thickness of the row, and of each material on it."""
        piece = np.floor((self.along_m - self.along_m[0]) / _TILE_M).astype(np.int64)
        count = np.bincount(piece)
        mean_m = np.bincount(piece, self.distance_m) / np.maximum(count, 1)
        crowded = count[piece] >= _TILE_LEAST
        piece = piece[crowded]
        deviation_m = _from_means(self.distance_m[crowded], mean_m[piece], count[piece])
        material: tuple[Spread, ...] = ()
        if self.intensity is not None:
            material = _by_material(self.intensity[crowded], materials, deviation_m)
        return ScanRow(
            row=self.row,
            scan=self.scan,
            n_points=len(self.along_m),
            sigma_m=median_deviation(deviation_m, 0.0) if len(deviation_m) else None,
            material=material,
        )


def row_points(
    planes: Planes, plane_of_sample: NDArray[np.int64], prepared: PreparedCloud, cloud: PointCloud
) -> RowPoints | None:
    """Give the scan row that most of the first plane's points are on, None without rows."""
    if cloud.row is None:
        return None
    members = prepared.sample.index[plane_of_sample == 0]
    if not len(members):
        return None
    scans = np.zeros(len(members), dtype=np.int64) if cloud.scan is None else cloud.scan[members]
    keys = scans.astype(np.int64) * 2**32 + cloud.row[members]
    names, counts = np.unique(keys, return_counts=True)
    scan, row = divmod(int(names[np.argmax(counts)]), 2**32)
    chosen = np.flatnonzero(cloud.row == row)
    if cloud.scan is not None:
        chosen = chosen[cloud.scan[chosen] == scan]
    on_plane = prepared.claims[chosen]
    claim = prepared.sample_claims[plane_of_sample == 0]
    chosen = chosen[on_plane == claim[0]]
    if len(chosen) < _ROW_LEAST:
        return None
    points = np.column_stack([cloud.x[chosen], cloud.y[chosen], cloud.z[chosen]]).astype(np.float64)
    normal = planes.normal[0]
    along_m = points @ wall_axes(normal, planes.up)[0]
    order = np.argsort(along_m, kind="stable")
    distance_m = points @ normal - (planes.offset[0] - float(normal @ cloud.origin))
    intensity = None
    if cloud.intensity is not None:
        intensity = np.nan_to_num(cloud.intensity[chosen].astype(np.float64))
    return RowPoints(
        row=row,
        scan=scan,
        along_m=along_m[order],
        distance_m=distance_m[order],
        intensity=None if intensity is None else intensity[order],
    )


@dataclass(frozen=True, kw_only=True)
class _Seen:
    """What thickness is measured on."""

    prepared: PreparedCloud
    cloud: PointCloud
    materials: Materials


def _measured(
    planes: Planes,
    index: int,
    members: NDArray[np.int64],
    distance_m: NDArray[np.float64],
    seen: _Seen,
) -> Thickness | None:
    sample = seen.prepared.sample
    points_m = sample.offsets_m[members]
    normal = planes.normal[index]
    placed = np.floor(points_m @ wall_axes(normal, planes.up).T / _TILE_M).astype(np.int64)
    # One number per tile, since rows of two take many times as long to sort.
    keys = placed[:, 0] * 2**31 + placed[:, 1]
    _, tile, count = np.unique(keys, return_inverse=True, return_counts=True)
    mean_m = np.bincount(tile, distance_m) / count
    crowded = count[tile] >= _TILE_LEAST
    if crowded.sum() < _SPREAD_LEAST:
        return None
    tile = tile[crowded]
    deviation_m = _from_means(distance_m[crowded], mean_m[tile], count[tile])
    low_m, high_m = np.quantile(deviation_m, (_TAIL, 1.0 - _TAIL))
    density = float(np.median(count[count >= _TILE_LEAST])) * sample.n_represented
    kept = members[crowded]
    whole = Thickness(
        sigma_m=median_deviation(deviation_m, 0.0),
        width_95_m=float(high_m - low_m),
        scan_step_m=_TILE_M / float(np.sqrt(density)),
    )
    return _by_class(whole, points_m[crowded], normal, deviation_m, kept, seen)


def _from_means(
    distance_m: NDArray[np.float64], mean_m: NDArray[np.float64], count: NDArray[np.int64]
) -> NDArray[np.float64]:
    """(m,) deviations of distances from the mean of the so many that are near."""
    # A mean of n follows its own points: deviations from it are too small by this.
    return (distance_m - mean_m) / np.sqrt(1.0 - 1.0 / count)


def _by_class(
    whole: Thickness,
    points_m: NDArray[np.float64],
    normal: NDArray[np.float64],
    deviation_m: NDArray[np.float64],
    members: NDArray[np.int64],
    seen: _Seen,
) -> Thickness:
    """Add to a thickness what is known of it by class."""
    cloud = seen.cloud
    in_cloud = seen.prepared.sample.index[members]
    stations_m = _stations_of(in_cloud, cloud)
    if stations_m is not None:
        rays_m = points_m - stations_m
        range_m = np.linalg.norm(rays_m, axis=1)
        cosine = np.abs(rays_m @ normal) / np.maximum(range_m, 1e-9)
        incidence_deg = np.degrees(np.arccos(np.clip(cosine, 0.0, 1.0)))
        whole = replace(
            whole,
            incidence_deg=_spreads(incidence_deg, np.array(_INCIDENCE_DEG), deviation_m),
            range_m=_spreads(range_m, _even_edges(range_m), deviation_m),
        )
    if cloud.intensity is not None:
        intensity = cloud.intensity[in_cloud].astype(np.float64)
        known = np.isfinite(intensity)
        intensity, of_known_m = intensity[known], deviation_m[known]
        if len(intensity):
            whole = replace(
                whole,
                intensity=_spreads(intensity, _even_edges(intensity), of_known_m),
                material=_by_material(intensity, seen.materials, of_known_m),
            )
    return whole


def _by_material(
    intensity: NDArray[np.float64], materials: Materials, deviation_m: NDArray[np.float64]
) -> tuple[Spread, ...]:
    """Spread of the points of each material; those with too few points are left out."""
    found = []
    for name, (low, high) in materials.items():
        inside = (intensity >= low) & (intensity <= high)
        if inside.sum() >= _SPREAD_LEAST:
            found.append(
                Spread(
                    low=low,
                    high=high,
                    n_points=int(inside.sum()),
                    sigma_m=median_deviation(deviation_m[inside], 0.0),
                    name=name,
                )
            )
    return tuple(found)


def _stations_of(index: NDArray[np.int64], cloud: PointCloud) -> NDArray[np.float64] | None:
    """(m, 3) or (3,) offset of the station that saw each point, None where that is not known."""
    stations = cloud.stations
    if stations is None or len(stations) == 0 or cloud.stations_source == "view_from":
        return None
    if len(stations) == 1:
        only: NDArray[np.float64] = stations[0] - cloud.origin
        return only
    if cloud.scan is None or not len(index) or int(cloud.scan[index].max()) >= len(stations):
        return None
    return stations[cloud.scan[index]] - cloud.origin


def _even_edges(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Edges of classes with equally many points."""
    return np.unique(np.quantile(values, np.linspace(0.0, 1.0, _CLASSES + 1)))


def _spreads(
    values: NDArray[np.float64], edges: NDArray[np.float64], deviation_m: NDArray[np.float64]
) -> tuple[Spread, ...]:
    if len(edges) < 2:
        return ()
    place = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
    found = []
    for k in range(len(edges) - 1):
        inside = place == k
        if inside.sum() >= _SPREAD_LEAST:
            found.append(
                Spread(
                    low=float(edges[k]),
                    high=float(edges[k + 1]),
                    n_points=int(inside.sum()),
                    sigma_m=median_deviation(deviation_m[inside], 0.0),
                )
            )
    return tuple(found)
