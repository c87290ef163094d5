"""Compiled passes that determine which cells of a wall a photo sees, and their photo positions."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled
from orthoflow.geometry.depth_buffer_kernels import DepthBuffer
from orthoflow_plugins.ortho.block_kernels import (
    HIDDEN,
    UNSURE,
    WIDE_BLOCKS,
    BlockRoom,
    judge_block,
    look_at_hidden_block,
    look_at_unoccluded_block,
    room_for_blocks,
    span_block,
)
from orthoflow_plugins.ortho.ray_kernels import (
    COLUMN,
    IS_HIDDEN,
    ROW,
    eye_of,
    follow_rays,
    hide_low_cells,
    highest_in_the_way,
)
from orthoflow_plugins.ortho.views import (
    BLOCK_CELLS,
    NO_SURFACE,
    OCCLUDED,
    OUTSIDE,
    PAINTED,
    Relief,
    TileVisibility,
    WallView,
)

# Distance of the two depths that represent a level block.
_LEAST_SPAN_M: Final = 1e-3


class RowVisibility(NamedTuple):
    """Part of a row of a `TileVisibility`: u, v, mask and quality of its cells (n,)."""

    u: NDArray[np.float32]
    v: NDArray[np.float32]
    mask: NDArray[np.uint8]
    quality: NDArray[np.float32]


@compiled
def project_row(
    view: WallView, relief: Relief, row: int, first_column: int, lanes: NDArray[np.float64]
) -> None:
    """Project some cells of a row without branches, so that several are processed at once.

    Args:
        view: the camera in front of the wall.
        relief: the wall.
        row: of the cells.
        first_column: of the first cell.
        lanes: (5, n) output: u (-1 where the camera cannot see), v, depth along the axis where the
            ray leaves the slab that the raster describes, cosine of incidence, and photo pixels per
            cell.
    """
    # The formula of `camera_kernels.project_point`, which has branches: without branches, and with
    # the camera in local variables, it takes a third of the time. A test compares the two.
    camera, gsd_m = view.camera, view.gsd_m
    xu, xv, xn, tx = camera[0], camera[1], camera[2], camera[9]
    yu, yv, yn, ty = camera[3], camera[4], camera[5], camera[10]
    zu, zv, zn, tz = camera[6], camera[7], camera[8], camera[11]
    fx, fy, cx, cy = camera[12], camera[13], camera[14], camera[15]
    k1, k2, p1, p2, k3 = camera[16], camera[17], camera[18], camera[19], camera[20]
    farthest, skew = camera[23] * camera[23], camera[24]
    height_m, free_m, tolerance_m = view.height_m, view.height_m - view.front_m, view.tolerance_m
    foot, down = view.column, (view.row - row) * gsd_m
    y, depths = (row + 0.5) * gsd_m, relief.depth[row]
    us, vs, leaves, cosines, pixels = lanes[0], lanes[1], lanes[2], lanes[3], lanes[4]
    for k in range(lanes.shape[1]):
        column, depth = float(first_column + k), float(depths[first_column + k])
        x = (column + 0.5) * gsd_m
        zc = zu * x + zv * y + zn * depth + tz
        per_zc = 1.0 / zc
        a = (xu * x + xv * y + xn * depth + tx) * per_zc
        b = (yu * x + yv * y + yn * depth + ty) * per_zc
        r2 = a * a + b * b
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        ad = a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a)
        bd = b * radial + p1 * (r2 + 2.0 * b * b) + 2.0 * p2 * a * b
        us[k] = fx * ad + cx + skew * bd if (zc > 1e-9) & (r2 <= farthest) else -1.0
        vs[k] = fy * bd + cy
        lift, across = height_m - depth, (foot - column) * gsd_m
        leaves[k] = zc * free_m / lift - tolerance_m
        cosine = lift / math.sqrt(lift * lift + across * across + down * down)
        cosines[k] = cosine
        pixels[k] = cosine * fx * fy * gsd_m * gsd_m * per_zc * per_zc


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

    Blocks that the photo sees entirely are fast; in the others every cell is tested and projected
    by itself.

    Args:
        view: the camera in front of the wall.
        relief: the whole wall.
        buffer: depth buffer of other objects.
        visible: output; its shape is the tile's.
        first_row: row of the wall where the tile begins.
        first_column: column likewise.
    """
    end_row, end_column = (
        first_row + visible.mask.shape[0],
        first_column + visible.mask.shape[1],
    )
    tile = (first_row, first_column, end_row, end_column)
    room = room_for_blocks(relief, visible)
    wide, n_blocks = WIDE_BLOCKS * BLOCK_CELLS, relief.bottoms.shape[1]
    summary = visible.summary
    summary[:] = 0.0
    summary[0], summary[1] = math.inf, -math.inf
    summary[2], summary[3] = math.inf, -math.inf
    for block_row in range(first_row // BLOCK_CELLS, (end_row - 1) // BLOCK_CELLS + 1):
        for wide_column in range(first_column // wide, (end_column - 1) // wide + 1):
            first = wide_column * WIDE_BLOCKS
            end = min(n_blocks, first + WIDE_BLOCKS)
            if look_at_blocks(view, relief, buffer, visible, room, tile, (block_row, first, end)):
                continue
            first = max(first, first_column // BLOCK_CELLS)
            end = min(end, (end_column - 1) // BLOCK_CELLS + 1)
            for column in range(first, end):
                blocks = (block_row, column, column + 1)
                if not look_at_blocks(view, relief, buffer, visible, room, tile, blocks):
                    _ask_each_cell(view, relief, buffer, visible, room, tile, (block_row, column))


@compiled
def look_at_blocks(
    view: WallView,
    relief: Relief,
    buffer: DepthBuffer,
    visible: TileVisibility,
    room: BlockRoom,
    tile: tuple[int, int, int, int],
    blocks: tuple[int, int, int],
) -> bool:
    """Fill adjacent blocks if the photo certainly sees all of them, or none.

    Args:
        view: the camera in front of the wall.
        relief: the wall.
        buffer: depth buffer of other objects.
        visible: of the tile, partly filled.
        room: from `room_for_blocks`.
        tile: its first row and column, and the row and column after its last ones.
        blocks: row of the blocks, column of the first one, and the column after the last one.

    Returns:
        Whether they were filled.
    """
    block_row, first, end = blocks
    # Whole blocks are tested, whatever part of them is in the tile: results must not depend on
    # tiles.
    rows = (block_row * BLOCK_CELLS, min(relief.depth.shape[0], (block_row + 1) * BLOCK_CELLS) - 1)
    columns = (first * BLOCK_CELLS, min(relief.depth.shape[1], end * BLOCK_CELLS) - 1)
    bottom, crest = math.inf, -math.inf
    for column in range(first, end):
        bottom = min(bottom, float(relief.bottoms[block_row, column]))
        crest = max(crest, float(relief.crests[block_row, column]))
    depths = (bottom, max(crest, bottom + _LEAST_SPAN_M))
    if view.is_exact or bottom > crest or depths[1] >= view.height_m:
        return False
    if not span_block(view, depths, rows, columns, room.nodes):
        return False
    verdict = judge_block(view, buffer, depths[1], rows, columns, room.nodes, room.box)
    if verdict == UNSURE:
        return False
    place = _place_in_tile(tile, rows, columns)
    if verdict == HIDDEN:
        look_at_hidden_block(relief, visible, place)
        return True
    n_seen = look_at_unoccluded_block(view, room, place, (rows, columns), depths)
    for column in range(first, end):
        block = (block_row, column)
        top = _highest(view, relief, block)
        if float(relief.bottoms[block]) + view.tolerance_m < top:
            corner, area = (tile[0], tile[1]), _cells_in_tile(tile, block)
            n_seen -= hide_low_cells(view, relief, visible.mask, corner, area, top, room.rays)
    if n_seen:
        summary, box = visible.summary, room.box
        summary[0], summary[1] = min(summary[0], box[0]), max(summary[1], box[1])
        summary[2], summary[3] = min(summary[2], box[2]), max(summary[3], box[3])
        summary[4] += n_seen
        summary[5] += n_seen * (place[1] + 0.5 * (place[3] - 1))
        summary[6] += n_seen * (place[0] + 0.5 * (place[2] - 1))
        summary[7] += n_seen * 0.5 * (bottom + crest)
    return True


@compiled
def _place_in_tile(
    tile: tuple[int, int, int, int], rows: tuple[int, int], columns: tuple[int, int]
) -> tuple[int, int, int, int, int, int]:
    """The `place` of `look_at_unoccluded_block` for blocks with these first and last cells."""
    begin, finish = max(tile[0], rows[0]), min(tile[2], rows[1] + 1)
    start, end = max(tile[1], columns[0]), min(tile[3], columns[1] + 1)
    return (begin, start, finish - begin, end - start, begin - tile[0], start - tile[1])


@compiled
def _highest(view: WallView, relief: Relief, block: tuple[int, int]) -> float:
    """Bound the height up to which the rays from a block must be followed."""
    bottom, eye = float(relief.bottoms[block]), eye_of(view, relief)
    return highest_in_the_way(eye, relief.tops, bottom, BLOCK_CELLS, block, relief.highest_m)


@compiled
def _cells_in_tile(
    tile: tuple[int, int, int, int], block: tuple[int, int]
) -> tuple[int, int, int, int]:
    """First row and column of a block's cells in a tile, and those after the last ones."""
    begin, start = block[0] * BLOCK_CELLS, block[1] * BLOCK_CELLS
    return (
        max(tile[0], begin),
        max(tile[1], start),
        min(tile[2], begin + BLOCK_CELLS),
        min(tile[3], start + BLOCK_CELLS),
    )


@compiled
def _ask_each_cell(
    view: WallView,
    relief: Relief,
    buffer: DepthBuffer,
    visible: TileVisibility,
    room: BlockRoom,
    tile: tuple[int, int, int, int],
    block: tuple[int, int],
) -> None:
    """Project the cells of a block one by one, and test for each whether the photo sees it."""
    top = _highest(view, relief, block)
    begin, start, finish, end = _cells_in_tile(tile, block)
    for row in range(begin, finish):
        into = _part(visible, row - tile[0], start - tile[1], end - start)
        project_row(view, relief, row, start, room.lanes[:, : end - start])
        look_at_row(view, relief, buffer, (row, start, top), room, into, visible.summary)


@compiled
def _part(visible: TileVisibility, row: int, first_column: int, n_cells: int) -> RowVisibility:
    end = first_column + n_cells
    return RowVisibility(
        visible.u[row, first_column:end],
        visible.v[row, first_column:end],
        visible.mask[row, first_column:end],
        visible.quality[row, first_column:end],
    )


@compiled
def look_at_row(
    view: WallView,
    relief: Relief,
    buffer: DepthBuffer,
    place: tuple[int, int, float],
    room: BlockRoom,
    into: RowVisibility,
    summary: NDArray[np.float64],
) -> None:
    """Test for each cell of a row whether the photo sees it.

    Args:
        view: the camera in front of the wall.
        relief: the wall.
        buffer: depth buffer of other objects.
        place: row of the cells, column of the first one, and the height up to which rays have to
            be followed.
        room: its lanes are those of `project_row`.
        into: filled.
        summary: of the `TileVisibility`, updated.
    """
    us, vs, mask, quality = into.u, into.v, into.mask, into.quality
    row, first_column, top = place
    width, image_height = view.camera[21], view.camera[22]
    per_pixel, per_border = 1.0 / buffer.reduction, 1.0 / view.border_px
    # Values in a tuple are read once: each access costs as much as a projection.
    depths, nearest, lanes, rays = relief.depth[row], buffer.nearest, room.lanes, room.rays
    cosine_least, tolerance_m = view.cosine_least, view.tolerance_m
    n_low = 0
    for k in range(mask.size):
        depth, u, v = float(depths[first_column + k]), lanes[0, k], lanes[1, k]
        if math.isnan(depth):
            mask[k] = NO_SURFACE
        elif not (0.0 <= u < width and 0.0 <= v < image_height):
            mask[k] = OUTSIDE
        elif (
            lanes[3, k] <= cosine_least
            or nearest[int(v * per_pixel), int(u * per_pixel)] < lanes[2, k]
        ):
            mask[k] = OCCLUDED
        else:
            mask[k] = PAINTED
            if depth + tolerance_m < top:
                rays[n_low, ROW], rays[n_low, COLUMN] = row, first_column + k
                n_low += 1
    follow_rays(eye_of(view, relief), relief.depth, relief.occluding, top, n_low, rays)
    for i in range(n_low):
        if rays[i, IS_HIDDEN]:
            mask[rays[i, COLUMN] - first_column] = OCCLUDED
    for k in range(mask.size):
        u, v = lanes[0, k], lanes[1, k]
        if mask[k] != PAINTED:
            us[k], vs[k] = 0.0, 0.0
            continue
        inside = min(width - u, u, image_height - v, v) * per_border
        quality[k] = lanes[4, k] * min(1.0, inside)
        us[k], vs[k] = u, v
        summary[0], summary[1] = min(summary[0], u), max(summary[1], u)
        summary[2], summary[3] = min(summary[2], v), max(summary[3], v)
        summary[4] += 1
        summary[5] += first_column + k
        summary[6] += row
        summary[7] += depths[first_column + k]
