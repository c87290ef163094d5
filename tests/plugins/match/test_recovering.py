"""Photos found by what others show: whose lens they have, which of them paints, and which pose."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.match.tracing import (
    lens_of,
    painted_walls,
    pose_of_most,
)

from orthoflow.testing import photographed as ms
from tests import samples
from tests.scenes import SURVEY_SHIFT_M
from tests.tied_photos import SCENE, photo, seen_by

VIEW = ms.camera_before(SCENE)


OLD = {"old.png": ms.oriented(replace(VIEW, fx=1000.0, fy=1000.0), name="old.png")}


@pytest.mark.parametrize(
    ("exif_px", "is_known"),
    [(None, True), (1000.0, True), (920.0, True), (1100.0, True), (905.0, False), (1120.0, False)],
)
def test_a_lens_is_taken_from_a_photo_of_the_same_size_and_nearly_the_same_focal_length(
    exif_px: float | None, is_known: bool
) -> None:
    found = lens_of(photo(name="new.png", exif_focal_px=exif_px), OLD, ms.photos())
    assert (found is not None) == is_known
    if found is not None:
        assert found.fx == 1000.0


def test_a_lens_that_contradicts_exif_is_that_of_photos_with_the_same_exif() -> None:
    old, new = (photo(name=name, exif_focal_px=500.0) for name in ("old.png", "new.png"))
    found = lens_of(new, OLD, ms.photos(old, new))
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


# The lens of the view, its pose forgotten.
LENS = replace(VIEW, rotation=np.eye(3), translation=np.zeros(3))


def test_the_pose_is_the_one_that_most_points_agree_with() -> None:
    seen = seen_by(VIEW, 80)
    points, wrong = seen.points_world + SURVEY_SHIFT_M, seen.pixels_photo.copy()
    wrong[:32] = np.random.default_rng(5).uniform([0, 0], [900, 640], (32, 2))
    found = pose_of_most(wrong, points, LENS, 2.0)
    assert found is not None
    np.testing.assert_allclose(found.centre_world, VIEW.centre_world + SURVEY_SHIFT_M, atol=2e-3)
    np.testing.assert_allclose(found.project(points)[:, :2], seen.pixels_photo, atol=0.5)
    assert (found.fx, found.cx) == (VIEW.fx, VIEW.cx)


@pytest.mark.parametrize(("n_right", "is_found"), [(23, False), (24, True)])
def test_two_dozen_points_must_agree_with_a_pose(n_right: int, is_found: bool) -> None:
    seen = seen_by(VIEW, 40)
    pixels = seen.pixels_photo.copy()
    pixels[n_right:] = np.random.default_rng(6).uniform([0, 0], [900, 640], (40 - n_right, 2))
    assert (pose_of_most(pixels, seen.points_world, LENS, 0.5) is not None) == is_found
