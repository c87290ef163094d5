"""Compiled passes that tell which cells of a wall a photo sees, and where in the photo they are."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.plain_block_kernels import (
    HIDDEN,
    SEEN,
    UNSURE,
    judge_block,
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
    n_rows, n_columns = relief.depth.shape
    lanes, box, nodes = np.empty((5, BLOCK_CELLS)), np.empty(4), np.empty((2, 3, 3, 4))
    room = room_for_blocks(relief, sight)
    summary = sight.summary
    summary[:] = 0.0
    summary[0], summary[1] = math.inf, -math.inf
    summary[2], summary[3] = math.inf, -math.inf
    for block_row in range(first_row // BLOCK_CELLS, (end_row - 1) // BLOCK_CELLS + 1):
        begin = max(first_row, block_row * BLOCK_CELLS)
        finish = min(end_row, (block_row + 1) * BLOCK_CELLS)
        for block_column in range(first_column // BLOCK_CELLS, (end_column - 1) // BLOCK_CELLS + 1):
            start = max(first_column, block_column * BLOCK_CELLS)
            end = min(end_column, (block_column + 1) * BLOCK_CELLS)
            bottom = np.float64(relief.bottoms[block_row, block_column])
            top = highest_in_the_way(
                view,
                relief.tops,
                bottom,
                BLOCK_CELLS,
                (block_row, block_column),
                relief.highest_m,
            )
            crest = np.float64(relief.crests[block_row, block_column])
            depths = (bottom, max(crest, bottom + _LEAST_SPAN_M))
            # The whole block counts, whatever part of it is in the tile: tiles must not show.
            rows = (block_row * BLOCK_CELLS, min(n_rows, (block_row + 1) * BLOCK_CELLS) - 1)
            columns = (
                block_column * BLOCK_CELLS,
                min(n_columns, (block_column + 1) * BLOCK_CELLS) - 1,
            )
            verdict = UNSURE
            if (
                not view.is_exact
                and bottom <= crest
                and depths[1] < view.height_m
                and span_block(view, depths, rows, columns, nodes)
            ):
                verdict = judge_block(view, buffer, depths[1], rows, columns, nodes, box)
            place = (
                begin,
                start,
                finish - begin,
                end - start,
                begin - first_row,
                start - first_column,
            )
            if verdict == HIDDEN:
                look_at_hidden_block(relief, sight, place)
                continue
            if verdict == SEEN:
                n_seen = look_at_plain_block(view, room, place, (rows, columns), depths, nodes, box)
                if bottom + view.tolerance_m < top:
                    n_seen -= hide_low_cells(view, relief, sight, place, top)
                if n_seen:
                    summary[0], summary[1] = min(summary[0], box[0]), max(summary[1], box[1])
                    summary[2], summary[3] = min(summary[2], box[2]), max(summary[3], box[3])
                    summary[4] += n_seen
                    summary[5] += n_seen * 0.5 * (start + end - 1)
                    summary[6] += n_seen * 0.5 * (begin + finish - 1)
                    summary[7] += n_seen * 0.5 * (bottom + crest)
                continue
            for row in range(begin, finish):
                into = _part(sight, row - first_row, start - first_column, end - start)
                project_row(view, relief, row, start, lanes[:, : end - start])
                look_at_row(view, relief, buffer, (row, start, top), lanes, into, summary)


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
def hide_low_cells(
    view: WallView,
    relief: Relief,
    sight: Sight,
    place: tuple[int, int, int, int, int, int],
    top: float,
) -> int:
    """Follow the rays of those cells of a painted block that lie low enough to be hidden.

    Small blocks within it are asked first: most of them are free.

    Args:
        view: the camera before the wall.
        relief: the wall.
        sight: of the tile, changed where cells are hidden.
        place: as of `look_at_plain_block`.
        top: height up to which rays have to be followed.

    Returns:
        How many cells are hidden.
    """
    first_row, first_column, n_rows, n_columns, tile_row, tile_column = place
    n_hidden = 0
    for fine_row in range(first_row // FINE_CELLS, (first_row + n_rows - 1) // FINE_CELLS + 1):
        begin = max(first_row, fine_row * FINE_CELLS)
        finish = min(first_row + n_rows, (fine_row + 1) * FINE_CELLS)
        for fine_column in range(
            first_column // FINE_CELLS, (first_column + n_columns - 1) // FINE_CELLS + 1
        ):
            bottom = np.float64(relief.fine_bottoms[fine_row, fine_column])
            if not bottom + view.tolerance_m < top:
                continue
            fine_top = highest_in_the_way(
                view, relief.fine_tops, bottom, FINE_CELLS, (fine_row, fine_column), top
            )
            if not bottom + view.tolerance_m < fine_top:
                continue
            start = max(first_column, fine_column * FINE_CELLS)
            end = min(first_column + n_columns, (fine_column + 1) * FINE_CELLS)
            for row in range(begin, finish):
                for column in range(start, end):
                    if not relief.depth[row, column] < fine_top - view.tolerance_m:
                        continue
                    if is_hidden_by_relief(view, relief, row, column, fine_top):
                        i, j = tile_row + row - first_row, tile_column + column - first_column
                        sight.mask[i, j] = OCCLUDED
                        sight.quality[i, j] = 0.0
                        n_hidden += 1
    return n_hidden
