"""Compiled function that finds the cells visible in a photo, and their positions in the photo."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part
from orthoflow.geometry.depth_buffer_kernels import DepthBuffer

# Rays from all cells of a block are traced up to a common height. This height is computed for small
# blocks only if that of the large block does not exclude occlusion.
BLOCK_CELLS: Final = 32
FINE_CELLS: Final = 8

# Cells of a row are projected in float32, in runs of this length and relative to the first cell of
# the run. Each run begins at a multiple of this length, so that results do not depend on the tile.
_RUN_CELLS: Final = 512
_N_QUANTITIES: Final = 6

# States of a cell, equal to those in `LayerMask`.
OUTSIDE: Final = 0
PAINTED: Final = 1
OCCLUDED: Final = 2
NO_SURFACE: Final = 3


class AxisView(NamedTuple):
    """A camera in the axes of a cylinder, cone or sphere (see `bends.Revolution`).

    Attributes:
        first: coordinate of the projection centre towards angle 0.
        second: its coordinate towards an angle of 90 degrees.
        axial: its coordinate along the axis.
        radius_m: radius of a cylinder or sphere; 0 for a cone.
        sine: sine of the half angle of a cone; 0 for a cylinder or sphere.
        cosine: cosine of the half angle.
        side: 1 if the surface is seen from outside, and -1 from inside; 0 for a plane.
        middle_rad: angle opposite of which the surface is cut.
        place_x: position of distance 0 and angle 0 on the raster, to the right, in metres.
        place_y: its position downwards.
        along_x: direction of the generatrix of angle 0 on the raster.
        along_y: see `along_x`.
        aside_x: direction of increasing angles on the raster, perpendicular to it.
        aside_y: see `aside_x`.
        fan: angle between two generatrices on the raster, per angle about the axis.
        round: 1 for a sphere, whose distances are those from the centre; 0 for other surfaces.
    """

    first: float
    second: float
    axial: float
    radius_m: float
    sine: float
    cosine: float
    side: float
    middle_rad: float
    place_x: float
    place_y: float
    along_x: float
    along_y: float
    aside_x: float
    aside_y: float
    fan: float
    round: float


_PLANE: Final = AxisView(*(16 * (0.0,)))
_NO_CAMERA: Final = np.zeros(25)


class WallView(NamedTuple):
    """A camera in the axes of a wall.

    Attributes:
        camera: (25,) flat camera (see `camera_kernels`) for points (u, v, n) in metres from the
            wall frame's origin.
        column: column of the projection centre, 0 at the centre of the first cell; the same applies
            to `row`.
        height_m: height of the projection centre above the plane.
        gsd_m: side of a cell.
        front_m: largest depth of the relief; the depth buffer contains only points in front of it.
        tolerance_m: minimum height above a ray at which the surface blocks that ray.
        cosine_least: smallest cosine of the angle of incidence of visible cells.
        outline_m: distance from the outline of a curved surface, besides one pixel, within which a
            photo may show what is behind the surface.
        border_px: width of the strip along the image border in which quality decreases to 0.
        about: the camera in the axes of a curved surface. The axes of the wall are then those at
            the top-left corner of its raster.
        axial_camera: (25,) flat camera for points in the axes of a curved surface from `start`.
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
    outline_m: float = 0.0
    about: AxisView = _PLANE
    axial_camera: NDArray[np.float64] = _NO_CAMERA


class Relief(NamedTuple):
    """The surface of a wall, and the surface that hides other cells.

    Attributes:
        depth: (rows, cols) float32 metres, NaN where void.
        occluding: (rows, cols) float32 depth without spikes, minus infinity where void, so that
            voids block no ray; empty if the surface hides nothing.
        tops: (blocks, blocks) float32 largest value of `occluding` in a block.
        bottoms: (blocks, blocks) float32 smallest depth in a block, infinite if the block is void.
        fine_tops: `tops` for blocks of `FINE_CELLS` if the surface can hide cells; `fine_bottoms`
            is the same for `bottoms`.
        highest_m: largest value of `tops`.
    """

    depth: NDArray[np.float32]
    occluding: NDArray[np.float32]
    tops: NDArray[np.float32]
    bottoms: NDArray[np.float32]
    fine_tops: NDArray[np.float32]
    fine_bottoms: NDArray[np.float32]
    highest_m: float


class TileVisibility(NamedTuple):
    """Visibility of the cells of a tile in a photo, filled by `look_at_cells`.

    Attributes:
        u: (rows, cols) float32 photo column, first pixel centre at 0.5; 0 where not visible.
        v: (rows, cols) float32 photo row, with the same convention.
        mask: (rows, cols) uint8 state of the cell.
        quality: (rows, cols) float32 photo pixels per cell, reduced at the border; 0 where not
            visible.
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
    """Project the cells of a tile into a photo and find those that are visible.

    Args:
        view: the camera in the axes of the wall.
        relief: the surface of the whole wall.
        buffer: depth buffer of objects in front of the wall.
        visible: output, with the shape of the tile.
        first_row: first row of the tile on the wall.
        first_column: first column of the tile on the wall.
    """
    n_rows, n_columns = visible.mask.shape
    end_column, first_block = first_column + n_columns, first_column // FINE_CELLS
    tops = np.empty((end_column - 1) // FINE_CELLS + 1 - first_block)
    steps = np.arange(_RUN_CELLS).astype(np.float32)
    projected = np.empty((_N_QUANTITIES, _RUN_CELLS), dtype=np.float32)
    places = np.empty(_RUN_CELLS, dtype=np.int32)
    occluding, tolerance_m = relief.occluding.reshape(-1), view.tolerance_m
    eye = (view.row, view.column, view.height_m)
    for i in range(n_rows):
        row = first_row + i
        if i == 0 or row % FINE_CELLS == 0:
            _bound_rays(view, relief, row // FINE_CELLS, first_block, tops)
        start = first_column
        while start < end_column:
            run = start // _RUN_CELLS * _RUN_CELLS
            end = min(end_column, run + _RUN_CELLS)
            depths, in_tile = relief.depth[row, start:end], start - first_column
            mask = visible.mask[i, in_tile : end - first_column]
            _project_run(view, depths, (row, run), steps[start - run : end - run], projected)
            _set_states(view, buffer, depths, projected, places, mask)
            for k in range(start // FINE_CELLS, (end - 1) // FINE_CELLS + 1):
                top = tops[k - first_block]
                if top > -math.inf:
                    first, last = max(start, k * FINE_CELLS), min(end, (k + 1) * FINE_CELLS)
                    lows, cells = depths[first - start : last - start], mask[first - start :]
                    place = (row, first, relief.depth.shape[0], relief.depth.shape[1])
                    _hide_low_cells(occluding, eye, tolerance_m, top, place, lows, cells)
            _keep_painted(mask, projected[0], visible.u[i, in_tile : end - first_column])
            _keep_painted(mask, projected[1], visible.v[i, in_tile : end - first_column])
            _keep_painted(mask, projected[5], visible.quality[i, in_tile : end - first_column])
            start = end


@kernel_part
def _project_run(
    view: WallView,
    depths: NDArray[np.float32],
    place: tuple[int, int],
    steps: NDArray[np.float32],
    projected: NDArray[np.float32],
) -> None:
    """Project the cells of a row, including void cells, like `camera_kernels.project_point`.

    Each loop has no branches and writes to one array only, so that the compiler can vectorise it;
    constants of another type would prevent that.

    Args:
        view: the camera in the axes of the wall.
        depths: (n,) depths of the cells.
        place: row of the cells, and column of the first cell of the run.
        steps: (n,) columns relative to the first one.
        projected: (_N_QUANTITIES, n or more), overwritten with u, v, the inverse distance along the
            optical axis, the cosine of the angle of incidence, the distance beyond which objects do
            not hide the cell, and the quality; u is -1 for cells behind the camera or outside the
            valid range of the lens model.
    """
    row, first_column = place
    c, gsd_m, f = view.camera, view.gsd_m, np.float32
    # Compute the first cell in float64, to keep the precision on large walls.
    x, y = (first_column + 0.5) * gsd_m, (row + 0.5) * gsd_m
    x0, y0 = f(c[0] * x + c[1] * y + c[9]), f(c[3] * x + c[4] * y + c[10])
    z0 = f(c[6] * x + c[7] * y + c[11])
    xu, yu, zu = f(c[0] * gsd_m), f(c[3] * gsd_m), f(c[6] * gsd_m)
    xn, yn, zn = f(c[2]), f(c[5]), f(c[8])
    fx, fy, cx, cy, skew = f(c[12]), f(c[13]), f(c[14]), f(c[15]), f(c[24])
    k1, k2, k3, p1, p2 = f(c[16]), f(c[17]), f(c[20]), f(c[18]), f(c[19])
    zero, one, two, farthest = f(0.0), f(1.0), f(2.0), f(c[23] * c[23])
    us, vs, nears, qualities = projected[0], projected[1], projected[2], projected[5]
    cosines, leaves_m = projected[3], projected[4]
    for j in range(depths.size):
        nears[j] = one / (z0 + zu * steps[j] + zn * depths[j])
    for j in range(depths.size):
        us[j] = (x0 + xu * steps[j] + xn * depths[j]) * nears[j]
    # These rows are used as work space until their own quantities are computed.
    bs = cosines
    for j in range(depths.size):
        bs[j] = (y0 + yu * steps[j] + yn * depths[j]) * nears[j]
    for j in range(depths.size):
        a, b = us[j], bs[j]
        r2 = a * a + b * b
        radial = one + r2 * (k1 + r2 * (k2 + r2 * k3))
        vs[j] = b * radial + p1 * (r2 + two * b * b) + two * p2 * a * b
    for j in range(depths.size):
        a, b = us[j], bs[j]
        r2 = a * a + b * b
        radial = one + r2 * (k1 + r2 * (k2 + r2 * k3))
        u = fx * (a * radial + two * p1 * a * b + p2 * (r2 + two * a * a)) + cx + skew * vs[j]
        us[j] = u if (r2 <= farthest) & (nears[j] > zero) else -one
    for j in range(depths.size):
        vs[j] = fy * vs[j] + cy
    height_m, foot, side_m = f(view.height_m), f(view.column - first_column), f(gsd_m)
    down_m = f((view.row - row) * gsd_m)
    for j in range(depths.size):
        lift, across = height_m - depths[j], (foot - steps[j]) * side_m
        cosines[j] = lift / math.sqrt(lift * lift + across * across + down_m * down_m)
    free_m, tolerance_m = f(view.height_m - view.front_m), f(view.tolerance_m)
    for j in range(depths.size):
        leaves_m[j] = free_m / (nears[j] * (height_m - depths[j])) - tolerance_m
    width, height, per_border = f(c[21]), f(c[22]), f(1.0 / view.border_px)
    area_m2 = f(c[12] * c[13] * gsd_m * gsd_m)
    for j in range(depths.size):
        inside = min(width - us[j], us[j], height - vs[j], vs[j]) * per_border
        qualities[j] = cosines[j] * area_m2 * nears[j] * nears[j] * min(one, inside)


@kernel_part
def _set_states(
    view: WallView,
    buffer: DepthBuffer,
    depths: NDArray[np.float32],
    projected: NDArray[np.float32],
    places: NDArray[np.int32],
    mask: NDArray[np.uint8],
) -> None:
    """Set the states of cells, ignoring occlusion by the relief.

    Args:
        view: the camera in the axes of the wall.
        buffer: depth buffer of objects in front of the wall.
        depths: (n,) depths of the cells.
        projected: output of `_project_run`; the row of inverse distances is overwritten.
        places: (n or more,) work array.
        mask: (n,) states, output.
    """
    f = np.float32
    us, vs, nearests = projected[0], projected[1], projected[2]
    cosines, leaves_m, nearest = projected[3], projected[4], buffer.nearest.reshape(-1)
    width, height, zero = f(view.camera[21]), f(view.camera[22]), f(0.0)
    per_pixel, stride = f(1.0 / buffer.reduction), np.int32(buffer.nearest.shape[1])
    last_row, last_column = np.int32(buffer.nearest.shape[0] - 1), stride - np.int32(1)
    cosine_least = f(view.cosine_least)
    for j in range(mask.size):
        u, v = us[j], vs[j]
        is_inside = (u >= zero) & (u < width) & (v >= zero) & (v < height)
        at_row, at_column = v * per_pixel, u * per_pixel
        # Near the border, the quotient may be rounded up beyond the last pixel of the buffer.
        down = min(np.int32(at_row if is_inside else zero), last_row)
        places[j] = down * stride + min(np.int32(at_column if is_inside else zero), last_column)
    for j in range(mask.size):
        nearests[j] = nearest[np.uintp(places[j])]
    outside, painted = np.uint8(OUTSIDE), np.uint8(PAINTED)
    occluded, no_surface = np.uint8(OCCLUDED), np.uint8(NO_SURFACE)
    for j in range(mask.size):
        u, v = us[j], vs[j]
        is_inside = (u >= zero) & (u < width) & (v >= zero) & (v < height)
        is_hidden = (cosines[j] <= cosine_least) | (nearests[j] < leaves_m[j])
        state = (occluded if is_hidden else painted) if is_inside else outside
        mask[j] = no_surface if math.isnan(depths[j]) else state


@kernel_part
def _keep_painted(
    mask: NDArray[np.uint8], values: NDArray[np.float32], kept: NDArray[np.float32]
) -> None:
    painted, zero = np.uint8(PAINTED), np.float32(0.0)
    for j in range(mask.size):
        kept[j] = values[j] if mask[j] == painted else zero


@kernel_part
def _hide_low_cells(
    surface: NDArray[np.float32],
    eye: tuple[float, float, float],
    tolerance_m: float,
    top: float,
    place: tuple[int, int, int, int],
    depths: NDArray[np.float32],
    mask: NDArray[np.uint8],
) -> None:
    """Trace rays towards the camera from the cells of a row that are not yet hidden.

    Tracing ends at the height `top`. A ray advances by one row or one column at a time, along the
    axis on which it is longer.

    Args:
        surface: (cells of the wall,) occluding surface, flattened.
        eye: row, column and height of the projection centre.
        tolerance_m: minimum height above a ray at which the surface blocks that ray.
        top: height above which nothing can hide the cells.
        place: row and first column of the cells; number of rows and columns of the wall.
        depths: (n,) depths of the cells.
        mask: (n or more,) states, updated.
    """
    row, first_column, n_rows, n_columns = place
    eye_row, eye_column, height_m = eye
    down, zero = eye_row - row, np.float32(0.0)
    for j in range(depths.size):
        column = first_column + j
        level = float(depths[j]) + tolerance_m
        if not (mask[j] == PAINTED and level < top):
            continue
        across = eye_column - column
        if abs(down) >= abs(across):
            along, aside, here, at = down, across, row, float(column)
            stride, side, n_here, n_beside = n_columns, 1, n_rows, n_columns
        else:
            along, aside, here, at = across, down, column, float(row)
            stride, side, n_here, n_beside = 1, n_columns, n_columns, n_rows
        per_cell, step = 1.0 / max(1.0, abs(along)), stride if along > 0.0 else -stride
        rise, move = (height_m - float(depths[j])) * per_cell, aside * per_cell
        n_left = n_here - 1 - here if along > 0.0 else here
        n_steps, last = min(n_left, int(min(abs(along), (top - level) / rise))), n_beside - 1.0
        if not 0.0 <= at + n_steps * move <= last:
            n_steps = int((last - at if move > 0.0 else at) / abs(move))
        start = here * stride
        for _ in range(n_steps):
            start, at, level = start + step, at + move, level + rise
            # Interpolate the surface between the two cells on either side of the ray. Indices are
            # clipped because rounding errors could lead outside the wall.
            first = int(at)
            share, second = np.float32(at - first), min(first + 1, n_beside - 1)
            one = surface[np.uintp(start + first * side)]
            other = surface[np.uintp(start + (second if share > zero else first) * side)]
            if one + share * (other - one) > level:
                mask[j] = OCCLUDED
                break


@kernel_part
def _bound_rays(
    view: WallView, relief: Relief, row: int, first_column: int, highest: NDArray[np.float64]
) -> None:
    """Compute the heights up to which rays from fine blocks must be traced; -inf if not at all.

    Args:
        view: the camera in the axes of the wall.
        relief: the surface of the wall.
        row: row of the blocks.
        first_column: column of the first block.
        highest: (blocks,) output.
    """
    per_block, large, top = BLOCK_CELLS // FINE_CELLS, -1, -math.inf
    for k in range(highest.size):
        column = first_column + k
        if column // per_block != large:
            large = column // per_block
            block = (row // per_block, large)
            top = _highest_in_the_way(
                view, relief.tops, relief.bottoms[block], BLOCK_CELLS, block, relief.highest_m
            )
        highest[k] = -math.inf
        if top > -math.inf:
            block = (row, column)
            highest[k] = _highest_in_the_way(
                view, relief.fine_tops, relief.fine_bottoms[block], FINE_CELLS, block, top
            )


@kernel_part
def _highest_in_the_way(
    view: WallView,
    tops: NDArray[np.float32],
    bottom: float,
    side_cells: int,
    block: tuple[int, int],
    top: float,
) -> float:
    """Return an upper bound of the height up to which rays from a block must be traced.

    The rays from a block converge towards the camera, and none is lower than the ray from the
    lowest cell. A surface can hide the block only where this lowest ray is below the highest point
    of the wall. The highest surface along this part of the ray gives a tighter bound.

    Args:
        view: the camera in the axes of the wall.
        tops: (blocks, blocks) largest height in each block.
        bottom: smallest depth in the block.
        side_cells: side of a block in cells.
        block: row and column of the block.
        top: height above which nothing can hide the cells of the block.
    """
    row, column = block
    # Distance, in blocks, from the middle of a block to the centre of its last cell, plus half a
    # cell because a ray is tested against the cells on both sides.
    half = 0.5 - 0.5 / side_cells
    bottom += view.tolerance_m
    down = (view.row + 0.5) / side_cells - row - 0.5
    across = (view.column + 0.5) / side_cells - column - 0.5
    for _ in range(2):
        if not bottom < min(top, view.height_m):
            return -math.inf
        share = min(1.0, (top - bottom) / (view.height_m - bottom))
        first_row = max(0, math.floor(row + min(0.0, share * (down + half))))
        end_row = min(tops.shape[0], math.ceil(row + 1 + max(0.0, share * (down - half))))
        first = max(0, math.floor(column + min(0.0, share * (across + half))))
        end = min(tops.shape[1], math.ceil(column + 1 + max(0.0, share * (across - half))))
        top = -math.inf
        for i in range(first_row, end_row):
            for j in range(first, end):
                top = max(top, float(tops[i, j]))
    return top
