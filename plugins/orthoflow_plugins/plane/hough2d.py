"""`plane.hough2d`: walls from the plan of the cloud, floors and ceilings from its heights."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Literal, Self

from pydantic import Field, model_validator

from orthoflow.sdk import Method, StepContext
from orthoflow_plugins.plane.parameters import (
    DETECTOR_METRICS,
    DetectorIn,
    DetectorOut,
    DetectorParams,
)

if TYPE_CHECKING:
    from orthoflow_plugins.plane.accumulators import PlanProposer
    from orthoflow_plugins.plane.candidates import Rules
    from orthoflow_plugins.plane.sample import PreparedCloud, Unassigned

_VOTERS: Final = {
    "counts": "each cell votes with its number of points",
    "unit": "each cell with points has one vote",
    "canny": "each cell on an edge of the density has one vote",
    "raw": "each point of the sample votes with its own coordinates",
}


class Hough2d(Method):
    """Find walls, floors and ceilings by markiewicz2015's modified 2D Hough transform.

    Points are counted in the cells of a plan; every occupied cell votes, with as many votes as it
    has points, for all lines through it. The best line is refined on a sample of the points, with a
    tolerance that shrinks from `tolerance_m` to `fit_tolerance_m`, given a rectangle, and its
    points are taken away: the sample says which share of each cell those are. When all planes are
    found, one pass over all points, of more than 24 million over a part drawn evenly, fits them
    (total least squares of cell means), one labels all points.

    Floors, ceilings and other level planes come from the histogram of heights in the same race and
    are refitted in 3D.

    The covariance of (normal, offset) respects that neighbouring points share errors; it is
    estimated from the scatter of tiles between 10 and 80 cm, the size with the largest variance.

    For comparison: `accumulator: unit` gives every occupied cell one vote (no clear maximum, as the
    paper says), `canny` only the cells on edges of the density image; `coordinates: raw` lets the
    points of the sample vote with their own coordinates, which takes longer for the same planes.
    """

    id = "plane.hough2d"
    result_version = 6
    determinism = "exact"
    metrics = DETECTOR_METRICS
    citations = (
        (
            "Markiewicz, Podlasiak, Zawieska 2015: A New Approach to the Generation of Orthoimages "
            "of Cultural Heritage Objects. Remote Sensing 7(12), doi:10.3390/rs71215869"
        ),
    )

    class Params(DetectorParams):
        """What may be set; the defaults suit rooms and facades scanned at millimetres."""

        cell_m: float = Field(
            0.02, gt=0.0, le=1.0, description="Side of a cell of the plan and of a distance bin."
        )
        angle_step_deg: float = Field(
            1.0, ge=0.1, le=15.0, description="Step between the directions that are voted for."
        )
        accumulator: Literal["counts", "unit", "canny"] = Field(
            "counts",
            description="Votes of a cell: its points, one, or one where the density has an edge.",
        )
        coordinates: Literal["cells", "raw"] = Field(
            "cells",
            description="What votes: cells of the plan, or points of the sample by themselves.",
        )

        @model_validator(mode="after")
        def _points_have_one_vote(self) -> Self:
            if self.coordinates == "raw" and self.accumulator != "counts":
                raise ValueError(
                    f"coordinates: raw goes with accumulator: counts only, got {self.accumulator}"
                )
            return self

    In = DetectorIn
    Out = DetectorOut

    def run(self, inputs: DetectorIn, params: Params, ctx: StepContext) -> DetectorOut:
        """Detect the planes of a cloud."""
        from orthoflow_plugins.plane.accumulators import PlanProposer, Voting
        from orthoflow_plugins.plane.detecting import Detector, detect
        from orthoflow_plugins.plane.search_figures import VotePicture, draw_accumulator

        searches: list[tuple[PreparedCloud, PlanProposer]] = []

        def proposer_of(cloud: PreparedCloud, _: Unassigned, __: Rules) -> PlanProposer:
            voting = Voting(
                angle_step_deg=params.angle_step_deg,
                least_points=params.min_share * len(cloud.claims),
                walls=params.constraint != "horizontal",
                levels=params.constraint != "vertical",
                accumulator=params.accumulator,
                is_raw=params.coordinates == "raw",
            )
            searches.append((cloud, PlanProposer(cloud, voting)))
            return searches[-1][1]

        detector = Detector(method=self.id, proposer_of=proposer_of, plan_cell_m=params.cell_m)
        detection = detect(inputs.cloud, params, ctx, detector)
        for searched, proposer in searches:
            if proposer.first is not None and searched.plan is not None:
                picture = VotePicture(
                    grid=searched.grid,
                    plan=searched.plan.cells,
                    accumulator=proposer.first,
                    voters=_VOTERS["raw" if params.coordinates == "raw" else params.accumulator],
                )
                draw_accumulator(ctx, picture, detection.planes, inputs.cloud)
        return DetectorOut(planes=detection.planes, labels=detection.labels)
