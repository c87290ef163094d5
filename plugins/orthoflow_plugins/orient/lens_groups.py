"""Which photos share a lens, what is known of it beforehand, and how it came out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.lenses import POSE_PARAMETERS, LensFreedom, lens_values
from orthoflow.products import JsonValue, Photo
from orthoflow_plugins.orient.block import Block, Lens
from orthoflow_plugins.orient.lenses import lens_prior

Sharing = Literal["focal-group", "shared", "per-photo"]
Refined = Literal["uncalibrated", "all", "none"]

_CALIBRATED: Final = {"focal_sigma": 0.01, "k1_sigma": 0.02, "k2_sigma": 0.04}
_CALIBRATED_CENTRE_SHARE: Final = 0.003
_CALIBRATED_TANGENTIAL: Final = 1e-3
_CORRELATED: Final = 0.95
_POSE_NAMES: Final = ("tilt", "pan", "roll", "x", "y", "distance")


@dataclass(frozen=True, kw_only=True)
class LensGroups:
    """Lenses of a set of photos.

    Attributes:
        lens_of: index of each photo's lens.
        lenses: the lenses.
    """

    lens_of: tuple[int, ...]
    lenses: tuple[Lens, ...]


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


def lenses_json(
    block: Block, photos: Sequence[Photo], covariance: NDArray[np.float64]
) -> JsonValue:
    """Give each lens as it came out, with standard deviations where it was free."""
    entries: list[JsonValue] = []
    starts = block.column_starts[1]
    for index, lens in enumerate(block.lenses):
        members = [at for at, of in enumerate(block.lens_of) if of == index]
        camera = block.cameras[members[0]]
        columns = np.arange(starts[index], starts[index + 1])
        sigmas = np.sqrt(np.diag(covariance)[columns])
        names = lens.freedom.names
        entry: dict[str, JsonValue] = {
            "photos": [photos[at].name for at in members],
            "known_from": lens.source,
            "focal_px": camera.fx,
            "centre_px": [camera.cx, camera.cy],
            "distortion": [float(value) for value in camera.distortion],
            "free": list(names),
            "sigmas": {
                name: float(sigma * (camera.fx if name == "focal" else 1.0))
                for name, sigma in zip(names, sigmas, strict=True)
            },
        }
        entries.append(entry)
    return entries


def lens_statistics(block: Block) -> JsonValue:
    """Mean and SD of what is free, over lenses of one image size that are free alike."""
    kinds: dict[tuple[int, int, tuple[str, ...]], list[NDArray[np.float64]]] = {}
    for index, lens in enumerate(block.lenses):
        camera = block.cameras[block.lens_of.index(index)]
        values = lens_values(camera, lens.freedom)
        values[: 1 if "focal" in lens.freedom.names else 0] = camera.fx
        kind = (lens.prior.width, lens.prior.height, lens.freedom.names)
        kinds.setdefault(kind, []).append(values)
    table: list[JsonValue] = []
    for (width, height, names), rows in kinds.items():
        if not names:
            continue
        stacked = np.array(rows)
        spread = stacked.std(axis=0, ddof=1) if len(rows) > 1 else np.zeros(len(names))
        table.append(
            {
                "width": width,
                "height": height,
                "n_lenses": len(rows),
                "mean": dict(zip(names, stacked.mean(axis=0).tolist(), strict=True)),
                "sd": dict(zip(names, spread.tolist(), strict=True)),
            }
        )
    return table


def correlation_notes(
    block: Block, photos: Sequence[Photo], cofactors: NDArray[np.float64]
) -> list[str]:
    """Say where the photos hardly tell a lens from where they were taken."""
    notes = []
    scale = np.sqrt(np.diag(cofactors))
    correlations = np.abs(cofactors / np.outer(scale, scale))
    for index, lens in enumerate(block.lenses):
        members = [at for at, of in enumerate(block.lens_of) if of == index]
        first = block.column_starts[1][index]
        for nth, name in enumerate(lens.freedom.names):
            rows = [correlations[6 * at : 6 * at + POSE_PARAMETERS, first + nth] for at in members]
            # Only what all its photos confuse stays unknown.
            confused = np.min(rows, axis=0)
            worst = int(confused.argmax())
            if confused[worst] > _CORRELATED:
                notes.append(
                    f"the {name} of the lens of {photos[members[0]].name} and the "
                    f"{_POSE_NAMES[worst]} of its photos correlate by {confused[worst]:.3f}: "
                    "photos from other sides, some turned by 90 degrees, or a calibration would "
                    "tell them apart"
                )
    return notes


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
