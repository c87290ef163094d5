"""Sides of outlines next to edges painted at known sub-cell positions."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.segment.outlines import Outline, moved_to_edges

SHAPE = (100, 120)
# Sides of the outline; an edge is painted near the left side.
LEFT, TOP, RIGHT, BOTTOM = 40.0, 20.0, 100.0, 80.0
CORNERS = np.array([[LEFT, TOP], [LEFT, BOTTOM], [RIGHT, BOTTOM], [RIGHT, TOP]])
HEIGHT = 60.0
# With the picture, no side is more accurate than half a cell.
SIGMA = 0.5


def outline(
    corners: NDArray[np.float64] = CORNERS,
    *,
    sigma: float | NDArray[np.float64] = 1.0,
    seen: float | NDArray[np.float64] = 1.0,
) -> Outline:
    count = len(corners)
    return Outline(
        corners=corners,
        sigma=np.broadcast_to(np.asarray(sigma, dtype=np.float64), count).copy(),
        seen_share=np.broadcast_to(np.asarray(seen, dtype=np.float64), count).copy(),
    )


def step_at(column: float, height: float = HEIGHT) -> NDArray[np.float64]:
    """Return a row of cells (columns,): `height` to the right of a position, 0 to the left."""
    return height * np.clip(np.arange(1, SHAPE[1] + 1) - column, 0.0, 1.0)


def picture(*rows: NDArray[np.float64], grey: float = 60.0) -> NDArray[np.float32]:
    """Return a picture whose rows are all the sum of given rows and a grey value."""
    return np.tile(grey + np.sum(rows, axis=0), (SHAPE[0], 1)).astype(np.float32)


def left_side(moved: tuple[Outline, NDArray[np.bool_]]) -> float | None:
    """Return the outward (leftward) shift of the left side; None if it was not moved."""
    if not moved[1][0]:
        np.testing.assert_array_equal(moved[0].corners[:2], CORNERS[:2])
        return None
    shifts = LEFT - moved[0].corners[:2, 0]
    assert shifts[0] == pytest.approx(shifts[1], abs=1e-9)
    return float(shifts[0])


@pytest.mark.parametrize("way", ["rises", "falls"])
@pytest.mark.parametrize("place", [-0.8, -0.25, 0.0, 0.1, 0.3, 0.9])
def test_a_side_moves_to_where_the_edge_was_painted(place: float, way: str) -> None:
    sign = 1.0 if way == "rises" else -1.0
    moved = moved_to_edges(outline(), picture(sign * step_at(LEFT + place), grey=120.0))
    # The tolerance is a tenth of a cell, because of partly covered cells.
    assert left_side(moved) == pytest.approx(-place, abs=0.1)
    assert moved[1].tolist() == [True, False, False, False]
    assert moved[0].sigma[0] == pytest.approx(SIGMA, abs=1e-9)
    np.testing.assert_array_equal(moved[0].sigma[1:], 1.0)
    np.testing.assert_allclose(moved[0].corners[2:], CORNERS[2:], atol=1e-9)


def test_a_blurred_edge_is_found_in_its_middle() -> None:
    from scipy.ndimage import gaussian_filter1d

    for place in (-0.1, 0.1, 0.2):
        soft = gaussian_filter1d(step_at(LEFT + place, 150.0), 0.9)
        moved = moved_to_edges(outline(), picture(soft))
        assert left_side(moved) == pytest.approx(-place, abs=0.08)


def has_moved(
    *rows: NDArray[np.float64],
    sigma: float = 1.0,
    seen: float | NDArray[np.float64] = 1.0,
    grey: float = 60.0,
) -> bool:
    moved = moved_to_edges(outline(sigma=sigma, seen=seen), picture(*rows, grey=grey))
    return left_side(moved) is not None


def test_only_sides_that_were_seen_and_that_depth_places_worse_move() -> None:
    edge = step_at(LEFT + 0.3)
    assert not has_moved(edge, seen=np.array([0.4, 1, 1, 1]))
    assert has_moved(edge, seen=np.array([0.6, 0, 0, 0]))
    assert not has_moved(edge, sigma=0.49)
    assert has_moved(edge, sigma=0.501)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_an_edge_farther_off_than_depth_errs_and_one_of_two_are_of_something_else(
    side: float,
) -> None:
    for sigma in (0.8, 1.0, 2.0):
        assert has_moved(step_at(LEFT + 1.35 * side), sigma=sigma) == (sigma > 0.9)
    for aside in (2.0, 3.0):
        for share in (0.5, 0.7):
            second = share * step_at(LEFT + aside * side)
            assert has_moved(step_at(LEFT), second) == (share < 0.6)
    # Edges beyond the profiles have no influence.
    assert has_moved(step_at(LEFT), 3.0 * step_at(LEFT + 6.0 * side))


def test_edges_have_four_grey_levels_and_are_three_times_as_steep_as_what_is_around() -> None:
    for height in (3.9, 4.1, -4.1):
        assert has_moved(step_at(LEFT, height)) == (abs(height) > 4.0)
    # Add a slope of ten grey levels per cell to the step.
    slope = 10.0 * np.arange(SHAPE[1])
    for height in (15.0, 25.0):
        assert has_moved(step_at(LEFT, height), slope, grey=-300.0) == (height > 20.0)


@pytest.mark.parametrize(("n_pieces", "is_moved"), [(5, True), (4, True), (3, False)])
def test_four_pieces_of_five_must_show_an_edge(n_pieces: int, is_moved: bool) -> None:
    grey = picture(step_at(LEFT))
    # Pieces have 10.4 rows, starting four cells from each end.
    first = round(TOP + 4.0 + 10.4 * n_pieces)
    grey[first:] = 60.0
    assert (left_side(moved_to_edges(outline(), grey)) is not None) == is_moved


@pytest.mark.parametrize(("share", "is_moved"), [(0.45, False), (0.55, True)])
def test_half_of_a_side_must_be_shown(share: float, is_moved: bool) -> None:
    grey = picture(step_at(LEFT))
    grey[round(TOP + 4.0 + 52.0 * share) :, 38:] = np.nan
    assert (left_side(moved_to_edges(outline(), grey)) is not None) == is_moved


def test_the_ends_of_a_side_and_what_lies_beyond_do_not_count() -> None:
    grey = picture(step_at(LEFT + 0.3))
    grey[: round(TOP) + 3, :] = np.nan
    grey[round(BOTTOM) - 3 :, :] = 255.0
    moved = moved_to_edges(outline(), grey)
    assert left_side(moved) == pytest.approx(-0.3, abs=0.03)
    # All profiles are complete and contain no void cells.
    assert moved[0].sigma[0] == pytest.approx(SIGMA, abs=1e-9)


def test_an_edge_that_wanders_is_as_exact_as_the_mean_of_its_pieces() -> None:
    slope = 0.03
    rows = np.arange(SHAPE[0]) + 0.5
    grey = np.stack([60.0 + step_at(LEFT + slope * (row - 50.0), 100.0) for row in rows])
    moved = moved_to_edges(outline(), grey.astype(np.float32))
    assert left_side(moved) == pytest.approx(0.0, abs=0.03)
    # Centres of five pieces, 10.4 rows apart.
    off = slope * 10.4 * np.arange(-2.0, 3.0)
    expected = np.hypot(SIGMA, np.std(off, ddof=1) / np.sqrt(5.0))
    assert moved[0].sigma[0] == pytest.approx(expected, abs=0.004)


@pytest.mark.parametrize(("turn_deg", "is_met"), [(12.0, False), (18.0, True), (-18.0, True)])
def test_corners_lie_on_the_moved_sides_unless_these_run_on_in_one_line(
    turn_deg: float, is_met: bool
) -> None:
    # The left side continues at a corner with a small change of direction.
    turn = np.radians(turn_deg)
    second = np.array([LEFT, 70.0]) + 10.0 * np.array([np.sin(turn), np.cos(turn)])
    corners = np.array([[LEFT, TOP], [LEFT, 70.0], second, [100.0, 70.0], [100.0, TOP]])
    moved = moved_to_edges(outline(corners), picture(step_at(LEFT + 0.3)))
    assert moved[1].tolist() == [True, False, False, False, False]
    shift = moved[0].corners[1] - corners[1]
    if is_met:
        # Test the moved side, and the next one, which was not moved.
        assert shift[0] == pytest.approx(0.3, abs=0.05)
        assert shift[0] * np.cos(turn) == pytest.approx(shift[1] * np.sin(turn), abs=1e-9)
    else:
        np.testing.assert_allclose(shift, [0.15, 0.0], atol=0.02)
    np.testing.assert_array_equal(moved[0].corners[2:4], corners[2:4])
