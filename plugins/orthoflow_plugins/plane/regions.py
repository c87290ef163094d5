"""Cells joined to regions: growing over neighbours, or grouping by the normal alone."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane
from orthoflow.geometry.point_kernels import BlockedPoints
from orthoflow.geometry.region_kernels import grow_regions, sum_regions
from orthoflow_plugins.plane.coarser_cells import coarser
from orthoflow_plugins.plane.surface_cells import POINTS_LEAST, SurfaceCells

_FREE: Final = -2
_NONE: Final = -1
# Cells whose neighbourhood is rounder than this (deviation over the shorter extent) show no plane.
_ROUNDEST: Final = 0.5
# A neighbourhood must reach this far both ways, in sides of a cell, lest it be a line.
_NARROWEST: Final = 0.2
# Seeds are taken flattest first, in steps of this share of a cell.
_FLATNESS_STEP: Final = 1.0 / 2000.0
_MEAN_SHIFTS: Final = 12
# How often cells become twice as wide where neighbourhoods hold less than so many times the points
# that a normal needs.
_WIDENINGS: Final = 2
_THIN: Final = 3.0


@dataclass(frozen=True, kw_only=True)
class Growth:
    """When a cell joins a region.

    Attributes:
        angle_deg: largest angle between its normal and the region's.
        distance_m: largest distance of its middle from the region's plane; None asks for the
            normal alone, wherever the cell lies.
        least_points: groups by normal smaller than this are not looked for.
    """

    angle_deg: float
    distance_m: float | None
    least_points: float


@dataclass(frozen=True, kw_only=True)
class Regions:
    """Regions of cells.

    Attributes:
        cells: the cells.
        region_of_cell: (m,) int32, -1 for none.
        n_points: (r,) int64 points of each region.
        planes: of the regions with points enough, by region: total least squares through all
            their points, in the cloud's offsets.
        starts: the planes that most points of a region are near; the same where it is one layer.
    """

    cells: SurfaceCells
    region_of_cell: NDArray[np.int32]
    n_points: NDArray[np.int64]
    planes: dict[int, Plane]
    starts: dict[int, Plane]

    def region_of(self, points: BlockedPoints) -> NDArray[np.int32]:
        """(n,) region of each point, -1 for none."""
        cell_of = self.cells.cell_of(points)
        return np.where(cell_of >= 0, self.region_of_cell[cell_of], np.int32(_NONE))


def grow(cells: SurfaceCells, growth: Growth, viewer_m: NDArray[np.float64]) -> Regions:
    """Join cells to regions.

    Args:
        cells: the cells with their normals.
        growth: when a cell joins.
        viewer_m: (3,) from where normals are told from their opposites when the normal alone
            counts, in the cloud's offsets.
    """
    if growth.distance_m is None:
        region_of_cell, n_regions = _grouped(cells, growth, viewer_m)
    else:
        region_of_cell, n_regions = _grown(cells, growth, growth.distance_m)
    sums = np.zeros((n_regions, 10))
    sum_regions(cells.places, cells.sums, region_of_cell, sums)
    n_points = sums[:, 0].astype(np.int64)
    planes = {
        int(region): plane
        for region in np.flatnonzero(n_points >= growth.least_points)
        if (plane := _plane(sums[region], cells)) is not None
    }
    starts = planes
    if growth.distance_m is None:
        starts = {
            region: _densest(cells, region_of_cell == region, plane)
            for region, plane in planes.items()
        }
    return Regions(
        cells=cells,
        region_of_cell=region_of_cell,
        n_points=n_points,
        planes=planes,
        starts=starts,
    )


def _grown(cells: SurfaceCells, growth: Growth, distance_m: float) -> tuple[NDArray[np.int32], int]:
    """Grow regions; where the cloud is thin, those of wider cells among what they leave."""
    regions, n_regions = _grown_once(cells, growth, distance_m)
    crumbs = np.flatnonzero(_is_crumb(cells, regions, growth))
    cells_left = cells
    for _ in range(_WIDENINGS):
        n_left = cells_left.counts[crumbs]
        if n_left.sum() < growth.least_points or not _is_thin(cells_left, n_left):
            break
        step = coarser(cells_left, crumbs)
        found, n_found = _grown_once(step.cells, growth, distance_m)
        if cells_left is cells:
            wide_of_cell = np.full(len(regions), -1)
            wide_of_cell[crumbs] = step.of_member
        else:
            of_wide = np.full(len(cells_left.counts), -1)
            of_wide[crumbs] = step.of_member
            wide_of_cell = np.where(wide_of_cell >= 0, of_wide[wide_of_cell], -1)
        is_crumb = _is_crumb(step.cells, found, growth)
        joins = (wide_of_cell >= 0) & ~is_crumb[wide_of_cell]
        regions[joins] = n_regions + found[wide_of_cell[joins]]
        n_regions += n_found
        cells_left, crumbs = step.cells, np.flatnonzero(is_crumb)
    return regions, n_regions


def _is_crumb(cells: SurfaceCells, regions: NDArray[np.int32], growth: Growth) -> NDArray[np.bool_]:
    """(m,) whether cells are in no region, or in one with too few points to be looked at."""
    n_points = np.bincount(regions + 1, cells.counts)
    too_few = n_points < growth.least_points
    too_few[0] = True
    return np.asarray(too_few[regions + 1])


def _is_thin(cells: SurfaceCells, counts: NDArray[np.int64]) -> bool:
    """Whether neighbourhoods of cells with these counts hold few points for a normal."""
    in_neighbourhood = float(counts.mean()) * cells.neighbourhood.width_cells() ** 2
    return in_neighbourhood < _THIN * POINTS_LEAST


def _grown_once(
    cells: SurfaceCells, growth: Growth, distance_m: float
) -> tuple[NDArray[np.int32], int]:
    reach = distance_m / cells.grid.cell_m
    deviation, width = cells.spreads[:, 0], cells.spreads[:, 1]
    may_join = (deviation <= reach) & (deviation <= _ROUNDEST * width) & (width > _NARROWEST)
    regions = np.where(may_join, np.int32(_FREE), np.int32(_NONE))
    seeds = np.flatnonzero(may_join)
    # Sixteen bits, so that the sort takes no comparisons.
    flatness = np.minimum(deviation[seeds] / _FLATNESS_STEP, 65535.0).astype(np.uint16)
    n_regions = grow_regions(
        cells.places,
        cells.bricks,
        cells.numbers,
        cells.sums,
        cells.normals,
        seeds[np.argsort(flatness, kind="stable")],
        np.array([math.cos(math.radians(growth.angle_deg)), reach]),
        regions,
    )
    return regions, n_regions


def _grouped(
    cells: SurfaceCells, growth: Growth, viewer_m: NDArray[np.float64]
) -> tuple[NDArray[np.int32], int]:
    """Take the direction that most points share, then that of the rest, and so on."""
    usable = (cells.spreads[:, 0] <= _ROUNDEST * cells.spreads[:, 1]) & (cells.counts >= 1)
    usable &= cells.spreads[:, 1] > _NARROWEST
    normals = facing(cells, viewer_m)
    regions = np.full(len(normals), _NONE, dtype=np.int32)
    free = np.flatnonzero(usable)
    cosine = math.cos(math.radians(growth.angle_deg))
    n_regions = 0
    while len(free):
        weights = cells.counts[free].astype(np.float64)
        direction = _common_direction(normals[free], weights, growth.angle_deg)
        within = normals[free] @ direction >= cosine
        if weights[within].sum() < growth.least_points:
            break
        regions[free[within]] = n_regions
        n_regions += 1
        free = free[~within]
    return regions, n_regions


def facing(cells: SurfaceCells, viewer_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """(m, 3) normals of the cells along e1, e2, up, each towards the viewer."""
    to_viewer = cells.grid.basis @ viewer_m - cells.centroids()
    normals: NDArray[np.float64] = cells.normals.astype(np.float64)
    signs = np.where(np.einsum("ij,ij->i", normals, to_viewer) < 0.0, -1.0, 1.0)
    normals *= signs[:, None]
    return normals


def _common_direction(
    normals: NDArray[np.float64], weights: NDArray[np.float64], angle_deg: float
) -> NDArray[np.float64]:
    """The fullest bin of directions, moved to the mean of those within the angle."""
    step = 2.0 * math.sin(0.5 * math.radians(max(angle_deg, 0.5)))
    bins = np.round(normals / step).astype(np.int64) + 4096
    keys, bin_of = np.unique(
        (bins[:, 0] * 8192 + bins[:, 1]) * 8192 + bins[:, 2], return_inverse=True
    )
    fullest = int(np.argmax(np.bincount(bin_of, weights, minlength=len(keys))))
    direction = _unit_mean(normals, weights * (bin_of == fullest))
    cosine = math.cos(math.radians(angle_deg))
    for _ in range(_MEAN_SHIFTS):
        moved = _unit_mean(normals, weights * (normals @ direction >= cosine))
        if float(moved @ direction) > 1.0 - 1e-12:
            break
        direction = moved
    return direction


def _unit_mean(normals: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    total = weights @ normals
    mean: NDArray[np.float64] = total / max(float(np.linalg.norm(total)), 1e-12)
    return mean


def _plane(sums: NDArray[np.float64], cells: SurfaceCells) -> Plane | None:
    """Total least squares through the points of a region; in the cloud's offsets."""
    mean = sums[1:4] / sums[0]
    second = np.array(
        [[sums[4], sums[5], sums[6]], [sums[5], sums[7], sums[8]], [sums[6], sums[8], sums[9]]]
    )
    variances, directions = np.linalg.eigh(second / sums[0] - np.outer(mean, mean))
    if variances[1] <= 0.0:
        return None
    basis, side_m = cells.grid.basis, cells.grid.cell_m
    # Sums count from the middle of the first cell.
    middle_m = (cells.grid.low_m + side_m * (mean + 0.5)) @ basis
    normal = directions[:, 0] @ basis
    normal /= np.linalg.norm(normal)
    return Plane(normal=normal, offset_m=float(normal @ middle_m))


def _densest(cells: SurfaceCells, member: NDArray[np.bool_], plane: Plane) -> Plane:
    """The plane in the mean direction of a group that most of its points are near."""
    basis, side_m = cells.grid.basis, cells.grid.cell_m
    weights = cells.counts[member].astype(np.float64)
    normals = cells.normals[member].astype(np.float64)
    rough = basis @ plane.normal
    best = int(np.argmax(np.abs(normals @ rough)))
    signs = np.where(normals @ normals[best] < 0.0, -1.0, 1.0)
    direction = _unit_mean(normals, weights * signs) @ basis
    along_m = cells.centroids()[member] @ basis @ direction
    low_m = float(along_m.min())
    bins = ((along_m - low_m) / side_m).astype(np.int64)
    fullest = int(np.argmax(np.bincount(bins, weights)))
    inside = bins == fullest
    offset_m = float(np.average(along_m[inside], weights=weights[inside]))
    return Plane(normal=direction, offset_m=offset_m)
