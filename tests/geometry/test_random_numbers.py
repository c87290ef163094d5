"""Numbers hashed from places: known answers, fair distributions, no order."""

from __future__ import annotations

import numpy as np
import pytest

from orthoflow.geometry.scenes import cell_states, mixed_bits, normals, uniforms

GOLDEN = 0x9E3779B97F4A7C15


def test_scrambling_is_that_of_splitmix64() -> None:
    # The first outputs of Vigna's splitmix64.c seeded with 0.
    states = np.array([GOLDEN, 2 * GOLDEN % 2**64, 3 * GOLDEN % 2**64], dtype=np.uint64)
    expected = [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F]
    np.testing.assert_array_equal(mixed_bits(states), np.array(expected, dtype=np.uint64))


def test_draws_of_a_state_are_the_numbers_of_splitmix64_from_there() -> None:
    bits = (0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F)
    # Of the state itself, and of one that is a number further.
    states = np.array([0, GOLDEN], dtype=np.uint64)
    for draw in (0, 1):
        expected = [(number >> 11) / 2.0**53 for number in bits[draw : draw + 2]]
        np.testing.assert_array_equal(uniforms(states, draw), expected)


def test_a_place_has_its_number_whatever_is_asked_with_it() -> None:
    columns, rows = np.arange(-40, 60), np.arange(1000, 1070)
    whole = uniforms(cell_states(columns[:, None], rows, 7), 3)
    part = uniforms(cell_states(columns[10:12, None], rows[::-5], 7), 3)
    np.testing.assert_array_equal(part, whole[10:12, ::-5])
    assert np.mean(whole == uniforms(cell_states(columns[:, None], rows, 8), 3)) < 1e-3


@pytest.mark.parametrize("seed", [0, 1, 2**62, -5])
def test_numbers_are_fairly_distributed_and_draws_independent(seed: int) -> None:
    states = cell_states(np.arange(400)[:, None], np.arange(500), seed).ravel()
    n = states.size
    even = uniforms(states, 0)
    assert even.min() >= 0.0
    assert even.max() < 1.0
    counts = np.bincount((even * 20).astype(int), minlength=20)
    # Five standard deviations of a count.
    np.testing.assert_allclose(counts, n / 20, atol=5.0 * np.sqrt(n / 20))
    bell = normals(states, 10)
    assert bell.mean() == pytest.approx(0.0, abs=5.0 / np.sqrt(n))
    assert bell.std() == pytest.approx(1.0, abs=5.0 / np.sqrt(2.0 * n))
    assert np.mean(np.abs(bell) > 2.0) == pytest.approx(0.0455, abs=5.0 * np.sqrt(0.0455 / n))
    together = np.corrcoef([even, bell, normals(states, 12), np.roll(bell, 1)])
    np.testing.assert_allclose(together, np.eye(4), atol=5.0 / np.sqrt(n))
