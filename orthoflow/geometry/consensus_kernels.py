"""Compiled scoring of hypotheses: how the distances of points to many planes are spread."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.point_kernels import compiled


@compiled
def distance_histograms(
    points: NDArray[np.float32],
    planes: NDArray[np.float32],
    reach_m: float,
    histograms: NDArray[np.int32],
) -> None:
    """Bin the distances of points to each of many planes.

    One table serves every score: its sum is the number of inliers, its moments give MSAC, its
    running sum the number within any smaller tolerance.

    Args:
        points: (3, m) metres.
        planes: (h, 4) normal and offset.
        reach_m: distances up to here are counted.
        histograms: (h, bins) points per bin of 0..reach; added to.
    """
    n_bins = histograms.shape[1]
    per_m, top = np.float32(n_bins / reach_m), np.float32(n_bins)
    xs, ys, zs = points[0], points[1], points[2]
    bins = np.empty(points.shape[1], dtype=np.int32)
    for h in range(planes.shape[0]):
        a, b, c = planes[h, 0] * per_m, planes[h, 1] * per_m, planes[h, 2] * per_m
        d = planes[h, 3] * per_m
        # Apart from the counting, so that the processor takes several points at once.
        for i in range(bins.size):
            bins[i] = np.int32(min(abs(a * xs[i] + b * ys[i] + c * zs[i] - d), top))
        for i in range(bins.size):
            if bins[i] < n_bins:
                histograms[h, bins[i]] += 1
