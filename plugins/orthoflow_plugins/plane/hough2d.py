"""`plane.hough2d`: walls from the plan of a cloud, floors and ceilings from its heights.

The cells of the plan (a map of the cloud, 2 cm cells) vote for lines. The number of points in a
cell is its number of votes, because with one vote per cell, floors and ceilings hide all walls
(markiewicz2015, Figure 10). From each maximum, the level of its surroundings at the same angle is
subtracted. This level is due to surfaces that the line crosses, and would favour the longest
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

    The points of a sample are counted in the cells of a plan. Every occupied cell votes for all
    lines through it, with as many votes as it has points. The best line is refined on the sample
    with a tolerance that decreases from `tolerance_m` to `fit_tolerance_m`. It is bounded by a
    rectangle and its points are removed. When all planes are found, they are fitted to all points
    in one pass (total least squares of cell means; for clouds above 24 million points, a random
    sample is used); a second pass labels all points.

    Floors, ceilings and other horizontal planes are found in the histogram of heights. They compete
    with walls by number of votes and are refitted in 3D.

    The covariance of (normal, offset) accounts for errors common to neighbouring points. It is
    estimated from the scatter of tiles of 10 to 80 cm; the size with the largest variance is used.

    For comparison, `accumulator: unit` gives every occupied cell one vote (no clear maximum, as in
    the paper), and `canny` one to cells on edges of the density image. With `coordinates: raw`, the
    points of the sample vote with their coordinates, which takes longer and finds the same planes.
    `scoring: votes` proposes the maximum itself, as in the paper.
    """

    id = "plane.hough2d"
    determinism = "exact"
    citations = (PAPER,)

    class Params(DetectorParams):
        """Parameters; the defaults suit rooms and facades scanned at millimetres."""

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
            description="Score of a line. contrast: its votes minus those on its emptier side, "
            "refined with finer angles and bins; votes: only the votes of its bin, as in "
            "markiewicz2015.",
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
        """Return the accumulator of the plan and of heights."""
        from orthoflow_plugins.plane.hough import PlanProposer

        del ctx
        return PlanProposer(search, params)
