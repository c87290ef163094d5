"""Several photos of one textured wall, with scan ties that are known but for their noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.products import Photos, Ties
from orthoflow.testing import photographed as ms
from tests import tied_photos as tp

_VIEWS = (
    ((0.8, -2.4, 1.1), (1.3, 0.0, 1.0), 0.0),
    ((2.0, -2.6, 0.9), (1.6, 0.0, 1.0), 1.57),
    ((1.5, -2.2, 1.3), (1.5, 0.0, 1.0), 0.0),
    ((2.6, -2.2, 1.0), (1.8, 0.0, 1.0), 0.0),
)
SCENE = tp.SCENE


def viewers() -> tuple[ViewingCamera, ...]:
    """Four photos of one lens, one of them turned by 90 degrees."""
    return tuple(
        replace(camera, fy=camera.fx)
        for centre, towards, roll in _VIEWS
        for camera in [ms.camera_before(centre=centre, towards=towards, roll=roll)]
    )


def names() -> tuple[str, ...]:
    return tuple(f"{letter}.png" for letter in "abcd")


def observed(
    cameras: Sequence[ViewingCamera], points: NDArray[np.float64]
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]:
    """Photo, point and pixel of each point in each photo that shows it, photo by photo."""
    pixels = np.array([camera.project(points)[:, :2] for camera in cameras])
    shown = [camera.sees(own) for camera, own in zip(cameras, pixels, strict=True)]
    photo, point = np.nonzero(shown)
    return photo, point, pixels[photo, point]


@cache
def photos(*, calibrated: bool) -> Photos:
    """What the viewers see; without calibration EXIF says a focal length 2 % too long."""
    return ms.photos(
        *(
            ms.photo_of(SCENE, camera, name=name, calibrated=calibrated)
            for name, camera in zip(names(), viewers(), strict=True)
        )
    )


def scan_ties(
    seed: int, *, n: int = 150, wrong_share: float = 0.1, shift_m: np.ndarray | None = None
) -> Ties:
    """Ties of each photo with points of its own on the wall, some at random pixels."""
    rng, each = np.random.default_rng(seed), []
    for index, camera in enumerate(viewers()):
        own = tp.known_ties(
            camera,
            rng,
            n=n,
            wrong_share=wrong_share,
            sigma_m=0.001,
            shift_m=shift_m,
        )
        each.append(replace(own, photo_names=names(), photo=np.full(n, index, np.int32)))
    return tp.joined(*each)
