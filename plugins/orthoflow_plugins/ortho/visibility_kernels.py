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
    n_rows, n_columns = visible.mask.shape
    first_block, last_block = (
        first_column // BLOCK_CELLS,
        (first_column + n_columns - 1) // BLOCK_CELLS,
    )
    tops, projected = np.empty(last_block - first_block + 1), np.empty((6, n_columns))
    for i in range(n_rows):
        row = first_row + i
        if i == 0 or row % BLOCK_CELLS == 0:
            for k in range(tops.size):
                tops[k] = _highest_in_the_way(view, relief, row // BLOCK_CELLS, first_block + k)
        part = TileVisibility(visible.u[i], visible.v[i], visible.mask[i], visible.quality[i])
        depths = relief.depth[row, first_column : first_column + n_columns]
        _project_row(view, depths, (row, first_column), projected)
        _look_at_row(view, relief, buffer, (row, first_column), tops, projected, part)


@kernel_part
def _project_row(
    view: WallView,
    depths: NDArray[np.float32],
    place: tuple[int, int],
    projected: NDArray[np.float64],
) -> None:
    """Project cells of a row, void or not, in loops without branches: several cells at once.

    Args:
        view: the camera in front of the wall.
        depths: (n,) of the cells.
        place: row of the cells, column of the first one.
        projected: (6, n or more) overwritten with u, v, distance along the axis, cosine of
            incidence, the least distance at which nothing is in the way, and quality.
    """
    row, first_column = place
    camera, gsd_m, height_m = view.camera, view.gsd_m, view.height_m
    us, vs, alongs = projected[0], projected[1], projected[2]
    cosines, leaves_m, qualities = projected[3], projected[4], projected[5]
    y = (row + 0.5) * gsd_m
    for j in range(depths.size):
        x = (first_column + j + 0.5) * gsd_m
        us[j], vs[j], alongs[j] = project_point(camera, x, y, float(depths[j]))
    width, height, border_px = camera[21], camera[22], view.border_px
    tolerance_m, free_m = view.tolerance_m, height_m - view.front_m
    down, view_column = (view.row - row) * gsd_m, view.column
    area_m2 = camera[12] * camera[13] * gsd_m * gsd_m
    for j in range(depths.size):
        u, v, along = us[j], vs[j], alongs[j]
        lift = height_m - float(depths[j])
        across = (view_column - (first_column + j)) * gsd_m
        cosine = lift / math.sqrt(lift * lift + across * across + down * down)
        inside = min(width - u, u, height - v, v) / border_px
        cosines[j] = cosine
        leaves_m[j] = along * free_m / lift - tolerance_m
        qualities[j] = cosine * area_m2 / (along * along) * min(1.0, inside)


@kernel_part
def _look_at_row(
    view: WallView,
    relief: Relief,
    buffer: DepthBuffer,
    place: tuple[int, int],
    tops: NDArray[np.float64],
    projected: NDArray[np.float64],
    visible: TileVisibility,
) -> None:
    """Determine which cells of a row a photo sees.

    Args:
        view: the camera in front of the wall.
        relief: the whole wall.
        buffer: depth buffer of other objects.
        place: row of the cells, column of the first one.
        tops: height up to which rays have to be followed, of each block that has some of the cells.
        projected: from `_project_row`.
        visible: (n,) arrays of the cells, output.
    """
    row, first_column = place
    before = first_column % BLOCK_CELLS
    width, height = view.camera[21], view.camera[22]
    cosine_least, tolerance_m = view.cosine_least, view.tolerance_m
    nearest, per_pixel = buffer.nearest, 1.0 / buffer.reduction
    us, vs, cosines, leaves_m = projected[0], projected[1], projected[3], projected[4]
    depths = relief.depth[row, first_column : first_column + visible.mask.size]
    for j in range(visible.mask.size):
        u, v, depth, top = us[j], vs[j], float(depths[j]), tops[(before + j) // BLOCK_CELLS]
        state = PAINTED
        if math.isnan(depth):
            state = NO_SURFACE
        elif not (0.0 <= u < width and 0.0 <= v < height):
            state = OUTSIDE
        elif (
            cosines[j] <= cosine_least
            or nearest[np.uintp(v * per_pixel), np.uintp(u * per_pixel)] < leaves_m[j]
            or (depth + tolerance_m < top and _is_hidden(view, relief, row, first_column + j, top))
        ):
            state = OCCLUDED
        is_painted = state == PAINTED
        visible.mask[j] = state
        visible.u[j] = u if is_painted else 0.0
        visible.v[j] = v if is_painted else 0.0
        visible.quality[j] = projected[5, j] if is_painted else 0.0


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
