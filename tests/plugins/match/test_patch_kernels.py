"""Compiled matching of patches, compared with simple implementations."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.match import displacements
from orthoflow_plugins.match.channels import Channels

from tests.long_loops import seeds

SIDE = 44
HALF = 5


def texture(columns: NDArray[np.float64], rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return two channels (..., 2) of waves that are longer than a patch."""
    a, b = np.random.default_rng(7).uniform(-0.5, 0.5, (2, 2, 6))
    phases = np.random.default_rng(8).uniform(0.0, 6.0, (2, 6))
    at = a * columns[..., None, None] + b * rows[..., None, None]
    return np.asarray(np.cos(at + phases).sum(axis=-1))


def picture(shift: tuple[float, float] = (0.0, 0.0)) -> NDArray[np.float32]:
    rows, columns = np.mgrid[:SIDE, :SIDE].astype(np.float64)
    return texture(columns - shift[0], rows - shift[1]).astype(np.float32)


# --- whole cells ---


@pytest.mark.parametrize("seed", seeds(3))
def test_the_shift_of_highest_correlation_is_found_with_its_lead(seed: int) -> None:
    rng = np.random.default_rng(seed)
    half, radius = 4, 3
    first = rng.normal(size=(30, 34, 2)).astype(np.float32)
    shift = rng.integers(-2, 3, 2)
    noise = rng.normal(size=first.shape).astype(np.float32)
    second = np.roll(first, tuple(shift[::-1]), axis=(0, 1)) + 0.5 * noise
    places = rng.integers(half + radius, [34 - half - radius, 30 - half - radius], (6, 2))

    def patch(of: NDArray[np.float32], column: int, row: int) -> NDArray[np.float64]:
        """Return every second cell of a patch, minus the mean of each channel."""
        steps = np.arange(-half, half + 1, 2)
        part = of[np.ix_(row + steps, column + steps)].astype(np.float64)
        return part - part.mean(axis=(0, 1))

    # The best position of the last picture is at the border.
    edge = np.roll(first, (0, radius), axis=(0, 1))
    for other, wanted in ((second, shift), (edge, (radius, 0))):
        found = np.zeros((6, 4))
        displacements.search_shifts(first, other, places, (half, radius), found)
        for (column, row), result in zip(places, found, strict=True):
            scores, own = np.empty((7, 7)), patch(first, column, row)
            for down, across in np.ndindex(7, 7):
                there = patch(other, column + across - radius, row + down - radius)
                length = math.sqrt((own**2).sum() * (there**2).sum())
                scores[down, across] = (own * there).sum() / length
            down, across = np.unravel_index(scores.argmax(), scores.shape)
            np.testing.assert_array_equal(result[:2], [across - radius, down - radius])
            np.testing.assert_array_equal(result[:2], wanted)
            assert result[2] == pytest.approx(scores.max(), abs=1e-6)
            rows, columns = np.indices(scores.shape)
            away = np.maximum(np.abs(rows - down), np.abs(columns - across)) > 2
            lead = -1.0 if other is edge else scores.max() - scores[away].max()
            assert result[3] == pytest.approx(lead, abs=1e-6)


# --- fractions of a cell ---


def _window(half: int) -> NDArray[np.float64]:
    bell = np.exp(-0.5 * (np.arange(-half, half + 1) / (0.6 * half)) ** 2)
    return np.outer(bell, bell)


def matched(
    first: Channels, second: Channels, start: tuple[float, float], place: tuple[int, int] = (22, 20)
) -> NDArray[np.float64]:
    window, found = _window(HALF), np.array([[*start, 0.0, 0.0]])
    side = len(window)
    work = tuple(np.empty(shape) for shape in ((side, side), (side + 3, side, 2), (side, side, 2)))
    displacements.match_patches(first, second, np.array([place]), window, work, found)
    return found[0]


def known(value: float = 1.0) -> NDArray[np.float32]:
    return np.full((SIDE, SIDE), value, dtype=np.float32)


def keys(t: float) -> NDArray[np.float64]:
    """Return weights of cubic convolution by definition, for distances 1 + t, t, 1 - t, 2 - t."""
    away = np.array([1.0 + t, t, 1.0 - t, 2.0 - t])
    near = 1.5 * away**3 - 2.5 * away**2 + 1.0
    far = -0.5 * away**3 + 2.5 * away**2 - 4.0 * away + 2.0
    return np.where(away <= 1.0, near, far)


def test_deviation_and_correlation_are_those_of_weighted_least_squares() -> None:
    rng = np.random.default_rng(1)
    noisy = [
        (values + rng.normal(0.0, 0.05, values.shape)).astype(np.float32)
        for values in (picture(), picture((0.6, -0.3)))
    ]
    mask = known()
    mask[15:19, 18:24] = 0.0
    first, second = Channels(noisy[0], mask), Channels(noisy[1], known())
    across, down, sigma, score = matched(first, second, (1.0, 0.0))
    window = _window(HALF)
    rows = 20 + np.arange(-HALF, HALF + 1)
    columns = 22 + np.arange(-HALF, HALF + 1)

    def shown(values: NDArray[np.float32], i: int, j: int) -> NDArray[np.float64]:
        return values[np.ix_(rows + i, columns + j)].astype(np.float64)

    low = (math.floor(20 + down) - 20, math.floor(22 + across) - 22)
    weights = (keys(down - low[0]), keys(across - low[1]))
    moved = sum(
        weights[0][i] * weights[1][j] * shown(noisy[1], low[0] + i - 1, low[1] + j - 1)
        for i in range(4)
        for j in range(4)
    )
    w = (window * mask[np.ix_(rows, columns)])[:, :, None]
    total = w.sum()

    def centred(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return values - (w * values).sum(axis=(0, 1)) / total

    a = centred(shown(noisy[0], 0, 0))
    b = centred(moved)
    slopes = [
        centred(0.5 * (shown(noisy[0], i, j) - shown(noisy[0], -i, -j)))
        for i, j in ((0, 1), (1, 0))
    ]
    saa, sab, sbb = (w * a * a).sum(), (w * a * b).sum(), (w * b * b).sum()
    assert score == pytest.approx(sab / math.sqrt(saa * sbb), abs=1e-4)
    normal = np.array([[(w * p * q).sum() for q in slopes] for p in slopes])
    noise = (saa - sab**2 / sbb) / (2.0 * total)
    expected = math.sqrt(noise * 0.5 * np.trace(np.linalg.inv(normal)))
    assert sigma == pytest.approx(expected, rel=0.01)
    # The residual has no component along the slopes, so no improvement is possible.
    residual = sab / sbb * b - a
    pull = np.linalg.solve(normal, [(w * residual * slope).sum() for slope in slopes])
    assert np.abs(pull).max() < 0.002


def test_patches_that_fix_no_shift_have_no_deviation() -> None:
    first, second = Channels(picture(), known()), Channels(picture((0.5, 0.25)), known())
    # These patches are too close to the border of either picture.
    reach = HALF + 3
    for least, is_fine in ((reach, True), (reach - 1, False)):
        for at in (least, SIDE - least - 1):
            for place in ((at, 20), (20, at)):
                assert math.isfinite(matched(first, second, (0.2, 0.1), place)[2]) == is_fine
    assert math.isinf(matched(first, second, (-30.0, 0.0))[2])
    assert math.isinf(matched(first, second, (0.0, 30.0))[2])
    # Three tenths of the weights must be known.
    window = _window(HALF)
    verdicts = set()
    for n_rows in range(15, 26):
        mask = known(0.0)
        mask[:n_rows] = 1.0
        share = float((window * mask[15:26, 17:28]).sum() / window.sum())
        is_fine = math.isfinite(matched(Channels(picture(), mask), second, (0.0, 0.0))[2])
        assert is_fine == (share > 0.3), share
        verdicts.add(is_fine)
    assert verdicts == {False, True}
    flat = Channels(np.ones((SIDE, SIDE, 2), dtype=np.float32), known())
    assert math.isinf(matched(flat, second, (0.0, 0.0))[2])
    negative = Channels(-picture(), known())
    assert math.isinf(matched(first, negative, (0.0, 0.0))[2])


@pytest.mark.parametrize("noise", [0.1, 1.0, 5.0])
@pytest.mark.parametrize("half", [4, 10])
def test_gains_are_ridge_regression_and_the_score_is_corrected_for_what_they_fit_of_chance(
    half: int, noise: float
) -> None:
    rng = np.random.default_rng(14)
    colours = rng.normal(3.0, 1.0, (SIDE, SIDE, 3))
    # Correlated channels.
    colours[..., 2] = 0.7 * colours[..., 0] + 0.5 * colours[..., 2]
    wall = colours @ [0.8, -0.5, 0.3] + noise * rng.normal(size=(SIDE, SIDE)) + 7.0
    first, second = wall[..., None].astype(np.float32), colours.astype(np.float32)
    found = np.zeros((1, 7))
    displacements.search_shifts(first, second, np.array([[21, 23]]), (half, 0), found)
    # Every second cell of the patch.
    cells = np.ix_(23 + np.arange(-half, half + 1, 2), 21 + np.arange(-half, half + 1, 2))
    a = first[cells].reshape(-1).astype(np.float64)
    x = second[cells].reshape(-1, 3).astype(np.float64)
    a, x = a - a.mean(), x - x.mean(axis=0)
    products = x.T @ x
    gains = np.linalg.solve(products + 1e-3 * np.trace(products) * np.eye(3), x.T @ a)
    # Products have single precision.
    np.testing.assert_allclose(found[0, 4:], gains, atol=2e-4)
    # Two of three cells are independent; three gains and a mean use four of these.
    free = len(a) / 1.5
    left = (1.0 - gains @ x.T @ a / (a @ a)) * (free - 1.0) / (free - 4.0)
    assert found[0, 2] == pytest.approx(np.sqrt(max(0.0, 1.0 - left)), abs=1e-4)
    assert (found[0, 0], found[0, 1], found[0, 3]) == (0.0, 0.0, -1.0)
