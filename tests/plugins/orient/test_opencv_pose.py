"""The pose by OpenCV's solvePnP alone: what it finds, rejects, and cannot do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from orthoflow_plugins.orient.pnp import OrientPnp, estimate_by_opencv
from orthoflow_plugins.orient.pose import TiedPhoto

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.resection import SeenPoints
from orthoflow.products import Intrinsics, Photo
from orthoflow.testing import photographed as ms

PARAMS = OrientPnp.Params(method="opencv")
CAMERA = ms.camera_before(ms.textured_wall(0))


def seen_by(viewer: ViewingCamera, n: int, *, noise_px: float = 0.0) -> SeenPoints:
    rng = np.random.default_rng(1)
    points = rng.uniform([0.2, -0.3, 0.2], [2.8, 0.1, 1.8], (6 * n, 3))
    pixels = viewer.project(points)[:, :2]
    inside = np.flatnonzero(viewer.sees(pixels))[:n]
    return SeenPoints(
        pixels_photo=pixels[inside] + noise_px * rng.normal(size=(n, 2)),
        points_world=points[inside],
        sigma_px=np.full(n, 0.5),
        sigma_m=np.full(n, 1e-4),
    )


def photo() -> Photo:
    return Photo(
        name="a.png",
        encoded=b"",
        width=CAMERA.width,
        height=CAMERA.height,
        intrinsics=Intrinsics.of(CAMERA),
    )


def none_of(n: int) -> np.ndarray:
    return np.zeros(n, dtype=np.bool_)


def tied(of: Photo, seen: SeenPoints, is_check: np.ndarray) -> TiedPhoto:
    return TiedPhoto(
        photo=of,
        chosen=np.arange(len(seen)),
        seen=seen,
        is_check=is_check,
        by_hand=none_of(len(seen)),
        seed=1,
    )


def test_a_lens_with_skew_is_refused_with_what_to_do_instead() -> None:
    skewed = replace(photo(), intrinsics=Intrinsics.of(replace(CAMERA, skew=2.5)))
    said = estimate_by_opencv(tied(skewed, seen_by(CAMERA, 40), none_of(40)), PARAMS)
    assert isinstance(said, str)
    assert said.endswith("2.5 px of it: use orient.pnp with method weighted")
