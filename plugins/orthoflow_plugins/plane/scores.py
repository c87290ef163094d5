"""What a hypothesis is worth, from the histogram of its points' distances.

- count (Max-Consensus): the points within the tolerance.
- msac: a point within the tolerance counts 1 - (distance / tolerance)^2 (Torr and Zisserman 2000).
- a-contrario (AC-RANSAC): minus the logarithm of the number of false alarms that the tolerance with
  the fewest gives; the tolerance is an outcome (Moisan and Stival 2004; Moisan, Moulon, Monasse
  2012). The chance that a point of the background lies within a distance of the plane is the share
  of the scene's box that the slab fills.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

Scoring = Literal["count", "msac", "a-contrario"]

# Points that fix a plane, and a line in the plan.
MODEL_POINTS: Final[dict[str, int]] = {"3d": 3, "2d": 2}


@dataclass(frozen=True, kw_only=True)
class Scores:
    """What hypotheses are worth.

    Attributes:
        value: (h,) the larger the better; for a-contrario positive when meaningful.
        tolerance_m: (h,) tolerance within which the points speak for it.
        n_points: (h,) points within that.
    """

    value: NDArray[np.float64]
    tolerance_m: NDArray[np.float64]
    n_points: NDArray[np.int64]


def scores_of(
    histograms: NDArray[np.int32],
    scoring: Scoring,
    *,
    reach_m: float,
    n_points: int,
    extents_m: NDArray[np.float64],
    model_points: int,
) -> Scores:
    """Score hypotheses.

    Args:
        histograms: (h, bins) points per bin of distance, 0..reach.
        scoring: see module.
        reach_m: the tolerance; for a-contrario the largest that is considered.
        n_points: points that were asked.
        extents_m: (h,) extent of the scene's box along each normal.
        model_points: points that fix a model.
    """
    n_bins = histograms.shape[1]
    within = np.cumsum(histograms, axis=1, dtype=np.int64)
    if scoring == "a-contrario":
        return _fewest_false_alarms(within, reach_m, n_points, extents_m, model_points)
    value = within[:, -1].astype(np.float64)
    if scoring == "msac":
        middles = (np.arange(n_bins) + 0.5) / n_bins
        value = histograms @ (1.0 - middles**2)
    return Scores(
        value=value, tolerance_m=np.full(len(value), reach_m), n_points=within[:, -1].copy()
    )


def scores_of_sums(
    sums: NDArray[np.int64], scoring: Scoring, *, n_bins: int, reach_m: float
) -> Scores:
    """Score hypotheses as `scores_of` does, by count or msac, from what `consensus_sums` gives.

    Args:
        sums: (h, 2) see there.
        scoring: count or msac.
        n_bins: bins that the distances were put into.
        reach_m: the tolerance.
    """
    n_points = sums[:, 0].copy()
    value = sums[:, 1] / (4.0 * n_bins**2) if scoring == "msac" else n_points.astype(np.float64)
    return Scores(value=value, tolerance_m=np.full(len(value), reach_m), n_points=n_points)


def _fewest_false_alarms(
    within: NDArray[np.int64],
    reach_m: float,
    n_points: int,
    extents_m: NDArray[np.float64],
    model_points: int,
) -> Scores:
    n_bins = within.shape[1]
    tolerances_m = (np.arange(n_bins) + 1.0) * (reach_m / n_bins)
    k = np.maximum(within, model_points + 1).astype(np.float64)
    chance = np.minimum(2.0 * tolerances_m / np.maximum(extents_m[:, None], 1e-9), 1.0)
    log_alarms = (
        np.log(max(n_points - model_points, 1))
        + _log_choose(float(n_points), k)
        + _log_choose(k, float(model_points))
        + (k - model_points) * np.log(chance)
    )
    log_alarms = np.where(within > model_points, log_alarms, np.inf)
    best = np.argmin(log_alarms, axis=1)
    rows = np.arange(len(within))
    return Scores(
        value=-log_alarms[rows, best] / np.log(10.0),
        tolerance_m=tolerances_m[best],
        n_points=within[rows, best],
    )


def _log_choose(
    n: float | NDArray[np.float64], k: float | NDArray[np.float64]
) -> NDArray[np.float64]:
    from scipy.special import gammaln

    apart = gammaln(np.subtract(n, k) + 1.0)
    logarithm: NDArray[np.float64] = gammaln(np.add(n, 1.0)) - gammaln(np.add(k, 1.0)) - apart
    return logarithm
