"""Shared by all detectors of key points: even coverage of a picture, and comparable descriptors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

# Squared RootSIFT entries in units of 1/512: their sums stay below 2^24, so that float32 products
# are exact, whatever the order a BLAS library adds in.
_QUANTA: Final = 512.0


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
