"""The surface of a wall: depth, intensity and colour of each cell."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part
from orthoflow.geometry.interpolation import Surroundings, cell_values, interpolate
from orthoflow.geometry.narrow_gaps import narrow_gaps
from orthoflow.geometry.rastering import (
    Entries,
    empty_winners,
    entries_inside,
    keep_nearest,
    keep_topmost,
    places_of_winners,
    share_cells,
    values_of_winners,
    wall_from_offset,
)
from orthoflow.geometry.robust import depth_noise_m
from orthoflow.geometry.slabs import Slab, read_only, read_only_view
from orthoflow.geometry.threads import in_parts
from orthoflow.products import PointCloud, SurfaceMask
from orthoflow_plugins.raster import kernels
from orthoflow_plugins.raster.nets import interpolate_net
from orthoflow_plugins.raster.parameters import RasterParams

# Rules by which a cell gets the values of a single point instead of the mean of several.
ONE_POINT: Final = frozenset({"nearest", "centre", "topmost", "tin"})
# Minimum difference in depth between layers in a cell, unless noise causes such differences.
LAYER_M: Final = 0.02
# Radius of the filter for the surface `denoised`; sigma of the Gaussian weights is half the radius.
DENOISE_CELLS: Final = 4
# Maximum number of cells in temporary arrays.
CELLS_AT_ONCE: Final = 1 << 20
# Maximum distance on the wall between neighbours in a scan, as a multiple of the radius of a narrow
# gap.
SPAN_GAPS: Final = 4
# Maximum number of cells in the grid of a scan (2 GB of indices); the rows and columns of larger
# scans are not used.
_GRID_CELLS_MOST: Final = 1 << 28
# Number of depths sorted at once (256 MB).
POINTS_AT_ONCE: Final = 1 << 26

# Radius of the neighbourhood for outliers, in rows and columns.
_NEAR_CELLS: Final = 2
# With fewer known neighbours, a cell is not checked.
_KNOWN_LEAST: Final = 6
# A cell with which fewer neighbours agree is an outlier.
_AGREEING_LEAST: Final = 2
# Radius of the neighbourhood for sparse cells, in rows and columns.
_SPARSE_CELLS: Final = 4
# At least this number of neighbours, and half of the known neighbours, must agree with a sparse
# cell.
_SPARSE_LEAST: Final = 3
# Maximum slope of a surface on which sparse cells agree (27 degrees).
_SLOPE: Final = 0.5
# A cell is sparse if its number of known neighbours is below this share of the largest number
# nearby.
_SPARSE_SHARE: Final = 0.35
# Half the maximum width of the scan shadow of an edge, in cells.
_AROUND_CELLS: Final = 16
# Maximum difference in depth, due to noise, between cells on the same surface, in standard
# deviations.
_CLOSE_SIGMAS: Final = 4.0
# Maximum differences in depth in the two passes of the filter, in standard deviations of the noise
# of a cell. The first pass removes most of the noise, so the second pass can be stricter at steps.
_REACHES: Final = (3.0, 1.5)
# So that void cells get no weight, they are filled with a depth that is below all others by this
# multiple of the maximum difference.
_VOID_REACHES: Final = 8.0
# Depths with less noise are not filtered.
_NOISE_LEAST_M: Final = 2.0e-5

_Number = TypeVar("_Number", np.float32, np.uint8)


@dataclass(frozen=True, kw_only=True)
class CellSurface:
    """The surface of a wall; the first axis of all arrays is the cell, in row order.

    Attributes:
        depth_m: float32 depths in metres; NaN for void cells.
        sigma_m: float32 standard deviations of depths in metres; NaN for fewer than two points.
        count: uint32 numbers of points.
        intensity: float32; NaN for void cells. None if the cloud has no intensity.
        rgb: (cells, 3) uint8; 0 for void cells. None if the cloud has no colour.
        has_rgb: (cells,) True for cells with a colour; None if all cells with points have one.
        layer_m: depths that differ by more belong to different layers.
        percentiles_m: (cells, k) float32 percentiles of depths in metres; NaN for cells without
            points. None if not requested.
        places: (cells, 2) float32 mean position of the points of a cell, to the right of and below
            its centre, in cells; (0, 0) if there are many points, NaN if there are none.
    """

    depth_m: NDArray[np.float32]
    sigma_m: NDArray[np.float32]
    count: NDArray[np.uint32]
    intensity: NDArray[np.float32] | None
    rgb: NDArray[np.uint8] | None
    places: NDArray[np.float32]
    percentiles_m: NDArray[np.float32] | None = None
    has_rgb: NDArray[np.bool_] | None = None
    layer_m: float = LAYER_M


def surface_of(cloud: PointCloud, slab: Slab, params: RasterParams, *, threads: int) -> CellSurface:
    """Compute the surface of a wall from a cloud.

    Args:
        cloud: the points.
        slab: raster and buffer of the wall or of a part of it.
        params: parameters, including the rule for depths.
        threads: number of threads.
    """
    if params.surface in ONE_POINT:
        surface = _surface_of_winners(cloud, slab, params, threads=threads)
    else:
        surface = _surface_of_all(cloud, slab, params, threads=threads)
    if not params.percentiles:
        return surface
    percentiles_m = _percentiles_m(cloud, slab, surface.count, params.percentiles, threads=threads)
    return replace(surface, percentiles_m=percentiles_m)


def carried_to_centres(
    surface: CellSurface, slab: Slab, params: RasterParams, *, threads: int
) -> CellSurface:
    """Extrapolate intensity and colour of cells with few points to the centres of the cells.

    If the rule for depths selects a single point per cell, the values of this point are not
    changed.
    """
    if params.surface in ONE_POINT or (surface.intensity is None and surface.rgb is None):
        return surface
    few = np.flatnonzero(
        (surface.count > 0) & (surface.count <= kernels.FEW_POINTS) & np.isfinite(surface.depth_m)
    )
    intensity = None if surface.intensity is None else surface.intensity.copy()
    rgb = None if surface.rgb is None else surface.rgb.copy()
    interpolate(
        few,
        Surroundings(surface.places, slab.frame.width, surface.layer_m),
        cell_values(surface.depth_m, intensity=surface.intensity, rgb=surface.rgb),
        cell_values(np.empty(0, dtype=np.float32), intensity=intensity, rgb=rgb),
        reach_cells=0.0,
        threads=threads,
    )
    if intensity is not None and surface.intensity is not None:
        # Cells next to cells without intensity cannot be extrapolated and keep their values.
        is_lost = few[~np.isfinite(intensity[few])]
        intensity[is_lost] = surface.intensity[is_lost]
    if surface.has_rgb is not None:
        rgb = surface.rgb
    return replace(surface, intensity=intensity, rgb=rgb)


def _surface_of_winners(
    cloud: PointCloud, slab: Slab, params: RasterParams, *, threads: int
) -> CellSurface:
    winners = empty_winners(slab.n_cells)
    count, moments = np.zeros(slab.n_cells, dtype=np.uint32), np.zeros((slab.n_cells, 2))
    for entries in entries_inside(cloud, slab, threads=threads):
        share_cells(
            threads,
            _contest(cloud, slab, params, entries, winners),
            partial(kernels.add_moments, entries, count, moments),
        )
    intensity, rgb, has_rgb = cloud.intensity, cloud.rgb, cloud.has_rgb
    if intensity is not None:
        intensity = values_of_winners(winners, intensity[:, np.newaxis], np.nan)[:, 0]
    if has_rgb is not None:
        has_rgb = values_of_winners(winners, has_rgb[:, np.newaxis], 0)[:, 0]
    surface = CellSurface(
        # The nearest point may be in a neighbouring cell, but cells that contain no points remain
        # void.
        depth_m=np.where(count > 0, winners["depth_m"], np.float32(np.nan)),
        sigma_m=_spread_m(count, moments),
        count=count,
        intensity=intensity,
        rgb=None if rgb is None else values_of_winners(winners, rgb, 0),
        has_rgb=has_rgb,
        places=places_of_winners(cloud, slab, winners),
    )
    if params.surface != "tin":
        return surface
    # Replace the values of points by those of the triangulation at the centres of the cells.
    depth_m, intensity, rgb = interpolate_net(cloud, slab, winners["point"], winners["depth_m"])
    is_known = np.isfinite(depth_m)[:, np.newaxis]
    places = np.where(is_known, np.float32(0.0), np.float32(np.nan)).repeat(2, 1)
    return replace(surface, depth_m=depth_m, intensity=intensity, rgb=rgb, places=places)


def _contest(
    cloud: PointCloud,
    slab: Slab,
    params: RasterParams,
    entries: Entries,
    winners: NDArray[np.void],
) -> Callable[[int, int], None]:
    if params.surface == "nearest":
        return partial(
            kernels.keep_nearest_around,
            entries,
            read_only(cloud.x, cloud.y, cloud.z),
            wall_from_offset(slab.frame, cloud.origin),
            winners,
            slab.frame.width,
        )
    keep = keep_topmost if params.surface == "topmost" else keep_nearest
    return partial(keep, entries, winners)


def _surface_of_all(
    cloud: PointCloud, slab: Slab, params: RasterParams, *, threads: int
) -> CellSurface:
    """Compute a surface in two or three passes: counts, medians (if used) and means."""
    count, moments = np.zeros(slab.n_cells, dtype=np.uint32), np.zeros((slab.n_cells, 2))
    for entries in entries_inside(cloud, slab, threads=threads):
        share_cells(threads, partial(kernels.add_moments, entries, count, moments))
    with np.errstate(invalid="ignore"):
        depth_m, layer_m = (moments[:, 0] / count).astype(np.float32), np.inf
    sigma_m = _spread_m(count, moments)
    del moments  # This frees a third of the memory used so far, since the next passes need more.
    if params.surface != "mean":
        layer_m = LAYER_M
        raster_m = _medians_m(cloud, slab, count, layer_m, threads=threads)
        # In sparse rasters, most neighbouring cells are at steps, whose height is not noise.
        noise_m = min(slab.rms_m, depth_noise_m(raster_m))
        if layer_m < _CLOSE_SIGMAS * noise_m:
            # The nearer of two points of a surface would be a layer, which displaces the surface.
            layer_m = _CLOSE_SIGMAS * noise_m
            raster_m = _medians_m(cloud, slab, count, layer_m, threads=threads)
        raster_m = without_specks(
            raster_m, gsd_m=slab.frame.gsd_m, layer_m=layer_m, threads=threads
        )
        depth_m = raster_m.ravel()
    few = kernels.FewPoints(
        n_inside=count,
        depths_m=depth_m,
        layer_m=layer_m,
        n_summed=np.zeros(slab.n_cells, dtype=np.uint8),
        places=np.zeros((slab.n_cells, 2), dtype=np.float32),
    )
    intensity, rgb, has_rgb = _averaged_values(cloud, slab, few, threads=threads)
    # Compute mean positions: NaN for cells without points, and 0 for cells with many points.
    n_summed = np.where(count <= kernels.FEW_POINTS, few.n_summed, np.uint8(1))[:, np.newaxis]
    with np.errstate(invalid="ignore"):
        np.divide(few.places, n_summed, out=few.places)
    return CellSurface(
        depth_m=depth_m,
        sigma_m=sigma_m,
        count=count,
        intensity=intensity,
        rgb=rgb,
        has_rgb=has_rgb,
        places=few.places,
        layer_m=LAYER_M if params.surface == "mean" else layer_m,
    )


def _medians_m(
    cloud: PointCloud, slab: Slab, count: NDArray[np.uint32], layer_m: float, *, threads: int
) -> NDArray[np.float32]:
    """Return the median depth (rows, cols) of the largest layer of each cell."""
    depth_m = np.empty(count.size, dtype=np.float32)
    for cells, depths_m, ends in _grouped(cloud, slab, count, threads=threads):
        _sort_depths(depths_m, ends, depth_m[cells], layer_m, threads=threads)
    return depth_m.reshape(slab.frame.shape)


def _spread_m(n_points: NDArray[np.uint32], moments: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the sample standard deviation of the depths in each cell.

    Args:
        n_points: (cells,) numbers of points.
        moments: (cells, 2) sums of depths and squared depths; overwritten.

    Returns:
        (cells,) metres; NaN for fewer than two points.
    """
    mean, squares = moments.T
    with np.errstate(divide="ignore", invalid="ignore"):
        np.divide(mean, n_points, out=mean)
        squares -= mean * mean * n_points
        np.maximum(squares, 0.0, out=squares)
        # Subtract 1.0 instead of 1, because 0 - 1 overflows with unsigned integers.
        np.divide(squares, n_points - 1.0, out=squares)
        np.sqrt(squares, out=squares)
    squares[n_points < 2] = np.nan
    sigma_m: NDArray[np.float32] = squares.astype(np.float32)
    return sigma_m


def _grouped(
    cloud: PointCloud, slab: Slab, count: NDArray[np.uint32], *, threads: int
) -> Iterator[tuple[slice, NDArray[np.float32], NDArray[np.int64]]]:
    """Yield ranges of cells, the depths of all points in these, and the end index of each cell."""
    width = slab.frame.width
    totals = np.cumsum(count, dtype=np.int64)
    first = n_before = 0
    while first < count.size:
        # Use at least one cell, even if it has more points.
        end = int(np.searchsorted(totals, n_before + POINTS_AT_ONCE, side="right"))
        end = max(first + 1, end)
        ends = totals[first:end] - n_before
        cursors = ends - count[first:end]
        depths_m = np.empty(int(ends[-1]), dtype=np.float32)
        rows = slice(first // width, -(-end // width))
        for entries in entries_inside(cloud, slab, threads=threads, rows=rows):
            sort = partial(kernels.sort_into_cells, entries, first, cursors, depths_m)
            share_cells(threads, sort)
        yield slice(first, end), depths_m, ends
        first, n_before = end, int(totals[end - 1])


def _sort_depths(
    depths_m: NDArray[np.float32],
    ends: NDArray[np.int64],
    medians_m: NDArray[np.float32],
    layer_m: float,
    *,
    threads: int,
) -> None:
    task = partial(kernels.median_depths, ends, depths_m, layer_m, medians_m)
    in_parts(task, medians_m.size, threads=threads)


def _percentiles_m(
    cloud: PointCloud,
    slab: Slab,
    count: NDArray[np.uint32],
    percentiles: tuple[float, ...],
    *,
    threads: int,
) -> NDArray[np.float32]:
    """Return percentiles (cells, k) of the depths of all points, interpolated as in NumPy."""
    percentiles_m = np.full((count.size, len(percentiles)), np.nan, dtype=np.float32)
    for cells, depths_m, ends in _grouped(cloud, slab, count, threads=threads):
        _sort_depths(depths_m, ends, np.empty(len(ends), np.float32), math.inf, threads=threads)
        for begin in range(0, len(ends), CELLS_AT_ONCE):
            part = slice(begin, begin + CELLS_AT_ONCE)
            n_points = count[cells][part].astype(np.int64)
            measured = np.flatnonzero(n_points)
            first, n_points = (ends[part] - n_points)[measured], n_points[measured]
            for k, percent in enumerate(percentiles):
                place = (n_points - 1) * (percent / 100.0)
                lower = np.floor(place).astype(np.int64)
                upper = np.minimum(lower + 1, n_points - 1)
                low_m, high_m = depths_m[first + lower], depths_m[first + upper]
                values_m = low_m + (place - lower) * (high_m - low_m)
                percentiles_m[cells][part][measured, k] = values_m
    return percentiles_m


def _averaged_values(
    cloud: PointCloud, slab: Slab, few: kernels.FewPoints, *, threads: int
) -> tuple[NDArray[np.float32] | None, NDArray[np.uint8] | None, NDArray[np.bool_] | None]:
    """Return mean intensities (cells,), mean colours (cells, 3), and a mask of known colours."""
    # For each channel: the values of the points, a mask of the points with a value (empty if all
    # have one, or if the others are NaN), and the sums per cell.
    of_all = np.empty(0, dtype=np.bool_)
    of_intensity, of_colour = np.empty((0, 2)), np.empty((0, 4), dtype=np.uint32)
    channels: list[tuple[NDArray[np.generic], NDArray[np.bool_], NDArray[np.generic]]] = []
    if cloud.intensity is not None:
        of_intensity = np.zeros((slab.n_cells, 2))
        channels.append((read_only_view(cloud.intensity)[:, np.newaxis], of_all, of_intensity))
    if cloud.rgb is not None:
        # Integer sums need half the memory and are exact.
        of_colour = np.zeros((slab.n_cells, 4), dtype=np.uint32)
        has_rgb = of_all if cloud.has_rgb is None else np.asarray(cloud.has_rgb)
        channels.append((read_only_view(cloud.rgb), has_rgb, of_colour))
    offsets = read_only(cloud.x, cloud.y, cloud.z)
    matrix = wall_from_offset(slab.frame, cloud.origin)
    for entries in entries_inside(cloud, slab, threads=threads):
        surface = (few.depths_m, few.layer_m)
        passes = [
            partial(kernels.add_values, entries, values, has_value, *surface, sums)
            for values, has_value, sums in channels
        ]
        passes.append(partial(kernels.add_places, entries, offsets, matrix, few))
        share_cells(threads, *passes)
    intensity = None if cloud.intensity is None else np.empty(slab.n_cells, dtype=np.float32)
    rgb = None if cloud.rgb is None else np.empty((slab.n_cells, 3), dtype=np.uint8)
    # Process the cells in parts, because the computation needs several times the memory of the
    # result.
    for first in range(0, slab.n_cells, CELLS_AT_ONCE):
        part = slice(first, first + CELLS_AT_ONCE)
        with np.errstate(invalid="ignore"):
            if intensity is not None:
                intensity[part] = of_intensity[part, 0] / of_intensity[part, 1]
            if rgb is not None:
                means = of_colour[part, :3] / of_colour[part, 3:]
                rgb[part] = np.rint(np.nan_to_num(means))
    return intensity, rgb, None if cloud.has_rgb is None else of_colour[:, 3] > 0


def without_specks(
    depth_m: NDArray[np.float32], *, gsd_m: float, layer_m: float, threads: int
) -> NDArray[np.float32]:
    """Set cells to void if their depth is an outlier that agrees with hardly any neighbour.

    In an orthoimage, such a cell would show a distant part of a photo. In the scan shadow of an
    edge, known cells are sparse, and many of them are outliers or mixed pixels from both sides of
    the edge. In such regions, half of the few neighbours must agree with a cell, allowing for a
    slope.

    Args:
        depth_m: (rows, cols) metres, NaN where void.
        gsd_m: side of a cell in metres.
        layer_m: depths that differ by more belong to different layers.
        threads: number of threads.
    """
    noise_m = min(layer_m, _CLOSE_SIGMAS * depth_noise_m(depth_m))
    is_sparse, is_speck = _sparse(np.isfinite(depth_m)), np.zeros(depth_m.shape, dtype=np.bool_)
    slope_m = _SLOPE * gsd_m
    task = partial(_find_specks, depth_m, is_sparse, (layer_m, noise_m, slope_m), is_speck)
    in_parts(task, depth_m.shape[0], threads=threads)
    return np.where(is_speck, np.float32(np.nan), depth_m)


def _sparse(is_known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a mask of known cells that have far fewer known neighbours than cells nearby."""
    import cv2

    near = 2 * _NEAR_CELLS + 1
    known = np.asarray(
        cv2.boxFilter(
            is_known.view(np.uint8),
            cv2.CV_8U,
            (near, near),
            normalize=False,
            borderType=cv2.BORDER_CONSTANT,
        )
    )
    around = cv2.dilate(known, np.ones((2 * _AROUND_CELLS + 1,) * 2, dtype=np.uint8))
    return is_known & (known < _SPARSE_SHARE * np.asarray(around))


def denoised(depth_m: NDArray[np.float32], noise_m: float) -> NDArray[np.float32]:
    """Average depths of neighbouring cells on the same surface (bilateral filter, Tomasi 1998).

    Steps of more than about six standard deviations are preserved.

    Args:
        depth_m: (rows, cols) metres, NaN where void.
        noise_m: standard deviation of measured depths.

    Returns:
        (rows, cols) metres, NaN for void cells.
    """
    import cv2

    is_known = np.isfinite(depth_m)
    if noise_m < _NOISE_LEAST_M or not is_known.any():
        return depth_m
    lowest = float(depth_m[is_known].min())
    values = depth_m
    for reach in _REACHES:
        reach_m = reach * noise_m
        filled = np.where(is_known, values, np.float32(lowest - _VOID_REACHES * reach_m))
        values = np.asarray(
            cv2.bilateralFilter(
                filled,
                2 * DENOISE_CELLS + 1,
                sigmaColor=reach_m,
                sigmaSpace=0.5 * DENOISE_CELLS,
                borderType=cv2.BORDER_REPLICATE,
            ),
            dtype=np.float32,
        )
    return np.where(is_known, values, np.float32(math.nan))


@compiled
def _find_specks(
    depth_m: NDArray[np.float32],
    is_sparse: NDArray[np.bool_],
    agree_m: tuple[float, float, float],
    is_speck: NDArray[np.bool_],
    first_row: int,
    end_row: int,
) -> None:
    """Mark outliers in the rows from `first_row` to `end_row` (exclusive).

    Args:
        depth_m: (rows, cols) metres, NaN where void.
        is_sparse: (rows, cols) True for sparse cells of an otherwise dense surface.
        agree_m: maximum difference between depths that agree; the same for sparse cells; and the
            increase of this second value per row or column of distance, due to a slope.
        is_speck: (rows, cols) output. A known cell is an outlier if at least six cells in its 5 x 5
            (or else 9 x 9) neighbourhood are known but fewer than two of them agree. A sparse cell
            is an outlier if fewer than three cells in its 9 x 9 neighbourhood, or fewer than half
            of the known ones, agree.
        first_row: first row to visit.
        end_row: the row after the last one.
    """
    columns = depth_m.shape[1]
    layer_m, noise_m, slope_m = agree_m
    for row in range(first_row, end_row):
        for column in range(columns):
            if np.isnan(depth_m[row, column]):
                continue
            if is_sparse[row, column]:
                n_known, n_agreeing = _count_around(
                    depth_m, row, column, _SPARSE_CELLS, noise_m, slope_m
                )
                is_speck[row, column] = n_agreeing < max(_SPARSE_LEAST, 0.5 * n_known)
                continue
            n_known, n_agreeing = _count_around(depth_m, row, column, _NEAR_CELLS, layer_m, 0.0)
            if n_known < _KNOWN_LEAST:
                # The points are several cells apart.
                n_known, n_agreeing = _count_around(
                    depth_m, row, column, _SPARSE_CELLS, layer_m, slope_m
                )
            is_speck[row, column] = n_agreeing < _AGREEING_LEAST and n_known >= _KNOWN_LEAST


@kernel_part
def _count_around(
    depth_m: NDArray[np.float32],
    row: int,
    column: int,
    reach: int,
    agree_m: float,
    slope_m: float,
) -> tuple[int, int]:
    """Return the number of known cells around a cell, and of those that agree with it.

    Depths agree if they differ by at most `agree_m` plus `slope_m` per row or column of distance.
    """
    rows, columns = depth_m.shape
    here = depth_m[row, column]
    n_known, n_agreeing = -1, -1
    for r in range(max(0, row - reach), min(rows, row + reach + 1)):
        for c in range(max(0, column - reach), min(columns, column + reach + 1)):
            other = depth_m[r, c]
            if np.isnan(other):
                continue
            n_known += 1
            n_between = max(abs(r - row), abs(c - column))
            n_agreeing += abs(other - here) <= agree_m + n_between * slope_m
    return n_known, n_agreeing


def close_gaps(
    cloud: PointCloud,
    slab: Slab,
    surface: CellSurface,
    params: RasterParams,
    *,
    threads: int,
) -> NDArray[np.uint8]:
    """Interpolate narrow gaps in a surface in place; filled cells get spread NaN and no points.

    If the rows and columns of a scan are known, gaps are interpolated between neighbouring points
    of the scan; otherwise, they are interpolated from the measured cells around them.

    Returns:
        (cells,) `SurfaceMask`.
    """
    reach_cells = params.recover_gap_cells
    is_known = np.isfinite(surface.depth_m)
    mask = np.full(is_known.shape, SurfaceMask.RECOVERED, dtype=np.uint8)
    mask[surface.count > 0] = SurfaceMask.MEASURED
    mask[~is_known] = SurfaceMask.VOID
    was_filled = _recover_between_neighbours(cloud, slab, surface, params, threads=threads)
    mask[was_filled] = SurfaceMask.RECOVERED
    narrow = narrow_gaps(is_known.reshape(slab.frame.shape), reach_cells)
    narrow = narrow[mask[narrow] == SurfaceMask.VOID]
    values = cell_values(surface.depth_m, intensity=surface.intensity, rgb=surface.rgb)
    is_found = interpolate(
        narrow,
        Surroundings(surface.places, slab.frame.width, surface.layer_m),
        values,
        values,
        reach_cells=reach_cells,
        threads=threads,
    )
    mask[narrow[is_found]] = SurfaceMask.RECOVERED
    return mask


def _recover_between_neighbours(
    cloud: PointCloud,
    slab: Slab,
    surface: CellSurface,
    params: RasterParams,
    *,
    threads: int,
) -> NDArray[np.bool_]:
    """Fill void cells of a surface by linear interpolation between neighbours in the scans' grids.

    A point that the scanner missed is between its neighbours in the scan, however far apart they
    are on the raster. Gaps between neighbours on the same surface are therefore interpolated. A gap
    through which the laser passed is not interpolated, because its two sides are not neighbours in
    the scan.

    Returns:
        (cells,) True for filled cells; their spread is NaN, and their number of points is 0.
    """
    import cv2

    was_void = ~np.isfinite(surface.depth_m)
    is_void, n_cells = was_void.copy(), was_void.size
    has_grid = cloud.row is not None and cloud.column is not None
    if params.recover_scan_steps == 0 or not has_grid or not is_void.any():
        return np.zeros(n_cells, dtype=np.bool_)
    intensity = _unchanged(np.empty(0, np.float32) if cloud.intensity is None else cloud.intensity)
    rgb = _unchanged(np.empty((0, 3), np.uint8) if cloud.rgb is None else cloud.rgb)
    matrix = wall_from_offset(slab.frame, cloud.origin)
    offsets = read_only(cloud.x, cloud.y, cloud.z)
    span_cells = SPAN_GAPS * params.recover_gap_cells
    window = np.ones((2 * span_cells + 1,) * 2, dtype=np.uint8)
    near = cv2.dilate(is_void.reshape(slab.frame.shape).view(np.uint8), window)
    is_near = np.asarray(near, dtype=np.bool_).ravel()
    chosen = _points_on(cloud, slab, surface, is_near, surface.layer_m, threads=threads)
    for step in range(1, params.recover_scan_steps + 1):
        sums = kernels.Sums(
            n=np.zeros(n_cells, dtype=np.uint16),
            depth_m=np.zeros(n_cells, dtype=np.float32),
            intensity=np.zeros(n_cells if intensity.size else 0, dtype=np.float32),
            rgb=np.zeros((n_cells if rgb.size else 0, 3), dtype=np.float32),
        )
        reach = kernels.Reach(step, float(span_cells), surface.layer_m)
        for points in _grids(cloud, chosen):
            grid = kernels.ScanGrid(points, offsets, matrix)
            voids = is_void.reshape(slab.frame.shape)
            kernels.recover_between(grid, intensity, rgb, reach, voids, sums)
        # The value of a cell is the mean of the triangles that cover it.
        filled = np.flatnonzero(is_void & (sums.n > 0))
        n = sums.n[filled].astype(np.float32)
        is_void[filled] = False
        surface.depth_m[filled] = sums.depth_m[filled] / n
        if surface.intensity is not None:
            surface.intensity[filled] = sums.intensity[filled] / n
        if surface.rgb is not None:
            shades = sums.rgb[filled] / n[:, np.newaxis]
            surface.rgb[filled] = np.clip(shades + 0.5, 0.0, 255.0).astype(np.uint8)
    return was_void & ~is_void


def _unchanged(values: NDArray[_Number]) -> NDArray[_Number]:
    """Return a read-only array of the type for which kernels are compiled."""
    view = np.asarray(values).view(np.ndarray)
    view.flags.writeable = False
    return view


def _grids(cloud: PointCloud, chosen: NDArray[np.uint32]) -> Iterator[NDArray[np.int64]]:
    """Yield the indices of the chosen points as an array (rows, cols) for each scan."""
    if cloud.row is None or cloud.column is None:
        raise AssertionError("the cloud has no rows and columns")
    scans = np.zeros(len(chosen), dtype=np.uint16) if cloud.scan is None else cloud.scan[chosen]
    for scan in np.unique(scans):
        points = chosen[scans == scan]
        rows, columns = cloud.row[points], cloud.column[points]
        shape = (int(np.ptp(rows)) + 1, int(np.ptp(columns)) + 1)
        if shape[0] * shape[1] > _GRID_CELLS_MOST:
            continue
        grid = np.full(shape, -1, dtype=np.int64)
        grid[rows - rows.min(), columns - columns.min()] = points
        yield grid


def _points_on(
    cloud: PointCloud,
    slab: Slab,
    surface: CellSurface,
    is_near: NDArray[np.bool_],
    layer_m: float,
    *,
    threads: int,
) -> NDArray[np.uint32]:
    found = [np.empty(0, dtype=np.uint32)]
    for entries in entries_inside(cloud, slab, threads=threads):
        beside = is_near[entries.cells]
        off_m = np.abs(entries.depths_m[beside] - surface.depth_m[entries.cells[beside]])
        found.append(entries.points[beside][off_m <= layer_m])
    return np.concatenate(found)
