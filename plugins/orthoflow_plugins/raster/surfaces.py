"""The surface of a wall: one depth per cell, and the measurements of its points."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.interpolation import Surroundings, cell_values, interpolate
from orthoflow.geometry.point_kernels import read_only
from orthoflow.geometry.raster_kernels import Entries, keep_nearest, keep_topmost
from orthoflow.geometry.rastering import (
    empty_winners,
    entries_inside,
    places_of_winners,
    share_cells,
    values_of_winners,
    wall_from_offset,
)
from orthoflow.geometry.slabs import Slab
from orthoflow.geometry.threads import in_parts
from orthoflow.products import PointCloud
from orthoflow_plugins.raster import surface_kernels as kernels
from orthoflow_plugins.raster.depth_filters import denoised, without_specks
from orthoflow_plugins.raster.nets import NO_POINT, Net, Vertices, interpolate_net
from orthoflow_plugins.raster.rules import SurfaceRule

# Temporary arrays are limited to this many cells.
CELLS_AT_ONCE: Final = 1 << 20
# Number of depths sorted at once: 256 MB.
_POINTS_AT_ONCE: Final = 1 << 26


@dataclass(frozen=True, kw_only=True)
class CellSurface:
    """The surface over one wall, all arrays flat over its cells.

    Attributes:
        depth_m: float32, NaN where void.
        sigma_m: float32, NaN with fewer than two points.
        count: uint32.
        intensity: float32, NaN where void, or None.
        rgb: (cells, 3) uint8, 0 where void, or None.
        has_rgb: (cells,) which have a colour; None if all with points have.
        percentiles_m: (cells, k) float32, NaN in cells without points, or None.
        places: (cells, 2) float32, position of the points of a cell right of and below its centre,
            in cells; (0, 0) for many points, NaN for none.
    """

    depth_m: NDArray[np.float32]
    sigma_m: NDArray[np.float32]
    count: NDArray[np.uint32]
    intensity: NDArray[np.float32] | None
    rgb: NDArray[np.uint8] | None
    places: NDArray[np.float32]
    percentiles_m: NDArray[np.float32] | None = None
    has_rgb: NDArray[np.bool_] | None = None


def surface_of(
    cloud: PointCloud, slab: Slab, rule: SurfaceRule, net: Net | None = None
) -> CellSurface:
    """Bin a cloud into the raster of a wall.

    Args:
        cloud: the points.
        slab: of the wall, or of a part of it.
        rule: how.
        net: triangulation for the surface tin over these cells, if the slab is a part.
    """
    if rule.is_of_one_point:
        surface = _surface_of_winners(cloud, slab, rule, net)
    else:
        surface = _surface_of_all(cloud, slab, rule)
    if not rule.percentiles:
        return surface
    return replace(surface, percentiles_m=_percentiles_m(cloud, slab, surface.count, rule))


def carried_to_centres(surface: CellSurface, slab: Slab, rule: SurfaceRule) -> CellSurface:
    """Extrapolate intensity and colour of cells with few points from these to the cell's centre.

    Rules that use a single point take its values unchanged.
    """
    if rule.is_of_one_point or (surface.intensity is None and surface.rgb is None):
        return surface
    few = np.flatnonzero(
        (surface.count > 0) & (surface.count <= kernels.FEW_POINTS) & np.isfinite(surface.depth_m)
    )
    intensity = None if surface.intensity is None else surface.intensity.copy()
    rgb = None if surface.rgb is None else surface.rgb.copy()
    interpolate(
        few,
        Surroundings(surface.places, slab.frame.width, rule.layer_m),
        cell_values(surface.depth_m, intensity=surface.intensity, rgb=surface.rgb),
        cell_values(np.empty(0, dtype=np.float32), intensity=intensity, rgb=rgb),
        reach_cells=0.0,
        threads=rule.threads,
    )
    if intensity is not None and surface.intensity is not None:
        # Next to cells without intensity a cell keeps its own.
        is_lost = few[~np.isfinite(intensity[few])]
        intensity[is_lost] = surface.intensity[is_lost]
    if surface.has_rgb is not None:
        rgb = surface.rgb
    return replace(surface, intensity=intensity, rgb=rgb)


def _surface_of_winners(
    cloud: PointCloud, slab: Slab, rule: SurfaceRule, net: Net | None
) -> CellSurface:
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
    # A nearest neighbour may be in the next cell; a cell without a point of its own stays void.
    has_point = winners["n_points"] > 0
    surface = CellSurface(
        depth_m=np.where(has_point, winners["depth_m"], np.float32(np.nan)),
        sigma_m=_spread_m(winners["n_points"], moments),
        count=winners["n_points"].copy(),
        intensity=None if intensity is None else taken(intensity[:, np.newaxis], np.nan)[:, 0],
        rgb=None if rgb is None else taken(rgb, 0),
        has_rgb=None
        if cloud.has_rgb is None
        else taken(cloud.has_rgb.view(np.uint8)[:, np.newaxis], 0)[:, 0] > 0,
        places=places_of_winners(cloud, slab, winners, threads=rule.threads),
    )
    if rule.surface != "tin":
        return surface
    return _spanned(surface, net or interpolate_net(cloud, slab, _vertices(winners, slab)))


def _contest(
    cloud: PointCloud, slab: Slab, rule: SurfaceRule, entries: Entries, winners: NDArray[np.void]
) -> Callable[[int, int], None]:
    if rule.surface == "topmost":
        return partial(keep_topmost, entries, winners)
    if rule.surface == "nearest":
        return partial(
            kernels.keep_nearest_around,
            entries,
            read_only(cloud.x, cloud.y, cloud.z),
            wall_from_offset(slab.frame, cloud.origin),
            winners,
            slab.frame.width,
        )
    return partial(keep_nearest, entries, winners)


def vertices_of(cloud: PointCloud, slab: Slab, rule: SurfaceRule) -> Vertices:
    """Return the points nearest to the centres of their cells, the vertices of the surface tin."""
    winners = empty_winners(slab.n_cells, threads=rule.threads)
    for entries in entries_inside(cloud, slab, threads=rule.threads):
        share_cells(rule.threads, _contest(cloud, slab, rule, entries, winners))
    return _vertices(winners, slab)


def _vertices(winners: NDArray[np.void], slab: Slab) -> Vertices:
    has_point = winners["n_points"] > 0
    return Vertices(
        point=np.where(has_point, winners["point"], NO_POINT).reshape(slab.frame.shape),
        depth_m=winners["depth_m"].reshape(slab.frame.shape),
    )


def _spanned(surface: CellSurface, net: Net) -> CellSurface:
    """Replace the values of points in cells by those of the triangulation at the centres."""
    is_known = np.isfinite(net.depth_m)[:, np.newaxis]
    return replace(
        surface,
        depth_m=net.depth_m,
        intensity=net.intensity,
        rgb=net.rgb,
        places=np.where(is_known, np.float32(0.0), np.float32(np.nan)).repeat(2, 1),
    )


def _surface_of_all(cloud: PointCloud, slab: Slab, rule: SurfaceRule) -> CellSurface:
    """Two or three passes: count, sort for a median, average the points on the surface."""
    count, moments = np.zeros(slab.n_cells, dtype=np.uint32), np.zeros((slab.n_cells, 2))
    for entries in entries_inside(cloud, slab, threads=rule.threads):
        share_cells(
            rule.threads,
            partial(kernels.count_points, entries, count),
            partial(kernels.add_moments, entries, moments),
        )
    with np.errstate(invalid="ignore"):
        depth_m, layer_m = (moments[:, 0] / count).astype(np.float32), np.inf
    sigma_m = _spread_m(count, moments)
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
    few = kernels.FewPoints(
        n_inside=count,
        depths_m=depth_m,
        layer_m=layer_m,
        n_summed=np.zeros(slab.n_cells, dtype=np.uint8),
        places=np.zeros((slab.n_cells, 2), dtype=np.float32),
    )
    intensity, rgb, has_rgb = _averaged_values(cloud, slab, few, threads=rule.threads)
    in_parts(partial(kernels.find_mean_places, few), slab.n_cells, threads=rule.threads)
    return CellSurface(
        depth_m=depth_m,
        sigma_m=sigma_m,
        count=count,
        intensity=intensity,
        rgb=rgb,
        has_rgb=has_rgb,
        places=few.places,
    )


def _spread_m(n_points: NDArray[np.uint32], moments: NDArray[np.float64]) -> NDArray[np.float32]:
    """Sample standard deviation of the depths in each cell.

    Args:
        n_points: (cells,).
        moments: (cells, 2) sums of depths and squared depths; overwritten.

    Returns:
        (cells,) metres, NaN with fewer than two points.
    """
    mean, squares = moments.T
    with np.errstate(divide="ignore", invalid="ignore"):
        np.divide(mean, n_points, out=mean)
        squares -= mean * mean * n_points
        np.maximum(squares, 0.0, out=squares)
        # 1.0, not 1: unsigned, 0 - 1 would be four thousand million points.
        np.divide(squares, n_points - 1.0, out=squares)
        np.sqrt(squares, out=squares)
    squares[n_points < 2] = np.nan
    sigma_m: NDArray[np.float32] = squares.astype(np.float32)
    return sigma_m


@dataclass(frozen=True, kw_only=True)
class _Group:
    """The depths of all points inside some neighbouring cells, cell after cell.

    Attributes:
        cells: the range of cells.
        depths_m: (points,) float32.
        ends: (cells,) where the depths of the next cell begin.
    """

    cells: slice
    depths_m: NDArray[np.float32]
    ends: NDArray[np.int64]


def _grouped(
    cloud: PointCloud, slab: Slab, count: NDArray[np.uint32], *, threads: int
) -> Iterator[_Group]:
    """Yield the depths of all points inside, sorted by cell, some points at a time."""
    width = slab.frame.width
    totals = np.cumsum(count, dtype=np.int64)
    first = n_before = 0
    while first < count.size:
        # At least one cell, however many points it has.
        end = int(np.searchsorted(totals, n_before + _POINTS_AT_ONCE, side="right"))
        end = max(first + 1, end)
        ends = totals[first:end] - n_before
        cursors = ends - count[first:end]
        depths_m = np.empty(int(ends[-1]), dtype=np.float32)
        rows = slice(first // width, -(-end // width))
        for entries in entries_inside(cloud, slab, threads=threads, rows=rows):
            share_cells(
                threads, partial(kernels.sort_into_cells, entries, first, cursors, depths_m)
            )
        yield _Group(cells=slice(first, end), depths_m=depths_m, ends=ends)
        first, n_before = end, int(totals[end - 1])


def _medians_m(
    cloud: PointCloud, slab: Slab, count: NDArray[np.uint32], rule: SurfaceRule
) -> NDArray[np.float32]:
    """Return medians (cells,) of the cells' best supported layers."""
    medians_m = np.empty(count.size, dtype=np.float32)
    for group in _grouped(cloud, slab, count, threads=rule.threads):
        _sort_depths(group, medians_m[group.cells], rule)
    return medians_m


def _sort_depths(group: _Group, medians_m: NDArray[np.float32], rule: SurfaceRule) -> None:
    """Sort the depths of each cell in place, and set the medians of their best layers."""
    task = partial(kernels.median_depths, group.ends, group.depths_m, rule.layer_m, medians_m)
    in_parts(task, medians_m.size, threads=rule.threads)


def _percentiles_m(
    cloud: PointCloud, slab: Slab, count: NDArray[np.uint32], rule: SurfaceRule
) -> NDArray[np.float32]:
    """Return percentiles (cells, k) of all points of a cell, interpolated as by numpy."""
    percentiles_m = np.full((count.size, len(rule.percentiles)), np.nan, dtype=np.float32)
    for group in _grouped(cloud, slab, count, threads=rule.threads):
        into = percentiles_m[group.cells]
        _sort_depths(group, np.empty(len(into), dtype=np.float32), rule)
        for begin in range(0, len(into), CELLS_AT_ONCE):
            part = slice(begin, begin + CELLS_AT_ONCE)
            n_points = count[group.cells][part].astype(np.int64)
            first = group.ends[part] - n_points
            measured = np.flatnonzero(n_points)
            n_points, first = n_points[measured], first[measured]
            for k, percent in enumerate(rule.percentiles):
                place = (n_points - 1) * (percent / 100.0)
                lower = np.floor(place).astype(np.int64)
                upper = np.minimum(lower + 1, n_points - 1)
                share = place - lower
                low_m, high_m = group.depths_m[first + lower], group.depths_m[first + upper]
                into[part][measured, k] = low_m + share * (high_m - low_m)
    return percentiles_m


def _averaged_values(
    cloud: PointCloud,
    slab: Slab,
    few: kernels.FewPoints,
    *,
    threads: int,
) -> tuple[NDArray[np.float32] | None, NDArray[np.uint8] | None, NDArray[np.bool_] | None]:
    channels = _channels(cloud)
    # Integers for colours: half the memory, and exact.
    sums = [
        np.zeros(
            (slab.n_cells, values.shape[1] + 1),
            dtype=np.uint32 if values.dtype == np.uint8 else np.float64,
        )
        for values, _ in channels
    ]
    offsets, matrix = (
        read_only(cloud.x, cloud.y, cloud.z),
        wall_from_offset(slab.frame, cloud.origin),
    )
    for entries in entries_inside(cloud, slab, threads=threads):
        passes = [
            partial(
                kernels.add_values,
                entries,
                values,
                has_value,
                few.depths_m,
                few.layer_m,
                sum_of_values,
            )
            for (values, has_value), sum_of_values in zip(channels, sums, strict=True)
        ]
        passes.append(partial(kernels.add_places, entries, offsets, matrix, few))
        share_cells(threads, *passes)
    intensity: NDArray[np.float32] | None = None
    rgb: NDArray[np.uint8] | None = None
    has_rgb: NDArray[np.bool_] | None = None
    for sum_of_values in sums:
        if sum_of_values.shape[1] == 2:
            intensity = np.empty(slab.n_cells, dtype=np.float32)
        else:
            rgb = np.empty((slab.n_cells, 3), dtype=np.uint8)
            has_rgb = None if cloud.has_rgb is None else sum_of_values[:, -1] > 0
        # Means take several times the memory of the result.
        for first in range(0, slab.n_cells, CELLS_AT_ONCE):
            part = slice(first, first + CELLS_AT_ONCE)
            with np.errstate(invalid="ignore"):
                means = sum_of_values[part, :-1] / sum_of_values[part, -1:]
            if intensity is not None and means.shape[1] == 1:
                intensity[part] = means[:, 0]
            elif rgb is not None:
                rgb[part] = np.rint(np.nan_to_num(means))
    return intensity, rgb, has_rgb


def _channels(cloud: PointCloud) -> list[tuple[NDArray[np.generic], NDArray[np.bool_]]]:
    """Return values of the points, and which have one; empty if all have, or if NaN marks them."""
    channels: list[tuple[NDArray[np.generic], NDArray[np.bool_]]] = []
    of_all = np.empty(0, dtype=np.bool_)
    if cloud.intensity is not None:
        channels.append((np.asarray(cloud.intensity)[:, np.newaxis], of_all))
    if cloud.rgb is not None:
        has_rgb = of_all if cloud.has_rgb is None else np.asarray(cloud.has_rgb)
        channels.append((np.asarray(cloud.rgb), has_rgb))
    return channels
