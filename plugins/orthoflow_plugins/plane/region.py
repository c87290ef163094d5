"""`plane.region`: regions grown over neighbouring points with like normals and a common plane."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

from pydantic import Field, model_validator

from orthoflow.sdk import Method, MetricSpec, StepContext
from orthoflow_plugins.plane.parameters import (
    DETECTOR_METRICS,
    DetectorIn,
    DetectorOut,
    DetectorParams,
)

if TYPE_CHECKING:
    from orthoflow_plugins.plane.candidates import FoundPlane, Rules
    from orthoflow_plugins.plane.regions import RegionProposer, Regions
    from orthoflow_plugins.plane.sample import PreparedCloud, Unassigned
    from orthoflow_plugins.plane.surface_voxels import Neighbourhood

# What `preset: paper` sets where nothing else is said: markiewicz2015, 4.1.2.
_PAPER: Final[dict[str, object]] = {
    "criterion": "normal",
    "neighbourhood": "cube",
    "neighbourhood_m": 0.01,
    "cell_m": 0.01,
    "angle_deg": 1.0,
    "thinning": 10,
    "labels": "region",
    "stop_unclassified_share": 0.1,
}


class Region(Method):
    """Find planes by region growing on the normals of neighbourhoods, on all points.

    The points are summed into cells once; the sums of neighbouring cells give the normal of each
    neighbourhood. From the flattest cell on, neighbours join whose normal is like the region's and
    whose middle is near its plane, which is fitted anew as the region grows. The planes of the
    regions, largest first, then go the way of every detector: refined on a sample, fitted to all
    points, parts of one plane joined, points labelled by the plane they are near.

    `criterion: normal` asks for the normal alone, wherever a cell lies, as in markiewicz2015; with
    `labels: region` a niche then belongs to its wall, whatever its depth. `preset: paper` sets both
    and the other values of that paper (a cube of 10 mm, 1 degree, every 10th point, an end at 10 %
    unclassified), each of which can still be set otherwise.

    Where the cloud is so thin that a neighbourhood would hold too few points, it is enlarged;
    `neighbourhood_mm` says to what. `normal_scatter_deg` says how far the normals of the first
    plane lie apart: an `angle_deg` below it leaves crumbs.
    """

    id = "plane.region"
    result_version = 5
    determinism = "exact"
    metrics = (
        *DETECTOR_METRICS,
        MetricSpec("n_regions", label="regions grown"),
        MetricSpec("neighbourhood_mm", label="radius of a neighbourhood"),
        MetricSpec("cell_mm", label="side of a surface cell"),
        MetricSpec("normal_scatter_deg", label="scatter of the normals"),
    )
    citations = (
        (
            "Markiewicz, Podlasiak, Zawieska 2015: A New Approach to the Generation of Orthoimages "
            "of Cultural Heritage Objects. Remote Sensing 7(12), doi:10.3390/rs71215869"
        ),
        (
            "Rabbani, van den Heuvel, Vosselman 2006: Segmentation of point clouds using "
            "smoothness constraint. ISPRS Archives 36(5)"
        ),
    )

    class Params(DetectorParams):
        """What may be set; the defaults suit rooms and facades scanned at millimetres."""

        preset: Literal["none", "paper"] = Field(
            "none", description="Values to begin with: those above, or those of markiewicz2015."
        )
        neighbourhood: Literal["cube", "radius", "knn"] = Field(
            "cube",
            description="From which points a normal is taken: a cube, a sphere, or the nearest "
            "cells that hold `n_neighbours` points.",
        )
        neighbourhood_m: Annotated[float, Field(gt=0.0, le=2.0)] | Literal["auto"] = Field(
            "auto",
            description="Side of the cube, radius of the sphere, metres. auto: 0.1, or three times "
            "the tolerance of the fit where that is more: normals need room beyond the noise.",
        )
        n_neighbours: int = Field(
            30, ge=3, le=100_000, description="Points of a neighbourhood for knn."
        )
        cell_m: float | None = Field(
            None,
            gt=0.0,
            le=1.0,
            description="Side of the cells that grow together; a third of the cube's side, half of "
            "the sphere's radius, a third of `neighbourhood_m` for knn unless given.",
        )
        criterion: Literal["normal-and-distance", "normal"] = Field(
            "normal-and-distance",
            description="What must be like the region's: the normal and the distance, or the "
            "normal alone, wherever the points lie.",
        )
        angle_deg: float = Field(
            10.0, gt=0.0, le=45.0, description="Largest angle between a normal and the region's."
        )
        distance_m: Annotated[float, Field(gt=0.0)] | Literal["auto"] = Field(
            "auto",
            description="Largest distance of a cell's middle from the region, metres. auto: 0.015, "
            "or half the tolerance of the fit where that is more.",
        )
        labels: Literal["plane", "region"] = Field(
            "plane",
            description="What labels a point: the plane it is near, or the region it is in.",
        )

        @model_validator(mode="before")
        @classmethod
        def _preset_fills_in(cls, given: Any) -> Any:
            # Any: what a user wrote, before it is checked.
            if isinstance(given, dict) and given.get("preset") == "paper":
                return {**_PAPER, **given}
            return given

    In = DetectorIn
    Out = DetectorOut

    def run(self, inputs: DetectorIn, params: Params, ctx: StepContext) -> DetectorOut:
        """Detect the planes of a cloud."""
        from orthoflow_plugins.plane.assembling import middle_viewpoint_m
        from orthoflow_plugins.plane.detecting import Detector, detect
        from orthoflow_plugins.plane.regions import (
            PART_SHARE,
            Growth,
            RegionProposer,
            claim_by_region,
            grow,
        )
        from orthoflow_plugins.plane.search_figures import draw_normals
        from orthoflow_plugins.plane.surface_voxels import surface_voxels

        by_normal = params.criterion == "normal"
        grown: list[Regions] = []

        def proposer_of(
            cloud: PreparedCloud, unassigned: Unassigned, rules: Rules
        ) -> RegionProposer:
            growth = Growth(
                angle_deg=params.angle_deg,
                distance_m=None if by_normal else _distance_m(params, rules),
                least_points=PART_SHARE * rules.least_share * len(cloud.claims),
            )
            voxels = surface_voxels(cloud, _neighbourhood(params, rules))
            ctx.progress(0.1, "growing regions")
            viewer_m = middle_viewpoint_m(inputs.cloud, cloud.sample.offsets_m)
            regions = grow(voxels, growth, viewer_m)
            grown.append(regions)
            return RegionProposer(
                regions=regions,
                region_of_sample=regions.region_of(unassigned.sample.points),
                family=params.family,
                tilt_most_deg=params.max_tilt_deg,
                least_points=rules.least_share * len(unassigned.claims),
                proposes_once=by_normal,
            )

        def relabel(found: list[FoundPlane], cloud: PreparedCloud) -> None:
            if params.labels == "region":
                claim_by_region(found, grown[0], cloud)

        detector = Detector(method=self.id, proposer_of=proposer_of, relabel=relabel)
        detection = detect(inputs.cloud, params, ctx, detector)
        draw_normals(ctx, grown[0], detection.planes, inputs.cloud)
        return DetectorOut(planes=detection.planes, labels=detection.labels)


def _distance_m(params: Region.Params, rules: Rules) -> float:
    return max(0.015, 0.5 * rules.fit_m) if params.distance_m == "auto" else params.distance_m


def _neighbourhood(params: Region.Params, rules: Rules) -> Neighbourhood:
    from orthoflow_plugins.plane.surface_voxels import Neighbourhood

    given = params.neighbourhood_m
    size_m = min(2.0, max(0.1, 3.0 * rules.fit_m)) if given == "auto" else given
    share = 0.5 if params.neighbourhood == "radius" else 1.0 / 3.0
    voxel_m = share * size_m if params.cell_m is None else params.cell_m
    return Neighbourhood(
        shape=params.neighbourhood,
        size_m=size_m,
        n_points=params.n_neighbours,
        voxel_m=voxel_m,
    )
