"""Compiled votes of an image for lines: its rows are shifted and added up, nothing is scattered.

For each direction the rows of the image, or its columns, are shifted and added to one line: the sum
is what lines of that slope meet. That is as exact as voting cell by cell up to rounding to cells,
and many times faster, because whole rows are added.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part

# A vote is counted in quarters, so that it can be shared between two bins without a rounding that
# would not cancel when it is taken back.
VOTE_SHARES: Final = 4
# Side of the tiles that an image is turned by.
_TILE: Final = 16


@compiled
def vote_image(
    image: NDArray[np.int32], angles_rad: NDArray[np.float64], votes: NDArray[np.int64]
) -> None:
    """Let the cells of an image vote for all lines through them.

    Args:
        image: (rows, columns) votes of each cell; negative ones take votes back.
        angles_rad: (a,) directions of the lines' normals, from the rows' axis to the columns'.
        votes: (a, bins) added to, VOTE_SHARES per vote; bins are as wide as cells, and the middle
            edge is the line through the middle of the image. Equation 4 of markiewicz2015.
    """
    n_rows, n_columns = image.shape
    turned = np.zeros((n_columns, n_rows), dtype=np.int32)
    spans = np.empty((n_rows, 2), dtype=np.int32)
    turned_spans = np.empty((n_columns, 2), dtype=np.int32)
    line = np.zeros(n_rows + n_columns + 4, dtype=np.int32)
    turn_image(image, (0, n_rows, 0, n_columns), turned)
    span_rows(image, (0, n_rows, 0, n_columns), spans)
    span_rows(turned, (0, n_columns, 0, n_rows), turned_spans)
    for a in range(angles_rad.size):
        cosine, sine = math.cos(angles_rad[a]), math.sin(angles_rad[a])
        if abs(sine) >= abs(cosine):
            piece = add_sheared(image, spans, cosine / sine, line)
            share_out(line, piece, (n_rows, n_columns), sine, votes[a])
        else:
            piece = add_sheared(turned, turned_spans, sine / cosine, line)
            share_out(line, piece, (n_columns, n_rows), cosine, votes[a])


@kernel_part
def add_sheared(
    image: NDArray[np.int32],
    spans: NDArray[np.int32],
    shear: float,
    line: NDArray[np.int32],
) -> tuple[int, int]:
    """Add the rows of an image to a line, each shifted by its height over the middle times a shear.

    A row's first column lands at half its number of rows, and one more, with no shift. The line is
    zero before; gives the piece of it that no longer is.
    """
    n_rows = image.shape[0]
    low, high = line.size, 0
    for row in range(n_rows):
        first, last = spans[row, 0], spans[row, 1]
        if first >= last:
            continue
        shift = math.floor((row + 0.5 - 0.5 * n_rows) * shear + 0.5) + n_rows // 2 + 1
        target = line[shift + first : shift + last]
        source = image[row, first:last]
        for i in range(source.size):
            target[i] += source[i]
        low, high = min(low, shift + first), max(high, shift + last)
    return low, high


@kernel_part
def share_out(
    line: NDArray[np.int32],
    piece: tuple[int, int],
    shape: tuple[int, int],
    scale: float,
    votes: NDArray[np.int32],
) -> None:
    """Add a piece of a line to a row of votes whose bins are narrower, in quarters; clears it.

    Args:
        line: see `add_sheared`.
        piece: what of it is not zero.
        shape: rows and columns of the image that was added up.
        scale: width of a cell of the line, in bins; negative when it runs the other way.
        votes: (bins,) added to.
    """
    middle = 0.5 * votes.size
    for i in range(piece[0], piece[1]):
        if line[i] == 0:
            continue
        left = scale * (i - (shape[0] // 2 + 1) - 0.5 * shape[1]) + middle
        low = min(left, left + scale)
        first = math.floor(low)
        share = min(VOTE_SHARES, int(VOTE_SHARES * (first + 1 - low) / abs(scale) + 0.5))
        if 0 <= first < votes.size:
            votes[first] += share * line[i]
        if 0 <= first + 1 < votes.size:
            votes[first + 1] += (VOTE_SHARES - share) * line[i]
        line[i] = 0


@kernel_part
def span_rows(
    image: NDArray[np.int32], window: tuple[int, int, int, int], spans: NDArray[np.int32]
) -> None:
    """Set (rows, 2) spans to the first column with votes and the one behind the last.

    All votes lie in the window: first row, row behind the last, and the same for the columns.
    """
    spans[:] = 0
    for row in range(window[0], window[1]):
        first, last = window[2], window[3]
        while first < last and image[row, first] == 0:
            first += 1
        while last > first and image[row, last - 1] == 0:
            last -= 1
        spans[row, 0], spans[row, 1] = first, last


@kernel_part
def turn_image(
    image: NDArray[np.int32], window: tuple[int, int, int, int], turned: NDArray[np.int32]
) -> None:
    """Set turned to the image with rows and columns exchanged, tile by tile for the cache."""
    for top in range(window[0], window[1], _TILE):
        for left in range(window[2], window[3], _TILE):
            for column in range(left, min(left + _TILE, window[3])):
                for row in range(top, min(top + _TILE, window[1])):
                    turned[column, row] = image[row, column]
