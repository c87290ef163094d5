"""Descriptors that are each other's nearest: by matrix products as by looking at every pair."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.match import descriptors as lists
from orthoflow_plugins.match.descriptors import (
    Matches,
    TwoNearest,
    Window,
    best_matches,
    mutual_matches,
    mutual_matches_within,
    nearest,
    two_nearest,
    two_nearest_roughly,
)


def descriptors(count: int, seed: int, *, size: int = 32) -> NDArray[np.float32]:
    rng = np.random.default_rng(seed)
    return rng.integers(0, 256, (count, size)).astype(np.float32)


def all_pairs(asked: NDArray[np.float32], among: NDArray[np.float32]) -> TwoNearest:
    apart = ((asked[:, None].astype(np.float64) - among[None]) ** 2).sum(axis=2)
    order = np.argsort(apart, axis=1, kind="stable")
    rows = np.arange(len(asked))
    return TwoNearest(
        index=order[:, 0],
        best=apart[rows, order[:, 0]].astype(np.float32),
        next_best=apart[rows, order[:, 1]].astype(np.float32),
    )


def same(found: TwoNearest, expected: TwoNearest) -> None:
    np.testing.assert_array_equal(found.index, expected.index)
    np.testing.assert_array_equal(found.best, expected.best)
    np.testing.assert_array_equal(found.next_best, expected.next_best)


def test_the_two_nearest_are_those_of_all_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    asked, among = descriptors(40, 1), descriptors(60, 2)
    expected = all_pairs(asked, among)
    same(two_nearest(asked, among), expected)
    np.testing.assert_array_equal(nearest(asked, among), expected.index)
    # However few rows are searched at once.
    monkeypatch.setattr("orthoflow_plugins.match.descriptors._BLOCK_ENTRIES", 7 * 60)
    same(two_nearest(asked, among), expected)
    np.testing.assert_array_equal(nearest(asked, among), expected.index)


def test_of_one_only_there_is_no_second() -> None:
    found = two_nearest(descriptors(3, 1), descriptors(1, 2))
    assert found.index.tolist() == [0, 0, 0]
    assert np.isinf(found.next_best).all()


def test_small_sets_are_searched_whole() -> None:
    asked, among = descriptors(40, 1), descriptors(600, 2)
    same(two_nearest_roughly(asked, among), all_pairs(asked, among))


def test_in_large_sets_what_is_alike_is_found_and_nothing_is_nearer_than_it_is() -> None:
    among = descriptors(4000, 3)
    noise = np.random.default_rng(4).integers(-6, 7, (300, among.shape[1]))
    chosen = np.random.default_rng(5).permutation(4000)[:300]
    asked = (among[chosen] + noise).astype(np.float32)
    found, exact = two_nearest_roughly(asked, among), two_nearest(asked, among)
    np.testing.assert_array_equal(exact.index, chosen)
    is_found = found.index == chosen
    assert is_found.mean() > 0.95
    np.testing.assert_array_equal(found.best[is_found], exact.best[is_found])
    assert (found.best >= exact.best).all()
    assert (found.next_best >= exact.next_best).all()


def paired(matches: Matches) -> list[tuple[int, int]]:
    return sorted(zip(matches.first.tolist(), matches.second.tolist(), strict=True))


@pytest.mark.parametrize("is_exact", [True, False])
def test_pairs_are_each_other_s_nearest_and_distinct(is_exact: bool) -> None:
    second = descriptors(50, 6)
    first = second[[4, 4, 9, 30]].copy()
    first[1, :4] += 40.0  # further from 4 than the first is
    first[3] = np.rint(0.5 * (second[30] + second[31]))  # as near to 31 as to 30
    found = mutual_matches(first, second, ratio_most=0.8, is_exact=is_exact)
    assert paired(found) == [(0, 4), (2, 9)]
    assert found.ratio.tolist() == [0.0, 0.0]
    # In one direction alone the second of the two is paired, too.
    assert paired(best_matches(first, second, ratio_most=0.8)) == [(0, 4), (1, 4), (2, 9)]
    assert len(best_matches(first, second, ratio_most=1.0)) == 4
    assert len(mutual_matches(first[:0], second, ratio_most=0.8, is_exact=is_exact)) == 0


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
        log_size_most=0.5,
        angle_most_deg=20.0,
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
    found = mutual_matches_within(first, second, outside, ratio_most=0.9)
    assert paired(found) == [(0, 0)]
    inside = window([[0.0, 0.0]], [[1.0, 1.0], [5.0, 0.0], [-1.0, 2.0], [60.0, 60.0]])
    assert paired(mutual_matches_within(first, second, inside, ratio_most=0.9)) == []
    # The only candidate is distinct from nothing.
    alone = window([[0.0, 0.0]], [[1.0, 1.0], [50.0, 0.0], [50.0, 2.0], [60.0, 60.0]])
    assert paired(mutual_matches_within(first, second, alone, ratio_most=0.9)) == []
    assert paired(mutual_matches_within(first, second, alone, ratio_most=1.0)) == [(0, 0)]


@pytest.mark.parametrize("is_exact", [True, False])
def test_of_two_that_are_the_same_none_is_distinct(is_exact: bool) -> None:
    second = descriptors(50, 8)
    second[7] = second[31]
    first = second[[7, 12]].copy()
    assert paired(mutual_matches(first, second, ratio_most=0.9, is_exact=is_exact)) == [(1, 12)]
    assert paired(best_matches(first, second, ratio_most=0.9)) == [(1, 12)]


def test_lists_are_about_the_means_of_what_is_nearest_to_members_spread_over_the_set() -> None:
    among = descriptors(90, 9, size=8)
    among[1] = among[0]
    chosen = among[[0, 12, 25, 38, 51, 64, 77]]
    apart = np.linalg.norm(among[:, None] - chosen[None], axis=2)
    expected = np.array([among[apart.argmin(axis=1) == k].mean(axis=0) for k in range(7)])
    found = lists._middles(among, 7)
    np.testing.assert_array_equal(found, np.rint(expected))
