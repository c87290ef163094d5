"""Compiled passes over the depths of a wall: bounds per block, and the surface without spikes."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import kernel_part
from orthoflow.geometry.visibility_kernels import FINE_CELLS, NOTHING, NOTHING_M, compiled


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
        bottoms: (blocks, blocks) set, infinite in a void block.
        crests: (blocks, blocks) set, minus infinity in a void one.
        first: first row of blocks.
        end: the row of blocks after the last one.
    """
    columns = depth.shape[1]
    low, high = np.empty(columns, dtype=np.float32), np.empty(columns, dtype=np.float32)
    for block in range(first, end):
        low[:], high[:] = np.inf, -np.inf
        for row in range(block * FINE_CELLS, min(depth.shape[0], (block + 1) * FINE_CELLS)):
            heights = depth[row]
            # What is compared with NaN is false: void changes nothing.
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
def take_spikes_away(
    depth: NDArray[np.float32],
    step_m: float,
    occluding: NDArray[np.int16],
    tops: NDArray[np.float32],
    first: int,
    end: int,
) -> None:
    """Close voids of one cell, then take away what is higher than all 2 x 2 cells it is in.

    A single outlier in front of a wall would cast a long shadow, which nothing real casts.

    Args:
        depth: (rows, cols) metres, NaN where void.
        step_m: unit of `occluding`.
        occluding: (rows, cols) set in some rows, `NOTHING` where void.
        tops: (blocks, blocks) set in some rows of blocks of `FINE_CELLS` to the highest of them in
            metres, `NOTHING_M` where all is void.
        first: first row of blocks.
        end: the row of blocks after the last one.
    """
    rows, columns = depth.shape
    first_row, end_row = first * FINE_CELLS, min(rows, end * FINE_CELLS)
    # Of the rows above, here and below, what the next row needs; with a cell more on both sides.
    closed = np.empty((2, columns + 2), dtype=np.float32)
    lowest = np.empty((2, columns + 2), dtype=np.float32)
    known = np.empty((3, columns + 2), dtype=np.float32)
    high = np.empty(columns, dtype=np.float32)
    per_step, floor = np.float32(1.0 / step_m), np.float32(NOTHING * step_m)
    high[:] = NOTHING_M
    # A row of `lowest` needs that row and the next of `closed`, whose rows need three of `known`.
    for row in range(first_row - 1, end_row):
        if row == first_row - 1:
            _close(depth, max(row, 0), known, closed[0])
        else:
            closed[0, :] = closed[1]
            lowest[0, :] = lowest[1]
        _close(depth, min(row + 1, rows - 1), known, closed[1])
        _erode(closed[0], closed[1], lowest[1])
        if row < first_row:
            continue
        if row == 0:
            lowest[0, :] = lowest[1]
        opened = known[0]
        _dilate(lowest[0], lowest[1], opened)
        into = occluding[row]
        for j in range(columns):
            height = opened[j + 1]
            scaled = (max(height, floor)) * per_step
            into[j] = np.int16(np.int32(np.rint(scaled)))
        for j in range(columns):
            high[j] = max(high[j], opened[j + 1])
        if (row + 1) % FINE_CELLS == 0 or row + 1 == rows:
            block = row // FINE_CELLS
            for k in range(tops.shape[1]):
                top = high[k * FINE_CELLS]
                for j in range(k * FINE_CELLS, min(columns, (k + 1) * FINE_CELLS)):
                    top = max(top, high[j])
                tops[block, k] = top
            high[:] = NOTHING_M


@kernel_part
def _close(
    depth: NDArray[np.float32], row: int, known: NDArray[np.float32], closed: NDArray[np.float32]
) -> None:
    """Set (cols + 2,) a row in which void cells are as high as the highest of their neighbours.

    Args:
        depth: (rows, cols).
        row: which.
        known: (3, cols + 2) room.
        closed: set; its ends repeat the first and the last cell.
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
