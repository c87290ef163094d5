"""Compiled passes that sum points into cells: which cell a point is in, and the cells' moments.

Cells are the voxels of `voxel_kernels` that have points, numbered as they are met; a table per
brick gives the number of each voxel. Within a cell places are whole steps, so that neither threads
nor the order of points show in the sums.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part
from orthoflow.geometry.point_kernels import BLOCK_POINTS, BlockedPoints
from orthoflow.geometry.voxel_kernels import VOXELS, place_keys

# Steps along a side of a cell: 20 micrometres in cells of two centimetres.
STEPS_PER_CELL: Final = 1024
# Sums of a cell: points, steps along a, b, c, then their products aa, ab, ac, bb, bc, cc.
N_SUMS: Final = 10
# Bits of the sum of a block's steps, and of the sum of its products of steps; a little more.
_FIELD_BITS: Final = 18
_PRODUCT_BITS: Final = 32


@kernel_part
def _place_steps(
    points: BlockedPoints,
    start: int,
    frame: NDArray[np.float32],
    axis: int,
    steps: NDArray[np.int64],
) -> None:
    """Set (BLOCK_POINTS,) steps of a block's points from the low side of their cells."""
    stop = min(start + BLOCK_POINTS, points.x.size)
    xs, ys, zs = points.x[start:stop], points.y[start:stop], points.z[start:stop]
    a0, a1, a2, a3 = frame[axis, 0], frame[axis, 1], frame[axis, 2], frame[axis, 3]
    fine = np.float32(STEPS_PER_CELL)
    for i in range(xs.size):
        a = a0 * xs[i] + a1 * ys[i] + a2 * zs[i] - a3
        steps[i] = np.int64(np.int32((a - np.float32(np.int32(a))) * fine))


@kernel_part
def _cell(
    key: int, bricks: NDArray[np.int32], numbers: NDArray[np.int32], n_used: NDArray[np.int64]
) -> int:
    """Give the number of the cell with a key of `place_keys`, a new one if it had none."""
    brick, voxel = key // VOXELS, key % VOXELS
    slot = bricks[brick]
    if slot < 0:
        slot = np.int32(n_used[0])
        n_used[0] += 1
        bricks[brick] = slot
        numbers[slot, :] = -1
    number = numbers[slot, voxel]
    if number < 0:
        number = np.int32(n_used[1])
        n_used[1] += 1
        numbers[slot, voxel] = number
    return int(number)


@kernel_part
def _pack(steps: NDArray[np.int64], packed: NDArray[np.int64]) -> None:
    """Pack what each point of a block adds into four numbers, so that a run of points is four sums.

    Args:
        steps: (3, BLOCK_POINTS) see `_place_steps`; the sum of those of a block has 18 bits, that
            of their products 28.
        packed: (4, BLOCK_POINTS) set: one and a, b, c; aa and bb; cc and ab; ac and bc.
    """
    fields, products, one = np.int64(_FIELD_BITS), np.int64(_PRODUCT_BITS), np.int64(1)
    a, b, c = steps[0], steps[1], steps[2]
    first, second, third, fourth = packed[0], packed[1], packed[2], packed[3]
    for i in range(BLOCK_POINTS):
        first[i] = (((((one << fields) + a[i]) << fields) + b[i]) << fields) + c[i]
    for i in range(BLOCK_POINTS):
        second[i] = ((a[i] * a[i]) << products) + b[i] * b[i]
    for i in range(BLOCK_POINTS):
        third[i] = ((c[i] * c[i]) << products) + a[i] * b[i]
    for i in range(BLOCK_POINTS):
        fourth[i] = ((a[i] * c[i]) << products) + b[i] * c[i]


@kernel_part
def _add_run(
    run: tuple[np.int64, np.int64, np.int64, np.int64], sums: NDArray[np.int64], k: int
) -> None:
    """Add the packed sums of a run of points to the moments of cell k, from the cell's middle."""
    fields, products = np.int64(_FIELD_BITS), np.int64(_PRODUCT_BITS)
    steps, squares, mixed, others = run
    field, product = (np.int64(1) << fields) - 1, (np.int64(1) << products) - 1
    n = steps >> (3 * fields)
    a, b, c = (steps >> (2 * fields)) & field, (steps >> fields) & field, steps & field
    half = np.int64(STEPS_PER_CELL // 2)
    square = half * half * n
    sums[k, 0] += n
    sums[k, 1] += a - half * n
    sums[k, 2] += b - half * n
    sums[k, 3] += c - half * n
    # Sum (s - h) (t - h) = sum st - h (sum s + sum t) + h h n.
    sums[k, 4] += (squares >> products) - 2 * half * a + square
    sums[k, 5] += (mixed & product) - half * (a + b) + square
    sums[k, 6] += (others >> products) - half * (a + c) + square
    sums[k, 7] += (squares & product) - 2 * half * b + square
    sums[k, 8] += (others & product) - half * (b + c) + square
    sums[k, 9] += (mixed >> products) - 2 * half * c + square


@compiled
def gather_cells(  # noqa: PLR0913, PLR0917 - compiled code has no objects to bundle these in
    points: BlockedPoints,
    start: int,
    frame: NDArray[np.float32],
    shape: tuple[int, int, int],
    bricks: NDArray[np.int32],
    numbers: NDArray[np.int32],
    sums: NDArray[np.int64],
    n_used: NDArray[np.int64],
) -> int:
    """Add points to the moments of their cells, which are made as they are met, until tables fill.

    A scan comes column by column, so points that follow each other share a cell: their sums are
    kept aside and added when the cell changes.

    Args:
        points: (n,) offsets in blocks.
        start: first point, at the start of a block.
        frame: (3, 4) voxel of a point.
        shape: bricks along a, b, c.
        bricks: (a * b * c,) row of each brick in `numbers`, -1 for none yet.
        numbers: (rows, voxels) number of each cell, -1 for none yet.
        sums: (cells, N_SUMS) added to.
        n_used: rows and cells in use.

    Returns:
        The first point that was not added: the number of points, unless the tables are full.
    """
    keys = np.empty(BLOCK_POINTS, dtype=np.int64)
    steps = np.zeros((3, BLOCK_POINTS), dtype=np.int64)
    packed = np.empty((4, BLOCK_POINTS), dtype=np.int64)
    first, second, third, fourth = packed[0], packed[1], packed[2], packed[3]
    while start < points.x.size:
        if n_used[0] + BLOCK_POINTS > numbers.shape[0] or n_used[1] + BLOCK_POINTS > sums.shape[0]:
            return start
        count = place_keys(points, start, frame, shape, keys)
        for axis in range(3):
            _place_steps(points, start, frame, axis, steps[axis])
        _pack(steps, packed)
        key = keys[0]
        p = q = r = s = np.int64(0)
        for i in range(count):
            if keys[i] != key:
                if key >= 0:
                    _add_run((p, q, r, s), sums, _cell(key, bricks, numbers, n_used))
                key = keys[i]
                p = q = r = s = np.int64(0)
            p += first[i]
            q += second[i]
            r += third[i]
            s += fourth[i]
        if key >= 0:
            _add_run((p, q, r, s), sums, _cell(key, bricks, numbers, n_used))
        start += BLOCK_POINTS
    return points.x.size


@compiled
def merge_cells(
    other_bricks: NDArray[np.int32],
    other_numbers: NDArray[np.int32],
    other_sums: NDArray[np.int64],
    bricks: NDArray[np.int32],
    numbers: NDArray[np.int32],
    sums: NDArray[np.int64],
    n_used: NDArray[np.int64],
) -> None:
    """Add the cells of another part to tables that have room for them."""
    for brick in range(other_bricks.size):
        slot = other_bricks[brick]
        if slot < 0:
            continue
        for voxel in range(other_numbers.shape[1]):
            other = other_numbers[slot, voxel]
            if other >= 0:
                k = _cell(brick * VOXELS + voxel, bricks, numbers, n_used)
                for place in range(N_SUMS):
                    sums[k, place] += other_sums[other, place]


@kernel_part
def _known_cell(key: int, bricks: NDArray[np.int32], numbers: NDArray[np.int32]) -> int:
    """Give the number of the cell with a key of `place_keys`, -1 if it has none."""
    slot = bricks[key // VOXELS] if key >= 0 else -1
    return numbers[slot, key % VOXELS] if slot >= 0 else -1


@compiled
def find_cells(
    points: BlockedPoints,
    frame: NDArray[np.float32],
    bricks: NDArray[np.int32],
    numbers: NDArray[np.int32],
    found: NDArray[np.int32],
) -> None:
    """Set (n,) found to the cell of each point, -1 outside."""
    keys = np.empty(BLOCK_POINTS, dtype=np.int64)
    flat = bricks.reshape(bricks.size)
    for start in range(0, points.x.size, BLOCK_POINTS):
        count = place_keys(points, start, frame, bricks.shape, keys)
        for i in range(count):
            found[start + i] = _known_cell(keys[i], flat, numbers)


@compiled
def claim_cells(
    points: BlockedPoints,
    frame: NDArray[np.float32],
    bricks: NDArray[np.int32],
    numbers: NDArray[np.int32],
    owners: NDArray[np.int8],
    claims: NDArray[np.int8],
) -> None:
    """Give each point to the plane that owns its cell; owners (cells,) are -1 for none."""
    keys = np.empty(BLOCK_POINTS, dtype=np.int64)
    flat = bricks.reshape(bricks.size)
    for start in range(0, points.x.size, BLOCK_POINTS):
        count = place_keys(points, start, frame, bricks.shape, keys)
        for i in range(count):
            cell = _known_cell(keys[i], flat, numbers)
            claims[start + i] = owners[cell] if cell >= 0 else -1
