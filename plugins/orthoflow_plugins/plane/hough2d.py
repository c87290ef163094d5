"""`plane.hough2d`: walls from the plan of a cloud, and floors and ceilings from its heights.

The cells of the plan (a map of the cloud with 2 cm cells) vote for lines. The number of votes of a
cell is its number of points, because with one vote per cell, floors and ceilings hide all walls
(markiewicz2015, Figure 10). From each maximum, the votes for adjacent lines with the same angle are
subtracted. These votes are due to surfaces that the line crosses, and would favour the longest
diagonal of the room.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, Self

from pydantic import Field, model_validator

from orthoflow.sdk import StepContext
from orthoflow_plugins.plane.detector import PAPER, Detector
from orthoflow_plugins.plane.proposing import Accumulator, DetectorParams

if TYPE_CHECKING:
    from orthoflow_plugins.plane.hough import PlanProposer
    from orthoflow_plugins.plane.search import Search


class Hough2d(Detector):
    """Find walls, floors and ceilings by markiewicz2015's modified 2D Hough transform.

    The points of a sample are counted in the cells of a plan. Each occupied cell votes for all
    lines through it, with as many votes as it has points. The best line is a candidate for a wall,
    which is refined on the sample with a tolerance that decreases from `tolerance_m` to
    `fit_tolerance_m`. The plane is bounded by a rectangle, and its points are removed from the
    search. When all planes have been found, they are fitted in one pass to all points, or, in
    clouds of more than 24 million points, to a random sample (total least squares of cell means). A
    second pass labels all points.

    Floors, ceilings and other horizontal planes are found in the histogram of heights. Of all
    candidates for walls and horizontal planes, the one with the most votes is used first. All
    planes are refitted in 3D.

    The covariance of (normal, offset) accounts for errors common to neighbouring points. It is
    estimated from the scatter of tiles; of several tile sizes from 10 to 80 cm, the one with the
    largest variance is used.

    Some options are meant for comparison. With `accumulator: unit`, each occupied cell has one vote
    (as in the paper, there is then no clear maximum); with `canny`, only cells on edges of the
    density image have one. With `coordinates: raw`, the points of the sample vote instead of cells,
    which takes longer and finds the same planes. With `scoring: votes`, the maximum of the votes is
    proposed unchanged, as in the paper.
    """

    id = "plane.hough2d"
    determinism = "exact"
    citations = (PAPER,)

    class Params(DetectorParams):
        """Parameters; the defaults suit rooms and facades scanned with millimetre point spacing."""

        cell_m: float = Field(
            0.02,
            gt=0.0,
            le=1.0,
            description="Size of the cells of the plan and of the distance bins.",
        )
        angle_step_deg: float = Field(
            1.0, ge=0.1, le=15.0, description="Angle between successive line directions."
        )
        accumulator: Accumulator = Field(
            "counts",
            description="Votes of a cell. counts: its number of points; unit: one; canny: one if "
            "it is on an edge of the point density, otherwise none.",
        )
        scoring: Literal["contrast", "votes"] = Field(
            "contrast",
            description="Score of a line. contrast: its votes minus those of the adjacent "
            "bins on the side with fewer votes, refined with finer angles and bins; votes: "
            "the votes of its bin, as in markiewicz2015.",
        )
        coordinates: Literal["cells", "raw"] = Field(
            "cells",
            description="Positions that vote. cells: cells of the plan; raw: single points of "
            "the sample.",
        )

        @model_validator(mode="after")
        def _points_have_one_vote(self) -> Self:
            if self.coordinates == "raw" and self.accumulator != "counts":
                raise ValueError(
                    f"coordinates: raw needs accumulator: counts, got {self.accumulator}"
                )
            return self

    def proposer(self, search: Search, params: Params, ctx: StepContext) -> PlanProposer:
        """Return a proposer that counts votes of plan cells and of heights."""
        from orthoflow_plugins.plane.hough import PlanProposer

        del ctx
        return PlanProposer(search, params)
