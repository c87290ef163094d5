"""What of a wall's surface hides what: its depth without spikes, bounds per block."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.visibility_kernels import BLOCK_CELLS, NOTHING, NOTHING_M, Relief
from orthoflow.products import Wall

# Whole blocks of rows at once, so that no temporary is as large as the wall.
_BAND_CELLS: Final = 16 * BLOCK_CELLS
_HALO_CELLS: Final = 3
# Heights fit into 16 bits with room for rounding.
_STEPS: Final = 32_000


def relief_of(wall: Wall) -> Relief:
    """Prepare a wall for looking at it from anywhere."""
    depth = np.asarray(wall.depth_m, dtype=np.float32).view(np.ndarray)[:]
    rows, columns = depth.shape
    n_rows, n_columns = -(-rows // BLOCK_CELLS), -(-columns // BLOCK_CELLS)
    tops = np.full((n_rows, n_columns), NOTHING_M, dtype=np.float32)
    bottoms, crests = np.empty_like(tops), np.empty_like(tops)
    bounds = _bounds_m(depth, bottoms, crests)
    step_m = max(1e-6, max(abs(bound) for bound in bounds) / _STEPS)
    occluding = np.empty(depth.shape, dtype=np.int16)
    for first in range(0, rows, _BAND_CELLS):
        # What is around a cell counts: three rows beside the band are enough for all its cells.
        around = slice(max(0, first - _HALO_CELLS), min(rows, first + _BAND_CELLS + _HALO_CELLS))
        own = slice(first - around.start, min(rows, first + _BAND_CELLS) - around.start)
        heights_m = _without_spikes(depth[around])[own]
        part = occluding[first : first + _BAND_CELLS]
        # Void is far below what 16 bits hold, and ends at their lowest number.
        scaled = np.maximum(heights_m, np.float32(NOTHING * step_m)) * np.float32(1.0 / step_m)
        np.copyto(part, np.rint(scaled, out=scaled), casting="unsafe")
        block = slice(first // BLOCK_CELLS, -(-(first + part.shape[0]) // BLOCK_CELLS))
        tops[block] = _per_block(heights_m, largest=True)
    # Kernels are compiled once, for arrays that cannot be written to.
    for array in (depth, occluding):
        array.flags.writeable = False
    return Relief(
        depth=depth,
        occluding=occluding,
        step_m=float(step_m),
        tops=_highest_around(tops),
        bottoms=bottoms,
        crests=crests,
        highest_m=float(tops.max(initial=NOTHING_M)),
    )


def transparent_relief_of(wall: Wall) -> Relief:
    """Prepare a wall that hides nothing of itself; takes no memory per cell."""
    depth = np.asarray(wall.depth_m, dtype=np.float32).view(np.ndarray)[:]
    shape = tuple(-(-side // BLOCK_CELLS) for side in depth.shape)
    bottoms = np.empty(shape, dtype=np.float32)
    crests = np.empty_like(bottoms)
    _bounds_m(depth, bottoms, crests)
    nothing = np.full((1, 1), NOTHING, dtype=np.int16)
    for array in (depth, nothing):
        array.flags.writeable = False
    return Relief(
        depth=depth,
        occluding=nothing,
        step_m=1.0,
        tops=np.full(shape, NOTHING_M, dtype=np.float32),
        bottoms=bottoms,
        crests=crests,
        highest_m=NOTHING_M,
    )


def _bounds_m(
    depth: NDArray[np.float32], bottoms: NDArray[np.float32], crests: NDArray[np.float32]
) -> tuple[float, float]:
    """Fill in the lowest and highest depth of each block; give those of the wall, 0 without any."""
    for first in range(0, depth.shape[0], _BAND_CELLS):
        band = depth[first : first + _BAND_CELLS]
        block = slice(first // BLOCK_CELLS, -(-(first + band.shape[0]) // BLOCK_CELLS))
        bottoms[block] = _per_block(band, largest=False)
        crests[block] = _per_block(band, largest=True)
    is_void = np.isnan(bottoms)
    bounds = (0.0, 0.0) if is_void.all() else (float(np.nanmin(bottoms)), float(np.nanmax(crests)))
    bottoms[is_void], crests[is_void] = np.inf, -np.inf
    return bounds


def _without_spikes(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Close voids of one cell, then take away what is higher than all 2 x 2 cells it is in.

    A single outlier in front of a wall would cast a long shadow, which nothing real casts.
    """
    import cv2

    known = np.where(np.isnan(depth), np.float32(NOTHING_M), depth)
    around = cv2.dilate(known, np.ones((3, 3), dtype=np.uint8))
    closed = np.where(known == np.float32(NOTHING_M), around, known)
    square = np.ones((2, 2), dtype=np.uint8)
    lowest = cv2.erode(closed, square, anchor=(0, 0), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(
        cv2.dilate(lowest, square, anchor=(1, 1), borderType=cv2.BORDER_REPLICATE),
        dtype=np.float32,
    )


def _per_block(values: NDArray[np.float32], *, largest: bool) -> NDArray[np.float32]:
    """The extreme of each block, NaN where all of it is."""
    rows, columns = values.shape
    # `fmax` and `fmin` pass over NaN. Whole blocks of rows at once are what numpy does fast.
    reduce = np.fmax if largest else np.fmin
    whole = rows - rows % BLOCK_CELLS
    down = reduce.reduce(values[:whole].reshape(-1, BLOCK_CELLS, columns), axis=1)
    if whole < rows:
        down = np.vstack([down, reduce.reduce(values[whole:], axis=0)])
    across = reduce.reduceat(down, np.arange(0, columns, BLOCK_CELLS), axis=1)
    return np.asarray(across, dtype=np.float32)


def _highest_around(tops: NDArray[np.float32]) -> NDArray[np.float32]:
    padded = np.pad(tops, 1, constant_values=NOTHING_M)
    rows, columns = tops.shape
    shifted = [padded[i : i + rows, j : j + columns] for i in range(3) for j in range(3)]
    return np.asarray(np.maximum.reduce(shifted), dtype=np.float32)
