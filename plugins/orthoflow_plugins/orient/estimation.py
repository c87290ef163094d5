"""The pose of one photo: robust start, adjustment, and which ties agree with it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.lenses import POSE_PARAMETERS, LensFreedom
from orthoflow.geometry.opencv_border import opencv_matrix, to_opencv
from orthoflow.geometry.resection import (
    Misfit,
    Resection,
    SeenPoints,
    adjust,
    first_step,
    fitted,
    misfit,
    pixels_by_point,
    stated,
)
from orthoflow.geometry.robust import MEDIAN_LENGTH
from orthoflow.products import Intrinsics, Photo
from orthoflow_plugins.orient.layout import GROUPS, image_cells
from orthoflow_plugins.orient.lenses import UNKNOWN, focal_sigma, intrinsics_of, lens_prior

_LEAST_FOR_POSE: Final = 4
_CONFIDENCE: Final = 0.99999
_ROUNDS: Final = 8
# A standard deviation of unit weight that changes by less changes no tie's weight to speak of.
_SETTLED_SHARE: Final = 0.02
_SIGMA0_RANGE: Final = (0.1, 3.0)
_CHANCE_SHARE_MOST: Final = 0.1
_TIGHTENING: Final = 0.8
_TIGHTENED_MOST: Final = 7
# Residuals beyond so many standard deviations pull less (Huber). One normal tie in a hundred does;
# at 2, one in seven did, which cost exactness and understated the error by another tenth.
SOFT_LIMIT: Final = 3.0
# What is known of a lens beforehand keeps it in bounds; so many ties make the equations solvable.
_LEAST_FOR_LENS: Final = 8
# A calibration that is off by more than both is another lens's.
_FOCAL_OFF_LEAST: Final = 0.03
_FOCAL_OFF_SIGMAS: Final = 5.0
# A first step far below that saves the rest of the adjustment.
_FOCAL_STEP_LEAST: Final = 0.5 * _FOCAL_OFF_LEAST
_LEAST_FOR_FOCAL: Final = 25
# EXIF is off by some percent at most where it is right: a focal length farther from it that many
# more ties agree with shows that it is wrong.
_EXIF_OFF_LEAST: Final = 0.15
_MANY_MORE: Final = 1.2
_OTHER_LENS: Final = LensFreedom(focal_sigma=0.35, k1_sigma=0.1)


@dataclass(frozen=True, kw_only=True)
class EstimationRule:
    """How a photo is oriented.

    Attributes:
        rejection_sigma: ties beyond so many standard deviations are rejected.
        threshold_px: ties agree with a sampled pose up to this distance; None derives it from
            their sigmas.
        n_trials_most: samples drawn at most.
        seed: of the samples.
    """

    rejection_sigma: float
    threshold_px: float | None
    n_trials_most: int
    seed: int


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A photo's pose with what it was found from.

    Attributes:
        resection: the adjusted camera.
        intrinsics: its interior orientation.
        source: what was known of the lens before: `calibration`, `exif`, `none` ...
        fit: of all the photo's ties, control and check.
        agreeing: (n,) bool, ties within the limit.
        limit: in standard deviations, as `fit.normalised`.
        notes: what its method has to say of it.
        numbers: what its method alone measures, by name, for the record.
        without_one: of a pose from ties that a person measured, how exact it is without each of
            them in turn; empty for others.
    """

    resection: Resection
    intrinsics: Intrinsics
    source: str
    fit: Misfit
    agreeing: NDArray[np.bool_]
    limit: float
    notes: tuple[str, ...] = ()
    numbers: Mapping[str, float] = field(default_factory=dict)
    without_one: tuple[Resection, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Start:
    """Where the adjustment of a photo starts.

    Attributes:
        camera: pose and lens.
        prior: what the lens is beforehand; of its pose nothing is used.
        agreeing: (n,) bool, ties that determine the first adjustment.
        freedom: what the adjustment may change of the lens.
        source: what the lens is known from.
        n_least_for_lens: ties that must agree before the lens may change.
    """

    camera: ViewingCamera
    prior: ViewingCamera
    agreeing: NDArray[np.bool_]
    freedom: LensFreedom
    source: str
    n_least_for_lens: int = _LEAST_FOR_LENS


def estimate_pose(
    photo: Photo, seen: SeenPoints, is_check: NDArray[np.bool_], rule: EstimationRule
) -> Estimate | str:
    """Orient a photo by its control ties, or say why not.

    Args:
        photo: the photo.
        seen: its ties.
        is_check: (n,) ties withheld from everything but the final fit.
        rule: how.
    """
    start = robust_start(photo, seen, is_check, rule)
    if start is None:
        return no_pose(seen)
    try:
        found = adjusted(photo, seen, is_check, start, rule)
    except GeometryError:
        return no_pose(seen)
    return _calibration_doubt(found, seen.take(found.agreeing & ~is_check)) or found


def focal_without_exif(
    photo: Photo, seen: SeenPoints, is_check: NDArray[np.bool_], rule: EstimationRule
) -> float | None:
    """Return the focal length in pixels that a photo's ties ask for where EXIF's contradicts them.

    Returns:
        None where they do not contradict it, or say too little of it.
    """
    if photo.intrinsics is not None or photo.exif_focal_px is None or len(seen) < _LEAST_FOR_FOCAL:
        return None
    unknown = replace(photo, exif_focal_px=None)
    start = robust_start(unknown, seen, is_check, rule)
    if start is None or start.agreeing.sum() < _LEAST_FOR_FOCAL:
        return None
    by_exif = robust_start(photo, seen, is_check, rule)
    if by_exif is not None and start.agreeing.sum() < _MANY_MORE * by_exif.agreeing.sum():
        return None
    try:
        found = adjusted(unknown, seen, is_check, start, rule).resection
    except GeometryError:
        return None
    off = abs(math.log(found.camera.fx / photo.exif_focal_px))
    sigma = focal_sigma(found)
    return found.camera.fx if off > max(_EXIF_OFF_LEAST, _FOCAL_OFF_SIGMAS * sigma) else None


def no_pose(seen: SeenPoints) -> str:
    """Say that a photo's ties contradict each other."""
    return f"no pose agrees with enough of its {len(seen)} ties"


def robust_start(
    photo: Photo, seen: SeenPoints, is_check: NDArray[np.bool_], rule: EstimationRule
) -> Start | None:
    """Find the pose that most control ties agree with; None when there is none."""
    prior, control = lens_prior(photo), seen.take(~is_check)
    if rule.threshold_px is None:
        # A lens known only roughly misplaces even right ties.
        slack = 1.0 if prior.source not in ("exif", UNKNOWN) else 2.0
        rule = replace(rule, threshold_px=slack * rule.rejection_sigma * expected_px(control))
    best: _RobustPose | None = None
    for intrinsics in prior.guesses:
        pose = _robust_pose(control, intrinsics.posed(), rule)
        if pose is not None and (best is None or pose.agreeing.sum() > best.agreeing.sum()):
            best = pose
    if best is None:
        return None
    agreeing = np.zeros(len(seen), dtype=np.bool_)
    agreeing[~is_check] = best.agreeing
    # Points that appear twice say nothing new to a pose of six unknowns.
    if len(set(map(tuple, seen.points_world[agreeing].round(4).tolist()))) < 5:
        return None
    return Start(
        camera=best.camera,
        prior=best.camera,
        agreeing=agreeing,
        freedom=prior.freedom,
        source=prior.source,
    )


def adjusted(
    photo: Photo,
    seen: SeenPoints,
    is_check: NDArray[np.bool_],
    start: Start,
    rule: EstimationRule,
) -> Estimate:
    """Adjust and reject in turns until the control ties stay the same.

    Raises:
        GeometryError: the ties that agree do not determine the camera.
    """
    camera, agreeing = start.camera, start.agreeing
    unit = unit_deviation(misfit(seen, camera).normalised[agreeing & ~is_check])
    for _ in range(_ROUNDS):
        used = agreeing & ~is_check
        lens = start.freedom if used.sum() >= start.n_least_for_lens else LensFreedom()
        control, soft_limit = seen.take(used), SOFT_LIMIT * unit
        # A lens that may not change is the one known beforehand.
        begin = camera if lens.sigmas.size else posed(start.prior, camera)
        camera = fitted(control, begin, prior=start.prior, lens=lens, soft_limit=soft_limit)
        fit = misfit(seen, camera)
        before, unit = unit, unit_deviation(fit.normalised[used])
        limit = without_chance(fit.normalised[~is_check], rule.rejection_sigma * unit)
        again = fit.normalised <= limit
        if np.array_equal(again & ~is_check, used) and abs(unit / before - 1.0) < _SETTLED_SHARE:
            break
        agreeing = again
    resection = stated(
        control,
        camera,
        prior=start.prior,
        lens=lens,
        groups=image_cells(control.pixels_photo, (photo.width, photo.height), GROUPS),
        soft_limit=soft_limit,
    )
    return Estimate(
        resection=resection,
        intrinsics=intrinsics_of(resection, start.source),
        source=start.source,
        fit=fit,
        agreeing=again,
        limit=limit,
    )


def without_chance(normalised: NDArray[np.float64], limit: float) -> float:
    """Tighten a limit until hardly any wrong tie lies within it by chance.

    Wrong ties near a pose lie evenly around where they should be: the ring from one to three
    times the limit has eight times the area within it and tells how many to expect.
    """
    lengths = np.sort(normalised[np.isfinite(normalised)])
    for tightened in limit * _TIGHTENING ** np.arange(_TIGHTENED_MOST):
        inside, around = np.searchsorted(lengths, [tightened, 3.0 * tightened], side="right")
        if (around - inside) / 8.0 <= _CHANCE_SHARE_MOST * inside:
            return float(tightened)
    return float(tightened)


def unit_deviation(normalised: NDArray[np.float64]) -> float:
    """Robust standard deviation of unit weight, kept within reason."""
    median = float(np.median(normalised)) if normalised.size else 1.0
    return float(np.clip(median / MEDIAN_LENGTH, *_SIGMA0_RANGE))


def expected_px(seen: SeenPoints) -> float:
    """Usual deviation of a tie before any pose: the photo's scale from the spread of its ties."""
    spread_px = float(np.median(np.abs(seen.pixels_photo - np.median(seen.pixels_photo, axis=0))))
    lengths = np.abs(seen.points_world - np.median(seen.points_world, axis=0)).max(axis=1)
    per_metre = spread_px / max(0.5 * float(np.median(lengths)), 1e-6)
    sigma = np.hypot(np.median(seen.sigma_px), per_metre * np.median(seen.sigma_m))
    return float(sigma)


def metres_per_pixel(camera: ViewingCamera, points_world: NDArray[np.float64]) -> float:
    """Size of a pixel of the photo at the points, median over them."""
    derivatives = pixels_by_point(camera, points_world)
    across = np.linalg.svd(derivatives, compute_uv=False)
    return float(np.median(1.0 / np.sqrt(across[:, 0] * across[:, 1])))


def posed(lens: ViewingCamera, pose: ViewingCamera) -> ViewingCamera:
    """Give the lens of one camera the pose of another."""
    return replace(lens, rotation=pose.rotation, translation=pose.translation)


def undistorted_pixels(pixels: NDArray[np.float64], lens: ViewingCamera) -> NDArray[np.float64]:
    """Pixels (n, 2) as without distortion and skew; NaN where the lens model cannot be undone."""
    if not (lens.distortion.any() or lens.skew):
        return pixels
    try:
        rays = lens.rays_camera(pixels)
    except GeometryError:
        rays = np.full((len(pixels), 3), np.nan)
        for index in range(len(pixels)):
            try:
                rays[index] = lens.rays_camera(pixels[index : index + 1])[0]
            except GeometryError:
                continue
    return rays[:, :2] * [lens.fx, lens.fy] + [lens.cx, lens.cy]


@dataclass(frozen=True, kw_only=True)
class _RobustPose:
    """A pose and the ties that agree with it.

    Attributes:
        camera: the camera at that pose.
        agreeing: (n,) bool.
    """

    camera: ViewingCamera
    agreeing: NDArray[np.bool_]


def _calibration_doubt(found: Estimate, control: SeenPoints) -> str:
    """Say that a calibrated photo was taken with another focal length; empty when it may be right.

    The pose of such a photo takes up most of the mistake, and its residuals do not show the rest.
    """
    camera = found.resection.camera
    if found.resection.lens.sigmas.size or len(control) < _LEAST_FOR_FOCAL:
        return ""
    try:
        step = first_step(control, camera, _OTHER_LENS, soft_limit=SOFT_LIMIT)
        if abs(step[POSE_PARAMETERS]) < _FOCAL_STEP_LEAST:
            return ""
        cells = image_cells(control.pixels_photo, (camera.width, camera.height), GROUPS)
        free = adjust(control, camera, lens=_OTHER_LENS, groups=cells, soft_limit=SOFT_LIMIT)
    except GeometryError:
        return ""
    off = abs(math.log(free.camera.fx / camera.fx))
    sigma = math.sqrt(float(free.covariance[POSE_PARAMETERS, POSE_PARAMETERS]))
    if off < max(_FOCAL_OFF_LEAST, _FOCAL_OFF_SIGMAS * sigma):
        return ""
    return (
        f"its ties ask for a focal length of {free.camera.fx:.0f} px, give or take "
        f"{sigma * free.camera.fx:.0f} px, but its calibration says {camera.fx:.0f} px: it is the "
        "calibration of another lens, zoom or image size"
    )


def _robust_pose(seen: SeenPoints, lens: ViewingCamera, rule: EstimationRule) -> _RobustPose | None:
    """Find the pose that most ties agree with (MSAC on P3P: Torr & Zisserman 2000).

    Args:
        seen: the ties.
        lens: the camera's interior orientation; its pose is ignored.
        rule: how samples are drawn; its `threshold_px` is known.

    Returns:
        None when no pose is found.
    """
    import cv2

    usable = undistorted_pixels(seen.pixels_photo, lens)
    inside: NDArray[np.bool_] = np.asarray(np.isfinite(usable).all(axis=1))
    if inside.sum() < _LEAST_FOR_POSE:
        return None
    middle = seen.points_world.mean(axis=0)
    pixels = np.ascontiguousarray(to_opencv(usable[inside]))
    points = np.ascontiguousarray(seen.points_world[inside] - middle)
    call: Any = cv2.solvePnPRansac
    try:
        found, _, turn, shift, agreed = call(
            points, pixels, opencv_matrix(lens), None, params=_usac(rule)
        )
    except cv2.error:  # no sample has a solution
        return None
    if not found or agreed is None:
        return None
    rotation = np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64)
    local = replace(lens, rotation=rotation, translation=np.asarray(shift).ravel())
    agreeing = np.zeros(len(inside), dtype=np.bool_)
    agreeing[np.flatnonzero(inside)[np.asarray(agreed).ravel()]] = True
    return _RobustPose(camera=local.shifted(-middle), agreeing=agreeing)


def _usac(rule: EstimationRule) -> Any:
    """OpenCV's universal sampling, one thread: several give another result each time."""
    import cv2

    params: Any = cv2.UsacParams()
    params.threshold = rule.threshold_px
    params.maxIterations = rule.n_trials_most
    params.confidence = _CONFIDENCE
    params.randomGeneratorState = rule.seed
    params.isParallel = False
    params.score = cv2.SCORE_METHOD_MSAC
    # The adjustment that follows does what a local optimisation would do in thrice the time.
    params.loMethod = cv2.LOCAL_OPTIM_NULL
    return params
