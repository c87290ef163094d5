"""Colours of points: scales that people read, brightness, and pieces all over a cloud."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from orthoflow.files.clouds.colours import (
    deviation_colours,
    grey_range,
    greys,
    plane_colour,
    plane_colours,
    round_scale_m,
    sampled_pieces,
)
from orthoflow.products import PointCloud


@pytest.mark.parametrize(
    ("largest_m", "scale_m"),
    [
        *((0.0, 0.001), (0.001, 0.001), (0.00101, 0.002), (0.0021, 0.005), (0.0051, 0.01)),
        *((1.0, 1.0), (1.01, 2.0), (4.0, 5.0), (6.0, 10.0), (4e5, 5e5), (6e5, 1e6), (9e7, 1e6)),
    ],
)
def test_a_scale_is_the_next_of_one_two_five(largest_m: float, scale_m: float) -> None:
    assert round_scale_m(largest_m) == scale_m


def cloud_of(n_points: int, **more: object) -> PointCloud:
    zero = np.zeros(n_points, np.float32)
    up = np.array([0.0, 0.0, 1.0])
    return PointCloud(origin=np.zeros(3), x=zero, y=zero, z=zero, up=up, **more)  # type: ignore[arg-type]


def test_brightness_is_the_root_of_the_intensity_else_the_mean_of_the_colours_else_one() -> None:
    rgb = np.array([[0, 0, 0], [10, 20, 60], [255, 255, 255]], np.uint8)
    intensity = np.array([-0.25, 0.25, 1.0], np.float32)
    every = slice(0, 3)
    assert greys(cloud_of(3, intensity=intensity, rgb=rgb), every).tolist() == [0.0, 0.5, 1.0]
    assert greys(cloud_of(3, rgb=rgb), every).tolist() == pytest.approx([0.0, 30 / 255, 1.0])
    assert greys(cloud_of(3), every).tolist() == [1.0, 1.0, 1.0]
    assert greys(cloud_of(3, rgb=rgb), slice(1, 2)).tolist() == pytest.approx([30 / 255])


def test_the_darkest_and_the_brightest_hundredth_set_no_range() -> None:
    roots = np.linspace(0.0, 1.0, 64 * 100 + 1)
    low, high = grey_range(cloud_of(len(roots), intensity=(roots**2).astype(np.float32)))
    assert low == pytest.approx(0.01, abs=1e-4)
    assert high == pytest.approx(0.99, abs=1e-4)
    assert grey_range(cloud_of(3)) == (0.0, 1.0)
    assert grey_range(cloud_of(0, intensity=np.zeros(0, np.float32))) == (0.0, 1.0)


@pytest.mark.parametrize("n_points", [0, 1, 63, 5000, 10_000_000])
def test_pieces_lie_all_over_a_cloud_and_are_a_quarter_of_a_million_points(n_points: int) -> None:
    pieces = sampled_pieces(n_points)
    assert all(0 <= piece.start < piece.stop <= n_points for piece in pieces)
    # None over another: every point that is looked at counts once.
    assert all(one.stop <= other.start for one, other in itertools.pairwise(pieces))
    if n_points <= 5000:
        assert sum(piece.stop - piece.start for piece in pieces) == n_points
    assert len(pieces) <= 80
    if n_points > 1_000_000:
        starts = np.array([piece.start for piece in pieces])
        assert starts[0] == 0
        assert np.diff(starts).max() <= n_points / 60
        assert n_points - starts[-1] <= n_points / 60
        assert 250_000 < sum(piece.stop - piece.start for piece in pieces) < 270_000


def test_a_dark_point_keeps_two_fifths_of_the_colour_of_its_plane() -> None:
    palette = np.array([plane_colour(k) for k in (-1, 0, 1)], dtype=np.float64)
    plane = np.array([-1, 0, 1, 1], np.int16)
    found = plane_colours(plane, palette, np.array([1.0, 0.0, 0.0, 0.5]))
    expected = [(1.0, -1), (0.4, 0), (0.4, 1), (0.7, 1)]
    wanted = [np.multiply(share, plane_colour(k)) for share, k in expected]
    np.testing.assert_allclose(found, wanted, atol=0.5001)


@pytest.mark.parametrize(
    ("index", "colour"),
    [
        (-1, (128, 128, 128)),
        (0, (255, 102, 102)),
        # Hues of 222 and 85 degrees: steps of the golden ratio round the circle.
        (1, (102, 147, 255)),
        (2, (191, 255, 102)),
    ],
)
def test_hues_of_planes_go_round_by_the_golden_ratio(
    index: int, colour: tuple[int, int, int]
) -> None:
    assert plane_colour(index) == colour


def test_deviations_go_from_blue_over_white_to_red() -> None:
    deviation_m = np.array([-0.02, -0.01, -0.004, 0.0, 0.004, 0.01, np.nan], dtype=np.float32)
    blue, white, red = (33, 102, 172), (247, 247, 247), (178, 24, 43)
    # Four tenths of the way from white.
    parts = [np.add(np.multiply(0.6, white), np.multiply(0.4, end)) for end in (blue, red)]
    expected = np.rint([blue, blue, parts[0], white, parts[1], red, (128, 128, 128)])
    np.testing.assert_array_equal(deviation_colours(deviation_m, 0.01), expected)
