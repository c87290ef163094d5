"""Measures of scatter: right for normal errors, unmoved by wild ones."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np
import pytest

from orthoflow.geometry.robust import MEDIAN_LENGTH, NMAD_FACTOR, median_deviation


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
