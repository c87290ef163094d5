"""Residuals of a run as its drawings show them: evenly chosen, and as long as people see."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.files.drawings import room_lines
from orthoflow.files.drawings.room_lines import Residuals


def residuals(shifts: NDArray[np.float64]) -> Residuals:
    count = len(shifts)
    inspection = SimpleNamespace(
        displacement_m=shifts,
        wall=np.arange(count, dtype=np.int32),
        points_world=np.arange(3.0 * count).reshape(-1, 3),
    )
    return room_lines._residuals("check", inspection)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("length_m", "times"),
    # A decimetre at most, but more than half of what a round number more would be.
    [(0.001, 50.0), (0.002, 25.0), (0.0011, 50.0), (0.1, 1.0), (0.3, 1.0), (0.0, 1.0)],
)
def test_residuals_are_enlarged_so_that_people_see_them(length_m: float, times: float) -> None:
    shifts = np.tile([0.6 * length_m, -0.8 * length_m], (40, 1))
    # One in twenty may be longer.
    shifts[7] *= 50.0
    found = residuals(shifts)
    assert found.times == pytest.approx(times)
    np.testing.assert_array_equal(found.displacement_m, shifts)
    assert found.cell == "check"


def test_residuals_that_are_not_known_are_left_out() -> None:
    shifts = np.full((6, 2), 0.001)
    shifts[[0, 4]] = np.nan
    shifts[2, 1] = np.nan
    found = residuals(shifts)
    assert found.wall.tolist() == [1, 3, 5]
    np.testing.assert_array_equal(found.points_world[:, 0], [3.0, 9.0, 15.0])
    nothing = residuals(np.full((3, 2), np.nan))
    assert (len(nothing.wall), nothing.times) == (0, 1.0)


@pytest.mark.parametrize(("count", "kept"), [(5000, 5000), (5001, 2501), (10_001, 3334)])
def test_five_thousand_residuals_are_drawn_evenly_over_all(count: int, kept: int) -> None:
    found = residuals(np.full((count, 2), 0.001))
    assert len(found.wall) == kept
    assert len(set(np.diff(found.wall))) == 1
