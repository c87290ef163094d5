"""Measures of scatter, and solutions of linear systems, that are robust to outliers."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

# Ratio of the standard deviation of a normal distribution to its median absolute deviation: 1 /
# Phi^-1(3/4).
NMAD_FACTOR: Final = 1.4826
# Median length of a vector with two standard normal components (Rayleigh distribution).
MEDIAN_LENGTH: Final = 1.1774
# Number of iterations for the L1 norm.
_ROUNDS: Final = 20
# Smaller residuals all have the same weight.
_FLOOR: Final = 0.01


def median_deviation(values: NDArray[np.floating], middle: float | None = None) -> float:
    """Return the NMAD: 1.4826 times the median absolute deviation.

    Args:
        values: at least one value.
        middle: value from which deviations are measured; None for the median.
    """
    middle = float(np.median(values)) if middle is None else middle
    return NMAD_FACTOR * float(np.median(np.abs(values - middle)))


def least_absolute(
    design: NDArray[np.float64], wanted: NDArray[np.float64], held: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Solve design @ x = wanted in the L1 norm, by least squares with weights of 1 / residual.

    Args:
        design: (n, k) design matrix.
        wanted: (n,) observations.
        held: (k,) regularisation weights; a larger weight keeps an unknown closer to 0.
    """
    weights = np.ones(len(wanted))
    solution: NDArray[np.float64] = np.zeros(design.shape[1])
    for _ in range(_ROUNDS):
        normal = design.T @ (design * weights[:, np.newaxis]) + np.diag(held)
        solution = np.asarray(np.linalg.solve(normal, design.T @ (weights * wanted)), np.float64)
        weights = 1.0 / np.maximum(np.abs(wanted - design @ solution), _FLOOR)
    return solution


_SAMPLES: Final = 300_000


def depth_noise_m(depth_m: NDArray[np.float32]) -> float:
    """Estimate the standard deviation of depths from second differences of neighbouring cells.

    Edges hardly affect the median of the differences. The result is 0 if the raster (rows, cols)
    has no three adjacent measured cells.
    """
    # Half of the differences are horizontal and half are vertical.
    step = max(1, 2 * depth_m.size // _SAMPLES)
    rows, middle = depth_m[::step], depth_m[1:-1:step]
    across = rows[:, :-2] - 2.0 * rows[:, 1:-1] + rows[:, 2:]
    down = depth_m[:-2:step] - 2.0 * middle + depth_m[2::step]
    bends = np.abs(np.concatenate([across.ravel(), down.ravel()]))
    n_known = int(np.count_nonzero(np.isfinite(bends)))
    if not n_known:
        return 0.0
    # Take the median of the known values; NaN is sorted last.
    half = n_known // 2
    bends = np.partition(bends, half)
    upper = float(bends[half])
    median = upper if n_known % 2 else (float(bends[:half].max()) + upper) / 2.0
    return median * NMAD_FACTOR / math.sqrt(6.0)
