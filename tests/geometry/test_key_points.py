"""Key points, spread over their cells, and pairs of descriptors: as by looking at every pair."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.geometry.key_points import (
    Matches,
    Window,
    best_matches,
    find_features,
    in_turns,
    mutual_matches,
    mutual_matches_within,
    root_sift,
    two_nearest,
)


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


def paired(matches: Matches) -> list[tuple[int, int]]:
    return sorted(zip(matches.first.tolist(), matches.second.tolist(), strict=True))


def test_pairs_are_each_other_s_nearest_and_distinct() -> None:
    second = descriptors(50, 6)
    first = second[[4, 4, 9, 30]].copy()
    first[1, :4] += 40.0  # further from 4 than the first is
    first[3] = np.rint(0.5 * (second[30] + second[31]))  # as near to 31 as to 30
    found = mutual_matches(first, second, ratio=0.8)
    assert paired(found) == [(0, 4), (2, 9)]
    assert found.ratio.tolist() == [0.0, 0.0]
    # In one direction alone the second of the two is paired, too.
    assert paired(best_matches(first, second, ratio=0.8)) == [(0, 4), (1, 4), (2, 9)]
    assert len(best_matches(first, second, ratio=1.0)) == 4
    assert len(mutual_matches(first[:0], second, ratio=0.8)) == 0


def window(
    first_at: list[list[float]], second_at: list[list[float]], **more: list[float]
) -> Window:
    def of(name: str, count: int) -> NDArray[np.float32]:
        return np.array(more.get(name, [0.0] * count), dtype=np.float32)

    return Window(
        first=np.array(first_at, dtype=np.float32),
        second=np.array(second_at, dtype=np.float32),
        radius=10.0,
        first_log_size=of("first_log_size", len(first_at)),
        second_log_size=of("second_log_size", len(second_at)),
        first_angle_deg=of("first_angle_deg", len(first_at)),
        second_angle_deg=of("second_angle_deg", len(second_at)),
        max_log_size=0.5,
        max_angle_deg=20.0,
    )


def test_a_window_knows_places_sizes_and_turns_across_north() -> None:
    near = window([[0.0, 0.0]], [[9.0, -9.0], [11.0, 0.0], [0.0, 0.0], [0.0, 0.0], [1.0, 1.0]],
        second_log_size=[0.4, 0.0, 0.6, 0.0, 0.0],
        first_angle_deg=[355.0],
        second_angle_deg=[10.0, 0.0, 0.0, 20.0, 340.0],
    )  # fmt: skip
    i, j = near.pairs()
    assert sorted(zip(i.tolist(), j.tolist(), strict=True)) == [(0, 0), (0, 4)]


def test_within_a_window_what_lies_outside_is_not_even_second_best() -> None:
    second = descriptors(4, 7)
    # Like the first of the second set, and as like the second, which is far away.
    first = np.rint(0.5 * (second[:1] + second[1:2])) + np.float32(2.0) * np.sign(
        second[:1] - second[1:2]
    )
    outside = window([[0.0, 0.0]], [[1.0, 1.0], [50.0, 0.0], [-1.0, 2.0], [60.0, 60.0]])
    found = mutual_matches_within(first, second, outside, ratio=0.9)
    assert paired(found) == [(0, 0)]
    inside = window([[0.0, 0.0]], [[1.0, 1.0], [5.0, 0.0], [-1.0, 2.0], [60.0, 60.0]])
    assert paired(mutual_matches_within(first, second, inside, ratio=0.9)) == []
    # The only candidate is distinct from nothing.
    alone = window([[0.0, 0.0]], [[1.0, 1.0], [50.0, 0.0], [50.0, 2.0], [60.0, 60.0]])
    assert paired(mutual_matches_within(first, second, alone, ratio=0.9)) == []
    assert paired(mutual_matches_within(first, second, alone, ratio=1.0)) == [(0, 0)]


def test_of_two_that_are_the_same_none_is_distinct() -> None:
    second = descriptors(50, 8)
    second[7] = second[31]
    first = second[[7, 12]].copy()
    assert paired(mutual_matches(first, second, ratio=0.9)) == [(1, 12)]
    assert paired(best_matches(first, second, ratio=0.9)) == [(1, 12)]
