"""Directions of up, and the axes of walls where up is any of them."""

from __future__ import annotations

import numpy as np
import pytest

from orthoflow.geometry import basis_from_up, up_vector, wall_axes
from orthoflow.geometry.frames import UP_VECTORS, UpDirection


@pytest.mark.parametrize("direction", UP_VECTORS, ids=str)
def test_the_frame_of_an_up_direction_is_right_handed(direction: UpDirection) -> None:
    basis = basis_from_up(up_vector(direction))
    np.testing.assert_allclose(basis @ basis.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(basis) == pytest.approx(1.0)
    np.testing.assert_array_equal(basis[2], up_vector(direction))
    if direction == "z":
        np.testing.assert_array_equal(basis, np.eye(3))


@pytest.mark.parametrize("direction", UP_VECTORS, ids=str)
def test_wall_axes_run_right_and_down_for_the_viewer(direction: UpDirection) -> None:
    up = up_vector(direction)
    normal = np.random.default_rng(0).normal(size=3)
    normal -= 0.95 * (normal @ up) * up  # a wall that leans a little
    normal /= np.linalg.norm(normal)
    u, v = wall_axes(normal, up)
    np.testing.assert_allclose(np.cross(u, v), -normal, atol=1e-12)
    assert u @ up == pytest.approx(0.0, abs=1e-12)  # horizontal
    assert v @ up < 0.0  # downwards
