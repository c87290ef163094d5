"""How thick the cloud is on each plane: the scanner's noise as the wall shows it.

markiewicz2015 urges to look at this before anything else (3.1, Figure 3). Relief and bow are not
thickness, so distances are taken from the mean of a small tile of the wall. What is measured comes
from the sample that every detector has; the scan row alone is read from the whole cloud.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import wall_axes
from orthoflow.products import JsonValue, Planes, PointCloud
from orthoflow_plugins.plane.remainders import Remainder

_TILE_M: Final = 0.1
_TILE_LEAST: Final = 4
# Fewer points do not show a spread.
_POINTS_LEAST: Final = 50
_INCIDENCE_DEG: Final = tuple(float(edge) for edge in range(0, 91, 10))
_CLASSES: Final = 6
# Half the share of a normal distribution that lies outside the width reported.
_TAIL: Final = 0.025


# Lowest and highest intensity of each material.
Materials = Mapping[str, tuple[float, float]]


@dataclass(frozen=True, kw_only=True)
class Spread:
    """Thickness of the points of one class.

    Attributes:
        low: smallest value of the class, in its unit.
        high: largest value of the class.
        n_points: points that were measured.
        sigma_m: robust standard deviation.
        name: of the class, where it has one.
    """

    low: float
    high: float
    n_points: int
    sigma_m: float
    name: str | None = None

    def to_json(self) -> dict[str, JsonValue]:
        """Numbers for the planes' details."""
        named: dict[str, JsonValue] = {} if self.name is None else {"name": self.name}
        return {
            **named,
            "low": self.low,
            "high": self.high,
            "n_points": self.n_points,
            "sigma_m": self.sigma_m,
        }


@dataclass(frozen=True, kw_only=True)
class Thickness:
    """Thickness of the cloud on one plane.

    Attributes:
        sigma_m: robust standard deviation of the distances from the tile's mean.
        width_m: width that holds 95 % of them.
        scan_step_m: distance between neighbouring points on the plane, median over tiles.
        over: spreads by class of `incidence_deg`, `range_m` (where stations are known) and
            `intensity` (which tells materials apart, where the cloud has it), and by `material`
            where those were named.
    """

    sigma_m: float
    width_m: float
    scan_step_m: float
    over: dict[str, tuple[Spread, ...]]

    def to_json(self) -> JsonValue:
        """Numbers for the planes' details."""
        return {
            "sigma_m": self.sigma_m,
            "width_95_m": self.width_m,
            "scan_step_m": self.scan_step_m,
            **{name: [item.to_json() for item in spreads] for name, spreads in self.over.items()},
        }


@dataclass(frozen=True, kw_only=True)
class _Seen:
    """What thickness is measured on."""

    whole: Remainder
    cloud: PointCloud
    materials: Materials


def measure_thickness(
    planes: Planes,
    plane_of_sample: NDArray[np.int64],
    whole: Remainder,
    cloud: PointCloud,
    *,
    reach_m: float,
    materials: Materials,
) -> tuple[Thickness | None, ...]:
    """Measure the thickness of each plane; None where too few points are on it.

    Args:
        planes: the planes, world.
        plane_of_sample: (s,) plane of each point of the sample, -1 for none.
        whole: the cloud and its sample.
        cloud: the cloud.
        reach_m: points further than this from their plane are relief or belong to something else.
        materials: lowest and highest intensity of each material.
    """
    seen = _Seen(whole=whole, cloud=cloud, materials=materials)
    found: list[Thickness | None] = []
    for k in range(len(planes)):
        members = np.flatnonzero(plane_of_sample == k)
        offset_m = planes.offset[k] - float(planes.normal[k] @ cloud.origin)
        distance_m = whole.sample.offsets_m[members] @ planes.normal[k] - offset_m
        near = np.abs(distance_m) <= reach_m
        found.append(_measured(planes, k, members[near], distance_m[near], seen))
    return tuple(found)


def _measured(
    planes: Planes,
    index: int,
    members: NDArray[np.int64],
    distance_m: NDArray[np.float64],
    seen: _Seen,
) -> Thickness | None:
    sample = seen.whole.sample
    points_m = sample.offsets_m[members]
    normal = planes.normal[index]
    placed = np.floor(points_m @ wall_axes(normal, planes.up).T / _TILE_M).astype(np.int64)
    # One number per tile, since rows of two take many times as long to sort.
    keys = placed[:, 0] * 2**31 + placed[:, 1]
    _, tile, count = np.unique(keys, return_inverse=True, return_counts=True)
    mean_m = np.bincount(tile, distance_m) / count
    crowded = count[tile] >= _TILE_LEAST
    if crowded.sum() < _POINTS_LEAST:
        return None
    # A mean of n follows its own points: deviations from it are too small by this.
    tile = tile[crowded]
    deviation_m = (distance_m[crowded] - mean_m[tile]) / np.sqrt(1.0 - 1.0 / count[tile])
    low_m, high_m = np.quantile(deviation_m, (_TAIL, 1.0 - _TAIL))
    density = float(np.median(count[count >= _TILE_LEAST])) * sample.n_represented
    kept = members[crowded]
    return Thickness(
        sigma_m=robust_sigma(deviation_m),
        width_m=float(high_m - low_m),
        scan_step_m=_TILE_M / float(np.sqrt(density)),
        over=_by_class(points_m[crowded], normal, deviation_m, kept, seen),
    )


def _by_class(
    points_m: NDArray[np.float64],
    normal: NDArray[np.float64],
    deviation_m: NDArray[np.float64],
    members: NDArray[np.int64],
    seen: _Seen,
) -> dict[str, tuple[Spread, ...]]:
    cloud = seen.cloud
    in_cloud = seen.whole.sample.index[members]
    over = {}
    stations_m = _stations_of(in_cloud, cloud)
    if stations_m is not None:
        rays_m = points_m - stations_m
        range_m = np.linalg.norm(rays_m, axis=1)
        cosine = np.abs(rays_m @ normal) / np.maximum(range_m, 1e-9)
        incidence_deg = np.degrees(np.arccos(np.clip(cosine, 0.0, 1.0)))
        over["incidence_deg"] = _spreads(incidence_deg, np.array(_INCIDENCE_DEG), deviation_m)
        over["range_m"] = _spreads(range_m, _even_edges(range_m), deviation_m)
    if cloud.intensity is not None:
        intensity = cloud.intensity[in_cloud].astype(np.float64)
        over["intensity"] = _spreads(intensity, _even_edges(intensity), deviation_m)
        if seen.materials:
            over["material"] = spreads_by_material(intensity, seen.materials, deviation_m)
    return over


def spreads_by_material(
    intensity: NDArray[np.float64], materials: Materials, deviation_m: NDArray[np.float64]
) -> tuple[Spread, ...]:
    """Spread of the points of each material; those with too few points are left out."""
    found = []
    for name, (low, high) in materials.items():
        inside = (intensity >= low) & (intensity <= high)
        if inside.sum() >= _POINTS_LEAST:
            found.append(
                Spread(
                    low=low,
                    high=high,
                    n_points=int(inside.sum()),
                    sigma_m=robust_sigma(deviation_m[inside]),
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
    seen_from: NDArray[np.float64] = stations[cloud.scan[index]] - cloud.origin
    return seen_from


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
        if inside.sum() >= _POINTS_LEAST:
            found.append(
                Spread(
                    low=float(edges[k]),
                    high=float(edges[k + 1]),
                    n_points=int(inside.sum()),
                    sigma_m=robust_sigma(deviation_m[inside]),
                )
            )
    return tuple(found)


def robust_sigma(deviation_m: NDArray[np.float64]) -> float:
    """Standard deviation of a normal distribution with the same median deviation."""
    return 1.4826 * float(np.median(np.abs(deviation_m)))
