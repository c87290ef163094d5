"""When something is a target: how far it is looked for, how much of it counts, how alike it is."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.inspect import targets
from orthoflow_plugins.inspect.patches import GreyImage
from orthoflow_plugins.inspect.targets import find_crossing
from scipy.ndimage import gaussian_filter

SIDE = 120
CENTRE = np.array([60.0, 60.0])
RADIUS = 20.0


@cache
def quadrants(turned_deg: float = 20.0) -> NDArray[np.float64]:
    """Four quadrants about the middle, their borders a cell wide."""
    fine = (np.arange(4 * SIDE) + 0.5) / 4.0
    columns, rows = np.meshgrid(fine - CENTRE[0], fine - CENTRE[1])
    turn = np.radians(turned_deg)
    one = columns * np.cos(turn) + rows * np.sin(turn)
    other = rows * np.cos(turn) - columns * np.sin(turn)
    bright = gaussian_filter(np.where(one * other > 0.0, 220.0, 40.0), 2.0)
    return np.asarray(bright.reshape(SIDE, 4, SIDE, 4).mean(axis=(1, 3)))


def found(
    grey: NDArray[np.float64],
    near: tuple[float, float] = (60.0, 60.0),
    valid: NDArray[np.bool_] | None = None,
    *,
    search: float = 8.0,
) -> NDArray[np.float64] | None:
    known = np.ones(grey.shape, dtype=np.bool_) if valid is None else valid
    picture = GreyImage(grey=np.where(known, grey, 0.0), valid=known, region=known)
    return find_crossing(picture, np.array(near), search_cells=search, radius_cells=RADIUS)


@pytest.mark.parametrize("turned_deg", [0.0, 20.0, 45.0])
@pytest.mark.parametrize("near", [(60.0, 60.0), (64.4, 55.7), (53.0, 61.0)])
def test_the_crossing_is_found_from_wherever_it_is_looked_for(
    turned_deg: float, near: tuple[float, float]
) -> None:
    place = found(quadrants(turned_deg), near)
    assert place is not None
    np.testing.assert_allclose(place, CENTRE, atol=0.02)


@pytest.mark.parametrize(
    ("off", "is_found"), [(7.0, True), (-7.0, True), (14.0, False), (-14.0, False)]
)
@pytest.mark.parametrize("axis", [0, 1])
def test_nothing_is_found_farther_off_than_it_is_looked_for(
    off: float, is_found: bool, axis: int
) -> None:
    near = [60.0, 60.0]
    near[axis] += off
    assert (found(quadrants(), (near[0], near[1])) is not None) == is_found


def test_moved_pictures_move_the_crossing() -> None:
    for down, right in ((3, 0), (0, -4), (-5, 2)):
        moved = np.roll(quadrants(), (down, right), axis=(0, 1))
        place = found(moved)
        assert place is not None
        np.testing.assert_allclose(place - CENTRE, [right, down], atol=0.02)


def test_what_is_bright_and_dark_does_not_matter() -> None:
    for grey in (255.0 - quadrants(), 0.1 * quadrants() + 50.0):
        place = found(grey)
        assert place is not None
        np.testing.assert_allclose(place, CENTRE, atol=0.02)


def test_edges_discs_and_even_places_are_no_targets() -> None:
    rows, columns = np.mgrid[:SIDE, :SIDE] + 0.5
    edge = gaussian_filter(np.where(columns < 60.0, 40.0, 220.0), 0.7)
    disc = gaussian_filter(np.where(np.hypot(columns - 60, rows - 60) < 12.0, 40.0, 220.0), 0.7)
    # Two quadrants of four, and a saddle that half a turn leaves alone but a quarter does not.
    wedge = gaussian_filter(np.where((columns > 60.0) & (rows > 60.0), 220.0, 40.0), 0.7)
    for grey in (edge, disc, wedge, np.full((SIDE, SIDE), 90.0)):
        assert found(grey) is None


@pytest.mark.parametrize(("noise", "is_found"), [(60.0, True), (600.0, False)])
def test_a_target_is_alike_under_half_a_turn_and_swapped_under_a_quarter(
    noise: float, is_found: bool
) -> None:
    grey = quadrants() + np.random.default_rng(2).normal(scale=noise, size=(SIDE, SIDE))
    assert (found(grey) is not None) == is_found


@pytest.mark.parametrize(("share", "is_found"), [(0.8, True), (0.35, False)])
def test_half_of_a_target_must_be_there_on_both_sides(share: float, is_found: bool) -> None:
    # A strip through the middle; what lies across the middle from a void does not count either.
    rows = np.mgrid[:SIDE, :SIDE][0] + 0.5
    valid = np.abs(rows - 60.0) <= share * RADIUS
    assert (found(quadrants(), valid=valid) is not None) == is_found


def test_a_target_at_the_border_of_the_picture_is_found() -> None:
    cut = quadrants()[45:, :]
    place = found(cut, (60.0, 15.0), search=5.0)
    assert place is not None
    np.testing.assert_allclose(place - CENTRE, [0.0, -45.0], atol=0.1)


@pytest.mark.parametrize(("n_known", "is_known"), [(1, False), (2, False), (3, True)])
def test_grey_is_told_between_three_cells_in_a_row(n_known: int, is_known: bool) -> None:
    """A fifth of what a Gaussian of 1.2 cells looks at must be there."""
    valid = np.zeros((21, 21), dtype=np.bool_)
    valid[10, 9 : 9 + n_known] = True
    closed = targets._closed(np.where(valid, 80.0, 0.0), valid)
    assert closed.valid[10, 10] == is_known
    assert closed.grey[10, 10] == pytest.approx(80.0 if is_known else 0.0, abs=1e-3)


def test_slopes_go_on_through_voids() -> None:
    rows, columns = np.mgrid[:40, :40]
    grey = 3.0 * columns - 2.0 * rows + 90.0
    valid = np.random.default_rng(5).random((40, 40)) > 0.4
    closed = targets._closed(np.where(valid, grey, 0.0), valid)
    np.testing.assert_allclose(closed.grey[closed.valid], grey[closed.valid], atol=0.01)
    assert closed.valid[8:-8, 8:-8].all()
