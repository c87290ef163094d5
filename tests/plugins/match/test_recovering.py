"""Photos found by what others show: whose lens they have, which of them paints, and which pose."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.match.tracing import (
    lens_of,
    painted_walls,
    pose_of_most,
)

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.products import Camera, Photo
from orthoflow.testing import photographed as ms
from tests import samples
from tests.scenes import SURVEY_SHIFT_M

VIEW = ms.camera_before(ms.textured_wall(0))


def photo(**known: Any) -> Photo:
    return Photo(**{"name": "new.png", "encoded": b"", "width": 900, "height": 640, **known})


def oriented(focal_px: float, *, width: int = 900, height: int = 640) -> Camera:
    view = replace(VIEW, fx=focal_px, fy=focal_px, width=width, height=height)
    return ms.oriented(view, name="old.png")


@pytest.mark.parametrize(
    ("exif_px", "is_known"),
    [(None, True), (1000.0, True), (920.0, True), (1100.0, True), (905.0, False), (1120.0, False)],
)
def test_a_lens_is_taken_from_a_photo_of_the_same_size_and_nearly_the_same_focal_length(
    exif_px: float | None, is_known: bool
) -> None:
    found = lens_of(photo(exif_focal_px=exif_px), {"old.png": oriented(1000.0)}, ms.photos())
    assert (found is not None) == is_known
    if found is not None:
        assert found.fx == 1000.0


def test_a_lens_that_contradicts_exif_is_that_of_photos_with_the_same_exif() -> None:
    old, new = photo(name="old.png", exif_focal_px=500.0), photo(exif_focal_px=500.0)
    found = lens_of(new, {"old.png": oriented(1000.0)}, ms.photos(old, new))
    assert found is not None
    assert found.fx == 1000.0


def view_of(
    grey: float, part: tuple[slice, slice], size: float, *, unknown: tuple[int, int] | None = None
) -> Any:
    """A photo that shows one grey in a part of the first of two walls, so large."""
    projection = SimpleNamespace(part=part, pixels_per_cell=size)
    shown = np.full((part[0].stop - part[0].start, part[1].stop - part[1].start), grey, np.float32)
    if unknown is not None:
        shown[unknown] = np.nan
    return SimpleNamespace(
        projections=[projection, None], on_wall=lambda _index, _projection: shown
    )


def test_of_photos_the_one_that_shows_a_place_largest_paints_it() -> None:
    walls = [samples.wall(samples.facing_south(0.01, 30, 20)) for _ in range(2)]
    small = view_of(100.0, (slice(0, 20), slice(0, 30)), 0.5)
    large = view_of(200.0, (slice(0, 10), slice(5, 15)), 2.0, unknown=(3, 2))
    middle = view_of(50.0, (slice(5, 15), slice(0, 30)), 1.0)
    expected = np.full((20, 30), 100.0)
    expected[5:15] = 50.0
    expected[:10, 5:15] = 200.0
    # What the largest does not know is the next one's.
    expected[3, 7] = 100.0
    for order in ((small, middle, large), (large, small, middle)):
        first, second = painted_walls(order, walls)  # type: ignore[arg-type]
        assert first[0].intensity is not None
        np.testing.assert_allclose(first[0].intensity, expected / 255.0, atol=1e-6)
        assert first[1] is not None
        assert second[1] is None
        assert second[0].intensity is not None
        assert np.isnan(second[0].intensity).all()


def ties(n: int, seed: int = 1) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    rng = np.random.default_rng(seed)
    points = rng.uniform([0.2, -0.3, 0.2], [2.8, 0.1, 1.8], (6 * n, 3))
    pixels = VIEW.project(points)[:, :2]
    inside = np.flatnonzero(VIEW.sees(pixels))[:n]
    return pixels[inside], points[inside]


def lens() -> ViewingCamera:
    """The lens of the view, its pose forgotten."""
    return replace(VIEW, rotation=np.eye(3), translation=np.zeros(3))


@pytest.mark.parametrize("shift_m", [np.zeros(3), SURVEY_SHIFT_M], ids=["near", "survey"])
@pytest.mark.parametrize("wrong_share", [0.0, 0.4])
def test_the_pose_is_the_one_that_most_points_agree_with(
    wrong_share: float, shift_m: NDArray[np.float64]
) -> None:
    pixels, points = ties(80)
    n_wrong = round(wrong_share * len(pixels))
    wrong = pixels.copy()
    wrong[:n_wrong] = np.random.default_rng(5).uniform([0, 0], [900, 640], (n_wrong, 2))
    found = pose_of_most(wrong, points + shift_m, lens(), 2.0)
    assert found is not None
    np.testing.assert_allclose(found.centre_world, VIEW.centre_world + shift_m, atol=2e-3)
    np.testing.assert_allclose(found.project(points + shift_m)[:, :2], pixels, atol=0.5)
    assert (found.fx, found.cx) == (VIEW.fx, VIEW.cx)


@pytest.mark.parametrize(("n_right", "is_found"), [(23, False), (24, True)])
def test_two_dozen_points_must_agree_with_apose_of_most(n_right: int, is_found: bool) -> None:
    pixels, points = ties(40)
    pixels[n_right:] = np.random.default_rng(6).uniform([0, 0], [900, 640], (40 - n_right, 2))
    assert (pose_of_most(pixels, points, lens(), 0.5) is not None) == is_found
