"""Compiled pass that determines which cells of a wall a photo sees, and their photo positions."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.camera_kernels import project_point
from orthoflow.geometry.compiling import compiled, kernel_part
from orthoflow.geometry.depth_buffer_kernels import DepthBuffer

# Side of the square blocks of cells that share one bound on the height up to which rays are
# followed.
BLOCK_CELLS: Final = 32
# From the middle of a block to the centre of its last cell, in blocks; a ray is met by the cells on
# either side of it, which are half a cell away at most.
_HALF: Final = 0.5 - 0.5 / BLOCK_CELLS

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


class Relief(NamedTuple):
    """The surface of a wall, and which parts of it hide other cells.

    Attributes:
        depth: (rows, cols) float32 metres, NaN where void.
        occluding: (rows, cols) float32 the same without spikes, minus infinity where void: void
            hides nothing, nor do interpolations with it. Empty if the surface hides nothing.
        tops: (blocks, blocks) float32, the highest `occluding` in a block, or minus infinity.
        bottoms: (blocks, blocks) float32, the lowest depth in a block, infinite in a void one.
        highest_m: the highest of `tops`.
    """

    depth: NDArray[np.float32]
    occluding: NDArray[np.float32]
    tops: NDArray[np.float32]
    bottoms: NDArray[np.float32]
    highest_m: float


class TileVisibility(NamedTuple):
    """What a photo sees of a tile of cells, filled by `look_at_cells`.

    Attributes:
        u: (rows, cols) float32 photo pixels, first centre at 0.5; 0 where not painted.
        v: likewise.
        mask: (rows, cols) uint8 states.
        quality: (rows, cols) float32 photo pixels per cell times the decrease at the border; 0
            where not painted.
    """

    u: NDArray[np.float32]
    v: NDArray[np.float32]
    mask: NDArray[np.uint8]
    quality: NDArray[np.float32]


@compiled
def look_at_cells(
    view: WallView,
    relief: Relief,
    buffer: DepthBuffer,
    visible: TileVisibility,
    first_row: int,
    first_column: int,
) -> None:
    """Project the cells of a tile into a photo and determine which of them it sees.

    Args:
        view: the camera in front of the wall.
        relief: the whole wall.
        buffer: depth buffer of other objects.
        visible: output; its shape is the tile's.
        first_row: row of the wall where the tile begins.
        first_column: column likewise.
    """
    end_row, end_column = first_row + visible.mask.shape[0], first_column + visible.mask.shape[1]
    for block_row in range(first_row // BLOCK_CELLS, (end_row - 1) // BLOCK_CELLS + 1):
        for block in range(first_column // BLOCK_CELLS, (end_column - 1) // BLOCK_CELLS + 1):
            top = _highest_in_the_way(view, relief, block_row, block)
            begin, start = max(first_row, block_row * BLOCK_CELLS), block * BLOCK_CELLS
            start, end = max(first_column, start), min(end_column, start + BLOCK_CELLS)
            for row in range(begin, min(end_row, (block_row + 1) * BLOCK_CELLS)):
                part = TileVisibility(
                    visible.u[row - first_row, start - first_column : end - first_column],
                    visible.v[row - first_row, start - first_column : end - first_column],
                    visible.mask[row - first_row, start - first_column : end - first_column],
                    visible.quality[row - first_row, start - first_column : end - first_column],
                )
                _look_at_row(view, relief, buffer, (row, start, top), part)


@kernel_part
def _look_at_row(
    view: WallView,
    relief: Relief,
    buffer: DepthBuffer,
    place: tuple[int, int, float],
    visible: TileVisibility,
) -> None:
    """Determine which cells of a row of a block a photo sees.

    Args:
        view: the camera in front of the wall.
        relief: the whole wall.
        buffer: depth buffer of other objects.
        place: row of the cells, column of the first one, and the height up to which rays have to
            be followed.
        visible: (n,) arrays of the cells, output.
    """
    row, first_column, top = place
    camera, gsd_m, height_m = view.camera, view.gsd_m, view.height_m
    width, height, border_px = camera[21], camera[22], view.border_px
    cosine_least, tolerance_m, free_m = view.cosine_least, view.tolerance_m, height_m - view.front_m
    depths, nearest, per_pixel = relief.depth[row], buffer.nearest, 1.0 / buffer.reduction
    us, vs, mask, quality = visible.u, visible.v, visible.mask, visible.quality
    y, down = (row + 0.5) * gsd_m, (view.row - row) * gsd_m
    area_m2 = camera[12] * camera[13] * gsd_m * gsd_m
    for j in range(mask.size):
        column = first_column + j
        us[j], vs[j], quality[j] = 0.0, 0.0, 0.0
        depth = float(depths[column])
        if math.isnan(depth):
            mask[j] = NO_SURFACE
            continue
        u, v, along = project_point(camera, (column + 0.5) * gsd_m, y, depth)
        if not (0.0 <= u < width and 0.0 <= v < height):
            mask[j] = OUTSIDE
            continue
        lift, across = height_m - depth, (view.column - column) * gsd_m
        cosine = lift / math.sqrt(lift * lift + across * across + down * down)
        leaves_m = along * free_m / lift - tolerance_m
        mask[j] = OCCLUDED
        if cosine <= cosine_least or nearest[int(v * per_pixel), int(u * per_pixel)] < leaves_m:
            continue
        if depth + tolerance_m < top and _is_hidden(view, relief, row, column, top):
            continue
        mask[j] = PAINTED
        us[j], vs[j] = u, v
        inside = min(width - u, u, height - v, v) / border_px
        quality[j] = cosine * area_m2 / (along * along) * min(1.0, inside)


@kernel_part
def _highest_in_the_way(view: WallView, relief: Relief, row: int, column: int) -> float:
    """Bound the height up to which rays from the cells of a block must be followed.

    On the way to the camera a block shrinks towards the camera's foot, and no ray is lower than
    that of its lowest cell. So what hides any of it lies on the part of the way on which that ray
    is below the highest surface of all; the highest surface there bounds a shorter part.
    """
    tops, top = relief.tops, relief.highest_m
    bottom = float(relief.bottoms[row, column]) + view.tolerance_m
    down = (view.row + 0.5) / BLOCK_CELLS - row - 0.5
    across = (view.column + 0.5) / BLOCK_CELLS - column - 0.5
    for _ in range(2):
        if not bottom < min(top, view.height_m):
            return -math.inf
        share = min(1.0, (top - bottom) / (view.height_m - bottom))
        first_row = max(0, math.floor(row + min(0.0, share * (down + _HALF))))
        end_row = min(tops.shape[0], math.ceil(row + 1 + max(0.0, share * (down - _HALF))))
        first = max(0, math.floor(column + min(0.0, share * (across + _HALF))))
        end = min(tops.shape[1], math.ceil(column + 1 + max(0.0, share * (across - _HALF))))
        top = -math.inf
        for i in range(first_row, end_row):
            for j in range(first, end):
                top = max(top, float(tops[i, j]))
    return top


@kernel_part
def _is_hidden(view: WallView, relief: Relief, row: int, column: int, top: float) -> bool:
    """Follow the ray from a cell to the camera, one row or column at a time, up to a height."""
    surface, depth = relief.occluding, float(relief.depth[row, column])
    down, across = view.row - row, view.column - column
    is_steep = abs(down) >= abs(across)
    # Steps are whole rows or columns; across them the ray moves by a fraction of a cell.
    along, aside, place, beside = (
        (down, across, row, column) if is_steep else (across, down, column, row)
    )
    per_cell, step = 1.0 / max(1.0, abs(along)), 1 if along > 0.0 else -1
    level, rise = depth + view.tolerance_m, (view.height_m - depth) * per_cell
    n_steps = int(min(abs(along), (top - level) / rise))
    n_places, n_beside = surface.shape[0 if is_steep else 1], surface.shape[1 if is_steep else 0]
    for k in range(1, n_steps + 1):
        here, at = place + k * step, beside + k * aside * per_cell
        if not (0 <= here < n_places and 0.0 <= at <= n_beside - 1.0):
            break
        # The surface is linear between the two cells beside the ray, which may be the same.
        first = int(at)
        share, second = at - first, min(first + 1, n_beside - 1)
        if is_steep:
            one, other = float(surface[here, first]), float(surface[here, second])
        else:
            one, other = float(surface[first, here]), float(surface[second, here])
        height = one if share == 0.0 else one + share * (other - one)
        if height > level + k * rise:
            return True
    return False
