"""Rings of points in a plane."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def signed_area(ring: NDArray[np.float64]) -> float:
    """Area that a ring (n, 2), not closed, goes round (Gauss's formula), in its units squared.

    Positive where it turns from the first axis to the second. Far from the origin digits are lost:
    give places from one of its points.

    >>> signed_area(np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0]]))
    2.0
    """
    x, y = ring.T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))
