"""Compiled passes that tell which cells of a wall a photo sees, and where in the photo they are."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.block_verdict_kernels import HIDDEN, UNSURE, judge_block
from orthoflow.geometry.plain_block_kernels import (
    WIDE_BLOCKS,
    BlockRoom,
    look_at_hidden_block,
    look_at_plain_block,
    room_for_blocks,
    span_block,
)
from orthoflow.geometry.visibility_kernels import (
    BLOCK_CELLS,
    FINE_CELLS,
    NO_SURFACE,
    OCCLUDED,
    OUTSIDE,
    PAINTED,
    DepthBuffer,
    Relief,
    Sight,
    WallView,
    compiled,
    highest_in_the_way,
    is_hidden_by_relief,
)

# Two depths that stand for a level block lie so far apart.
_LEAST_SPAN_M: Final = 1e-3


class SightRow(NamedTuple):
    """Part of a row of a `Sight`: u, v, mask and quality of its cells (n,)."""

    u: NDArray[np.float32]
    v: NDArray[np.float32]
    mask: NDArray[np.uint8]
    quality: NDArray[np.float32]


@compiled
def project_row(
    view: WallView, relief: Relief, row: int, first_column: int, lanes: NDArray[np.float64]
) -> None:
    """Project some cells of a row; nothing here branches, so several go at once.

    Args:
        view: the camera before the wall.
        relief: the wall.
        row: of the cells.
        first_column: of the first cell.
        lanes: (5, n) filled with u (-1 where the camera cannot see), v, depth along the axis where
            the ray leaves the slab that the raster describes, cosine of incidence, and photo
            pixels per cell.
    """
    # The formula of `camera_kernels.project_point`, which branches: without branches, and with the
    # camera in variables of its own, it takes a third of the time. A test holds the two together.
    camera, gsd_m = view.camera, view.gsd_m
    xu, xv, xn, tx = camera[0], camera[1], camera[2], camera[9]
    yu, yv, yn, ty = camera[3], camera[4], camera[5], camera[10]
    zu, zv, zn, tz = camera[6], camera[7], camera[8], camera[11]
    fx, fy, cx, cy = camera[12], camera[13], camera[14], camera[15]
    k1, k2, p1, p2, k3 = camera[16], camera[17], camera[18], camera[19], camera[20]
    farthest = camera[23] * camera[23]
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
        us[k] = fx * ad + cx if (zc > 1e-9) & (r2 <= farthest) else -1.0
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
    sight: Sight,
    first_row: int,
    first_column: int,
) -> None:
    """Project the cells of a tile into a photo and tell which of them it sees.

    Blocks that the photo sees as a whole go fast; in the others every cell is asked and projected
    by itself.

    Args:
        view: the camera before the wall.
        relief: the whole wall.
        buffer: what else stands before the camera.
        sight: filled; its shape is the tile's.
        first_row: row of the wall where the tile begins.
        first_column: column likewise.
    """
    end_row, end_column = first_row + sight.mask.shape[0], first_column + sight.mask.shape[1]
    tile = (first_row, first_column, end_row, end_column)
    lanes, room = np.empty((5, BLOCK_CELLS)), room_for_blocks(relief, sight)
    wide, n_blocks = WIDE_BLOCKS * BLOCK_CELLS, relief.bottoms.shape[1]
    summary = sight.summary
    summary[:] = 0.0
    summary[0], summary[1] = math.inf, -math.inf
    summary[2], summary[3] = math.inf, -math.inf
    for block_row in range(first_row // BLOCK_CELLS, (end_row - 1) // BLOCK_CELLS + 1):
        for wide_column in range(first_column // wide, (end_column - 1) // wide + 1):
            first = wide_column * WIDE_BLOCKS
            end = min(n_blocks, first + WIDE_BLOCKS)
            if look_at_blocks(view, relief, buffer, sight, room, tile, (block_row, first, end)):
                continue
            first = max(first, first_column // BLOCK_CELLS)
            end = min(end, (end_column - 1) // BLOCK_CELLS + 1)
            for column in range(first, end):
                blocks = (block_row, column, column + 1)
                if not look_at_blocks(view, relief, buffer, sight, room, tile, blocks):
                    _ask_each_cell(view, relief, buffer, sight, tile, (block_row, column), lanes)


@compiled
def look_at_blocks(
    view: WallView,
    relief: Relief,
    buffer: DepthBuffer,
    sight: Sight,
    room: BlockRoom,
    tile: tuple[int, int, int, int],
    blocks: tuple[int, int, int],
) -> bool:
    """Fill in blocks beside each other, if the photo surely sees all of them, or none.

    Args:
        view: the camera before the wall.
        relief: the wall.
        buffer: what else stands before the camera.
        sight: of the tile, filled in part.
        room: of `room_for_blocks`.
        tile: its first row and column, and the row and column after its last ones.
        blocks: row of the blocks, column of the first one, and the column after the last one.

    Returns:
        Whether they are filled in.
    """
    block_row, first, end = blocks
    # Whole blocks count, whatever part of them is in the tile: tiles must not show.
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
        look_at_hidden_block(relief, sight, place)
        return True
    n_seen = look_at_plain_block(view, room, place, (rows, columns), depths)
    for column in range(first, end):
        n_seen -= _hide_low_cells(view, relief, sight, tile, (block_row, column))
    if n_seen:
        summary, box = sight.summary, room.box
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
    """Give the `place` of `look_at_plain_block` for blocks with such first and last cells."""
    begin, finish = max(tile[0], rows[0]), min(tile[2], rows[1] + 1)
    start, end = max(tile[1], columns[0]), min(tile[3], columns[1] + 1)
    return (begin, start, finish - begin, end - start, begin - tile[0], start - tile[1])


@compiled
def _highest(view: WallView, relief: Relief, block: tuple[int, int]) -> float:
    """Bound the height up to which the rays from a block must be followed."""
    bottom = float(relief.bottoms[block[0], block[1]])
    return highest_in_the_way(view, relief.tops, bottom, BLOCK_CELLS, block, relief.highest_m)


@compiled
def _ask_each_cell(
    view: WallView,
    relief: Relief,
    buffer: DepthBuffer,
    sight: Sight,
    tile: tuple[int, int, int, int],
    block: tuple[int, int],
    lanes: NDArray[np.float64],
) -> None:
    """Project the cells of a block one by one, and ask for each whether the photo sees it."""
    top = _highest(view, relief, block)
    begin, finish = max(tile[0], block[0] * BLOCK_CELLS), min(tile[2], (block[0] + 1) * BLOCK_CELLS)
    start, end = max(tile[1], block[1] * BLOCK_CELLS), min(tile[3], (block[1] + 1) * BLOCK_CELLS)
    for row in range(begin, finish):
        into = _part(sight, row - tile[0], start - tile[1], end - start)
        project_row(view, relief, row, start, lanes[:, : end - start])
        look_at_row(view, relief, buffer, (row, start, top), lanes, into, sight.summary)


@compiled
def _part(sight: Sight, row: int, first_column: int, n_cells: int) -> SightRow:
    end = first_column + n_cells
    return SightRow(
        sight.u[row, first_column:end],
        sight.v[row, first_column:end],
        sight.mask[row, first_column:end],
        sight.quality[row, first_column:end],
    )


@compiled
def look_at_row(
    view: WallView,
    relief: Relief,
    buffer: DepthBuffer,
    place: tuple[int, int, float],
    lanes: NDArray[np.float64],
    into: SightRow,
    summary: NDArray[np.float64],
) -> None:
    """Ask for each cell of a row whether the photo sees it.

    Args:
        view: the camera before the wall.
        relief: the wall.
        buffer: what else stands before the camera.
        place: row of the cells, column of the first one, and the height up to which rays have to
            be followed.
        lanes: of `project_row`.
        into: filled.
        summary: of the `Sight`, updated.
    """
    us, vs, mask, quality = into.u, into.v, into.mask, into.quality
    row, first_column, top = place
    width, image_height = view.camera[21], view.camera[22]
    per_pixel, per_border = 1.0 / buffer.reduction, 1.0 / view.border_px
    for k in range(mask.size):
        depth = float(relief.depth[row, first_column + k])
        u, v = lanes[0, k], lanes[1, k]
        us[k], vs[k], quality[k] = 0.0, 0.0, 0.0
        if math.isnan(depth):
            mask[k] = NO_SURFACE
            continue
        if not (0.0 <= u < width and 0.0 <= v < image_height):
            mask[k] = OUTSIDE
            continue
        mask[k] = OCCLUDED
        if lanes[3, k] <= view.cosine_least:
            continue
        if buffer.nearest[int(v * per_pixel), int(u * per_pixel)] < lanes[2, k]:
            continue
        if depth + view.tolerance_m < top and is_hidden_by_relief(
            view, relief, row, first_column + k, top
        ):
            continue
        mask[k] = PAINTED
        inside = min(width - u, u, image_height - v, v) * per_border
        quality[k] = lanes[4, k] * min(1.0, inside)
        us[k], vs[k] = u, v
        summary[0], summary[1] = min(summary[0], u), max(summary[1], u)
        summary[2], summary[3] = min(summary[2], v), max(summary[3], v)
        summary[4] += 1
        summary[5] += first_column + k
        summary[6] += row
        summary[7] += depth


@compiled
def _hide_low_cells(
    view: WallView,
    relief: Relief,
    sight: Sight,
    tile: tuple[int, int, int, int],
    block: tuple[int, int],
) -> int:
    """Follow the rays of those cells of a painted block that lie low enough to be hidden.

    Small blocks within it are asked first: most of them are free.

    Args:
        view: the camera before the wall.
        relief: the wall.
        sight: of the tile, changed where cells are hidden.
        tile: as of `look_at_blocks`.
        block: row and column of the block.

    Returns:
        How many cells are hidden.
    """
    top = _highest(view, relief, block)
    if not float(relief.bottoms[block[0], block[1]]) + view.tolerance_m < top:
        return 0
    n_hidden, per_block = 0, BLOCK_CELLS // FINE_CELLS
    n_rows, n_columns = relief.fine_bottoms.shape
    for row in range(block[0] * per_block, min(n_rows, (block[0] + 1) * per_block)):
        for column in range(block[1] * per_block, min(n_columns, (block[1] + 1) * per_block)):
            bottom = float(relief.fine_bottoms[row, column])
            if not bottom + view.tolerance_m < top:
                continue
            fine_top = highest_in_the_way(
                view, relief.fine_tops, bottom, FINE_CELLS, (row, column), top
            )
            if bottom + view.tolerance_m < fine_top:
                n_hidden += _hide_cells(view, relief, sight, tile, (row, column, fine_top))
    return n_hidden


@compiled
def _hide_cells(
    view: WallView,
    relief: Relief,
    sight: Sight,
    tile: tuple[int, int, int, int],
    block: tuple[int, int, float],
) -> int:
    """Follow the rays of the low cells of a small block, given with the height up to which."""
    fine_row, fine_column, top = block
    n_hidden = 0
    for row in range(
        max(tile[0], fine_row * FINE_CELLS), min(tile[2], (fine_row + 1) * FINE_CELLS)
    ):
        for column in range(
            max(tile[1], fine_column * FINE_CELLS), min(tile[3], (fine_column + 1) * FINE_CELLS)
        ):
            if not relief.depth[row, column] < top - view.tolerance_m:
                continue
            if is_hidden_by_relief(view, relief, row, column, top):
                sight.mask[row - tile[0], column - tile[1]] = OCCLUDED
                sight.quality[row - tile[0], column - tile[1]] = 0.0
                n_hidden += 1
    return n_hidden
