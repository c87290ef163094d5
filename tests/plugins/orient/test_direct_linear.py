"""Projection matrices taken apart, and how much control eleven parameters and a lens need."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.orient.dlt import (
    Distortion,
    OrientDlt,
    direct_linear,
    estimate_dlt,
    relief,
)
from orthoflow_plugins.orient.pose import Estimate, TiedPhoto

from orthoflow.errors import GeometryError
from orthoflow.geometry.cameras import ViewingCamera, looking_at
from orthoflow.geometry.frames import rotation_from_vector
from orthoflow.geometry.resection import SeenPoints
from orthoflow.products import Intrinsics, Photo
from tests import samples
from tests.long_loops import seeds

SIZE_PX = (4000, 3000)


def camera(**changes: object) -> ViewingCamera:
    centre = np.array([0.15, -2.6, 0.1])
    rotation = looking_at(centre, np.zeros(3), np.array([0.0, 0.0, 1.0]))
    plain = {"fx": 3200.0, "fy": 3204.0, "cx": 2012.0, "cy": 1490.0}
    return samples.camera(
        rotation, centre, width=SIZE_PX[0], height=SIZE_PX[1], **{**plain, **changes}
    )


def seen_by(
    viewer: ViewingCamera, n: int, *, relief_m: float = 0.3, sigma_m: float = 1e-5, seed: int = 1
) -> SeenPoints:
    """Exact ties all over the photo, on two planes so far apart."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform([100.0, 100.0], [3900.0, 2900.0], (n, 2))
    rays = viewer.rays_world(pixels)
    depth = np.where(np.arange(n) % 2 == 0, 0.0, -relief_m)
    reach = (depth - viewer.centre_world[1]) / rays[:, 1]
    return SeenPoints(
        pixels_photo=pixels,
        points_world=viewer.centre_world + reach[:, None] * rays,
        sigma_px=np.full(n, 0.5),
        sigma_m=np.full(n, sigma_m),
    )


def estimated(
    viewer: ViewingCamera,
    seen: SeenPoints,
    *,
    distortion: Distortion = "none",
    keeps_skew: bool = False,
    is_check: NDArray[np.bool_] | None = None,
) -> Estimate | str:
    photo = Photo(
        name="a.png",
        encoded=b"",
        width=SIZE_PX[0],
        height=SIZE_PX[1],
        intrinsics=Intrinsics.of(viewer),
    )
    withheld = np.zeros(len(seen), dtype=np.bool_) if is_check is None else is_check
    tied = TiedPhoto(
        photo=photo,
        chosen=np.arange(len(seen)),
        seen=seen,
        is_check=withheld,
        by_hand=np.zeros(len(seen), dtype=np.bool_),
        seed=1,
    )
    return estimate_dlt(tied, OrientDlt.Params(distortion=distortion, skew=keeps_skew))


@pytest.mark.parametrize("scale", [1.0, -3.0, 0.02])
@pytest.mark.parametrize("seed", seeds(4))
def test_a_projection_matrix_comes_apart_into_what_it_was_made_of(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    rotation = rotation_from_vector(rng.normal(size=3))
    translation = rng.normal(size=3)
    lens = np.array([[3000.0, 25.0, 2010.0], [0.0, 2800.0, 1480.0], [0.0, 0.0, 1.0]])
    # In front of the camera, five metres away and more.
    local = rng.uniform([-2.0, -2.0, 5.0], [2.0, 2.0, 9.0], (12, 3))
    points = (local - translation) @ rotation
    matrix = scale * lens @ np.column_stack([rotation, translation])
    pixels = (homogeneous := np.column_stack([points, np.ones(12)]) @ matrix.T)[:, :2]
    pixels /= homogeneous[:, 2:]
    found = direct_linear(pixels, points, SIZE_PX)[0]
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-7)
    np.testing.assert_allclose(found.translation, translation, atol=1e-6)
    assert (found.fx, found.fy) == pytest.approx((3000.0, 2800.0))
    assert (found.cx, found.cy, found.skew) == pytest.approx((2010.0, 1480.0, 25.0))
    assert (found.width, found.height) == SIZE_PX
    # Mirrored in the projection centre, the points have the same pixels, and lie behind it.
    behind = (-local - translation) @ rotation
    with pytest.raises(GeometryError, match="puts the points behind the camera"):
        direct_linear(pixels, behind, SIZE_PX)


@pytest.mark.parametrize(
    ("distortion", "keeps_skew", "least"),
    [
        ("none", False, 12),
        ("none", True, 13),
        ("k1", False, 16),
        ("k1 k2 p1 p2", False, 24),
        ("k1 k2 p1 p2", True, 25),
    ],
)
def test_a_richer_lens_needs_more_control(
    distortion: Distortion, keeps_skew: bool, least: int
) -> None:
    viewer = camera()
    enough, few = (
        estimated(viewer, seen_by(viewer, n), distortion=distortion, keeps_skew=keeps_skew)
        for n in (least, least - 1)
    )
    assert isinstance(enough, Estimate)
    assert isinstance(few, str)
    # Check points are no control points.
    is_check = np.arange(least) == 3
    held = estimated(
        viewer,
        seen_by(viewer, least),
        distortion=distortion,
        keeps_skew=keeps_skew,
        is_check=is_check,
    )
    assert isinstance(held, str)


@pytest.mark.parametrize(("sigma_m", "is_enough"), [(0.0048, True), (0.0053, False)])
def test_relief_must_be_ten_deviations_of_the_points(sigma_m: float, is_enough: bool) -> None:
    viewer = camera()
    # Two planes 10 cm apart: 5 cm from the one between them, nearly.
    seen = seen_by(viewer, 80, relief_m=0.1, sigma_m=sigma_m)
    assert relief(seen.points_world)[0] == pytest.approx(0.05, rel=0.02)
    found = estimated(viewer, seen)
    assert isinstance(found, Estimate) == is_enough
    if isinstance(found, str):
        assert "a DLT needs 10 times as much relief" in found


def test_skew_is_given_whether_it_is_kept_or_not() -> None:
    viewer = camera(skew=4.0)
    seen = seen_by(viewer, 60)
    for keeps_skew, kept_px in ((True, 4.0), (False, 0.0)):
        found = estimated(replace(viewer, skew=0.0), seen, keeps_skew=keeps_skew)
        assert isinstance(found, Estimate)
        assert found.numbers["skew_px"] == pytest.approx(4.0, abs=0.1)
        assert found.resection.camera.skew == pytest.approx(kept_px, abs=0.1)


def test_five_points_and_points_in_one_place_determine_no_camera() -> None:
    seen = seen_by(camera(), 6)
    direct_linear(seen.pixels_photo, seen.points_world, SIZE_PX)
    with pytest.raises(GeometryError, match="needs six points, got 5"):
        direct_linear(seen.pixels_photo[:5], seen.points_world[:5], SIZE_PX)
    with pytest.raises(GeometryError, match="lie in one place"):
        direct_linear(seen.pixels_photo, np.ones((6, 3)), SIZE_PX)
