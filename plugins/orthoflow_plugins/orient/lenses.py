"""What is known of a photo's lens before its orientation, and how far it may move."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from orthoflow.geometry.lenses import LensFreedom
from orthoflow.geometry.resection import Resection
from orthoflow.products import Intrinsics, Photo

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
