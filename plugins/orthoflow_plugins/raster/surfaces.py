"""The surface of a wall: one depth per cell, and what the points on it measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import MethodError
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
from orthoflow_plugins.raster.rules import SurfaceRule

# What is made of cells for a moment is made of so many.
CELLS_AT_ONCE: Final = 1 << 20
# The depths of so many points are sorted at once: 256 MB.
_POINTS_AT_ONCE: Final = 1 << 26
# A net of triangles has at most so many, and is laid over so many rows at once.
_VERTICES_MOST: Final = 2_000_000
_ROWS_AT_ONCE: Final = 256


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
        places: (cells, 2) float32, where the points of a cell lie to the right of and below its
            centre, in cells; (0, 0) where many do, NaN where none does.
    """

    depth_m: NDArray[np.float32]
    sigma_m: NDArray[np.float32]
    count: NDArray[np.uint32]
    intensity: NDArray[np.float32] | None
    rgb: NDArray[np.uint8] | None
    places: NDArray[np.float32]
    percentiles_m: NDArray[np.float32] | None = None


def surface_of(cloud: PointCloud, slab: Slab, rule: SurfaceRule) -> CellSurface:
    """Lay a cloud into the raster of a wall."""
    if rule.is_of_one_point:
        surface = _surface_of_winners(cloud, slab, rule)
    else:
        surface = _surface_of_all(cloud, slab, rule)
    if not rule.percentiles:
        return surface
    return replace(surface, percentiles_m=_percentiles_m(cloud, slab, surface.count, rule))


def carried_to_centres(surface: CellSurface, slab: Slab, rule: SurfaceRule) -> CellSurface:
    """Carry intensity and colour of cells with few points from these to the centre of the cell.

    Rules that take a single point take its values as they are.
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
    return replace(surface, intensity=intensity, rgb=rgb)


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
        sigma_m=_spread_m(winners["n_points"], moments),
        count=winners["n_points"].copy(),
        intensity=None if intensity is None else taken(intensity[:, np.newaxis], np.nan)[:, 0],
        rgb=None if rgb is None else taken(rgb, 0),
        places=places_of_winners(cloud, slab, winners, threads=rule.threads),
    )
    points = winners["point"][has_point]
    return _triangulated(cloud, slab, points, surface) if rule.surface == "tin" else surface


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


def _triangulated(
    cloud: PointCloud, slab: Slab, points: NDArray[np.uint32], surface: CellSurface
) -> CellSurface:
    """Replace a surface by the net through the points nearest to the centres of their cells."""
    offsets = np.stack([values[points] for values in (cloud.x, cloud.y, cloud.z)])
    matrix = wall_from_offset(slab.frame, cloud.origin)
    places = (matrix[:2, :3] @ offsets.astype(np.float64)).T + matrix[:2, 3]
    measured = np.flatnonzero(surface.count)
    channels: list[NDArray[np.generic]] = [surface.depth_m[measured, np.newaxis]]
    if surface.intensity is not None:
        channels.append(surface.intensity[measured, np.newaxis])
    if surface.rgb is not None:
        channels.append(surface.rgb[measured])
    found = _interpolated(places, channels, slab.frame.shape)
    return replace(
        surface,
        depth_m=np.ascontiguousarray(found[0][:, 0]),
        intensity=None if surface.intensity is None else np.ascontiguousarray(found[1][:, 0]),
        rgb=None if surface.rgb is None else np.rint(np.nan_to_num(found[-1])).astype(np.uint8),
        # The net tells what is at the centres.
        places=np.where(np.isfinite(found[0]), np.float32(0.0), np.float32(np.nan)).repeat(2, 1),
    )


def _interpolated(
    places: NDArray[np.float64],
    values: Sequence[NDArray[np.generic]],
    shape: tuple[int, int],
) -> list[NDArray[np.float32]]:
    """Values at all cell centres, linear in the triangles of a Delaunay net.

    The net spans every gap, windows included, and lays slopes where depths step.

    Args:
        places: (n, 2) column and row of the vertices, cell centres at .5.
        values: arrays (n, channels), each with values at the vertices.
        shape: rows and columns of the raster.

    Returns:
        An array (cells, channels) for each of `values`; NaN outside the net.

    Raises:
        MethodError: the points make no triangle, or too many.
    """
    from scipy.interpolate import LinearNDInterpolator
    from scipy.spatial import Delaunay, QhullError

    if len(places) > _VERTICES_MOST:
        raise MethodError(
            f"surface tin takes at most {_VERTICES_MOST} cells with points, this wall has "
            f"{len(places)}: raise gsd_m, or take another surface"
        )
    stacked = np.column_stack([np.asarray(array, dtype=np.float64) for array in values])
    no_net = MethodError(
        f"surface tin needs points that span triangles about the cells of each wall, and the "
        f"{len(places)} cells with points of this one do not: take another surface"
    )
    try:
        net = Delaunay(places)
    except (QhullError, ValueError) as error:
        raise no_net from error
    look_up = LinearNDInterpolator(net, stacked)
    rows, columns = shape
    found = np.empty((rows * columns, stacked.shape[1]), dtype=np.float32)
    for first in range(0, rows, _ROWS_AT_ONCE):
        end = min(first + _ROWS_AT_ONCE, rows)
        row, column = np.mgrid[first:end, :columns] + 0.5
        found[first * columns : end * columns] = look_up(
            np.column_stack([column.ravel(), row.ravel()])
        )
    if not np.isfinite(found).any():
        raise no_net
    widths = np.cumsum([array.shape[1] for array in values])[:-1]
    return np.split(found, widths, axis=1)


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
    intensity, rgb = _averaged_values(cloud, slab, few, threads=rule.threads)
    in_parts(partial(kernels.find_mean_places, few), slab.n_cells, threads=rule.threads)
    return CellSurface(
        depth_m=depth_m,
        sigma_m=sigma_m,
        count=count,
        intensity=intensity,
        rgb=rgb,
        places=few.places,
    )


def _spread_m(n_points: NDArray[np.uint32], moments: NDArray[np.float64]) -> NDArray[np.float32]:
    """Sample standard deviation of the depths in each cell.

    Args:
        n_points: (cells,).
        moments: (cells, 2) sums of depths and squared depths; used up.

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
        cells: which of the raster.
        depths_m: (points,) float32.
        ends: (cells,) where the depths of the next cell begin.
    """

    cells: slice
    depths_m: NDArray[np.float32]
    ends: NDArray[np.int64]


def _grouped(
    cloud: PointCloud, slab: Slab, count: NDArray[np.uint32], *, threads: int
) -> Iterator[_Group]:
    """Sort the depths of all points inside by cells, so many points at once."""
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
    """Medians (cells,) of the cells' best supported layers."""
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
    """Percentiles (cells, k) of all points of a cell, linear between two of them as numpy's."""
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
    offsets, matrix = (
        read_only(cloud.x, cloud.y, cloud.z),
        wall_from_offset(slab.frame, cloud.origin),
    )
    for entries in entries_inside(cloud, slab, threads=threads):
        passes = [
            partial(kernels.add_values, entries, values, few.depths_m, few.layer_m, sum_of_values)
            for values, sum_of_values in zip(channels, sums, strict=True)
        ]
        passes.append(partial(kernels.add_places, entries, offsets, matrix, few))
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
