"""Compiled passes that tell which cells of a wall a photo sees, and where in the photo they are."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.camera_kernels import project_point
from orthoflow.geometry.visibility_kernels import (
    BLOCK_CELLS,
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
def is_plain_block(
    view: WallView,
    relief: Relief,
    buffer: DepthBuffer,
    rows: tuple[int, int],
    columns: tuple[int, int],
    box: NDArray[np.float64],
) -> bool:
    """Tell whether a photo surely sees all known cells of a block, so that none need be asked.

    What counts for a cell is monotonous over the block or nearly linear, so that its eight corners
    bound it: those of the rectangle at the lowest and at the highest depth.

    Args:
        view: the camera before the wall.
        relief: the wall; the rays to the camera are known to be free of it.
        buffer: what else stands before the camera.
        rows: first and last row of the cells.
        columns: first and last column.
        box: (4,) filled with the smallest and largest u, the smallest and largest v.
    """
    block_row, block_column = rows[0] // BLOCK_CELLS, columns[0] // BLOCK_CELLS
    low = float(relief.bottoms[block_row, block_column])
    high = float(relief.crests[block_row, block_column])
    if not low <= high < view.height_m:
        return False
    farthest_row = max(abs(view.row - rows[0]), abs(view.row - rows[1])) * view.gsd_m
    farthest_column = max(abs(view.column - columns[0]), abs(view.column - columns[1])) * view.gsd_m
    lift = view.height_m - high
    aside = farthest_row * farthest_row + farthest_column * farthest_column
    if lift <= view.cosine_least * math.sqrt(lift * lift + aside):
        return False
    box[0], box[1], box[2], box[3] = math.inf, -math.inf, math.inf, -math.inf
    leaves = 0.0
    for corner in range(8):
        depth = low if corner & 1 else high
        x = (columns[1 if corner & 2 else 0] + 0.5) * view.gsd_m
        y = (rows[1 if corner & 4 else 0] + 0.5) * view.gsd_m
        u, v, along = project_point(view.camera, x, y, depth)
        if math.isnan(u):
            return False
        box[0], box[1] = min(box[0], u), max(box[1], u)
        box[2], box[3] = min(box[2], v), max(box[3], v)
        leaves = max(leaves, along * (view.height_m - view.front_m) / (view.height_m - depth))
    # A lens bends straight lines: over a block, by far less than this.
    margin = 1.0 + 0.02 * max(box[1] - box[0], box[3] - box[2])
    box[0], box[1], box[2], box[3] = (
        box[0] - margin,
        box[1] + margin,
        box[2] - margin,
        box[3] + margin,
    )
    width, height = view.camera[21], view.camera[22]
    if not (box[0] >= 0.0 and box[1] < width and box[2] >= 0.0 and box[3] < height):
        return False
    per_pixel, nearest = 1.0 / buffer.reduction, leaves - view.tolerance_m
    for row in range(int(box[2] * per_pixel), int(box[3] * per_pixel) + 1):
        for column in range(int(box[0] * per_pixel), int(box[1] * per_pixel) + 1):
            if buffer.nearest[row, column] < nearest:
                return False
    return True


@compiled
def look_at_plain_row(
    view: WallView,
    relief: Relief,
    row: int,
    first_column: int,
    bottom: float,
    into: SightRow,
) -> int:
    """Project cells of a row that a photo surely sees where they are known; without branches.

    Args:
        view: the camera before the wall.
        relief: the wall.
        row: of the cells.
        first_column: of the first cell.
        bottom: depth that stands in for void cells, so that every place is a number.
        into: filled.

    Returns:
        How many of the cells are known.
    """
    us, vs, mask, quality = into.u, into.v, into.mask, into.quality
    n_known = 0
    # The formula of `project_row`; a test holds the two together.
    camera, gsd_m = view.camera, view.gsd_m
    xu, xv, xn, tx = camera[0], camera[1], camera[2], camera[9]
    yu, yv, yn, ty = camera[3], camera[4], camera[5], camera[10]
    zu, zv, zn, tz = camera[6], camera[7], camera[8], camera[11]
    fx, fy, cx, cy = camera[12], camera[13], camera[14], camera[15]
    k1, k2, p1, p2, k3 = camera[16], camera[17], camera[18], camera[19], camera[20]
    width, image_height, per_border = camera[21], camera[22], 1.0 / view.border_px
    height_m, foot, down = view.height_m, view.column, (view.row - row) * gsd_m
    y, depths, area = (row + 0.5) * gsd_m, relief.depth[row], fx * fy * gsd_m * gsd_m
    x_row, y_row, z_row = xv * y + tx, yv * y + ty, zv * y + tz
    for k in range(us.size):
        column, known = float(first_column + k), float(depths[first_column + k])
        is_void = math.isnan(known)
        depth = bottom if is_void else known
        x = (column + 0.5) * gsd_m
        per_zc = 1.0 / (zu * x + zn * depth + z_row)
        a = (xu * x + xn * depth + x_row) * per_zc
        b = (yu * x + yn * depth + y_row) * per_zc
        r2 = a * a + b * b
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        u = fx * (a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a)) + cx
        v = fy * (b * radial + p1 * (r2 + 2.0 * b * b) + 2.0 * p2 * a * b) + cy
        lift, across = height_m - depth, (foot - column) * gsd_m
        inside = min(width - u, u, image_height - v, v) * per_border
        worth = (
            area * per_zc * per_zc * lift / math.sqrt(lift * lift + across * across + down * down)
        )
        us[k], vs[k] = u, v
        mask[k] = NO_SURFACE if is_void else PAINTED
        quality[k] = 0.0 if is_void else worth * min(1.0, inside)
        n_known += 0 if is_void else 1
    return n_known


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

    Blocks that the photo sees as a whole go fast; in the others every cell is asked. Both compute
    the same places.

    Args:
        view: the camera before the wall.
        relief: the whole wall.
        buffer: what else stands before the camera.
        sight: filled; its shape is the tile's.
        first_row: row of the wall where the tile begins.
        first_column: column likewise.
    """
    end_row, end_column = first_row + sight.mask.shape[0], first_column + sight.mask.shape[1]
    lanes, box = np.empty((5, BLOCK_CELLS)), np.empty(4)
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
            top = highest_in_the_way(view, relief, block_row, block_column)
            bottom = float(relief.bottoms[block_row, block_column])
            is_free = bottom + view.tolerance_m >= top
            if is_free and is_plain_block(
                view, relief, buffer, (begin, finish - 1), (start, end - 1), box
            ):
                middle = 0.5 * (bottom + float(relief.crests[block_row, block_column]))
                summary[0], summary[1] = min(summary[0], box[0]), max(summary[1], box[1])
                summary[2], summary[3] = min(summary[2], box[2]), max(summary[3], box[3])
                for row in range(begin, finish):
                    into = _part(sight, row - first_row, start - first_column, end - start)
                    n_seen = look_at_plain_row(view, relief, row, start, bottom, into)
                    summary[4] += n_seen
                    summary[5] += n_seen * (0.5 * (start + end - 1))
                    summary[6] += n_seen * row
                    summary[7] += n_seen * middle
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
