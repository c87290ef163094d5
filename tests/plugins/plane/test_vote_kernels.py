"""Compiled votes of the Hough transforms against plain formulations, on random input."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.kernels import blocked, box_blocks
from orthoflow_plugins.plane.vote_kernels import (
    VOTE_SHARES,
    best_bins,
    vote_image,
    vote_lines,
    vote_planes,
    vote_points,
    vote_tilts,
)

from orthoflow.geometry.point_kernels import read_only

SEEDS: Final = range(3)


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
    votes = np.ones((len(angles), n_bins), dtype=np.int64)
    vote_image(image, angles, votes)
    expected = [voted(image, math.cos(angle), math.sin(angle), n_bins) for angle in angles]
    np.testing.assert_array_equal(votes - 1, expected)


@pytest.mark.parametrize("seed", SEEDS)
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


@pytest.mark.parametrize("axis", [0, 2])
def test_places_on_the_first_edge_of_the_image_count_and_those_on_the_last_do_not(
    axis: int,
) -> None:
    # Four cells of 1 m about the middle; every second place lies on an edge of a cell.
    along = np.arange(-2.5, 2.75, 0.25, dtype=np.float32)
    places = np.full((3, len(along)), 0.5, dtype=np.float32)
    places[axis] = along
    weights = np.ones(len(along), dtype=np.int32)
    angles = np.array([[0.0, 0.0 if axis == 0 else math.pi / 2]])
    image, votes = np.zeros((4, 4), dtype=np.int32), np.zeros((1, 8), dtype=np.int32)
    vote_planes(places, weights, angles, np.array([0, 1]), image, 1.0, votes)
    expected = [0, 0, *[4 * VOTE_SHARES] * 4, 0, 0]
    np.testing.assert_array_equal(votes[0], expected)
    assert not image.any()


@pytest.mark.parametrize("seed", SEEDS)
def test_lines_and_points_vote_at_their_distance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    angles = np.radians([0.0, 20.0, 75.0, 90.0, 160.0])
    low_m, bin_m, n_bins = -0.7, 0.13, 12
    cells = rng.uniform(-1.0, 1.0, (80, 2)).astype(np.float32)
    weights = rng.integers(-3, 9, 80)
    votes = np.ones((5, n_bins), dtype=np.int64)
    vote_lines(cells, weights, angles, low_m, bin_m, votes)
    points_m = rng.uniform(-1.0, 1.0, (300, 3)).astype(np.float32)
    offsets = read_only(*np.ascontiguousarray(points_m.T))
    points = blocked(offsets, box_blocks(offsets, parts=1).boxes)
    basis = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    plan = np.column_stack([basis[:2], rng.uniform(-0.4, 0.4, 2)])
    of_points = np.ones((5, n_bins), dtype=np.int64)
    vote_points(points, plan, angles, low_m, bin_m, of_points)
    in_plan = points_m @ plan[:, :3].T - plan[:, 3]
    edges = low_m + bin_m * np.arange(n_bins + 1)
    for angle, found, found_of_points in zip(angles, votes, of_points, strict=True):
        direction = np.array([math.cos(angle), math.sin(angle)])
        expected = np.histogram(cells @ direction, edges, weights=weights)[0]
        np.testing.assert_array_equal(found - 1, expected)
        expected = np.histogram(in_plan @ direction, edges)[0]
        assert 0 < expected.sum() < 300
        np.testing.assert_array_equal(found_of_points - 1, expected)


def test_tilts_are_voted_for_at_the_height_above_the_tilted_plane() -> None:
    rng = np.random.default_rng(0)
    places = rng.uniform(-1.0, 1.0, (3, 300)).astype(np.float32)
    weights = rng.integers(1, 9, 300).astype(np.int32)
    slopes = np.array([[0.0, 0.0], [0.2, 0.0], [0.0, -0.3], [0.1, 0.15]])
    low_m, bin_m, n_bins = -0.6, 0.1, 12
    votes = np.ones((4, n_bins), dtype=np.int64)
    vote_tilts(places, weights, slopes, low_m, bin_m, votes)
    edges = low_m + bin_m * np.arange(n_bins + 1)
    for slope, found in zip(slopes, votes, strict=True):
        heights = places[2] - slope @ places[:2]
        expected = np.histogram(heights, edges, weights=weights)[0]
        assert 0 < expected.sum() < weights.sum()
        np.testing.assert_array_equal(found - 1, expected)


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
