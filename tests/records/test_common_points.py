"""Comparisons over the check points that every method found."""

from __future__ import annotations

import numpy as np
import pytest

from orthoflow.products import Inspection
from orthoflow.records.tables import over_common_points


def inspection(
    shift_mm: dict[int, tuple[float, float]], kinds: tuple[str, ...] = ("flat",)
) -> Inspection:
    """Points by number, each with its displacement; even numbers are of the first kind."""
    names = np.array([*shift_mm], dtype=np.float64)
    return Inspection(
        wall=np.zeros(len(names), dtype=np.int32),
        points_world=np.column_stack([names, np.zeros_like(names), 0.1 * names]),
        displacement_m=1e-3 * np.array([*shift_mm.values()], dtype=np.float64).reshape(-1, 2),
        kind=(names % len(kinds)).astype(np.uint8),
        kinds=kinds,
        findings=(),
    )


def test_methods_are_compared_over_the_points_that_all_of_them_show() -> None:
    found = {
        # The second method loses the point that is far off.
        "points@a": inspection({1: (3.0, 4.0), 2: (0.0, 1.0), 3: (30.0, 0.0)}),
        "points@b": inspection({2: (0.0, 2.0), 1: (-3.0, 0.0), 4: (9.0, 9.0)}),
    }
    a, b = over_common_points(found, step="points")
    assert (a.cell, a.step, a.kind) == ("points@a", "points", "")
    assert (a.n_found, a.n_common, a.n_lost) == (b.n_found, b.n_common, b.n_lost) == (3, 2, 1)
    assert a.rms_u_mm == pytest.approx(np.sqrt(9.0 / 2))
    assert a.rms_v_mm == pytest.approx(np.sqrt(17.0 / 2))
    assert a.rms_mm == pytest.approx(np.sqrt(26.0 / 2))
    assert b.rms_mm == pytest.approx(np.sqrt(13.0 / 2))


def test_classes_of_points_are_compared_apart() -> None:
    kinds = ("flat", "edge")
    found = {
        "a": inspection({0: (1.0, 0.0), 1: (5.0, 0.0), 2: (2.0, 0.0)}, kinds),
        "b": inspection({0: (3.0, 0.0), 1: (4.0, 0.0)}, kinds),
    }
    rows = {(row.kind, row.cell): row for row in over_common_points(found)}
    assert {kind for kind, _ in rows} == {"", "edge", "flat"}
    assert rows["edge", "a"].rms_mm == pytest.approx(5.0)
    assert rows["flat", "b"].rms_mm == pytest.approx(3.0)
    assert rows["flat", "a"].n_lost == 1
