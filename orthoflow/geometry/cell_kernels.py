"""Compiled passes that sum points into cells: which cell a point is in, and the cells' moments.

Cells are the voxels of `voxel_kernels` that have points, numbered as they are met; a table per
brick gives the number of each voxel. Within a cell places are whole steps, so that neither threads
nor the order of points show in the sums.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.point_kernels import BLOCK_POINTS, BlockedPoints, compiled
from orthoflow.geometry.voxel_kernels import BRICK_SIDE

# Steps along a side of a cell: 20 micrometres in cells of two centimetres.
STEPS_PER_CELL: Final = 1024
# Sums of a cell: points, steps along a, b, c, then their products aa, ab, ac, bb, bc, cc.
N_SUMS: Final = 10


@compiled
def place_points(
    points: BlockedPoints,
    start: int,
    frame: NDArray[np.float32],
    shape: tuple[int, int, int],
    where: NDArray[np.int32],
) -> int:
    """Set brick, voxel and steps of a block's points; gives the number of points.

    Args:
        points: (n,) offsets in blocks.
        start: first point of the block.
        frame: (3, 4) voxel of a point: `frame @ p - frame[:, 3]`.
        shape: bricks along a, b, c.
        where: (5, BLOCK_POINTS) set: brick (-1 outside), voxel within it, and -512..511 from the
            middle of the voxel along a, b, c.
    """
    x, y, z = points.x, points.y, points.z
    a0, a1, a2, a3 = frame[0, 0], frame[0, 1], frame[0, 2], frame[0, 3]
    b0, b1, b2, b3 = frame[1, 0], frame[1, 1], frame[1, 2], frame[1, 3]
    c0, c1, c2, c3 = frame[2, 0], frame[2, 1], frame[2, 2], frame[2, 3]
    top_a = np.float32(shape[0] * BRICK_SIDE)
    top_b = np.float32(shape[1] * BRICK_SIDE)
    top_c = np.float32(shape[2] * BRICK_SIDE)
    zero, fine = np.float32(0.0), np.float32(STEPS_PER_CELL)
    half, low = np.int32(STEPS_PER_CELL // 2), np.int32(BRICK_SIDE - 1)
    width, depth, side = np.int32(shape[1]), np.int32(shape[2]), np.int32(BRICK_SIDE)
    count = min(BLOCK_POINTS, x.size - start)
    # Without branches, so that the processor takes several points at once.
    for i in range(count):
        px, py, pz = x[start + i], y[start + i], z[start + i]
        a = a0 * px + a1 * py + a2 * pz - a3
        b = b0 * px + b1 * py + b2 * pz - b3
        c = c0 * px + c1 * py + c2 * pz - c3
        within = (a >= zero) & (a < top_a) & (b >= zero) & (b < top_b)
        within = within & (c >= zero) & (c < top_c)
        a = a if within else zero
        b = b if within else zero
        c = c if within else zero
        p, q, r = np.int32(a), np.int32(b), np.int32(c)
        brick = ((p >> np.int32(3)) * width + (q >> np.int32(3))) * depth + (r >> np.int32(3))
        where[0, i] = brick if within else np.int32(-1)
        where[1, i] = ((p & low) * side + (q & low)) * side + (r & low)
        where[2, i] = np.int32((a - np.float32(p)) * fine) - half
        where[3, i] = np.int32((b - np.float32(q)) * fine) - half
        where[4, i] = np.int32((c - np.float32(r)) * fine) - half
    return count


@compiled
def _cell(
    brick: int,
    voxel: int,
    bricks: NDArray[np.int32],
    numbers: NDArray[np.int32],
    n_used: NDArray[np.int64],
) -> int:
    """Give the number of a cell, a new one if it had none."""
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
    where = np.empty((5, BLOCK_POINTS), dtype=np.int32)
    while start < points.x.size:
        if n_used[0] + BLOCK_POINTS > numbers.shape[0] or n_used[1] + BLOCK_POINTS > sums.shape[0]:
            return start
        count = place_points(points, start, frame, shape, where)
        i = 0
        while i < count:
            brick, voxel = where[0, i], where[1, i]
            n = a = b = c = aa = ab = ac = bb = bc = cc = np.int64(0)
            while i < count and where[0, i] == brick and where[1, i] == voxel:
                p, q, r = np.int64(where[2, i]), np.int64(where[3, i]), np.int64(where[4, i])
                n += 1
                a += p
                b += q
                c += r
                aa += p * p
                ab += p * q
                ac += p * r
                bb += q * q
                bc += q * r
                cc += r * r
                i += 1
            if brick >= 0:
                k = _cell(brick, voxel, bricks, numbers, n_used)
                sums[k, 0] += n
                sums[k, 1] += a
                sums[k, 2] += b
                sums[k, 3] += c
                sums[k, 4] += aa
                sums[k, 5] += ab
                sums[k, 6] += ac
                sums[k, 7] += bb
                sums[k, 8] += bc
                sums[k, 9] += cc
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
                k = _cell(brick, voxel, bricks, numbers, n_used)
                for place in range(N_SUMS):
                    sums[k, place] += other_sums[other, place]


@compiled
def _known_cell(
    brick: int, voxel: int, bricks: NDArray[np.int32], numbers: NDArray[np.int32]
) -> int:
    """Give the number of a cell, -1 if it has none."""
    slot = bricks[brick] if brick >= 0 else -1
    return numbers[slot, voxel] if slot >= 0 else -1


@compiled
def find_cells(
    points: BlockedPoints,
    frame: NDArray[np.float32],
    bricks: NDArray[np.int32],
    numbers: NDArray[np.int32],
    found: NDArray[np.int32],
) -> None:
    """Set (n,) found to the cell of each point, -1 outside."""
    where = np.empty((5, BLOCK_POINTS), dtype=np.int32)
    flat = bricks.reshape(bricks.size)
    for start in range(0, points.x.size, BLOCK_POINTS):
        count = place_points(points, start, frame, bricks.shape, where)
        for i in range(count):
            found[start + i] = _known_cell(where[0, i], where[1, i], flat, numbers)


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
    where = np.empty((5, BLOCK_POINTS), dtype=np.int32)
    flat = bricks.reshape(bricks.size)
    for start in range(0, points.x.size, BLOCK_POINTS):
        count = place_points(points, start, frame, bricks.shape, where)
        for i in range(count):
            cell = _known_cell(where[0, i], where[1, i], flat, numbers)
            claims[start + i] = owners[cell] if cell >= 0 else -1
