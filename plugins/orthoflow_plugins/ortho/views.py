"""A wall in front of a photo's camera, and what the photo sees of it, as tuples for kernels."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

# Side of the square blocks of cells that share one bound on the height up to which rays are
# followed.
BLOCK_CELLS: Final = 32
# Side of the small blocks that are tested if a large one is not free; a part of a large one.
FINE_CELLS: Final = 8
# Void cells in `Relief.occluding`: they hide nothing, nor do interpolations with them.
NOTHING: Final = np.int16(-32768)
NOTHING_M: Final = -1.0e6

# States of a cell, as in `LayerMask`.
OUTSIDE: Final = 0
PAINTED: Final = 1
OCCLUDED: Final = 2
NO_SURFACE: Final = 3


class WallView(NamedTuple):
    """A photo's camera in front of a wall, in the wall's axes.

    Attributes:
        camera: (25,) flat camera (see `camera_kernels`) for points (u, v, n) in metres from the
            wall frame's origin.
        column: foot of the projection centre on the wall, in cell indices; 0 is the centre of
            the first cell. row likewise.
        height_m: projection centre above the plane.
        gsd_m: side of a cell.
        front_m: up to this depth the raster itself decides what is hidden; only points in front of
            it are in the depth buffer.
        tolerance_m: how far a surface must be above a ray to hide it.
        cosine_least: cells seen at a smaller cosine of incidence count as hidden.
        border_px: quality decreases to 0 over this distance from the image border.
        is_exact: project every cell by itself.
    """

    camera: NDArray[np.float64]
    column: float
    row: float
    height_m: float
    gsd_m: float
    front_m: float
    tolerance_m: float
    cosine_least: float
    border_px: float
    is_exact: bool


class Relief(NamedTuple):
    """The surface of a wall, and which parts of it hide other cells.

    Attributes:
        depth: (rows, cols) float32 metres, NaN where void.
        occluding: (rows * cols,) int16 the same without spikes, in steps of `step_m`, `NOTHING`
            where void; half the memory of float32, and far finer than the tolerance. Empty if the
            surface hides nothing.
        step_m: of `occluding`.
        tops: (blocks + 1, blocks + 1) float32, the highest `occluding` in the window of 2 x 2
            blocks that begins one row and one column before, metres.
        bottoms: (blocks, blocks) float32, the lowest depth in a block, infinite in a void one.
        crests: (blocks, blocks) float32, the highest depth in a block, minus infinity in a void
            one.
        fine_tops: (fine blocks + 1, fine blocks + 1) as `tops`, for blocks of `FINE_CELLS`.
        fine_bottoms: (fine blocks, fine blocks) as `bottoms`, for blocks of `FINE_CELLS`.
        highest_m: the highest `occluding` of all; with `NOTHING_M` no ray is followed.
    """

    depth: NDArray[np.float32]
    occluding: NDArray[np.int16]
    step_m: float
    tops: NDArray[np.float32]
    bottoms: NDArray[np.float32]
    crests: NDArray[np.float32]
    fine_tops: NDArray[np.float32]
    fine_bottoms: NDArray[np.float32]
    highest_m: float


class TileVisibility(NamedTuple):
    """What a photo sees of a tile of cells, filled by `look_at_cells`.

    Attributes:
        u: (rows, cols) float32 photo pixels, first centre at 0.5, finite everywhere, but a position
            only where painted. v likewise.
        mask: (rows, cols) uint8 states.
        quality: (rows, cols) float32 photo pixels per cell times the decrease at the border;
            defined only where painted.
        summary: (8,) float64 over painted cells: bounds of u and of v (smallest, largest each),
            their number, sums of columns, rows and depths (if a whole block is seen, those of its
            middle).
    """

    u: NDArray[np.float32]
    v: NDArray[np.float32]
    mask: NDArray[np.uint8]
    quality: NDArray[np.float32]
    summary: NDArray[np.float64]
