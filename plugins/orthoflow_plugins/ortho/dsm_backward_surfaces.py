"""What of a wall's surface hides what: its depth without spikes, bounds per block."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.visibility_kernels import BLOCK_CELLS, NOTHING_M, Relief
from orthoflow.products import Wall


def relief_of(wall: Wall) -> Relief:
    """Prepare a wall for looking at it from anywhere."""
    depth = np.asarray(wall.depth_m, dtype=np.float32).view(np.ndarray)
    occluding = _without_spikes(depth)
    known = np.where(np.isnan(depth), np.float32(np.inf), depth)
    tops = _per_block(occluding, NOTHING_M, largest=True)
    # Kernels are compiled once, for arrays that cannot be written to.
    for array in (depth := depth[:], occluding):
        array.flags.writeable = False
    return Relief(
        depth=depth,
        occluding=occluding,
        tops=_highest_around(tops),
        bottoms=_per_block(known, np.inf, largest=False),
        highest_m=float(occluding.max(initial=NOTHING_M)),
    )


def _without_spikes(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Close voids of one cell, then take away what is higher than all 2 x 2 cells it is in.

    A single outlier in front of a wall would cast a long shadow, which nothing real casts.
    """
    import cv2

    known = np.where(np.isnan(depth), np.float32(NOTHING_M), depth)
    around = cv2.dilate(known, np.ones((3, 3), dtype=np.uint8))
    closed = np.where(known == np.float32(NOTHING_M), around, known)
    square = np.ones((2, 2), dtype=np.uint8)
    lowest = cv2.erode(closed, square, anchor=(0, 0), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(
        cv2.dilate(lowest, square, anchor=(1, 1), borderType=cv2.BORDER_REPLICATE),
        dtype=np.float32,
    )


def _per_block(values: NDArray[np.float32], fill: float, *, largest: bool) -> NDArray[np.float32]:
    rows, columns = values.shape
    n_rows, n_columns = -(-rows // BLOCK_CELLS), -(-columns // BLOCK_CELLS)
    reduce = np.maximum if largest else np.minimum
    blocks = np.full((n_rows, n_columns), fill, dtype=np.float32)
    starts = np.arange(n_columns) * BLOCK_CELLS
    for block in range(n_rows):
        strip = values[block * BLOCK_CELLS : (block + 1) * BLOCK_CELLS]
        blocks[block] = reduce.reduceat(reduce.reduce(strip, axis=0), starts)
    return blocks


def _highest_around(tops: NDArray[np.float32]) -> NDArray[np.float32]:
    padded = np.pad(tops, 1, constant_values=NOTHING_M)
    rows, columns = tops.shape
    shifted = [padded[i : i + rows, j : j + columns] for i in range(3) for j in range(3)]
    return np.asarray(np.maximum.reduce(shifted), dtype=np.float32)
