"""Rasters of single walls; large walls are processed in bands of rows."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry import WallFrame
from orthoflow.geometry.bands import IN_MEMORY_CELLS, Allocate, bands_with_reach
from orthoflow.geometry.levels import REC_601
from orthoflow.geometry.robust import depth_noise_m
from orthoflow.geometry.slabs import Slab
from orthoflow.products import PointCloud, SurfaceMask, Wall
from orthoflow_plugins.raster.parameters import RasterParams

# Bytes per cell of a finished wall.
_BYTES_KEPT: Final = 25
# Additional bytes per cell while a wall is processed.
_BYTES_WORKING: Final = 90
# Bytes per vertex of a triangulation, which is not processed in bands.
_BYTES_VERTEX: Final = 700
_MEMORY_SHARE: Final = 0.75
# Number of cells in a band, which needs 1.5 GB of memory; larger walls are processed in bands.
BAND_CELLS: Final = 1 << 24
# Margin of a band in rows, for the detection of outliers, which uses cells up to 20 rows away.
_REACH_OF_OUTLIERS: Final = 32


def bytes_needed(shapes: Sequence[tuple[int, int]], *, is_tin: bool = False) -> int:
    """Estimate the memory in bytes needed to rasterise walls of given shapes (rows, columns)."""
    sizes = [rows * columns for rows, columns in shapes]
    # Finished large walls are stored in files; while they are processed, they only need memory for
    # one band.
    kept = _BYTES_KEPT * sum(size for size in sizes if size <= IN_MEMORY_CELLS)
    if is_tin:
        return kept + (_BYTES_WORKING + _BYTES_VERTEX) * max(sizes)
    return kept + _BYTES_WORKING * min(max(sizes), BAND_CELLS)


def require_memory(frames: Sequence[WallFrame], *, is_tin: bool = False) -> None:
    """Check that the memory of the machine suffices for the rasters.

    Raises:
        MethodError: the rasters do not fit into memory.
    """
    sizes = [frame.width * frame.height for frame in frames]
    needed = bytes_needed([frame.shape for frame in frames], is_tin=is_tin)
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    # Indices of cells have 32 bits.
    if needed > _MEMORY_SHARE * memory or max(sizes) > np.iinfo(np.int32).max:
        largest = frames[int(np.argmax(sizes))]
        raise MethodError(
            f"gsd_m = {largest.gsd_m:g} m gives {sum(sizes):.3g} cells ({largest.width} x "
            f"{largest.height} on the largest wall), which need {needed / 2**30:.3g} GiB; this "
            f"machine has {memory / 2**30:.3g} GiB: increase gsd_m, or reduce n_walls_max"
        )


def rastered_wall(
    cloud: PointCloud,
    slab: Slab,
    params: RasterParams,
    *,
    index: int,
    name: str,
    allocate: Allocate,
    threads: int,
) -> Wall:
    """Rasterise a wall; large walls are processed in bands of rows.

    Args:
        cloud: the points.
        slab: raster and buffer of the wall.
        params: parameters.
        index: number of the wall.
        name: name of the wall.
        allocate: function that creates the arrays of a large wall.
        threads: number of threads.
    """
    from orthoflow_plugins.raster.surfaces import DENOISE_CELLS, SPAN_GAPS

    frame, width = slab.frame, slab.frame.width
    cells_most = BAND_CELLS + (slab.n_cells if params.surface == "tin" else 0)
    # The noise filter is applied twice. The interpolation of gaps needs the distance between
    # neighbours across a gap, the radius of a disc on each side, and a margin.
    reach_rows = _REACH_OF_OUTLIERS + 2 * DENOISE_CELLS
    reach_rows += (SPAN_GAPS + 2) * params.recover_gap_cells + 2
    whole: dict[str, NDArray[np.generic]] = {}
    for band in bands_with_reach(frame.shape, cells_most=cells_most, reach_rows=reach_rows):
        found = _rastered(cloud, slab.over(band.around), params, threads=threads)
        for field, values in found.items():
            shape = (*frame.shape, *values.shape[1:])
            if slab.n_cells <= min(IN_MEMORY_CELLS, cells_most):
                whole[field] = values.reshape(shape)
                continue
            if field not in whole:
                whole[field] = allocate(field, shape, values.dtype)
            of_band = values.reshape(-1, width, *values.shape[1:])
            whole[field][band.rows] = of_band[band.inner]
    # The arrays have the same types as those of the bands.
    arrays = cast("dict[str, Any]", whole)
    return Wall(frame=frame, plane_index=index, name=name, **arrays)


def _rastered(
    cloud: PointCloud,
    slab: Slab,
    params: RasterParams,
    *,
    threads: int,
) -> dict[str, NDArray[np.generic]]:
    """Return the arrays of a `Wall` for a slab; their first axis is the cell, in row order."""
    from orthoflow_plugins.raster.surfaces import (
        carried_to_centres,
        close_gaps,
        denoised,
        surface_of,
    )

    surface = surface_of(cloud, slab, params, threads=threads)
    is_denoised, noise_m = params.surface == "denoised", 0.0
    if is_denoised:
        # Interpolated depths have less noise than the points, which the filter is meant for.
        noise_m = depth_noise_m(surface.depth_m.reshape(slab.frame.shape))
    mask = close_gaps(cloud, slab, surface, params, threads=threads)
    surface = carried_to_centres(surface, slab, params, threads=threads)
    if is_denoised:
        depth_m = denoised(surface.depth_m.reshape(slab.frame.shape), noise_m)
        surface = replace(surface, depth_m=depth_m.ravel())
    intensity, rgb, rgb_mask = surface.intensity, surface.rgb, None
    if rgb is not None:
        rgb_mask = (mask != SurfaceMask.VOID).astype(np.uint8)
        if surface.has_rgb is not None:
            rgb_mask &= surface.has_rgb
        if intensity is None:
            intensity = rgb.astype(np.float32) @ REC_601.astype(np.float32) / np.float32(255.0)
            intensity[rgb_mask == 0] = np.nan
    found = {
        "depth_m": surface.depth_m,
        "sigma_m": surface.sigma_m,
        "count": surface.count,
        "mask": mask,
        "intensity": intensity,
        "rgb": rgb,
        "rgb_mask": rgb_mask,
        "percentiles_m": surface.percentiles_m,
    }
    return {name: values for name, values in found.items() if values is not None}
