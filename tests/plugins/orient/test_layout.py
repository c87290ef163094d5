"""How ties lie over a photo."""

from __future__ import annotations

import numpy as np
import pytest
from orthoflow_plugins.orient.layout import hull_area, image_cells, quadrant_counts, withheld
from scipy.spatial import ConvexHull


@pytest.mark.parametrize("seed", range(4))
def test_the_area_of_a_hull_is_that_of_its_polygon(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pixels = np.round(rng.uniform(0.0, 30.0, (60, 2)))
    assert hull_area(pixels) == pytest.approx(ConvexHull(pixels).volume)
    assert hull_area(np.vstack([pixels, pixels])[rng.permutation(120)]) == hull_area(pixels)


def test_a_line_and_two_points_have_no_area() -> None:
    line = np.outer(np.arange(5.0), [2.0, 3.0])
    assert hull_area(line) == 0.0
    assert hull_area(np.tile([[1.0, 2.0], [3.0, 9.0]], (4, 1))) == 0.0
    assert hull_area(np.empty((0, 2))) == 0.0
    assert hull_area(np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 3.0]])) == 3.0


def test_cells_are_numbered_row_by_row_and_hold_what_lies_beside_the_image() -> None:
    pixels = np.array([[0.0, 0.0], [99.9, 0.0], [100.0, 0.0], [0.0, 50.0], [299.0, 149.0]])
    np.testing.assert_array_equal(image_cells(pixels, (300, 150), 3), [0, 0, 1, 3, 8])
    beside = np.array([[-5.0, -5.0], [400.0, -5.0], [-5.0, 200.0], [300.0, 150.0]])
    np.testing.assert_array_equal(image_cells(beside, (300, 150), 3), [0, 2, 6, 8])
    np.testing.assert_array_equal(quadrant_counts(pixels, (300, 150)), [4, 0, 0, 1])
    np.testing.assert_array_equal(quadrant_counts(beside[:3], (300, 150)), [1, 1, 1, 0])
    np.testing.assert_array_equal(quadrant_counts(beside[:0], (300, 150)), [0, 0, 0, 0])


@pytest.mark.parametrize(("share", "n_check"), [(0.2, 144), (0.25, 180), (0.001, 1), (0.0, 0)])
def test_check_points_are_withheld_evenly(share: float, n_check: int) -> None:
    rng = np.random.default_rng(0)
    # Twenty ties in each of six by six cells.
    corner = np.stack(np.meshgrid(np.arange(6), np.arange(6)), axis=-1).reshape(-1, 1, 2)
    pixels = (100.0 * (corner + rng.random((36, 20, 2)))).reshape(-1, 2)
    chosen = withheld(pixels, (600, 600), share, rng)
    assert chosen.sum() == n_check
    counts = np.bincount(image_cells(pixels[chosen], (600, 600), 6), minlength=36)
    assert np.abs(counts - share * 20).max() <= 1.0
    # Which ones is left to chance.
    other = withheld(pixels, (600, 600), share, rng)
    assert n_check == 0 or (other != chosen).any()
    assert withheld(pixels[:0], (600, 600), 0.5, rng).shape == (0,)
