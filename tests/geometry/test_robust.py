"""Measures of scatter: right for normal errors, unmoved by wild ones, edges and holes."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np
import pytest

from orthoflow.geometry.robust import MEDIAN_LENGTH, NMAD_FACTOR, depth_noise_m, median_deviation


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


@pytest.mark.parametrize("sigma_m", [0.001, 0.004])
def test_noise_is_told_apart_from_slopes_steps_and_holes(sigma_m: float) -> None:
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[:200, :300]
    depth = 0.02 * columns + 0.5 * (columns > 150) - 0.1 * rows
    depth = depth + rng.normal(0.0, sigma_m, depth.shape)
    depth[rng.random(depth.shape) < 0.1] = np.nan
    # 43 000 second differences, neighbours of which share values.
    assert depth_noise_m(depth.astype(np.float32)) == pytest.approx(sigma_m, rel=0.03)


def test_of_large_rasters_some_rows_tell() -> None:
    depth = np.random.default_rng(0).normal(0.0, 0.002, (900, 1000)).astype(np.float32)
    assert depth_noise_m(depth) == pytest.approx(0.002, rel=0.02)


@pytest.mark.parametrize("shape", [(5, 2), (0, 0), (3, 1)])
def test_without_three_neighbours_there_is_no_noise(shape: tuple[int, int]) -> None:
    assert depth_noise_m(np.ones(shape, dtype=np.float32)) == 0.0
    gaps = np.full((4, 9), np.nan, dtype=np.float32)
    gaps[:, ::3] = gaps[:, 1::3] = 1.0
    assert depth_noise_m(gaps) == 0.0
