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
from tests import samples

_VIEWS = (
    ((0.8, -2.4, 1.1), (1.3, 0.0, 1.0), 0.0),
    ((2.0, -2.6, 0.9), (1.6, 0.0, 1.0), 1.57),
    ((1.5, -2.2, 1.3), (1.5, 0.0, 1.0), 0.0),
    ((2.6, -2.2, 1.0), (1.8, 0.0, 1.0), 0.0),
)
SCENE = ms.textured_wall(0)


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
    seed: int,
    *,
    n: int = 150,
    noise_px: float = 0.5,
    noise_m: float = 0.001,
    wrong_share: float = 0.1,
    shift_m: np.ndarray | None = None,
) -> Ties:
    """Ties of each photo with points of its own on the wall, some at random pixels."""
    rng = np.random.default_rng(seed)
    owner, pixels, points = [], [], []
    for index, camera in enumerate(viewers()):
        cells = rng.uniform([5, 5], [495, 328], (8 * n, 2))
        depth = SCENE.depth_m(cells[:, 0] * ms.GSD_M, cells[:, 1] * ms.GSD_M)
        true = SCENE.frame.world_from_wall(cells, depth)
        seen = camera.project(true)[:, :2]
        chosen = np.flatnonzero(camera.sees(seen))[:n]
        found = seen[chosen] + noise_px * rng.normal(size=(n, 2))
        n_wrong = round(wrong_share * n)
        found[:n_wrong] = rng.uniform([0, 0], [900, 640], (n_wrong, 2))
        owner.append(np.full(n, index, np.int32))
        pixels.append(found)
        points.append(true[chosen] + noise_m * rng.normal(size=(n, 3)))
    shift = np.zeros(3) if shift_m is None else shift_m
    n_all = n * len(viewers())
    return samples.ties(
        np.vstack(pixels),
        photo_names=names(),
        photo=np.concatenate(owner),
        points_world=np.vstack(points) + shift,
        sigma_px=np.full(n_all, noise_px),
        sigma_m=np.full(n_all, noise_m),
        walls=(samples.tie_wall(SCENE.frame.corners_world() + shift, ms.GSD_M),),
    )
