"""Narrow gaps in a raster, as opposed to windows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def narrow_gaps(is_measured: NDArray[np.bool_], radius_cells: int) -> NDArray[np.int64]:
    """Find the void cells that are in narrow gaps.

    A gap is narrow if no disc with the given radius fits into it. The remaining void cells are the
    morphological opening of all void cells, so the shapes of windows and outlines do not change.
    Cells outside the raster count as void. Each cell found has a measured cell within the radius.

    Args:
        is_measured: (rows, cols) bool.
        radius_cells: radius of the disc; 0 finds no gaps.

    Returns:
        (k,) indices of the cells in row order, ascending.
    """
    import cv2

    if radius_cells == 0:
        return np.empty(0, dtype=np.int64)
    steps = np.arange(-radius_cells, radius_cells + 1)
    disc = (np.add.outer(steps**2, steps**2) <= radius_cells**2).astype(np.uint8)
    # Pad with void cells, so that discs may extend beyond the raster.
    void = np.pad((~is_measured).astype(np.uint8), radius_cells, constant_values=1)
    opened = cv2.morphologyEx(void, cv2.MORPH_OPEN, disc, borderType=cv2.BORDER_REPLICATE)
    inner = (slice(radius_cells, -radius_cells),) * 2
    return np.flatnonzero((np.asarray(opened)[inner] == 0) & ~is_measured)
