"""Nearest descriptors: exact by matrix products, or roughly among those that are alike."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

# Entries of a block of distances: 12 MB, which a processor's cache holds while they are searched.
_BLOCK_ENTRIES: Final = 3_000_000
# Of the nearest lists, so many are searched; a list holds some hundred descriptors.
_LISTS_PROBED: Final = 6
_LIST_SIZE: Final = 120
_LISTS_LEAST: Final = 2 * _LISTS_PROBED


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
    found = _nothing(len(asked))
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
    found = _nothing(len(asked))
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


def _nothing(count: int) -> TwoNearest:
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
