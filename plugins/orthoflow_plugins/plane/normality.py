"""How close the deviations of a plane's points are to a normal distribution.

markiewicz2015 takes a plane as correct when its deviations look normal (Figures 6c to 14c). With a
million points every formal test rejects, so the departure itself is told: skewness, excess
kurtosis, shares within one, two and three standard deviations, and quantile against quantile.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.products import JsonValue

# Points that are too few to speak of a distribution.
_POINTS_LEAST: Final = 100
_PROBABILITIES: Final = (
    0.001, 0.0025, 0.005, 0.01, 0.025, *(0.05 * step for step in range(1, 20)),
    0.975, 0.99, 0.995, 0.9975, 0.999,
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Normality:
    """Shape of a distribution of distances.

    Attributes:
        mean_m: their mean.
        sigma_m: their standard deviation.
        skewness: third standardised moment, 0 for a normal distribution.
        excess_kurtosis: fourth standardised moment less 3, 0 for a normal distribution.
        within: shares within 1, 2 and 3 sigma of the mean; 0.683, 0.954, 0.997 if normal.
        expected_sigmas: (q,) quantiles of the normal distribution.
        found_sigmas: (q,) the same quantiles of the distances from their mean, over sigma.
    """

    mean_m: float
    sigma_m: float
    skewness: float
    excess_kurtosis: float
    within: tuple[float, ...]
    expected_sigmas: NDArray[np.float64]
    found_sigmas: NDArray[np.float64]

    def to_json(self) -> JsonValue:
        """Numbers for the planes' details."""
        return {
            "mean_m": self.mean_m,
            "sigma_m": self.sigma_m,
            "skewness": self.skewness,
            "excess_kurtosis": self.excess_kurtosis,
            "within_sigmas": list(self.within),
        }


def normality(histogram: NDArray[np.int64], *, find_m: float, fit_m: float) -> Normality | None:
    """Judge the distances that a histogram over -find_m..find_m holds within the fit tolerance.

    Returns:
        Their shape, or None where there are too few, or all in one bin.
    """
    edges_m = np.linspace(-find_m, find_m, len(histogram) + 1)
    middles_m = 0.5 * (edges_m[1:] + edges_m[:-1])
    held = np.abs(middles_m) <= fit_m
    counts, middles_m = histogram[held].astype(np.float64), middles_m[held]
    total = float(counts.sum())
    if total < _POINTS_LEAST:
        return None
    width_m = 2.0 * find_m / len(histogram)
    mean_m = float(counts @ middles_m) / total
    away_m = middles_m - mean_m
    second, third, fourth = (float(counts @ away_m**power) / total for power in (2, 3, 4))
    # Sheppard's corrections: within a bin, points spread over its width.
    fourth += -0.5 * second * width_m**2 + 7.0 / 240.0 * width_m**4
    second -= width_m**2 / 12.0
    if second <= 0.0:
        return None
    sigma_m = math.sqrt(second)
    below = np.concatenate([[0.0], np.cumsum(counts)]) / total
    rims_m = np.append(middles_m - 0.5 * width_m, middles_m[-1] + 0.5 * width_m)

    def share(reach: float) -> float:
        low, high = np.interp([mean_m - reach * sigma_m, mean_m + reach * sigma_m], rims_m, below)
        return float(high - low)

    quantiles_m = np.interp(_PROBABILITIES, below, rims_m)
    return Normality(
        mean_m=mean_m,
        sigma_m=sigma_m,
        skewness=third / sigma_m**3,
        excess_kurtosis=fourth / second**2 - 3.0,
        within=(share(1.0), share(2.0), share(3.0)),
        expected_sigmas=np.array([NormalDist().inv_cdf(p) for p in _PROBABILITIES]),
        found_sigmas=(quantiles_m - mean_m) / sigma_m,
    )
