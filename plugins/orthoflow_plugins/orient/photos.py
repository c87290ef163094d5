"""Orientation of single photos: ties, check points, lens priors and tests."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError, MethodError
from orthoflow.geometry.cameras import POSE_PARAMETERS, ViewingCamera, opencv_matrix, to_opencv
from orthoflow.geometry.resection import Resection, SeenPoints, adjust, misfit, stated
from orthoflow.products import Camera, Photo, Photos, PointCloud, TieRole, Ties
from orthoflow.sdk import DiagnosticSpec, StepContext
from orthoflow_plugins.orient.gates import (
    GATES_BEFORE_BLOCK,
    Candidate,
    known_walls,
    refusal,
    too_few,
    wall_error,
    warnings_for,
)
from orthoflow_plugins.orient.pose import (
    MIN_EXIF_OFF,
    Estimate,
    Estimator,
    Lens,
    Note,
    OrientIn,
    OrientParams,
    Start,
    TiedPhoto,
    adjusted,
    focal_without_exif,
    image_cells,
    lens_prior,
    ties_of_photo,
    undistorted_pixels,
)
from orthoflow_plugins.orient.report import Oriented, numbers_json
from orthoflow_plugins.orient.scan_errors import MAX_SCANS, measured_scan_errors

MIN_TIES: Final = 6
_MAX_WRONG: Final = 2
# Maximum number of subsets to try. It is large enough to leave out any two of 24 ties.
_MAX_TRIALS: Final = 300
# Accepted probability of classifying correct ties as contradictory.
_CONTRADICTION: Final = 1e-3
# Limit of residuals, in standard deviations of a coordinate.
_LIMIT: Final = 3.5
# Poses that differ by more than this angle are distinct. From different initial values, the same
# pose differs by far less.
_ONE_POSE_RAD: Final = math.radians(2.0)
# Two poses are at different places if they displace the ties in the photo by more than this share
# of its longer side.
_APART_SHARE: Final = 0.1
# Two numbers of ties differ if their difference exceeds this many standard deviations (Poisson).
_COUNT_SIGMAS: Final = 3.0
BY_HAND: Final = DiagnosticSpec(
    code="photo-oriented-by-hand",
    severity="warning",
    text="photo {subject}: oriented only from ties measured by hand",
)
HAND_TIES_LEFT_OUT: Final = DiagnosticSpec(
    code="ties-by-hand-contradict",
    severity="warning",
    text="photo {subject}: ties measured by hand that contradict the others were ignored ({n}): "
    "{places}",
    remedy="measure them again",
    rank_by="n",
)


_Fit = tuple[float, Resection, ViewingCamera]
"""An adjustment to some ties: the probability of residuals that are larger by chance, the adjusted
camera, and the prior of its lens.
"""


def pose_by_hand(tied: TiedPhoto) -> tuple[Estimate, Start] | str:
    """Orient a photo from its ties measured by hand; return the reason if this fails.

    Args:
        tied: the photo, which must have at least `MIN_TIES` ties measured by hand.

    Returns:
        The orientation from these ties only, and the initial values of an adjustment with all ties.
    """
    seen = tied.seen
    known, hand = lens_prior(tied.photo), seen.take(tied.by_hand)
    found = _consistent(hand, known)
    if isinstance(found, str):
        return found
    kept, (_, resection, prior) = found
    agreeing = np.zeros(len(seen), dtype=np.bool_)
    agreeing[np.flatnonzero(tied.by_hand)[kept]] = True
    own, camera, lens = seen.take(agreeing), resection.camera, resection.lens
    notes: list[Note] = [(BY_HAND, {})]
    if len(kept) < len(hand):
        pixels = np.delete(hand.pixels_photo, kept, axis=0)
        notes.append((HAND_TIES_LEFT_OUT, {"n": len(pixels), "places": _places(pixels)}))
    without_one = (
        stated(own.take(np.arange(len(own)) != k), camera, prior=prior, lens=lens)
        for k in range(len(own))
    )
    estimate = Estimate(
        resection=_as_stated(resection),
        source=known.source,
        fit=misfit(seen, camera),
        agreeing=agreeing,
        limit=_LIMIT,
        notes=tuple(notes),
        without_one=tuple(map(_as_stated, without_one)),
    )
    return estimate, Start(camera=camera, lens=replace(known, prior=prior), agreeing=agreeing)


def _consistent(hand: SeenPoints, lens: Lens) -> tuple[NDArray[np.intp], _Fit] | str:
    """Find consistent ties: all ties, or all except one or two that are clearly wrong."""
    n_most = min(_MAX_WRONG, len(hand) - MIN_TIES)
    if math.comb(len(hand), n_most) > _MAX_TRIALS:
        n_most = 1
    for n_wrong in range(n_most + 1):
        fitting: list[tuple[NDArray[np.intp], _Fit]] = []
        for wrong in combinations(range(len(hand)), n_wrong):
            kept = np.delete(np.arange(len(hand)), list(wrong))
            fits = _distinct(_fits(hand.take(kept), lens))
            if len(fits) > 1:
                return (
                    "two different poses agree with its ties measured by hand: measure more ties "
                    "outside the plane of these"
                )
            fitting += [(kept, fit) for fit in fits]
        if len(fitting) == 1:
            return fitting[0]
        if fitting:
            suspect = sorted(
                {int(at) for kept, _ in fitting for at in np.setdiff1d(np.arange(len(hand)), kept)}
            )
            return (
                f"its {len(hand)} ties measured by hand contradict each other; one of "
                f"{_places(hand.pixels_photo[suspect])} must be wrong, but it is not clear which: "
                "measure them again, or add more"
            )
    return (
        f"its {len(hand)} ties measured by hand contradict each other by more than their sigma_px "
        f"allows, and leaving out up to {n_most} of them does not help ({MIN_TIES} must remain): "
        "measure them again, or add more"
    )


def _fits(seen: SeenPoints, known: Lens) -> Iterator[_Fit]:
    """Adjust from each initial pose, and yield the fits that are consistent with the ties."""
    from scipy.special import chdtrc  # importing scipy.stats would take seconds

    for lens in (known.prior, *known.guesses):
        for start in _starts(seen, lens):
            try:
                found = adjust(seen, start, prior=lens, lens=known.freedom)
            except GeometryError:
                continue
            # The prior of the lens counts as additional observations.
            cofactors = np.diag(found.covariance / found.sigma0**2)
            of_lens = cofactors[POSE_PARAMETERS:] / found.lens.sigmas**2
            redundancy = float(2 * len(seen) - len(cofactors) + of_lens.sum())
            chance = float(chdtrc(redundancy, found.sigma0**2 * redundancy))
            is_seen = np.isfinite(misfit(seen, found.camera).normalised).all()
            if is_seen and chance >= _CONTRADICTION:
                yield chance, found, lens


def _distinct(fits: Iterator[_Fit]) -> list[_Fit]:
    """Return the best fit of each distinct pose."""
    kept: list[_Fit] = []
    for fit in sorted(fits, key=lambda each: -each[0]):
        turns = [fit[1].camera.rotation @ other[1].camera.rotation.T for other in kept]
        cosines = np.clip([(np.trace(turn) - 1.0) / 2.0 for turn in turns], -1.0, 1.0)
        if (np.arccos(cosines) > _ONE_POSE_RAD).all():
            kept.append(fit)
    return kept


def _starts(seen: SeenPoints, lens: ViewingCamera) -> list[ViewingCamera]:
    """Compute initial poses by SQPnP and, for coplanar points, by IPPE."""
    import cv2

    straight = undistorted_pixels(seen.pixels_photo, lens)
    inside = np.isfinite(straight).all(axis=1)
    if inside.sum() < 4:
        return []
    middle = seen.points_world.mean(axis=0)
    pixels = np.ascontiguousarray(to_opencv(straight[inside]))
    points = np.ascontiguousarray(seen.points_world[inside] - middle)
    posed = [(cv2.SOLVEPNP_SQPNP, points)]
    centroid = points.mean(axis=0)
    _, across, axes = np.linalg.svd(points - centroid, full_matrices=False)
    if across[2] < 1e-2 * across[1]:
        # IPPE only accepts exactly coplanar points.
        flat = points - np.outer((points - centroid) @ axes[2], axes[2])
        posed.append((cv2.SOLVEPNP_IPPE, flat))
    call: Any = cv2.solvePnPGeneric
    starts: list[ViewingCamera] = []
    for method, of_method in posed:
        try:
            n_found, turns, shifts, _ = call(
                of_method, pixels, opencv_matrix(lens), None, flags=method
            )
        except cv2.error:  # there is no such solution for these points
            continue
        starts += [
            lens.at_opencv_pose(turn, shift, middle)
            for turn, shift in zip(turns[:n_found], shifts[:n_found], strict=True)
            if np.isfinite(turn).all()
        ]
    return starts


def _as_stated(resection: Resection) -> Resection:
    """Use the a priori standard deviations if the residuals are smaller than expected."""
    unit = max(1.0, resection.sigma0)
    covariance = resection.covariance * (unit / resection.sigma0) ** 2
    return replace(resection, covariance=covariance, sigma0=unit, variance_factor=unit**2)


def _places(pixels: NDArray[np.float64] | Sequence[NDArray[np.float64]]) -> str:
    """Format pixels in the convention of tie files."""
    counted = to_opencv(np.asarray(pixels))
    return ", ".join(f"(u {u:.0f}, v {v:.0f})" for u, v in counted)


_SEED_LIMIT: Final = 2**31 - 1
# Check points are selected evenly from a grid with this many cells per side.
_STRATA: Final = 6
# The EXIF focal length of a lens is tested with at most this many photos.
_TESTED_PER_LENS: Final = 5
# If the focal lengths of at least _MIN_OTHERS photos of a camera agree within a factor of
# _SAME_FOCAL, they take precedence over a contradicting EXIF value of another photo.
_MIN_OTHERS: Final = 2
_SAME_FOCAL: Final = 1.05
REGISTRATION_UNKNOWN: Final = DiagnosticSpec(
    code="registration-unknown",
    severity="warning",
    text="the cloud does not show how well its scans are registered, since {reason}: expected "
    "errors include errors of registration only as far as residuals show them, and may be half "
    "the true errors",
    remedy="read the scans with their scanner positions (E57, or one file per scan), with "
    "overlaps, or measure check points",
)
EXIF_CONTRADICTED: Final = DiagnosticSpec(
    code="exif-focal-contradicted",
    severity="warning",
    text="photos {subject}: the EXIF focal length is {exif_px:.0f} px, but their ties give "
    "{focal_px:.0f} px, a factor of {factor:.2f}: EXIF was not used (possible causes: digital "
    "zoom, an adapter, or cropping)",
    remedy="provide a calibration file",
)
EXIF_LEFT_OUT: Final = DiagnosticSpec(
    code="exif-focal-left-out",
    severity="warning",
    text="photo {subject}: its EXIF focal length contradicts the other photos of its camera, so it "
    "was oriented with their focal length of {focal_px:.0f} px",
    remedy="provide a calibration file",
)


@dataclass(frozen=True, kw_only=True)
class Trusted:
    """A photo oriented from its own ties.

    Attributes:
        tied: the photo with its ties.
        estimate: the separate orientation of the photo.
        by_hand: the orientation only from ties measured by hand, or None.
        kept: (n,) bool, the ties used for `by_hand`.
    """

    tied: TiedPhoto
    estimate: Estimate
    by_hand: Oriented | None
    kept: NDArray[np.bool_]

    def judged(self, ties: Ties, params: OrientParams, estimate: Estimate) -> Oriented:
        """Test a pose; return the pose from ties by hand if it fails or contradicts these ties."""
        found = judged(self.tied, candidate_of(self.tied, ties, params, estimate))
        is_with_hand = not (self.kept & (found.role == TieRole.REJECTED)).any()
        if self.by_hand is None or (found.camera.status == "ok" and is_with_hand):
            return found
        return self.by_hand


Look = TypeVar("Look", bound=Trusted | Oriented)


def require(ties: Ties, photos: Photos) -> None:
    """Check that there are photos and ties, and that the ties refer to these photos.

    Raises:
        MethodError: there are no photos or no ties, or the ties refer to other photos.
    """
    if not photos.photos:
        raise MethodError("there are no photos to orient: give at least one photo")
    if not len(ties.photo):
        raise MethodError(
            "there are no ties between photos and walls, so no photo can be oriented: see the "
            "diagnostics of the matching step"
        )
    names = {photo.name for photo in photos.photos}
    unknown = [name for name in ties.photo_names if name not in names]
    if unknown:
        raise MethodError(
            f"the ties refer to photo {unknown[0]}, which is not among the given photos: connect "
            "the photos from which the ties were computed"
        )


def scan_errors_of(inputs: OrientIn, ctx: StepContext) -> NDArray[np.float64] | None:
    """Return `SeenPoints.scan_errors` of all ties; None if the cloud does not show them."""
    cloud, found = inputs.cloud, None
    if cloud is None:
        return None
    cloud.require_points(3)
    if cloud.scan is not None:
        stations = cloud.stations if cloud.stations_source == "file" else None
        found = measured_scan_errors(
            (cloud.x, cloud.y, cloud.z), cloud.scan, cloud.origin, stations
        )
    if found is None:
        if reason := _unmeasured(cloud):
            ctx.report(REGISTRATION_UNKNOWN, reason=reason)
        return None
    ctx.metric("scan_registration_mm", 1e3 * float(found.sigma_m[0]), "mm")
    return found.at(inputs.ties.points_world)


def _unmeasured(cloud: PointCloud) -> str:
    """Return why a cloud does not show the registration of its scans; empty for a single scan."""
    if cloud.scan is None:
        return "its points have no scan numbers"
    n_scans = np.count_nonzero(np.bincount(cloud.scan))
    if n_scans > MAX_SCANS:
        return f"it has {n_scans} scans, more than {MAX_SCANS}"
    if n_scans > 1:
        return f"no surface is in several of its {n_scans} scans"
    if cloud.stations_source == "file":
        return ""
    return "it is one scan without a scanner position, which may combine several"


def tied_photo(
    photo: Photo,
    ties: Ties,
    params: OrientParams,
    rng: np.random.Generator,
    scan_errors: NDArray[np.float64] | None = None,
) -> TiedPhoto:
    """Select the ties of a photo, and split them into control and check points."""
    # Draw one seed per photo, so that its samples do not depend on the ties of other photos.
    own = np.random.default_rng(int(rng.integers(_SEED_LIMIT)))
    chosen = ties_of_photo(ties, photo.name)
    chosen = chosen[ties.role[chosen] != TieRole.REJECTED]
    seen = SeenPoints(
        pixels_photo=ties.pixels_photo[chosen],
        points_world=ties.points_world[chosen],
        sigma_px=ties.sigma_px[chosen],
        sigma_m=ties.sigma_m[chosen],
        scan_errors=None if scan_errors is None else scan_errors[chosen],
    )
    by_hand = np.zeros(len(chosen), dtype=np.bool_)
    if ties.by_hand is not None:
        by_hand = ties.by_hand[chosen] > 0
    is_check = np.zeros(len(chosen), dtype=np.bool_)
    is_check[~by_hand] = withheld(
        seen.pixels_photo[~by_hand], (photo.width, photo.height), params.check_share, own
    )
    return TiedPhoto(
        photo=photo,
        chosen=chosen,
        seen=seen,
        is_check=is_check,
        by_hand=by_hand,
        seed=int(own.integers(_SEED_LIMIT)),
    )


def withheld(
    pixels_photo: NDArray[np.float64],
    size_px: tuple[int, int],
    share: float,
    rng: np.random.Generator,
) -> NDArray[np.bool_]:
    """Select check points (n,): a share of the ties, evenly from all parts of the image.

    The ties are shuffled and sorted by image cell; then every (1 / share)-th tie is selected. Each
    cell thus contributes its share, and the share of all ties is at least `share`.
    """
    shuffled = rng.permutation(len(pixels_photo))
    cells = image_cells(pixels_photo, size_px, _STRATA)
    order = shuffled[np.argsort(cells[shuffled], kind="stable")]
    n_check = math.ceil(share * len(order))
    picked = np.floor((np.arange(n_check) + rng.random()) * len(order) / max(n_check, 1))
    chosen = np.zeros(len(order), dtype=np.bool_)
    chosen[order[np.minimum(picked.astype(np.intp), len(order) - 1)]] = True
    return chosen


def with_believable_priors(
    photos: Sequence[Photo], ties: Ties, params: OrientParams, ctx: StepContext
) -> list[Photo]:
    """Replace EXIF focal lengths that contradict the ties.

    Because of digital zoom, adapters or cropping, EXIF may be wrong for all photos taken with a
    lens. The photos with the most ties are tested, and the resulting focal length is used for all
    photos taken with that lens.
    """
    believed = list(photos)
    lenses: dict[tuple[object, ...], list[int]] = {}
    for at, photo in enumerate(photos):
        if photo.intrinsics is None and photo.exif_focal_px is not None:
            key = (photo.camera, photo.width, photo.height, photo.exif_focal_px)
            lenses.setdefault(key, []).append(at)
    for members in lenses.values():
        # Use a separate random generator, so that orientations do not depend on whether EXIF
        # exists.
        rng = np.random.default_rng(0)
        tied = [tied_photo(photos[at], ties, params, rng) for at in members]
        tied.sort(key=lambda each: -len(each.seen))
        tested = [focal_without_exif(each, params) for each in tied[:_TESTED_PER_LENS]]
        found = [focal_px for focal_px in tested if focal_px is not None]
        if 2 * len(found) <= len(tested):
            continue
        focal_px = float(np.median(found))
        first = photos[members[0]]
        exif_px = first.exif_focal_px or math.nan
        names = f"{first.name} and {len(members) - 1} more" if len(members) > 1 else first.name
        ctx.report(
            EXIF_CONTRADICTED,
            subject=names,
            exif_px=exif_px,
            focal_px=focal_px,
            factor=focal_px / exif_px,
        )
        for at in members:
            believed[at] = replace(photos[at], exif_focal_px=focal_px)
    return believed


def each_by_itself(
    inputs: OrientIn, params: OrientParams, ctx: StepContext, estimator: Estimator
) -> list[Oriented]:
    """Orient each photo separately from its own ties, and test each orientation.

    Raises:
        MethodError: there are no photos or no ties, or the ties refer to other photos.
    """
    ties = inputs.ties
    require(ties, inputs.photos)

    def look(tied: TiedPhoto) -> Oriented:
        result = by_itself(tied, ties, params, estimator)
        if isinstance(result, Oriented):
            return result
        return result.judged(ties, params, result.estimate)

    believed = with_believable_priors(inputs.photos.photos, ties, params, ctx)
    scan_errors = scan_errors_of(inputs, ctx)
    tied = [tied_photo(photo, ties, params, ctx.rng, scan_errors) for photo in believed]
    return looked_at(tied, look, ctx)


def looked_at(
    photos: Sequence[TiedPhoto],
    look: Callable[[TiedPhoto], Look],
    ctx: StepContext,
    share: float = 1.0,
) -> list[Look]:
    """Orient photos one by one; repeat those whose EXIF contradicts other photos of the camera.

    Args:
        photos: the photos.
        look: function that orients one photo.
        ctx: context for progress and diagnostics.
        share: share of the progress of the step.
    """
    found = []
    for nth, tied in enumerate(photos):
        ctx.progress(share * nth / len(photos), tied.photo.name)
        found.append(look(tied))
    for at, (tied, result) in enumerate(zip(photos, found, strict=True)):
        focal_px = None if _focal_px(result) else _focal_of_others(tied.photo, photos, found)
        if focal_px is None:
            continue
        again = look(replace(tied, photo=replace(tied.photo, exif_focal_px=focal_px)))
        if _focal_px(again):
            found[at] = again
            ctx.report(EXIF_LEFT_OUT, subject=tied.photo.name, focal_px=focal_px)
    return found


def _focal_px(found: Trusted | Oriented) -> float | None:
    if isinstance(found, Trusted):
        return found.estimate.resection.camera.fx
    return found.camera.intrinsics.fx if found.camera.intrinsics is not None else None


def _focal_of_others(
    photo: Photo, photos: Sequence[TiedPhoto], found: Sequence[Trusted | Oriented]
) -> float | None:
    """Return the focal length of other photos of the camera if they agree and contradict EXIF."""
    if photo.intrinsics is not None or photo.exif_focal_px is None:
        return None
    camera = (photo.camera, photo.width, photo.height)
    others = [
        focal_px
        for tied, result in zip(photos, found, strict=True)
        if (tied.photo.camera, tied.photo.width, tied.photo.height) == camera
        and (focal_px := _focal_px(result)) is not None
    ]
    if len(others) < _MIN_OTHERS or max(others) > _SAME_FOCAL * min(others):
        return None
    focal_px = float(np.median(others))
    is_far = abs(math.log(focal_px / photo.exif_focal_px)) > MIN_EXIF_OFF
    return focal_px if is_far else None


def by_itself(
    tied: TiedPhoto, ties: Ties, params: OrientParams, estimator: Estimator
) -> Trusted | Oriented:
    """Orient a photo from its own ties.

    Returns:
        A final result if the photo is oriented only from ties by hand or not at all; otherwise, an
        orientation that has yet to be tested.
    """
    alone, kept = None, np.zeros(len(tied.seen), dtype=np.bool_)
    reason = too_few(len(tied.seen))
    if tied.by_hand.sum() >= MIN_TIES:
        alone, pose = oriented_by_hand(tied, ties, params)
        # Ties measured by hand are never check points, so other ties are needed to check the pose.
        too_few_others = too_few(int((~tied.by_hand).sum()))
        if pose is not None:
            own, start = pose
            kept = own.agreeing
            joined = None if too_few_others else _joined(tied, ties, params, start)
            if joined is not None and joined.agreeing[kept].all():
                return Trusted(tied=tied, estimate=joined, by_hand=alone, kept=kept)
        if alone.camera.status == "ok":
            return alone
        if too_few_others:
            reason = alone.camera.status
    estimate = reason or estimator(tied, params)
    if isinstance(estimate, str):
        return refused(tied, estimate if alone is None else alone.camera.status)
    if alone is None and (n := _ties_of_another_pose(tied, ties, params, estimator, estimate)):
        return refused(
            tied,
            f"two poses agree with its ties equally well ({estimate.agreeing.sum()} and {n} "
            "ties), as in front of identical walls: measure ties by hand, or take a photo that "
            "also shows what distinguishes the walls",
            is_ambiguous=True,
        )
    return Trusted(tied=tied, estimate=estimate, by_hand=alone, kept=kept)


def _ties_of_another_pose(
    tied: TiedPhoto, ties: Ties, params: OrientParams, estimator: Estimator, estimate: Estimate
) -> int:
    """Count the ties of another pose that fits as well, and passes the same tests; 0 if none."""
    rest, n_first = ~estimate.agreeing, int(estimate.agreeing.sum())
    if _is_fewer(int(rest.sum()), n_first):
        return 0
    others = replace(
        tied,
        chosen=tied.chosen[rest],
        seen=tied.seen.take(rest),
        is_check=tied.is_check[rest],
        by_hand=tied.by_hand[rest],
    )
    other = estimator(others, params)
    if isinstance(other, str) or _is_fewer(n_other := int(other.agreeing.sum()), n_first):
        return 0
    if refusal(candidate_of(others, ties, params, other), GATES_BEFORE_BLOCK) is not None:
        return 0
    own = tied.seen.take(estimate.agreeing)
    off_px = other.resection.camera.project(own.points_world)[:, :2] - own.pixels_photo
    apart_px = float(np.median(np.nan_to_num(np.linalg.norm(off_px, axis=1), nan=np.inf)))
    return n_other if apart_px > _APART_SHARE * max(tied.photo.width, tied.photo.height) else 0


def _is_fewer(n_ties: int, n_first: int) -> bool:
    """Return whether a number of ties is smaller than another one by more than chance."""
    return n_first - n_ties > _COUNT_SIGMAS * math.sqrt(n_first + n_ties)


def oriented_by_hand(
    tied: TiedPhoto, ties: Ties, params: OrientParams
) -> tuple[Oriented, tuple[Estimate, Start] | None]:
    """Orient a photo only from its ties measured by hand, and test the orientation."""
    found = pose_by_hand(tied)
    if isinstance(found, str):
        return refused(tied, found), None
    return judged(tied, candidate_of(tied, ties, params, found[0])), found


def _joined(tied: TiedPhoto, ties: Ties, params: OrientParams, start: Start) -> Estimate | None:
    """Orient a photo from all ties, starting from the pose by hand; None if they contradict it."""
    try:
        joined = adjusted(tied, start, params)
    except GeometryError:
        return None
    against = refusal(candidate_of(tied, ties, params, joined), GATES_BEFORE_BLOCK)
    return joined if against is None else None


def candidate_of(
    tied: TiedPhoto, ties: Ties, params: OrientParams, estimate: Estimate
) -> Candidate:
    """Collect the values with which an orientation is tested."""
    used = np.zeros(len(ties.photo), dtype=np.bool_)
    used[tied.chosen[estimate.agreeing]] = True
    known = known_walls(ties, used)
    radii_px = dict(zip(ties.photo_names, ties.search_radius_px, strict=False))
    radius_px = radii_px.get(tied.photo.name)
    return Candidate(
        photo=tied.photo,
        seen=tied.seen,
        is_check=tied.is_check,
        walls=ties.wall[tied.chosen],
        estimate=estimate,
        known=known,
        error=wall_error(estimate.resection, known),
        params=params,
        search_radius_px=math.inf if radius_px is None else radius_px,
    )


def judged(tied: TiedPhoto, candidate: Candidate) -> Oriented:
    """Accept an orientation, or reject it with a reason."""
    against, estimate = refusal(candidate), candidate.estimate
    entry = numbers_json(candidate) if candidate.control.any() else {}
    if against is not None:
        gate, reason = against
        return replace(refused(tied, reason), entry={**entry, "refused_by": gate})
    role = np.where(candidate.checked, TieRole.CHECK, TieRole.CONTROL).astype(np.uint8)
    role[~estimate.agreeing] = TieRole.REJECTED
    result, sigmas_px = estimate.resection, candidate.seen.sigma_px[candidate.control]
    return Oriented(
        camera=Camera(
            photo=candidate.photo.name,
            status="ok",
            intrinsics=estimate.intrinsics,
            rotation_camera_from_world=result.camera.rotation,
            translation_camera_from_world=result.camera.translation,
            covariance=result.covariance[:6, :6],
            sigma0_px=result.sigma0 * float(np.median(sigmas_px)),
            sigma_wall_m=None if candidate.error is None else candidate.error.rms_m,
        ),
        chosen=tied.chosen,
        role=role,
        residuals_px=estimate.fit.residuals_px,
        entry=entry,
        notes=(*estimate.notes, *warnings_for(candidate)),
        candidate=candidate,
    )


def refused(tied: TiedPhoto, reason: str, *, is_ambiguous: bool = False) -> Oriented:
    """Return the result for a photo that is not oriented."""
    n_ties = len(tied.chosen)
    return Oriented(
        camera=Camera(photo=tied.photo.name, status=reason, is_ambiguous=is_ambiguous),
        chosen=tied.chosen,
        role=np.full(n_ties, TieRole.REJECTED, dtype=np.uint8),
        residuals_px=np.full((n_ties, 2), np.nan),
    )
