"""Parameters of every detector, and what a detector contributes to the search."""

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
# Lowest and highest intensity of each material.
Materials = Mapping[str, tuple[float, float]]
# Votes of a cell of the plan.
Accumulator = Literal["counts", "unit", "canny"]

# Tolerances for a clean scan: that of markiewicz2015, and one that excludes mouldings.
_TOLERANCE_M: Final = 0.05
_FIT_TOLERANCE_M: Final = 0.015
# Ratio of the tolerances to the standard deviation of the noise.
_NOISE_TIMES: Final = 4.0


class DetectorParams(MethodParams):
    """Parameters of every detector; the defaults suit rooms and facades scanned at millimetres."""

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
        description="Minimum area of a plane, square metres; the search ends when all candidates "
        "are smaller. It is reduced for a cloud without a face of at least 50 times this area.",
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
                    f"intensities of {name} begin at {low:g}, below {before:g} where those of "
                    f"{before_name} end"
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
        """Return `tolerance_m` and `fit_tolerance_m` for a cloud with the given noise.

        A plane differs from a filled slab in the concentration of its points in the inner half of
        the tolerance. With a normal distribution this half contains 95 % of them if the tolerance
        is four standard deviations, but only 80 %, which is rejected, if it is 2.5. Errors common
        to neighbouring points bend a surface, so they count fully for `tolerance_m`, and by half
        for the fit, which averages bends over the whole plane.

        Args:
            single_m: noise of single points, standard deviation; 0 if unknown.
            shared_m: the same, including errors that are common to neighbouring points.
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
        plane: the plane in the cloud's offsets, accurate to a few centimetres or a degree.
        constraint: permitted orientation of the fitted plane.
        own_tolerance_m: tolerance estimated by the detector, or None.
        start: initial plane of the common fit; None for `plane`.
    """

    plane: Plane
    constraint: Constraint
    own_tolerance_m: float | None = None
    start: Plane | None = None


class Proposer:
    """What a detector contributes to the search, which all detectors share."""

    # Any stands for `search.Search`, here and below, because its module imports this one.
    @abstractmethod
    def propose(self, search: Any) -> Candidate | None:
        """Return the best candidate among the points not yet assigned, or None."""

    def reject(self) -> None:
        """Exclude the last candidate from further proposals."""

    def relabel(self, found: Any, cloud: Any) -> None:
        """Change the claims of the cloud after all points are labelled."""

    def draw(self, ctx: StepContext, planes: Planes, cloud: PointCloud) -> None:
        """Report and draw the results specific to this detector."""


def leans_as_asked(
    normals: NDArray[np.float64],
    up: NDArray[np.float64],
    constraint: Constraint,
    max_tilt_deg: float,
) -> NDArray[np.bool_]:
    """Return whether (n,) planes with normals (n, 3) satisfy a constraint within `max_tilt_deg`."""
    tilts_deg = np.degrees(np.arcsin(np.clip(np.abs(normals @ up), 0.0, 1.0)))
    if constraint == "any":
        return np.ones(len(normals), dtype=bool)
    within = (
        tilts_deg <= max_tilt_deg if constraint == "vertical" else tilts_deg >= 90.0 - max_tilt_deg
    )
    return np.asarray(within, dtype=np.bool_)
