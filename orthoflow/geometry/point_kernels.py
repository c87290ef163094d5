"""Compiled passes over all points of a cloud: how many lie in each cell, and where blocks lie.

Kernels read float32 offsets as three contiguous arrays, in `BLOCK_POINTS` blocks. Work is split
into parts, one per thread, and everything summed across parts is an integer, so the result has the
same bits for any number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple, TypeVar, cast

import numba
import numpy as np
from numba import prange
from numpy.typing import NDArray

# Small enough that a block of a scan column is a short piece of one surface, so that its box tells
# most planes apart; large enough that boxes of 48 million points fit into the processor's cache.
BLOCK_POINTS: Final = 256

_Kernel = TypeVar("_Kernel", bound=Callable[..., object])


def compiled(function: _Kernel) -> _Kernel:
    """Compile a kernel for one thread; the compiled code is kept between processes."""
    return cast("_Kernel", numba.njit(cache=True)(function))


def compiled_parallel(function: _Kernel) -> _Kernel:
    """Compile a kernel whose `prange` loops use the threads of `use_threads`."""
    return cast("_Kernel", numba.njit(cache=True, parallel=True)(function))


def use_threads(cores: int) -> int:
    """Let parallel kernels use up to so many threads; gives how many there are."""
    threads = max(1, min(cores, int(numba.config.NUMBA_NUM_THREADS)))
    numba.set_num_threads(threads)
    return threads


class Offsets(NamedTuple):
    """Offsets of points from their cloud's origin, (n,) float32 metres each."""

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    z: NDArray[np.float32]


class BlockedPoints(NamedTuple):
    """Points as the passes that skip blocks take them; built by `blocked`.

    Attributes:
        x: (n,) float32 metres from the cloud's origin; y and z alike.
        boxes: (blocks, 6) float32, smallest and largest x, y, z of each block.
    """

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    z: NDArray[np.float32]
    boxes: NDArray[np.float32]


def read_only(x: NDArray[np.float32], y: NDArray[np.float32], z: NDArray[np.float32]) -> Offsets:
    """Give arrays, mapped files among them, in the one form that kernels are compiled for."""
    views = [np.asarray(values).view(np.ndarray) for values in (x, y, z)]
    for view in views:
        view.flags.writeable = False
    return Offsets(*views)


def blocked(offsets: Offsets, boxes: NDArray[np.float32]) -> BlockedPoints:
    """Join points and the boxes of their blocks."""
    return BlockedPoints(offsets.x, offsets.y, offsets.z, boxes)


@dataclass(frozen=True, kw_only=True)
class PlanGrid:
    """Where the cells of a plan (a map of the cloud seen from above) and its storeys lie.

    Attributes:
        basis: (3, 3) rows e1, e2, up (see `geometry.directions.basis_from_up`).
        low_m: (3,) lower corner in the (e1, e2, up) frame of the cloud's offsets, metres.
        cell_m: side of a cell, and height of a storey of the height histogram.
        shape: cells along e1, cells along e2, storeys along up.
    """

    basis: NDArray[np.float64]
    low_m: NDArray[np.float64]
    cell_m: float
    shape: tuple[int, int, int]


@dataclass(frozen=True, kw_only=True)
class PlanCounts:
    """How the points of a cloud spread over a plan.

    Attributes:
        cells: (cells along e1, cells along e2) int64, points per cell.
        heights: (storeys,) int64, points per storey of those that lie over the plan.
        boxes: (blocks, 6) float32, smallest and largest x, y, z offsets of each block.
        n_unusable: points that are NaN or infinite.
    """

    cells: NDArray[np.int64]
    heights: NDArray[np.int64]
    boxes: NDArray[np.float32]
    n_unusable: int


def plan_frame(grid: PlanGrid) -> NDArray[np.float32]:
    """(3, 4) that gives the cell along e1, along e2 and the storey of an offset: `f @ p - f3`."""
    frame = np.empty((3, 4), dtype=np.float32)
    frame[:, :3] = grid.basis / grid.cell_m
    frame[:, 3] = grid.low_m / grid.cell_m
    return frame


def count_over_plan(offsets: Offsets, grid: PlanGrid, *, parts: int) -> PlanCounts:
    """Count points per plan cell and per storey, and find the box of each block, in one pass."""
    n_blocks = -(-len(offsets.x) // BLOCK_POINTS)
    cells = np.zeros((parts, *grid.shape[:2]), dtype=np.int32)
    heights = np.zeros((parts, grid.shape[2]), dtype=np.int32)
    boxes = np.empty((n_blocks, 6), dtype=np.float32)
    unusable = np.zeros(parts, dtype=np.int64)
    _count_over_plan(offsets, plan_frame(grid), cells, heights, boxes, unusable)
    return PlanCounts(
        cells=cells.sum(axis=0, dtype=np.int64),
        heights=heights.sum(axis=0, dtype=np.int64),
        boxes=boxes,
        n_unusable=int(unusable.sum()),
    )


@compiled_parallel
def _count_over_plan(
    offsets: Offsets,
    frame: NDArray[np.float32],
    cells: NDArray[np.int32],
    heights: NDArray[np.int32],
    boxes: NDArray[np.float32],
    unusable: NDArray[np.int64],
) -> None:
    x, y, z = offsets.x, offsets.y, offsets.z
    parts, n_first, n_second = cells.shape
    n_storeys = heights.shape[1]
    n_blocks = boxes.shape[0]
    a0, a1, a2, a3 = frame[0, 0], frame[0, 1], frame[0, 2], frame[0, 3]
    b0, b1, b2, b3 = frame[1, 0], frame[1, 1], frame[1, 2], frame[1, 3]
    c0, c1, c2, c3 = frame[2, 0], frame[2, 1], frame[2, 2], frame[2, 3]
    zero = np.float32(0.0)
    top_first, top_second = np.float32(n_first), np.float32(n_second)
    top_storey = np.float32(n_storeys)
    for part in prange(parts):
        bad = 0
        for block in range(part * n_blocks // parts, (part + 1) * n_blocks // parts):
            start = block * BLOCK_POINTS
            stop = min(start + BLOCK_POINTS, x.size)
            x_low = x_high = x[start]
            y_low = y_high = y[start]
            z_low = z_high = z[start]
            for i in range(start, stop):
                px, py, pz = x[i], y[i], z[i]
                x_low, x_high = min(x_low, px), max(x_high, px)
                y_low, y_high = min(y_low, py), max(y_high, py)
                z_low, z_high = min(z_low, pz), max(z_high, pz)
                first = a0 * px + a1 * py + a2 * pz - a3
                second = b0 * px + b1 * py + b2 * pz - b3
                storey = c0 * px + c1 * py + c2 * pz - c3
                if not np.isfinite(first + second + storey):
                    bad += 1
                    continue
                if zero <= first < top_first and zero <= second < top_second:
                    cells[part, int(first), int(second)] += 1
                    if zero <= storey < top_storey:
                        heights[part, int(storey)] += 1
            boxes[block, 0], boxes[block, 1] = x_low, x_high
            boxes[block, 2], boxes[block, 3] = y_low, y_high
            boxes[block, 4], boxes[block, 5] = z_low, z_high
        unusable[part] = bad
