"""Compiled passes that paint a tile: colours sampled from the photo, and written to the layer.

Bilinear sampling takes three channels at once, in integers. The channels of a pixel are 21 bits
apart in one 64-bit number. Weights in 64ths of a pixel along both axes multiply to 12 bits, and 8 +
12 bits do not overflow into the next channel: four products and three sums give three colours, the
same ones on every machine. `cv2.remap` takes twice as long. Channels of 16 bits do not fit into one
number; they are mixed one by one, by weights that are not rounded.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part
from orthoflow.geometry.levels import Colours
from orthoflow_plugins.ortho.views import OCCLUDED, PAINTED, TileVisibility

_STEPS: Final = 64
# Bit positions of the channels in a packed pixel.
_GREEN, _BLUE = np.uint64(21), np.uint64(42)
_WEIGHT_BITS: Final = np.uint64(12)
# Half of the divisor of a weighted sum, for each channel, so that colours are rounded.
_HALF: Final = np.uint64((1 << 11) | (1 << 32) | (1 << 53))
# Twenty bits resolve views well enough, and compress to half the size.
_QUALITY_BITS: Final = np.uint32(0xFFFFF000)
# Cells processed together: if all are painted, none has to be cleared.
_RUN: Final = 32


@compiled
def pack_pixels(photo: NDArray[np.uint8], packed: NDArray[np.uint64]) -> None:
    """Pack the channels of each pixel; the last column and the last row are repeated.

    Args:
        photo: (rows, cols, 3).
        packed: (rows + 1, cols + 1) overwritten.
    """
    rows, columns = photo.shape[0], photo.shape[1]
    for row in range(rows + 1):
        pixels = photo[min(row, rows - 1)]
        for column in range(columns):
            red, green = np.uint64(pixels[column, 0]), np.uint64(pixels[column, 1])
            blue = np.uint64(pixels[column, 2])
            packed[row, column] = red | (green << _GREEN) | (blue << _BLUE)
        packed[row, columns] = packed[row, columns - 1]


class Patch(NamedTuple):
    """A range of cells of a larger array, which is passed whole: rows of a view are slower.

    Attributes:
        row: the first one; column likewise.
        n_rows: number of rows; n_columns likewise.
    """

    row: int
    column: int
    n_rows: int
    n_columns: int


@compiled
def sample_bilinear(
    packed: NDArray[np.uint64],
    places: tuple[NDArray[np.float32], NDArray[np.float32]],
    corner: tuple[np.float32, np.float32],
    patch: Patch,
    colours: NDArray[np.uint8],
) -> None:
    """Set the colours at positions of a photo, whose border is extended.

    Args:
        packed: from `pack_pixels`.
        places: u and v (rows, cols) in pixels, finite everywhere.
        corner: u and v of the centre of the first pixel.
        patch: range of positions.
        colours: (rows, cols, 3) of the patch, overwritten.
    """
    us, vs = places[0].reshape(places[0].size), places[1].reshape(places[1].size)
    width, pixels = packed.shape[1], packed.reshape(packed.size)
    first_u, first_v, zero = corner[0], corner[1], np.float32(0.0)
    last_u, last_v = np.float32(packed.shape[1] - 2), np.float32(packed.shape[0] - 2)
    steps, half, whole = np.float32(_STEPS), np.float32(0.5), np.uint64(_STEPS)
    at, shares = np.empty(patch.n_columns, np.int32), np.empty(patch.n_columns, np.int32)
    for row in range(patch.n_rows):
        first = np.uintp((patch.row + row) * places[0].shape[1] + patch.column)
        into = colours[row]
        # Each of these loops writes one array, and eight cells are processed at once.
        for j in range(patch.n_columns):
            across = min(max(us[first + np.uintp(j)] - first_u, zero), last_u)
            down = min(max(vs[first + np.uintp(j)] - first_v, zero), last_v)
            at[j] = np.int32(down) * np.int32(width) + np.int32(across)
        for j in range(patch.n_columns):
            across = min(max(us[first + np.uintp(j)] - first_u, zero), last_u)
            down = min(max(vs[first + np.uintp(j)] - first_v, zero), last_v)
            share_across = np.int32((across - np.float32(np.int32(across))) * steps + half)
            share_down = np.int32((down - np.float32(np.int32(down))) * steps + half)
            shares[j] = share_across | (share_down << np.int32(8))
        for j in range(patch.n_columns):
            upper = np.uintp(at[j])
            lower = upper + np.uintp(width)
            right = np.uint64(np.uint32(shares[j]) & np.uint32(255))
            below = np.uint64(np.uint32(shares[j]) >> np.uint32(8))
            # One product each: negative differences wrap around, but the sums do not.
            above_sum = pixels[upper] * whole
            above_sum += (pixels[upper + np.uintp(1)] - pixels[upper]) * right
            below_sum = pixels[lower] * whole
            below_sum += (pixels[lower + np.uintp(1)] - pixels[lower]) * right
            colour = above_sum * whole + (below_sum - above_sum) * below + _HALF
            into[j, 0] = np.uint8((colour >> _WEIGHT_BITS) & np.uint64(255))
            into[j, 1] = np.uint8((colour >> (_WEIGHT_BITS + _GREEN)) & np.uint64(255))
            into[j, 2] = np.uint8((colour >> (_WEIGHT_BITS + _BLUE)) & np.uint64(255))


@compiled
def sample_deep(
    photo: NDArray[np.uint16],
    places: tuple[NDArray[np.float32], NDArray[np.float32]],
    corner: tuple[np.float32, np.float32],
    patch: Patch,
    colours: NDArray[np.uint16],
) -> None:
    """Do as `sample_bilinear` for (rows, cols, 3) of 16 bits, which are not packed."""
    us, vs = places
    last_u, last_v = photo.shape[1] - 1, photo.shape[0] - 1
    for row in range(patch.n_rows):
        for j in range(patch.n_columns):
            u, v = us[patch.row + row, patch.column + j], vs[patch.row + row, patch.column + j]
            across = min(max(float(u - corner[0]), 0.0), float(last_u))
            down = min(max(float(v - corner[1]), 0.0), float(last_v))
            left, upper = int(across), int(down)
            right, lower = min(left + 1, last_u), min(upper + 1, last_v)
            across -= left
            down -= upper
            for channel in range(3):
                first, last = float(photo[upper, left, channel]), float(photo[lower, left, channel])
                above = first + (float(photo[upper, right, channel]) - first) * across
                below = last + (float(photo[lower, right, channel]) - last) * across
                colours[row, j, channel] = int(above + (below - above) * down + 0.5)


class Canvas(NamedTuple):
    """A layer that is being painted.

    Attributes:
        mask: (rows, cols) uint8 states.
        quality: (rows, cols) float32.
        rgb: (rows, cols, 3) uint8 or uint16.
    """

    mask: NDArray[np.uint8]
    quality: NDArray[np.float32]
    rgb: Colours


@compiled
def hand_over(
    visible: TileVisibility,
    is_near: NDArray[np.uint8],
    inner: tuple[int, int],
    canvas: Canvas,
    tile: tuple[slice, slice],
) -> None:
    """Write mask and quality of a tile, and clear the colours of cells that are not painted.

    Args:
        visible: of the tile with its margin.
        is_near: of the same shape, non-zero where a cell is too close to a hidden patch; or empty.
        inner: row and column of `visible` where the tile begins.
        canvas: changed in the tile.
        tile: rows and columns of it.
    """
    rows, columns = tile
    n_columns, width = columns.stop - columns.start, canvas.mask.shape[1]
    masks = canvas.mask.reshape(canvas.mask.size)
    qualities = canvas.quality.view(np.uint32).reshape(canvas.quality.size)
    seen = visible.mask.reshape(visible.mask.size)
    qualities_in = visible.quality.view(np.uint32).reshape(visible.quality.size)
    near = is_near.reshape(is_near.size)
    painted, occluded = np.uint8(PAINTED), np.uint8(OCCLUDED)
    zero, bits = np.uint32(0), _QUALITY_BITS
    for row in range(rows.start, rows.stop):
        first = np.uintp(row * width + columns.start)
        source = np.uintp((row - rows.start + inner[0]) * visible.mask.shape[1] + inner[1])
        for j in range(n_columns):
            masks[first + np.uintp(j)] = seen[source + np.uintp(j)]
        if near.size:
            for j in range(n_columns):
                is_lost = (near[source + np.uintp(j)] != 0) & (
                    seen[source + np.uintp(j)] == painted
                )
                masks[first + np.uintp(j)] = occluded if is_lost else seen[source + np.uintp(j)]
        for j in range(n_columns):
            is_bare = masks[first + np.uintp(j)] != painted
            value = np.uint32(qualities_in[source + np.uintp(j)] & bits)
            qualities[first + np.uintp(j)] = zero if is_bare else value
    _take_colours(canvas, tile)


@kernel_part
def _take_colours(canvas: Canvas, tile: tuple[slice, slice]) -> None:
    """Make the unpainted cells of a tile black."""
    rows, columns = tile
    masks, rgb = canvas.mask.reshape(canvas.mask.size), canvas.rgb.reshape(canvas.rgb.size)
    painted = np.uint8(PAINTED)
    for row in range(rows.start, rows.stop):
        for start in range(columns.start, columns.stop, _RUN):
            first = np.uintp(row * canvas.mask.shape[1] + start)
            n_cells = min(columns.stop - start, _RUN)
            has_bare = False
            for j in range(n_cells):
                has_bare |= masks[first + np.uintp(j)] != painted
            if not has_bare:
                continue
            for j in range(n_cells):
                if masks[first + np.uintp(j)] != painted:
                    for channel in range(3):
                        rgb[3 * (first + np.uintp(j)) + np.uintp(channel)] = 0
