"""Where on a wall to look for a photo: corners and crossings, evenly over what the photo shows."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow_plugins.match.channels import Channels

_APART_CELLS: Final = 5
_GRID: Final = 16


def texture(channels: Channels, *, half_patch_cells: int) -> NDArray[np.float32]:
    """How well the surroundings of each cell fix a displacement in both directions.

    The smaller eigenvalue of the gradients' second moments over the patch (Shi & Tomasi 1994),
    (rows, cols).
    """
    import cv2

    second = np.zeros((*channels.known.shape, 3), dtype=np.float32)
    for channel in range(channels.values.shape[2]):
        layer = np.ascontiguousarray(channels.values[:, :, channel])
        across = cv2.Scharr(layer, cv2.CV_32F, 1, 0)
        down = cv2.Scharr(layer, cv2.CV_32F, 0, 1)
        second += np.stack([across * across, across * down, down * down], axis=-1)
    second = np.asarray(cv2.GaussianBlur(second, (0, 0), 0.4 * half_patch_cells), dtype=np.float32)
    a, b, c = second[:, :, 0], second[:, :, 1], second[:, :, 2]
    return np.asarray(0.5 * (a + c) - np.sqrt(0.25 * (a - c) ** 2 + b * b), dtype=np.float32)


def textured_places(
    strength: NDArray[np.float32], usable: NDArray[np.bool_], n_most: int
) -> NDArray[np.intp]:
    """Cells (n, 2) = (column, row) with the most texture around them.

    The best are taken in turns from a grid, so that they cover the usable part evenly.

    Args:
        strength: (rows, cols) as `texture` gives it.
        usable: (rows, cols), where cells may be taken.
        n_most: at most so many.
    """
    import cv2

    response = np.where(usable, strength, 0.0).astype(np.float32)
    kernel = np.ones((_APART_CELLS, _APART_CELLS), dtype=np.uint8)
    peak = (response >= cv2.dilate(response, kernel)) & (response > 0.0)
    rows, columns = np.nonzero(peak)
    if not rows.size:
        return np.empty((0, 2), dtype=np.intp)
    chosen = _in_turns(rows, columns, response[rows, columns], n_most)
    return np.column_stack([columns[chosen], rows[chosen]])


def _in_turns(
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
    strength: NDArray[np.float32],
    n_most: int,
) -> NDArray[np.intp]:
    low_row, low_column = rows.min(), columns.min()
    side_rows = max(1.0, (rows.max() - low_row + 1) / _GRID)
    side_columns = max(1.0, (columns.max() - low_column + 1) / _GRID)
    cell = ((rows - low_row) / side_rows).astype(np.intp) * _GRID + (
        (columns - low_column) / side_columns
    ).astype(np.intp)
    order = np.lexsort((columns, rows, -strength, cell))
    turn = np.arange(len(order)) - np.searchsorted(cell[order], cell[order])
    taken = order[np.lexsort((columns[order], rows[order], -strength[order], turn))]
    return np.asarray(taken[:n_most], dtype=np.intp)
