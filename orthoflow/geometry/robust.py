"""Measures of scatter that single outliers do not change."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

# Standard deviation of a normal distribution per median absolute deviation: 1 / Phi^-1(3/4).
NMAD_FACTOR: Final = 1.4826
# Median length of a vector whose two components are normal with standard deviation 1 (Rayleigh).
MEDIAN_LENGTH: Final = 1.1774


def median_deviation(values: NDArray[np.floating], middle: float | None = None) -> float:
    """Standard deviation as 1.4826 times the median absolute deviation (NMAD).

    Args:
        values: at least one.
        middle: deviations are taken from this value; None for the median.
    """
    middle = float(np.median(values)) if middle is None else middle
    return NMAD_FACTOR * float(np.median(np.abs(values - middle)))
