"""Compiled passes that tell where a photo sees the cells of a wall, and what stands in between."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.camera_kernels import project_point
from orthoflow.geometry.compiling import compiled
from orthoflow.geometry.point_kernels import Offsets

# Side of the square blocks of cells that share one bound on how high rays have to be followed.
BLOCK_CELLS: Final = 32
# Side of the small blocks that are asked where a large one is not free; a part of a large one.
FINE_CELLS: Final = 8
# Void cells in `Relief.occluding`: they hide nothing, nor do mixtures with them.
NOTHING: Final = np.int16(-32768)
NOTHING_M: Final = -1.0e6
# Counts stay below this, so that sums over 3 x 3 x 3 voxels fit into 16 bits.
COUNT_MOST: Final = 2000

# States of a cell, as in `LayerMask`.
OUTSIDE: Final = 0
PAINTED: Final = 1
OCCLUDED: Final = 2
NO_SURFACE: Final = 3

# Points nearer to the projection centre than this are the camera itself.
_NEAREST_M: Final = 0.05
_LARGEST_SPLAT_PX: Final = 24.0


class WallView(NamedTuple):
    """A photo's camera before a wall, in the wall's axes.

    Attributes:
        camera: (24,) flat camera (see `camera_kernels`) for points (u, v, n) in metres from the
            wall frame's origin.
        column: foot of the projection centre on the wall, in cell indices; 0 is the centre of
            the first cell. row likewise.
        height_m: projection centre above the plane.
        gsd_m: side of a cell.
        front_m: up to this depth the raster itself tells what hides what; only points before it
            are looked up in the depth buffer.
        tolerance_m: how far a surface must be above a ray to hide it.
        cosine_least: cells seen at a smaller cosine of incidence count as hidden.
        border_px: quality falls to 0 over this distance from the image border.
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
    """The surface of a wall, and what of it hides other cells.

    Attributes:
        depth: (rows, cols) float32 metres, NaN where void.
        occluding: (rows * cols,) int16 the same without spikes, in steps of `step_m`, `NOTHING`
            where void; half the memory of float32, and far finer than what counts as hidden.
            Empty where the surface hides nothing.
        step_m: of `occluding`.
        tops: (blocks + 1, blocks + 1) float32, the highest `occluding` in the window of 2 x 2
            blocks that begins one row and one column before, metres.
        bottoms: (blocks, blocks) float32, the lowest depth in a block, infinite in a void one.
        crests: (blocks, blocks) float32, the highest depth in a block, minus infinity in a void
            one.
        fine_tops: (fine blocks + 1, fine blocks + 1) as `tops`, for blocks of `FINE_CELLS`.
        fine_bottoms: (fine blocks, fine blocks) as `bottoms`, for blocks of `FINE_CELLS`.
        highest_m: the highest `occluding` of all; `NOTHING_M` and no ray is followed.
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


class DepthBuffer(NamedTuple):
    """The nearest points of a cloud in a reduced photo.

    Attributes:
        nearest: (rows, cols) float32 metres along the optical axis, infinite where nothing is.
        reduction: photo pixels per pixel of the buffer.
    """

    nearest: NDArray[np.float32]
    reduction: float


class Sight(NamedTuple):
    """What a photo sees of a tile of cells, filled by `look_at_cells`.

    Attributes:
        u: (rows, cols) float32 photo pixels, first centre at 0.5, a number everywhere, but a place
            only where painted. v likewise.
        mask: (rows, cols) uint8 states.
        quality: (rows, cols) float32 photo pixels per cell times the falling off at the border;
            it counts only where painted.
        summary: (8,) float64 over painted cells: bounds of u and of v (smallest, largest each),
            their number, sums of columns, rows and depths (where a whole block is seen, those of
            its middle).
    """

    u: NDArray[np.float32]
    v: NDArray[np.float32]
    mask: NDArray[np.uint8]
    quality: NDArray[np.float32]
    summary: NDArray[np.float64]


class VoxelGrid(NamedTuple):
    """Cubes that tell how densely points lie.

    Attributes:
        low: (3,) float64 metres from the cloud's origin, lower corner of the first cube.
        side_m: side of a cube.
        counts: (nx, ny, nz) uint16 points in each, or in each and its 26 neighbours.
    """

    low: NDArray[np.float64]
    side_m: float
    counts: NDArray[np.uint16]


@compiled
def count_in_voxels(points: Offsets, grid: VoxelGrid) -> None:
    """Count points in voxels, up to `COUNT_MOST`; points outside the grid are left out."""
    nx, ny, nz = grid.counts.shape
    low_x, low_y, low_z, per_m = grid.low[0], grid.low[1], grid.low[2], 1.0 / grid.side_m
    for i in range(points.x.shape[0]):
        a = math.floor((points.x[i] - low_x) * per_m)
        b = math.floor((points.y[i] - low_y) * per_m)
        c = math.floor((points.z[i] - low_z) * per_m)
        if 0 <= a < nx and 0 <= b < ny and 0 <= c < nz and grid.counts[a, b, c] < COUNT_MOST:
            grid.counts[a, b, c] += 1


@compiled
def splat_points(
    points: Offsets,
    camera: NDArray[np.float64],
    around: VoxelGrid,
    n_least: int,
    buffer: DepthBuffer,
) -> None:
    """Lay points into a depth buffer as squares as large as the gaps between them.

    Args:
        points: offsets from the cloud's origin.
        camera: (24,) flat camera for these offsets.
        around: points in 3 x 3 x 3 voxels; a surface through them has 9 faces of a voxel, which
            tells the spacing of its points.
        n_least: points with fewer around them, themselves included, are outliers.
        buffer: the nearest depths so far, lowered in place.
    """
    nx, ny, nz = around.counts.shape
    rows, columns = buffer.nearest.shape
    low_x, low_y, low_z, per_m = around.low[0], around.low[1], around.low[2], 1.0 / around.side_m
    focal = math.sqrt(camera[12] * camera[13])
    for i in range(points.x.shape[0]):
        x, y, z = float(points.x[i]), float(points.y[i]), float(points.z[i])
        a = math.floor((x - low_x) * per_m)
        b = math.floor((y - low_y) * per_m)
        c = math.floor((z - low_z) * per_m)
        if not (0 <= a < nx and 0 <= b < ny and 0 <= c < nz):
            continue
        n_around = around.counts[a, b, c]
        if n_around < n_least:
            continue
        u, v, distance = project_point(camera, x, y, z)
        if not distance > _NEAREST_M or math.isnan(u):
            continue
        spacing_m = 3.0 * around.side_m / math.sqrt(n_around)
        half = min(spacing_m * focal / (distance * buffer.reduction), _LARGEST_SPLAT_PX)
        u, v = u / buffer.reduction, v / buffer.reduction
        first_row, end_row = max(0, math.floor(v - half)), min(rows, math.floor(v + half) + 1)
        first, end = max(0, math.floor(u - half)), min(columns, math.floor(u + half) + 1)
        nearest = np.float32(distance)
        for row in range(first_row, end_row):
            for column in range(first, end):
                buffer.nearest[row, column] = min(buffer.nearest[row, column], nearest)
