"""What is taken out of depths: specks that hardly any cell agrees with, and noise, but no steps."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.raster import surfaces
from orthoflow_plugins.raster.surfaces import denoised, without_specks

LAYER_M = 0.1
GSD_M = 0.01


def specks(depth_m: NDArray[np.float32]) -> NDArray[np.bool_]:
    cleaned = without_specks(depth_m, gsd_m=GSD_M, layer_m=LAYER_M, threads=2)
    is_speck = np.isnan(cleaned) & ~np.isnan(depth_m)
    np.testing.assert_array_equal(cleaned[~is_speck], depth_m[~is_speck])
    return is_speck


def flat(rows: int = 40, columns: int = 40, *, noise_m: float = 0.001) -> NDArray[np.float32]:
    return np.random.default_rng(1).normal(0.0, noise_m, (rows, columns)).astype(np.float32)


@pytest.mark.parametrize(("off_m", "n_cells", "is_speck"), [
    (0.2, 1, True),
    (0.2, 2, True),
    (0.2, 3, False),
    (0.09, 1, False),
    (-0.2, 1, True),
])  # fmt: skip
def test_a_cell_that_fewer_than_two_around_agree_with_is_a_speck(
    off_m: float, n_cells: int, is_speck: bool
) -> None:
    depth_m = flat()
    depth_m[20, 20 : 20 + n_cells] = off_m
    expected = np.zeros(depth_m.shape, dtype=np.bool_)
    expected[20, 20 : 20 + n_cells] = is_speck
    np.testing.assert_array_equal(specks(depth_m), expected)


@pytest.mark.parametrize(("n_known", "is_speck"), [(5, False), (6, True)])
def test_fewer_than_six_known_cells_say_nothing(n_known: int, is_speck: bool) -> None:
    # Alone in the void, so that nothing is denser around.
    depth_m = np.full((40, 40), np.nan, dtype=np.float32)
    around = [(18, 18), (18, 20), (18, 22), (20, 18), (20, 22), (22, 18)][:n_known]
    for k, (row, column) in enumerate(around):
        depth_m[row, column] = 0.5 + 0.001 * k
    depth_m[20, 20] = 0.0
    assert specks(depth_m)[20, 20] == is_speck


def test_cells_two_rows_or_columns_off_are_around_and_three_are_not() -> None:
    depth_m = flat()
    for row, column in ((20, 20), (22, 20), (20, 22)):
        depth_m[row, column] = 0.3
    assert not specks(depth_m)[20, 20]
    apart = flat()
    for row, column in ((20, 20), (23, 20), (20, 23)):
        apart[row, column] = 0.3
    assert specks(apart)[20, 20]


def shadow(*, agree: int, n: int = 6) -> NDArray[np.float32]:
    """A dense wall, a shadow 10 columns wide, and in it a cell with some around it."""
    depth_m = flat(40, 60)
    depth_m[:, 25:35] = np.nan
    depth_m[20, 30] = 0.5
    places = [(20, 28), (20, 32), (18, 30), (22, 30), (17, 28), (23, 32)][:n]
    for k, (row, column) in enumerate(places):
        # Those that do not agree differ from each other, too.
        depth_m[row, column] = 0.5 if k < agree else 0.7 + 0.1 * k
    return depth_m


@pytest.mark.parametrize(
    ("agree", "n", "is_speck"),
    [(3, 6, False), (2, 6, True), (2, 3, True), (3, 3, False)],
)
def test_in_a_shadow_three_and_half_of_the_known_must_agree(
    agree: int, n: int, is_speck: bool
) -> None:
    assert specks(shadow(agree=agree, n=n))[20, 30] == is_speck


def test_sparse_cells_agree_but_for_a_slope_of_one_in_two() -> None:
    for slope, is_speck in ((0.4, False), (0.8, True)):
        depth_m = flat(40, 60, noise_m=1e-5)
        depth_m[:, 25:35] = np.nan
        for row, column in ((20, 30), (20, 28), (20, 32), (20, 34)):
            depth_m[row, column] = 0.5 + slope * GSD_M * (column - 30)
        # The farthest is four columns off.
        assert specks(depth_m)[20, 30] == is_speck, slope


@pytest.mark.parametrize(("sigmas", "is_speck"), [(3.2, False), (5.5, True)])
def test_sparse_cells_agree_within_four_deviations_of_the_noise(
    sigmas: float, is_speck: bool
) -> None:
    depth_m = flat(80, 80, noise_m=0.001)
    depth_m[:, 25:35] = np.nan
    depth_m[20, 30] = 0.5
    for row, column in ((20, 28), (20, 32), (18, 30), (22, 30)):
        depth_m[row, column] = 0.5 + 0.001 * sigmas
    # Cells so small that the slope of a surface adds nothing.
    cleaned = without_specks(depth_m, gsd_m=1e-9, layer_m=LAYER_M, threads=1)
    assert np.isnan(cleaned[20, 30]) == is_speck


def test_noise_of_less_than_a_fiftieth_of_a_millimetre_is_left() -> None:
    quiet, noisy = flat(noise_m=1.6e-5), flat(noise_m=2.6e-5)
    assert denoised(quiet) is quiet
    assert denoised(noisy) is not noisy
    noisy[10:20, 20:30] = np.nan
    np.testing.assert_array_equal(np.isnan(denoised(noisy)), np.isnan(noisy))
    nothing = np.full((20, 20), np.nan, dtype=np.float32)
    assert denoised(nothing) is nothing


def weighed(depth_m: NDArray[np.float64], reach_m: float) -> NDArray[np.float64]:
    """A bilateral filter, cell by cell: neighbours in a disc, both weights those of a Gauss."""
    radius, sigma = 4, 2.0
    high = np.pad(depth_m, radius, mode="edge")
    total, weights = np.zeros_like(depth_m), np.zeros_like(depth_m)
    rows, columns = depth_m.shape
    steps = range(-radius, radius + 1)
    for down, right in [(a, b) for a in steps for b in steps if a * a + b * b <= radius**2]:
        other = high[radius + down :, radius + right :][:rows, :columns]
        weight = np.exp(-0.5 * ((other - depth_m) / reach_m) ** 2)
        weight *= np.exp(-0.5 * (down**2 + right**2) / sigma**2)
        total, weights = total + weight * other, weights + weight
    return total / weights


def test_noise_is_taken_out_within_three_sigmas_and_then_half_of_that(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(surfaces, "depth_noise_m", lambda _depth_m: 0.01)
    depth_m = flat(30, 30, noise_m=0.012)
    depth_m[:, 15:] += 0.05
    expected = weighed(weighed(depth_m.astype(np.float64), 0.03), 0.015)
    np.testing.assert_allclose(denoised(depth_m), expected, atol=2e-5)
