"""How the points of each plane lie about it: number, spread, histogram and reach, in one pass."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.deviation_kernels import measure_deviations
from orthoflow.geometry.plane_kernels import HISTOGRAM_BINS, STEPS_PER_TOLERANCE
from orthoflow.geometry.point_kernels import each_part, piece_of
from orthoflow_plugins.plane.remainders import Remainder


@dataclass(frozen=True, kw_only=True)
class Deviations:
    """How far the points of each plane lie from it.

    Attributes:
        n_find: (k,) int64 points that belong to the plane.
        rms_find_m: (k,) root mean square of their distances.
        n_fit: (k,) int64 those of them within the fit tolerance.
        rms_fit_m: (k,) root mean square of the distances of those.
        mean_fit_m: (k,) mean of the distances of those.
        histogram: (k, bins) points per bin of -find_m..find_m.
        extents_m: (k, 4) smallest and largest u, smallest and largest v of the points within the
            fit tolerance in the plane's rectangle.
        find_m: find tolerance.
        fit_m: fit tolerance.
    """

    n_find: NDArray[np.int64]
    rms_find_m: NDArray[np.float64]
    n_fit: NDArray[np.int64]
    rms_fit_m: NDArray[np.float64]
    mean_fit_m: NDArray[np.float64]
    histogram: NDArray[np.int64]
    extents_m: NDArray[np.float64]
    find_m: float
    fit_m: float

    def reordered(self, order: NDArray[np.int64]) -> Deviations:
        """Give the planes in another order, as copies."""
        return Deviations(
            n_find=self.n_find[order],
            rms_find_m=self.rms_find_m[order],
            n_fit=self.n_fit[order],
            rms_fit_m=self.rms_fit_m[order],
            mean_fit_m=self.mean_fit_m[order],
            histogram=self.histogram[order],
            extents_m=self.extents_m[order],
            find_m=self.find_m,
            fit_m=self.fit_m,
        )


def measure_planes(
    remainder: Remainder,
    slabs: NDArray[np.float64],
    bounds_m: NDArray[np.float64],
    *,
    find_m: float,
    fit_m: float,
) -> Deviations:
    """Measure the deviations of all claimed points in one pass.

    Args:
        remainder: the cloud with its claims.
        slabs: (k, 12) the planes.
        bounds_m: (k, 4) their rectangles, smallest and largest u, smallest and largest v.
        find_m: find tolerance.
        fit_m: fit tolerance.
    """
    parts, count = remainder.parts, len(slabs)
    sums = np.zeros((parts, count, 6), dtype=np.int64)
    histogram = np.zeros((parts, count, HISTOGRAM_BINS), dtype=np.int64)
    extents = np.tile([np.inf, -np.inf, np.inf, -np.inf], (parts, count, 1))
    fit_m = min(fit_m, find_m)
    limits = np.column_stack([np.full(count, find_m), np.full(count, fit_m), bounds_m])

    def measure(part: int, piece: slice) -> None:
        measure_deviations(
            piece_of(remainder.points, piece),
            remainder.claims[piece],
            slabs,
            limits,
            sums[part],
            histogram[part],
            extents[part],
        )

    each_part(len(remainder.claims), parts, measure)
    total = sums.sum(axis=0)
    step_m = fit_m / STEPS_PER_TOLERANCE
    n_find, n_fit = total[:, 0], total[:, 3]
    low, high = extents.min(axis=0), extents.max(axis=0)
    reached = np.column_stack([low[:, 0], high[:, 1], low[:, 2], high[:, 3]])
    return Deviations(
        n_find=n_find,
        rms_find_m=np.sqrt(total[:, 2] / np.maximum(n_find, 1)) * step_m,
        n_fit=n_fit,
        rms_fit_m=np.sqrt(total[:, 5] / np.maximum(n_fit, 1)) * step_m,
        mean_fit_m=total[:, 4] / np.maximum(n_fit, 1) * step_m,
        histogram=histogram.sum(axis=0),
        # A later, nearer plane may have taken every point within the fit tolerance.
        extents_m=np.where(np.isfinite(reached), reached, bounds_m),
        find_m=find_m,
        fit_m=fit_m,
    )
