"""Measures of scatter: right for normal errors, unmoved by wild ones."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np
import pytest

from orthoflow.geometry.robust import MEDIAN_LENGTH, NMAD_FACTOR, median_deviation
from tests.long_loops import seeds


def test_factors_are_those_of_the_normal_distribution() -> None:
    # Four decimals, as they are cited.
    assert pytest.approx(1.0 / NormalDist().inv_cdf(0.75), abs=5e-5) == NMAD_FACTOR
    assert pytest.approx(np.sqrt(2.0 * np.log(2.0)), abs=5e-5) == MEDIAN_LENGTH


@pytest.mark.parametrize(
    ("values", "middle", "deviation"),
    [
        ([5.0], None, 0.0),
        ([1.0, 2.0, 4.0], None, 1.0),
        ([1.0, 2.0, 3.0, 4.0], None, 1.0),
        ([1.0, 2.0, 4.0], 0.0, 2.0),
        ([-1.0, 1.0, -3.0], 0.0, 1.0),
        ([1.0, 2.0, 1e9], None, 1.0),
    ],
    ids=["one value", "odd", "even", "about zero", "signs", "a wild value"],
)
def test_deviations_are_told_from_the_middle(
    values: list[float], middle: float | None, deviation: float
) -> None:
    assert median_deviation(np.array(values), middle) == NMAD_FACTOR * deviation


@pytest.mark.parametrize("seed", seeds(4))
def test_a_tenth_of_wild_values_moves_it_by_less_than_they_move_a_standard_deviation(
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    errors = 3.0 * rng.normal(size=20_000) + 7.0
    assert median_deviation(errors) == pytest.approx(3.0, rel=0.03)  # 1.2 sigma / sqrt(n) is 1 %
    errors[::10] += 1000.0
    # A tenth on one side moves it by a seventh; the standard deviation a hundredfold.
    assert median_deviation(errors) == pytest.approx(3.0, rel=0.2)
    assert np.std(errors) > 100.0


@pytest.mark.parametrize("seed", seeds(4))
def test_half_of_all_normal_vectors_are_shorter_than_the_median_length(seed: int) -> None:
    vectors = np.random.default_rng(seed).normal(size=(40_000, 2))
    shorter = np.linalg.norm(vectors, axis=1) < MEDIAN_LENGTH
    assert shorter.mean() == pytest.approx(0.5, abs=0.01)  # four standard deviations
