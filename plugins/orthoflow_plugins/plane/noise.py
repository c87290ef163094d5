"""How noisy a cloud is, measured on its own flat places, before anything is known of its planes.

The points around a seed are fitted by a plane (principal components); their scatter across it is
noise where they are flat: spread at least five times as far along the plane as across it. Small
neighbourhoods show the noise of single points. Large ones show, too, errors that neighbouring
points share (a bent trajectory, stereo, scans that do not fit), but also relief: of them the
flatter quarter counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

_SEEDS: Final = 600
_RADII_M: Final = (0.05, 0.1, 0.2, 0.4, 0.8)
_LARGE_M: Final = 0.8
_LEAST_POINTS: Final = 12
_MOST_POINTS: Final = 400
# A neighbourhood is flat where it spreads that many times as far along its plane as across it.
_FLATNESS: Final = 5.0
# Fewer flat places do not speak for a cloud.
_LEAST_SEEDS: Final = 20
_QUARTER: Final = 0.25


@dataclass(frozen=True, kw_only=True)
class CloudNoise:
    """Noise of a cloud across its surfaces, standard deviations in metres.

    Attributes:
        single_m: of single points against their neighbours.
        shared_m: with errors that the points within 0.8 m share.
    """

    single_m: float
    shared_m: float


def measure_noise(points_m: NDArray[np.float64]) -> CloudNoise | None:
    """Measure the noise of a cloud on a sample of its points (n, 3); None where nothing is flat."""
    from scipy.spatial import cKDTree

    if len(points_m) < _LEAST_POINTS:
        return None
    tree = cKDTree(points_m)
    seeds = points_m[:: max(1, len(points_m) // _SEEDS)]
    single = np.full(len(seeds), np.nan)
    shared = np.full(len(seeds), np.nan)
    for radius_m in _RADII_M:
        open_seeds = np.flatnonzero(np.isnan(single) | (radius_m >= _LARGE_M))
        for k in open_seeds.tolist():
            near = tree.query_ball_point(seeds[k], radius_m)
            if len(near) < _LEAST_POINTS:
                continue
            chosen = points_m[near[:: max(1, len(near) // _MOST_POINTS)]]
            across_m = _flat_scatter_m(chosen)
            if across_m is None:
                continue
            if np.isnan(single[k]):
                single[k] = across_m
            if radius_m >= _LARGE_M:
                shared[k] = across_m
    known = single[np.isfinite(single)]
    if len(known) < _LEAST_SEEDS:
        return None
    single_m = float(np.median(known))
    large = shared[np.isfinite(shared)]
    is_known = len(large) >= _LEAST_SEEDS
    shared_m = float(np.quantile(large, _QUARTER)) if is_known else single_m
    return CloudNoise(single_m=single_m, shared_m=max(single_m, shared_m))


def _flat_scatter_m(points_m: NDArray[np.float64]) -> float | None:
    """Robust scatter across the plane of some points; None where they are not flat.

    The median deviation from the plane of principal components, 1.4826 times: a second surface or
    an edge among them widens the components, so such places fall out by the flatness.
    """
    relative = points_m - points_m.mean(axis=0)
    values, axes = np.linalg.eigh(relative.T @ relative / (len(points_m) - 3))
    if values[1] < _FLATNESS**2 * values[0]:
        return None
    across_m = relative @ axes[:, 0]
    return float(1.4826 * np.median(np.abs(across_m - np.median(across_m))))
