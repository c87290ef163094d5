"""What every orientation takes and gives: ports, rejection, withheld share, and gates."""

from __future__ import annotations

from typing import Final, Literal

from pydantic import Field

from orthoflow.products import Cameras, Photos, Ties
from orthoflow.sdk import MethodParams, Ports
from orthoflow_plugins.orient.acceptance import GateRule
from orthoflow_plugins.orient.estimation import EstimationRule

# What every orientation reports of its photos.
ORIENTATION_METRICS: Final = (
    *("n_photos", "n_oriented", "n_refused", "n_ties", "n_control", "n_check", "rejected_share"),
    *("control_rmse_px_median", "control_rmse_px_worst"),
    *("check_rmse_px_median", "check_rmse_px_worst"),
    *("check_rmse_mm_median", "check_rmse_mm_worst"),
    *("sigma_wall_mm_median", "sigma_wall_mm_worst"),
)


class OrientIn(Ports):
    """Ties with the walls, and the photos they are in."""

    ties: Ties
    photos: Photos


class OrientOut(Ports):
    """One orientation per photo."""

    cameras: Cameras


class OrientParams(MethodParams):
    """Rejection, withheld share, and the gates an orientation has to pass."""

    rejection_sigma: float = Field(
        default=3.5,
        gt=1,
        le=20,
        description="Ties that deviate more than so many of their standard deviations are "
        "rejected.",
    )
    threshold_px: float | None = Field(
        default=None,
        gt=0,
        description="Largest deviation of a tie from a sampled pose; without it, what the "
        "ties' own standard deviations allow.",
    )
    check_share: float = Field(
        default=0.2,
        ge=0.2,
        le=0.5,
        description="Share of the ties withheld to check the orientation.",
    )
    n_trials_max: int = Field(
        default=20_000, ge=100, description="Random samples drawn per photo at most."
    )
    n_control_min: int = Field(
        default=12, ge=6, description="Control ties that must agree with the pose."
    )
    n_quadrant_min: int = Field(
        default=2,
        ge=0,
        description="Ties that must agree in each quarter of a photo (markiewicz2015: 2), "
        "unless the predicted error on the walls in that quarter stays below "
        "sigma_wall_max_cells; 0 leaves it to the predicted error alone.",
    )
    quadrants: Literal["predicted", "strict"] = Field(
        default="predicted",
        description="strict: a photo with fewer than n_quadrant_min ties in a quarter is refused "
        "whatever is predicted there, also where the quarter shows no wall (markiewicz2015).",
    )
    inlier_min_share: float = Field(
        default=0.04,
        ge=0,
        le=1,
        description="Share of a photo's ties that must agree with the pose.",
    )
    hull_min_ratio: float = Field(
        default=0.4,
        ge=0,
        le=1,
        description="Area of the control's hull over that of the walls in the photo.",
    )
    sigma_wall_max_cells: float = Field(
        default=1.0,
        gt=0,
        description="Largest predicted error on the wall, RMS over what the photo shows, in "
        "cells of its raster.",
    )
    sigma_corner_max_cells: float = Field(
        default=3.0, gt=0, description="The same at the worst place of what the photo shows."
    )
    n_ties_max: int = Field(
        default=20_000, ge=100, description="At most so many ties of a photo are used."
    )

    def estimation(self, seed: int) -> EstimationRule:
        """Give how a photo is oriented, with the seed of its samples."""
        return EstimationRule(
            rejection_sigma=self.rejection_sigma,
            threshold_px=self.threshold_px,
            n_trials_most=self.n_trials_max,
            seed=seed,
        )

    def gates(self) -> GateRule:
        """Give what an orientation must reach."""
        return GateRule(
            n_control_least=self.n_control_min,
            n_quadrant_least=self.n_quadrant_min,
            quadrants_are_strict=self.quadrants == "strict",
            inlier_share_least=self.inlier_min_share,
            hull_ratio_least=self.hull_min_ratio,
            sigma_wall_most_gsd=self.sigma_wall_max_cells,
            sigma_corner_most_gsd=self.sigma_corner_max_cells,
        )
