"""Kernels for the votes of Hough transforms: for lines in a plan, and for planes in space.

Votes are computed from an image. For each direction, its rows or columns are shifted and added up,
which gives the sums over all lines of that slope. Except for rounding to cells, this is the same as
voting cell by cell, and it is many times faster, because entire rows are added.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part

# Votes are counted in quarters, so that a vote can be divided between two bins and subtracted later
# without rounding errors.
VOTE_SHARES: Final = 4
# Minimum votes of a candidate as a share of the required points, because its votes may be
# distributed over several bins until it is refined.
VOTE_CAUTION: Final = 0.25
# Side of the tiles in which an image is transposed.
_TILE: Final = 16


@compiled
def vote_image(
    image: NDArray[np.int32], angles_rad: NDArray[np.float64], votes: NDArray[np.int32]
) -> None:
    """Let the cells of an image vote for all lines through them.

    Args:
        image: (rows, columns) votes of each cell; negative ones subtract votes.
        angles_rad: (a,) directions of the normals of lines, from the axis of rows towards that of
            columns.
        votes: (a, bins) added to, VOTE_SHARES per vote; bins are as wide as cells, and the middle
            edge is the line through the centre of the image. Equation 4 of markiewicz2015.
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
def _count_upright(
    places: NDArray[np.float32],
    weights: NDArray[np.int32],
    omega_rad: float,
    bin_m: float,
    cells: NDArray[np.int32],
    image: NDArray[np.int32],
) -> tuple[int, int, int, int]:
    """Count positions in a vertical image along a direction; `cells` (m,) is scratch space.

    Returns the window that contains them: first row, row after the last, and the same for columns.
    """
    n_rows, n_columns = image.shape
    cosine, sine = np.float32(math.cos(omega_rad) / bin_m), np.float32(math.sin(omega_rad) / bin_m)
    per_m, zero, none = np.float32(1.0 / bin_m), np.float32(0.0), np.int32(-1)
    half_columns, half_rows = np.float32(0.5 * n_columns), np.float32(0.5 * n_rows)
    top_columns, top_rows = np.float32(n_columns), np.float32(n_rows)
    width = np.int32(n_columns)
    xs, ys, zs = places[0], places[1], places[2]
    left, right, bottom, top = top_columns, zero, top_rows, zero
    # Without branches, so that the compiler vectorises the loop.
    for i in range(cells.size):
        column = cosine * xs[i] + sine * ys[i] + half_columns
        row = zs[i] * per_m + half_rows
        within = (column >= zero) & (column < top_columns) & (row >= zero) & (row < top_rows)
        left, right = min(left, column), max(right, column)
        bottom, top = min(bottom, row), max(top, row)
        column = column if within else zero
        row = row if within else zero
        cells[i] = np.int32(row) * width + np.int32(column) if within else none
    flat = image.reshape(image.size)
    for i in range(cells.size):
        if cells[i] >= 0:
            flat[cells[i]] += weights[i]
    return (
        max(0, int(bottom)),
        min(n_rows, int(top) + 1),
        max(0, int(left)),
        min(n_columns, int(right) + 1),
    )


@compiled
def vote_planes(
    places: NDArray[np.float32],
    weights: NDArray[np.int32],
    angles: NDArray[np.float64],
    starts: NDArray[np.int64],
    image: NDArray[np.int32],
    bin_m: float,
    votes: NDArray[np.int32],
) -> None:
    """Let positions vote for all planes through them, in two stages.

    For each direction in the plan, the positions are counted in a vertical image (distance along
    that direction, height). For each phi, the rows of the image are shifted and added up, or its
    columns for planes that are closer to level than to vertical. This is a hundred times as fast as
    voting one by one.

    Args:
        places: (3, m) e1, e2 and height, metres from the centre of the box.
        weights: (m,) votes of each position; negative ones subtract votes.
        angles: (d, 2) omega and phi of each direction, grouped by omega; radians.
        starts: (o + 1,) index of the first direction of each omega.
        image: (rows, columns) scratch space with zeros; its centre is that of the box.
        bin_m: side of a cell of the image, width of a bin.
        votes: (d, bins) added to, VOTE_SHARES per vote; the middle edge is distance zero.
    """
    n_rows, n_columns = image.shape
    turned = np.empty((n_columns, n_rows), dtype=np.int32)
    cells = np.empty(places.shape[1], dtype=np.int32)
    spans = np.empty((n_rows, 2), dtype=np.int32)
    turned_spans = np.empty((n_columns, 2), dtype=np.int32)
    line = np.zeros(n_rows + n_columns + 4, dtype=np.int32)
    for turn in range(starts.size - 1):
        if starts[turn] == starts[turn + 1]:
            continue
        window = _count_upright(places, weights, angles[starts[turn], 0], bin_m, cells, image)
        turn_image(image, window, turned)
        span_rows(image, window, spans)
        span_rows(turned, (window[2], window[3], window[0], window[1]), turned_spans)
        for d in range(starts[turn], starts[turn + 1]):
            level, rise = math.cos(angles[d, 1]), math.sin(angles[d, 1])
            if level >= abs(rise):
                piece = add_sheared(image, spans, rise / level, line)
                share_out(line, piece, (n_rows, n_columns), level, votes[d])
            else:
                piece = add_sheared(turned, turned_spans, level / rise, line)
                share_out(line, piece, (n_columns, n_rows), rise, votes[d])
        image[window[0] : window[1], window[2] : window[3]] = 0


@compiled
def best_bins(
    votes: NDArray[np.int32],
    rows: NDArray[np.int64],
    half: int,
    is_plain: bool,  # noqa: FBT001 - compiled code takes no keywords
    barred: NDArray[np.uint8],
    scores: NDArray[np.int64],
    places: NDArray[np.int64],
) -> None:
    """Find the window in each row with the largest excess over the emptier adjacent window.

    Args:
        votes: (d, bins).
        rows: (m,) rows to search.
        half: a window has 2 half + 1 bins and is separated from adjacent windows by one bin.
        is_plain: ignore adjacent windows.
        barred: (d, bins) 1 for bins that must not be the centre of a window.
        scores: (d,) set for these rows.
        places: (d,) set to the middle bin.
    """
    n_bins = votes.shape[1]
    width = 2 * half + 1
    gap = width + 1
    running = np.zeros(n_bins + 2 * (half + gap) + 1, dtype=np.int64)
    windows = np.empty(n_bins + 2 * gap, dtype=np.int64)
    line = np.empty(n_bins, dtype=np.int64)
    before, middle, after = windows[:n_bins], windows[gap:], windows[2 * gap :]
    # Separate loops, which the compiler vectorises.
    for d in rows:
        row, is_barred = votes[d], barred[d]
        total = np.int64(0)
        for k in range(n_bins):
            total += row[k]
            running[half + gap + 1 + k] = total
        running[half + gap + 1 + n_bins :] = total
        low, high = running[: windows.size], running[width:]
        for k in range(windows.size):
            windows[k] = high[k] - low[k]
        best = np.int64(-1)
        for k in range(n_bins):
            score = middle[k] - (np.int64(0) if is_plain else min(before[k], after[k]))
            line[k] = np.int64(-1) if is_barred[k] != 0 else score
        for k in range(n_bins):
            best = max(best, line[k])
        scores[d], places[d] = best, 0
        for k in range(n_bins):
            if best >= 0 and line[k] == best:
                places[d] = k
                break


@compiled
def vote_places(
    places: NDArray[np.float32],
    weights: NDArray[np.int32],
    normals: NDArray[np.float64],
    low_m: float,
    bin_m: float,
    votes: NDArray[np.int32],
) -> None:
    """Let positions vote one by one for the planes, or lines in a plan, through them.

    Args:
        places: (3, m) metres; the third coordinate is 0 in a plan.
        weights: (m,) votes of each position.
        normals: (t, 3) directions of distances, as in Equation 4 of markiewicz2015.
        low_m: lower edge of the first bin; positions outside the bins do not vote.
        bin_m: width of a bin.
        votes: (t, bins) added to.
    """
    n_bins = votes.shape[1]
    bins = np.empty(places.shape[1], dtype=np.int32)
    us, vs, heights = places[0], places[1], places[2]
    zero, none, top = np.float32(0.0), np.int32(-1), np.float32(n_bins)
    d = np.float32(-low_m / bin_m)
    for t in range(normals.shape[0]):
        a, b = np.float32(normals[t, 0] / bin_m), np.float32(normals[t, 1] / bin_m)
        c = np.float32(normals[t, 2] / bin_m)
        for i in range(bins.size):
            place = c * heights[i] + a * us[i] + b * vs[i] + d
            within = (place >= zero) & (place < top)
            bins[i] = np.int32(place if within else zero) if within else none
        for i in range(bins.size):
            if bins[i] >= 0:
                votes[t, bins[i]] += weights[i]


@kernel_part
def add_sheared(
    image: NDArray[np.int32],
    spans: NDArray[np.int32],
    shear: float,
    line: NDArray[np.int32],
) -> tuple[int, int]:
    """Add the rows of an image to a line, shifted by the distance from the centre times a shear.

    If the shift is zero, the first column is added at index half the number of rows plus one. The
    line must be zero. Returns the part that is changed.
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
    """Add part of a line to a row of votes with narrower bins, in quarters; clear the line.

    Args:
        line: see `add_sheared`.
        piece: part of the line that is not zero.
        shape: rows and columns of the image.
        scale: width of a cell of the line, in bins; negative for the opposite direction.
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
    """Set spans (rows, 2) to the first column with votes and the column after the last.

    All votes are in the window: first row, row after the last, and the same for columns.
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
    """Set `turned` to the transposed image, tile by tile for the cache."""
    for top in range(window[0], window[1], _TILE):
        for left in range(window[2], window[3], _TILE):
            for column in range(left, min(left + _TILE, window[3])):
                for row in range(top, min(top + _TILE, window[1])):
                    turned[column, row] = image[row, column]


def best_bin(
    votes: NDArray[np.int32], barred: NDArray[np.uint8], half: int, *, is_plain: bool
) -> tuple[int, int, int]:
    """Return the score, row and bin of the best window in a table; see `best_bins`."""
    scores, places = np.zeros((2, len(votes)), dtype=np.int64)
    best_bins(votes, np.arange(len(votes)), half, is_plain, barred, scores, places)
    row = int(np.argmax(scores))
    return int(scores[row]), row, int(places[row])


def contrast(votes: NDArray[np.int32], half: int) -> NDArray[np.float64]:
    """Return the votes in windows of 2 half + 1 bins minus those of the emptier adjacent window."""
    width = 2 * half + 1
    gap = width + 1
    padded = np.pad(votes, ((0, 0), (half + gap + 1, half + gap)))
    running = np.cumsum(padded, axis=1, dtype=np.int64)
    window = (running[:, width:] - running[:, :-width]).astype(np.float64)
    n_bins = votes.shape[1]
    middle = window[:, gap : gap + n_bins]
    left, right = window[:, :n_bins], window[:, 2 * gap : 2 * gap + n_bins]
    return middle - np.minimum(left, right)


def sharpest(votes: NDArray[np.int32]) -> tuple[int, float]:
    """Return the row of votes (rows, bins) with the best maximum, and its position in bins."""
    scores = contrast(votes, 1)
    row, column = np.unravel_index(int(np.argmax(scores)), scores.shape)
    values, place = scores[row], int(column)
    shift = 0.0
    if 0 < place < len(values) - 1:
        before, here, after = values[place - 1 : place + 2]
        bend = before - 2.0 * here + after
        # Vertex of the parabola through the three values.
        shift = 0.0 if bend >= 0.0 else float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5))
    return int(row), place + 0.5 + shift
