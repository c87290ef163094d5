"""What every detector takes and gives: ports, tolerances, constraint, stop rules, thinning."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final, Literal, Self

from pydantic import Field, field_validator, model_validator

from orthoflow.products import Planes, PointCloud, PointLabels
from orthoflow.sdk import MethodParams, Ports

if TYPE_CHECKING:
    from orthoflow_plugins.plane.candidates import Family

# What every detector reports.
DETECTOR_METRICS: Final = (
    *("n_planes", "thinning", "labelled_share", "first_share"),
    *("detection_s", "first_plane_s", "next_plane_s"),
    *("detection_cpu_s", "first_plane_cpu_s", "next_plane_cpu_s"),
    *("rms_mm", "fit_rms_mm", "omega_deg", "phi_deg", "offset_m", "r_m"),
    *("sigma_angle_deg", "sigma_offset_mm", "n_independent"),
    *("skewness", "excess_kurtosis", "within_[123]_sigma"),
    *("raw_omega_deg", "raw_phi_deg", "raw_r_m", "raw_angle_deg", "raw_offset_mm"),
    *("thickest_mm", "thickness_mm", "thickness_width_mm", "thickness_scan_steps", "scan_step_mm"),
)

_FAMILIES: Final[Mapping[str, Family]] = {"any": "any", "vertical": "wall", "horizontal": "level"}


class DetectorIn(Ports):
    """What planes are found in."""

    cloud: PointCloud


class DetectorOut(Ports):
    """Planes, and which of them has each point."""

    planes: Planes
    labels: PointLabels


class DetectorParams(MethodParams):
    """What every detector takes; the defaults suit rooms and facades scanned at millimetres."""

    tolerance_m: float = Field(
        0.05, gt=0.0, description="Points this near to a plane belong to it."
    )
    fit_tolerance_m: float = Field(
        0.015,
        gt=0.0,
        description="Points this near to a plane take part in its final fit; at most "
        "`tolerance_m`, which the default follows where that is set below it.",
    )
    constraint: Literal["any", "vertical", "horizontal"] = Field(
        "any", description="Which planes are looked for, within `max_tilt_deg`."
    )
    max_tilt_deg: float = Field(
        10.0,
        gt=0.0,
        le=45.0,
        description="Vertical planes may be off vertical, and horizontal ones off level, by this.",
    )
    exact: bool = Field(
        default=False,
        description="Keep walls exactly vertical and levels exactly level instead of letting each "
        "plane lean as its points say.",
    )
    n_planes_max: int = Field(16, ge=1, le=100, description="Stop after so many planes.")
    min_share: float = Field(
        0.005, gt=0.0, lt=1.0, description="Share of all points that a plane must hold."
    )
    stop_unclassified_share: float = Field(
        0.05,
        ge=0.0,
        lt=1.0,
        description="Stop when a smaller share of the points is on no plane yet; markiewicz2015 "
        "takes 0.1, at which mirror ghosts can end the search before a small wall.",
    )
    stop_rest_share: float = Field(
        0.0,
        ge=0.0,
        lt=1.0,
        description="Stop at a plane that holds a smaller share of the points that were left for "
        "it: the other reading of the 10 % in markiewicz2015. 0 never stops.",
    )
    thinning: int = Field(
        1,
        ge=1,
        le=10_000,
        description="Find and fit planes on every n-th point only; all points are labelled.",
    )
    join_parts: bool = Field(
        default=True,
        description="Parts of one plane that do not touch are one plane; else each is its own.",
    )

    materials: dict[str, tuple[float, float]] = Field(
        default_factory=dict,
        description="Lowest and highest intensity (0..1) of each material, by its name, e.g. "
        "{fabric: [0, 0.3], plaster: [0.3, 1]}: how thick the cloud is on each of them is told.",
    )
    refit: bool = Field(
        default=True,
        description="Fit planes to all their points, the same for every detector; else they stay "
        "as the detector itself gave them.",
    )

    @property
    def family(self) -> Family:
        """The planes that `constraint` asks for."""
        return _FAMILIES[self.constraint]

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

    @model_validator(mode="before")
    @classmethod
    def _fit_follows_find(cls, given: object) -> object:
        """A default that is wider than what was set would be refused where it is given back."""
        if not isinstance(given, dict) or "fit_tolerance_m" in given:
            return given
        tolerance_m, fit_m = given.get("tolerance_m"), cls.model_fields["fit_tolerance_m"].default
        if isinstance(tolerance_m, int | float) and 0 < tolerance_m < fit_m:
            return {**given, "fit_tolerance_m": float(tolerance_m)}
        return given

    @model_validator(mode="after")
    def _fit_lies_within_find(self) -> Self:
        if self.fit_tolerance_m > self.tolerance_m:
            raise ValueError(
                f"fit_tolerance_m must be at most tolerance_m = {self.tolerance_m:g}, "
                f"got {self.fit_tolerance_m:g}"
            )
        return self
