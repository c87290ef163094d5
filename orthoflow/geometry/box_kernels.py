"""Compiled steps that passes take per block of points: planes it can be on, places along them.

Places within a block are counted from the middle of its box: float32 then is exact to nanometres
wherever the block lies, and the processor takes twice as many points at once as with float64.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import kernel_part
from orthoflow.geometry.point_kernels import BLOCK_POINTS, BlockedPoints

# Blocks whose boxes are tried against the slabs at once.
CHUNK_BLOCKS: Final = 64
# Axes of a slab. Of a type, since each plain number would have a version compiled for itself.
ALONG_NORMAL: Final = np.int64(0)
ALONG_U: Final = np.int64(1)
ALONG_V: Final = np.int64(2)


@kernel_part
def _spread_boxes(
    boxes: NDArray[np.float32], first: int, count: int, spread: NDArray[np.float32]
) -> None:
    """Set (6, CHUNK_BLOCKS) spread to the middles and half sides of the boxes of some blocks."""
    half = np.float32(0.5)
    for b in range(count):
        for axis in range(3):
            low, high = boxes[first + b, 2 * axis], boxes[first + b, 2 * axis + 1]
            spread[axis, b] = half * (low + high)
            spread[3 + axis, b] = half * (high - low)


@kernel_part
def _meet(
    spread: NDArray[np.float32],
    slabs: NDArray[np.float64],
    bounds: NDArray[np.float64],
    k: int,
    meeting: NDArray[np.int32],
) -> None:
    """How a slab within its rectangle meets boxes: 0 misses, 2 holds it, else 1.

    Sets (slabs, CHUNK_BLOCKS) meeting.
    """
    one = np.int32(1)
    for b in range(CHUNK_BLOCKS):
        meeting[k, b] = 2
    for row in range(3):
        p, q, r = slabs[k, 4 * row], slabs[k, 4 * row + 1], slabs[k, 4 * row + 2]
        a, b_, c = np.float32(p), np.float32(q), np.float32(r)
        u, v, w = np.float32(abs(p)), np.float32(abs(q)), np.float32(abs(r))
        shift = np.float32(slabs[k, 4 * row + 3])
        least = np.float32(-bounds[k, 0] if row == 0 else bounds[k, 2 * row - 1])
        most = np.float32(bounds[k, 0] if row == 0 else bounds[k, 2 * row])
        for b in range(CHUNK_BLOCKS):
            before = meeting[k, b]
            centre = a * spread[0, b] + b_ * spread[1, b] + c * spread[2, b] - shift
            half = u * spread[3, b] + v * spread[4, b] + w * spread[5, b]
            misses = (centre + half < least) | (centre - half > most)
            cuts = (centre - half < least) | (centre + half > most)
            here = np.int32(0) if misses else (one if cuts else np.int32(2))
            meeting[k, b] = min(before, here)


@kernel_part
def meet_chunk(
    boxes: NDArray[np.float32],
    block: int,
    slabs: NDArray[np.float64],
    bounds: NDArray[np.float64],
    spread: NDArray[np.float32],
    meeting: NDArray[np.int32],
) -> None:
    """Try the boxes of the blocks from one on against all slabs.

    Args:
        boxes: (blocks, 6) smallest and largest x, y, z.
        block: the first block; those up to CHUNK_BLOCKS from there are tried.
        slabs: (k, 12) see `plane_kernels`.
        bounds: (k, 5) find tolerance, then smallest and largest u and v; metres.
        spread: (6, CHUNK_BLOCKS) scratch.
        meeting: (k, CHUNK_BLOCKS) set: 0 where a slab misses a block, 2 where it holds it, else 1.
    """
    _spread_boxes(boxes, block, min(CHUNK_BLOCKS, boxes.shape[0] - block), spread)
    for k in range(slabs.shape[0]):
        _meet(spread, slabs, bounds, k, meeting)


@kernel_part
def centre_block(
    points: BlockedPoints, block: int, middle: NDArray[np.float64], local: NDArray[np.float32]
) -> None:
    """Set (3, BLOCK_POINTS) local to a block's points, counted from the middle of its box."""
    x, y, z, boxes = points.x, points.y, points.z, points.boxes
    start = block * BLOCK_POINTS
    mx = np.float32(0.5) * (boxes[block, 0] + boxes[block, 1])
    my = np.float32(0.5) * (boxes[block, 2] + boxes[block, 3])
    mz = np.float32(0.5) * (boxes[block, 4] + boxes[block, 5])
    middle[0], middle[1], middle[2] = mx, my, mz
    stop = min(start + BLOCK_POINTS, x.size)
    # As pieces, since an index that is a sum keeps the processor from taking several at once.
    xs, ys, zs = x[start:stop], y[start:stop], z[start:stop]
    for i in range(xs.size):
        local[0, i] = xs[i] - mx
        local[1, i] = ys[i] - my
        local[2, i] = zs[i] - mz


@kernel_part
def place_along(  # noqa: PLR0913, PLR0917 - compiled code has no objects to bundle these in
    local: NDArray[np.float32],
    middle: NDArray[np.float64],
    slabs: NDArray[np.float64],
    k: int,
    row: np.int64,
    scale: float,
    low: float,
    values: NDArray[np.float32],
) -> None:
    """Set values to `scale` times the places of a block's points along an axis of a slab."""
    a, b, c = slabs[k, 4 * row], slabs[k, 4 * row + 1], slabs[k, 4 * row + 2]
    there = a * middle[0] + b * middle[1] + c * middle[2] - slabs[k, 4 * row + 3] - low
    p, q, r = np.float32(a * scale), np.float32(b * scale), np.float32(c * scale)
    s = np.float32(there * scale)
    for i in range(BLOCK_POINTS):
        values[i] = p * local[0, i] + q * local[1, i] + r * local[2, i] + s
