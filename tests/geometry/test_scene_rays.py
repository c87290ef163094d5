"""Trees of boxes over rectangles: split where rays have the least to do, along the best axes."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.geometry import scene_rays
from orthoflow.geometry.scene_rays import Hits, points_on
from tests.long_loops import seeds


def surface(low: NDArray[np.float64], high: NDArray[np.float64]) -> float:
    """Half the surface of the box about some boxes."""
    sides = high.max(axis=0) - low.min(axis=0)
    return float(sum(a * b for a, b in itertools.combinations(sides, 2)))


def tree_of(low: NDArray[np.float64], high: NDArray[np.float64]) -> scene_rays._BoxTree:
    tree = scene_rays._BoxTree.__new__(scene_rays._BoxTree)
    tree.boxes, tree.links, tree.order = [], [], []
    tree._low, tree._high = low, high
    return tree


@pytest.mark.parametrize("seed", seeds(12))
@pytest.mark.parametrize("n", [2, 3, 7])
def test_boxes_are_split_where_rays_have_the_least_to_do(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    low = rng.uniform(0.0, (seed % 4 + 1.0) ** 2, (n, 3))
    high = low + rng.uniform(0.1, 3.0, (n, 3))
    # Goldsmith and Salmon: rays come by as often as the surface of a box is large.
    whole = surface(low, high)
    costs = {}
    for axis in range(3):
        order = np.argsort(low[:, axis] + high[:, axis])
        for count in range(1, n):
            first, second = order[:count], order[count:]
            costs[frozenset(first.tolist())] = (
                whole
                + count * surface(low[first], high[first])
                + (n - count) * surface(low[second], high[second])
            )
    half = tree_of(low, high)._cheapest_half(np.arange(n))
    least = min(costs.values())
    if half is None:
        assert least >= n * whole
    else:
        assert costs[frozenset(np.flatnonzero(half).tolist())] == pytest.approx(least)
        assert least < n * whole


def test_a_leaf_has_what_is_not_worth_a_split() -> None:
    # Far apart each has its box; in the same place a split would only cost.
    low = np.array([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0], [9.0, 0.0, 0.0]])
    tree = tree_of(low, low + 1.0)
    tree._add(np.arange(3))
    assert tree.order == [0, 1, 2]
    assert tree.boxes == [
        [0.0, 0.0, 0.0, 10.0, 1.0, 1.0],
        [0.0, 0.0, 0.0, 1.0, 1.0, 1.0],
        [9.0, 0.0, 0.0, 10.0, 1.0, 1.0],
    ]
    # Which node comes next where a box is missed, and which rectangles a leaf has.
    assert tree.links == [(3, 0, 0), (2, 0, 1), (3, 1, 3)]


def test_points_lie_where_their_rays_end() -> None:
    starts = np.array([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]])
    ways = np.array([[0.5, 1.0], [0.0, 1.0], [-0.5, 1.0]])
    hits = Hits(t=np.array([4.0, np.inf]), rectangle=np.array([3, -1], dtype=np.int32))
    np.testing.assert_array_equal(
        points_on(starts, ways, hits), [[3.0, 1.0], [2.0, 2.0], [1.0, 3.0]]
    )
