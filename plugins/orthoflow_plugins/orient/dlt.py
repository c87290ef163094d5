"""`orient.dlt`: each photo by itself by a direct linear transform (markiewicz2015, 3.6 and 4.3)."""

from __future__ import annotations

from functools import partial
from importlib.metadata import version
from typing import ClassVar, Literal

from pydantic import Field

from orthoflow.sdk import Method, StepContext
from orthoflow.sdk.methods import Determinism
from orthoflow_plugins.orient.direct_linear import Distortion, estimate_dlt
from orthoflow_plugins.orient.parameters import (
    ORIENTATION_METRICS,
    OrientIn,
    OrientOut,
    OrientParams,
)
from orthoflow_plugins.orient.reporting import hand_over
from orthoflow_plugins.orient.single_photo import each_by_itself


class OrientDlt(Method):
    """Orient each photo by eleven parameters, or more with distortion, known from its ties alone.

    Calibration and EXIF serve only to reject wrong ties, with `prior: none` not even that. The
    linear solution starts a weighted adjustment of pose, fx, fy and principal point (and
    distortion); of the eleven parameters the skew is recorded but kept only when asked, since no
    lens of today has one. Control that lies near one plane does not determine the parameters and is
    refused. Everything is judged as in `orient.pnp`.
    """

    id: ClassVar[str] = "orient.dlt"
    result_version: ClassVar[int] = 9
    determinism: ClassVar[Determinism] = "seeded"
    metrics: ClassVar[tuple[str, ...]] = ORIENTATION_METRICS
    citations: ClassVar[tuple[str, ...]] = (
        "Abdel-Aziz, Karara 1971, Direct linear transformation, doi:10.14358/PERS.81.2.103",
        "Hartley 1997, In defense of the eight-point algorithm, doi:10.1109/34.601246",
        "Markiewicz, Podlasiak, Zawieska 2015, doi:10.3390/rs71215869 (3.6, 4.3)",
    )

    class Params(OrientParams):
        """The distortion that is estimated besides, and what `orient.pnp` takes, too."""

        distortion: Distortion = Field(
            default="none",
            description="Distortion estimated with the eleven parameters: none, k1, or "
            "k1 k2 p1 p2.",
        )
        skew: bool = Field(
            default=False,
            description="Keep the skew, the eleventh parameter: rows and columns of the camera's "
            "pixels need not be square to each other. The way to the orthoimage knows it, too.",
        )
        prior: Literal["lens", "none"] = Field(
            default="lens",
            description="What wrong ties are rejected by: the lens as calibration or EXIF know it, "
            "or none, the usual focal lengths tried in turn (markiewicz2015).",
        )

    In = OrientIn
    Out = OrientOut

    def run(self, inputs: OrientIn, params: Params, ctx: StepContext) -> OrientOut:
        """Orient the photos one after the other."""
        estimator = partial(
            estimate_dlt,
            distortion=params.distortion,
            keeps_skew=params.skew,
            forgets_lens=params.prior == "none",
        )
        found = each_by_itself(inputs.ties, inputs.photos, params, ctx, estimator)
        return OrientOut(cameras=hand_over(ctx, inputs.ties, inputs.photos.photos, found))

    @classmethod
    def tools(cls) -> dict[str, str]:
        """OpenCV rejects wrong ties."""
        return {name: version(name) for name in ("opencv-python-headless", "scipy")}
