"""Points in blocks with a box each, and what one pass over a cloud counts over its plan.

Kernels read float32 offsets as three contiguous arrays, in `BLOCK_POINTS` blocks. Work is split
into parts, one per thread, each with tables of its own; everything summed across parts is an
integer, so the result has the same bits for any number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part
from orthoflow.geometry.point_kernels import Offsets
from orthoflow.geometry.threads import even_parts, in_threads

# Small enough that a block of a scan column is a short piece of one surface, so that its box tells
# most planes apart; large enough that boxes of 48 million points fit into the processor's cache.
BLOCK_POINTS: Final = 256


def each_part(n_items: int, parts: int, task: Callable[[int, slice], None]) -> None:
    """Cut a range into parts at multiples of `BLOCK_POINTS` and run a task on each, in threads.

    Args:
        n_items: length of the range.
        parts: into how many parts; some may be empty.
        task: gets the number of the part and its piece of the range.
    """
    pieces = even_parts(n_items, parts, multiple=BLOCK_POINTS)
    in_threads([partial(task, part, piece) for part, piece in enumerate(pieces)])


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


def blocked(offsets: Offsets, boxes: NDArray[np.float32]) -> BlockedPoints:
    """Join points and the boxes of their blocks."""
    return BlockedPoints(offsets.x, offsets.y, offsets.z, boxes)


def piece_of(points: BlockedPoints, piece: slice) -> BlockedPoints:
    """Give a piece of the points that starts at a block."""
    blocks = slice(piece.start // BLOCK_POINTS, -(-piece.stop // BLOCK_POINTS))
    return BlockedPoints(points.x[piece], points.y[piece], points.z[piece], points.boxes[blocks])


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
class Boxes:
    """Where the blocks of a cloud lie.

    Attributes:
        boxes: (blocks, 6) float32, smallest and largest x, y, z offsets of each block.
        n_unusable: sides of boxes that are NaN or infinite.
    """

    boxes: NDArray[np.float32]
    n_unusable: int


@dataclass(frozen=True, kw_only=True)
class PlanCounts:
    """How the points of a cloud spread over a plan.

    Attributes:
        cells: (cells along e1, cells along e2) int64, points per cell.
        heights: (storeys,) int64, points per storey of those that lie over the plan.
        boxed: where the blocks lie.
    """

    cells: NDArray[np.int64]
    heights: NDArray[np.int64]
    boxed: Boxes


def box_blocks(offsets: Offsets, *, parts: int) -> Boxes:
    """Find the box of each block of points, in one pass."""
    n_points = len(offsets.x)
    boxes = np.empty((-(-n_points // BLOCK_POINTS), 6), dtype=np.float32)
    unusable = np.zeros(parts, dtype=np.int64)

    def find(part: int, piece: slice) -> None:
        points = piece_of(blocked(offsets, boxes), piece)
        unusable[part] = _set_boxes(points, points.boxes.view(np.int32))

    each_part(n_points, parts, find)
    return Boxes(boxes=boxes, n_unusable=int(unusable.sum()))


def plan_frame(grid: PlanGrid) -> NDArray[np.float32]:
    """(3, 4) that gives the cell along e1, along e2 and the storey of an offset: `f @ p - f3`."""
    frame = np.empty((3, 4), dtype=np.float32)
    frame[:, :3] = grid.basis / grid.cell_m
    frame[:, 3] = grid.low_m / grid.cell_m
    return frame


def count_over_plan(offsets: Offsets, grid: PlanGrid, *, parts: int) -> PlanCounts:
    """Count points per plan cell and per storey, and find the box of each block, in one pass."""
    n_points = len(offsets.x)
    cells = np.zeros((parts, *grid.shape[:2]), dtype=np.int32)
    heights = np.zeros((parts, grid.shape[2]), dtype=np.int32)
    boxes = np.empty((-(-n_points // BLOCK_POINTS), 6), dtype=np.float32)
    unusable = np.zeros(parts, dtype=np.int64)
    frame = plan_frame(grid)

    def count(part: int, piece: slice) -> None:
        points = piece_of(blocked(offsets, boxes), piece)
        sides = points.boxes.view(np.int32)
        unusable[part] = _count_over_plan(points, sides, frame, cells[part], heights[part])

    each_part(n_points, parts, count)
    return PlanCounts(
        cells=cells.sum(axis=0, dtype=np.int64),
        heights=heights.sum(axis=0, dtype=np.int64),
        boxed=Boxes(boxes=boxes, n_unusable=int(unusable.sum())),
    )


@kernel_part
def _set_box(points: BlockedPoints, block: int, sides: NDArray[np.int32]) -> int:
    """Set the box of a block, and give at how many of its sides values are NaN or infinite.

    Bits of floats, those of negative ones turned over, are in the order of their values: whole
    numbers are compared several at once, which floats with their NaN are not. What is not finite
    lies at the ends of that order.

    Args:
        points: (n,) offsets in blocks.
        block: which block.
        sides: (blocks, 6) the boxes as bits.
    """
    start = block * BLOCK_POINTS
    stop = min(start + BLOCK_POINTS, points.x.size)
    turned, sign = np.int32(0x7FFFFFFF), np.int32(31)
    infinite = np.int32(0x7F800000)
    bad = 0
    for axis in range(3):
        bits = (points.x, points.y, points.z)[axis][start:stop].view(np.int32)
        low, high = turned, np.int32(-0x80000000)
        for i in range(bits.size):
            ordered = np.int32(bits[i] ^ ((bits[i] >> sign) & turned))
            low = min(low, ordered)
            high = max(high, ordered)
        bad += int(low < -infinite) + int(high >= infinite)
        sides[block, 2 * axis] = low ^ ((low >> sign) & turned)
        sides[block, 2 * axis + 1] = high ^ ((high >> sign) & turned)
    return bad


@compiled
def _set_boxes(points: BlockedPoints, sides: NDArray[np.int32]) -> int:
    """Set the boxes of all blocks, and give at how many sides values are unusable."""
    bad = 0
    for block in range(sides.shape[0]):
        bad += _set_box(points, block, sides)
    return bad


@kernel_part
def _place_block(
    points: BlockedPoints,
    block: int,
    frame: NDArray[np.float32],
    shape: tuple[int, int],
    n_storeys: int,
    cell: NDArray[np.int32],
    storey: NDArray[np.int32],
) -> None:
    """Set cell and storey of a block's points, -1 outside.

    Apart from the counting, and without branches, so that the processor takes several points at
    once: the counts wait for each other, the places need not.
    """
    x, y, z = points.x, points.y, points.z
    a0, a1, a2, a3 = frame[0, 0], frame[0, 1], frame[0, 2], frame[0, 3]
    b0, b1, b2, b3 = frame[1, 0], frame[1, 1], frame[1, 2], frame[1, 3]
    c0, c1, c2, c3 = frame[2, 0], frame[2, 1], frame[2, 2], frame[2, 3]
    zero = np.float32(0.0)
    top_first, top_second = np.float32(shape[0]), np.float32(shape[1])
    top_storey = np.float32(n_storeys)
    width, nowhere = np.int32(shape[1]), np.int32(-1)
    start = block * BLOCK_POINTS
    for i in range(start, min(start + BLOCK_POINTS, x.size)):
        first = a0 * x[i] + a1 * y[i] + a2 * z[i] - a3
        second = b0 * x[i] + b1 * y[i] + b2 * z[i] - b3
        height = c0 * x[i] + c1 * y[i] + c2 * z[i] - c3
        over = (first >= zero) & (first < top_first) & (second >= zero) & (second < top_second)
        within = over & (height >= zero) & (height < top_storey)
        row = np.int32(first if over else zero)
        column = np.int32(second if over else zero)
        level = np.int32(height if within else zero)
        cell[i - start] = row * width + column if over else nowhere
        storey[i - start] = level if within else nowhere


@kernel_part
def _add_runs(places: NDArray[np.int32], count: int, table: NDArray[np.int32]) -> None:
    """Count places into a table, none of them negative; a scan's neighbours share one."""
    first, place = 0, places[0]
    for i in range(1, count):
        if places[i] != place:
            if place >= 0:
                table[place] += i - first
            first, place = i, places[i]
    if place >= 0:
        table[place] += count - first


@compiled
def _count_over_plan(
    points: BlockedPoints,
    sides: NDArray[np.int32],
    frame: NDArray[np.float32],
    cells: NDArray[np.int32],
    heights: NDArray[np.int32],
) -> int:
    """Add to cells and heights, set the boxes, and give at how many sides values are unusable."""
    flat = cells.reshape(cells.size)
    cell = np.empty(BLOCK_POINTS, dtype=np.int32)
    storey = np.empty(BLOCK_POINTS, dtype=np.int32)
    bad = 0
    for block in range(sides.shape[0]):
        start = block * BLOCK_POINTS
        stop = min(start + BLOCK_POINTS, points.x.size)
        bad += _set_box(points, block, sides)
        _place_block(points, block, frame, cells.shape, heights.size, cell, storey)
        _add_runs(cell, stop - start, flat)
        _add_runs(storey, stop - start, heights)
    return bad
