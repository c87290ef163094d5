"""Compiled passes for blocks of cells that a photo sees as a whole: few projections, many cells.

Bounds at nodes of the block tell that nothing hides any of it; parabolas through them then give
the places of its cells in the photo. Where that is not exact enough, or not sure, the block is not
plain, and `sight_kernels` asks each cell.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.camera_kernels import project_point
from orthoflow.geometry.visibility_kernels import (
    NO_SURFACE,
    PAINTED,
    DepthBuffer,
    Relief,
    Sight,
    WallView,
    compiled,
)

# How far interpolated places may be off, in photo pixels; `cv2.remap` knows 32nds of them.
PARABOLA_PX: Final = 0.02


@compiled
def span_block(
    view: WallView,
    depths: tuple[float, float],
    rows: tuple[int, int],
    columns: tuple[int, int],
    nodes: NDArray[np.float64],
) -> bool:
    """Project the corners, edge middles and centre of a block at two depths.

    Args:
        view: the camera before the wall.
        depths: two depths, both below the camera.
        rows: first and last row of the cells.
        columns: first and last column.
        nodes: (2, 3, 3, 4) filled: at each depth, row and column u, v, the photo pixels that a cell
            covers, and the depth along the axis where the ray leaves the slab of the raster.

    Returns:
        Whether the camera sees all of them, and whether parabolas through them give the places of
        the cells in between to `PARABOLA_PX`.
    """
    for layer in range(2):
        for i in range(3):
            row = rows[0] + 0.5 * i * (rows[1] - rows[0])
            for j in range(3):
                column = columns[0] + 0.5 * j * (columns[1] - columns[0])
                if not _project_node(view, row, column, depths[layer], nodes[layer, i, j]):
                    return False
    return _is_parabolic(view, depths, rows, columns, nodes)


@compiled
def _is_parabolic(
    view: WallView,
    depths: tuple[float, float],
    rows: tuple[int, int],
    columns: tuple[int, int],
    nodes: NDArray[np.float64],
) -> bool:
    """Compare parabolas with the projection where cubic errors are largest."""
    probe = np.empty(4)
    for corner in range(4):
        x, y = (0.25 if corner & 1 else 0.75), (0.25 if corner & 2 else 0.75)
        row, column = rows[0] + y * (rows[1] - rows[0]), columns[0] + x * (columns[1] - columns[0])
        if not _project_node(view, row, column, 0.5 * (depths[0] + depths[1]), probe):
            return False
        across, down = _parabola(x), _parabola(y)
        for k in range(2):
            between = 0.0
            for i in range(3):
                for j in range(3):
                    weight = 0.5 * down[i] * across[j]
                    between += weight * (nodes[0, i, j, k] + nodes[1, i, j, k])
            if not abs(between - probe[k]) <= PARABOLA_PX:
                return False
    return True


@compiled
def _project_node(
    view: WallView, row: float, column: float, depth: float, node: NDArray[np.float64]
) -> bool:
    x, y = (column + 0.5) * view.gsd_m, (row + 0.5) * view.gsd_m
    u, v, along = project_point(view.camera, x, y, depth)
    lift = view.height_m - depth
    across, down = (view.column - column) * view.gsd_m, (view.row - row) * view.gsd_m
    pixels_per_m2 = view.camera[12] * view.camera[13] / (along * along)
    cosine = lift / math.sqrt(lift * lift + across * across + down * down)
    node[0], node[1], node[2] = u, v, cosine * pixels_per_m2 * view.gsd_m * view.gsd_m
    node[3] = along * (view.height_m - view.front_m) / lift
    return not math.isnan(u)


@compiled
def _parabola(x: float) -> tuple[float, float, float]:
    """Weights of the values at 0, 0.5 and 1 in the parabola through them."""
    return (2.0 * (x - 0.5) * (x - 1.0), 4.0 * x * (1.0 - x), 2.0 * x * (x - 0.5))


@compiled
def is_plain_block(
    view: WallView,
    buffer: DepthBuffer,
    high: float,
    rows: tuple[int, int],
    columns: tuple[int, int],
    nodes: NDArray[np.float64],
    box: NDArray[np.float64],
) -> bool:
    """Tell whether a photo surely sees all known cells of a block, so that none need be asked.

    What counts for a cell is monotonous over the block or nearly linear, so that the nodes at the
    lowest and the highest depth bound it. The rays to the camera are known to be free of relief.

    Args:
        view: the camera before the wall.
        buffer: what else stands before the camera.
        high: the highest depth.
        rows: first and last row of the cells.
        columns: first and last column.
        nodes: of `span_block`.
        box: (4,) filled with the smallest and largest u, the smallest and largest v.
    """
    farthest_row = max(abs(view.row - rows[0]), abs(view.row - rows[1])) * view.gsd_m
    farthest_column = max(abs(view.column - columns[0]), abs(view.column - columns[1])) * view.gsd_m
    lift = view.height_m - high
    aside = farthest_row * farthest_row + farthest_column * farthest_column
    if lift <= view.cosine_least * math.sqrt(lift * lift + aside):
        return False
    u_least, u_most, v_least, v_most, leaves = math.inf, -math.inf, math.inf, -math.inf, 0.0
    for layer in range(2):
        for i in range(3):
            for j in range(3):
                node = nodes[layer, i, j]
                u_least, u_most = min(u_least, node[0]), max(u_most, node[0])
                v_least, v_most = min(v_least, node[1]), max(v_most, node[1])
                leaves = max(leaves, node[3])
    # Between the nodes edges bend, by far less than this.
    margin = 1.0 + 0.02 * max(u_most - u_least, v_most - v_least)
    box[0], box[1], box[2], box[3] = (
        u_least - margin,
        u_most + margin,
        v_least - margin,
        v_most + margin,
    )
    if box[0] < 0.0 or box[1] >= view.camera[21] or box[2] < 0.0 or box[3] >= view.camera[22]:
        return False
    per_pixel, nearest = 1.0 / buffer.reduction, leaves - view.tolerance_m
    for row in range(int(box[2] * per_pixel), int(box[3] * per_pixel) + 1):
        for column in range(int(box[0] * per_pixel), int(box[1] * per_pixel) + 1):
            if buffer.nearest[row, column] < nearest:
                return False
    return True


@compiled
def look_at_plain_block(
    view: WallView,
    relief: Relief,
    sight: Sight,
    place: tuple[int, int, int, int, int, int],
    block: tuple[tuple[int, int], tuple[int, int]],
    depths: tuple[float, float],
    nodes: NDArray[np.float64],
) -> int:
    """Fill in the cells of a block that a photo surely sees where they are known.

    Places and worth follow parabolas over the block and are linear in depth: the projection itself
    would take several times as long.

    Args:
        view: the camera before the wall.
        relief: the wall.
        sight: of the tile, filled in part.
        place: first row and column on the wall of the part of the block that is in the tile, its
            rows and columns, and first row and column in the tile.
        block: first and last row, and first and last column, of the whole block.
        depths: those of the nodes.
        nodes: of `span_block`.

    Returns:
        How many of the cells are known.
    """
    first_row, first_column, n_rows, n_columns, tile_row, tile_column = place
    low, per_depth = np.float32(depths[0]), 1.0 / (depths[1] - depths[0])
    width, height = np.float32(view.camera[21]), np.float32(view.camera[22])
    per_border, one, nothing = np.float32(1.0 / view.border_px), np.float32(1.0), np.float32(0.0)
    rows, columns = block
    per_row = 1.0 / max(1, rows[1] - rows[0])
    per_column = 1.0 / max(1, columns[1] - columns[0])
    ramp = (np.arange(n_columns) + (first_column - columns[0])).astype(np.float32)
    # Level, slope and bend along the row, and level and slope of what depth adds, of three values.
    c = np.empty((3, 5), dtype=np.float32)
    n_known = 0
    for i in range(n_rows):
        weights = _parabola((first_row + i - rows[0]) * per_row)
        for k in range(3):
            f0, f1, f2, g0, g2 = 0.0, 0.0, 0.0, 0.0, 0.0
            for r in range(3):
                weight = weights[r]
                f0 += weight * nodes[0, r, 0, k]
                f1 += weight * nodes[0, r, 1, k]
                f2 += weight * nodes[0, r, 2, k]
                g0 += weight * (nodes[1, r, 0, k] - nodes[0, r, 0, k])
                g2 += weight * (nodes[1, r, 2, k] - nodes[0, r, 2, k])
            c[k, 0] = f0
            c[k, 1] = (4.0 * f1 - 3.0 * f0 - f2) * per_column
            c[k, 2] = (2.0 * f0 - 4.0 * f1 + 2.0 * f2) * per_column * per_column
            c[k, 3] = g0 * per_depth
            c[k, 4] = (g2 - g0) * per_column * per_depth
        u0, u1, u2, u3, u4 = c[0, 0], c[0, 1], c[0, 2], c[0, 3], c[0, 4]
        v0, v1, v2, v3, v4 = c[1, 0], c[1, 1], c[1, 2], c[1, 3], c[1, 4]
        q0, q1, q2, q3, q4 = c[2, 0], c[2, 1], c[2, 2], c[2, 3], c[2, 4]
        heights = relief.depth[first_row + i, first_column : first_column + n_columns]
        us = sight.u[tile_row + i, tile_column : tile_column + n_columns]
        vs = sight.v[tile_row + i, tile_column : tile_column + n_columns]
        mask = sight.mask[tile_row + i, tile_column : tile_column + n_columns]
        quality = sight.quality[tile_row + i, tile_column : tile_column + n_columns]
        for j in range(n_columns):
            x, depth = ramp[j], heights[j]
            is_void = math.isnan(depth)
            rise = nothing if is_void else depth - low
            u = u0 + x * (u1 + x * u2) + rise * (u3 + x * u4)
            v = v0 + x * (v1 + x * v2) + rise * (v3 + x * v4)
            worth = q0 + x * (q1 + x * q2) + rise * (q3 + x * q4)
            inside = min(width - u, u, height - v, v) * per_border
            us[j], vs[j] = u, v
            mask[j] = NO_SURFACE if is_void else PAINTED
            quality[j] = nothing if is_void else worth * min(one, inside)
            n_known += 0 if is_void else 1
    return n_known
