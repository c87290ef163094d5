"""Compiled passes over the depths of a wall: bounds per block, and the surface without spikes."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part
from orthoflow_plugins.ortho.views import FINE_CELLS, NOTHING, NOTHING_M


@compiled
def bound_blocks(
    depth: NDArray[np.float32],
    bottoms: NDArray[np.float32],
    crests: NDArray[np.float32],
    first: int,
    end: int,
) -> None:
    """Set the lowest and the highest depth of some rows of blocks of `FINE_CELLS`.

    Args:
        depth: (rows, cols) metres, NaN where void.
        bottoms: (blocks, blocks) output, infinite in a void block.
        crests: (blocks, blocks) output, minus infinity in a void one.
        first: first row of blocks.
        end: the row of blocks after the last one.
    """
    columns = depth.shape[1]
    low, high = np.empty(columns, dtype=np.float32), np.empty(columns, dtype=np.float32)
    for block in range(first, end):
        low[:], high[:] = np.inf, -np.inf
        for row in range(block * FINE_CELLS, min(depth.shape[0], (block + 1) * FINE_CELLS)):
            heights = depth[row]
            # Comparisons with NaN are false: void changes nothing.
            for j in range(columns):
                low[j] = min(low[j], heights[j])
            for j in range(columns):
                high[j] = max(high[j], heights[j])
        for k in range(bottoms.shape[1]):
            lowest, highest = low[k * FINE_CELLS], high[k * FINE_CELLS]
            for j in range(k * FINE_CELLS, min(columns, (k + 1) * FINE_CELLS)):
                lowest, highest = min(lowest, low[j]), max(highest, high[j])
            bottoms[block, k], crests[block, k] = lowest, highest


@compiled
def make_occluding(
    depth: NDArray[np.float32],
    step_m: float,
    edge_m: float,
    occluding: NDArray[np.int16],
    tops: NDArray[np.float32],
    first: int,
    end: int,
) -> None:
    """Compute the surface that hides other cells: without spikes, and with full edges.

    Voids of one cell are closed, then cells higher than all 2 x 2 patches that contain them are
    lowered: a single outlier in front of a wall would cast a long shadow, which no real object
    casts. The position of an edge within its cell is unknown, and the cell's own points are on
    either side of it or between; so next to a step of more than `edge_m` the lower cell counts as
    high as the higher.

    Args:
        depth: (rows, cols) metres, NaN where void.
        step_m: unit of `occluding`.
        edge_m: minimum height of an edge.
        occluding: (rows, cols) output in some rows, `NOTHING` where void.
        tops: (blocks, blocks) output in some rows of blocks of `FINE_CELLS`: the highest of them in
            metres, `NOTHING_M` if all is void.
        first: first row of blocks.
        end: the row of blocks after the last one.
    """
    rows, columns = depth.shape
    first_row, end_row = first * FINE_CELLS, min(rows, end * FINE_CELLS)
    # Of the rows above, here and below, what the next row needs; with an additional cell on both
    # sides.
    closed = np.empty((2, columns + 2), dtype=np.float32)
    lowest = np.empty((2, columns + 2), dtype=np.float32)
    known = np.empty((2, columns + 2), dtype=np.float32)
    opened = np.empty((3, columns + 2), dtype=np.float32)
    high = np.empty(columns, dtype=np.float32)
    high[:] = NOTHING_M
    begin = max(first_row - 2, -1)
    _close(depth, max(begin, 0), known, closed[begin % 2])
    # A row needs those above and below it of `opened`, and a row of that itself and the one above
    # of `lowest`, a row of which needs itself and the next of `closed`. Above the first row and
    # below the last one the surface is extended.
    for row in range(begin, end_row + 1):
        now, other = row % 2, (row + 1) % 2
        if row < rows:
            _close(depth, min(row + 1, rows - 1), known, closed[other])
            _erode(closed[now], closed[other], lowest[now])
            if row >= max(first_row - 1, 0):
                _dilate(lowest[other if row > 0 else now], lowest[now], opened[row % 3])
        done = row - 1
        if done < first_row:
            continue
        above, below = opened[max(done - 1, 0) % 3], opened[min(row, rows - 1) % 3]
        _widen(above, opened[done % 3], below, edge_m, step_m, known, occluding[done])
        for j in range(columns):
            high[j] = max(high[j], known[1, j + 1])
        if (done + 1) % FINE_CELLS == 0 or done + 1 == rows:
            _bound(high, tops[done // FINE_CELLS])
            high[:] = NOTHING_M


@kernel_part
def _bound(high: NDArray[np.float32], tops: NDArray[np.float32]) -> None:
    """Set (blocks,) to the highest of each block of cells (cols,)."""
    for k in range(tops.size):
        top = high[k * FINE_CELLS]
        for j in range(k * FINE_CELLS, min(high.size, (k + 1) * FINE_CELLS)):
            top = max(top, high[j])
        tops[k] = top


@kernel_part
def _widen(
    above: NDArray[np.float32],
    here: NDArray[np.float32],
    below: NDArray[np.float32],
    edge_m: float,
    step_m: float,
    room: NDArray[np.float32],
    occluding: NDArray[np.int16],
) -> None:
    """Set a row to the highest of 3 x 3 cells where these are higher by an edge.

    Args:
        above: (cols + 2,) of the row above; the ends are not used.
        here: likewise.
        below: likewise, of the row below.
        edge_m: minimum height of a step.
        step_m: unit of `occluding`.
        room: (2, cols + 2), of which the second row is set.
        occluding: set.
    """
    n = here.size
    edge, per_step = np.float32(edge_m), np.float32(1.0 / step_m)
    floor = np.float32(NOTHING * step_m)
    above[0], here[0], below[0] = above[1], here[1], below[1]
    above[n - 1], here[n - 1], below[n - 1] = above[n - 2], here[n - 2], below[n - 2]
    highest, widened = room[0], room[1]
    for j in range(n):
        beside = max(above[j], below[j])
        highest[j] = max(beside, here[j])
    for j in range(1, n - 1):
        top = max(highest[j - 1], highest[j + 1])
        top = max(top, highest[j])
        widened[j] = top if top - here[j] > edge else here[j]
    for j in range(occluding.size):
        scaled = max(widened[j + 1], floor) * per_step
        occluding[j] = np.int16(np.int32(np.rint(scaled)))


@kernel_part
def _close(
    depth: NDArray[np.float32], row: int, known: NDArray[np.float32], closed: NDArray[np.float32]
) -> None:
    """Set (cols + 2,) to a row in which void cells are as high as the highest of their neighbours.

    Args:
        depth: (rows, cols).
        row: which.
        known: (2, cols + 2) working memory.
        closed: output; its ends repeat the first and the last cell.
    """
    rows, columns = depth.shape
    nothing = np.float32(NOTHING_M)
    here, highest = known[0], known[1]
    above, at, below = depth[max(row - 1, 0)], depth[row], depth[min(row + 1, rows - 1)]
    for j in range(columns):
        here[j + 1] = nothing if math.isnan(at[j]) else at[j]
    for j in range(columns):
        top = here[j + 1]
        top = max(top, above[j])
        highest[j + 1] = max(top, below[j])
    highest[0] = highest[columns + 1] = nothing
    for j in range(1, columns + 1):
        around = max(highest[j], highest[j - 1], highest[j + 1])
        closed[j] = around if here[j] == nothing else here[j]
    closed[0], closed[columns + 1] = closed[1], closed[columns]


@kernel_part
def _erode(
    upper: NDArray[np.float32], lower: NDArray[np.float32], lowest: NDArray[np.float32]
) -> None:
    """Set the lowest of each cell, the next in its row, and the two below them."""
    n = lowest.size
    for j in range(1, n - 1):
        here, beside = min(upper[j], lower[j]), min(upper[j + 1], lower[j + 1])
        lowest[j] = min(here, beside)
    lowest[0], lowest[n - 1] = lowest[1], lowest[n - 2]


@kernel_part
def _dilate(
    above: NDArray[np.float32], here: NDArray[np.float32], opened: NDArray[np.float32]
) -> None:
    """Set the highest of each cell, the one before it in its row, and the two above them."""
    for j in range(1, opened.size):
        highest, before = max(above[j], here[j]), max(above[j - 1], here[j - 1])
        opened[j] = max(highest, before)
