"""Compiled verdicts on blocks of cells: whether the cloud hides all of them, or none."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled
from orthoflow.geometry.visibility_kernels import BLOCK_CELLS, DepthBuffer, WallView

# What `judge_block` finds.
HIDDEN: Final = -1
UNSURE: Final = 0
SEEN: Final = 1


@compiled
def parabola(x: float) -> tuple[float, float, float]:
    """Weights of the values at 0, 0.5 and 1 in the parabola through them."""
    return (2.0 * (x - 0.5) * (x - 1.0), 4.0 * x * (1.0 - x), 2.0 * x * (x - 0.5))


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
    """Tell whether a photo surely sees all known cells of a block, so that none need be asked.

    What counts for a cell is monotonous over the block or nearly linear, so that the nodes at the
    lowest and the highest depth bound it. The rays to the camera are known to be free of relief.

    Args:
        view: the camera before the wall.
        buffer: what else stands before the camera.
        high: the highest depth.
        rows: first and last row of the cells.
        columns: first and last column.
        nodes: of `plain_block_kernels.span_block`.
        box: (4,) filled with the smallest and largest u, the smallest and largest v.

    Returns:
        `SEEN`, `HIDDEN` where the cloud surely hides all of them, or `UNSURE`.
    """
    farthest_row = max(abs(view.row - rows[0]), abs(view.row - rows[1])) * view.gsd_m
    farthest_column = max(abs(view.column - columns[0]), abs(view.column - columns[1])) * view.gsd_m
    lift = view.height_m - high
    aside = farthest_row * farthest_row + farthest_column * farthest_column
    if lift <= view.cosine_least * math.sqrt(lift * lift + aside):
        return UNSURE
    box[0], box[1], box[2], box[3] = math.inf, -math.inf, math.inf, -math.inf
    # The distance to the camera changes over a wide block: each of its parts is asked by itself.
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
        nodes: of `plain_block_kernels.span_block`.
        k: which quantity of the nodes.
        starts: weights of the nodes of a row at the first column; those of the others likewise.
        middles: at the middle one.
        ends: at the last one.
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
    """Give the nearest and the farthest depth in a part of a photo."""
    nearest, farthest = np.float32(np.inf), np.float32(0.0)
    per_pixel = 1.0 / buffer.reduction
    for row in range(int(upper * per_pixel), int(lower * per_pixel) + 1):
        for column in range(int(left * per_pixel), int(right * per_pixel) + 1):
            nearest = min(nearest, buffer.nearest[row, column])
            farthest = max(farthest, buffer.nearest[row, column])
    return float(nearest), float(farthest)
