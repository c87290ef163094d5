"""`plane.region`: regions of neighbouring points with similar normals on a common plane.

Regions consist of voxels. They are grown over neighbouring voxels, or formed by grouping normals
alone. The region with the most unassigned points is proposed first. Points can also be labelled by
their region.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from orthoflow.geometry import Plane
from orthoflow.products import Planes, PointCloud
from orthoflow.sdk import MetricSpec, StepContext
from orthoflow_plugins.plane.detector import DETECTOR_METRICS, PAPER, Detector
from orthoflow_plugins.plane.proposing import (
    Candidate,
    DetectorParams,
    Proposer,
    leans_as_asked,
)

if TYPE_CHECKING:
    from orthoflow_plugins.plane.cloud import PreparedCloud
    from orthoflow_plugins.plane.fit import FoundPlane
    from orthoflow_plugins.plane.search import Search
    from orthoflow_plugins.plane.voxels import Neighbourhood, SurfaceVoxels, VoxelTable

# Values that `preset: paper` gives to parameters that are not set (markiewicz2015, 4.1.2).
_PAPER_PRESET: Final[dict[str, object]] = {
    "criterion": "normal",
    "neighbourhood": "cube",
    "neighbourhood_m": 0.01,
    "cell_m": 0.01,
    "angle_deg": 1.0,
    "thinning": 10,
    "labels": "region",
    "stop_unclassified_share": 0.1,
}
# Number of points in a neighbourhood for `knn`.
_N_NEAREST: Final = 30
# Maximum distance of a voxel's centroid from the plane of a region; it is larger if the noise is
# high.
_DISTANCE_M: Final = 0.015
# Minimum number of points of a region, as a share of the required number. It is low because the
# parts of a wall are separate regions, which may have enough points only together.
_PART_SHARE: Final = 0.2
# Additional tilt that is tolerated for the plane of a region, because the fit may reduce the tilt.
_LEAN_CAUTION_DEG: Final = 3.0
# Values for voxels in no region: _FREE if they may be added to a region, _NONE if not.
_FREE: Final = -2
_NONE: Final = -1
# Maximum ratio of the deviation from the plane of a neighbourhood to the shorter extent of the
# neighbourhood.
_ROUNDEST: Final = 0.5
# Minimum width of a neighbourhood, in sides of a voxel; a narrower neighbourhood is a line.
_NARROWEST: Final = 0.2
# Seeds are sorted by flatness, in steps of this share of a voxel's side.
_FLATNESS_STEP: Final = 1.0 / 2000.0
_MEAN_SHIFTS: Final = 12
# Maximum number of times that the width of voxels is doubled. It is doubled if neighbourhoods have
# fewer than _THIN times the number of points needed for a normal.
_WIDENINGS: Final = 2
_THIN: Final = 3.0


class Region(Detector):
    """Find planes by region growing with the normals of neighbourhoods, using all points.

    The points are summed in voxels once; the sums of neighbouring voxels give the normal of each
    neighbourhood. Starting from the flattest voxel, a region grows by adding neighbours whose
    normals are similar to the normal of the region and whose centroids are near its plane. This
    plane is refitted as the region grows. The planes of the regions, largest first, are then
    processed as for all detectors: they are refined on a sample and fitted to all points, parts of
    the same plane are joined, and points are labelled by the nearest plane.

    With `criterion: normal`, only the normals of voxels are used, not their positions, as in
    markiewicz2015; with `labels: region`, a niche of any depth then belongs to its wall. `preset:
    paper` sets both options and the other values of that paper (a cube of 10 mm, 1 degree, every
    10th point, and a stop when 10 % of the points are unclassified). Each value can be overridden.

    If neighbourhoods would have too few points because the cloud is sparse, they are enlarged;
    `neighbourhood_mm` reports their size. `normal_scatter_deg` reports the scatter of the normals
    of the first plane; if `angle_deg` is smaller than this, planes are split into fragments.
    """

    id = "plane.region"
    determinism = "exact"
    metrics = (
        *DETECTOR_METRICS,
        MetricSpec("n_regions", label="regions grown"),
        MetricSpec("neighbourhood_mm", label="radius of a neighbourhood"),
        MetricSpec("cell_mm", label="cell size"),
        MetricSpec("normal_scatter_deg", label="scatter of the normals"),
    )
    citations = (
        PAPER,
        (
            "Rabbani, van den Heuvel, Vosselman 2006: Segmentation of point clouds using "
            "smoothness constraint. ISPRS Archives 36(5)"
        ),
    )

    class Params(DetectorParams):
        """Parameters; the defaults suit rooms and facades scanned with millimetre point spacing."""

        preset: Literal["none", "paper"] = Field(
            "none",
            description="Default values of the other parameters. none: those of this table; "
            "paper: those of markiewicz2015.",
        )
        neighbourhood: Literal["cube", "radius", "knn"] = Field(
            "cube",
            description="Points from which a normal is computed. cube: those in a cube; radius: "
            "in a sphere; knn: in the nearest cells that together contain 30 points.",
        )
        neighbourhood_m: Annotated[float, Field(gt=0.0, le=2.0)] | Literal["auto"] = Field(
            "auto",
            description="Side of the cube or radius of the sphere, metres. auto: 0.1, or three "
            "times the tolerance of the fit if that is more, because noise must not dominate "
            "the normals.",
        )
        cell_m: float | None = Field(
            None,
            gt=0.0,
            le=1.0,
            description="Cell size; by default a third of the side of the cube, half the radius "
            "of the sphere, or, for knn, a third of `neighbourhood_m`.",
        )
        criterion: Literal["normal-and-distance", "normal"] = Field(
            "normal-and-distance",
            description="Criterion for adding cells to a region. normal-and-distance: normal and "
            "distance from its plane; normal: only the normal.",
        )
        angle_deg: float = Field(
            10.0,
            gt=0.0,
            le=45.0,
            description="Maximum angle between the normal of a cell and that of the region.",
        )
        labels: Literal["plane", "region"] = Field(
            "plane",
            description="Labels of points. plane: the nearest plane; region: the region that "
            "contains the point.",
        )

        @model_validator(mode="before")
        @classmethod
        def _preset_fills_in(cls, given: Any) -> Any:
            # The type is Any, because the user's input has not been validated yet.
            if isinstance(given, dict) and given.get("preset") == "paper":
                return {**_PAPER_PRESET, **given}
            return given

        def neighbourhood_of(self, fit_tolerance_m: float) -> Neighbourhood:
            """Return the neighbourhood for normals, given the tolerance of the fit."""
            from orthoflow_plugins.plane.voxels import Neighbourhood

            auto_m = min(2.0, max(0.1, 3.0 * fit_tolerance_m))
            size_m = auto_m if self.neighbourhood_m == "auto" else self.neighbourhood_m
            share = 0.5 if self.neighbourhood == "radius" else 1.0 / 3.0
            return Neighbourhood(
                shape=self.neighbourhood,
                size_m=size_m,
                n_points=_N_NEAREST,
                voxel_m=share * size_m if self.cell_m is None else self.cell_m,
            )

    def proposer(self, search: Search, params: Params, ctx: StepContext) -> RegionProposer:
        """Return a proposer that grows the regions of the cloud."""
        ctx.progress(0.1, "growing regions")
        return RegionProposer(search, params)


class RegionProposer(Proposer):
    """Proposes the planes of regions; the regions are grown using all points.

    Attributes:
        n_points: (r,) int64 number of points in each region.
        planes: total least squares planes, in the cloud's offsets, of the regions with enough
            points, by region.
    """

    def __init__(self, search: Search, params: Region.Params) -> None:
        """Grow regions using all points of the cloud of a search."""
        from orthoflow_plugins.plane.voxels import surface_voxels

        cloud, self._params = search.cloud, params
        self._voxels = surface_voxels(cloud, params.neighbourhood_of(search.cloud.fit_tolerance_m))
        least_points = _PART_SHARE * params.min_share * len(cloud.claims)
        if params.criterion == "normal":
            regions = _grouped(self._voxels, params.angle_deg, least_points, cloud.viewpoint_m)
        else:
            # Increase the distance for noisy clouds, so that noise does not exclude voxels from
            # their plane.
            distance_m = max(_DISTANCE_M, 0.5 * search.cloud.fit_tolerance_m)
            regions = _grown(self._voxels, params.angle_deg, distance_m, least_points)
        self._region_of_voxel, n_regions = regions
        sums = self._voxels.table.sums_of(self._region_of_voxel, n_regions)
        self.n_points = sums[:, 0].astype(np.int64)
        self.planes = {
            int(region): plane
            for region in np.flatnonzero(self.n_points >= least_points)
            if (plane := _plane(sums[region], self._voxels.table)) is not None
        }
        self._region_of_sample = self._region_of(cloud)
        self._barred: set[int] = set()
        self._last = -1

    def _region_of(self, cloud: PreparedCloud) -> NDArray[np.int32]:
        from orthoflow_plugins.plane.cloud import blocked

        # The last entry is for points in no voxel.
        regions = np.append(self._region_of_voxel, np.int32(_NONE))
        return regions[self._voxels.table.voxel_of(blocked(cloud.sample.offsets_m))]

    def propose(self, search: Search) -> Candidate | None:
        """Return the plane of the region with the most unassigned points."""
        free = self._region_of_sample[search.is_free & (self._region_of_sample >= 0)]
        counts = np.bincount(free, minlength=len(self.n_points))
        constraint, by_normal = self._params.constraint, self._params.criterion == "normal"
        limit_deg = self._params.max_tilt_deg + _LEAN_CAUTION_DEG
        for region in np.argsort(-counts, kind="stable").tolist():
            if counts[region] < _PART_SHARE * search.least_points:
                break
            plane = self.planes.get(region)
            if plane is None or region in self._barred:
                continue
            leans = leans_as_asked(plane.normal[None], search.cloud.up, constraint, limit_deg).all()
            # If only normals are used, propose a region only once, because many of its points may
            # be off its plane and thus remain unassigned.
            if by_normal or not leans:
                self._barred.add(region)
            if leans:
                self._last = region
                member = self._region_of_voxel == region
                start = _densest(self._voxels, member, plane) if by_normal else None
                return Candidate(plane=plane, constraint=constraint, start=start)
        return None

    def reject(self) -> None:
        """Exclude the last region."""
        self._barred.add(self._last)

    def relabel(self, found: list[FoundPlane], cloud: PreparedCloud) -> None:
        """If requested, assign each point to the plane of its region instead of the nearest plane.

        The plane of a region is the one with the most points of the region, provided that more than
        half of its points are on any plane.
        """
        from orthoflow_plugins.plane.kernels import each_part, piece_of

        if self._params.labels == "plane":
            return
        claims, region_of_sample = cloud.sample_claims, self._region_of(cloud)
        near = (region_of_sample >= 0) & (claims >= 0)
        joint = np.zeros((len(self.n_points), len(found)), dtype=np.int64)
        np.add.at(joint, (region_of_sample[near], claims[near]), 1)
        n_sampled = np.bincount(region_of_sample[region_of_sample >= 0], minlength=len(joint))
        owner = np.where(joint.sum(axis=1) * 2 > n_sampled, joint.argmax(axis=1), -1)
        # The appended entries are for voxels in no region, and for points in no voxel.
        owners = np.append(np.append(owner, -1)[self._region_of_voxel], -1).astype(np.int8)

        def claim(_part: int, piece: slice) -> None:
            voxel_of_point = self._voxels.table.voxel_of(piece_of(cloud.points, piece))
            cloud.claims[piece] = owners[voxel_of_point]

        each_part(len(cloud.claims), cloud.parts, claim)

    def draw(self, ctx: StepContext, planes: Planes, cloud: PointCloud) -> None:
        """Report and draw the scatter of the normals."""
        from orthoflow_plugins.plane.figures import draw_normals

        draw_normals(ctx, self._voxels, len(self.planes), planes, cloud)


def _grown(
    voxels: SurfaceVoxels,
    angle_deg: float,
    distance_m: float,
    least_points: float,
    n_widenings: int = _WIDENINGS,
) -> tuple[NDArray[np.int32], int]:
    """Grow regions; in sparse parts of a cloud, use larger voxels.

    Returns:
        The region (m,) of each voxel, negative for voxels in no region; and the number of regions.
    """
    from orthoflow_plugins.plane.voxels import POINTS_LEAST, SurfaceVoxels, grow_regions

    table = voxels.table
    reach = distance_m / table.voxel_m
    deviation, width = voxels.spreads[:, 0], voxels.spreads[:, 1]
    may_join = (deviation <= reach) & (deviation <= _ROUNDEST * width) & (width > _NARROWEST)
    regions = np.where(may_join, np.int32(_FREE), np.int32(_NONE))
    seeds = np.flatnonzero(may_join)
    # Use 16-bit integers, which NumPy sorts by radix sort.
    flatness = np.minimum(deviation[seeds] / _FLATNESS_STEP, 65535.0).astype(np.uint16)
    n_regions = grow_regions(
        table.places,
        table.bricks,
        table.numbers,
        table.sums,
        voxels.normals,
        seeds[np.argsort(flatness, kind="stable")],
        np.array([math.cos(math.radians(angle_deg)), reach]),
        regions,
    )

    def small(own: NDArray[np.int32], counts: NDArray[np.int64]) -> NDArray[np.bool_]:
        is_small = np.bincount(own + 1, counts) < least_points
        return np.asarray(is_small[own + 1] | (own < 0))

    crumbs = np.flatnonzero(small(regions, voxels.counts))
    n_left = voxels.counts[crumbs]
    if n_widenings == 0 or n_left.sum() < least_points:
        return regions, n_regions
    if float(n_left.mean()) * voxels.neighbourhood.width_voxels() ** 2 >= _THIN * POINTS_LEAST:
        return regions, n_regions
    coarser, wide_of_crumb = table.coarser(crumbs)
    wider = SurfaceVoxels.of(coarser, voxels.neighbourhood, parts=1)
    own, n_wide = _grown(wider, angle_deg, distance_m, least_points, n_widenings - 1)
    joins = ~small(own, wider.counts)[wide_of_crumb]
    regions[crumbs[joins]] = n_regions + own[wide_of_crumb[joins]]
    return regions, n_regions + n_wide


def _grouped(
    voxels: SurfaceVoxels, angle_deg: float, least_points: float, viewer_m: NDArray[np.float64]
) -> tuple[NDArray[np.int32], int]:
    """Group voxels whose normals have the most frequent direction; repeat with remaining voxels."""
    usable = (voxels.spreads[:, 0] <= _ROUNDEST * voxels.spreads[:, 1]) & (voxels.counts >= 1)
    usable &= voxels.spreads[:, 1] > _NARROWEST
    # Make normals point towards the viewer.
    normals: NDArray[np.float64] = voxels.normals.astype(np.float64)
    to_viewer = voxels.table.basis @ viewer_m - voxels.table.centroids()
    normals *= np.where(np.einsum("ij,ij->i", normals, to_viewer) < 0.0, -1.0, 1.0)[:, None]
    regions = np.full(len(normals), _NONE, dtype=np.int32)
    free = np.flatnonzero(usable)
    cosine = math.cos(math.radians(angle_deg))
    n_regions = 0
    while len(free):
        weights = voxels.counts[free].astype(np.float64)
        direction = _common_direction(normals[free], weights, angle_deg)
        within = normals[free] @ direction >= cosine
        if weights[within].sum() < least_points:
            break
        regions[free[within]] = n_regions
        n_regions += 1
        free = free[~within]
    return regions, n_regions


def _common_direction(
    normals: NDArray[np.float64], weights: NDArray[np.float64], angle_deg: float
) -> NDArray[np.float64]:
    """Return the most frequent direction, by mean shift from the bin with the largest weight."""
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


def _plane(sums: NDArray[np.float64], table: VoxelTable) -> Plane | None:
    """Return the total least squares plane of a region's points, in the cloud's offsets."""
    mean = sums[1:4] / sums[0]
    second = sums[[[4, 5, 6], [5, 7, 8], [6, 8, 9]]]
    variances, directions = np.linalg.eigh(second / sums[0] - np.outer(mean, mean))
    if variances[1] <= 0.0:
        return None
    middle_m = (table.low_m + table.voxel_m * mean) @ table.basis
    normal = directions[:, 0] @ table.basis
    normal /= np.linalg.norm(normal)
    return Plane(normal=normal, offset_m=float(normal @ middle_m))


def _densest(voxels: SurfaceVoxels, member: NDArray[np.bool_], plane: Plane) -> Plane:
    """Return the plane with the mean normal of a group of voxels, through their densest layer."""
    table, weights = voxels.table, voxels.counts[member].astype(np.float64)
    normals = voxels.normals[member].astype(np.float64)
    best = int(np.argmax(np.abs(normals @ (table.basis @ plane.normal))))
    signs = np.where(normals @ normals[best] < 0.0, -1.0, 1.0)
    direction = _unit_mean(normals, weights * signs)
    along_m = table.centroids()[member] @ direction
    bins = ((along_m - float(along_m.min())) / table.voxel_m).astype(np.int64)
    inside = bins == int(np.argmax(np.bincount(bins, weights)))
    offset_m = float(np.average(along_m[inside], weights=weights[inside]))
    return Plane(normal=direction @ table.basis, offset_m=offset_m)
