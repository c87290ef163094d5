"""Compiled pass that hands over a painted tile: what is hidden after all, and what stays bare."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part
from orthoflow.geometry.visibility_kernels import OCCLUDED, PAINTED, Sight

# Twenty bits tell views apart well enough, and pack to half the size.
_QUALITY_BITS: Final = np.uint32(0xFFFFF000)
# Cells that are looked at together: where all are painted, none has to be made bare.
_RUN: Final = 32


class Canvas(NamedTuple):
    """A layer that is being painted.

    Attributes:
        mask: (rows, cols) uint8 states.
        quality: (rows, cols) float32.
        rgb: (rows, cols, 3) uint8.
    """

    mask: NDArray[np.uint8]
    quality: NDArray[np.float32]
    rgb: NDArray[np.uint8]


@compiled
def hand_over(
    sight: Sight,
    is_near: NDArray[np.uint8],
    inner: tuple[int, int],
    canvas: Canvas,
    tile: tuple[slice, slice],
) -> None:
    """Write mask and quality of a tile, and take the colours of cells that are not painted.

    Args:
        sight: of the tile and what is around it.
        is_near: of the same shape, not 0 where a cell is too near to a hidden patch; or empty.
        inner: row and column of `sight` where the tile begins.
        canvas: changed where the tile is.
        tile: rows and columns of it.
    """
    rows, columns = tile
    n_columns, width = columns.stop - columns.start, canvas.mask.shape[1]
    masks = canvas.mask.reshape(canvas.mask.size)
    qualities = canvas.quality.view(np.uint32).reshape(canvas.quality.size)
    seen = sight.mask.reshape(sight.mask.size)
    worth = sight.quality.view(np.uint32).reshape(sight.quality.size)
    near = is_near.reshape(is_near.size)
    painted, occluded = np.uint8(PAINTED), np.uint8(OCCLUDED)
    zero, bits = np.uint32(0), _QUALITY_BITS
    for row in range(rows.start, rows.stop):
        first = np.uintp(row * width + columns.start)
        source = np.uintp((row - rows.start + inner[0]) * sight.mask.shape[1] + inner[1])
        for j in range(n_columns):
            masks[first + np.uintp(j)] = seen[source + np.uintp(j)]
        if near.size:
            for j in range(n_columns):
                is_lost = (near[source + np.uintp(j)] != 0) & (
                    seen[source + np.uintp(j)] == painted
                )
                masks[first + np.uintp(j)] = occluded if is_lost else seen[source + np.uintp(j)]
        for j in range(n_columns):
            is_bare = masks[first + np.uintp(j)] != painted
            value = np.uint32(worth[source + np.uintp(j)] & bits)
            qualities[first + np.uintp(j)] = zero if is_bare else value
    _take_colours(canvas, tile)


@kernel_part
def _take_colours(canvas: Canvas, tile: tuple[slice, slice]) -> None:
    """Make the cells of a tile black that are not painted."""
    rows, columns = tile
    masks, rgb = canvas.mask.reshape(canvas.mask.size), canvas.rgb.reshape(canvas.rgb.size)
    painted = np.uint8(PAINTED)
    for row in range(rows.start, rows.stop):
        for start in range(columns.start, columns.stop, _RUN):
            first = np.uintp(row * canvas.mask.shape[1] + start)
            n_cells = min(columns.stop - start, _RUN)
            has_bare = False
            for j in range(n_cells):
                has_bare |= masks[first + np.uintp(j)] != painted
            if not has_bare:
                continue
            for j in range(n_cells):
                if masks[first + np.uintp(j)] != painted:
                    for channel in range(3):
                        rgb[3 * (first + np.uintp(j)) + np.uintp(channel)] = 0
