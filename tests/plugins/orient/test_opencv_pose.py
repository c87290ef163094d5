"""The pose by OpenCV's solvePnP alone: what it finds, rejects, and cannot do."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.orient.pnp import OrientPnp, estimate_by_opencv
from orthoflow_plugins.orient.pose import Estimate, TiedPhoto

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.resection import SeenPoints
from orthoflow.products import Intrinsics, Photo
from orthoflow.testing import photographed as ms
from tests.scenes import SURVEY_SHIFT_M

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


@pytest.mark.parametrize("shift_m", [np.zeros(3), SURVEY_SHIFT_M], ids=["", "survey"])
def test_exact_ties_give_the_exact_pose(shift_m: np.ndarray) -> None:
    viewer = CAMERA.shifted(-shift_m)
    seen = seen_by(CAMERA, 40)
    seen = replace(seen, points_world=seen.points_world + shift_m)
    found = estimate_by_opencv(tied(photo(), seen, none_of(40)), PARAMS)
    assert isinstance(found, Estimate)
    camera = found.resection.camera
    np.testing.assert_allclose(camera.centre_world, viewer.centre_world, atol=1e-5)
    np.testing.assert_allclose(camera.rotation, viewer.rotation, atol=1e-5)
    assert camera.fx == viewer.fx


def test_a_lens_with_skew_is_refused_with_what_to_do_instead() -> None:
    skewed = replace(photo(), intrinsics=Intrinsics.of(replace(CAMERA, skew=2.5)))
    said = estimate_by_opencv(tied(skewed, seen_by(CAMERA, 40), none_of(40)), PARAMS)
    assert isinstance(said, str)
    assert said.endswith("2.5 px of it: use orient.pnp with method weighted")


@pytest.mark.parametrize("n_check", [0, 30])
def test_wrong_ties_are_rejected_and_every_other_counts_alike(n_check: int) -> None:
    seen = seen_by(CAMERA, 120, noise_px=0.4)
    wrong = np.arange(120) % 10 == 3
    pixels = seen.pixels_photo + wrong[:, None] * np.array([9.0, -7.0])
    is_check = np.arange(120) % 4 == 0 if n_check else none_of(120)
    found: Any = estimate_by_opencv(
        tied(photo(), replace(seen, pixels_photo=pixels), is_check), PARAMS
    )
    assert isinstance(found, Estimate)
    np.testing.assert_array_equal(found.agreeing & wrong, none_of(120))
    assert found.agreeing[~wrong].mean() > 0.97
    np.testing.assert_array_equal(found.agreeing, found.fit.normalised <= found.limit)
    off = np.linalg.norm(found.resection.camera.centre_world - CAMERA.centre_world)
    assert off < 0.01
    # Whatever the ties say of themselves, the pose is the same.
    doubted = np.where(np.arange(120) % 2 == 0, 0.5, 0.9)
    other: Any = estimate_by_opencv(
        tied(photo(), replace(seen, pixels_photo=pixels, sigma_m=1e-4 * doubted), is_check), PARAMS
    )
    np.testing.assert_allclose(
        other.resection.camera.centre_world, found.resection.camera.centre_world, atol=1e-3
    )
    assert found.source == "calibration"
