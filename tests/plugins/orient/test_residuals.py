"""The table of residuals: every number against its definition, worked out by hand."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest
from orthoflow_plugins.orient.residuals import residual_rows

UNITS = {"px": 1.0, "mm": 2.5, "cell": 0.5}


def rows(residuals: np.ndarray, units: dict[str, float] = UNITS) -> dict[tuple[str, str], dict]:
    found = residual_rows("a", "check", residuals, units)
    return {(row.axis, row.unit): asdict(row) for row in found}


def test_numbers_are_those_of_their_definition() -> None:
    residuals = np.array([[1.0, 0.0], [-1.0, 0.0], [3.0, 2.0], [-1.0, 0.0], [-2.0, -2.0]])
    found = rows(residuals)["u", "px"]
    # u: mean 0, squares 1 + 1 + 9 + 1 + 4 = 16, cubes 1 - 1 + 27 - 1 - 8 = 18.
    assert found["n"] == 5
    assert found["mean"] == 0.0
    assert found["shift_p"] == 1.0
    assert found["sd"] == 2.0
    assert found["median"] == -1.0
    # Distances from the median: 2, 0, 4, 0, 1.
    assert found["nmad"] == pytest.approx(1.4826)
    assert found["skewness"] == pytest.approx((18.0 / 5.0) / (16.0 / 5.0) ** 1.5)
    assert found["rmse"] == pytest.approx(np.sqrt(3.2))
    assert found["p95"] == pytest.approx(2.8)
    assert found["max"] == 3.0


@pytest.mark.parametrize("seed", range(3))
def test_the_chance_of_a_mean_is_that_of_students_test(seed: int) -> None:
    from scipy import stats  # slow to import

    values = np.random.default_rng(seed).normal(0.2, 1.0, (40, 2))
    found = rows(values)
    for axis, column in zip("uv", values.T, strict=True):
        expected = stats.ttest_1samp(column, 0.0).pvalue
        assert found[axis, "px"]["shift_p"] == pytest.approx(expected, rel=1e-9)


def test_units_scale_lengths_and_nothing_else() -> None:
    found = rows(np.random.default_rng(0).normal(0.3, 1.0, (60, 2)))
    for name in ("mean", "sd", "median", "nmad", "rmse", "p95", "max"):
        assert found["v", "mm"][name] == pytest.approx(2.5 * found["v", "px"][name])
        assert found["v", "cell"][name] == pytest.approx(0.5 * found["v", "px"][name])
    for name in ("n", "shift_p", "skewness", "beyond_own", "beyond_cells", "beyond_any"):
        assert found["v", "mm"][name] == pytest.approx(found["v", "px"][name])


def test_shares_follow_their_three_conventions() -> None:
    residuals = np.zeros((20, 2))
    residuals[0, 0] = 5.0  # u: RMSE 1.118, so beyond; 5 px are 2.5 cells, so beyond
    residuals[1, 1] = 3.0  # v: RMSE 0.671, so beyond; 3 px are 1.5 cells, so not
    found = rows(residuals)
    assert (found["u", "px"]["beyond_own"], found["v", "px"]["beyond_own"]) == (0.05, 0.05)
    assert (found["u", "px"]["beyond_cells"], found["v", "px"]["beyond_cells"]) == (0.05, 0.0)
    assert found["u", "px"]["beyond_any"] == found["v", "px"]["beyond_any"] == 0.1


def test_without_a_cell_there_is_no_share_beyond_cells() -> None:
    found = rows(np.ones((3, 2)), {"px": 1.0})
    assert found["u", "px"]["beyond_cells"] is None
    assert found["u", "px"]["skewness"] is None
    assert found["u", "px"]["shift_p"] == 0.0


def test_one_residual_and_none() -> None:
    assert rows(np.array([[0.5, -0.5]]))["u", "px"]["shift_p"] is None
    assert residual_rows("a", "check", np.empty((0, 2)), UNITS) == []
