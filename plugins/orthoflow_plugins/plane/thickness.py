"""Thickness of the cloud on each plane, and along a row of a scan.

Thickness is the noise of the scanner on the wall; markiewicz2015 recommends inspecting it first
(3.1, Figure 3). Relief and bow are not part of the thickness, so distances are measured from the
mean of a small tile of the wall. Thickness is measured on the sample and also along a scan row of
the whole cloud. The scatter along a row contains only the noise of single distances, because other
rows and stations do not contribute to it. It is reported for each material along the row.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import wall_axes
from orthoflow.geometry.robust import median_deviation
from orthoflow.products import Planes, PointCloud, ScanRow, Spread, Thickness
from orthoflow.sdk import StepContext
from orthoflow_plugins.plane.cloud import PreparedCloud
from orthoflow_plugins.plane.proposing import Materials

# Side of the tiles of a wall, and length of the pieces of a scan row. Distances are measured from
# the mean of a tile or piece.
_TILE_M: Final = 0.1
_TILE_LEAST: Final = 4
# Minimum number of points for a standard deviation.
_SPREAD_LEAST: Final = 50
_INCIDENCE_DEG: Final = tuple(float(edge) for edge in range(0, 91, 10))
# Number of classes of range, which have equal numbers of points.
_CLASSES: Final = 6
# Share of the distances that are outside the reported width on each side.
_TAIL: Final = 0.025
# Minimum number of points of a scan row on a plane.
_ROW_LEAST: Final = 20


@dataclass(frozen=True, kw_only=True)
class RowPoints:
    """The points of a row of a scan that are on the first plane.

    Attributes:
        row: index of the row.
        scan: index of the scan.
        along_m: (n,) position along the plane, to the viewer's right, in metres; ascending.
        distance_m: (n,) distance from the plane in metres, positive towards the viewer.
        intensity: (n,) intensity, 0 to 1; None if the cloud has no intensity.
    """

    row: int
    scan: int
    along_m: NDArray[np.float64]
    distance_m: NDArray[np.float64]
    intensity: NDArray[np.float64] | None

    def measured(self, materials: Materials) -> ScanRow:
        """Return the thickness of the row, in total and for each material."""
        piece = np.floor((self.along_m - self.along_m[0]) / _TILE_M).astype(np.int64)
        crowded, deviation_m, _ = _from_tiles(self.distance_m, piece, np.bincount(piece))
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


def measure_thickness(
    planes: Planes,
    plane_of_sample: NDArray[np.int64],
    prepared: PreparedCloud,
    cloud: PointCloud,
    materials: Materials,
) -> tuple[Thickness | None, ...]:
    """Measure the thickness of each plane; None for a plane with too few points.

    Args:
        planes: the planes, in world coordinates.
        plane_of_sample: (s,) plane of each sample point; -1 for points on no plane.
        prepared: the prepared cloud with its sample.
        cloud: the cloud.
        materials: lowest and highest intensity of each material.
    """
    sample, found = prepared.sample, list[Thickness | None]()
    for k, normal in enumerate(planes.normal):
        members = np.flatnonzero(plane_of_sample == k)
        offset_m = planes.offset[k] - float(normal @ cloud.origin)
        distance_m = sample.offsets_m[members] @ normal - offset_m
        # Ignore points farther from the plane, which are on relief or other surfaces.
        near = np.abs(distance_m) <= prepared.fit_tolerance_m
        members, distance_m = members[near], distance_m[near]
        axes = wall_axes(normal, planes.up)
        placed = np.floor(sample.offsets_m[members] @ axes.T / _TILE_M).astype(np.int64)
        # Use a single number per tile, because sorting pairs takes many times as long.
        keys = placed[:, 0] * 2**31 + placed[:, 1]
        _, tile, count = np.unique(keys, return_inverse=True, return_counts=True)
        crowded, deviation_m, usual = _from_tiles(distance_m, tile, count)
        if crowded.sum() < _SPREAD_LEAST:
            found.append(None)
            continue
        low_m, high_m = np.quantile(deviation_m, (_TAIL, 1.0 - _TAIL))
        kept = members[crowded]
        incidence, ranges, material = (tuple[Spread, ...](),) * 3
        stations_m = _stations_of(sample.index[kept], cloud)
        if stations_m is not None:
            rays_m = sample.offsets_m[kept] - stations_m
            range_m = np.linalg.norm(rays_m, axis=1)
            cosine = np.abs(rays_m @ normal) / np.maximum(range_m, 1e-9)
            incidence_deg = np.degrees(np.arccos(np.clip(cosine, 0.0, 1.0)))
            incidence = _spreads(incidence_deg, np.array(_INCIDENCE_DEG), deviation_m)
            edges_m = np.quantile(range_m, np.linspace(0.0, 1.0, _CLASSES + 1))
            ranges = _spreads(range_m, np.unique(edges_m), deviation_m)
        if cloud.intensity is not None:
            intensity = cloud.intensity[sample.index[kept]].astype(np.float64)
            material = _by_material(intensity, materials, deviation_m)
        found.append(
            Thickness(
                sigma_m=median_deviation(deviation_m, 0.0),
                width_95_m=float(high_m - low_m),
                scan_step_m=_TILE_M / float(np.sqrt(usual * sample.n_represented)),
                incidence_deg=incidence,
                range_m=ranges,
                material=material,
            )
        )
    return tuple(found)


def row_points(
    planes: Planes, plane_of_sample: NDArray[np.int64], prepared: PreparedCloud, cloud: PointCloud
) -> RowPoints | None:
    """Return the scan row with the most points on the first plane; None without rows or points."""
    members = prepared.sample.index[plane_of_sample == 0]
    if cloud.row is None or not len(members):
        return None
    scans = np.zeros(len(members), dtype=np.int64) if cloud.scan is None else cloud.scan[members]
    keys = scans.astype(np.int64) * 2**32 + cloud.row[members]
    names, counts = np.unique(keys, return_counts=True)
    scan, row = divmod(int(names[np.argmax(counts)]), 2**32)
    chosen = np.flatnonzero(cloud.row == row)
    if cloud.scan is not None:
        chosen = chosen[cloud.scan[chosen] == scan]
    claim = prepared.sample_claims[plane_of_sample == 0][0]
    chosen = chosen[prepared.claims[chosen] == claim]
    if len(chosen) < _ROW_LEAST:
        return None
    points = np.column_stack([cloud.x[chosen], cloud.y[chosen], cloud.z[chosen]]).astype(np.float64)
    normal = planes.normal[0]
    along_m = points @ wall_axes(normal, planes.up)[0]
    order = np.argsort(along_m, kind="stable")
    distance_m = points @ normal - (planes.offset[0] - float(normal @ cloud.origin))
    intensity = None
    if cloud.intensity is not None:
        intensity = np.nan_to_num(cloud.intensity[chosen].astype(np.float64))[order]
    return RowPoints(
        row=row,
        scan=scan,
        along_m=along_m[order],
        distance_m=distance_m[order],
        intensity=intensity,
    )


def report_thickness(ctx: StepContext, found: tuple[Thickness | None, ...]) -> None:
    """Report the thickness and point spacing on the first plane, and the largest thickness."""
    known = [item for item in found if item is not None]
    if known:
        ctx.metric("thickest_mm", 1000.0 * max(item.sigma_m for item in known), "mm")
    first = found[0]
    if first is not None:
        ctx.metric("thickness_mm", 1000.0 * first.sigma_m, "mm")
        ctx.metric("thickness_width_mm", 1000.0 * first.width_95_m, "mm")
        ctx.metric("scan_step_mm", 1000.0 * first.scan_step_m, "mm")
        ctx.metric("thickness_scan_steps", first.sigma_m / first.scan_step_m, "1")


def _from_tiles(
    distance_m: NDArray[np.float64], tile: NDArray[np.int64], count: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], NDArray[np.float64], float]:
    """Return the deviations of distances from the means of their tiles.

    Args:
        distance_m: (m,) distances.
        tile: (m,) index of the tile of each distance.
        count: (t,) number of points in each tile.

    Returns:
        A mask (m,) of the distances in tiles with enough points, the deviations of these distances,
        and the median number of points in these tiles.
    """
    mean_m = np.bincount(tile, distance_m) / np.maximum(count, 1)
    crowded = count[tile] >= _TILE_LEAST
    tile = tile[crowded]
    # Deviations from the mean of n values are too small, by the factor sqrt(1 - 1 / n).
    deviation_m = (distance_m[crowded] - mean_m[tile]) / np.sqrt(1.0 - 1.0 / count[tile])
    usual = float(np.median(count[count >= _TILE_LEAST])) if len(tile) else 0.0
    return crowded, deviation_m, usual


def _stations_of(index: NDArray[np.int64], cloud: PointCloud) -> NDArray[np.float64] | None:
    """Return the offsets of points' stations, (m, 3), or (3,) for a single one; None if unknown."""
    stations = cloud.stations
    if stations is None or len(stations) == 0 or cloud.stations_source == "view_from":
        return None
    if len(stations) == 1:
        return np.asarray(stations[0] - cloud.origin)
    if cloud.scan is None or not len(index) or int(cloud.scan[index].max()) >= len(stations):
        return None
    return stations[cloud.scan[index]] - cloud.origin


def _spreads(
    values: NDArray[np.float64], edges: NDArray[np.float64], deviation_m: NDArray[np.float64]
) -> tuple[Spread, ...]:
    place = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
    found = (
        _spread(None, float(edges[k]), float(edges[k + 1]), deviation_m[place == k])
        for k in range(len(edges) - 1)
    )
    return tuple(one for one in found if one is not None)


def _by_material(
    intensity: NDArray[np.float64], materials: Materials, deviation_m: NDArray[np.float64]
) -> tuple[Spread, ...]:
    found = (
        _spread(name, low, high, deviation_m[(intensity >= low) & (intensity <= high)])
        for name, (low, high) in materials.items()
    )
    return tuple(one for one in found if one is not None)


def _spread(
    name: str | None, low: float, high: float, deviation_m: NDArray[np.float64]
) -> Spread | None:
    if len(deviation_m) < _SPREAD_LEAST:
        return None
    sigma_m = median_deviation(deviation_m, 0.0)
    return Spread(low=low, high=high, n_points=len(deviation_m), sigma_m=sigma_m, name=name)
