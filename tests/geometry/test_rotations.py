"""Rotation vectors and cross products against scipy's and numpy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from orthoflow.geometry.frames import (
    cross_matrices,
    cross_matrix,
    rotation_from_vector,
)

ANGLES = [0.0, 1e-9, 0.9e-8, 1.1e-8, 1e-3, 1.0, 3.0, np.pi, 4.0]


@pytest.mark.parametrize("angle", ANGLES)
def test_rotation_vectors_turn_about_themselves(angle: float) -> None:
    vector = angle * np.array([0.48, -0.6, 0.64])
    expected = Rotation.from_rotvec(vector).as_matrix()
    np.testing.assert_allclose(rotation_from_vector(vector), expected, atol=1e-15)


def test_cross_matrices_multiply_like_the_cross_product() -> None:
    first, second = np.random.default_rng(0).normal(size=(2, 7, 3))
    found = np.einsum("nij,nj->ni", cross_matrices(first), second)
    np.testing.assert_allclose(found, np.cross(first, second), atol=1e-14)
    np.testing.assert_array_equal(cross_matrix(first[3]), cross_matrices(first)[3])
