"""`plane.hough3d`: planes in any direction from voxels that vote in a 3D accumulator."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field

from orthoflow.sdk import Method, StepContext
from orthoflow_plugins.plane.parameters import (
    DETECTOR_METRICS,
    DetectorIn,
    DetectorOut,
    DetectorParams,
)

if TYPE_CHECKING:
    from orthoflow_plugins.plane.candidates import Rules
    from orthoflow_plugins.plane.sample import PreparedCloud, Unassigned
    from orthoflow_plugins.plane.space_accumulators import SpaceProposer


class Hough3d(Method):
    """Find planes by the 3D Hough transform of markiewicz2015: voxels vote with their points.

    r = x cos(phi) cos(omega) + y cos(phi) sin(omega) + z sin(phi). For each omega the voxels are
    first counted in an upright image, whose occupied cells then vote over phi. Directions are even
    over the hemisphere, so that a floor is counted once and not for every omega.

    `search: coarse-to-fine` votes with twice `cell_m` and twice `angle_step_deg` and looks finer
    around each maximum only; `full` votes with both as they are. What follows is common to all
    detectors: refined on a sample, fitted to all points, points taken away.
    """

    id = "plane.hough3d"
    result_version = 6
    determinism = "exact"
    metrics = DETECTOR_METRICS
    citations = (
        (
            "Markiewicz, Podlasiak, Zawieska 2015: A New Approach to the Generation of Orthoimages "
            "of Cultural Heritage Objects. Remote Sensing 7(12), doi:10.3390/rs71215869"
        ),
        (
            "Borrmann, Elseberg, Lingemann, Nuechter 2011: The 3D Hough Transform for plane "
            "detection in point clouds, doi:10.1007/3DRes.02(2011)3 (accumulators safe at the pole)"
        ),
    )

    class Params(DetectorParams):
        """What may be set; the defaults suit rooms and facades scanned at millimetres."""

        cell_m: float = Field(
            0.02, gt=0.0, le=1.0, description="Side of a voxel and of a distance bin."
        )
        angle_step_deg: float = Field(
            1.0, ge=0.25, le=15.0, description="Step between the directions that are voted for."
        )
        search: Literal["coarse-to-fine", "full"] = Field(
            "coarse-to-fine",
            description="Vote with doubled cells and steps and look finer around maxima, or vote "
            "with all of them.",
        )
        coordinates: Literal["cells", "raw"] = Field(
            "cells", description="What votes: voxels, or points of the sample by themselves."
        )

    In = DetectorIn
    Out = DetectorOut

    def run(self, inputs: DetectorIn, params: Params, ctx: StepContext) -> DetectorOut:
        """Detect the planes of a cloud."""
        from orthoflow_plugins.plane.detecting import Detector, detect
        from orthoflow_plugins.plane.search_figures import draw_sections, draw_space
        from orthoflow_plugins.plane.space_accumulators import SpaceProposer, SpaceVoting

        proposers: list[SpaceProposer] = []
        coarser = 1.0 if params.search == "full" else 2.0

        def proposer_of(cloud: PreparedCloud, _: Unassigned, __: Rules) -> SpaceProposer:
            voting = SpaceVoting(
                cell_m=coarser * params.cell_m,
                angle_step_deg=coarser * params.angle_step_deg,
                least_points=params.min_share * len(cloud.claims),
                family=params.family,
                tilt_most_deg=params.max_tilt_deg,
                is_raw=params.coordinates == "raw",
            )
            proposers.append(SpaceProposer(cloud, voting))
            return proposers[-1]

        detector = Detector(method=self.id, proposer_of=proposer_of)
        detection = detect(inputs.cloud, params, ctx, detector)
        for proposer in proposers:
            if proposer.first_picture is not None:
                draw_space(ctx, proposer.first_picture, detection.planes)
        draw_sections(ctx, detection.planes, inputs.cloud, cell_m=params.cell_m)
        return DetectorOut(planes=detection.planes, labels=detection.labels)
