"""Compiled bilinear sampling of a photo: three channels at once, in whole numbers.

The channels of a pixel stand 21 bits apart in one 64-bit number. Weights in 64ths of a pixel along
both axes multiply to 12 bits, and 8 + 12 bits do not run over into the next channel: four products
and three sums give three colours, the same ones on every machine. `cv2.remap` takes twice as long.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled

_STEPS: Final = 64
# Places of the channels in a packed pixel.
_GREEN, _BLUE = np.uint64(21), np.uint64(42)
_WEIGHT_BITS: Final = np.uint64(12)
# Half of what a weighted sum is divided by, for each channel: colours are rounded, not cut off.
_HALF: Final = np.uint64((1 << 11) | (1 << 32) | (1 << 53))


@compiled
def pack_pixels(photo: NDArray[np.uint8], packed: NDArray[np.uint64]) -> None:
    """Pack the channels of each pixel; the last column and the last row are there twice.

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
    """Cells of a larger array, which stays whole: rows of a part of it would be slower to read.

    Attributes:
        row: the first one; column likewise.
        n_rows: how many; n_columns likewise.
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
    """Set the colours at places of a photo, which goes on beyond its border as it ends there.

    Args:
        packed: of `pack_pixels`.
        places: u and v (rows, cols) in pixels, numbers everywhere.
        corner: u and v of the centre of the first pixel.
        patch: which of the places.
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
        # Each of these loops writes one array, and the processor takes eight cells at once.
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
            # One product each: that differences run under does no harm, for the sums do not.
            above_sum = pixels[upper] * whole
            above_sum += (pixels[upper + np.uintp(1)] - pixels[upper]) * right
            below_sum = pixels[lower] * whole
            below_sum += (pixels[lower + np.uintp(1)] - pixels[lower]) * right
            colour = above_sum * whole + (below_sum - above_sum) * below + _HALF
            into[j, 0] = np.uint8((colour >> _WEIGHT_BITS) & np.uint64(255))
            into[j, 1] = np.uint8((colour >> (_WEIGHT_BITS + _GREEN)) & np.uint64(255))
            into[j, 2] = np.uint8((colour >> (_WEIGHT_BITS + _BLUE)) & np.uint64(255))
