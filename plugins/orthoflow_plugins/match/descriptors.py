"""Descriptors that are each other's nearest, and clearly so.

The nearest ones are found exactly, by matrix products, or roughly, among those that are alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.rows import Rows

# Pairs whose descriptors are gathered at once: 2 x 32 MB.
_PAIRS_AT_ONCE: Final = 65_536
# Entries of a block of distances: 12 MB, which a processor's cache holds while they are searched.
_BLOCK_ENTRIES: Final = 3_000_000
# Of the nearest lists, so many are searched; a list holds some hundred descriptors.
_LISTS_PROBED: Final = 6
_LIST_SIZE: Final = 120
_LISTS_LEAST: Final = 2 * _LISTS_PROBED


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

    def pairs(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Possible pairs: indices into the first set and into the second."""
        from scipy.spatial import cKDTree

        near = cKDTree(self.first).sparse_distance_matrix(
            cKDTree(self.second), self.radius, p=np.inf, output_type="ndarray"
        )
        i, j = near["i"].astype(np.intp), near["j"].astype(np.intp)
        log_size = np.abs(self.first_log_size[i] - self.second_log_size[j])
        turn = np.abs(self.first_angle_deg[i] - self.second_angle_deg[j]) % 360.0
        turn = np.minimum(turn, 360.0 - turn)
        possible = (log_size <= self.log_size_most) & (turn <= self.angle_most_deg)
        return i[possible], j[possible]


def mutual_matches(
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    *,
    ratio_most: float,
    is_exact: bool,
) -> Matches:
    """Pair descriptors that are each other's nearest and clearly nearer than the next.

    Args:
        first: (n, d) whole numbers, small enough that products are exact in float32.
        second: (m, d) likewise.
        ratio_most: largest distance of the best over the distance of the second best (Lowe 2004).
        is_exact: whether all pairs are compared, or only those that are roughly alike.
    """
    if not (len(first) and len(second)):
        return _no_matches()
    search = two_nearest if is_exact else two_nearest_roughly
    found = search(first, second)
    ratio = _ratio(found.best, found.next_best)
    # Few are distinct, so that only they are looked up backwards.
    distinct = np.flatnonzero(ratio <= ratio_most)
    asked, place = np.unique(found.index[distinct], return_inverse=True)
    back = nearest(second[asked], first)[place]
    kept = distinct[back == distinct]
    return Matches(first=kept, second=found.index[kept], ratio=ratio[kept])


def best_matches(
    first: NDArray[np.float32], second: NDArray[np.float32], *, ratio_most: float
) -> Matches:
    """Pair each descriptor of the first set with its nearest in the second, in one direction.

    Args:
        first: (n, d) whole numbers, small enough that products are exact in float32.
        second: (m, d) likewise, at least one.
        ratio_most: largest distance of the best over the distance of the second best (Lowe 2004);
            1 for any.
    """
    found = two_nearest(first, second)
    ratio = _ratio(found.best, found.next_best)
    kept = np.flatnonzero(ratio <= ratio_most)
    return Matches(first=kept, second=found.index[kept], ratio=ratio[kept])


def mutual_matches_within(
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    window: Window,
    *,
    ratio_most: float,
) -> Matches:
    """Pair descriptors as `mutual_matches` does, as if there were no pairs but the possible ones.

    Args:
        first: (n, d) whole numbers, small enough that products are exact in float32.
        second: (m, d) likewise.
        window: only pairs inside it count, also as second best.
        ratio_most: largest distance of the best over the distance of the second best.
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
    ratio = _ratio(distances[best], next_best)
    backwards = np.lexsort((i, distances, j))
    back = backwards[np.flatnonzero(np.diff(j[backwards], prepend=-1))]
    is_back = np.zeros(len(i), dtype=np.bool_)
    is_back[back] = True
    kept = is_back[best] & (ratio <= ratio_most)
    return Matches(first=i[best[kept]], second=j[best[kept]], ratio=ratio[kept])


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
    found = _none_found(len(asked))
    for rows in _blocks(len(asked), len(among)):
        _keep_nearer(found, np.arange(rows.start, rows.stop), left[rows] @ right, None)
    return found


def two_nearest_roughly(asked: NDArray[np.float32], among: NDArray[np.float32]) -> TwoNearest:
    """Find the two nearest among those that are alike; now and then a nearer one is missed.

    An inverted file (Sivic & Zisserman 2003; Jegou et al. 2011): `among` is sorted into lists about
    some of its own members, and only the lists next to what is asked for are searched. Small sets
    are searched as `two_nearest` does.
    """
    n_lists = len(among) // _LIST_SIZE
    if n_lists < _LISTS_LEAST:
        return two_nearest(asked, among)
    middles = _middles(among, n_lists)
    list_of = nearest(among, middles)
    members = np.argsort(list_of, kind="stable")
    ends = np.cumsum(np.bincount(list_of, minlength=n_lists))
    left, right = _left(asked), _right(among)
    probed = _probed(left, middles)
    found = _none_found(len(asked))
    for number in range(n_lists):
        inside = members[ends[number - 1] if number else 0 : ends[number]]
        rows = np.flatnonzero((probed == number).any(axis=1))
        if inside.size and rows.size:
            _keep_nearer(found, rows, left[rows] @ right[:, inside], inside)
    return found


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


def _none_found(count: int) -> TwoNearest:
    far = np.full(count, np.inf, dtype=np.float32)
    return TwoNearest(index=np.zeros(count, dtype=np.intp), best=far, next_best=far.copy())


def _keep_nearer(
    found: TwoNearest,
    rows: NDArray[np.intp],
    distances: NDArray[np.float32],
    names: NDArray[np.intp] | None,
) -> None:
    """Enter distances (rows, columns) into what was found; `names` are the columns' indices."""
    own = np.arange(len(rows))
    column = distances.argmin(axis=1)
    best = distances[own, column]
    distances[own, column] = np.inf
    next_best = distances.min(axis=1)
    is_nearer = best < found.best[rows]
    found.next_best[rows] = np.where(
        is_nearer,
        np.minimum(found.best[rows], next_best),
        np.minimum(found.next_best[rows], best),
    )
    nearer = rows[is_nearer]
    found.best[nearer] = best[is_nearer]
    found.index[nearer] = (column if names is None else names[column])[is_nearer]


def _middles(among: NDArray[np.float32], n_lists: int) -> NDArray[np.float32]:
    """Members spread over the set, moved once to the mean of what is nearest to them."""
    chosen = among[np.floor(np.arange(n_lists) * len(among) / n_lists).astype(np.intp)]
    list_of = nearest(among, chosen)
    order = np.argsort(list_of, kind="stable")
    # Every member is nearest to itself or to its equal: lists of equals may stay empty.
    names, starts = np.unique(list_of[order], return_index=True)
    sums = np.add.reduceat(among[order].astype(np.float64), starts)
    counts = np.diff(np.append(starts, len(order)))[:, None]
    middles = chosen.copy()
    # Whole numbers again, so that products stay exact.
    middles[names] = np.rint(sums / counts)
    return middles


def _probed(left: NDArray[np.float32], middles: NDArray[np.float32]) -> NDArray[np.intp]:
    """Lists (n, p) nearest to each descriptor."""
    right = _right(middles)
    parts = [
        np.argpartition(left[rows] @ right, _LISTS_PROBED, axis=1)[:, :_LISTS_PROBED]
        for rows in _blocks(len(left), len(middles))
    ]
    return np.concatenate(parts)


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
