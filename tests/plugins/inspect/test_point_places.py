"""Where a check point lies on the surface that a wall has: on the plane through what is near it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.inspect.point_places import point_on_surface

from orthoflow.products import Wall
from tests.inspect_scenes import GSD_M, SHAPE, frame, walls

RADIUS_M = 0.04


def wall_with(depth_m: NDArray[np.float64]) -> Wall:
    return replace(walls().walls[0], depth_m=depth_m.astype(np.float32))


def slope(across: float, down: float, lift_m: float) -> NDArray[np.float64]:
    """Depths (rows, cols) of a plane: metres per cell across and down."""
    rows, cols = (np.arange(n) + 0.5 for n in SHAPE)
    return np.asarray(lift_m + across * cols[None, :] + down * rows[:, None])


@pytest.mark.parametrize(
    "place", [(180.5, 140.25), (11.0, 140.0), (4.2, 3.1), (356.5, 277.0), (100.0, 2.0)]
)
@pytest.mark.parametrize(("across", "down"), [(0.0, 0.0), (1e-4, -2e-4), (-3e-4, 1e-4)])
def test_a_place_on_a_slope_has_the_depth_of_the_slope_there(
    place: tuple[float, float], across: float, down: float
) -> None:
    wall = wall_with(slope(across, down, 0.03))
    found = point_on_surface(wall, np.array(place), RADIUS_M)
    depth = 0.03 + across * place[0] + down * place[1]
    expected = frame().world_from_wall(np.array([place]), np.array([depth]))[0]
    assert found is not None
    np.testing.assert_allclose(found, expected, atol=1e-7)  # metres; depths are float32


@pytest.mark.parametrize("radius_m", [0.016, 0.04])
def test_a_target_before_the_wall_is_where_it_is_not_where_the_wall_is(radius_m: float) -> None:
    depth = slope(0.0, 0.0, 0.0)
    rows, cols = np.indices(SHAPE) + 0.5
    from_place = np.hypot(cols - 180.5, rows - 140.5)
    depth[from_place <= 0.8 * radius_m / GSD_M] = 0.05
    found = point_on_surface(wall_with(depth), np.array([180.5, 140.5]), radius_m)
    expected = frame().world_from_wall(np.array([[180.5, 140.5]]), np.array([0.05]))[0]
    assert found is not None
    np.testing.assert_allclose(found, expected, atol=1e-7)


@pytest.mark.parametrize(("n_known", "is_found"), [(0, False), (11, False), (12, True)])
def test_twelve_depths_make_a_surface(n_known: int, *, is_found: bool) -> None:
    depth = np.full(SHAPE, np.nan)
    rows, cols = np.unravel_index(np.arange(n_known), (3, 4))
    depth[139 + rows, 179 + cols] = 0.02
    found = point_on_surface(wall_with(depth), np.array([181.0, 140.5]), RADIUS_M)
    assert (found is not None) == is_found


def test_what_lies_beyond_the_radius_has_no_say() -> None:
    depth = slope(0.0, 0.0, 0.01)
    rows, cols = np.indices(SHAPE) + 0.5
    depth[np.hypot(cols - 180.5, rows - 140.5) > RADIUS_M / GSD_M] = 0.015
    found = point_on_surface(wall_with(depth), np.array([180.5, 140.5]), RADIUS_M)
    expected = frame().world_from_wall(np.array([[180.5, 140.5]]), np.array([0.01]))[0]
    assert found is not None
    np.testing.assert_allclose(found, expected, atol=1e-7)
