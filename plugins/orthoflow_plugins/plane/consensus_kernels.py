"""Compiled scoring of hypotheses: how the distances of points to many planes are spread."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled
from orthoflow_plugins.plane.block_kernels import BLOCK_POINTS


@compiled
def consensus_sums(
    points: NDArray[np.float32],
    planes: NDArray[np.float32],
    reach_m: float,
    n_bins: int,
    sums: NDArray[np.int64],
) -> None:
    """Count the points near each of many planes, and how near they are, in bins of distance.

    Args:
        points: (3, m) metres.
        planes: (h, 4) normal and offset.
        reach_m: distances up to here are counted.
        n_bins: bins of 0..reach.
        sums: (h, 2) added to: points within reach, and 4 n^2 - (2 b + 1)^2 of the bin b of each,
            which is 4 n^2 (1 - d^2) with the distance d of its middle as a share of the reach.
    """
    per_m, top = np.float32(n_bins / reach_m), np.float32(n_bins)
    most, one = np.int32(4 * n_bins * n_bins), np.int32(1)
    last, nothing = np.int32(n_bins), np.int32(0)
    for h in range(planes.shape[0]):
        a, b, c = planes[h, 0] * per_m, planes[h, 1] * per_m, planes[h, 2] * per_m
        d = planes[h, 3] * per_m
        for start in range(0, points.shape[1], BLOCK_POINTS):
            stop = min(start + BLOCK_POINTS, points.shape[1])
            xs, ys, zs = points[0, start:stop], points[1, start:stop], points[2, start:stop]
            # Whole numbers of 32 bits, so that the processor takes several points at once.
            count, worth = nothing, nothing
            for i in range(xs.size):
                place = np.int32(min(abs(a * xs[i] + b * ys[i] + c * zs[i] - d), top))
                is_near = place < last
                middle = np.int32(place + place + one)
                count = np.int32(count + (one if is_near else nothing))
                here = np.int32(most - np.int32(middle * middle))
                worth = np.int32(worth + (here if is_near else nothing))
            sums[h, 0] += count
            sums[h, 1] += worth


@compiled
def distance_histograms(
    points: NDArray[np.float32],
    planes: NDArray[np.float32],
    reach_m: float,
    histograms: NDArray[np.int32],
) -> None:
    """Bin the distances of points to each of many planes.

    The running sum of a row is the number of points within any smaller tolerance.

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
