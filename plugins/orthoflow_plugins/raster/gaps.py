"""The state of the cells of a surface: measured, recovered in narrow gaps, or void.

A gap is recovered between points that are neighbours in a scan if its rows and columns are known;
otherwise between the measured cells around it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.interpolation import CellValues, Surroundings, cell_values, interpolate
from orthoflow.geometry.narrow_gaps import narrow_gaps
from orthoflow.geometry.point_kernels import read_only
from orthoflow.geometry.raster_kernels import BLOCK
from orthoflow.geometry.rastering import entries_inside, wall_from_offset
from orthoflow.geometry.slabs import Slab
from orthoflow.products import PointCloud, SurfaceMask
from orthoflow_plugins.raster.rules import GapRule
from orthoflow_plugins.raster.scan_grid_kernels import (
    Reach,
    ScanGrid,
    Sums,
    recover_between,
    take_means,
)
from orthoflow_plugins.raster.surfaces import CellSurface

# In a scan with more rows times columns than this the numbers are not a grid (2 GB of indices).
_GRID_CELLS_MOST: Final = 1 << 28

_Number = TypeVar("_Number", np.float32, np.uint8)


def close_gaps(
    cloud: PointCloud, slab: Slab, surface: CellSurface, rule: GapRule
) -> NDArray[np.uint8]:
    """Fill the narrow gaps of a surface in place; their spread stays unknown, their count 0.

    Returns:
        (cells,) `SurfaceMask`.
    """
    is_known = np.isfinite(surface.depth_m)
    mask = np.full(is_known.shape, SurfaceMask.RECOVERED, dtype=np.uint8)
    mask[surface.count > 0] = SurfaceMask.MEASURED
    mask[~is_known] = SurfaceMask.VOID
    mask[_recover_between_neighbours(cloud, slab, surface, rule)] = SurfaceMask.RECOVERED
    narrow = narrow_gaps(is_known.reshape(slab.frame.shape), rule.gap_cells, threads=rule.threads)
    narrow = narrow[mask[narrow] == SurfaceMask.VOID]
    values = _values(surface)
    is_found = interpolate(
        narrow,
        Surroundings(surface.places, slab.frame.width, rule.layer_m),
        values,
        values,
        reach_cells=rule.gap_cells,
        threads=rule.threads,
    )
    mask[narrow[is_found]] = SurfaceMask.RECOVERED
    return mask


def _values(surface: CellSurface) -> CellValues:
    return cell_values(surface.depth_m, intensity=surface.intensity, rgb=surface.rgb)


def _recover_between_neighbours(
    cloud: PointCloud, slab: Slab, surface: CellSurface, rule: GapRule
) -> NDArray[np.bool_]:
    """Fill void cells of a surface between neighbours in the scans' grids by linear interpolation.

    A point that the scanner missed lies between its neighbours in the scan, whatever their distance
    on the raster. So a gap between points that are neighbours, or nearly, and on one surface is
    recovered between them; one through which the scanner looked is not, since no neighbours span
    it.

    Args:
        cloud: with rows and columns; without them nothing is filled.
        slab: of the wall.
        surface: filled in place; its spreads stay unknown and its counts 0.
        rule: which points count as neighbours.

    Returns:
        (cells,) which were filled.
    """
    was_void = ~np.isfinite(surface.depth_m)
    is_void = was_void.reshape(slab.frame.shape).copy()
    if rule.scan_steps == 0 or cloud.row is None or cloud.column is None or not is_void.any():
        return np.zeros(was_void.size, dtype=np.bool_)
    no_intensity, no_rgb = np.empty(0, dtype=np.float32), np.empty((0, 3), dtype=np.uint8)
    intensity = _unchanged(no_intensity if cloud.intensity is None else cloud.intensity)
    rgb = _unchanged(no_rgb if cloud.rgb is None else cloud.rgb)
    values = _values(surface)
    matrix = wall_from_offset(slab.frame, cloud.origin)
    offsets = read_only(cloud.x, cloud.y, cloud.z)
    chosen = _points_beside_voids(cloud, slab, surface, _near(is_void, rule.span_cells), rule)
    for step in range(1, rule.scan_steps + 1):
        sums = Sums(
            n=np.zeros(was_void.size, dtype=np.uint16),
            depth_m=np.zeros(was_void.size, dtype=np.float32),
            intensity=np.zeros(values.intensity.shape, dtype=np.float32),
            rgb=np.zeros(values.rgb.shape, dtype=np.float32),
        )
        reach = Reach(step, float(rule.span_cells), rule.layer_m)
        for points in _grids(cloud, chosen):
            grid = ScanGrid(points, offsets, matrix)
            recover_between(grid, intensity, rgb, reach, is_void, sums)
        take_means(np.flatnonzero(is_void), sums, is_void.reshape(-1), values)
    return was_void & ~is_void.ravel()


def _unchanged(values: NDArray[_Number]) -> NDArray[_Number]:
    """Return an array in the form for which kernels are compiled."""
    view = np.asarray(values).view(np.ndarray)
    view.flags.writeable = False
    return view


def _near(is_void: NDArray[np.bool_], reach_cells: int) -> NDArray[np.bool_]:
    """Return cells (flat) whose points may span a void cell."""
    import cv2

    window = np.ones((2 * reach_cells + 1,) * 2, dtype=np.uint8)
    return np.asarray(cv2.dilate(is_void.view(np.uint8), window), dtype=np.bool_).ravel()


def _grids(cloud: PointCloud, chosen: NDArray[np.uint32]) -> Iterator[NDArray[np.int64]]:
    """Return for each scan the indices of its chosen points by row and column."""
    if cloud.row is None or cloud.column is None:
        raise AssertionError("a grid was asked of a cloud without rows and columns")
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


def _points_beside_voids(
    cloud: PointCloud,
    slab: Slab,
    surface: CellSurface,
    near: NDArray[np.bool_],
    rule: GapRule,
) -> NDArray[np.uint32]:
    """Return indices of the points on the surface of a cell near a void one."""
    found = [np.empty(0, dtype=np.uint32)]
    for entries in entries_inside(cloud, slab, threads=rule.threads):
        for block, n_inside in enumerate(entries.n_inside):
            part = slice(block * BLOCK, block * BLOCK + int(n_inside))
            cells = entries.cells[part]
            beside = near[cells]
            if not beside.any():
                continue
            cells, depths_m = cells[beside], entries.depths_m[part][beside]
            on_surface = np.abs(depths_m - surface.depth_m[cells]) <= rule.layer_m
            found.append(entries.points[part][beside][on_surface])
    return np.concatenate(found)
