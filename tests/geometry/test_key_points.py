"""Key points, spread over their cells, and pairs of descriptors: as by looking at every pair."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from orthoflow.geometry.key_points import (
    Window,
    best_matches,
    find_features,
    in_turns,
    mutual_matches,
    mutual_matches_within,
    root_sift,
    two_nearest,
)
from orthoflow.testing.photographed import textured_wall, walls_of


def test_cells_take_turns_and_their_strongest_come_first() -> None:
    cell = np.array([7, 7, 7, 2, 2, 5])
    strength = np.array([9.0, 8.0, 7.0, 1.0, 3.0, 2.0])
    taken = in_turns(cell, (-strength,), 6)
    # First turn: the best of each cell, by strength; then the second best; then the third.
    assert taken.tolist() == [0, 4, 5, 1, 3, 2]
    assert in_turns(cell, (-strength,), 2).tolist() == [0, 4]


def test_what_is_taken_does_not_hang_on_the_order_given() -> None:
    rng = np.random.default_rng(0)
    cell, strength = rng.integers(0, 12, 300), rng.integers(0, 5, 300).astype(float)
    place = rng.permutation(300)
    taken = in_turns(cell, (place, -strength), 90)
    shuffled = rng.permutation(300)
    again = in_turns(cell[shuffled], (place[shuffled], -strength[shuffled]), 90)
    np.testing.assert_array_equal(shuffled[again], taken)


def test_nothing_gives_nothing() -> None:
    assert in_turns(np.empty(0, np.intp), (np.empty(0),), 5).size == 0


def test_descriptors_are_whole_and_of_one_length() -> None:
    raw = np.random.default_rng(0).integers(0, 256, (50, 128)).astype(np.float32)
    rooted = root_sift(raw)
    np.testing.assert_array_equal(rooted, np.rint(rooted))
    # 128 entries, each rounded by at most a half: the sum of squares is 512^2 up to that.
    np.testing.assert_allclose(np.linalg.norm(rooted, axis=1), 512.0, atol=0.5 * np.sqrt(128.0))
    assert not root_sift(np.zeros((1, 128), np.float32)).any()


def blobs() -> np.ndarray:
    """Bright discs on black, 40 px apart."""
    rows, cols = np.mgrid[:120, :160] + 0.5
    away = np.hypot((rows % 40) - 20.0, (cols % 40) - 20.0)
    return np.rint(255.0 * np.exp(-0.5 * (away / 3.0) ** 2)).astype(np.uint8)


def test_key_points_lie_only_where_they_may() -> None:
    usable = np.zeros((120, 160), dtype=np.bool_)
    usable[:, :80] = True
    found = find_features(blobs(), 200, usable)
    everywhere = find_features(blobs(), 200)
    assert 0 < len(found) < len(everywhere)
    assert (found.pixels[:, 0] < 80.0).all()


@pytest.mark.parametrize(("side", "n_found"), [(15, 0), (16, 1)])
def test_pictures_of_fifteen_pixels_have_no_key_points(side: int, n_found: int) -> None:
    rows, cols = np.mgrid[:side, :side] + 0.5
    away = np.hypot(rows - 8.0, cols - 8.0)
    disc = np.rint(255.0 * np.exp(-0.5 * (away / 1.5) ** 2)).astype(np.uint8)
    found = find_features(disc, 200)
    assert (len(found) > 0) == bool(n_found)
    assert found.descriptors.shape == (len(found), 128)


def descriptors(count: int, seed: int, *, size: int = 32) -> NDArray[np.float32]:
    rng = np.random.default_rng(seed)
    return rng.integers(0, 256, (count, size)).astype(np.float32)


def test_of_one_only_there_is_no_second() -> None:
    found = two_nearest(descriptors(3, 1), descriptors(1, 2))
    assert found.index.tolist() == [0, 0, 0]
    assert np.isinf(found.next_best).all()


@pytest.mark.parametrize("in_window", [True, False])
def test_matches_are_those_of_brute_force(*, in_window: bool) -> None:
    rng = np.random.default_rng(0)
    first = rng.integers(0, 80, (600, 128)).astype(np.float32)
    second = (first[:500] + rng.integers(-9, 10, (500, 128))).astype(np.float32)
    # Of two that are the same, neither is distinct; of two with the same nearest, one is mutual.
    second[7] = second[31] = first[31]
    first[599] = first[99] + 1.0
    places = [rng.uniform(0.0, 100.0, (n, 2)).astype(np.float32) for n in (600, 500)]
    sizes = [rng.normal(size=n).astype(np.float32) for n in (600, 500)]
    angles = [rng.uniform(0.0, 360.0, n).astype(np.float32) for n in (600, 500)]
    window = Window(
        first=places[0],
        second=places[1],
        radius=30.0,
        first_log_size=sizes[0],
        second_log_size=sizes[1],
        first_angle_deg=angles[0],
        second_angle_deg=angles[1],
        max_log_size=0.7,
        max_angle_deg=90.0,
    )
    distance = cdist(first.astype(np.float64), second.astype(np.float64))
    turn = np.abs(angles[0][:, None] - angles[1]) % 360.0
    is_outside = np.abs(places[0][:, None] - places[1]).max(axis=2) > 30.0
    is_outside |= np.abs(sizes[0][:, None] - sizes[1]) > 0.7
    is_outside |= np.minimum(turn, 360.0 - turn) > 90.0
    if in_window:
        found = mutual_matches_within(first, second, window, ratio=0.95)
        distance[is_outside] = np.inf
    else:
        found = mutual_matches(first, second, ratio=0.95)
    ordered = np.sort(distance, axis=1)
    nearest = distance.argmin(axis=1)
    mutual = distance.argmin(axis=0)[nearest] == np.arange(len(first))
    # One that has no rival is distinct from nothing.
    ratio = np.full(len(first), np.inf)
    rivals = np.isfinite(ordered[:, 1]) & (ordered[:, 1] > 0.0)
    ratio[rivals] = ordered[rivals, 0] / ordered[rivals, 1]
    expected = np.flatnonzero(mutual & (ratio <= 0.95))
    assert len(expected) > 10
    np.testing.assert_array_equal(found.first, expected)
    np.testing.assert_array_equal(found.second, nearest[expected])
    np.testing.assert_allclose(found.ratio, ratio[expected], atol=1e-5)
    if not in_window:
        one_way = best_matches(first, second, ratio=0.95)
        np.testing.assert_array_equal(one_way.first, np.flatnonzero(ratio <= 0.95))
        assert len(one_way) > len(expected)
        assert len(mutual_matches(first[:0], second, ratio=0.8)) == 0


@pytest.mark.parametrize("as_opencv", [False, True], ids=["precise", "as OpenCV sets it"])
def test_key_points_lie_where_they_are(*, as_opencv: bool) -> None:
    places = np.array([(u, v) for u in np.linspace(30.3, 370.7, 7) for v in (40.1, 200.6, 360.4)])
    columns, rows = np.meshgrid(np.arange(400) + 0.5, np.arange(400) + 0.5)
    picture = np.full((400, 400), 60.0)
    for u, v in places:
        picture += 120.0 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / (2.0 * 4.0**2))
    grey = np.rint(picture).astype(np.uint8)
    found = find_features(grey, 3000, as_opencv=as_opencv).pixels
    nearest = found[np.linalg.norm(found[None] - places[:, None], axis=2).argmin(axis=1)]
    # OpenCV's default puts them a quarter of a pixel too far to the right and down.
    np.testing.assert_allclose(np.median(nearest - places, axis=0), 0.0, atol=0.03)


def test_the_key_points_that_are_kept_are_described_as_if_all_were() -> None:
    rgb = walls_of(textured_wall(1)).walls[0].rgb
    assert rgb is not None
    grey = np.tile(rgb[:200, :, 0], (1, 5))
    every, few = (find_features(grey, n) for n in (10**6, 100))
    assert len(few) == 100 < len(every) / 10
    # Some lie in the second tile.
    assert (few.pixels[:, 0] > 2048).any()
    for name in ("pixels", "sizes_px", "angles_deg", "descriptors"):
        np.testing.assert_array_equal(getattr(few, name), getattr(every, name)[:100])
