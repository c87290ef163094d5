"""The surface of a wall: one depth per cell, and what the points on it measured."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import raster_kernels as kernels
from orthoflow.geometry.raster_kernels import NO_POINT
from orthoflow.geometry.rastering import (
    empty_winners,
    entries_inside,
    in_parts,
    share_cells,
    spread_m,
)
from orthoflow.geometry.slabs import Slab
from orthoflow.products import PointCloud
from orthoflow_plugins.raster.rules import SurfaceRule


@dataclass(frozen=True, kw_only=True)
class CellSurface:
    """The surface over one wall, all arrays flat over its cells.

    Attributes:
        depth_m: float32, NaN where void.
        sigma_m: float32, NaN with fewer than two points.
        count: uint32.
        intensity: float32, NaN where void, or None.
        rgb: (cells, 3) uint8, 0 where void, or None.
    """

    depth_m: NDArray[np.float32]
    sigma_m: NDArray[np.float32]
    count: NDArray[np.uint32]
    intensity: NDArray[np.float32] | None
    rgb: NDArray[np.uint8] | None


def surface_of(cloud: PointCloud, slab: Slab, rule: SurfaceRule) -> CellSurface:
    """Lay a cloud into the raster of a wall."""
    if rule.surface in {"nearest", "topmost"}:
        return _surface_of_winners(cloud, slab, rule)
    return _surface_of_all(cloud, slab, rule)


def _surface_of_winners(cloud: PointCloud, slab: Slab, rule: SurfaceRule) -> CellSurface:
    """One pass: the winning point gives depth, intensity and colour."""
    winners, moments = empty_winners(slab.n_cells), np.zeros((slab.n_cells, 2))
    keep = kernels.keep_topmost if rule.surface == "topmost" else kernels.keep_nearest
    for entries in entries_inside(cloud, slab, threads=rule.threads):
        share_cells(
            rule.threads,
            partial(keep, entries, winners),
            partial(kernels.add_moments, entries, moments),
        )
    sigma_m = spread_m(winners["n_points"], moments)
    has_point = winners["point"] != NO_POINT
    points = winners["point"][has_point]
    return CellSurface(
        depth_m=np.where(has_point, winners["depth_m"], np.float32(np.nan)),
        sigma_m=sigma_m,
        count=winners["n_points"].copy(),
        intensity=_gathered_intensity(cloud, points, has_point),
        rgb=_gathered_rgb(cloud, points, has_point),
    )


def _gathered_intensity(
    cloud: PointCloud, points: NDArray[np.uint32], has_point: NDArray[np.bool_]
) -> NDArray[np.float32] | None:
    if cloud.intensity is None:
        return None
    intensity = np.full(has_point.size, np.nan, dtype=np.float32)
    intensity[has_point] = cloud.intensity[points]
    return intensity


def _gathered_rgb(
    cloud: PointCloud, points: NDArray[np.uint32], has_point: NDArray[np.bool_]
) -> NDArray[np.uint8] | None:
    if cloud.rgb is None:
        return None
    rgb = np.zeros((has_point.size, 3), dtype=np.uint8)
    rgb[has_point] = cloud.rgb[points]
    return rgb


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
    if rule.surface == "median":
        layer_m = rule.layer_m
        depth_m = _medians_m(cloud, slab, count, rule)
    intensity, rgb = _averaged_values(cloud, slab, depth_m, layer_m=layer_m, threads=rule.threads)
    return CellSurface(
        depth_m=depth_m,
        sigma_m=sigma_m,
        count=count,
        intensity=intensity,
        rgb=rgb,
    )


def _medians_m(
    cloud: PointCloud, slab: Slab, count: NDArray[np.uint32], rule: SurfaceRule
) -> NDArray[np.float32]:
    ends = np.cumsum(count, dtype=np.int64)
    cursors = ends - count
    sorted_m = np.empty(int(ends[-1]), dtype=np.float32)
    for entries in entries_inside(cloud, slab, threads=rule.threads):
        share_cells(rule.threads, partial(kernels.sort_into_cells, entries, cursors, sorted_m))
    medians_m = np.empty(slab.n_cells, dtype=np.float32)
    in_parts(
        slab.n_cells,
        rule.threads,
        partial(kernels.median_depths, ends, sorted_m, rule.layer_m, medians_m),
    )
    return medians_m


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
        with np.errstate(invalid="ignore"):
            means = sum_of_values[:, :-1] / sum_of_values[:, -1:]
        if means.shape[1] == 1:
            intensity = means[:, 0].astype(np.float32)
        else:
            rgb = np.rint(np.nan_to_num(means)).astype(np.uint8)
    return intensity, rgb


def _channels(cloud: PointCloud) -> list[NDArray[np.generic]]:
    channels: list[NDArray[np.generic]] = []
    if cloud.intensity is not None:
        channels.append(np.asarray(cloud.intensity)[:, np.newaxis])
    if cloud.rgb is not None:
        channels.append(np.asarray(cloud.rgb))
    return channels
