"""`orient.pnp`: each photo by itself from its ties with the walls (markiewicz2015, 3.6 and 4.3)."""

from __future__ import annotations

from importlib.metadata import version
from typing import ClassVar, Final, Literal

from pydantic import Field

from orthoflow.sdk import Method, StepContext
from orthoflow.sdk.methods import Determinism
from orthoflow_plugins.orient.estimation import estimate_pose
from orthoflow_plugins.orient.opencv_pose import estimate_by_opencv
from orthoflow_plugins.orient.parameters import (
    ORIENTATION_METRICS,
    OrientIn,
    OrientOut,
    OrientParams,
)
from orthoflow_plugins.orient.reporting import hand_over
from orthoflow_plugins.orient.single_photo import Estimator, each_by_itself

PoseMethod = Literal["weighted", "opencv"]
_ESTIMATORS: Final[dict[PoseMethod, Estimator]] = {
    "weighted": estimate_pose,
    "opencv": estimate_by_opencv,
}


class OrientPnp(Method):
    """Orient each photo by itself: robust pose, then a weighted adjustment with the full lens.

    A share of the ties is withheld from all of it and checks the result. A photo is `ok` only if
    its ties suffice and lie well, the withheld ones agree beyond chance, the camera stands in
    front of the wall, and the predicted error on the wall is small; else the reason is said.
    """

    id: ClassVar[str] = "orient.pnp"
    result_version: ClassVar[int] = 9
    determinism: ClassVar[Determinism] = "seeded"
    metrics: ClassVar[tuple[str, ...]] = ORIENTATION_METRICS
    citations: ClassVar[tuple[str, ...]] = (
        "Markiewicz, Podlasiak, Zawieska 2015, doi:10.3390/rs71215869 (3.6, 4.3)",
        "Raguram et al. 2013, USAC, universal random sample consensus, doi:10.1109/TPAMI.2012.257",
        "Torr, Zisserman 2000, MLESAC (and MSAC), doi:10.1006/cviu.1999.0832",
        "Ke, Roumeliotis 2017, An efficient algebraic solution to P3P, doi:10.1109/CVPR.2017.491",
    )

    class Params(OrientParams):
        """How the pose is adjusted, rejection, withheld share, and the gates to pass."""

        method: PoseMethod = Field(
            default="weighted",
            description="weighted: each tie counts by its own sigmas and an uncalibrated lens is "
            "refined; opencv: cv2.solvePnP, iterative, all ties alike, the lens as it is known "
            "(markiewicz2015).",
        )

    In = OrientIn
    Out = OrientOut

    def run(self, inputs: OrientIn, params: Params, ctx: StepContext) -> OrientOut:
        """Orient the photos one after the other."""
        estimator = _ESTIMATORS[params.method]
        found = each_by_itself(inputs.ties, inputs.photos, params, ctx, estimator)
        return OrientOut(cameras=hand_over(ctx, inputs.ties, inputs.photos.photos, found))

    @classmethod
    def tools(cls) -> dict[str, str]:
        """OpenCV finds the first pose."""
        return {name: version(name) for name in ("opencv-python-headless", "scipy")}
