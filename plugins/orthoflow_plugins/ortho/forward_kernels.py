"""Compiled function that projects the pixels of a photo onto the surface of a wall."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled
from orthoflow.geometry.depth_buffer_kernels import DepthBuffer
from orthoflow_plugins.ortho.visibility_kernels import Relief, WallView

# Rays are exact at every nth pixel and interpolated in between. The interpolation error is below a
# hundredth of a pixel for focal lengths of 1000 pixels or more.
RAY_STEP_PX: Final = 16
NO_PIXEL: Final = -1
_NEAREST_M: Final = 0.05


class Catch(NamedTuple):
    """The pixel chosen for each cell of a wall.

    Attributes:
        pixel: (rows, cols) int32 index row * width + column in the photo, or `NO_PIXEL`.
        square: (rows, cols) float32 squared distance between the cell centre and the point hit by
            the ray of this pixel, in squared cells.
    """

    pixel: NDArray[np.int32]
    square: NDArray[np.float32]


@compiled
def throw_pixels(
    view: WallView, relief: Relief, buffer: DepthBuffer, rays: NDArray[np.float64], catch: Catch
) -> int:
    """Trace the ray of each pixel to the first cell that it hits; keep one pixel for each cell.

    A cell takes the pixel whose ray hits it closest to its centre; of equally close pixels, it
    takes the first. A ray that hits the side of a depth step is ignored, since that side is not
    part of any cell.

    Args:
        view: the camera in front of the wall.
        relief: the surface, with at least one known depth.
        buffer: depth buffer of other objects.
        rays: (n, m, 3) ray directions at the pixel positions `RAY_STEP_PX` * (row, column), per
            metre along the optical axis; components along columns and rows are in cells, and those
            along the normal are in metres.
        catch: the chosen pixels, updated.

    Returns:
        The number of pixels that hit the surface.
    """
    rows, columns = relief.depth.shape
    width, height = int(view.camera[21]), int(view.camera[22])
    per_step, per_pixel = 1.0 / RAY_STEP_PX, 1.0 / buffer.reduction
    lowest = np.float64(np.min(relief.bottoms))
    free_m, gsd_m = view.height_m - view.front_m, view.gsd_m
    n_met = 0
    for j in range(height):
        at_row = (j + 0.5) * per_step
        low_row = int(at_row)
        down = at_row - low_row
        for i in range(width):
            at_column = (i + 0.5) * per_step
            low_column = int(at_column)
            across = at_column - low_column
            w00, w01 = (1.0 - down) * (1.0 - across), (1.0 - down) * across
            w10, w11 = down * (1.0 - across), down * across
            above, below = rays[low_row, low_column], rays[low_row + 1, low_column]
            above_next, below_next = (
                rays[low_row, low_column + 1],
                rays[low_row + 1, low_column + 1],
            )
            dc = w00 * above[0] + w01 * above_next[0] + w10 * below[0] + w11 * below_next[0]
            dr = w00 * above[1] + w01 * above_next[1] + w10 * below[1] + w11 * below_next[1]
            dn = w00 * above[2] + w01 * above_next[2] + w10 * below[2] + w11 * below_next[2]
            if not dn < -1e-9:
                continue
            aside = gsd_m * gsd_m * (dc * dc + dr * dr)
            if -dn <= view.cosine_least * math.sqrt(aside + dn * dn):
                continue
            passes = free_m / -dn - view.tolerance_m
            nearest = buffer.nearest[int((j + 0.5) * per_pixel), int((i + 0.5) * per_pixel)]
            if nearest < passes:
                continue
            t = first_hit(view, relief, dc, dr, dn, lowest)
            if t < 0.0:
                continue
            u, v = view.column + 0.5 + t * dc, view.row + 0.5 + t * dr
            column, row = math.floor(u), math.floor(v)
            if not (0 <= column < columns and 0 <= row < rows):
                continue
            if math.isnan(relief.depth[row, column]):
                continue
            n_met += 1
            du, dv = u - column - 0.5, v - row - 0.5
            square = np.float32(du * du + dv * dv)
            if square < catch.square[row, column]:
                catch.square[row, column] = square
                catch.pixel[row, column] = j * width + i
    return n_met


@compiled
def first_hit(
    view: WallView, relief: Relief, dc: float, dr: float, dn: float, lowest: float
) -> float:
    """Return the distance in metres along the optical axis at which a ray hits the surface, or -1.

    Each cell is a flat patch. A ray that enters a cell below its surface has hit the side of a
    depth step. If the height difference is small, it is due to noise or a slope and the cell counts
    as hit; otherwise, it is an edge and the result is -1.
    """
    rows, columns = relief.depth.shape
    begin = max(_NEAREST_M, (view.height_m - relief.highest_m) / -dn)
    # Continue slightly beyond the lowest cell, to allow for rounding.
    end = (view.height_m - lowest + view.tolerance_m) / -dn
    t = begin
    u, v = view.column + 0.5 + t * dc, view.row + 0.5 + t * dr
    column, row = math.floor(u), math.floor(v)
    column_step, row_step = (1 if dc > 0.0 else -1), (1 if dr > 0.0 else -1)
    per_column = 1.0 / max(abs(dc), 1e-12)
    per_row = 1.0 / max(abs(dr), 1e-12)
    next_column = t + (column + 1 - u if dc > 0.0 else u - column) * per_column
    next_row = t + (row + 1 - v if dr > 0.0 else v - row) * per_row
    slack = -dn * min(per_column, per_row, end - begin) + 2.0 * view.tolerance_m
    while t < end:
        leaves = min(next_column, next_row, end)
        if 0 <= column < columns and 0 <= row < rows:
            depth = float(relief.depth[row, column])
            height = view.height_m + t * dn
            # Void cells are NaN, so the comparison is false.
            if view.height_m + leaves * dn <= depth:
                if height >= depth:
                    return t + (height - depth) / -dn
                return t if depth - height <= slack else -1.0
        if next_column <= next_row:
            column += column_step
            next_column += per_column
        else:
            row += row_step
            next_row += per_row
        t = leaves
    return -1.0
