"""Regions of voxels: grown over neighbours or grouped by normals alone, and proposed as planes.

The region with most free points comes first. A point may also be labelled by its region.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane
from orthoflow_plugins.plane.candidates import Candidate, Family, FoundPlane
from orthoflow_plugins.plane.kernels import BlockedPoints
from orthoflow_plugins.plane.sample import PreparedCloud, Unassigned
from orthoflow_plugins.plane.surface_voxels import POINTS_LEAST, SurfaceVoxels, coarser
from orthoflow_plugins.plane.voxel_kernels import grow_regions, sum_regions

# Parts of a wall are regions of their own: together they may hold what each alone does not.
PART_SHARE: Final = 0.2
# A region's plane may lean by this much more than what is looked for; the fit decides.
_LEAN_CAUTION_DEG: Final = 3.0
_FREE: Final = -2
_NONE: Final = -1
# Voxels whose neighbourhood is rounder than this (deviation over the shorter extent) show no plane.
_ROUNDEST: Final = 0.5
# A neighbourhood must reach this far both ways, in sides of a voxel, lest it be a line.
_NARROWEST: Final = 0.2
# Seeds are taken flattest first, in steps of this share of a voxel.
_FLATNESS_STEP: Final = 1.0 / 2000.0
_MEAN_SHIFTS: Final = 12
# How often voxels become twice as wide where neighbourhoods hold less than so many times the points
# that a normal needs.
_WIDENINGS: Final = 2
_THIN: Final = 3.0


@dataclass(frozen=True, kw_only=True)
class Growth:
    """When a voxel joins a region.

    Attributes:
        angle_deg: largest angle between its normal and the region's.
        distance_m: largest distance of its middle from the region's plane; None asks for the
            normal alone, wherever the voxel lies.
        least_points: groups by normal smaller than this are not looked for.
    """

    angle_deg: float
    distance_m: float | None
    least_points: float


@dataclass(frozen=True, kw_only=True)
class Regions:
    """Regions of voxels.

    Attributes:
        voxels: the voxels.
        region_of_voxel: (m,) int32, -1 for none.
        n_points: (r,) int64 points of each region.
        planes: of the regions with points enough, by region: total least squares through all
            their points, in the cloud's offsets.
        starts: the planes that most points of a region are near; the same where it is one layer.
    """

    voxels: SurfaceVoxels
    region_of_voxel: NDArray[np.int32]
    n_points: NDArray[np.int64]
    planes: dict[int, Plane]
    starts: dict[int, Plane]

    def region_of(self, points: BlockedPoints) -> NDArray[np.int32]:
        """(n,) region of each point, -1 for none."""
        voxel_of = self.voxels.voxel_of(points)
        return np.where(voxel_of >= 0, self.region_of_voxel[voxel_of], np.int32(_NONE))


def grow(voxels: SurfaceVoxels, growth: Growth, viewer_m: NDArray[np.float64]) -> Regions:
    """Join voxels to regions.

    Args:
        voxels: the voxels with their normals.
        growth: when a voxel joins.
        viewer_m: (3,) from where normals are told from their opposites when the normal alone
            counts, in the cloud's offsets.
    """
    if growth.distance_m is None:
        region_of_voxel, n_regions = _grouped(voxels, growth, viewer_m)
    else:
        region_of_voxel, n_regions = _grown(voxels, growth, growth.distance_m)
    sums = np.zeros((n_regions, 10))
    sum_regions(voxels.places, voxels.sums, region_of_voxel, sums)
    n_points = sums[:, 0].astype(np.int64)
    planes = {
        int(region): plane
        for region in np.flatnonzero(n_points >= growth.least_points)
        if (plane := _plane(sums[region], voxels)) is not None
    }
    starts = planes
    if growth.distance_m is None:
        starts = {
            region: _densest(voxels, region_of_voxel == region, plane)
            for region, plane in planes.items()
        }
    return Regions(
        voxels=voxels,
        region_of_voxel=region_of_voxel,
        n_points=n_points,
        planes=planes,
        starts=starts,
    )


@dataclass(kw_only=True)
class RegionProposer:
    """Proposes the planes of regions.

    Attributes:
        regions: the regions, grown on all points.
        region_of_sample: (s,) region of each point of the sample, -1 for none.
        family: which planes are looked for.
        tilt_most_deg: how far they may be off vertical or level.
        least_points: of the sample, that a plane needs.
        proposes_once: a region has one plane, also where many of its points lie off it.
    """

    regions: Regions
    region_of_sample: NDArray[np.int32]
    family: Family
    tilt_most_deg: float
    least_points: float
    proposes_once: bool
    _barred: set[int] = field(default_factory=set)
    _last: int = -1

    def propose(self, unassigned: Unassigned) -> Candidate | None:
        """Name the plane of the region with most free points."""
        free = self.region_of_sample[(unassigned.claims < 0) & (self.region_of_sample >= 0)]
        counts = np.bincount(free, minlength=len(self.regions.n_points))
        for region in np.argsort(-counts, kind="stable").tolist():
            if counts[region] < PART_SHARE * self.least_points:
                return None
            plane = self.regions.planes.get(region)
            if plane is None or region in self._barred:
                continue
            if self._leans_too_much(float(plane.normal @ unassigned.up)):
                self._barred.add(region)
                continue
            if self.proposes_once:
                self._barred.add(region)
            self._last = region
            return Candidate(
                plane=plane,
                family=self.family,
                votes=float(self.regions.n_points[region]),
                start=self.regions.starts[region],
            )
        return None

    def reject(self, candidate: Candidate) -> None:
        """Do not name the last region again."""
        del candidate
        self._barred.add(self._last)

    def _leans_too_much(self, rise: float) -> bool:
        tilt_deg = math.degrees(math.asin(min(1.0, abs(rise))))
        limit_deg = self.tilt_most_deg + _LEAN_CAUTION_DEG
        if self.family == "wall":
            return tilt_deg > limit_deg
        return self.family == "level" and tilt_deg < 90.0 - limit_deg


def claim_by_region(found: list[FoundPlane], regions: Regions, cloud: PreparedCloud) -> None:
    """Give each point to the plane of its region instead of the plane it is near.

    A region belongs to the plane that most of its points are near, if more than half of them are
    near any; the claims of the cloud say which those are.
    """
    claims = cloud.sample_claims
    region_of = regions.region_of_voxel
    region_of_sample = regions.region_of(cloud.sample.points)
    near = (region_of_sample >= 0) & (claims >= 0)
    n_regions = len(regions.n_points)
    joint = np.zeros((n_regions, len(found)), dtype=np.int64)
    np.add.at(joint, (region_of_sample[near], claims[near]), 1)
    n_sampled = np.bincount(region_of_sample[region_of_sample >= 0], minlength=n_regions)
    owner = np.where(joint.sum(axis=1) * 2 > n_sampled, joint.argmax(axis=1), -1)
    # The last entry stands for voxels in no region: a region of -1 picks it.
    owners = np.append(owner, -1).astype(np.int8)[region_of]
    regions.voxels.claim(cloud, owners)


def _grown(
    voxels: SurfaceVoxels, growth: Growth, distance_m: float
) -> tuple[NDArray[np.int32], int]:
    """Grow regions; where the cloud is thin, those of wider voxels among what they leave."""
    regions, n_regions = _grown_once(voxels, growth, distance_m)
    crumbs = np.flatnonzero(_is_crumb(voxels, regions, growth))
    voxels_left = voxels
    for _ in range(_WIDENINGS):
        n_left = voxels_left.counts[crumbs]
        if n_left.sum() < growth.least_points or not _is_thin(voxels_left, n_left):
            break
        step = coarser(voxels_left, crumbs)
        found, n_found = _grown_once(step.voxels, growth, distance_m)
        if voxels_left is voxels:
            wide_of_voxel = np.full(len(regions), -1)
            wide_of_voxel[crumbs] = step.of_member
        else:
            of_wide = np.full(len(voxels_left.counts), -1)
            of_wide[crumbs] = step.of_member
            wide_of_voxel = np.where(wide_of_voxel >= 0, of_wide[wide_of_voxel], -1)
        is_crumb = _is_crumb(step.voxels, found, growth)
        joins = (wide_of_voxel >= 0) & ~is_crumb[wide_of_voxel]
        regions[joins] = n_regions + found[wide_of_voxel[joins]]
        n_regions += n_found
        voxels_left, crumbs = step.voxels, np.flatnonzero(is_crumb)
    return regions, n_regions


def _is_crumb(
    voxels: SurfaceVoxels, regions: NDArray[np.int32], growth: Growth
) -> NDArray[np.bool_]:
    """(m,) whether voxels are in no region, or in one with too few points to be looked at."""
    n_points = np.bincount(regions + 1, voxels.counts)
    too_few = n_points < growth.least_points
    too_few[0] = True
    return np.asarray(too_few[regions + 1])


def _is_thin(voxels: SurfaceVoxels, counts: NDArray[np.int64]) -> bool:
    """Whether neighbourhoods of voxels with these counts hold few points for a normal."""
    in_neighbourhood = float(counts.mean()) * voxels.neighbourhood.width_voxels() ** 2
    return in_neighbourhood < _THIN * POINTS_LEAST


def _grown_once(
    voxels: SurfaceVoxels, growth: Growth, distance_m: float
) -> tuple[NDArray[np.int32], int]:
    reach = distance_m / voxels.grid.cell_m
    deviation, width = voxels.spreads[:, 0], voxels.spreads[:, 1]
    may_join = (deviation <= reach) & (deviation <= _ROUNDEST * width) & (width > _NARROWEST)
    regions = np.where(may_join, np.int32(_FREE), np.int32(_NONE))
    seeds = np.flatnonzero(may_join)
    # Sixteen bits, so that the sort takes no comparisons.
    flatness = np.minimum(deviation[seeds] / _FLATNESS_STEP, 65535.0).astype(np.uint16)
    n_regions = grow_regions(
        voxels.places,
        voxels.bricks,
        voxels.numbers,
        voxels.sums,
        voxels.normals,
        seeds[np.argsort(flatness, kind="stable")],
        np.array([math.cos(math.radians(growth.angle_deg)), reach]),
        regions,
    )
    return regions, n_regions


def _grouped(
    voxels: SurfaceVoxels, growth: Growth, viewer_m: NDArray[np.float64]
) -> tuple[NDArray[np.int32], int]:
    """Take the direction that most points share, then that of the rest, and so on."""
    usable = (voxels.spreads[:, 0] <= _ROUNDEST * voxels.spreads[:, 1]) & (voxels.counts >= 1)
    usable &= voxels.spreads[:, 1] > _NARROWEST
    normals = facing(voxels, viewer_m)
    regions = np.full(len(normals), _NONE, dtype=np.int32)
    free = np.flatnonzero(usable)
    cosine = math.cos(math.radians(growth.angle_deg))
    n_regions = 0
    while len(free):
        weights = voxels.counts[free].astype(np.float64)
        direction = _common_direction(normals[free], weights, growth.angle_deg)
        within = normals[free] @ direction >= cosine
        if weights[within].sum() < growth.least_points:
            break
        regions[free[within]] = n_regions
        n_regions += 1
        free = free[~within]
    return regions, n_regions


def facing(voxels: SurfaceVoxels, viewer_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """(m, 3) normals of the voxels along e1, e2, up, each towards the viewer."""
    to_viewer = voxels.grid.basis @ viewer_m - voxels.centroids()
    normals: NDArray[np.float64] = voxels.normals.astype(np.float64)
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
    return total / max(float(np.linalg.norm(total)), 1e-12)


def _plane(sums: NDArray[np.float64], voxels: SurfaceVoxels) -> Plane | None:
    """Total least squares through the points of a region; in the cloud's offsets."""
    mean = sums[1:4] / sums[0]
    second = np.array(
        [[sums[4], sums[5], sums[6]], [sums[5], sums[7], sums[8]], [sums[6], sums[8], sums[9]]]
    )
    variances, directions = np.linalg.eigh(second / sums[0] - np.outer(mean, mean))
    if variances[1] <= 0.0:
        return None
    basis, side_m = voxels.grid.basis, voxels.grid.cell_m
    # Sums count from the middle of the first voxel.
    middle_m = (voxels.grid.low_m + side_m * (mean + 0.5)) @ basis
    normal = directions[:, 0] @ basis
    normal /= np.linalg.norm(normal)
    return Plane(normal=normal, offset_m=float(normal @ middle_m))


def _densest(voxels: SurfaceVoxels, member: NDArray[np.bool_], plane: Plane) -> Plane:
    """The plane in the mean direction of a group that most of its points are near."""
    basis, side_m = voxels.grid.basis, voxels.grid.cell_m
    weights = voxels.counts[member].astype(np.float64)
    normals = voxels.normals[member].astype(np.float64)
    rough = basis @ plane.normal
    best = int(np.argmax(np.abs(normals @ rough)))
    signs = np.where(normals @ normals[best] < 0.0, -1.0, 1.0)
    direction = _unit_mean(normals, weights * signs) @ basis
    along_m = voxels.centroids()[member] @ basis @ direction
    low_m = float(along_m.min())
    bins = ((along_m - low_m) / side_m).astype(np.int64)
    fullest = int(np.argmax(np.bincount(bins, weights)))
    inside = bins == fullest
    offset_m = float(np.average(along_m[inside], weights=weights[inside]))
    return Plane(normal=direction, offset_m=offset_m)
