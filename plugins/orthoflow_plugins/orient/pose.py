"""Pose of a single photo: lens prior, robust initial pose, adjustment and rejection of ties."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from orthoflow.errors import GeometryError
from orthoflow.geometry.cameras import (
    POSE_PARAMETERS,
    LensFreedom,
    ViewingCamera,
    opencv_matrix,
    to_opencv,
    undistorted,
)
from orthoflow.geometry.resection import (
    Misfit,
    Resection,
    SeenPoints,
    adjust,
    fitted,
    misfit,
    stated,
)
from orthoflow.geometry.robust import MEDIAN_LENGTH
from orthoflow.products import Cameras, Intrinsics, Photo, Photos, PointCloud, Ties
from orthoflow.sdk import DiagnosticSpec, MethodParams, MetricSpec, Ports

# Declaration and values of a diagnostic about one photo.
Note: TypeAlias = tuple[DiagnosticSpec, Mapping[str, Any]]
NOT_ORIENTED: Final = DiagnosticSpec(
    code="photo-not-oriented",
    severity="warning",
    text="photo {subject} is not oriented: {status}",
)


def _median_and_worst(
    name: str, label: str, *, is_headline: bool = False, description: str = ""
) -> tuple[MetricSpec, MetricSpec]:
    """Declare a metric that consists of the median and the worst value over the photos."""

    def spec(which: str, **more: Any) -> MetricSpec:
        return MetricSpec(
            f"{name}_{which}",
            label=f"{label}, {which} photo",
            better="lower",
            counted_by="n_oriented",
            **more,
        )

    return spec("median"), spec("worst", headline=is_headline, description=description)


ORIENTATION_METRICS: Final = (
    MetricSpec("n_photos", label="photos"),
    MetricSpec("n_oriented", label="photos oriented", better="higher", headline=True),
    MetricSpec("n_refused", label="photos refused"),
    MetricSpec("n_ties", label="ties"),
    MetricSpec("n_control", label="control ties"),
    MetricSpec("n_check", label="withheld ties"),
    MetricSpec("rejected_share", label="share of rejected ties"),
    MetricSpec(
        "scan_registration_mm",
        label="registration error of a scan, per coordinate",
        better="lower",
        description="standard deviation, from surfaces that several scans contain",
    ),
    *_median_and_worst("control_rmse_px", "control ties, RMS residual per axis"),
    *_median_and_worst("check_rmse_px", "withheld ties, RMS residual per axis"),
    *_median_and_worst(
        "check_rmse_mm",
        "withheld ties, RMS residual per axis on the wall",
        is_headline=True,
        description="mean over both axes of the photo; the error along one axis of the wall may "
        "be larger",
    ),
    *_median_and_worst(
        "sigma_wall_mm",
        "expected error of the orientation on the wall",
        is_headline=True,
        description="relative to the scan, so errors of the scan and its depths are not included",
    ),
)
"""Metrics of all orientation methods."""


class OrientIn(Ports):
    """Ties to the walls, the photos in which they were found, and the cloud of the walls.

    The cloud shows how well its scans are registered, which is part of the expected errors.
    """

    ties: Ties
    photos: Photos
    cloud: PointCloud | None = None


class OrientOut(Ports):
    """One orientation per photo."""

    cameras: Cameras


class OrientParams(MethodParams):
    """Rejection of ties, share of check points, and limits of the gates."""

    rejection_sigma: float = Field(
        default=3.5,
        gt=1,
        le=20,
        description="Ties whose residuals exceed this multiple of their standard deviation are "
        "rejected.",
    )
    threshold_px: float | None = Field(
        default=None,
        gt=0,
        description="Maximum deviation of a tie from a sampled pose; by default it follows from "
        "the standard deviations of the ties.",
    )
    check_share: float = Field(
        default=0.2,
        ge=0.2,
        le=0.5,
        description="Share of the ties that is withheld to check the orientation.",
    )
    min_quadrant_ties: int = Field(
        default=2,
        ge=0,
        description="Minimum number of inliers in each quarter of a photo (markiewicz2015: 2). "
        "Fewer are accepted if the predicted error on the walls in that quarter is below "
        "max_sigma_wall_cells; 0 disables the test.",
    )
    quadrants: Literal["predicted", "strict"] = Field(
        default="predicted",
        description="strict: a photo with fewer than min_quadrant_ties in a quarter is refused "
        "regardless of the predicted error, even if that quarter shows no wall (markiewicz2015).",
    )
    min_hull_ratio: float = Field(
        default=0.4,
        ge=0,
        le=1,
        description="Minimum ratio of the area of the control ties' convex hull to that of the "
        "walls in the photo.",
    )
    max_sigma_wall_cells: float = Field(
        default=1.0,
        gt=0,
        description="Maximum allowed predicted error on the wall (RMS over the area that the photo "
        "shows), in raster cells.",
    )
    max_sigma_corner_cells: float = Field(
        default=3.0,
        gt=0,
        description="Maximum allowed predicted error at the worst position of the area that the "
        "photo shows, in raster cells.",
    )


Sharing = Literal["focal-group", "shared", "per-photo"]
UNKNOWN: Final = "none"
"""Source of a lens without calibration and EXIF."""
MAX_ROUNDS: Final = 8
"""Maximum number of rounds of adjustment and rejection."""
SOFT_LIMIT: Final = 3.0
"""Residuals beyond this many standard deviations get less weight (Huber).

This affects one in a hundred normally distributed ties. A limit of 2 affects one in seven;
it made results less accurate and underestimated their error by a further 10 %.
"""
_LEAST_FOR_POSE: Final = 4
_CONFIDENCE: Final = 0.99999
_MAX_TRIALS: Final = 20_000
# The standard deviation of unit weight has converged if its relative change is below this.
_SETTLED_SHARE: Final = 0.02
_SIGMA0_RANGE: Final = (0.1, 3.0)
_MAX_CHANCE_SHARE: Final = 0.1
_TIGHTENING: Final = 0.8
_MAX_TIGHTENED: Final = 7
# Minimum number of ties to adjust a lens that has a prior.
_LEAST_FOR_LENS: Final = 8
# A calibration belongs to another lens if its focal length differs from that determined by the ties
# by more than both limits.
_MIN_FOCAL_OFF: Final = 0.03
_FOCAL_OFF_SIGMAS: Final = 5.0
_LEAST_FOR_FOCAL: Final = 25
MIN_EXIF_OFF: Final = 0.15
"""EXIF is wrong if its ln f differs from that of the ties by more than this, and many more ties
agree with the latter.

Correct EXIF values are accurate to a few percent.
"""
_MANY_MORE: Final = 1.2
_OTHER_LENS: Final = LensFreedom(focal_sigma=0.35, k1_sigma=0.1)
_EXIF_FACTORS: Final = (1.0, 0.94, 1.06)
_UNKNOWN_FACTORS: Final = (0.75, 0.9375, 1.1875, 1.5, 2.0, 2.75)
_UNDONE: Final = 1e-9


@dataclass(frozen=True, kw_only=True)
class Lens:
    """The lens of one or more photos.

    Attributes:
        prior: camera with the most likely lens; its pose is not used.
        freedom: prior standard deviations of the lens parameters.
        source: source of the prior: `calibration`, `exif`, `UNKNOWN` ...
        guesses: other lenses to try for the first pose.
    """

    prior: ViewingCamera
    freedom: LensFreedom
    source: str
    guesses: tuple[ViewingCamera, ...] = ()


def lens_prior(photo: Photo) -> Lens:
    """Return the prior for the lens of a photo, with focal lengths to try."""
    known, freedom = photo.lens_prior()
    if photo.intrinsics is not None:
        return Lens(prior=known, freedom=freedom, source=photo.intrinsics.source)
    source, factors = (
        (UNKNOWN, _UNKNOWN_FACTORS) if photo.exif_focal_px is None else ("exif", _EXIF_FACTORS)
    )
    prior, *guesses = (
        replace(known, fx=known.fx * factor, fy=known.fy * factor) for factor in factors
    )
    return Lens(prior=prior, freedom=freedom, source=source, guesses=tuple(guesses))


def lens_groups(
    photos: Sequence[Photo],
    cameras: Sequence[ViewingCamera],
    sharing: Sharing,
    apart: Set[int] = frozenset(),
) -> tuple[tuple[int, ...], tuple[Lens, ...]]:
    """Group photos by lens.

    Args:
        photos: the photos.
        cameras: cameras from separate orientations, as initial values of lenses without a prior.
        sharing: with `focal-group`, photos of the same size share a lens if they have the same EXIF
            focal length or calibration, or if they have neither; with `shared`, all photos of the
            same size share a lens; with `per-photo`, each photo has its own lens.
        apart: photos that get a separate lens in any case.

    Returns:
        Index of the lens of each photo, and the lenses.
    """
    members: dict[tuple[object, ...], list[int]] = {}
    for at, photo in enumerate(photos):
        known = photo.exif_focal_px if photo.intrinsics is None else photo.intrinsics
        own = {"shared": (), "per-photo": (None, at), "focal-group": (known,)}[sharing]
        key = (photo.width, photo.height, *((None, at) if at in apart else own))
        members.setdefault(key, []).append(at)
    lens_of, lenses = [0] * len(photos), []
    for index, some in enumerate(members.values()):
        priors = [lens_prior(photos[at]) for at in some]
        lens = min(priors, key=lambda each: each.freedom.focal_sigma)
        if lens.source == UNKNOWN:
            focal_px = float(np.median([cameras[at].fx for at in some]))
            lens = replace(lens, prior=replace(lens.prior, fx=focal_px, fy=focal_px))
        lenses.append(lens)
        for at in some:
            lens_of[at] = index
    return tuple(lens_of), tuple(lenses)


def focal_sigma(resection: Resection) -> float:
    """Return the standard deviation of ln(focal length); infinite if it was not adjusted."""
    if "focal" not in resection.lens.names:
        return math.inf
    column = POSE_PARAMETERS + resection.lens.names.index("focal")
    return math.sqrt(resection.covariance[column, column])


def camera_rays(camera: ViewingCamera, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rays (n, 3) in camera axes, with z = 1; NaN where the distortion has no inverse."""
    found = undistorted(*camera.bent_rays(pixels.T), camera.distortion)
    rays = np.column_stack([found[0], found[1], np.ones(len(pixels))])
    rays[~(found[2] < _UNDONE)] = np.nan
    return rays


@dataclass(frozen=True, kw_only=True)
class TiedPhoto:
    """A photo with its ties.

    Attributes:
        photo: the photo.
        chosen: (n,) indices of the ties of the photo among all ties.
        seen: these ties as observations.
        is_check: (n,) True for check points, which are never used to estimate the pose.
        by_hand: (n,) True for ties measured by hand.
        seed: seed of the robust sampling.
    """

    photo: Photo
    chosen: NDArray[np.intp]
    seen: SeenPoints
    is_check: NDArray[np.bool_]
    by_hand: NDArray[np.bool_]
    seed: int

    def control(self, agreeing: NDArray[np.bool_]) -> SeenPoints:
        """Return a mask (n,) of the inliers that are not check points."""
        return self.seen.take(agreeing & ~self.is_check)


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """The estimated pose of a photo.

    Attributes:
        resection: the adjusted camera.
        source: source of the lens prior: `calibration`, `exif`, `none` ...
        fit: residuals of all ties of the photo, both control and check points.
        agreeing: (n,) bool, ties whose residuals are within the limit.
        limit: rejection limit for `fit.normalised`, in standard deviations.
        notes: diagnostics of the method.
        numbers: further results of the method by name, for the record.
        without_one: for a pose from ties measured by hand, the accuracy without each of these ties;
            otherwise empty.
    """

    resection: Resection
    source: str
    fit: Misfit
    agreeing: NDArray[np.bool_]
    limit: float
    notes: tuple[Note, ...] = ()
    numbers: Mapping[str, float] = field(default_factory=dict)
    without_one: tuple[Resection, ...] = ()

    @property
    def intrinsics(self) -> Intrinsics:
        """The interior orientation, with source `estimated` if it was adjusted."""
        was_estimated = self.resection.lens.sigmas.size or self.source == UNKNOWN
        return Intrinsics.of(
            self.resection.camera, source="estimated" if was_estimated else self.source
        )


Estimator = Callable[[TiedPhoto, OrientParams], Estimate | str]
"""Orients one photo from its control points, or returns the reason why not."""
Solver = Callable[[SeenPoints, ViewingCamera], ViewingCamera]
"""Estimates a pose from points and an initial camera, or raises a `GeometryError`."""


@dataclass(frozen=True, kw_only=True)
class Start:
    """Initial values of an adjustment.

    Attributes:
        camera: pose and lens.
        lens: prior of the lens.
        agreeing: (n,) bool, ties used in the first adjustment.
        n_least_for_lens: minimum number of inliers to adjust the lens.
    """

    camera: ViewingCamera
    lens: Lens
    agreeing: NDArray[np.bool_]
    n_least_for_lens: int = _LEAST_FOR_LENS


def estimate_pose(tied: TiedPhoto, params: OrientParams) -> Estimate | str:
    """Orient a photo from its weighted control points; return a reason if this fails."""
    start = robust_start(tied, params)
    if start is None:
        return no_pose(tied.seen)
    try:
        found = adjusted(tied, start, params)
    except GeometryError:
        return no_pose(tied.seen)
    return _contradicted_calibration(found, tied.control(found.agreeing)) or found


def focal_without_exif(tied: TiedPhoto, params: OrientParams) -> float | None:
    """Return the focal length in pixels from the ties of a photo if it contradicts EXIF.

    Returns:
        None if the focal length agrees with EXIF or cannot be determined.
    """
    exif_px = tied.photo.exif_focal_px
    if tied.photo.intrinsics is not None or exif_px is None or len(tied.seen) < _LEAST_FOR_FOCAL:
        return None
    unknown = replace(tied, photo=replace(tied.photo, exif_focal_px=None))
    start = robust_start(unknown, params)
    if start is None or start.agreeing.sum() < _LEAST_FOR_FOCAL:
        return None
    by_exif = robust_start(tied, params)
    if by_exif is not None and start.agreeing.sum() < _MANY_MORE * by_exif.agreeing.sum():
        return None
    try:
        found = adjusted(unknown, start, params).resection
    except GeometryError:
        return None
    off = abs(math.log(found.camera.fx / exif_px))
    sigma = focal_sigma(found)
    return found.camera.fx if off > max(MIN_EXIF_OFF, _FOCAL_OFF_SIGMAS * sigma) else None


def no_pose(seen: SeenPoints) -> str:
    """Return the message that too few ties agree with one pose."""
    return f"no pose agrees with enough of its {len(seen)} ties"


def robust_start(tied: TiedPhoto, params: OrientParams) -> Start | None:
    """Find the pose with the most inliers among the control points; None if there is none."""
    lens, control = lens_prior(tied.photo), tied.seen.take(~tied.is_check)
    if len(control) < _LEAST_FOR_POSE:
        return None
    threshold_px = params.threshold_px
    if threshold_px is None:
        # With an approximate lens, residuals of correct ties are larger.
        slack = 1.0 if lens.source not in ("exif", UNKNOWN) else 2.0
        threshold_px = slack * params.rejection_sigma * expected_px(control)
    best: tuple[ViewingCamera, NDArray[np.bool_]] | None = None
    for guess in (lens.prior, *lens.guesses):
        pose = _robust_pose(control, guess, threshold_px, tied.seed)
        if pose is not None and (best is None or pose[1].sum() > best[1].sum()):
            best = pose
    if best is None:
        return None
    agreeing = np.zeros(len(tied.seen), dtype=np.bool_)
    agreeing[~tied.is_check] = best[1]
    # Ties with the same point count only once towards a pose.
    if len(set(map(tuple, tied.seen.points_world[agreeing].round(4).tolist()))) < 5:
        return None
    if lens.source == UNKNOWN:
        lens = replace(lens, prior=best[0])
    return Start(camera=best[0], lens=lens, agreeing=agreeing)


def adjusted(
    tied: TiedPhoto, start: Start, params: OrientParams, solve: Solver | None = None
) -> Estimate:
    """Alternate between adjustment and rejection until the control points no longer change.

    Args:
        tied: the photo.
        start: initial pose, lens and control points.
        params: parameters of the rejection.
        solve: function that estimates the pose; if None, the weighted robust adjustment of pose and
            lens is used.

    Raises:
        GeometryError: the inliers do not determine the camera.
    """
    seen, is_check, prior = tied.seen, tied.is_check, start.lens.prior
    camera, agreeing = start.camera, start.agreeing
    unit = unit_deviation(misfit(seen, camera).normalised[agreeing & ~is_check])
    for _ in range(MAX_ROUNDS):
        used, before = agreeing & ~is_check, unit
        lens = start.lens.freedom if used.sum() >= start.n_least_for_lens else LensFreedom()
        # The ties must agree with their standard deviations, since the weight of the prior of the
        # lens is relative to theirs. The residuals are smaller, because the unknowns follow them.
        n_free = 2 * used.sum() - POSE_PARAMETERS - lens.sigmas.size
        follow = math.sqrt(2.0 * used.sum() / max(n_free, 1))
        scale, soft_limit = unit * follow, math.inf if solve else SOFT_LIMIT / follow
        control = seen.take(used).scaled(scale)
        # Use the lens of the prior if the lens is not adjusted.
        begin = camera if lens.sigmas.size else posed(prior, camera)
        if solve:
            camera = solve(control, begin)
        else:
            camera = fitted(control, begin, prior=prior, lens=lens, soft_limit=soft_limit)
        fit = misfit(seen, camera)
        unit = unit_deviation(fit.normalised[used])
        limit = without_chance(fit.normalised[~is_check], params.rejection_sigma * unit)
        again = fit.normalised <= limit
        if np.array_equal(again & ~is_check, used) and abs(unit / before - 1.0) < _SETTLED_SHARE:
            break
        agreeing = again
    found = stated(
        control, camera, prior=prior, lens=lens, independent=False, soft_limit=soft_limit
    )
    resection = replace(
        found, sigma0=scale * found.sigma0, variance_factor=scale**2 * found.variance_factor
    )
    source = start.lens.source
    return Estimate(resection=resection, source=source, fit=fit, agreeing=again, limit=limit)


def ties_of_photo(ties: Ties, name: str) -> NDArray[np.intp]:
    """Return the indices of the ties of a photo."""
    if name not in ties.photo_names:
        return np.empty(0, dtype=np.intp)
    return np.flatnonzero(ties.photo == ties.photo_names.index(name))


def image_cells(
    pixels_photo: NDArray[np.float64], size_px: tuple[int, int], side: int
) -> NDArray[np.intp]:
    """Return the cell (n,) of each pixel in a grid of side x side cells over the image."""
    scaled = np.floor(pixels_photo * side / np.array(size_px)).astype(np.intp)
    scaled = np.clip(scaled, 0, side - 1)
    cells: NDArray[np.intp] = scaled[:, 1] * side + scaled[:, 0]
    return cells


def without_chance(normalised: NDArray[np.float64], limit: float) -> float:
    """Tighten a limit so that hardly any outliers are within it by chance.

    Small residuals of outliers are uniformly distributed. The ring from one to three times the
    limit has eight times the area of the circle within the limit, so the circle is expected to
    contain an eighth as many outliers as the ring.
    """
    lengths = np.sort(normalised[np.isfinite(normalised)])
    for tightened in limit * _TIGHTENING ** np.arange(_MAX_TIGHTENED):
        inside, around = np.searchsorted(lengths, [tightened, 3.0 * tightened], side="right")
        if (around - inside) / 8.0 <= _MAX_CHANCE_SHARE * inside:
            return float(tightened)
    return float(tightened)


def unit_deviation(normalised: NDArray[np.float64]) -> float:
    """Return the robust standard deviation of unit weight, limited to plausible values."""
    median = float(np.median(normalised)) if normalised.size else 1.0
    return float(np.clip(median / MEDIAN_LENGTH, *_SIGMA0_RANGE))


def expected_px(seen: SeenPoints) -> float:
    """Return the a priori standard deviation of a tie in pixels.

    The image scale is estimated from all ties.
    """
    spread_px = float(np.median(np.abs(seen.pixels_photo - np.median(seen.pixels_photo, axis=0))))
    lengths = np.abs(seen.points_world - np.median(seen.points_world, axis=0)).max(axis=1)
    per_metre = spread_px / max(0.5 * float(np.median(lengths)), 1e-6)
    sigma = np.hypot(np.median(seen.sigma_px), per_metre * np.median(seen.sigma_m))
    return float(sigma)


def posed(lens: ViewingCamera, pose: ViewingCamera) -> ViewingCamera:
    """Return a camera with the lens of the first and the pose of the second."""
    return replace(lens, rotation=pose.rotation, translation=pose.translation)


def undistorted_pixels(pixels: NDArray[np.float64], lens: ViewingCamera) -> NDArray[np.float64]:
    """Return pixels (n, 2) without distortion and skew; NaN where the lens model has no inverse."""
    if not (lens.distortion.any() or lens.skew):
        return pixels
    rays = camera_rays(lens, pixels)
    return rays[:, :2] * [lens.fx, lens.fy] + [lens.cx, lens.cy]


def _contradicted_calibration(found: Estimate, control: SeenPoints) -> str:
    """Return why the ties of a photo contradict its calibration; empty if they do not.

    The pose compensates for most of a wrong focal length, so the residuals do not reveal it.
    """
    camera = found.resection.camera
    if found.resection.lens.sigmas.size or len(control) < _LEAST_FOR_FOCAL:
        return ""
    # Common errors are estimated only if the focal length would be significant without them, since
    # this takes longer and only increases its standard deviation.
    for independent in (True, False):
        try:
            free = adjust(
                control, camera, lens=_OTHER_LENS, independent=independent, soft_limit=SOFT_LIMIT
            )
        except GeometryError:
            return ""
        off = abs(math.log(free.camera.fx / camera.fx))
        sigma = math.sqrt(float(free.covariance[POSE_PARAMETERS, POSE_PARAMETERS]))
        if off < max(_MIN_FOCAL_OFF, _FOCAL_OFF_SIGMAS * sigma):
            return ""
    return (
        f"its ties give a focal length of {free.camera.fx:.0f} px +- "
        f"{sigma * free.camera.fx:.0f} px, but its calibration has {camera.fx:.0f} px: the "
        "calibration belongs to another lens, zoom setting or image size"
    )


def _robust_pose(
    seen: SeenPoints, lens: ViewingCamera, threshold_px: float, seed: int
) -> tuple[ViewingCamera, NDArray[np.bool_]] | None:
    """Find the pose with the most inliers (MSAC on P3P: Torr & Zisserman 2000).

    Args:
        seen: the ties.
        lens: interior orientation of the camera; its pose is ignored.
        threshold_px: maximum residual of an inlier.
        seed: seed of the sampling.

    Returns:
        The camera with this pose, and a mask (n,) of its inliers; None if no pose is found.
    """
    import cv2

    usable = undistorted_pixels(seen.pixels_photo, lens)
    inside: NDArray[np.bool_] = np.asarray(np.isfinite(usable).all(axis=1))
    if inside.sum() < _LEAST_FOR_POSE:
        return None
    middle = seen.points_world.mean(axis=0)
    pixels = np.ascontiguousarray(to_opencv(usable[inside]))
    points = np.ascontiguousarray(seen.points_world[inside] - middle)
    usac: Any = cv2.UsacParams()
    usac.threshold = threshold_px
    usac.maxIterations = _MAX_TRIALS
    usac.confidence = _CONFIDENCE
    usac.randomGeneratorState = seed
    # With several threads, results are not reproducible.
    usac.isParallel = False
    usac.score = cv2.SCORE_METHOD_MSAC
    # The subsequent adjustment replaces local optimisation, and takes only a third of its time.
    usac.loMethod = cv2.LOCAL_OPTIM_NULL
    call: Any = cv2.solvePnPRansac
    try:
        found, _, turn, shift, agreed = call(points, pixels, opencv_matrix(lens), None, params=usac)
    except cv2.error:  # there is no solution for any sample
        return None
    if not found or agreed is None:
        return None
    agreeing = np.zeros(len(inside), dtype=np.bool_)
    agreeing[np.flatnonzero(inside)[np.asarray(agreed).ravel()]] = True
    return lens.at_opencv_pose(turn, shift, middle), agreeing
