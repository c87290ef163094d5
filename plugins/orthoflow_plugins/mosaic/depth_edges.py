"""Depth edges of a wall, where photos differ by parallax."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

_DEPTH_EDGE_M: Final = 0.03


def depth_edges(depth_m: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return cells whose right or lower neighbour is 3 cm nearer or farther."""
    edges = np.zeros(depth_m.shape, dtype=np.bool_)
    edges[:, :-1] |= np.abs(np.diff(depth_m, axis=1)) > _DEPTH_EDGE_M
    edges[:-1] |= np.abs(np.diff(depth_m, axis=0)) > _DEPTH_EDGE_M
    return edges


def depth_edges_in(depth_m: NDArray[np.float32], rows: slice) -> NDArray[np.bool_]:
    """Return cells of some rows on either side of a depth edge; neighbouring rows are included."""
    first = max(0, rows.start - 1)
    around = depth_m[first : rows.stop + 1]
    beside = depth_edges(around) | depth_edges(around[::-1, ::-1])[::-1, ::-1]
    return beside[rows.start - first :][: rows.stop - rows.start]
