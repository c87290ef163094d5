"""Key points: spread over their cells, and descriptors whose products are exact."""

from __future__ import annotations

import numpy as np
import pytest

from orthoflow.geometry.key_points import in_turns, root_sift
from tests.long_loops import seeds


def test_cells_take_turns_and_their_strongest_come_first() -> None:
    cell = np.array([7, 7, 7, 2, 2, 5])
    strength = np.array([9.0, 8.0, 7.0, 1.0, 3.0, 2.0])
    taken = in_turns(cell, (-strength,), 6)
    # First turn: the best of each cell, by strength; then the second best; then the third.
    assert taken.tolist() == [0, 4, 5, 1, 3, 2]
    assert in_turns(cell, (-strength,), 2).tolist() == [0, 4]


@pytest.mark.parametrize("seed", seeds(4))
def test_what_is_taken_does_not_hang_on_the_order_given(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cell, strength = rng.integers(0, 12, 300), rng.integers(0, 5, 300).astype(float)
    place = rng.permutation(300)
    taken = in_turns(cell, (place, -strength), 90)
    shuffled = rng.permutation(300)
    again = in_turns(cell[shuffled], (place[shuffled], -strength[shuffled]), 90)
    np.testing.assert_array_equal(shuffled[again], taken)


def test_nothing_gives_nothing() -> None:
    assert in_turns(np.empty(0, np.intp), (np.empty(0),), 5).size == 0


@pytest.mark.parametrize("seed", seeds(3))
def test_descriptors_are_whole_and_of_one_length(seed: int) -> None:
    raw = np.random.default_rng(seed).integers(0, 256, (50, 128)).astype(np.float32)
    rooted = root_sift(raw)
    np.testing.assert_array_equal(rooted, np.rint(rooted))
    # 128 entries, each rounded by at most a half: the sum of squares is 512^2 up to that.
    np.testing.assert_allclose(np.linalg.norm(rooted, axis=1), 512.0, atol=0.5 * np.sqrt(128.0))
    assert not root_sift(np.zeros((1, 128), np.float32)).any()
