"""Ties between photos of points whose places are known, and what does not belong to any."""

from __future__ import annotations

import itertools
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.orient import photo_ties
from orthoflow_plugins.orient.photo_ties import (
    PhotoTies,
    overlapping_pairs,
    photo_features,
    tie_photos,
)

from orthoflow.files.images import encode_png
from orthoflow.geometry.cameras import ViewingCamera, looking_at
from orthoflow.geometry.key_points import Features
from orthoflow.products import Photo
from tests import samples


def camera(*centre: float) -> ViewingCamera:
    where = np.array(centre)
    rotation = looking_at(where, np.array([0.2, 5.0, 0.3]), samples.UP)
    return samples.camera(
        rotation, where, width=1000, height=800, fx=900.0, fy=900.0, cx=500.0, cy=400.0
    )


CENTRES = ((-1.0, 0.0, 0.0), (1.0, 0.3, 0.2), (0.2, -0.4, 0.9), (0.1, 0.2, -0.8))
CAMERAS = [camera(*centre) for centre in CENTRES]
PAIRS = list(itertools.combinations(range(4), 2))


def described(count: int, seed: int = 0) -> NDArray[np.float32]:
    """Descriptors (n, 128), each far from all others."""
    return np.random.default_rng(seed).integers(0, 60, (count, 128)).astype(np.float32)


def features(pixels: NDArray[np.float64], descriptors: NDArray[np.float32]) -> Features:
    n = len(pixels)
    return Features(
        pixels=pixels, sizes_px=np.ones(n), angles_deg=np.zeros(n), descriptors=descriptors
    )


def scene_points(count: int = 30) -> NDArray[np.float64]:
    return np.random.default_rng(2).uniform((-1.0, 4.0, -0.8), (1.2, 6.0, 1.2), (count, 3))


def seen_in(
    points: NDArray[np.float64], moved: dict[tuple[int, int], tuple[float, float]] | None = None
) -> list[Features]:
    """Key points of all points in all photos, in an order of its own in each; some moved."""
    found = []
    for photo, view in enumerate(CAMERAS):
        pixels = view.project(points)[:, :2]
        for (of, point), by in (moved or {}).items():
            if of == photo:
                pixels[point] += by
        order = np.random.default_rng(photo).permutation(len(points))
        found.append(features(pixels[order], described(len(points))[order]))
    return found


def observed(ties: PhotoTies, points: NDArray[np.float64]) -> list[list[int]]:
    """Which photos see each tied point, by the point's number in the scene."""
    found: list[list[int]] = [[] for _ in points]
    for photo, point in zip(ties.photo, ties.point, strict=True):
        apart = np.linalg.norm(points - ties.points_world[point], axis=1)
        found[int(apart.argmin())].append(int(photo))
    return [sorted(photos) for photos in found]


def test_points_are_tied_in_all_photos_that_see_them_where_they_are() -> None:
    points = scene_points()
    ties = tie_photos(CAMERAS, seen_in(points), PAIRS, 1000)
    assert observed(ties, points) == [[0, 1, 2, 3]] * 30
    apart = np.linalg.norm(points[:, None] - ties.points_world[None], axis=2).min(axis=0)
    np.testing.assert_allclose(apart, 0.0, atol=1e-7)
    for photo, point, pixel in zip(ties.photo, ties.point, ties.pixels, strict=True):
        expected = CAMERAS[photo].project(ties.points_world[point][None])[0, :2]
        np.testing.assert_allclose(pixel, expected, atol=1e-5)
    # Key points of photos of 1000 px are found at full size, those of larger ones at 1600 px.
    assert set(ties.scale) == {1.0}
    large = [replace(view, width=3200, height=2560) for view in CAMERAS]
    assert set(tie_photos(large, seen_in(points), PAIRS, 1000).scale) == {2.0}


def test_of_many_points_those_that_most_photos_see_are_kept() -> None:
    points = scene_points()
    known_to = seen_in(points)
    # The last two photos know the first ten points alone.
    for photo in (2, 3):
        order = np.random.default_rng(photo).permutation(30)
        known_to[photo] = known_to[photo].take(order < 10)
    ties = tie_photos(CAMERAS, known_to, PAIRS, 12)
    seen = observed(ties, points)
    assert seen[:10] == [[0, 1, 2, 3]] * 10
    assert sum(photos == [0, 1] for photos in seen[10:]) == 2


def across_line(point: NDArray[np.float64]) -> NDArray[np.float64]:
    """Direction in the second photo square to the picture of a point's ray from the first."""
    first, second = CAMERAS[0], CAMERAS[1]
    beyond = first.centre_world + 1.1 * (point - first.centre_world)
    along = np.diff(second.project(np.array([point, beyond]))[:, :2], axis=0)[0]
    return np.array([-along[1], along[0]]) / np.linalg.norm(along)


@pytest.mark.parametrize(("off_px", "is_tied"), [(5.6, True), (6.4, False)])
def test_matches_more_than_six_pixels_off_the_line_are_none(off_px: float, is_tied: bool) -> None:
    points = scene_points()
    way = tuple(off_px * across_line(points[4]))
    ties = tie_photos(CAMERAS[:2], seen_in(points, {(1, 4): way})[:2], [(0, 1)], 1000)
    assert len(ties.points_world) == (30 if is_tied else 29)


@pytest.mark.parametrize(("off_px", "is_tied"), [(20.0, True), (22.0, False)])
def test_rays_that_miss_their_point_by_eight_pixels_do_not_meet(
    off_px: float, is_tied: bool
) -> None:
    # Along the line of the first photo, which does not see it; the other two do.
    points = scene_points()
    across = across_line(points[4])
    way = (off_px * across[1], -off_px * across[0])
    ties = tie_photos(CAMERAS[:3], seen_in(points, {(1, 4): way})[:3], [(0, 1), (0, 2)], 1000)
    worst = [
        np.linalg.norm(CAMERAS[photo].project(ties.points_world[point][None])[0, :2] - pixel)
        for photo, point, pixel in zip(ties.photo, ties.point, ties.pixels, strict=True)
    ]
    assert max(worst) <= 8.0
    assert (len(ties.points_world) == 30) == is_tied


@pytest.mark.parametrize(("angle_deg", "is_tied"), [(1.9, False), (2.1, True)])
def test_rays_must_meet_at_two_degrees(angle_deg: float, is_tied: bool) -> None:
    half = 5.0 * np.tan(np.radians(0.5 * angle_deg))
    views = [camera(0.2 - half, 0.0, 0.3), camera(0.2 + half, 0.0, 0.3)]
    points = np.array([[0.2, 5.0, 0.3], [0.2, 5.0, 0.3]])
    found = [features(view.project(points)[:, :2], described(2)) for view in views]
    ties = tie_photos(views, found, [(0, 1)], 10)
    assert len(ties.points_world) == (2 if is_tied else 0)


@pytest.mark.parametrize(("share", "is_pair"), [(0.35, True), (0.45, False)])
def test_pairs_show_enough_of_each_others_walls(share: float, is_pair: bool) -> None:
    # The second sees four of the ten points of the first, the first all of the second's.
    points = np.tile([0.2, 5.0, 0.3], (10, 1))
    behind = points.copy()
    behind[:6, 1] = -500.0
    views = [camera(-1.0, 0.0, 0.0), camera(1.0, 0.0, 0.0)]
    assert overlapping_pairs(views, [behind, points], share) == ([(0, 1)] if is_pair else [])
    assert overlapping_pairs(views, [points, behind], share) == ([(0, 1)] if is_pair else [])
    assert overlapping_pairs(views, [points[:0], points], share) == []


def disc_photo(width: int, height: int, radius: float) -> tuple[Photo, NDArray[np.float64]]:
    """Bright discs on grey; their centres, first pixel centre at (0.5, 0.5)."""
    centres = np.array([[0.2, 0.5], [0.45, 0.4], [0.7, 0.6]]) * (width, height)
    rows, columns = np.mgrid[:height, :width] + 0.5
    grey = np.full((height, width), 90.0)
    for column, row in centres:
        grey += 120.0 * (np.hypot(columns - column, rows - row) < radius)
    soft = cv2.GaussianBlur(grey, (0, 0), 2.0).astype(np.uint8)
    photo = Photo(name="a.png", encoded=encode_png(soft), width=width, height=height)
    return photo, centres


def test_key_points_are_in_pixels_of_the_photo_when_it_was_reduced() -> None:
    photo, centres = disc_photo(2400, 150, 18.0)
    found = photo_features(photo, 100)
    for centre in centres:
        assert np.linalg.norm(found.pixels - centre, axis=1).min() < 0.5
    assert found.descriptors.shape == (len(found.pixels), 128)
    few = photo_features(photo, 3)
    assert len(few.pixels) == 3
    # One of each part of the photo, before a second of any.
    assert np.linalg.norm(few.pixels[:, None] - centres[None], axis=2).min(axis=0).max() < 20.0


def test_points_behind_a_camera_are_none() -> None:
    """Rays that come together meet before both photos, rays that go apart behind them."""
    views = [camera(-1.0, 0.0, 0.0), camera(1.0, 0.0, 0.0)]
    for inwards, n_points in ((0.3, 2), (-0.3, 0)):
        found = []
        for view, aside in zip(views, (inwards, -inwards), strict=True):
            ways = np.array([[aside, 1.0, 0.05], [aside, 1.0, 0.1]])
            pixels = view.project(view.centre_world + 5.0 * ways)[:, :2]
            found.append(features(pixels, described(2)))
        assert len(tie_photos(views, found, [(0, 1)], 10).points_world) == n_points


def test_a_track_with_two_points_of_one_photo_is_none() -> None:
    starts = np.array([0, 10, 20, 30])
    links = np.array([[0, 10], [10, 20], [1, 11], [11, 21], [21, 2], [3, 22]])
    found = [track.tolist() for track in photo_ties._tracks(links, starts)]
    assert found == [[0, 10, 20], [3, 22]]
    assert photo_ties._tracks(np.empty((0, 2), dtype=np.intp), starts) == []
