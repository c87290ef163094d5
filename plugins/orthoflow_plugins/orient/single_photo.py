"""Photos one by one: their ties, which of them only check, and the verdict on each orientation."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError, MethodError
from orthoflow.geometry.resection import SeenPoints
from orthoflow.products import Camera, JsonValue, Photo, Photos, ResidualRow, TieRole, Ties
from orthoflow.sdk import StepContext
from orthoflow_plugins.orient.acceptance import (
    Candidate,
    reason_against,
    reason_to_leave_out,
    too_few,
    warnings_for,
)
from orthoflow_plugins.orient.by_hand import TIES_LEAST, pose_by_hand
from orthoflow_plugins.orient.estimation import (
    Estimate,
    EstimationRule,
    adjusted,
    focal_without_exif,
)
from orthoflow_plugins.orient.layout import withheld
from orthoflow_plugins.orient.parameters import OrientParams
from orthoflow_plugins.orient.residuals import (
    PhotoNumbers,
    numbers_json,
    photo_numbers,
    residual_table,
)
from orthoflow_plugins.orient.wall_errors import known_walls, wall_error

_SEED_LIMIT = 2**31 - 1
# Photos of a lens that are asked whether EXIF is right.
_ASKED_OF_LENS: Final = 5

Estimator = Callable[[Photo, SeenPoints, NDArray[np.bool_], EstimationRule], Estimate | str]
"""Orients one photo by its control ties, or says why it cannot."""


@dataclass(frozen=True, kw_only=True)
class TiedPhoto:
    """A photo with the ties it is oriented by.

    Attributes:
        photo: the photo.
        chosen: (n,) index into all ties.
        seen: these ties as an adjustment takes them.
        is_check: (n,) withheld from every estimation.
        by_hand: (n,) measured by a person.
        rule: how to estimate, with a seed of its own.
    """

    photo: Photo
    chosen: NDArray[np.intp]
    seen: SeenPoints
    is_check: NDArray[np.bool_]
    by_hand: NDArray[np.bool_]
    rule: EstimationRule


@dataclass(frozen=True, kw_only=True)
class Oriented:
    """What became of one photo.

    Attributes:
        camera: its orientation, or why there is none.
        chosen: (n,) index into all ties of those that were used.
        role: (n,) `TieRole` of these.
        residuals_px: (n, 2), NaN without an orientation.
        numbers: for the metrics, None without an orientation.
        entry: for the record.
        table: rows of the table of residuals.
        notes: what limits it.
        candidate: what it was judged by, of a photo that is ok.
    """

    camera: Camera
    chosen: NDArray[np.intp]
    role: NDArray[np.uint8]
    residuals_px: NDArray[np.float64]
    numbers: PhotoNumbers | None = None
    entry: JsonValue = None
    table: tuple[ResidualRow, ...] = ()
    notes: tuple[str, ...] = ()
    candidate: Candidate | None = None


@dataclass(frozen=True, kw_only=True)
class ByHand:
    """What the ties that a person measured make of a photo.

    Attributes:
        alone: its orientation by them alone, or why there is none; without a reason where there
            are too few of them to orient it.
        kept: (n,) bool, ties of the photo that determine it.
        joined: its orientation with the other ties that agree with these; None where they do not.
    """

    alone: Oriented
    kept: NDArray[np.bool_]
    joined: Estimate | None = None

    @property
    def is_enough(self) -> bool:
        """Whether they orient the photo alone."""
        return self.alone.camera.status == "ok"

    @property
    def reason(self) -> str:
        """Why they do not orient it; empty where they do, or are too few."""
        return "" if self.is_enough else self.alone.camera.status

    def agrees(self, agreeing: NDArray[np.bool_]) -> bool:
        """Whether an orientation that these ties (n,) agree with has all that were kept."""
        return bool(agreeing[self.kept].all())

    def or_alone(self, oriented: Oriented) -> Oriented:
        """Give an orientation by all ties if it is ok and not against those by hand."""
        if oriented.camera.status == "ok" and self.agrees(oriented.role != TieRole.REJECTED):
            return oriented
        return self.alone if self.is_enough or self.reason else oriented


def require(ties: Ties, photos: Photos) -> None:
    """Refuse what no orientation can start from.

    Raises:
        MethodError: no photos, no ties, or ties of other photos.
    """
    if not photos.photos:
        raise MethodError("there are no photos to orient: give at least one photo")
    if not len(ties.photo):
        raise MethodError(
            "there are no ties between photos and walls, so no photo can be oriented: see the "
            "matching step for what it found"
        )
    names = {photo.name for photo in photos.photos}
    strangers = [name for name in ties.photo_names if name not in names]
    if strangers:
        raise MethodError(
            f"the ties speak of photo {strangers[0]}, which is not among the photos given: wire "
            "the photos that the ties were made from"
        )


def of_photo(ties: Ties, name: str) -> NDArray[np.intp]:
    """Index of the ties of a photo."""
    if name not in ties.photo_names:
        return np.empty(0, dtype=np.intp)
    return np.flatnonzero(ties.photo == ties.photo_names.index(name))


def tied_photo(
    photo: Photo, ties: Ties, params: OrientParams, rng: np.random.Generator
) -> TiedPhoto:
    """Choose the ties of a photo and split them into control and check."""
    # Drawn for every photo, so that one photo's ties do not change the luck of the next.
    own = np.random.default_rng(int(rng.integers(_SEED_LIMIT)))
    chosen = _usable(ties, photo.name, params.n_ties_max)
    seen = SeenPoints(
        pixels_photo=ties.pixels_photo[chosen],
        points_world=ties.points_world[chosen],
        sigma_px=ties.sigma_px[chosen],
        sigma_m=ties.sigma_m[chosen],
    )
    size_px = (photo.width, photo.height)
    by_hand = np.zeros(len(chosen), dtype=np.bool_)
    if ties.by_hand is not None:
        by_hand = ties.by_hand[chosen] > 0
    is_check = np.zeros(len(chosen), dtype=np.bool_)
    is_check[~by_hand] = withheld(seen.pixels_photo[~by_hand], size_px, params.check_share, own)
    return TiedPhoto(
        photo=photo,
        chosen=chosen,
        seen=seen,
        is_check=is_check,
        by_hand=by_hand,
        rule=params.estimation(int(own.integers(_SEED_LIMIT))),
    )


def with_believable_priors(
    photos: Sequence[Photo], ties: Ties, params: OrientParams, ctx: StepContext
) -> list[Photo]:
    """Replace focal lengths of EXIF that photos of their camera contradict by what these ask for.

    EXIF is wrong for all photos of a lens, as by digital zoom, adapters and programs that cut a
    picture. The photos with most ties are asked; the others get the lens that these gave.
    """
    believed = list(photos)
    lenses: dict[tuple[object, ...], list[int]] = {}
    for at, photo in enumerate(photos):
        if photo.intrinsics is None and photo.exif_focal_px is not None:
            key = (photo.camera, photo.width, photo.height, photo.exif_focal_px)
            lenses.setdefault(key, []).append(at)
    for members in lenses.values():
        # Drawn apart, so that the luck of an orientation does not hang on whether EXIF is there.
        rng = np.random.default_rng(0)
        tied = [tied_photo(photos[at], ties, params, rng) for at in members]
        tied.sort(key=lambda each: -len(each.seen))
        asked = [
            focal_without_exif(each.photo, each.seen, each.is_check, each.rule)
            for each in tied[:_ASKED_OF_LENS]
        ]
        found = [focal_px for focal_px in asked if focal_px is not None]
        if 2 * len(found) <= len(asked):
            continue
        focal_px = float(np.median(found))
        first = photos[members[0]]
        said_px = first.exif_focal_px or math.nan
        names = f"{first.name} and {len(members) - 1} more" if len(members) > 1 else first.name
        ctx.warn(
            f"photos {names}: EXIF says a focal length of {said_px:.0f} px, but their ties ask for "
            f"{focal_px:.0f} px, a factor of {focal_px / said_px:.2f}: EXIF is not used (digital "
            "zoom, an adapter, or a picture that was cut)"
        )
        for at in members:
            believed[at] = replace(photos[at], exif_focal_px=focal_px)
    return believed


def each_by_itself(
    ties: Ties, photos: Photos, params: OrientParams, ctx: StepContext, estimator: Estimator
) -> list[Oriented]:
    """Orient the photos one after the other by their own ties alone, and judge each.

    Raises:
        MethodError: no photos, no ties, or ties of other photos.
    """
    require(ties, photos)
    found = []
    believed = with_believable_priors(photos.photos, ties, params, ctx)
    for nth, photo in enumerate(believed):
        ctx.progress(nth / len(believed), photo.name)
        tied = tied_photo(photo, ties, params, ctx.rng)
        found.append(_by_itself(tied, ties, params, estimator))
    return found


def _by_itself(tied: TiedPhoto, ties: Ties, params: OrientParams, estimator: Estimator) -> Oriented:
    hand = oriented_by_hand(tied, ties, params)
    if hand.joined is not None:
        return hand.or_alone(judged(tied, candidate_of(tied, ties, params, hand.joined)))
    if hand.is_enough:
        return hand.alone
    reason = reason_not_to_try(tied, hand)
    if reason:
        return refused(tied, reason)
    estimate = estimator(tied.photo, tied.seen, tied.is_check, tied.rule)
    if isinstance(estimate, str):
        return refused(tied, hand.reason or estimate)
    return hand.or_alone(judged(tied, candidate_of(tied, ties, params, estimate)))


def reason_not_to_try(tied: TiedPhoto, hand: ByHand) -> str:
    """Say why a photo that ties by hand do not orient cannot be either by all its ties."""
    # What a person measured is never withheld, so that the others have to check the pose.
    n_withheld_from = int((~tied.by_hand).sum())
    return (hand.reason if too_few(n_withheld_from) else "") or too_few(len(tied.seen))


def oriented_by_hand(tied: TiedPhoto, ties: Ties, params: OrientParams) -> ByHand:
    """Orient a photo by the ties that a person measured, alone and with those that agree."""
    nothing = ByHand(alone=refused(tied, ""), kept=np.zeros(len(tied.seen), dtype=np.bool_))
    if tied.by_hand.sum() < TIES_LEAST:
        return nothing
    found = pose_by_hand(tied.photo, tied.seen, tied.by_hand)
    if isinstance(found, str):
        return replace(nothing, alone=refused(tied, found))
    alone = judged(tied, candidate_of(tied, ties, params, found.estimate))
    hand = ByHand(alone=alone, kept=found.estimate.agreeing)
    if too_few(int((~tied.by_hand).sum())):
        return hand
    try:
        joined = adjusted(tied.photo, tied.seen, tied.is_check, found.start, tied.rule)
    except GeometryError:
        return hand
    is_trusted = not reason_to_leave_out(candidate_of(tied, ties, params, joined))
    return replace(hand, joined=joined) if is_trusted and hand.agrees(joined.agreeing) else hand


def candidate_of(
    tied: TiedPhoto, ties: Ties, params: OrientParams, estimate: Estimate
) -> Candidate:
    """Bring together what an orientation is judged by."""
    used = np.zeros(len(ties.photo), dtype=np.bool_)
    used[tied.chosen[estimate.agreeing]] = True
    known = known_walls(ties, used)
    return Candidate(
        photo=tied.photo,
        seen=tied.seen,
        is_check=tied.is_check,
        walls=ties.wall[tied.chosen],
        estimate=estimate,
        known=known,
        error=wall_error(estimate.resection, known),
        rule=params.gates(),
        search_radius_px=_search_radius_px(ties, tied.photo.name),
    )


def judged(tied: TiedPhoto, candidate: Candidate) -> Oriented:
    """Call an orientation ok, or say why not."""
    reason = reason_against(candidate)
    numbers = photo_numbers(candidate) if candidate.control.any() else None
    entry: JsonValue = None if numbers is None else numbers_json(candidate, numbers)
    if reason:
        return replace(refused(tied, reason), entry=entry)
    result, estimate = candidate.estimate.resection, candidate.estimate
    role = np.where(candidate.checked, TieRole.CHECK, TieRole.CONTROL).astype(np.uint8)
    role[~estimate.agreeing] = TieRole.REJECTED
    return Oriented(
        camera=Camera(
            photo=candidate.photo.name,
            status="ok",
            intrinsics=estimate.intrinsics,
            rotation_camera_from_world=result.camera.rotation,
            translation_camera_from_world=result.camera.translation,
            covariance=result.covariance[:6, :6],
            sigma0_px=result.sigma0 * float(np.median(candidate.seen.sigma_px[candidate.control])),
            sigma_wall_m=None if candidate.error is None else candidate.error.rms_m,
        ),
        chosen=tied.chosen,
        role=role,
        residuals_px=estimate.fit.residuals_px,
        numbers=numbers,
        entry=entry,
        table=() if numbers is None else tuple(residual_table(candidate, numbers)),
        notes=(*estimate.notes, *warnings_for(candidate)),
        candidate=candidate,
    )


def refused(tied: TiedPhoto, reason: str) -> Oriented:
    """Give a photo without an orientation."""
    n_ties = len(tied.chosen)
    return Oriented(
        camera=Camera(photo=tied.photo.name, status=reason),
        chosen=tied.chosen,
        role=np.full(n_ties, TieRole.REJECTED, dtype=np.uint8),
        residuals_px=np.full((n_ties, 2), np.nan),
    )


def _usable(ties: Ties, name: str, n_most: int) -> NDArray[np.intp]:
    """Ties of a photo that may be used: not rejected by the matcher, thinned evenly."""
    mine = of_photo(ties, name)
    mine = np.asarray(mine[ties.role[mine] != TieRole.REJECTED], dtype=np.intp)
    if len(mine) <= n_most:
        return mine
    thinned = np.floor(np.arange(n_most) * len(mine) / n_most).astype(np.intp)
    kept = np.asarray(mine[thinned], dtype=np.intp)
    if ties.by_hand is not None:
        kept = np.union1d(kept, mine[ties.by_hand[mine] > 0])
    return kept


def _search_radius_px(ties: Ties, name: str) -> float:
    """What the matcher says of how far it looked for the ties of a photo."""
    radius_px = dict(zip(ties.photo_names, ties.search_radius_px, strict=False)).get(name)
    return math.inf if radius_px is None else radius_px
