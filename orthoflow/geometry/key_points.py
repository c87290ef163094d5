"""Shared by all detectors of key points: even coverage of a picture, and pairs of descriptors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.rows import Rows

# Squared RootSIFT entries in units of 1/512: their sums stay below 2^24, so that float32 products
# are exact, whatever the order a BLAS library adds in.
_QUANTA: Final = 512.0
# Pairs whose descriptors are gathered at once: 2 x 32 MB.
_PAIRS_AT_ONCE: Final = 65_536
# Entries of a block of distances: 12 MB, which a processor's cache holds while they are searched.
_BLOCK_ENTRIES: Final = 3_000_000


def in_turns(
    cell: NDArray[np.intp], keys: Sequence[NDArray[np.floating] | NDArray[np.intp]], n_most: int
) -> NDArray[np.intp]:
    """Return positions (k,) of up to `n_most` of n items, in rotation from the cells of a grid.

    The selection covers what the cells cover; within a cell the first items are taken first.

    Args:
        cell: (n,) cell of each.
        keys: (n,) each, the sort keys; the last one is the primary key, as in `numpy.lexsort`.
        n_most: maximum number of items.
    """
    order = np.lexsort((*keys, cell))
    turn = np.arange(len(order)) - np.searchsorted(cell[order], cell[order])
    taken = order[np.lexsort((*(key[order] for key in keys), turn))]
    return np.asarray(taken[:n_most], dtype=np.intp)


def root_sift(raw: NDArray[np.float32]) -> NDArray[np.float32]:
    """RootSIFT of SIFT descriptors (n, 128) as whole numbers (Arandjelovic & Zisserman 2012).

    The Euclidean distance becomes Hellinger's.
    """
    total = np.maximum(raw.sum(axis=1, keepdims=True), 1e-9)
    rooted: NDArray[np.float32] = np.rint(np.sqrt(raw / total) * _QUANTA).astype(np.float32)
    return rooted


@dataclass(frozen=True, kw_only=True)
class Matches(Rows):
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


@dataclass(frozen=True, kw_only=True)
class Window:
    """Which pairs are possible at all, from what is roughly known of the geometry.

    Attributes:
        first: (n, 2) positions of the first set.
        second: (m, 2) positions of the second set, where they are expected in the first's frame.
        radius: largest difference of a pair's coordinates.
        first_log_size: (n,) float32 log2 of the sizes.
        second_log_size: (m,) float32, as expected in the first's frame.
        first_angle_deg: (n,) float32.
        second_angle_deg: (m,) float32, as expected in the first's frame.
        max_log_size: largest difference of log2 sizes.
        max_angle_deg: largest difference of angles.
    """

    first: NDArray[np.float32]
    second: NDArray[np.float32]
    radius: float
    first_log_size: NDArray[np.float32]
    second_log_size: NDArray[np.float32]
    first_angle_deg: NDArray[np.float32]
    second_angle_deg: NDArray[np.float32]
    max_log_size: float
    max_angle_deg: float

    def pairs(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Possible pairs: indices into the first set and into the second."""
        from scipy.spatial import cKDTree  # noqa: PLC0415 - few who load this need it

        near = cKDTree(self.first).sparse_distance_matrix(
            cKDTree(self.second), self.radius, p=np.inf, output_type="ndarray"
        )
        i, j = near["i"].astype(np.intp), near["j"].astype(np.intp)
        log_size = np.abs(self.first_log_size[i] - self.second_log_size[j])
        turn = np.abs(self.first_angle_deg[i] - self.second_angle_deg[j]) % 360.0
        turn = np.minimum(turn, 360.0 - turn)
        possible = (log_size <= self.max_log_size) & (turn <= self.max_angle_deg)
        return i[possible], j[possible]


def mutual_matches(
    first: NDArray[np.float32], second: NDArray[np.float32], *, ratio: float
) -> Matches:
    """Pair descriptors that are each other's nearest and clearly nearer than the next.

    Args:
        first: (n, d) whole numbers, small enough that products are exact in float32.
        second: (m, d) likewise.
        ratio: largest distance of the best over the distance of the second best (Lowe 2004).
    """
    if not (len(first) and len(second)):
        return _no_matches()
    found = two_nearest(first, second)
    ratios = _ratio(found.best, found.next_best)
    # Few are distinct, so that only they are looked up backwards.
    distinct = np.flatnonzero(ratios <= ratio)
    asked, place = np.unique(found.index[distinct], return_inverse=True)
    back = nearest(second[asked], first)[place]
    kept = distinct[back == distinct]
    return Matches(first=kept, second=found.index[kept], ratio=ratios[kept])


def best_matches(
    first: NDArray[np.float32], second: NDArray[np.float32], *, ratio: float
) -> Matches:
    """Pair each descriptor of the first set with its nearest in the second, in one direction.

    Args:
        first: (n, d) whole numbers, small enough that products are exact in float32.
        second: (m, d) likewise, at least one.
        ratio: largest distance of the best over the distance of the second best (Lowe 2004);
            1 for any.
    """
    found = two_nearest(first, second)
    ratios = _ratio(found.best, found.next_best)
    kept = np.flatnonzero(ratios <= ratio)
    return Matches(first=kept, second=found.index[kept], ratio=ratios[kept])


def mutual_matches_within(
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    window: Window,
    *,
    ratio: float,
) -> Matches:
    """Pair descriptors as `mutual_matches` does, as if there were no pairs but the possible ones.

    Args:
        first: (n, d) whole numbers, small enough that products are exact in float32.
        second: (m, d) likewise.
        window: only pairs inside it count, also as second best.
        ratio: largest distance of the best over the distance of the second best.
    """
    if not (len(first) and len(second)):
        return _no_matches()
    i, j = window.pairs()
    distances = _distances(first, second, i, j)
    order = np.lexsort((j, distances, i))
    starts = np.flatnonzero(np.diff(i[order], prepend=-1))
    best, following = order[starts], starts + 1
    has_next = np.append(starts[1:], len(order)) > following
    next_best = np.full(len(best), np.inf, dtype=np.float32)
    next_best[has_next] = distances[order[following[has_next]]]
    ratios = _ratio(distances[best], next_best)
    backwards = np.lexsort((i, distances, j))
    back = backwards[np.flatnonzero(np.diff(j[backwards], prepend=-1))]
    is_back = np.zeros(len(i), dtype=np.bool_)
    is_back[back] = True
    kept = is_back[best] & (ratios <= ratio)
    return Matches(first=i[best[kept]], second=j[best[kept]], ratio=ratios[kept])


@dataclass(frozen=True, kw_only=True)
class TwoNearest:
    """The two nearest of a set, for each descriptor that was asked for.

    Attributes:
        index: (n,) the nearest.
        best: (n,) float32 squared distance to it.
        next_best: (n,) float32 to the second nearest; inf where there is none.
    """

    index: NDArray[np.intp]
    best: NDArray[np.float32]
    next_best: NDArray[np.float32]


def two_nearest(asked: NDArray[np.float32], among: NDArray[np.float32]) -> TwoNearest:
    """Find the two nearest of `among` (m, d), at least one, for each of `asked` (n, d).

    Both are whole numbers, small enough that products are exact in float32.
    """
    left, right = _left(asked), _right(among)
    index = np.zeros(len(asked), dtype=np.intp)
    best, next_best = np.empty((2, len(asked)), dtype=np.float32)
    for rows in _blocks(len(asked), len(among)):
        distances = left[rows] @ right
        own, column = np.arange(len(distances)), distances.argmin(axis=1)
        index[rows], best[rows] = column, distances[own, column]
        distances[own, column] = np.inf
        next_best[rows] = distances.min(axis=1)
    return TwoNearest(index=index, best=best, next_best=next_best)


def nearest(asked: NDArray[np.float32], among: NDArray[np.float32]) -> NDArray[np.intp]:
    """Index (n,) of the nearest of `among` (m, d), at least one, for each of `asked` (n, d)."""
    left, right = _left(asked), _right(among)
    parts = [(left[rows] @ right).argmin(axis=1) for rows in _blocks(len(asked), len(among))]
    return np.concatenate([np.empty(0, dtype=np.intp), *parts])


def _distances(
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    i: NDArray[np.intp],
    j: NDArray[np.intp],
) -> NDArray[np.float32]:
    """Squared distances of pairs."""
    distances = np.empty(len(i), dtype=np.float32)
    for start in range(0, len(i), _PAIRS_AT_ONCE):
        some = slice(start, start + _PAIRS_AT_ONCE)
        apart = first[i[some]] - second[j[some]]
        distances[some] = np.einsum("ij,ij->i", apart, apart)
    return distances


def _ratio(best: NDArray[np.float32], next_best: NDArray[np.float32]) -> NDArray[np.float64]:
    ratio = np.sqrt(np.maximum(best, 0.0) / np.maximum(next_best, 1e-12)).astype(np.float64)
    # The only candidate is distinct from nothing, and of two equal ones none is.
    ratio[~np.isfinite(next_best) | (next_best <= 0.0)] = 1.0
    return ratio


def _no_matches() -> Matches:
    nothing = np.empty(0, dtype=np.intp)
    return Matches(first=nothing, second=nothing, ratio=np.empty(0))


def _left(descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Rows whose product with `_right` is the squared distance: (-2 a, |a|^2, 1) (b, 1, |b|^2)."""
    squares = (descriptors * descriptors).sum(axis=1)
    return np.column_stack([-2.0 * descriptors, squares, np.ones_like(squares)])


def _right(descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
    squares = (descriptors * descriptors).sum(axis=1)
    return np.vstack([descriptors.T, np.ones_like(squares), squares])


def _blocks(n_rows: int, n_columns: int) -> list[slice]:
    rows = max(1, _BLOCK_ENTRIES // n_columns)
    return [slice(start, min(start + rows, n_rows)) for start in range(0, n_rows, rows)]
