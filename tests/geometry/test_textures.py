"""Paint of simulated surfaces: its noise, and what photos and lasers see of it."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numba
import numpy as np
import pytest

from orthoflow.geometry import scene_rays
from orthoflow.geometry.scenes import TextureKind
from tests.long_loops import seeds

SEED = 7
# splitmix64 of seed 0: the first numbers of its reference implementation (Vigna 2015).
REFERENCE = (0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F)


def callable_from_python(name: str) -> Callable[..., Any]:
    """Parts of kernels have no way in from Python: give one that has."""
    part = getattr(scene_rays, name)

    @numba.njit
    def call(*arguments: Any) -> Any:
        return part(*arguments)

    return call  # type: ignore[no-any-return]


PARTS = (
    *("mixed_bits", "uniform", "cell_state", "_column_state", "_lattice_value", "_value_noise"),
    *("_stains", "colour_at"),
)
tk = SimpleNamespace(**{name: callable_from_python(name) for name in PARTS})


@pytest.mark.parametrize("draw", seeds(3))
def test_numbers_are_those_of_splitmix64(draw: int) -> None:
    state = (draw + 1) * 0x9E3779B97F4A7C15 % 2**64
    assert int(tk.mixed_bits(np.uint64(state))) == REFERENCE[draw]
    assert tk.uniform(np.uint64(0), draw) == (REFERENCE[draw] >> 11) / 2**53


def test_cells_of_a_lattice_have_states_of_their_own() -> None:
    states = [
        int(tk.cell_state(i, j, s)) for i in range(-3, 4) for j in range(-3, 4) for s in (1, 2)
    ]
    assert len(set(states)) == len(states)
    for i, j in ((0, 0), (-2, 5), (3, -1)):
        value = tk._lattice_value(np.uint64(tk._column_state(i, SEED)), j)
        assert (value * 2**53) == int(tk.cell_state(i, j, SEED)) >> 11
        assert 0.0 <= value < 1.0


def lattice(i: int, j: int) -> float:
    """Number -1..1 of a lattice point."""
    return 2.0 * float(tk._lattice_value(np.uint64(tk._column_state(i, SEED)), j)) - 1.0


def noise(a: float, b: float, seed: int = SEED) -> float:
    return float(tk._value_noise(a, b, seed))


@pytest.mark.parametrize("i", [-2, 0, 3])
@pytest.mark.parametrize("j", [-1, 4])
def test_noise_is_smooth_between_the_numbers_of_its_lattice(i: int, j: int) -> None:
    corners = [[lattice(i + k, j + m) for m in (0, 1)] for k in (0, 1)]
    assert noise(i, j) == pytest.approx(corners[0][0])
    assert noise(i + 0.5, j + 0.5) == pytest.approx(np.mean(corners))
    # The quintic smoothstep 6 s^5 - 15 s^4 + 10 s^3 is 106 / 1024 at a quarter.
    s = 106.0 / 1024.0
    assert noise(i + 0.25, j) == pytest.approx((1 - s) * corners[0][0] + s * corners[1][0])
    assert noise(i, j + 0.25) == pytest.approx((1 - s) * corners[0][0] + s * corners[0][1])
    assert noise(i + 1, j + 0.75) == pytest.approx(s * corners[1][0] + (1 - s) * corners[1][1])
    # Neither slope nor bend at the lattice, from either side.
    for step in (-1e-3, 1e-3):
        assert noise(i + step, j) == pytest.approx(noise(i, j), abs=1e-7)
        assert noise(i, j + step) == pytest.approx(noise(i, j), abs=1e-7)


def test_stains_are_three_octaves_that_scale_with_their_period() -> None:
    octaves = (
        0.5 * noise(1.25, 0.5, SEED)
        + 0.3 * noise(2.7 * 1.25 + 7.3, 2.7 * 0.5 + 1.9, SEED + 1)
        + 0.2 * noise(6.1 * 1.25 + 3.1, 6.1 * 0.5 + 5.7, SEED + 2)
    )
    for period in (0.2, 1.0, 3.0):
        found = tk._stains(1.25 * period, 0.5 * period, period, SEED)
        assert found == pytest.approx(octaves)


@pytest.mark.parametrize("kind", list(TextureKind))
def test_colours_stay_within_what_a_photo_and_a_laser_tell(kind: TextureKind) -> None:
    params = np.array([250.0, 5.0, 120.0, 0.9, 1.0, 0.2, 3.0, 0.5])
    places = np.random.default_rng(SEED).uniform(0.0, 2.0, (400, 2))
    shades = np.array([tk.colour_at(int(kind), params, a, b) for a, b in places])
    assert (shades[:, :3] >= 0.0).all()
    assert (shades[:, :3] <= 255.0).all()
    assert shades[:, 0].max() == 255.0
    assert (shades[:, 3] >= 0.01).all()
    assert (shades[:, 3] <= 1.0).all()
    # Without contrast nothing but the ground is left.
    plain = params * [1, 1, 1, 1, 0, 1, 1, 1]
    ground = np.array([tk.colour_at(int(kind), plain, a, b) for a, b in places])
    np.testing.assert_allclose(ground, np.tile([250.0, 5.0, 120.0, 0.9], (400, 1)))


@pytest.mark.parametrize("gap", [0.0, 1.0])
def test_light_is_seen_by_eye_and_laser_alike_unless_there_is_a_gap(gap: float) -> None:
    params = np.array([120.0, 120.0, 120.0, 0.5, 0.3, 0.2, 3.0, gap])
    places = np.random.default_rng(SEED).uniform(0.0, 20.0, (2000, 2))
    shades = np.array([tk.colour_at(0, params, a, b) for a, b in places])
    # Warmth takes from blue what it gives to red: their mean is the light alone.
    light = (shades[:, 0] + shades[:, 2]) / 2.0 / 120.0 - 1.0
    laser = shades[:, 3] / 0.5 - 1.0
    if gap == 0.0:
        np.testing.assert_allclose(laser, 0.9 * light, atol=1e-9)
    else:
        assert abs(np.corrcoef(light, laser)[0, 1]) < 0.5
    warm = (shades[:, 0] - shades[:, 2]) / 2.0
    np.testing.assert_allclose(shades[:, 1] / 120.0 - 1.0 - light, 0.3 * warm / 120.0, atol=1e-9)
