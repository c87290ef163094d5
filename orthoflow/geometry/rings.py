"""Rings of points in a plane."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def signed_area(ring: NDArray[np.float64]) -> float:
    """Return the area enclosed by an open ring (n, 2) by Gauss's formula, in its units squared.

    Positive if it turns from the first axis to the second. Digits are lost far from the origin:
    pass coordinates relative to one of its points.

    >>> signed_area(np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0]]))
    2.0
    """
    x, y = ring.T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))
