"""`plane.ransac`: the planes that most points of a sample agree on, fitted to all points."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, Self

from pydantic import Field, model_validator

from orthoflow.sdk import Method, MetricSpec, StepContext
from orthoflow_plugins.plane.parameters import (
    DETECTOR_METRICS,
    DetectorIn,
    DetectorOut,
    DetectorParams,
)

if TYPE_CHECKING:
    from orthoflow_plugins.plane.candidates import Rules
    from orthoflow_plugins.plane.detecting import Proposer
    from orthoflow_plugins.plane.sample import PreparedCloud, Unassigned


class Ransac(Method):
    """Find planes by random sample consensus: Max-Consensus, MSAC or AC-RANSAC, in 3D or the plan.

    Planes through random points are scored on a sample of the cloud; the best is refined on the
    sample with a tolerance that shrinks from `tolerance_m` to `fit_tolerance_m`, and must hold
    crowded cells of enough points. When all planes are found on the sample, one pass over all
    points (of more than 24 million, over a part drawn evenly) fits them, and one labels the points.

    `model: 2d` draws upright planes through two points of the plan, as in markiewicz2015; it finds
    walls only. `scoring: a-contrario` finds its own tolerance, up to `tolerance_m`: the one at
    which the points least look like chance. It is reported as `own_tolerance_mm` for the first
    plane and with each plane; the common fit with `fit_tolerance_m` follows all the same.
    """

    id = "plane.ransac"
    result_version = 5
    determinism = "seeded"
    metrics = (
        *DETECTOR_METRICS,
        MetricSpec("own_tolerance_mm", label="tolerance taken from the cloud"),
    )
    citations = (
        "Fischler, Bolles 1981: Random sample consensus, doi:10.1145/358669.358692",
        "Torr, Zisserman 2000: MLESAC, doi:10.1006/cviu.1999.0832 (MSAC)",
        (
            "Moisan, Stival 2004: A probabilistic criterion to detect rigid point matches, "
            "doi:10.1023/B:VISI.0000013094.38752.54 (a contrario)"
        ),
        (
            "Markiewicz, Podlasiak, Zawieska 2015: A New Approach to the Generation of Orthoimages "
            "of Cultural Heritage Objects. Remote Sensing 7(12), doi:10.3390/rs71215869"
        ),
    )

    class Params(DetectorParams):
        """What may be set; the defaults suit rooms and facades scanned at millimetres."""

        model: Literal["3d", "2d"] = Field(
            "3d", description="Planes through three points, or upright ones through two."
        )
        scoring: Literal["count", "msac", "a-contrario"] = Field(
            "msac",
            description="What a hypothesis is worth: its points, its points the more the nearer "
            "they are, or how little they look like chance at its own tolerance.",
        )
        n_hypotheses: int = Field(
            1000,
            ge=10,
            le=1_000_000,
            description="Hypotheses for the first plane; half as many for each further one.",
        )

        @model_validator(mode="after")
        def _upright_planes_are_walls(self) -> Self:
            if self.model == "2d" and self.constraint == "horizontal":
                raise ValueError("model: 2d finds upright planes only, got constraint: horizontal")
            return self

    In = DetectorIn
    Out = DetectorOut

    def run(self, inputs: DetectorIn, params: Params, ctx: StepContext) -> DetectorOut:
        """Detect the planes of a cloud."""
        from orthoflow_plugins.plane.consensus import ConsensusProposer, Search
        from orthoflow_plugins.plane.detecting import Detector, detect

        def proposer_of(_: PreparedCloud, unassigned: Unassigned, rules: Rules) -> Proposer:
            search = Search(
                model=params.model,
                scoring=params.scoring,
                n_hypotheses=params.n_hypotheses,
                find_m=rules.find_m,
                family=params.family,
                tilt_most_deg=params.max_tilt_deg,
                least_share=params.min_share,
            )
            return ConsensusProposer(unassigned, search, ctx.rng)

        detector = Detector(method=self.id, proposer_of=proposer_of)
        detection = detect(inputs.cloud, params, ctx, detector)
        own_m = detection.raw[0].own_tolerance_m
        if own_m is not None:
            ctx.metric("own_tolerance_mm", 1000.0 * own_m, "mm")
        return DetectorOut(planes=detection.planes, labels=detection.labels)
