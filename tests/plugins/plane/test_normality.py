"""Closeness to a normal distribution: known shapes give their known moments and shares."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.planes import normality

FIND_M = 0.05
LIMITS_M = {"tolerance_m": FIND_M, "fit_tolerance_m": 0.015}
FIT_M = LIMITS_M["fit_tolerance_m"]


def histogram(distances_m: NDArray[np.float64]) -> NDArray[np.int64]:
    counts, _ = np.histogram(distances_m, 200, (-FIND_M, FIND_M))
    return counts.astype(np.int64)


@pytest.mark.parametrize("sigma_m", [0.001, 0.002, 0.0035])
def test_normal_deviations_have_the_moments_and_shares_of_a_normal_distribution(
    sigma_m: float,
) -> None:
    distances_m = np.random.default_rng(1).normal(0.0003, sigma_m, 400_000)
    shape = normality(histogram(distances_m), **LIMITS_M)
    assert shape is not None
    assert shape.mean_m == pytest.approx(0.0003, abs=1e-5)
    assert shape.sigma_m == pytest.approx(sigma_m, rel=0.005)
    assert shape.skewness == pytest.approx(0.0, abs=0.03)
    assert shape.excess_kurtosis == pytest.approx(0.0, abs=0.06)
    # Bins of 0.5 mm are read as evenly filled, which matters where sigma is not much wider.
    np.testing.assert_allclose(shape.within, [0.6827, 0.9545, 0.9973], atol=0.02)
    np.testing.assert_allclose(shape.found_sigmas[5:-5], shape.expected_sigmas[5:-5], atol=0.12)


def test_points_of_relief_on_one_side_show_as_skewness_and_heavy_tails() -> None:
    rng = np.random.default_rng(2)
    wall = rng.normal(0.0, 0.002, 95_000)
    moulding = rng.normal(0.012, 0.001, 5_000)
    shape = normality(histogram(np.concatenate([wall, moulding])), **LIMITS_M)
    assert shape is not None
    mirrored = normality(histogram(np.concatenate([wall, moulding]))[::-1], **LIMITS_M)
    assert mirrored is not None
    assert shape.skewness > 1.0
    assert shape.excess_kurtosis > 2.0
    assert shape.within[0] > 0.75
    assert mirrored.skewness == pytest.approx(-shape.skewness)


def test_evenly_spread_points_have_light_tails() -> None:
    flat = np.random.default_rng(3).uniform(-FIT_M, FIT_M, 200_000)
    shape = normality(histogram(flat), **LIMITS_M)
    assert shape is not None
    assert shape.excess_kurtosis == pytest.approx(-1.2, abs=0.02)
    assert shape.sigma_m == pytest.approx(FIT_M / np.sqrt(3.0), rel=0.01)


def test_few_points_or_one_bin_say_nothing() -> None:
    few = np.random.default_rng(4).normal(0.0, 0.002, 50)
    assert normality(histogram(few), **LIMITS_M) is None
    assert normality(histogram(np.full(1000, 1e-4)), **LIMITS_M) is None
