"""Photos of a textured wall with ties that are known but for their noise, and their orientation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from orthoflow_plugins.orient.gates import KnownWall
from orthoflow_plugins.orient.pose import TiedPhoto

from orthoflow.files.images import encode_png
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.resection import SeenPoints
from orthoflow.products import Cameras, Intrinsics, Photo, Photos, Ties
from orthoflow.sdk import StepContext
from orthoflow.testing import photographed as ms
from tests import samples
from tests.method_runs import run

SCENE = ms.textured_wall(0)
SIZE_PX = (900, 640)
ENCODED = encode_png(np.zeros(SIZE_PX[::-1], np.uint8))


def context(folder: Path, *, seed: int = 1) -> StepContext:
    return StepContext(rng=np.random.default_rng(seed), cores=2, scratch=folder)


# Any: fields of the photo, each of its own type; ports and parameters differ by method.
def photo(calibrated: ViewingCamera | None = None, **known: Any) -> Photo:
    """A photo, calibrated by a camera or not."""
    if calibrated is not None:
        known["intrinsics"] = Intrinsics.of(calibrated)
    usual = {"name": "a.png", "encoded": ENCODED, "width": SIZE_PX[0], "height": SIZE_PX[1]}
    return Photo(**{**usual, **known})


def oriented(by: Any, ties: Ties, photos: Photos, ctx: StepContext, **params: Any) -> Cameras:
    """What a method makes of photos and ties."""
    cameras: Cameras = run(by, ctx, {"ties": ties, "photos": photos}, **params).cameras
    return cameras


def seen_by(
    camera: ViewingCamera,
    n: int,
    *,
    seed: int = 1,
    noise_px: float = 0.0,
    noise_m: float = 0.0,
    sigma_px: float = 0.5,
    sigma_m: float = 1e-4,
    depths_m: tuple[float, float] = (-0.3, 0.1),
) -> SeenPoints:
    """Points about the wall as the camera sees them."""
    rng, (low, high) = np.random.default_rng(seed), depths_m
    points = rng.uniform([0.2, low, 0.2], [2.8, high, 1.8], (6 * n, 3))
    pixels = camera.project(points)[:, :2]
    inside = np.flatnonzero(camera.sees(pixels))[:n]
    seen = pixels[inside] + noise_px * rng.normal(size=(n, 2))
    known = points[inside] + noise_m * rng.normal(size=(n, 3))
    return samples.seen(seen, known, sigma_px, sigma_m)


def seen_of(ties: Ties) -> SeenPoints:
    return SeenPoints(
        pixels_photo=ties.pixels_photo,
        points_world=ties.points_world,
        sigma_px=ties.sigma_px,
        sigma_m=ties.sigma_m,
    )


def tied(
    of: Photo,
    seen: SeenPoints,
    *,
    is_check: NDArray[np.bool_] | None = None,
    by_hand: NDArray[np.bool_] | None = None,
) -> TiedPhoto:
    """A photo with its ties, of which none are withheld or measured by hand unless given."""
    none = np.zeros(len(seen), dtype=np.bool_)
    return TiedPhoto(
        photo=of,
        chosen=np.arange(len(seen)),
        seen=seen,
        is_check=none if is_check is None else is_check,
        by_hand=none if by_hand is None else by_hand,
        seed=1,
    )


def known_ties(
    camera: ViewingCamera,
    seed: int | np.random.Generator,
    *,
    n: int = 200,
    wrong_share: float = 0.0,
    relief: float = 1.0,
    sigma_m: float = 1e-4,
    shift_m: NDArray[np.float64] | None = None,
) -> Ties:
    """Ties with 0.5 px of noise on the textured wall, a share of them at random places.

    Points of the scan have errors where `sigma_m` is not the default.
    """
    rng = np.random.default_rng(seed)
    cells = rng.uniform([5, 5], [495, 328], (8 * n, 2))
    depth = relief * SCENE.depth_m(cells[:, 0] * ms.GSD_M, cells[:, 1] * ms.GSD_M)
    points = SCENE.frame.world_from_wall(cells, depth)
    pixels = camera.project(points)[:, :2]
    chosen = np.flatnonzero(camera.sees(pixels))[:n]
    points, pixels = points[chosen], pixels[chosen] + 0.5 * rng.normal(size=(len(chosen), 2))
    n_wrong = round(wrong_share * len(chosen))
    pixels[:n_wrong] = rng.uniform([0, 0], SIZE_PX, (n_wrong, 2))
    if sigma_m > 1e-4:
        points += sigma_m * rng.normal(size=points.shape)
    shift = np.zeros(3) if shift_m is None else shift_m
    return samples.ties(
        pixels,
        points_world=points + shift,
        sigma_px=np.full(len(chosen), 0.5),
        sigma_m=np.full(len(chosen), sigma_m),
        walls=(samples.tie_wall(SCENE.frame.corners_world() + shift, ms.GSD_M),),
    )


def joined(*each: Ties) -> Ties:
    """The ties of all, of which the first has what they share."""
    arrays = [name for name, value in vars(each[0]).items() if isinstance(value, np.ndarray)]
    both = {name: np.concatenate([getattr(ties, name) for ties in each]) for name in arrays}
    return replace(each[0], **both)


def known_wall(
    across_m: tuple[float, float],
    up_m: tuple[float, float] = (0.0, 2.0),
    *,
    number: int = 0,
    gsd_m: float | None = None,
) -> KnownWall:
    """A rectangle in the plane y = 0 that faces -y."""
    (left, right), (low, high) = across_m, up_m
    corners = [[left, 0.0, high], [left, 0.0, low], [right, 0.0, low], [right, 0.0, high]]
    return KnownWall(
        index=number,
        number=number,
        name=f"wall {number}",
        corners_world=np.array(corners),
        normal=-samples.NORTH,
        gsd_m=gsd_m,
        has_side=True,
    )
