"""Regular openings, and layers of CAD files."""

from __future__ import annotations

import numpy as np
import pytest

from orthoflow.files.drawings.dxf import regular_opening
from tests.long_loops import seeds


def wobbled(outline: np.ndarray, seed: int, sd_m: float) -> np.ndarray:
    """An outline with a vertex every 5 cm, each moved at random."""
    points = []
    for begin, end in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        count = max(1, int(np.linalg.norm(end - begin) / 0.05))
        points += [begin + k / count * (end - begin) for k in range(count)]
    return np.array(points) + np.random.default_rng(seed).normal(0.0, sd_m, (len(points), 2))


@pytest.mark.parametrize("seed", seeds(5))
def test_a_window_with_uneven_sides_is_a_rectangle(seed: int) -> None:
    box = np.array([[1.0, 0.5], [2.2, 0.5], [2.2, 2.0], [1.0, 2.0]])
    found = regular_opening(wobbled(box, seed, 0.005), 0.005)
    assert found.kind == "rectangle"
    assert np.abs(found.outline_m - box).max() < 0.005
    assert 0.004 < found.deviation_m < 0.03


@pytest.mark.parametrize(("seed", "rise_m"), [(0, 0.6), (1, 0.3), (2, 0.15)])
def test_a_door_under_an_arch_is_one(seed: int, rise_m: float) -> None:
    half, spring = 0.6, 2.0
    radius = (half**2 + rise_m**2) / (2 * rise_m)
    angle = np.arcsin(half / radius)
    turns = np.linspace(angle, -angle, 40)
    arc = np.column_stack([np.sin(turns), np.cos(turns)]) * radius
    arc += [0.0, spring + rise_m - radius]
    door = np.vstack([[-half, 0.0], [half, 0.0], arc])
    found = regular_opening(wobbled(door, seed, 0.003), 0.003)
    assert found.kind == "arch"
    assert found.outline_m[:, 1].max() == pytest.approx(spring + rise_m, abs=0.012)
    assert found.deviation_m < 0.03


def test_what_is_neither_keeps_its_outline() -> None:
    star = np.array([[0.0, 0.0], [1.0, 0.3], [2.0, 0.0], [1.4, 0.8], [1.0, 2.0], [0.6, 0.8]])
    found = regular_opening(star, None)
    assert (found.kind, found.deviation_m) == ("outline", 0.0)
    np.testing.assert_array_equal(found.outline_m, star)
