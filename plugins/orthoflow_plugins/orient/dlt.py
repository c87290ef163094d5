"""`orient.dlt`: direct linear transform of single photos (markiewicz2015, 3.6 and 4.3).

The eleven parameters are estimated without prior knowledge and used as initial values of an
adjustment. The predicted error includes the distortion of the lens that the model omits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from importlib.metadata import version
from typing import ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from orthoflow.errors import GeometryError
from orthoflow.geometry.cameras import LensFreedom, ViewingCamera, linearised
from orthoflow.geometry.resection import (
    Resection,
    SeenPoints,
    adjust,
    moved_origin,
    predicted_covariances,
)
from orthoflow.sdk import DiagnosticSpec, Method, MetricSpec, StepContext
from orthoflow.sdk.methods import Determinism
from orthoflow_plugins.orient.photos import each_by_itself
from orthoflow_plugins.orient.pose import (
    ORIENTATION_METRICS,
    SOFT_LIMIT,
    Estimate,
    Lens,
    Note,
    OrientIn,
    OrientOut,
    OrientParams,
    Start,
    TiedPhoto,
    adjusted,
    no_pose,
    robust_start,
)
from orthoflow_plugins.orient.report import hand_over

Distortion = Literal["none", "k1", "k1 k2 p1 p2"]

# This prior has practically no effect, since control points with relief determine a lens far
# better.
_FREE: Final = {"focal_sigma": 1.0, "aspect_sigma": 0.5}
_CENTRE_SHARE: Final = 0.5
_SKEW_SHARE: Final = 0.5
# Unless the relief is deep, decentring distortion is correlated with the principal point, which
# therefore gets this tighter prior.
_PINNED_CENTRE_SHARE: Final = 0.05
_FULL: Final = "k1 k2 p1 p2"
_FREEDOMS: Final[Mapping[Distortion, LensFreedom]] = {
    "none": LensFreedom(**_FREE),
    "k1": LensFreedom(**_FREE, k1_sigma=0.5),
    _FULL: LensFreedom(**_FREE, k1_sigma=0.5, k2_sigma=0.5, tangential_sigma=0.01),
}
_LEAST: Final[Mapping[Distortion, int]] = {"none": 12, "k1": 16, _FULL: 24}
# Relief of less than this many standard deviations of the points is mostly noise.
_RELIEF_SIGMAS: Final = 10.0
# If the condition number exceeds this, the control points are so close to a plane that rounding
# errors of the coordinates affect the eleven parameters.
_MAX_CONDITION: Final = 5000.0
# The lens model is considered insufficient if the standard deviation of unit weight exceeds this.
_MAX_SIGMA0: Final = 1.5
# Lens models are compared on a grid with this many points per side of the photo.
_FRAME: Final = 12
DLT_MISFIT: Final = DiagnosticSpec(
    code="dlt-without-distortion",
    severity="warning",
    text="photo {subject}: the ties deviate {sigma0:.1f} times as much as expected, since the "
    "lens has distortion that this DLT does not model (a complete lens model moves points by "
    "{moved_px:.1f} px, mostly at the corners); the predicted error was multiplied by "
    "{factor:.1f}",
    remedy='set {step}.distortion to "k1 k2 p1 p2", or provide a calibration',
    rank_by="sigma0",
)


class OrientDlt(Method):
    """Orient each photo from its ties only, by eleven parameters, or by more with distortion.

    Calibration and EXIF are used only to reject wrong ties; `prior: none` does not use them at all.
    The linear solution gives the initial values of a weighted adjustment of pose, fx, fy, principal
    point and, if requested, distortion. The skew is recorded, but only used if requested, since
    modern cameras have no skew. Photos with nearly coplanar control points are rejected, since such
    points do not determine the parameters. The gates are the same as in `orient.pnp`.
    """

    id: ClassVar[str] = "orient.dlt"
    determinism: ClassVar[Determinism] = "seeded"
    result_version: ClassVar[int] = 6
    metrics: ClassVar[tuple[MetricSpec, ...]] = ORIENTATION_METRICS
    citations: ClassVar[tuple[str, ...]] = (
        "Abdel-Aziz, Karara 1971, Direct linear transformation, doi:10.14358/PERS.81.2.103",
        "Hartley 1997, In defense of the eight-point algorithm, doi:10.1109/34.601246",
        "Markiewicz, Podlasiak, Zawieska 2015, doi:10.3390/rs71215869 (3.6, 4.3)",
    )

    class Params(OrientParams):
        """Distortion, skew, and the parameters of `orient.pnp`."""

        distortion: Distortion = Field(
            default="none",
            description="Distortion parameters estimated in addition to the eleven: none, k1, or "
            "k1 k2 p1 p2.",
        )
        skew: bool = Field(
            default=False,
            description="Use the skew, the eleventh parameter (the angle between pixel rows and "
            "columns), in the camera model and the orthoimage.",
        )
        prior: Literal["lens", "none"] = Field(
            default="lens",
            description="Lens used to reject wrong ties. lens: from calibration or EXIF; none: "
            "several usual focal lengths are tried (markiewicz2015).",
        )

    In = OrientIn
    Out = OrientOut

    def run(self, inputs: OrientIn, params: Params, ctx: StepContext) -> OrientOut:
        """Orient each photo separately."""

        def estimator(tied: TiedPhoto, _: OrientParams) -> Estimate | str:
            return estimate_dlt(tied, params)

        found = each_by_itself(inputs, params, ctx, estimator)
        return OrientOut(cameras=hand_over(ctx, inputs.ties, inputs.photos.photos, found))

    @classmethod
    def tools(cls) -> dict[str, str]:
        """OpenCV for the rejection of wrong ties."""
        return {name: version(name) for name in ("opencv-python-headless", "scipy")}


def relief(points: NDArray[np.float64]) -> tuple[float, float]:
    """Measure the relief of points (n, 3) about their best-fitting plane.

    Returns:
        RMS distance from the plane in metres, and standard deviation along the longest axis in
        metres.
    """
    centred = points - points.mean(axis=0)
    variances = np.linalg.eigvalsh(np.einsum("ni,nj->ij", centred, centred) / len(points))
    roots = np.sqrt(np.maximum(variances, 0.0))
    return float(roots[0]), float(roots[2])


def direct_linear(
    pixels: NDArray[np.float64], points_world: NDArray[np.float64], size_px: tuple[int, int]
) -> tuple[ViewingCamera, float]:
    """Solve for the eleven parameters (Abdel-Aziz & Karara 1971, normalised after Hartley 1997).

    Args:
        pixels: (n, 2) pixels of at least six points.
        points_world: (n, 3) coordinates in metres.
        size_px: width and height of the photo.

    Returns:
        The camera, with skew but without distortion; and the ratio of the largest to the second
        smallest singular value of the normalised equations, which tends to infinity for coplanar
        points.

    Raises:
        GeometryError: the points do not determine a camera.
    """
    if len(pixels) < 6:
        raise GeometryError(f"a direct linear transform needs six points, got {len(pixels)}")
    shift_px, scale_px = _normalisation(pixels, math.sqrt(2.0))
    shift_m, scale_m = _normalisation(points_world, math.sqrt(3.0))
    uv = (pixels - shift_px) * scale_px
    xyz = np.column_stack([(points_world - shift_m) * scale_m, np.ones(len(pixels))])
    rows = np.zeros((len(pixels), 2, 12))
    rows[:, 0, :4], rows[:, 0, 8:] = xyz, -uv[:, :1] * xyz
    rows[:, 1, 4:8], rows[:, 1, 8:] = xyz, -uv[:, 1:] * xyz
    # Solve normal equations with a fixed order of summation, since the result of a singular value
    # decomposition depends on the number of threads. The subsequent adjustment restores the lost
    # precision.
    values, vectors = np.linalg.eigh(np.einsum("nij,nik->jk", rows, rows))
    matrix = vectors[:, 0].reshape(3, 4)
    inverse_px = np.array(
        [[1 / scale_px, 0.0, shift_px[0]], [0.0, 1 / scale_px, shift_px[1]], [0.0, 0.0, 1.0]]
    )
    local = inverse_px @ matrix @ np.diag([scale_m, scale_m, scale_m, 1.0])
    camera = _decomposed(local, points_world - shift_m, size_px)
    condition = math.sqrt(float(values[-1]) / max(float(values[1]), 1e-300))
    return camera.shifted(-shift_m), condition


def estimate_dlt(tied: TiedPhoto, params: OrientDlt.Params) -> Estimate | str:
    """Orient a photo by a direct linear transform; return the reason if this fails.

    With `prior: none`, neither calibration nor EXIF is used to reject wrong ties. Without `skew`,
    the adjustment assumes perpendicular pixel rows and columns.
    """
    if params.prior == "none":
        tied = replace(tied, photo=replace(tied.photo, intrinsics=None, exif_focal_px=None))
    robust = robust_start(tied, params)
    if robust is None:
        return no_pose(tied.seen)
    control = tied.control(robust.agreeing)
    least = _LEAST[params.distortion] + params.skew
    if reason := _too_poor(control, params.distortion, least):
        return reason
    size_px = (tied.photo.width, tied.photo.height)
    try:
        linear, condition = direct_linear(control.pixels_photo, control.points_world, size_px)
        if condition > _MAX_CONDITION:
            return _flat(control, f"the condition number of the equations is {condition:.0f}")
        camera = linear if params.skew else replace(linear, skew=0.0)
        lens = Lens(
            prior=replace(camera, cx=0.5 * size_px[0], cy=0.5 * size_px[1], skew=0.0),
            freedom=_freedom(params.distortion, size_px, keeps_skew=params.skew),
            source="dlt",
        )
        start = Start(camera=camera, lens=lens, agreeing=robust.agreeing, n_least_for_lens=least)
        estimate = adjusted(tied, start, params)
    except GeometryError as error:
        return f"{error}: use orient.pnp or orient.colmap-bundle"
    skew_px = estimate.resection.camera.skew if params.skew else linear.skew
    estimate = replace(estimate, numbers={"skew_px": skew_px, "condition": condition})
    control = tied.control(estimate.agreeing)
    if params.distortion == _FULL or len(control) < _LEAST[_FULL]:
        return estimate
    fuller = _freedom(_FULL, size_px, keeps_skew=params.skew)
    return _with_what_is_missing(estimate, control, start, fuller)


def _normalisation(values: NDArray[np.float64], length: float) -> tuple[NDArray[np.float64], float]:
    """Return the shift and scale that centre points and set their mean distance to `length`."""
    shift = values.mean(axis=0)
    mean = float(np.linalg.norm(values - shift, axis=1).mean())
    if not mean > 0.0:
        raise GeometryError("all points of a direct linear transform coincide")
    return shift, length / mean


def _decomposed(
    matrix: NDArray[np.float64], points: NDArray[np.float64], size_px: tuple[int, int]
) -> ViewingCamera:
    """Decompose a projection matrix (3, 4) into lens and pose."""
    if np.linalg.det(matrix[:, :3]) < 0.0:
        matrix = -matrix
    # Compute the RQ decomposition by a QR decomposition with rows and columns reversed.
    q, r = np.linalg.qr(matrix[::-1, :3].T)
    upper, rotation = r.T[::-1, ::-1], q.T[::-1]
    signs = np.sign(np.diag(upper))
    if not signs.all():
        raise GeometryError("the points of a direct linear transform do not determine a camera")
    upper, rotation = upper * signs, signs[:, None] * rotation
    translation = np.linalg.solve(upper, matrix[:, 3])
    if float(np.median(points @ rotation[2] + translation[2])) <= 0.0:
        raise GeometryError("a direct linear transform puts the points behind the camera")
    upper = upper / upper[2, 2]
    return ViewingCamera(
        width=size_px[0],
        height=size_px[1],
        fx=float(upper[0, 0]),
        fy=float(upper[1, 1]),
        cx=float(upper[0, 2]),
        cy=float(upper[1, 2]),
        distortion=np.zeros(5),
        rotation=rotation,
        translation=translation,
        skew=float(upper[0, 1]),
    )


def _freedom(distortion: Distortion, size_px: tuple[int, int], *, keeps_skew: bool) -> LensFreedom:
    share = _PINNED_CENTRE_SHARE if distortion == _FULL else _CENTRE_SHARE
    return replace(
        _FREEDOMS[distortion],
        centre_sigma_px=share * max(size_px),
        skew_sigma_px=_SKEW_SHARE * max(size_px) if keeps_skew else 0.0,
    )


def _too_poor(control: SeenPoints, distortion: Distortion, least: int) -> str:
    """Return why the control points do not suffice for a DLT; empty if they do."""
    if len(control) < least:
        return (
            f"only {len(control)} control ties agree with one pose; a DLT with distortion "
            f'"{distortion}" requires {least}'
        )
    rms_m, extent_m = relief(control.points_world)
    sigma_m = float(np.sqrt(np.mean(control.sigma_m**2)))
    if rms_m < _RELIEF_SIGMAS * sigma_m:
        return _flat(
            control,
            f"their standard deviation is {1000 * sigma_m:.1f} mm, and a DLT needs "
            f"{_RELIEF_SIGMAS:g} times as much relief",
        )
    return _flat(control, "a DLT needs relief") if rms_m < extent_m / _MAX_CONDITION else ""


def _with_what_is_missing(
    estimate: Estimate, control: SeenPoints, start: Start, freedom: LensFreedom
) -> Estimate:
    """Add the systematic error of an incomplete lens model to the covariance.

    Residuals show less than a tenth of the missing distortion, because the other parameters absorb
    most of it, which causes errors between and beyond the ties. Therefore, the covariance is that
    of the complete model plus the squared difference between the models. Without this term, the
    predicted error with eleven parameters would be a ninth of the actual error for a typical lens
    with unknown distortion.

    Args:
        estimate: estimate with the incomplete model.
        control: the control points.
        start: initial values of the adjustment.
        freedom: free lens parameters of the complete model.
    """
    model = estimate.resection
    try:
        full = adjust(
            control,
            model.camera,
            prior=start.lens.prior,
            lens=freedom,
            independent=False,
            soft_limit=SOFT_LIMIT * max(model.sigma0, 1.0),
        )
    except GeometryError:
        return estimate
    points = control.points_world
    # Mean squared difference per coordinate, minus the part that the variance of the complete model
    # explains.
    moved_px = _moved_px(model.camera, full.camera, points)
    missing = 0.5 * float((moved_px**2).sum(axis=1).mean()) - _variance_px2(full, points)
    if missing <= 0.0:
        return estimate
    bias = _bias(model.camera, full, control)
    wider = replace(model, covariance=full.covariance + np.outer(bias, bias), lens=full.lens)
    factor = _variance_px2(wider, points) / _variance_px2(model, points)
    wider = replace(wider, variance_factor=factor * model.variance_factor)
    # The variance factor already includes the error of the lens model that neighbouring ties share.
    beyond_noise = factor * model.variance_factor / model.sigma0**2
    notes: tuple[Note, ...] = ()
    if model.sigma0 > _MAX_SIGMA0 or beyond_noise > _MAX_SIGMA0**2:
        values = {"moved_px": math.sqrt(missing), "factor": math.sqrt(beyond_noise)}
        notes = ((DLT_MISFIT, {"sigma0": model.sigma0, **values}),)
    return replace(estimate, resection=wider, notes=notes)


def _flat(control: SeenPoints, why: str) -> str:
    rms_m, _ = relief(control.points_world)
    return (
        f"the control ties are within {1000 * rms_m:.1f} mm (RMS) of one plane; {why}: use "
        "orient.pnp or orient.colmap-bundle"
    )


def _bias(camera: ViewingCamera, full: Resection, control: SeenPoints) -> NDArray[np.float64]:
    """Return the parameter change (p,) that best reproduces the complete model in the photo.

    The difference of the parameters is unsuitable: large changes of focal length and distance
    compensate each other, but not in the linearised model.
    """
    middle = control.points_world.mean(axis=0)
    points = _frame_points(camera, control) - middle
    near = camera.shifted(middle)
    linear = linearised(near, points, full.lens)
    moved = _moved_px(near, full.camera.shifted(middle), points)
    seen = np.isfinite(moved).all(axis=1)
    rows = linear.by_parameters[seen].reshape(-1, len(full.covariance))
    scale = np.linalg.norm(rows, axis=0)
    bias = np.linalg.lstsq(rows / scale, moved[seen].ravel(), rcond=1e-9)[0] / scale
    return np.asarray(moved_origin(camera, middle, len(bias)) @ bias)


def _frame_points(camera: ViewingCamera, control: SeenPoints) -> NDArray[np.float64]:
    """Return points (n, 3) on rays through a grid of pixels, at the range of control points.

    Each point has the range of the control point nearest to it in the photo.
    """
    across, down = ((np.arange(_FRAME) + 0.5) / _FRAME for _ in range(2))
    pixels = np.stack(np.meshgrid(across * camera.width, down * camera.height), axis=-1)
    pixels = pixels.reshape(-1, 2)
    off = pixels[:, None] - control.pixels_photo
    nearest = (off**2).sum(axis=2).argmin(axis=1)
    ranges = np.linalg.norm(control.points_world - camera.centre_world, axis=1)
    rays = camera.rays_world(pixels)
    points: NDArray[np.float64] = (
        camera.centre_world + (ranges[nearest] / np.linalg.norm(rays, axis=1))[:, None] * rays
    )
    return points


def _moved_px(
    camera: ViewingCamera, other: ViewingCamera, points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the differences (n, 2), in pixels, between the projections by two cameras."""
    return other.project(points)[:, :2] - camera.project(points)[:, :2]


def _variance_px2(resection: Resection, points: NDArray[np.float64]) -> float:
    """Return the predicted variance of a pixel coordinate, averaged over points (n, 3)."""
    covariances = predicted_covariances(resection, points)
    return 0.5 * float(np.trace(covariances, axis1=1, axis2=2).mean())
