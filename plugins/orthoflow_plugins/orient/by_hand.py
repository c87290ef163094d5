"""Poses from ties that a person measured: few, each with a standard deviation that is believed.

Ties that a matcher finds are many and of unknown worth, so their agreement beyond chance proves a
pose. Of six that a person clicked, none can be withheld. What proves them is that they fit together
as well as their standard deviations say (a chi-squared test of the adjustment), that at most two
have to go for that and it is plain which, and that the pose hangs on none of them alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.opencv_border import opencv_matrix, to_opencv
from orthoflow.geometry.resection import Resection, SeenPoints, adjust, misfit, stated
from orthoflow.sdk import DiagnosticSpec
from orthoflow_plugins.orient.lenses import LensPrior, lens_prior
from orthoflow_plugins.orient.parameters import Note
from orthoflow_plugins.orient.pose import Estimate, Start, TiedPhoto, undistorted_pixels

MIN_TIES: Final = 6
_MAX_WRONG: Final = 2
# So many ways to leave ties out are tried: two of 24 ties, one of any number.
_MAX_TRIALS: Final = 300
# Right ties are called contradictory once in a thousand photos.
_CONTRADICTION: Final = 1e-3
# Of the longest length of a residual that is left over: 3.5 standard deviations of a coordinate.
_LIMIT: Final = 3.5
# Adjusted from two starts, one pose comes out twice to far less than that.
_ONE_POSE_RAD: Final = math.radians(2.0)
BY_HAND: Final = DiagnosticSpec(
    code="photo-oriented-by-hand",
    severity="warning",
    text="photo {subject}: oriented by ties measured by hand alone",
)
HAND_TIES_LEFT_OUT: Final = DiagnosticSpec(
    code="ties-by-hand-contradict",
    severity="warning",
    text="photo {subject}: {n} ties measured by hand contradict the others and are left out: "
    "{places}",
    remedy="measure them again",
    rank_by="n",
)


@dataclass(frozen=True, kw_only=True)
class _Fit:
    """An adjustment to some of the ties.

    Attributes:
        resection: the camera.
        prior: its lens as it was known beforehand.
        chance: probability of residuals as large by chance, were the sigmas right.
    """

    resection: Resection
    prior: ViewingCamera
    chance: float


@dataclass(frozen=True, kw_only=True)
class PoseByHand:
    """What the ties that a person measured say of a photo.

    Attributes:
        estimate: the orientation by them alone.
        start: where an adjustment of all ties starts from it.
    """

    estimate: Estimate
    start: Start


def pose_by_hand(tied: TiedPhoto) -> PoseByHand | str:
    """Orient a photo by the ties that a person measured, or say why not.

    Args:
        tied: the photo; of its ties at least `MIN_TIES` are measured by a person.
    """
    seen = tied.seen
    prior, hand = lens_prior(tied.photo), seen.take(tied.by_hand)
    found = _consistent(hand, prior)
    if isinstance(found, str):
        return found
    kept, fit = found
    agreeing = np.zeros(len(seen), dtype=np.bool_)
    agreeing[np.flatnonzero(tied.by_hand)[kept]] = True
    own, camera = seen.take(agreeing), fit.resection.camera
    lens = fit.resection.lens
    n_lost = len(hand) - len(kept)
    notes: list[Note] = [(BY_HAND, {})]
    if n_lost:
        pixels = np.delete(hand.pixels_photo, kept, axis=0)
        notes.append((HAND_TIES_LEFT_OUT, {"n": n_lost, "places": _places(pixels)}))
    estimate = Estimate(
        resection=_as_stated(fit.resection),
        source=prior.source,
        fit=misfit(seen, camera),
        agreeing=agreeing,
        limit=_LIMIT,
        notes=tuple(notes),
        without_one=tuple(
            _as_stated(
                stated(own.take(np.arange(len(own)) != k), camera, prior=fit.prior, lens=lens)
            )
            for k in range(len(own))
        ),
    )
    start = Start(
        camera=camera,
        prior=fit.prior,
        agreeing=agreeing,
        freedom=prior.freedom,
        source=prior.source,
    )
    return PoseByHand(estimate=estimate, start=start)


def _consistent(hand: SeenPoints, prior: LensPrior) -> tuple[NDArray[np.intp], _Fit] | str:
    """Find the ties that fit together: all, or all but one or two that are plainly wrong."""
    n_most = min(_MAX_WRONG, len(hand) - MIN_TIES)
    if math.comb(len(hand), n_most) > _MAX_TRIALS:
        n_most = 1
    for n_wrong in range(n_most + 1):
        fitting: list[tuple[NDArray[np.intp], _Fit]] = []
        for wrong in combinations(range(len(hand)), n_wrong):
            kept = np.delete(np.arange(len(hand)), list(wrong))
            fits = _distinct(_fits(hand.take(kept), prior))
            if len(fits) > 1:
                return (
                    "two poses agree with its ties measured by hand: add some outside the "
                    "plane of the others"
                )
            fitting += [(kept, fit) for fit in fits]
        if len(fitting) == 1:
            return fitting[0]
        if fitting:
            doubtful = sorted(
                {int(at) for kept, _ in fitting for at in np.setdiff1d(np.arange(len(hand)), kept)}
            )
            return (
                f"its {len(hand)} ties measured by hand contradict each other, and it is not plain "
                f"which is wrong, one of {_places(hand.pixels_photo[doubtful])}: measure them "
                "again, or add more"
            )
    return (
        f"its {len(hand)} ties measured by hand contradict each other by more than their sigma_px "
        f"says, and leaving out up to {n_most} of them does not help ({MIN_TIES} must stay): "
        "measure them again, or add more"
    )


def _fits(seen: SeenPoints, prior: LensPrior) -> Iterator[_Fit]:
    """Adjust from every start, and give what the ties allow."""
    from scipy.special import chdtrc  # scipy.stats would take seconds to import

    for guess in prior.guesses:
        lens = guess.posed()
        for start in _starts(seen, lens):
            try:
                found = adjust(seen, start, prior=lens, lens=prior.freedom)
            except GeometryError:
                continue
            redundancy = _redundancy(seen, found)
            chance = float(chdtrc(redundancy, found.sigma0**2 * redundancy))
            is_seen = np.isfinite(misfit(seen, found.camera).normalised).all()
            if is_seen and chance >= _CONTRADICTION:
                yield _Fit(resection=found, prior=lens, chance=chance)


def _redundancy(seen: SeenPoints, found: Resection) -> float:
    """Observations beyond what determines the camera; a known lens is observed as well."""
    n_pose = 6
    cofactors = found.covariance / found.sigma0**2
    of_lens = np.diag(cofactors)[n_pose:] / found.lens.sigmas**2
    return float(2 * len(seen) - len(cofactors) + of_lens.sum())


def _distinct(fits: Iterator[_Fit]) -> list[_Fit]:
    """The best of each pose."""
    kept: list[_Fit] = []
    for fit in sorted(fits, key=lambda item: -item.chance):
        if all(_are_apart(fit.resection.camera, other.resection.camera) for other in kept):
            kept.append(fit)
    return kept


def _are_apart(first: ViewingCamera, second: ViewingCamera) -> bool:
    turn = first.rotation @ second.rotation.T
    angle = math.acos(min(1.0, max(-1.0, (float(np.trace(turn)) - 1.0) / 2.0)))
    return angle > _ONE_POSE_RAD


def _starts(seen: SeenPoints, lens: ViewingCamera) -> list[ViewingCamera]:
    """Poses that fit ties exactly in the sense of SQPnP and, of points in a plane, of IPPE."""
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
        # IPPE takes nothing but points of one plane: onto it, then.
        flat = points - np.outer((points - centroid) @ axes[2], axes[2])
        posed.append((cv2.SOLVEPNP_IPPE, flat))
    call: Any = cv2.solvePnPGeneric
    starts: list[ViewingCamera] = []
    for method, of_method in posed:
        try:
            n_found, turns, shifts, _ = call(
                of_method, pixels, opencv_matrix(lens), None, flags=method
            )
        except cv2.error:  # the points have no such solution
            continue
        for turn, shift in zip(turns[:n_found], shifts[:n_found], strict=True):
            rotation = np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64)
            if not np.isfinite(rotation).all():
                continue
            local = replace(lens, rotation=rotation, translation=np.asarray(shift).ravel())
            starts.append(local.shifted(-middle))
    return starts


def _as_stated(resection: Resection) -> Resection:
    """Take the ties' own standard deviations where few residuals are small by luck."""
    unit = max(1.0, resection.sigma0)
    covariance = resection.covariance * (unit / resection.sigma0) ** 2
    return replace(
        resection,
        covariance=covariance,
        sigma0=unit,
        variance_factor=unit**2,
    )


def _places(pixels: NDArray[np.float64] | Sequence[NDArray[np.float64]]) -> str:
    """Pixels as they stand in a file of ties."""
    counted = to_opencv(np.asarray(pixels))
    return ", ".join(f"(u {u:.0f}, v {v:.0f})" for u, v in counted)
