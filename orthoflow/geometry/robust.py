"""Measures of scatter that single outliers do not change."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

# Standard deviation of a normal distribution per median absolute deviation: 1 / Phi^-1(3/4).
NMAD_FACTOR: Final = 1.4826
# Median length of a vector whose two components are normal with standard deviation 1 (Rayleigh).
MEDIAN_LENGTH: Final = 1.1774
# Iterations of weights for the L1 norm, and the residual with the largest weight.
_ROUNDS: Final = 20
_FLOOR: Final = 0.01


def median_deviation(values: NDArray[np.floating], middle: float | None = None) -> float:
    """Standard deviation as 1.4826 times the median absolute deviation (NMAD).

    Args:
        values: at least one.
        middle: deviations are taken from this value; None for the median.
    """
    middle = float(np.median(values)) if middle is None else middle
    return NMAD_FACTOR * float(np.median(np.abs(values - middle)))


def least_absolute(
    design: NDArray[np.float64], wanted: NDArray[np.float64], held: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Solve design x = wanted in the L1 norm, by least squares with weights of 1 / residual.

    Args:
        design: (n, k).
        wanted: (n,).
        held: (k,) weights that hold unknowns at 0.
    """
    weights = np.ones(len(wanted))
    solution: NDArray[np.float64] = np.zeros(design.shape[1])
    for _ in range(_ROUNDS):
        normal = design.T @ (design * weights[:, np.newaxis]) + np.diag(held)
        solution = np.asarray(np.linalg.solve(normal, design.T @ (weights * wanted)), np.float64)
        weights = 1.0 / np.maximum(np.abs(wanted - design @ solution), _FLOOR)
    return solution
