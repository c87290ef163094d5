"""Parts of pictures that are compared, and how far they lie off each other."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.inspect import patches
from orthoflow_plugins.inspect.patches import GreyImage
from scipy.ndimage import gaussian_filter, shift

ROWS, COLUMNS = 9, 12


def texture(seed: int = 1, side: int = 130) -> NDArray[np.float64]:
    smooth = gaussian_filter(np.random.default_rng(seed).normal(size=(side, side)), 1.5)
    return np.asarray(128.0 + 30.0 * smooth / smooth.std())


def image(grey: NDArray[np.float64], valid: NDArray[np.bool_] | None = None) -> GreyImage:
    everywhere = np.ones(grey.shape, dtype=np.bool_)
    return GreyImage(grey=grey, valid=everywhere if valid is None else valid, region=everywhere)


def moved(grey: NDArray[np.float64], right: float, down: float) -> NDArray[np.float64]:
    return np.asarray(shift(grey, (down, right), order=3, mode="nearest"))


@pytest.mark.parametrize("apart", [(0.0, 0.0), (1.3, -2.6), (-3.0, 3.75), (5.0, -5.0), (-5.0, 5.0)])
def test_a_displacement_is_measured_in_every_whole_patch(apart: tuple[float, float]) -> None:
    true = texture()
    found = patches.measure_shifts(image(moved(true, *apart)), image(true), reach_cells=5)
    # Four by four patches of 32 cells in 130; two cells are left over.
    centres = [[32 * c + 16.0, 32 * r + 16.0] for r in range(4) for c in range(4)]
    assert found.centre.tolist() == centres
    np.testing.assert_allclose(found.shift, np.tile(apart, (16, 1)), atol=0.03)
    assert (np.abs(found.found - apart) <= 0.51).all()
    assert (found.sigma < 0.15).all()
    assert (found.correlation > 0.98).all()


def test_what_strays_by_two_cells_from_its_start_is_left_out() -> None:
    true = texture()
    start = patches.unrefined(
        np.array([[40.0, 40.0], [80.0, 40.0]]), np.array([[1.0, 0.0], [6.0, 0.0]])
    )
    found = patches.refine_shifts(
        image(moved(true, 1.8, 0.0)), image(true), start, sigma_most_cells=0.5
    )
    assert found.centre.tolist() == [[40.0, 40.0]]
    np.testing.assert_allclose(found.shift, [[1.8, 0.0]], atol=0.03)
    np.testing.assert_array_equal(found.found, [[1.0, 0.0]])
    noisy = image(true + np.random.default_rng(6).normal(size=true.shape))
    none = patches.refine_shifts(noisy, image(true), start, sigma_most_cells=1e-4)
    assert len(none.centre) == 0
    empty = patches.unrefined(np.zeros((0, 2)), np.zeros((0, 2)))
    assert patches.refine_shifts(image(true), image(true), empty, sigma_most_cells=1.0) is empty
