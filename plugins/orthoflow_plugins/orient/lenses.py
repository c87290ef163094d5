"""Lenses: what is known of them before an orientation, which photos share one, and their rays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.cameras import ViewingCamera, undistorted
from orthoflow.geometry.lenses import LensFreedom
from orthoflow.geometry.resection import Resection
from orthoflow.products import Intrinsics, Photo

Sharing = Literal["focal-group", "shared", "per-photo"]
Refined = Literal["uncalibrated", "all", "none"]

# EXIF says the focal length to a whole number of millimetres, or of the full-frame equivalent, and
# nothing of the focusing distance; nothing at all leaves what lenses usually are.
_EXIF_SIGMA: Final = 0.05
_UNKNOWN_SIGMA: Final = 0.35
# What else a lens may have that nobody measured. Held at nothing, it bends the pose: photos came
# out wrong by 2.4 times the error they stated, and by 1.7 times as much as they had to.
_CENTRE_SHARE: Final = 0.01
_K1_SIGMA: Final = 0.1
_K2_SIGMA: Final = 0.1
_TANGENTIAL_SIGMA: Final = 1e-3
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
        source: `calibration`, `exif` or `none`.
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
    """Give what is known of a photo's lens: its calibration, else EXIF, else what is usual."""
    if photo.intrinsics is not None:
        return LensPrior(
            guesses=(photo.intrinsics,), freedom=LensFreedom(), source=photo.intrinsics.source
        )
    if photo.exif_focal_px is not None:
        return LensPrior(
            guesses=tuple(_centred(photo, photo.exif_focal_px * f) for f in _EXIF_FACTORS),
            freedom=_unmeasured(photo, _EXIF_SIGMA),
            source="exif",
        )
    longest = max(photo.width, photo.height)
    return LensPrior(
        guesses=tuple(_centred(photo, longest * f) for f in _UNKNOWN_FACTORS),
        freedom=_unmeasured(photo, _UNKNOWN_SIGMA),
        source="none",
    )


def intrinsics_of(resection: Resection, source: str) -> Intrinsics:
    """Give the interior orientation after an adjustment; `source` is what it was known from."""
    was_estimated = resection.lens.sigmas.size or source == "none"
    return Intrinsics.of(resection.camera, source="estimated" if was_estimated else source)


def lens_groups(
    photos: Sequence[Photo],
    cameras: Sequence[ViewingCamera],
    sharing: Sharing,
    refined: Refined,
) -> LensGroups:
    """Group photos by lens.

    Args:
        photos: the photos.
        cameras: each oriented by itself; where nothing is known of a lens, they start it.
        sharing: `focal-group`: photos of one size and one known focal length share a lens;
            `shared`: all of one size do; `per-photo`: none do.
        refined: which lenses may change.
    """
    keys = [_key(index, photo, sharing) for index, photo in enumerate(photos)]
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


def _unmeasured(photo: Photo, focal_sigma: float) -> LensFreedom:
    """How far a lens without calibration may be from one without any errors."""
    return LensFreedom(
        focal_sigma=focal_sigma,
        centre_sigma_px=_CENTRE_SHARE * max(photo.width, photo.height),
        k1_sigma=_K1_SIGMA,
        k2_sigma=_K2_SIGMA,
        tangential_sigma=_TANGENTIAL_SIGMA,
    )


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


def _key(index: int, photo: Photo, sharing: Sharing) -> tuple[object, ...]:
    size = (photo.width, photo.height)
    if sharing == "per-photo":
        return (*size, index)
    if sharing == "shared":
        return size
    if photo.intrinsics is not None:
        return (*size, photo.intrinsics)
    # A focal length that nobody knows may be another one for every photo.
    return (*size, photo.exif_focal_px if photo.exif_focal_px is not None else index)


def _uncertainty(photo: Photo) -> float:
    """How little is known of a photo's focal length."""
    return lens_prior(photo).freedom.focal_sigma


def _lens(photo: Photo, cameras: Sequence[ViewingCamera], refined: Refined) -> Lens:
    known = lens_prior(photo)
    prior = known.guesses[0].posed()
    longest = max(photo.width, photo.height)
    if known.source == "none":
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
