"""Compiled votes of the Hough transforms against plain formulations, on random input."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.votes import (
    VOTE_SHARES,
    best_bins,
    sharpest,
    vote_image,
    vote_places,
    vote_planes,
)

from tests.long_loops import seeds


def voted(
    image: NDArray[np.int32], along_rows: float, along_columns: float, n_bins: int
) -> NDArray[np.int64]:
    """(bins,) votes of an image's cells for the lines across a direction, cell by cell.

    Cells move along the axis that is nearer to the lines until they lie on the other one through
    the middle; from there they cover a piece of the direction, in quarters of bins.
    """
    votes = np.zeros(n_bins, dtype=np.int64)
    if abs(along_columns) < abs(along_rows):
        image, along_rows, along_columns = image.T, along_columns, along_rows
    n_rows, n_columns = image.shape
    for row, column in np.argwhere(image):
        height = row + 0.5 - 0.5 * n_rows
        shift = math.floor(height * (along_rows / along_columns) + 0.5)
        landed = column + shift - 0.5 * n_columns
        edges = sorted([along_columns * landed, along_columns * (landed + 1.0)])
        low = edges[0] + 0.5 * n_bins
        first = math.floor(low)
        share = math.floor(VOTE_SHARES * (first + 1 - low) / abs(along_columns) + 0.5)
        share = min(VOTE_SHARES, share)
        for place, quarters in ((first, share), (first + 1, VOTE_SHARES - share)):
            if 0 <= place < n_bins:
                votes[place] += quarters * image[row, column]
    return votes


def random_image(rng: np.random.Generator, shape: tuple[int, int]) -> NDArray[np.int32]:
    image = rng.integers(-3, 9, shape) * (rng.random(shape) < 0.2)
    # Rows and columns at the sides that are empty, whole tiles among them.
    image[:2] = image[:, -18:] = 0
    return image.astype(np.int32)


@pytest.mark.parametrize("shape", [(9, 37), (41, 20), (24, 24)])
@pytest.mark.parametrize("n_bins", [14, 60])
def test_cells_of_an_image_vote_for_the_lines_through_them(
    shape: tuple[int, int], n_bins: int
) -> None:
    image = random_image(np.random.default_rng(0), shape)
    angles = np.radians(np.arange(0.0, 180.0, 7.2))
    votes = np.ones((len(angles), n_bins), dtype=np.int32)
    vote_image(image, angles, votes)
    expected = [voted(image, math.cos(angle), math.sin(angle), n_bins) for angle in angles]
    np.testing.assert_array_equal(votes - 1, expected)


@pytest.mark.parametrize("seed", seeds(3))
def test_places_vote_for_the_planes_through_them(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape, bin_m, n_bins = (22, 35), 0.1, 30
    places = rng.uniform(-1.0, 1.0, (3, 200)).astype(np.float32) * np.float32([[1.6], [1.6], [1.3]])
    weights = rng.integers(1, 5, 200).astype(np.int32)
    # The middle omega has no direction.
    omegas, phis = np.radians([10.0, 60.0, 140.0]), np.radians([-80.0, -30.0, 0.0, 40.0, 90.0])
    angles = np.array([(omega, phi) for omega in omegas[[0, 2]] for phi in phis])
    starts = np.array([0, 5, 5, 10])
    image = np.zeros(shape, dtype=np.int32)
    votes = np.zeros((10, n_bins), dtype=np.int32)
    vote_planes(places, weights, angles, starts, image, bin_m, votes)
    assert not image.any()
    for (omega, phi), found in zip(angles, votes, strict=True):
        upright = np.zeros(shape, dtype=np.int32)
        level = np.float32(math.cos(omega) / bin_m) * places[0]
        level += np.float32(math.sin(omega) / bin_m) * places[1]
        column = np.floor(level + np.float32(0.5 * shape[1])).astype(int)
        row = np.floor(places[2] * np.float32(1.0 / bin_m) + np.float32(0.5 * shape[0])).astype(int)
        held = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
        assert 0 < np.count_nonzero(held) < 200
        np.add.at(upright, (row[held], column[held]), weights[held])
        np.testing.assert_array_equal(found, voted(upright, math.sin(phi), math.cos(phi), n_bins))


def test_places_vote_one_by_one_at_their_distance() -> None:
    rng = np.random.default_rng(0)
    places = rng.uniform(-1.0, 1.0, (3, 300)).astype(np.float32)
    weights = rng.integers(-3, 9, 300).astype(np.int32)
    normals = np.array([[0.0, 0.0, 1.0], [-0.2, 0.0, 1.0], [0.6, 0.8, 0.0], [-0.1, -0.15, 1.0]])
    low_m, bin_m, n_bins = -0.6, 0.1, 12
    votes = np.ones((4, n_bins), dtype=np.int32)
    vote_places(places, weights, normals, low_m, bin_m, votes)
    edges = low_m + bin_m * np.arange(n_bins + 1)
    for normal, found in zip(normals, votes, strict=True):
        expected = np.histogram(normal @ places, edges, weights=weights)[0]
        assert 0 < np.abs(expected).sum() < np.abs(weights).sum()
        np.testing.assert_array_equal(found - 1, expected)


def test_a_maximum_lies_at_the_top_of_a_parabola_through_its_neighbours() -> None:
    votes = np.zeros((2, 30), dtype=np.int32)
    votes[1, 14:17] = (40, 100, 70)
    row, place = sharpest(votes)
    assert row == 1
    # Windows of three bins hold 140, 210, 170 about the middle, and nothing beside them.
    assert place == pytest.approx(15.5 + 0.5 * (140 - 170) / (140 - 420 + 170), abs=1e-9)


@pytest.mark.parametrize(("half", "is_plain"), [(0, False), (1, False), (3, False), (0, True)])
def test_the_best_bin_stands_out_most_from_the_emptier_window_beside_it(
    half: int, is_plain: bool
) -> None:
    rng = np.random.default_rng(half)
    n_rows, n_bins = 9, 25
    votes = rng.integers(0, 6, (n_rows, n_bins)).astype(np.int32)
    barred = (rng.random(votes.shape) < 0.3).astype(np.uint8)
    barred[4] = 1
    votes[5], barred[5] = 0, 0
    # The best window may lie at either side.
    votes[6, 0] = votes[7, -1] = 99
    barred[6] = barred[7] = 0
    asked = np.array([0, 1, 2, 4, 5, 6, 7, 8])
    scores, places = np.full(n_rows, -7), np.full(n_rows, -7)
    best_bins(votes, asked, half, is_plain, barred, scores, places)
    assert (scores[3], places[3]) == (-7, -7)
    apart = 2 * half + 2
    for row in asked:
        wide = np.pad(votes[row].astype(np.int64), half + apart)
        windows = np.convolve(wide, np.ones(2 * half + 1, dtype=np.int64), "valid")
        beside = np.minimum(windows[:n_bins], windows[2 * apart :])
        worth = windows[apart : apart + n_bins] - (0 if is_plain else beside)
        line = np.where(barred[row] != 0, -1, worth)
        best = max(int(line.max()), -1)
        assert scores[row] == best
        assert places[row] == (int(line.argmax()) if best >= 0 else 0)
