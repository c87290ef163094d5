"""Paint of simulated surfaces: its noise, and what photos and lasers see of it."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.geometry import scene_rays
from orthoflow.geometry.scenes import TextureKind

SEED = 7


@numba.njit
def colour_at(kind: int, params: NDArray[np.float64], a: float, b: float) -> tuple[float, ...]:
    """Parts of kernels have no way in from Python."""
    return scene_rays.colour_at(kind, params, a, b)


@pytest.mark.parametrize("kind", list(TextureKind))
def test_colours_stay_within_what_a_photo_and_a_laser_tell(kind: TextureKind) -> None:
    params = np.array([250.0, 5.0, 120.0, 0.9, 1.0, 0.2, 3.0, 0.5])
    places = np.random.default_rng(SEED).uniform(0.0, 2.0, (400, 2))
    shades = np.array([colour_at(int(kind), params, a, b) for a, b in places])
    assert (shades[:, :3] >= 0.0).all()
    assert (shades[:, :3] <= 255.0).all()
    assert shades[:, 0].max() == 255.0
    assert (shades[:, 3] >= 0.01).all()
    assert (shades[:, 3] <= 1.0).all()
    # Without contrast nothing but the ground is left.
    plain = params * [1, 1, 1, 1, 0, 1, 1, 1]
    ground = np.array([colour_at(int(kind), plain, a, b) for a, b in places])
    np.testing.assert_allclose(ground, np.tile([250.0, 5.0, 120.0, 0.9], (400, 1)))


@pytest.mark.parametrize("gap", [0.0, 1.0])
def test_light_is_seen_by_eye_and_laser_alike_unless_there_is_a_gap(gap: float) -> None:
    params = np.array([120.0, 120.0, 120.0, 0.5, 0.3, 0.2, 3.0, gap])
    places = np.random.default_rng(SEED).uniform(0.0, 20.0, (2000, 2))
    shades = np.array([colour_at(0, params, a, b) for a, b in places])
    # Warmth takes from blue what it gives to red: their mean is the light alone.
    light = (shades[:, 0] + shades[:, 2]) / 2.0 / 120.0 - 1.0
    laser = shades[:, 3] / 0.5 - 1.0
    if gap == 0.0:
        np.testing.assert_allclose(laser, 0.9 * light, atol=1e-9)
    else:
        assert abs(np.corrcoef(light, laser)[0, 1]) < 0.5
    warm = (shades[:, 0] - shades[:, 2]) / 2.0
    np.testing.assert_allclose(shades[:, 1] / 120.0 - 1.0 - light, 0.3 * warm / 120.0, atol=1e-9)
