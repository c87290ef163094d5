"""The surface of a wall: one depth per cell, and what the points on it measured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import raster_kernels as kernels
from orthoflow.geometry.point_kernels import read_only
from orthoflow.geometry.raster_entry_kernels import Entries
from orthoflow.geometry.rastering import (
    empty_winners,
    entries_inside,
    in_parts,
    share_cells,
    spread_m,
    values_of_winners,
    wall_from_offset,
)
from orthoflow.geometry.slabs import Slab
from orthoflow.products import PointCloud
from orthoflow_plugins.raster.denoising import denoised
from orthoflow_plugins.raster.rules import SurfaceRule
from orthoflow_plugins.raster.specks import without_specks

# What is made of cells for a moment is made of so many.
CELLS_AT_ONCE: Final = 1 << 20


@dataclass(frozen=True, kw_only=True)
class CellSurface:
    """The surface over one wall, all arrays flat over its cells.

    Attributes:
        depth_m: float32, NaN where void.
        sigma_m: float32, NaN with fewer than two points.
        count: uint32.
        intensity: float32, NaN where void, or None.
        rgb: (cells, 3) uint8, 0 where void, or None.
        percentiles_m: (cells, k) float32, NaN in cells without points, or None.
    """

    depth_m: NDArray[np.float32]
    sigma_m: NDArray[np.float32]
    count: NDArray[np.uint32]
    intensity: NDArray[np.float32] | None
    rgb: NDArray[np.uint8] | None
    percentiles_m: NDArray[np.float32] | None = None


def surface_of(cloud: PointCloud, slab: Slab, rule: SurfaceRule) -> CellSurface:
    """Lay a cloud into the raster of a wall."""
    if rule.surface in {"nearest", "centre", "topmost", "tin"}:
        surface = _surface_of_winners(cloud, slab, rule)
    else:
        surface = _surface_of_all(cloud, slab, rule)
    if not rule.percentiles:
        return surface
    return replace(surface, percentiles_m=_percentiles_m(cloud, slab, surface.count, rule))


def _surface_of_winners(cloud: PointCloud, slab: Slab, rule: SurfaceRule) -> CellSurface:
    """One pass: the winning point gives depth, intensity and colour."""
    winners = empty_winners(slab.n_cells, threads=rule.threads)
    moments = np.zeros((slab.n_cells, 2))
    for entries in entries_inside(cloud, slab, threads=rule.threads):
        share_cells(
            rule.threads,
            _contest(cloud, slab, rule, entries, winners),
            partial(kernels.add_moments, entries, moments),
        )
    taken = partial(values_of_winners, winners, threads=rule.threads)
    intensity, rgb = cloud.intensity, cloud.rgb
    # A nearest neighbour may lie in the next cell; a cell without a point of its own stays void.
    has_point = winners["n_points"] > 0
    surface = CellSurface(
        depth_m=np.where(has_point, winners["depth_m"], np.float32(np.nan)),
        sigma_m=spread_m(winners["n_points"], moments),
        count=winners["n_points"].copy(),
        intensity=None if intensity is None else taken(intensity[:, np.newaxis], np.nan)[:, 0],
        rgb=None if rgb is None else taken(rgb, 0),
    )
    points = winners["point"][has_point]
    return _triangulated(cloud, slab, points, surface) if rule.surface == "tin" else surface


def _contest(
    cloud: PointCloud, slab: Slab, rule: SurfaceRule, entries: Entries, winners: NDArray[np.void]
) -> Callable[[int, int], None]:
    if rule.surface == "topmost":
        return partial(kernels.keep_topmost, entries, winners)
    if rule.surface == "nearest":
        return partial(
            kernels.keep_nearest_around,
            entries,
            read_only(cloud.x, cloud.y, cloud.z),
            wall_from_offset(slab.frame, cloud.origin),
            winners,
            slab.frame.width,
        )
    return partial(kernels.keep_nearest, entries, winners)


def _triangulated(
    cloud: PointCloud, slab: Slab, points: NDArray[np.uint32], surface: CellSurface
) -> CellSurface:
    """Replace a surface by the net through the points nearest to the centres of their cells."""
    from orthoflow_plugins.raster.triangulating import interpolated

    offsets = np.stack([values[points] for values in (cloud.x, cloud.y, cloud.z)])
    matrix = wall_from_offset(slab.frame, cloud.origin)
    places = (matrix[:2, :3] @ offsets.astype(np.float64)).T + matrix[:2, 3]
    measured = np.flatnonzero(surface.count)
    channels: list[NDArray[np.generic]] = [surface.depth_m[measured, np.newaxis]]
    if surface.intensity is not None:
        channels.append(surface.intensity[measured, np.newaxis])
    if surface.rgb is not None:
        channels.append(surface.rgb[measured])
    found = interpolated(places, channels, slab.frame.shape)
    return replace(
        surface,
        depth_m=np.ascontiguousarray(found[0][:, 0]),
        intensity=None if surface.intensity is None else np.ascontiguousarray(found[1][:, 0]),
        rgb=None if surface.rgb is None else np.rint(np.nan_to_num(found[-1])).astype(np.uint8),
    )


def _surface_of_all(cloud: PointCloud, slab: Slab, rule: SurfaceRule) -> CellSurface:
    """Two or three passes: count, sort if a median is wanted, average what lies on the surface."""
    count, moments = np.zeros(slab.n_cells, dtype=np.uint32), np.zeros((slab.n_cells, 2))
    for entries in entries_inside(cloud, slab, threads=rule.threads):
        share_cells(
            rule.threads,
            partial(kernels.count_points, entries, count),
            partial(kernels.add_moments, entries, moments),
        )
    with np.errstate(invalid="ignore"):
        depth_m, layer_m = (moments[:, 0] / count).astype(np.float32), np.inf
    sigma_m = spread_m(count, moments)
    del moments  # A third of what is held here, and what follows takes more.
    if rule.surface != "mean":
        layer_m = rule.layer_m
        raster_m = without_specks(
            _medians_m(cloud, slab, count, rule).reshape(slab.frame.shape),
            gsd_m=slab.frame.gsd_m,
            layer_m=layer_m,
            threads=rule.threads,
        )
        if rule.surface == "denoised":
            raster_m = denoised(raster_m, rule.denoise_cells)
        depth_m = raster_m.ravel()
    intensity, rgb = _averaged_values(cloud, slab, depth_m, layer_m=layer_m, threads=rule.threads)
    return CellSurface(
        depth_m=depth_m,
        sigma_m=sigma_m,
        count=count,
        intensity=intensity,
        rgb=rgb,
    )


def _grouped_m(
    cloud: PointCloud, slab: Slab, count: NDArray[np.uint32], *, threads: int
) -> NDArray[np.float32]:
    """The depths of all points inside, those of a cell beside each other, cell after cell."""
    ends = np.cumsum(count, dtype=np.int64)
    cursors = ends - count
    grouped_m = np.empty(int(ends[-1]), dtype=np.float32)
    for entries in entries_inside(cloud, slab, threads=threads):
        share_cells(threads, partial(kernels.sort_into_cells, entries, cursors, grouped_m))
    return grouped_m


def _medians_m(
    cloud: PointCloud, slab: Slab, count: NDArray[np.uint32], rule: SurfaceRule
) -> NDArray[np.float32]:
    grouped_m = _grouped_m(cloud, slab, count, threads=rule.threads)
    return _sorted_medians_m(grouped_m, count, rule)


def _sorted_medians_m(
    grouped_m: NDArray[np.float32], count: NDArray[np.uint32], rule: SurfaceRule
) -> NDArray[np.float32]:
    """Medians of the cells' best supported layers; sorts the depths of each cell in place."""
    medians_m = np.empty(count.size, dtype=np.float32)
    ends = np.cumsum(count, dtype=np.int64)
    task = partial(kernels.median_depths, ends, grouped_m, rule.layer_m, medians_m)
    in_parts(count.size, rule.threads, task)
    return medians_m


def _percentiles_m(
    cloud: PointCloud, slab: Slab, count: NDArray[np.uint32], rule: SurfaceRule
) -> NDArray[np.float32]:
    """Percentiles (cells, k) of all points of a cell, linear between two of them as numpy's."""
    grouped_m = _grouped_m(cloud, slab, count, threads=rule.threads)
    _sorted_medians_m(grouped_m, count, rule)
    measured = np.flatnonzero(count)
    n_points = count[measured].astype(np.int64)
    first = (np.cumsum(count, dtype=np.int64) - count)[measured]
    percentiles_m = np.full((count.size, len(rule.percentiles)), np.nan, dtype=np.float32)
    for k, percent in enumerate(rule.percentiles):
        place = (n_points - 1) * (percent / 100.0)
        lower = np.floor(place).astype(np.int64)
        upper = np.minimum(lower + 1, n_points - 1)
        share = place - lower
        low_m, high_m = grouped_m[first + lower], grouped_m[first + upper]
        percentiles_m[measured, k] = low_m + share * (high_m - low_m)
    return percentiles_m


def _averaged_values(
    cloud: PointCloud, slab: Slab, depth_m: NDArray[np.float32], *, layer_m: float, threads: int
) -> tuple[NDArray[np.float32] | None, NDArray[np.uint8] | None]:
    channels = _channels(cloud)
    # Whole numbers for colours: half the memory, and exact.
    sums = [
        np.zeros(
            (slab.n_cells, values.shape[1] + 1),
            dtype=np.uint32 if values.dtype == np.uint8 else np.float64,
        )
        for values in channels
    ]
    if channels:
        for entries in entries_inside(cloud, slab, threads=threads):
            passes = [
                partial(kernels.add_values, entries, values, depth_m, layer_m, sum_of_values)
                for values, sum_of_values in zip(channels, sums, strict=True)
            ]
            share_cells(threads, *passes)
    intensity: NDArray[np.float32] | None = None
    rgb: NDArray[np.uint8] | None = None
    for sum_of_values in sums:
        if sum_of_values.shape[1] == 2:
            intensity = np.empty(slab.n_cells, dtype=np.float32)
        else:
            rgb = np.empty((slab.n_cells, 3), dtype=np.uint8)
        # Means take several times the memory of what is kept of them.
        for first in range(0, slab.n_cells, CELLS_AT_ONCE):
            part = slice(first, first + CELLS_AT_ONCE)
            with np.errstate(invalid="ignore"):
                means = sum_of_values[part, :-1] / sum_of_values[part, -1:]
            if intensity is not None and means.shape[1] == 1:
                intensity[part] = means[:, 0]
            elif rgb is not None:
                rgb[part] = np.rint(np.nan_to_num(means))
    return intensity, rgb


def _channels(cloud: PointCloud) -> list[NDArray[np.generic]]:
    channels: list[NDArray[np.generic]] = []
    if cloud.intensity is not None:
        channels.append(np.asarray(cloud.intensity)[:, np.newaxis])
    if cloud.rgb is not None:
        channels.append(np.asarray(cloud.rgb))
    return channels
