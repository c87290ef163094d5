"""`orient.pnp`: resection of single photos from ties to walls (markiewicz2015, 3.6 and 4.3)."""

from __future__ import annotations

from dataclasses import replace
from importlib.metadata import version
from typing import Any, ClassVar, Final, Literal

import numpy as np
from pydantic import Field

from orthoflow.errors import GeometryError
from orthoflow.geometry.cameras import LensFreedom, ViewingCamera, opencv_matrix, to_opencv
from orthoflow.geometry.resection import SeenPoints
from orthoflow.sdk import Method, MetricSpec, StepContext
from orthoflow.sdk.methods import Determinism
from orthoflow_plugins.orient.photos import each_by_itself
from orthoflow_plugins.orient.pose import (
    ORIENTATION_METRICS,
    Estimate,
    OrientIn,
    OrientOut,
    OrientParams,
    TiedPhoto,
    adjusted,
    estimate_pose,
    expected_px,
    no_pose,
    robust_start,
)
from orthoflow_plugins.orient.report import hand_over

# solvePnP needs six points if they are not coplanar.
_LEAST: Final = 6


class OrientPnp(Method):
    """Orient each photo separately by a robust pose and a weighted adjustment with the full lens.

    Some ties are withheld as check points. The status of a photo is `ok` only if it has enough
    well-distributed ties, if more withheld ties agree with the pose than expected by chance, if the
    camera is in front of the wall, and if the predicted error on the wall is small. Otherwise, the
    status is the reason for the rejection.
    """

    id: ClassVar[str] = "orient.pnp"
    determinism: ClassVar[Determinism] = "seeded"
    result_version: ClassVar[int] = 6
    metrics: ClassVar[tuple[MetricSpec, ...]] = ORIENTATION_METRICS
    citations: ClassVar[tuple[str, ...]] = (
        "Markiewicz, Podlasiak, Zawieska 2015, doi:10.3390/rs71215869 (3.6, 4.3)",
        "Raguram et al. 2013, USAC, universal random sample consensus, doi:10.1109/TPAMI.2012.257",
        "Torr, Zisserman 2000, MLESAC (and MSAC), doi:10.1006/cviu.1999.0832",
        "Ke, Roumeliotis 2017, An efficient algebraic solution to P3P, doi:10.1109/CVPR.2017.491",
    )

    class Params(OrientParams):
        """Adjustment, rejection, share of check points, and limits of the gates."""

        method: Literal["weighted", "opencv"] = Field(
            default="weighted",
            description="weighted: each tie is weighted by its own standard deviations, and an "
            "uncalibrated lens is refined; opencv: iterative cv2.solvePnP with equal weights and "
            "a fixed lens (markiewicz2015).",
        )

    In = OrientIn
    Out = OrientOut

    def run(self, inputs: OrientIn, params: Params, ctx: StepContext) -> OrientOut:
        """Orient each photo separately."""
        estimator = estimate_pose if params.method == "weighted" else estimate_by_opencv
        found = each_by_itself(inputs, params, ctx, estimator)
        return OrientOut(cameras=hand_over(ctx, inputs.ties, inputs.photos.photos, found))

    @classmethod
    def tools(cls) -> dict[str, str]:
        """OpenCV for the first pose."""
        return {name: version(name) for name in ("opencv-python-headless", "scipy")}


def estimate_by_opencv(tied: TiedPhoto, params: OrientParams) -> Estimate | str:
    """Orient a photo by `cv2.solvePnP` (Levenberg-Marquardt); return a reason if this fails.

    All ties have the same weight, the lens is fixed, and solvePnP gets no initial pose. solvePnP
    and the rejection of outliers alternate until the set of inliers no longer changes. The first
    inliers are found by robust sampling, since least squares with all ties would fail.
    """
    robust = robust_start(tied, params)
    if robust is None:
        return no_pose(tied.seen)
    # solvePnP assumes that all pixels have the same uncertainty and that the points are exact.
    n = len(tied.seen)
    sigma_px = np.full(n, expected_px(tied.control(robust.agreeing)))
    equal = replace(tied, seen=replace(tied.seen, sigma_px=sigma_px, sigma_m=np.zeros(n)))
    fixed = replace(robust.lens, freedom=LensFreedom())
    try:
        return adjusted(equal, replace(robust, lens=fixed), params, _solved)
    except GeometryError as error:
        return f"{error}: use orient.pnp with method weighted"


def _solved(seen: SeenPoints, lens: ViewingCamera) -> ViewingCamera:
    """Return the camera with the pose from solvePnP.

    Raises:
        GeometryError: solvePnP finds no pose.
    """
    import cv2

    if len(seen) < _LEAST:
        raise GeometryError(f"solvePnP needs {_LEAST} ties; only {len(seen)} agree with one pose")
    if lens.skew:
        raise GeometryError(f"solvePnP does not support skew, and the lens has {lens.skew:.1f} px")
    # Shift the origin, since large survey coordinates would reduce the precision.
    middle = seen.points_world.mean(axis=0)
    # The type stubs of OpenCV do not accept these arrays.
    call: Any = cv2.solvePnP
    try:
        found, turn, shift = call(
            seen.points_world - middle,
            np.ascontiguousarray(to_opencv(seen.pixels_photo)),
            opencv_matrix(lens),
            lens.distortion,
            flags=cv2.SOLVEPNP_ITERATIVE,
        )
    except cv2.error as error:
        raise GeometryError(f"solvePnP failed ({error.err})") from error
    if not found:
        raise GeometryError("solvePnP finds no pose")
    return lens.at_opencv_pose(turn, shift, middle)
