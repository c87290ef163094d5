"""Parameters of all detectors, and the base class of proposers."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from orthoflow.geometry import Plane
from orthoflow.products import Planes, PointCloud
from orthoflow.sdk import MethodParams, StepContext

# Orientation of the planes to search for.
Constraint = Literal["any", "vertical", "horizontal"]
# Lowest and highest intensity of each material, by name.
Materials = Mapping[str, tuple[float, float]]
# Rule for the votes of a cell of the plan.
Accumulator = Literal["counts", "unit", "canny"]

# Tolerances for a cloud with little noise: that of markiewicz2015, and that of the fit, which
# excludes mouldings.
_TOLERANCE_M: Final = 0.05
_FIT_TOLERANCE_M: Final = 0.015
# Ratio of the tolerances to the standard deviation of the noise.
_NOISE_TIMES: Final = 4.0


class DetectorParams(MethodParams):
    """Parameters of all detectors; defaults suit rooms and facades with millimetre spacing."""

    tolerance_m: Annotated[float, Field(gt=0.0)] | Literal["auto"] = Field(
        "auto",
        description="Maximum distance from a plane of the points that belong to it, metres. auto: "
        "0.05, or four times the measured noise of the cloud if that is more.",
    )
    fit_tolerance_m: Annotated[float, Field(gt=0.0)] | Literal["auto"] = Field(
        "auto",
        description="Maximum distance from a plane of the points used in its final fit, metres; "
        "at most `tolerance_m`. auto: 0.015, or four times the noise of single points if that is "
        "more.",
    )
    constraint: Constraint = Field(
        "any", description="Orientation of the planes to detect, within `max_tilt_deg`."
    )
    max_tilt_deg: float = Field(
        10.0,
        gt=0.0,
        le=45.0,
        description="Maximum deviation of vertical planes from vertical, and of horizontal ones "
        "from level.",
    )
    exact: bool = Field(
        default=False,
        description="Constrain walls to be exactly vertical and floors to be exactly level "
        "instead of fitting their tilt.",
    )
    n_planes_max: int = Field(100, ge=1, le=100, description="Maximum number of planes.")
    min_area_m2: float = Field(
        1.0,
        ge=0.0,
        description="Minimum area of a plane, square metres; the search ends when all "
        "candidates are smaller. In small clouds, it is reduced to 2 % of the largest face "
        "of the bounding box.",
    )
    min_share: float = Field(
        0.001, gt=0.0, lt=1.0, description="Minimum share of all points that a plane must contain."
    )
    stop_unclassified_share: float = Field(
        0.0,
        ge=0.0,
        lt=1.0,
        description="Stop when the share of points not yet on a plane is smaller than this. "
        "markiewicz2015 uses 0.1, which misses walls far from the scanner. 0 disables this.",
    )
    thinning: int = Field(
        1,
        ge=1,
        le=10_000,
        description="Find and fit planes using only every n-th point; all points are labelled.",
    )
    join_parts: bool = Field(
        default=True,
        description="Treat disconnected coplanar parts as one plane instead of several.",
    )
    materials: dict[str, tuple[float, float]] = Field(
        default_factory=dict,
        description="Lowest and highest intensity (0..1) of each material by name, such as "
        "{fabric: [0, 0.3], plaster: [0.3, 1]}: the thickness of the cloud is reported for each.",
    )
    refit: bool = Field(
        default=True,
        description="Fit planes to all their points, in the same way for every detector, instead "
        "of keeping them as the detector proposed them.",
    )

    @field_validator("materials")
    @classmethod
    def _materials_lie_apart(
        cls, materials: dict[str, tuple[float, float]]
    ) -> dict[str, tuple[float, float]]:
        before_name, before = "", 0.0
        for name, (low, high) in sorted(materials.items(), key=lambda item: item[1]):
            if not 0.0 <= low < high <= 1.0:
                raise ValueError(
                    f"intensities of {name} must ascend between 0 and 1, got {low:g} and {high:g}"
                )
            if low < before:
                raise ValueError(
                    f"intensities of {name} begin at {low:g}, but those of "
                    f"{before_name} end at {before:g}: the ranges of materials must not "
                    "overlap"
                )
            before_name, before = name, high
        return materials

    @model_validator(mode="after")
    def _fit_lies_within_tolerance(self) -> Self:
        given = (self.tolerance_m, self.fit_tolerance_m)
        if "auto" not in given and self.fit_tolerance_m > self.tolerance_m:  # type: ignore[operator]  # no text is left
            raise ValueError(
                f"fit_tolerance_m must be at most tolerance_m = {self.tolerance_m:g}, "
                f"got {self.fit_tolerance_m:g}"
            )
        return self

    def tolerances_m(self, single_m: float, shared_m: float) -> tuple[float, float]:
        """Return `tolerance_m` and `fit_tolerance_m` for a cloud with a given noise.

        Unlike the points of a filled slab, those of a plane concentrate in the inner half of the
        tolerance. If deviations are normally distributed, this half contains 95 % of the points if
        the tolerance is four standard deviations, but only 80 % if it is 2.5, so that the plane is
        rejected. Errors common to neighbouring points bend a surface. They are fully included in
        `tolerance_m`, but only half of them in `fit_tolerance_m`, because a fit averages bends over
        the whole plane.

        Args:
            single_m: standard deviation of the noise of single points; 0 if unknown.
            shared_m: the same, including errors common to neighbouring points.
        """
        if self.fit_tolerance_m == "auto":
            fit_m = max(_FIT_TOLERANCE_M, _NOISE_TIMES * single_m, 0.5 * _NOISE_TIMES * shared_m)
        else:
            fit_m = self.fit_tolerance_m
        if self.tolerance_m == "auto":
            return max(_TOLERANCE_M, _NOISE_TIMES * shared_m, fit_m), fit_m
        return self.tolerance_m, min(fit_m, self.tolerance_m)


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A plane that a detector proposes.

    Attributes:
        plane: the plane in the cloud's offsets, accurate to a few centimetres and about a degree.
        constraint: orientation to which the fitted plane is restricted.
        own_tolerance_m: tolerance that the detector estimated; None if it estimates none.
        start: initial plane of the common fit; if None, `plane` is used.
    """

    plane: Plane
    constraint: Constraint
    own_tolerance_m: float | None = None
    start: Plane | None = None


class Proposer:
    """Proposes planes; each detector has its own proposer for the common search."""

    # In this class, Any stands for `search.Search`, whose module imports this one.
    @abstractmethod
    def propose(self, search: Any) -> Candidate | None:
        """Return the best candidate for the points not yet assigned; None if there is none."""

    def reject(self) -> None:
        """Exclude the last candidate from further proposals."""

    def relabel(self, found: Any, cloud: Any) -> None:
        """Reassign points to planes after all points have been labelled."""

    def draw(self, ctx: StepContext, planes: Planes, cloud: PointCloud) -> None:
        """Report and draw results that are specific to this detector."""


def leans_as_asked(
    normals: NDArray[np.float64],
    up: NDArray[np.float64],
    constraint: Constraint,
    max_tilt_deg: float,
) -> NDArray[np.bool_]:
    """Return a mask (n,) of planes with normals (n, 3) that satisfy a constraint."""
    tilts_deg = np.degrees(np.arcsin(np.clip(np.abs(normals @ up), 0.0, 1.0)))
    if constraint == "any":
        return np.ones(len(normals), dtype=bool)
    within = (
        tilts_deg <= max_tilt_deg if constraint == "vertical" else tilts_deg >= 90.0 - max_tilt_deg
    )
    return np.asarray(within, dtype=np.bool_)
