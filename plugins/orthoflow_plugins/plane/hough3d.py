"""`plane.hough3d`: planes of any orientation, from voxels that vote in a 3D accumulator."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field

from orthoflow.sdk import StepContext
from orthoflow_plugins.plane.detector import PAPER, Detector
from orthoflow_plugins.plane.proposing import DetectorParams

if TYPE_CHECKING:
    from orthoflow_plugins.plane.hough import SpaceProposer
    from orthoflow_plugins.plane.search import Search


class Hough3d(Detector):
    """Find planes of any orientation by the 3D Hough transform of markiewicz2015.

    The points of a sample are counted in voxels, which vote for all planes through them: r = x
    cos(phi) cos(omega) + y cos(phi) sin(omega) + z sin(phi). For each omega, the voxels are first
    summed in a vertical image, whose occupied pixels then vote for all phi. Directions are evenly
    distributed over the hemisphere, so that a floor is counted only once instead of once for each
    omega.

    With `search: coarse-to-fine`, votes are counted with twice `cell_m` and twice `angle_step_deg`,
    and each maximum is refined; with `full`, both are used as given. The other stages are common to
    all detectors: planes are refined on a sample and fitted to all points, and their points are
    removed from the search. With `scoring: votes`, the maximum of the votes is proposed unchanged,
    as in the paper.
    """

    id = "plane.hough3d"
    determinism = "exact"
    citations = (
        PAPER,
        (
            "Borrmann, Elseberg, Lingemann, Nuechter 2011: The 3D Hough Transform for plane "
            "detection in point clouds, doi:10.1007/3DRes.02(2011)3 (accumulators safe at the pole)"
        ),
    )

    class Params(DetectorParams):
        """Parameters; the defaults suit rooms and facades scanned with millimetre point spacing."""

        cell_m: float = Field(
            0.02, gt=0.0, le=1.0, description="Size of the voxels and of the distance bins."
        )
        angle_step_deg: float = Field(
            1.0, ge=0.25, le=15.0, description="Angle between successive normal directions."
        )
        search: Literal["coarse-to-fine", "full"] = Field(
            "coarse-to-fine",
            description="coarse-to-fine: vote with twice the cell size and angle step, then "
            "refine the maxima; full: vote with the given values.",
        )
        scoring: Literal["contrast", "votes"] = Field(
            "contrast",
            description="Score of a plane. contrast: its votes minus those of the adjacent "
            "bins on the side with fewer votes, refined with finer angles and bins; votes: "
            "the votes of its bin, as in markiewicz2015.",
        )
        coordinates: Literal["cells", "raw"] = Field(
            "cells",
            description="Positions that vote. cells: voxels; raw: single points of the sample.",
        )

    def proposer(self, search: Search, params: Params, ctx: StepContext) -> SpaceProposer:
        """Return a proposer that counts votes of voxels."""
        from orthoflow_plugins.plane.hough import SpaceProposer

        del ctx
        return SpaceProposer(search, params)
