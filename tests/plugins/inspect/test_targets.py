"""When something is a target: how far it is looked for, how much of it counts, how alike it is."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
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


def test_edges_discs_and_even_places_are_no_targets() -> None:
    rows, columns = np.mgrid[:SIDE, :SIDE] + 0.5
    edge = gaussian_filter(np.where(columns < 60.0, 40.0, 220.0), 0.7)
    disc = gaussian_filter(np.where(np.hypot(columns - 60, rows - 60) < 12.0, 40.0, 220.0), 0.7)
    # Two quadrants of four, and a saddle that half a turn leaves alone but a quarter does not.
    wedge = gaussian_filter(np.where((columns > 60.0) & (rows > 60.0), 220.0, 40.0), 0.7)
    for grey in (edge, disc, wedge, np.full((SIDE, SIDE), 90.0)):
        assert found(grey) is None


@pytest.mark.parametrize(("share", "is_found"), [(0.8, True), (0.35, False)])
def test_half_of_a_target_must_be_there_on_both_sides(share: float, is_found: bool) -> None:
    # A strip through the middle; what lies across the middle from a void does not count either.
    rows = np.mgrid[:SIDE, :SIDE][0] + 0.5
    valid = np.abs(rows - 60.0) <= share * RADIUS
    assert (found(quadrants(), valid=valid) is not None) == is_found


@pytest.mark.parametrize("turned_deg", [0.0, 20.0, 33.0])
def test_the_centre_of_a_target_is_found_in_noise_and_holes(turned_deg: float) -> None:
    rng = np.random.default_rng(3)
    noisy = quadrants(turned_deg) + rng.normal(scale=6.0, size=(SIDE, SIDE))
    place = found(noisy, (55.0, 64.0), rng.random(noisy.shape) > 0.3)
    assert place is not None
    np.testing.assert_allclose(place, CENTRE, atol=0.06)  # cells
