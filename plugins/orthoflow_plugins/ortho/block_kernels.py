"""Compiled passes for blocks of cells that a photo sees entirely: few projections, many cells.

Bounds at nodes of the block decide whether nothing hides any of it, or the cloud hides all of it;
parabolas through the nodes then give the positions of its cells in the photo. If that is not
accurate enough, or undecided, `visibility_kernels` tests each cell.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.camera_kernels import project_point
from orthoflow.geometry.compiling import compiled, kernel_part
from orthoflow.geometry.depth_buffer_kernels import DepthBuffer
from orthoflow_plugins.ortho.ray_kernels import N_LANES
from orthoflow_plugins.ortho.views import (
    BLOCK_CELLS,
    FINE_CELLS,
    NO_SURFACE,
    OCCLUDED,
    PAINTED,
    Relief,
    TileVisibility,
    WallView,
)

# Results of `judge_block`.
HIDDEN: Final = -1
UNSURE: Final = 0
SEEN: Final = 1
# Permitted error of interpolated positions, in photo pixels; `cv2.remap` resolves 1/32 of them.
PARABOLA_PX: Final = 0.02
# Blocks that are processed together if parabolas are accurate that far.
WIDE_BLOCKS: Final = 4
# Terms that describe a row of a block: see `_fit_block`.
N_TERMS: Final = 15


@compiled
def parabola(x: float) -> tuple[float, float, float]:
    """Return the weights of the values at 0, 0.5 and 1 in the parabola through them."""
    return (2.0 * (x - 0.5) * (x - 1.0), 4.0 * x * (1.0 - x), 2.0 * x * (x - 0.5))


@compiled
def span_block(
    view: WallView,
    depths: tuple[float, float],
    rows: tuple[int, int],
    columns: tuple[int, int],
    nodes: NDArray[np.float64],
) -> bool:
    """Project the corners, edge midpoints and centre of a block at two depths.

    Args:
        view: the camera in front of the wall.
        depths: two depths, both below the camera.
        rows: first and last row of the cells.
        columns: first and last column.
        nodes: (2, 3, 3, 4) output: at each depth, row and column u, v, the photo pixels that a cell
            covers, and the depth along the axis where the ray leaves the slab of the raster.

    Returns:
        Whether the camera sees all of them, and parabolas through them give the positions of the
        cells in between to `PARABOLA_PX`.
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
        across, down = parabola(x), parabola(y)
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
def judge_block(
    view: WallView,
    buffer: DepthBuffer,
    high: float,
    rows: tuple[int, int],
    columns: tuple[int, int],
    nodes: NDArray[np.float64],
    box: NDArray[np.float64],
) -> int:
    """Determine whether a photo certainly sees all known cells of a block.

    The quantities of a cell are monotonic over the block or nearly linear, so that the nodes at the
    lowest and the highest depth bound them. The rays to the camera are known to be free of relief.

    Args:
        view: the camera in front of the wall.
        buffer: depth buffer of other objects.
        high: the highest depth.
        rows: first and last row of the cells.
        columns: first and last column.
        nodes: from `span_block`.
        box: (4,) output: smallest and largest u, smallest and largest v.

    Returns:
        `SEEN`, `HIDDEN` if the cloud certainly hides all of them, or `UNSURE`.
    """
    farthest_row = max(abs(view.row - rows[0]), abs(view.row - rows[1])) * view.gsd_m
    farthest_column = max(abs(view.column - columns[0]), abs(view.column - columns[1])) * view.gsd_m
    lift = view.height_m - high
    aside = farthest_row * farthest_row + farthest_column * farthest_column
    if lift <= view.cosine_least * math.sqrt(lift * lift + aside):
        return UNSURE
    box[0], box[1], box[2], box[3] = math.inf, -math.inf, math.inf, -math.inf
    # The distance to the camera changes over a wide block: each of its parts is tested by itself.
    n_parts = max(1, (columns[1] - columns[0] + 1) // BLOCK_CELLS)
    is_seen, is_hidden = True, True
    for part in range(n_parts):
        starts, ends = parabola(part / n_parts), parabola((part + 1) / n_parts)
        middles = parabola((part + 0.5) / n_parts)
        u_least, u_most = _bounds(nodes, 0, starts, middles, ends)
        v_least, v_most = _bounds(nodes, 1, starts, middles, ends)
        first, last = _bounds(nodes, 3, starts, middles, ends)
        # Between the nodes edges bend, by far less than this.
        margin = 1.0 + 0.02 * max(u_most - u_least, v_most - v_least)
        left, right, upper, lower = (
            u_least - margin,
            u_most + margin,
            v_least - margin,
            v_most + margin,
        )
        box[0], box[1] = min(box[0], left), max(box[1], right)
        box[2], box[3] = min(box[2], upper), max(box[3], lower)
        if left < 0.0 or right >= view.camera[21] or upper < 0.0 or lower >= view.camera[22]:
            return UNSURE
        nearest, farthest = _bound_cloud(buffer, left, right, upper, lower)
        is_seen &= nearest >= last - view.tolerance_m
        is_hidden &= farthest < first - view.tolerance_m
        if not (is_seen or is_hidden):
            return UNSURE
    return SEEN if is_seen else HIDDEN


@compiled
def _bounds(
    nodes: NDArray[np.float64],
    k: int,
    starts: tuple[float, float, float],
    middles: tuple[float, float, float],
    ends: tuple[float, float, float],
) -> tuple[float, float]:
    """Bound a quantity over some columns of a block, by its values at three of them.

    Args:
        nodes: from `span_block`.
        k: which quantity of the nodes.
        starts: weights of the nodes of a row at the first column.
        middles: weights at the middle column.
        ends: weights at the last column.
    """
    least, most = math.inf, -math.inf
    for layer in range(2):
        for i in range(3):
            at_start, at_middle, at_end = 0.0, 0.0, 0.0
            for j in range(3):
                value = nodes[layer, i, j, k]
                at_start += starts[j] * value
                at_middle += middles[j] * value
                at_end += ends[j] * value
            least = min(least, at_start, at_middle, at_end)
            most = max(most, at_start, at_middle, at_end)
    return least, most


@compiled
def _bound_cloud(
    buffer: DepthBuffer, left: float, right: float, upper: float, lower: float
) -> tuple[float, float]:
    """Return the nearest and the farthest depth in a part of a photo."""
    nearest, farthest = np.float32(np.inf), np.float32(0.0)
    per_pixel = 1.0 / buffer.reduction
    for row in range(int(upper * per_pixel), int(lower * per_pixel) + 1):
        for column in range(int(left * per_pixel), int(right * per_pixel) + 1):
            nearest = min(nearest, buffer.nearest[row, column])
            farthest = max(farthest, buffer.nearest[row, column])
    return float(nearest), float(farthest)


@compiled
def look_at_hidden_block(
    relief: Relief, visible: TileVisibility, place: tuple[int, int, int, int, int, int]
) -> None:
    """Set the cells of a block that the cloud hides; see `look_at_unoccluded_block`."""
    first_row, first_column, n_rows, n_columns, tile_row, tile_column = place
    for i in range(n_rows):
        for j in range(n_columns):
            depth = relief.depth[first_row + i, first_column + j]
            at_row, at_column = tile_row + i, tile_column + j
            visible.mask[at_row, at_column] = NO_SURFACE if math.isnan(depth) else OCCLUDED
            visible.u[at_row, at_column] = 0.0
            visible.v[at_row, at_column] = 0.0


class BlockRoom(NamedTuple):
    """The arrays of a tile that blocks fill, flat, and working memory.

    Attributes:
        heights: (cells of the wall,) float32 metres.
        u: (cells of the tile,) as in `TileVisibility`; v, mask and quality likewise.
        bends: (3, N_TERMS) from `_fit_block`; along (3, 5) likewise.
        terms: (N_TERMS,) of one row.
        rises: (WIDE_BLOCKS * BLOCK_CELLS,) metres above the lower of the two depths, 0 where void.
        ramp: (WIDE_BLOCKS * BLOCK_CELLS,) 0, 1, 2, ...
        wall_columns: columns of the wall; tile_columns those of the tile.
        nodes: (2, 3, 3, 4) of `span_block`.
        box: (4,) from `judge_block`.
        lanes: (5, BLOCK_CELLS) for `visibility_kernels.project_row`.
        rays: (FINE_CELLS * FINE_CELLS, N_LANES) for `ray_kernels.follow_rays`.
    """

    heights: NDArray[np.float32]
    u: NDArray[np.float32]
    v: NDArray[np.float32]
    mask: NDArray[np.uint8]
    quality: NDArray[np.float32]
    bends: NDArray[np.float64]
    along: NDArray[np.float64]
    terms: NDArray[np.float32]
    rises: NDArray[np.float32]
    ramp: NDArray[np.float32]
    wall_columns: int
    tile_columns: int
    nodes: NDArray[np.float64]
    box: NDArray[np.float64]
    lanes: NDArray[np.float64]
    rays: NDArray[np.int64]


@compiled
def room_for_blocks(relief: Relief, visible: TileVisibility) -> BlockRoom:
    """Return the working memory that `look_at_unoccluded_block` needs for the blocks of a tile."""
    return BlockRoom(
        relief.depth.reshape(relief.depth.size),
        visible.u.reshape(visible.u.size),
        visible.v.reshape(visible.v.size),
        visible.mask.reshape(visible.mask.size),
        visible.quality.reshape(visible.quality.size),
        np.empty((3, N_TERMS)),
        np.empty((3, 5)),
        np.empty(N_TERMS, dtype=np.float32),
        np.empty(WIDE_BLOCKS * BLOCK_CELLS, dtype=np.float32),
        np.arange(WIDE_BLOCKS * BLOCK_CELLS).astype(np.float32),
        relief.depth.shape[1],
        visible.mask.shape[1],
        np.empty((2, 3, 3, 4)),
        np.empty(4),
        np.empty((5, BLOCK_CELLS)),
        np.empty((FINE_CELLS * FINE_CELLS, N_LANES), dtype=np.int64),
    )


@compiled
def look_at_unoccluded_block(
    view: WallView,
    room: BlockRoom,
    place: tuple[int, int, int, int, int, int],
    block: tuple[tuple[int, int], tuple[int, int]],
    depths: tuple[float, float],
) -> int:
    """Set the known cells of a block that a photo certainly sees.

    Positions and quality follow parabolas over the block and are linear in depth: the projection
    itself would take several times as long. Each loop writes one array and has no branches, so that
    eight cells are processed at once. Passing rows to functions of their own would take longer.

    Args:
        view: the camera in front of the wall.
        room: partly filled.
        place: first row and column on the wall of the part of the block that is in the tile, its
            rows and columns, and first row and column in the tile.
        block: first and last row, and first and last column, of the whole block.
        depths: the depths of the nodes.

    Returns:
        The number of known cells.
    """
    first_row, first_column, n_rows, n_columns, tile_row, tile_column = place
    rows, columns = block
    per_row = 1.0 / max(1, rows[1] - rows[0])
    per_column = 1.0 / max(1, columns[1] - columns[0])
    heights, us, vs, mask, quality = room.heights, room.u, room.v, room.mask, room.quality
    bends, terms, rises, ramp = room.bends, room.terms, room.rises, room.ramp
    box = room.box
    _fit_block(room.nodes, per_column, 1.0 / (depths[1] - depths[0]), bends, room.along)
    low, begin = np.float32(depths[0]), np.uintp(first_column - columns[0])
    nothing = np.float32(0.0)
    void, painted = np.uint8(NO_SURFACE), np.uint8(PAINTED)
    n_void = 0
    for i in range(n_rows):
        y = (first_row + i - rows[0]) * per_row
        for k in range(N_TERMS):
            terms[k] = bends[0, k] + y * (bends[1, k] + y * bends[2, k])
        # Unsigned indices: they cannot be negative, which would keep loops scalar.
        on_wall = np.uintp((first_row + i) * room.wall_columns + first_column)
        in_tile = np.uintp((tile_row + i) * room.tile_columns + tile_column)
        for j in range(n_columns):
            depth = heights[on_wall + np.uintp(j)]
            rises[j] = nothing if math.isnan(depth) else depth - low
        t0, t1, t2, t3, t4 = terms[0], terms[1], terms[2], terms[3], terms[4]
        for j in range(n_columns):
            x = ramp[begin + np.uintp(j)]
            us[in_tile + np.uintp(j)] = t0 + x * (t1 + x * t2) + rises[j] * (t3 + x * t4)
        t0, t1, t2, t3, t4 = terms[5], terms[6], terms[7], terms[8], terms[9]
        for j in range(n_columns):
            x = ramp[begin + np.uintp(j)]
            vs[in_tile + np.uintp(j)] = t0 + x * (t1 + x * t2) + rises[j] * (t3 + x * t4)
        t0, t1, t2, t3, t4 = terms[10], terms[11], terms[12], terms[13], terms[14]
        for j in range(n_columns):
            x = ramp[begin + np.uintp(j)]
            quality[in_tile + np.uintp(j)] = t0 + x * (t1 + x * t2) + rises[j] * (t3 + x * t4)
        for j in range(n_columns):
            depth = heights[on_wall + np.uintp(j)]
            mask[in_tile + np.uintp(j)] = void if math.isnan(depth) else painted
        n_void_here = np.int32(0)
        for j in range(n_columns):
            n_void_here += np.int32(mask[in_tile + np.uintp(j)] == void)
        n_void += int(n_void_here)
    if min(box[0], box[2], view.camera[21] - box[1], view.camera[22] - box[3]) < view.border_px:
        _fade(view, room, place)
    return n_rows * n_columns - n_void


@kernel_part
def _fade(view: WallView, room: BlockRoom, place: tuple[int, int, int, int, int, int]) -> None:
    """Decrease the quality of the cells of a block towards the border of the photo."""
    us, vs, quality = room.u, room.v, room.quality
    _, _, n_rows, n_columns, tile_row, tile_column = place
    width, height = np.float32(view.camera[21]), np.float32(view.camera[22])
    per_border, one = np.float32(1.0 / view.border_px), np.float32(1.0)
    for i in range(n_rows):
        first = np.uintp((tile_row + i) * room.tile_columns + tile_column)
        for j in range(n_columns):
            u, v = us[first + np.uintp(j)], vs[first + np.uintp(j)]
            inside = min(width - u, u, height - v, v) * per_border
            quality[first + np.uintp(j)] *= min(one, inside)


@kernel_part
def _fit_block(
    nodes: NDArray[np.float64],
    per_column: float,
    per_depth: float,
    bends: NDArray[np.float64],
    along: NDArray[np.float64],
) -> None:
    """Set the parabolas down a block of the terms that describe its rows.

    Args:
        nodes: from `span_block`.
        per_column: reciprocal of the distance of the first and last column.
        per_depth: reciprocal of the distance of the two depths.
        bends: (3, N_TERMS) output: level, slope and bend down the block of five terms each for u, v
            and quality: level, slope and bend along the row, and level and slope of the change per
            metre of depth.
        along: (3, 5) working memory.
    """
    for k in range(3):
        for r in range(3):
            f0, f1, f2 = nodes[0, r, 0, k], nodes[0, r, 1, k], nodes[0, r, 2, k]
            g0, g2 = nodes[1, r, 0, k] - f0, nodes[1, r, 2, k] - f2
            along[r, 0] = f0
            along[r, 1] = (4.0 * f1 - 3.0 * f0 - f2) * per_column
            along[r, 2] = (2.0 * f0 - 4.0 * f1 + 2.0 * f2) * per_column * per_column
            along[r, 3] = g0 * per_depth
            along[r, 4] = (g2 - g0) * per_column * per_depth
        for term in range(5):
            first, middle, last = along[0, term], along[1, term], along[2, term]
            bends[0, 5 * k + term] = first
            bends[1, 5 * k + term] = 4.0 * middle - 3.0 * first - last
            bends[2, 5 * k + term] = 2.0 * first - 4.0 * middle + 2.0 * last
