"""What every orientation takes and gives: ports, rejection, withheld share, and gates."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, Literal, TypeAlias

from pydantic import Field

from orthoflow.products import Cameras, Photos, Ties
from orthoflow.sdk import DiagnosticSpec, MethodParams, MetricSpec, Ports

# What an orientation says of a photo: a spec and its values.
Note: TypeAlias = tuple[DiagnosticSpec, Mapping[str, Any]]
NOT_ORIENTED: Final = DiagnosticSpec(
    code="photo-not-oriented",
    severity="warning",
    text="photo {subject} is not oriented: {status}",
)
# What every orientation reports of its photos.
ORIENTATION_METRICS: Final = (
    MetricSpec("n_photos", label="photos"),
    MetricSpec("n_oriented", label="photos oriented", better="higher", headline=True),
    MetricSpec("n_refused", label="photos refused"),
    MetricSpec("n_ties", label="ties"),
    MetricSpec("n_control", label="control points"),
    MetricSpec("n_check", label="check points"),
    MetricSpec("rejected_share", label="share of the ties that is rejected"),
    MetricSpec(
        "control_rmse_px_median",
        label="control points, RMS per axis, median photo",
        better="lower",
        counted_by="n_oriented",
    ),
    MetricSpec(
        "control_rmse_px_worst",
        label="control points, RMS per axis, worst photo",
        better="lower",
        counted_by="n_oriented",
    ),
    MetricSpec(
        "check_rmse_px_median",
        label="check points, RMS per axis, median photo",
        better="lower",
        counted_by="n_oriented",
    ),
    MetricSpec(
        "check_rmse_px_worst",
        label="check points, RMS per axis, worst photo",
        better="lower",
        counted_by="n_oriented",
    ),
    MetricSpec(
        "check_rmse_mm_median",
        label="check points, RMS per axis on the wall, median photo",
        better="lower",
        counted_by="n_oriented",
    ),
    MetricSpec(
        "check_rmse_mm_worst",
        label="check points, RMS per axis on the wall, worst photo",
        better="lower",
        counted_by="n_oriented",
        headline=True,
        description="mean of both axes of the photo; along one of the wall it may be more",
    ),
    MetricSpec(
        "sigma_wall_mm_median",
        label="expected error of the orientation on the wall, median photo",
        better="lower",
        counted_by="n_oriented",
    ),
    MetricSpec(
        "sigma_wall_mm_worst",
        label="expected error of the orientation on the wall, worst photo",
        better="lower",
        counted_by="n_oriented",
        headline=True,
        description="against the scan; errors of depth and scan add to it",
    ),
)


class OrientIn(Ports):
    """Ties with the walls, and the photos they are in."""

    ties: Ties
    photos: Photos


class OrientOut(Ports):
    """One orientation per photo."""

    cameras: Cameras


class OrientParams(MethodParams):
    """Rejection, withheld share, and the limits of the gates that depend on the job."""

    rejection_sigma: float = Field(
        default=3.5,
        gt=1,
        le=20,
        description="Ties that deviate by more than this "
        "many of their standard deviations are rejected.",
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
    min_quadrant_ties: int = Field(
        default=2,
        ge=0,
        description="Ties that must agree in each quarter of a photo (markiewicz2015: 2), "
        "unless the predicted error on the walls in that quarter stays below "
        "max_sigma_wall_cells; 0 leaves it to the predicted error alone.",
    )
    quadrants: Literal["predicted", "strict"] = Field(
        default="predicted",
        description="strict: a photo with fewer than min_quadrant_ties in a quarter is refused "
        "regardless of the predicted error, even if the quarter shows no wall (markiewicz2015).",
    )
    min_hull_ratio: float = Field(
        default=0.4,
        ge=0,
        le=1,
        description="Area of the control's hull over that of the walls in the photo.",
    )
    max_sigma_wall_cells: float = Field(
        default=1.0,
        gt=0,
        description="Largest predicted error on the wall, RMS over what the photo shows, in "
        "cells of its raster.",
    )
    max_sigma_corner_cells: float = Field(
        default=3.0, gt=0, description="The same at the worst place of what the photo shows."
    )
