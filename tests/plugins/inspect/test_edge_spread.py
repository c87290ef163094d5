"""Edge profiles, their width and their spectrum, against functions that are known."""

from __future__ import annotations

import numpy as np
import pytest
from orthoflow_plugins.inspect.image_quality import _ALONG, _centred, _mtf50, _width_cells
from scipy.special import erf


def spread(sigma_cells: float, shift_cells: float = 0.0) -> np.ndarray:
    return 0.5 * (1.0 + erf((_ALONG - shift_cells) / (sigma_cells * np.sqrt(2.0))))


@pytest.mark.parametrize("sigma_cells", [0.6, 1.0, 2.0])
def test_the_width_and_the_spectrum_of_a_gauss_are_known(sigma_cells: float) -> None:
    profile = spread(sigma_cells)
    # From 10 to 90 % are 2.563 standard deviations; the sampling of a quarter cell adds a little.
    assert _width_cells(profile) == pytest.approx(2.5631 * sigma_cells, rel=0.01)
    # exp(-2 pi^2 s^2 f^2) = 1/2.
    expected = np.sqrt(np.log(2.0) / 2.0) / (np.pi * sigma_cells)
    assert _mtf50(profile) == pytest.approx(expected, rel=0.02)


def test_a_step_within_one_sample_is_as_sharp_as_can_be_told() -> None:
    step = (_ALONG > 0.1).astype(np.float64)
    assert _width_cells(step) == pytest.approx(0.8 * 0.25)
    assert _mtf50(step) == pytest.approx(2.0, rel=1e-3)


def test_the_width_is_from_the_last_dark_place_to_the_first_bright_one() -> None:
    ringing = np.concatenate([np.zeros(20), [0.2, 0.05, 0.5, 0.95, 0.8], np.ones(20)])
    low = 21.0 + (0.1 - 0.05) / 0.45
    high = 22.0 + (0.9 - 0.5) / 0.45
    assert _width_cells(ringing) == pytest.approx(0.25 * (high - low))


@pytest.mark.parametrize("shift_cells", [-0.7, 0.0, 0.45])
def test_profiles_are_moved_to_their_middle(shift_cells: float) -> None:
    (moved,) = _centred(spread(0.8, shift_cells)[None], _ALONG)
    np.testing.assert_allclose(moved, spread(0.8), atol=0.01)
    assert _centred(np.zeros((0, _ALONG.size)), _ALONG).shape == (0, _ALONG.size)
