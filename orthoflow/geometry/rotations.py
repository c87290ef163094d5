"""Small rotations: from a vector to a matrix, and the cross product as a matrix."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


def rotation_from_vector(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrix (3, 3) of a rotation vector (3,) in radians (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    cross = cross_matrix(vector)
    if angle < 1e-8:
        return np.eye(3) + cross + 0.5 * cross @ cross
    first, second = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle**2
    return np.eye(3) + first * cross + second * cross @ cross


def cross_matrix(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matrix (3, 3) that multiplies like the cross product from the left with a vector (3,)."""
    matrix: NDArray[np.float64] = cross_matrices(vector[None])[0]
    return matrix


def cross_matrices(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matrices (n, 3, 3) that multiply like the cross product with vectors (n, 3)."""
    matrices = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    matrices[:, 0, 1], matrices[:, 0, 2] = -z, y
    matrices[:, 1, 0], matrices[:, 1, 2] = z, -x
    matrices[:, 2, 0], matrices[:, 2, 1] = -y, x
    return matrices
