"""How far apart the points of a scan lie on a wall."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def scan_step_m(count: NDArray[np.uint32], *, gsd_m: float) -> float:
    """Distance between neighbouring points on the wall, estimated from the points per cell.

    Cells are joined, 2 x 2, until a block that holds points holds at least four on average: from
    then on chance hardly leaves a block of scanned surface empty, so that the blocks show the
    scanned area.

    Args:
        count: (rows, cols) points per cell.
        gsd_m: side of a cell in metres.

    Returns:
        Side of the square that each point has for itself, metres; 0 without points.
    """
    # Sums over ever larger blocks stay below the number of points, which 32 bits hold.
    blocks, side_m = count, gsd_m
    while blocks.any():
        per_block = blocks.sum(dtype=np.int64) / np.count_nonzero(blocks)
        if per_block >= 4.0 or blocks.size == 1:
            return float(side_m / np.sqrt(per_block))
        rows, columns = blocks.shape
        even = blocks
        if rows % 2 or columns % 2:
            even = np.pad(blocks, ((0, rows % 2), (0, columns % 2)))
        blocks = even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2]
        side_m *= 2.0
    return 0.0
