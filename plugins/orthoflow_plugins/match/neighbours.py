"""Nearest descriptors, exact: matrix products in blocks, several times as fast as brute force."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

# Rows per block: its products with 20 000 descriptors take 80 MB.
_BLOCK: Final = 1024


@dataclass(frozen=True, kw_only=True)
class Matches:
    """Pairs of descriptors.

    Attributes:
        first: (n,) index into the first set.
        second: (n,) index into the second set.
        ratio: (n,) distance of the best over the second best of the second set; 1 where there is
            no second best.
    """

    first: NDArray[np.intp]
    second: NDArray[np.intp]
    ratio: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.first)

    def take(self, chosen: NDArray[np.bool_]) -> Matches:
        """Give some of the pairs."""
        return Matches(
            first=self.first[chosen], second=self.second[chosen], ratio=self.ratio[chosen]
        )


@dataclass(frozen=True, kw_only=True)
class Window:
    """Which pairs are possible at all, from what is roughly known of the geometry.

    Attributes:
        first: (n, 2) positions of the first set.
        second: (m, 2) positions of the second set, where they are expected in the first's frame.
        radius: largest distance of a pair.
        first_log_size: (n,) float32 log2 of the sizes.
        second_log_size: (m,) float32, as expected in the first's frame.
        first_angle_deg: (n,) float32.
        second_angle_deg: (m,) float32, as expected in the first's frame.
        log_size_most: largest difference of log2 sizes.
        angle_most_deg: largest difference of angles.
    """

    first: NDArray[np.float32]
    second: NDArray[np.float32]
    radius: float
    first_log_size: NDArray[np.float32]
    second_log_size: NDArray[np.float32]
    first_angle_deg: NDArray[np.float32]
    second_angle_deg: NDArray[np.float32]
    log_size_most: float
    angle_most_deg: float

    def allows(self, rows: slice) -> NDArray[np.bool_]:
        """Which of the second set (columns) some of the first set (rows) may be paired with."""
        possible = np.abs(self.first[rows, None, 0] - self.second[:, 0]) <= self.radius
        possible &= np.abs(self.first[rows, None, 1] - self.second[:, 1]) <= self.radius
        # The rest only for the few that are near.
        i, j = np.nonzero(possible)
        start = rows.start
        log_size = np.abs(self.first_log_size[start + i] - self.second_log_size[j])
        turn = np.abs(self.first_angle_deg[start + i] - self.second_angle_deg[j]) % 360.0
        turn = np.minimum(turn, 360.0 - turn)
        possible[i, j] = (log_size <= self.log_size_most) & (turn <= self.angle_most_deg)
        return np.asarray(possible)


def mutual_matches(
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    *,
    ratio_most: float,
    window: Window | None = None,
) -> Matches:
    """Pair descriptors that are each other's nearest and clearly nearer than the next.

    Args:
        first: (n, d) whole numbers, small enough that products are exact in float32.
        second: (m, d) likewise.
        ratio_most: largest distance of the best over the distance of the second best (Lowe 2004).
        window: only pairs inside it count, also as second best.
    """
    if not (len(first) and len(second)):
        nothing = np.empty(0, dtype=np.intp)
        return Matches(first=nothing, second=nothing, ratio=np.empty(0))
    squares_first = (first * first).sum(axis=1)
    squares_second = (second * second).sum(axis=1)
    transposed = np.ascontiguousarray(second.T)
    n_first, n_second = len(first), len(second)
    nearest = np.empty(n_first, dtype=np.intp)
    best = np.empty(n_first, dtype=np.float32)
    next_best = np.full(n_first, np.inf, dtype=np.float32)
    back = np.zeros(n_second, dtype=np.intp)
    back_best = np.full(n_second, np.inf, dtype=np.float32)
    for start in range(0, n_first, _BLOCK):
        rows = slice(start, min(start + _BLOCK, n_first))
        distances = first[rows] @ transposed
        distances *= -2.0
        distances += squares_second
        distances += squares_first[rows, None]
        if window is not None:
            distances[~window.allows(rows)] = np.inf
        lowest = distances.min(axis=0)
        better = lowest < back_best
        back_best[better] = lowest[better]
        back[better] = start + distances[:, better].argmin(axis=0)
        index = distances.argmin(axis=1)
        own = np.arange(len(index))
        nearest[rows], best[rows] = index, distances[own, index]
        if n_second > 1:
            distances[own, index] = np.inf
            next_best[rows] = distances.min(axis=1)
    with np.errstate(invalid="ignore"):
        ratio = np.sqrt(np.maximum(best, 0.0) / np.maximum(next_best, 1e-12)).astype(np.float64)
    # The only candidate is distinct from nothing, and of two equal ones none is.
    ratio[~np.isfinite(next_best) | (next_best <= 0.0)] = 1.0
    ratio[~np.isfinite(best)] = np.inf
    kept = np.flatnonzero((back[nearest] == np.arange(n_first)) & (ratio <= ratio_most))
    return Matches(first=kept, second=nearest[kept], ratio=ratio[kept])
