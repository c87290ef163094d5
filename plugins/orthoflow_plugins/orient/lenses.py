"""Lenses: what is known of them before an orientation, which photos share one, and their rays."""

from __future__ import annotations

import math
from collections.abc import Sequence, Set
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.cameras import ViewingCamera, undistorted
from orthoflow.geometry.lenses import POSE_PARAMETERS, LensFreedom, unmeasured
from orthoflow.geometry.resection import Resection
from orthoflow.products import Intrinsics, Photo

Sharing = Literal["focal-group", "shared", "per-photo"]
Refined = Literal["uncalibrated", "all", "none"]
UNKNOWN: Final = "none"
"""Source of a lens of which neither a calibration nor EXIF says anything."""

_EXIF_FACTORS: Final = (1.0, 0.94, 1.06)
_UNKNOWN_FACTORS: Final = (0.6, 0.75, 0.95, 1.2, 1.6, 2.2)
# How far a calibration may be off where it is refined all the same.
_CALIBRATED: Final = {"focal_sigma": 0.01, "k1_sigma": 0.02, "k2_sigma": 0.04}
_CALIBRATED_CENTRE_SHARE: Final = 0.003
_CALIBRATED_TANGENTIAL: Final = 1e-3
_UNDONE: Final = 1e-9


@dataclass(frozen=True, kw_only=True)
class LensPrior:
    """A lens to start from.

    Attributes:
        guesses: interior orientations to try, the likeliest first.
        freedom: what the adjustment may change.
        source: `calibration`, `exif` or `UNKNOWN`.
    """

    guesses: tuple[Intrinsics, ...]
    freedom: LensFreedom
    source: str


@dataclass(frozen=True, kw_only=True)
class Lens:
    """A lens that one photo or several were taken with.

    Attributes:
        prior: what it is beforehand; its pose says nothing.
        freedom: how far it may change.
        source: what `prior` is known from.
    """

    prior: ViewingCamera
    freedom: LensFreedom
    source: str


@dataclass(frozen=True, kw_only=True)
class LensGroups:
    """Lenses of a set of photos.

    Attributes:
        lens_of: index of each photo's lens.
        lenses: the lenses.
    """

    lens_of: tuple[int, ...]
    lenses: tuple[Lens, ...]


def lens_prior(photo: Photo) -> LensPrior:
    """Return what is known of a photo's lens: its calibration, else EXIF, else what is usual."""
    if photo.intrinsics is not None:
        return LensPrior(
            guesses=(photo.intrinsics,), freedom=LensFreedom(), source=photo.intrinsics.source
        )
    longest = max(photo.width, photo.height)
    if photo.exif_focal_px is not None:
        return LensPrior(
            guesses=tuple(_centred(photo, photo.exif_focal_px * f) for f in _EXIF_FACTORS),
            freedom=unmeasured(longest, has_exif=True),
            source="exif",
        )
    return LensPrior(
        guesses=tuple(_centred(photo, longest * f) for f in _UNKNOWN_FACTORS),
        freedom=unmeasured(longest, has_exif=False),
        source=UNKNOWN,
    )


def intrinsics_of(resection: Resection, source: str) -> Intrinsics:
    """Return the interior orientation after an adjustment; `source` is what it was known from."""
    was_estimated = resection.lens.sigmas.size or source == UNKNOWN
    return Intrinsics.of(resection.camera, source="estimated" if was_estimated else source)


def focal_sigma(resection: Resection) -> float:
    """Return the standard deviation of an adjusted ln(focal length); inf where it was held."""
    if "focal" not in resection.lens.names:
        return math.inf
    column = POSE_PARAMETERS + resection.lens.names.index("focal")
    return math.sqrt(resection.covariance[column, column])


def lens_groups(
    photos: Sequence[Photo],
    cameras: Sequence[ViewingCamera],
    sharing: Sharing,
    refined: Refined,
    apart: Set[int] = frozenset(),
) -> LensGroups:
    """Group photos by lens.

    Args:
        photos: the photos.
        cameras: each oriented by itself; where nothing is known of a lens, they start it.
        sharing: `focal-group`: photos of one size and one focal length share a lens, or those of
            one size of which no file says it; `shared`: all of one size do; `per-photo`: none do.
        refined: which lenses may change.
        apart: photos that have a lens of their own whatever they have in common with others.
    """
    keys = [_key(index, photo, sharing, apart) for index, photo in enumerate(photos)]
    names = list(dict.fromkeys(keys))
    lenses = []
    for name in names:
        members = [index for index, key in enumerate(keys) if key == name]
        best_known = min(members, key=lambda at: _uncertainty(photos[at]))
        lenses.append(_lens(photos[best_known], [cameras[at] for at in members], refined))
    return LensGroups(lens_of=tuple(names.index(key) for key in keys), lenses=tuple(lenses))


def camera_rays(camera: ViewingCamera, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Directions (n, 3) with z = 1 in camera axes; NaN where the distortion cannot be undone."""
    found = undistorted(*camera.bent_rays(pixels.T), camera.distortion)
    rays = np.column_stack([found[0], found[1], np.ones(len(pixels))])
    rays[~(found[2] < _UNDONE)] = np.nan
    return rays


def _centred(photo: Photo, focal_px: float) -> Intrinsics:
    return Intrinsics(
        width=photo.width,
        height=photo.height,
        fx=focal_px,
        fy=focal_px,
        cx=0.5 * photo.width,
        cy=0.5 * photo.height,
        source="exif",
    )


def _key(index: int, photo: Photo, sharing: Sharing, apart: Set[int]) -> tuple[object, ...]:
    size = (photo.width, photo.height)
    if sharing == "per-photo" or index in apart:
        return (*size, None, index)
    if sharing == "shared":
        return size
    return (*size, photo.exif_focal_px if photo.intrinsics is None else photo.intrinsics)


def _uncertainty(photo: Photo) -> float:
    """How little is known of a photo's focal length."""
    return lens_prior(photo).freedom.focal_sigma


def _lens(photo: Photo, cameras: Sequence[ViewingCamera], refined: Refined) -> Lens:
    known = lens_prior(photo)
    prior = known.guesses[0].posed()
    longest = max(photo.width, photo.height)
    if known.source == UNKNOWN:
        prior = replace(prior, fx=_median_focal(cameras), fy=_median_focal(cameras))
    if known.freedom.sigmas.size == 0:
        freedom = LensFreedom()
        if refined == "all":
            freedom = LensFreedom(
                **_CALIBRATED,
                centre_sigma_px=_CALIBRATED_CENTRE_SHARE * longest,
                tangential_sigma=_CALIBRATED_TANGENTIAL,
            )
    else:
        freedom = LensFreedom() if refined == "none" else known.freedom
    return Lens(prior=prior, freedom=freedom, source=known.source)


def _median_focal(cameras: Sequence[ViewingCamera]) -> float:
    return float(np.median([camera.fx for camera in cameras]))
