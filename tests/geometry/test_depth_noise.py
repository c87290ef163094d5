"""The noise of depths is told whatever the surface below them."""

from __future__ import annotations

import numpy as np
import pytest

from orthoflow.geometry.robust import depth_noise_m


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
