"""Rotations and a place that many tests share."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

UP_Z = np.array([0.0, 0.0, 1.0])
SURVEY_SHIFT_M = np.array([634512.347, 486215.781, 112.193])


def random_rotation(rng: np.random.Generator) -> NDArray[np.float64]:
    """A rotation matrix (3, 3), uniform over all rotations (QR of a Gaussian matrix)."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    rotation: NDArray[np.float64] = q if np.linalg.det(q) > 0 else -q
    return rotation


def rotation_about(axis: NDArray[np.float64], angle_deg: float) -> NDArray[np.float64]:
    """Rotation matrix (3, 3) about a unit vector (3,), right-handed (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = math.radians(angle_deg)
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross
