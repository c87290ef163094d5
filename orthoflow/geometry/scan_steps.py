"""Estimate of the point spacing on a wall from a raster of counts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def scan_step_m(count: NDArray[np.uint32], *, gsd_m: float) -> float:
    """Estimate the distance between neighbouring points on the wall from the points per cell.

    Cells are joined 2 x 2 until a block that holds points holds at least four on average: from then
    on hardly any block of scanned surface is empty by chance, so that the blocks show the scanned
    area.

    Args:
        count: (rows, cols) points per cell.
        gsd_m: side of a cell in metres.

    Returns:
        Side of the square per point, metres; 0 without points.
    """
    # Sums over ever larger blocks stay below the number of points, which fits into 32 bits.
    blocks, side_m = count, gsd_m
    while blocks.any():
        per_block = blocks.sum(dtype=np.int64) / np.count_nonzero(blocks)
        if per_block >= 4.0 or blocks.size == 1:
            return float(side_m / np.sqrt(per_block))
        blocks = _joined(blocks)
        side_m *= 2.0
    return 0.0


def _joined(blocks: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Return sums of 2 x 2 blocks; a remaining row or column counts as it is."""
    rows, columns = blocks.shape
    sums = np.zeros((-(-rows // 2), -(-columns // 2)), dtype=np.uint32)
    for first_row in (0, 1):
        for first_column in (0, 1):
            quarter = blocks[first_row::2, first_column::2]
            sums[: quarter.shape[0], : quarter.shape[1]] += quarter
    return sums
