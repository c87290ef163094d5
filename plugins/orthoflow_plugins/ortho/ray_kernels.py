"""Compiled passes that follow rays from cells of a wall to the camera, over the wall's relief.

Arrays are separate arguments: accessing one in a tuple costs as much as some steps along a ray, and
two threads that do it wait for each other.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import kernel_part
from orthoflow_plugins.ortho.views import (
    FINE_CELLS,
    NOTHING,
    NOTHING_M,
    OCCLUDED,
    Relief,
    WallView,
)

# The data of each ray in `follow_rays`, a column each.
ROW: Final = 0
COLUMN: Final = 1
IS_HIDDEN: Final = 2
_AT, _MOVE, _PLACE, _STEP, _BESIDE = 3, 4, 5, 6, 7
_LEVEL, _CLIMB, _N_STEPS = 8, 9, 10
N_LANES: Final = 11
# Positions and heights along a ray are integers: no step has to be rounded.
_BITS: Final = 32
_UNIT: Final = 1 << _BITS
_PART: Final = _UNIT - 1


class Eye(NamedTuple):
    """Where rays end, and when they count as blocked: numbers only.

    Attributes:
        row: foot of the projection centre on the wall, in cell indices; 0 is the centre of the
            first cell. column likewise.
        height_m: projection centre above the plane.
        tolerance_m: how far a surface must be above a ray to hide what it comes from.
        steps_per_m: of `Relief.occluding`.
    """

    row: float
    column: float
    height_m: float
    tolerance_m: float
    steps_per_m: float


@kernel_part
def eye_of(view: WallView, relief: Relief) -> Eye:
    """Return the camera of a photo in the form that rays need."""
    return Eye(view.row, view.column, view.height_m, view.tolerance_m, 1.0 / relief.step_m)


@kernel_part
def highest_in_the_way(
    eye: Eye,
    tops: NDArray[np.float32],
    bottom: float,
    side: int,
    block: tuple[int, int],
    highest_m: float,
) -> float:
    """Bound the height up to which rays from the cells of a block must be followed.

    On the way to the camera the block moves along the rays, and shrinks. At any position it touches
    no more than the window of 2 x 2 blocks that begins at its corner; between two samples, half a
    block apart, that window moves by one row or column of blocks at most, or by both, one after the
    other. No ray is lower than the one from the lowest cell.

    Args:
        eye: the camera.
        tops: (blocks + 1, blocks + 1) metres, the highest in the window of 2 x 2 blocks that begins
            one row and one column before.
        bottom: the lowest depth of the block.
        side: of a block, in cells.
        block: its row and column among the blocks.
        highest_m: maximum height of all that can hide.
    """
    top = NOTHING_M
    if not bottom < eye.height_m:
        return top
    down = (eye.row + 0.5) / side - block[0] - 0.5
    across = (eye.column + 0.5) / side - block[1] - 0.5
    n_steps = max(1, math.ceil(2.0 * max(abs(down), abs(across))))
    per_step = 1.0 / n_steps
    rise = (eye.height_m - bottom) * per_step
    row, column = _first_block(block[0], down), _first_block(block[1], across)
    for k in range(n_steps + 1):
        height = bottom + max(0, k - 1) * rise + eye.tolerance_m
        if height >= highest_m:
            break
        next_row = _first_block(block[0] + k * per_step * down, down)
        next_column = _first_block(block[1] + k * per_step * across, across)
        here = _top_at(tops, next_row, next_column)
        if next_row != row and next_column != column:
            here = max(here, _top_at(tops, row, next_column), _top_at(tops, next_row, column))
        elif here == NOTHING_M and not _is_inside(tops, next_row, next_column):
            break
        if here > height and here > top:
            top = here
        row, column = next_row, next_column
    return top


@kernel_part
def _first_block(corner: float, direction: float) -> int:
    """Return the first of the two rows or columns that a block touches, from its upper left corner.

    A block that touches a single one tests the next one too, in the direction in which it moves.
    """
    return math.floor(corner) if direction > 0.0 else math.ceil(corner) - 1


@kernel_part
def _is_inside(tops: NDArray[np.float32], row: int, column: int) -> bool:
    rows, columns = tops.shape
    return bool(-1 <= row < rows - 1 and -1 <= column < columns - 1)


@kernel_part
def _top_at(tops: NDArray[np.float32], row: int, column: int) -> float:
    if not _is_inside(tops, row, column):
        return NOTHING_M
    return float(tops[np.uintp(row + 1), np.uintp(column + 1)])


@kernel_part
def follow_rays(
    eye: Eye,
    depths: NDArray[np.float32],
    occluding: NDArray[np.int16],
    top: float,
    n_rays: int,
    rays: NDArray[np.int64],
) -> None:
    """Follow the rays from some cells to the camera, one row or column at a time, up to a height.

    First all are set up, which is fast for many at once, then they are followed one after the
    other.

    Args:
        eye: the camera.
        depths: (rows, cols) of the `Relief`.
        occluding: of the `Relief`.
        top: maximum height of all that can hide, metres.
        n_rays: number of rays.
        rays: (at least n_rays, N_LANES) with rows and columns of the cells in its columns `ROW` and
            `COLUMN`; `IS_HIDDEN` is set to 1 or 0, the others are overwritten.
    """
    columns = depths.shape[1]
    for i in range(n_rays):
        j = np.uintp(i)
        row, column = rays[j, ROW], rays[j, COLUMN]
        depth = float(depths[np.uintp(row), np.uintp(column)])
        down, across = eye.row - row, eye.column - column
        # Steps are whole rows or columns; across them the ray moves by a fraction of a cell.
        if abs(down) >= abs(across):
            along, aside, here, beside = down, across, row, column
            n_here, n_beside, stride, beside_stride = depths.shape[0], columns, columns, 1
        else:
            along, aside, here, beside = across, down, column, row
            n_here, n_beside, stride, beside_stride = columns, depths.shape[0], 1, columns
        per_cell = 1.0 / max(1.0, abs(along))
        height, rise = depth + eye.tolerance_m, (eye.height_m - depth) * per_cell
        n_steps = int(min(abs(along), max(0.0, (top - height) / rise)))
        n_steps = min(n_steps, here if along < 0.0 else n_here - 1 - here)
        move = int(aside * per_cell * _UNIT)
        if not 1.0 < beside + n_steps * aside * per_cell < n_beside - 2.0:
            n_steps = min(n_steps, _steps_inside(beside, n_beside, move))
        rays[j, _AT], rays[j, _MOVE] = beside << _BITS, move
        rays[j, _PLACE] = here * stride
        rays[j, _STEP] = stride if along > 0.0 else -stride
        rays[j, _BESIDE] = beside_stride
        # Without steps, the climb may overflow, and is not used.
        rays[j, _LEVEL] = int(height * eye.steps_per_m * _UNIT)
        rays[j, _CLIMB] = int(rise * eye.steps_per_m * _UNIT)
        rays[j, _N_STEPS] = n_steps
    for i in range(n_rays):
        j = np.uintp(i)
        at, move, stride = rays[j, _AT], rays[j, _MOVE], rays[j, _BESIDE]
        place, step = rays[j, _PLACE], rays[j, _STEP]
        level, climb = rays[j, _LEVEL], rays[j, _CLIMB]
        is_hidden = False
        for _ in range(rays[j, _N_STEPS]):
            at += move
            place += step
            level += climb
            # The surface is linear between the two cells beside the ray, which may be the same.
            share = at & _PART
            first = place + (at >> _BITS) * stride
            second = first + (stride if share else 0)
            one, other = np.int64(occluding[np.uintp(first)]), np.int64(occluding[np.uintp(second)])
            if one * _UNIT + (other - one) * share > level and NOTHING not in (one, other):
                is_hidden = True
                break
        rays[j, IS_HIDDEN] = is_hidden


@kernel_part
def _steps_inside(beside: int, n_beside: int, move: int) -> int:
    """Return how many steps a ray takes before it leaves the raster at its side."""
    if move > 0:
        return ((n_beside - 1 - beside) << _BITS) // move
    return (beside << _BITS) // -move if move < 0 else n_beside


@kernel_part
def hide_low_cells(
    view: WallView,
    relief: Relief,
    mask: NDArray[np.uint8],
    corner: tuple[int, int],
    area: tuple[int, int, int, int],
    top: float,
    rays: NDArray[np.int64],
) -> int:
    """Follow the rays of those cells of a painted block that are low enough to be hidden.

    Small blocks within it are tested first: most of them are free.

    Args:
        view: the camera in front of the wall.
        relief: the wall.
        mask: of the tile's `TileVisibility`, changed for hidden cells.
        corner: row and column of the tile's first cell.
        area: first row and column of the block's cells in the tile, and the row and column after
            its last ones, on the wall.
        top: height up to which rays from the block have to be followed.
        rays: (cells of a small block, N_LANES) working memory.

    Returns:
        The number of hidden cells.
    """
    eye = eye_of(view, relief)
    depths, occluding = relief.depth, relief.occluding
    fine_bottoms, fine_tops = relief.fine_bottoms, relief.fine_tops
    begin, start, finish, end = area
    n_hidden = 0
    for block_row in range(begin // FINE_CELLS, (finish - 1) // FINE_CELLS + 1):
        for block_column in range(start // FINE_CELLS, (end - 1) // FINE_CELLS + 1):
            bottom = float(fine_bottoms[block_row, block_column])
            if not bottom + eye.tolerance_m < top:
                continue
            block = (block_row, block_column)
            fine_top = highest_in_the_way(eye, fine_tops, bottom, FINE_CELLS, block, top)
            low = fine_top - eye.tolerance_m
            if not bottom < low:
                continue
            n_low = 0
            for row in range(
                max(begin, block_row * FINE_CELLS), min(finish, (block_row + 1) * FINE_CELLS)
            ):
                for column in range(
                    max(start, block_column * FINE_CELLS),
                    min(end, (block_column + 1) * FINE_CELLS),
                ):
                    rays[np.uintp(n_low), ROW] = row
                    rays[np.uintp(n_low), COLUMN] = column
                    n_low += depths[np.uintp(row), np.uintp(column)] < low
            follow_rays(eye, depths, occluding, fine_top, n_low, rays)
            for i in range(n_low):
                if rays[np.uintp(i), IS_HIDDEN]:
                    row, column = rays[np.uintp(i), ROW], rays[np.uintp(i), COLUMN]
                    mask[row - corner[0], column - corner[1]] = OCCLUDED
                    n_hidden += 1
    return n_hidden
