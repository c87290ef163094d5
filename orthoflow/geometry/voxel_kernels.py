"""Compiled passes of the 3D Hough transform: voxels in bricks, two-stage votes, their maxima.

Voxels live in bricks of 8 x 8 x 8, of which only those with points have memory: a scan is surfaces,
and a full table of two-centimetre voxels would be larger than the scan.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part
from orthoflow.geometry.point_kernels import BLOCK_POINTS, BlockedPoints
from orthoflow.geometry.shear_kernels import add_sheared, share_out, span_rows, turn_image

BRICK_SIDE: Final = 8
VOXELS: Final = BRICK_SIDE**3


@kernel_part
def place_keys(
    points: BlockedPoints,
    start: int,
    frame: NDArray[np.float32],
    shape: tuple[int, int, int],
    keys: NDArray[np.int64],
) -> int:
    """Set the voxel of a block's points; gives their number.

    Apart from the counting and without branches, so that the processor takes several points at
    once. Each of these loops writes one array: with more, the compiler gives up that.

    Args:
        points: (n,) offsets in blocks.
        start: first point of the block.
        frame: (3, 4) voxel of a point: `frame @ p - frame[:, 3]`.
        shape: bricks along a, b, c.
        keys: (BLOCK_POINTS,) set: brick times VOXELS plus the voxel within it, -1 outside.
    """
    stop = min(start + BLOCK_POINTS, points.x.size)
    xs, ys, zs = points.x[start:stop], points.y[start:stop], points.z[start:stop]
    a0, a1, a2, a3 = frame[0, 0], frame[0, 1], frame[0, 2], frame[0, 3]
    b0, b1, b2, b3 = frame[1, 0], frame[1, 1], frame[1, 2], frame[1, 3]
    c0, c1, c2, c3 = frame[2, 0], frame[2, 1], frame[2, 2], frame[2, 3]
    zero, low = np.float32(0.0), np.int32(BRICK_SIDE - 1)
    top_a = np.float32(shape[0] * BRICK_SIDE)
    top_b = np.float32(shape[1] * BRICK_SIDE)
    top_c = np.float32(shape[2] * BRICK_SIDE)
    n_b, n_c, side = np.int32(shape[1]), np.int32(shape[2]), np.int32(BRICK_SIDE)
    voxels, nowhere = np.int64(VOXELS), np.int64(-1)
    for i in range(xs.size):
        a = a0 * xs[i] + a1 * ys[i] + a2 * zs[i] - a3
        b = b0 * xs[i] + b1 * ys[i] + b2 * zs[i] - b3
        c = c0 * xs[i] + c1 * ys[i] + c2 * zs[i] - c3
        within = (a >= zero) & (a < top_a) & (b >= zero) & (b < top_b)
        within = within & (c >= zero) & (c < top_c)
        p = np.int32(a if within else zero)
        q = np.int32(b if within else zero)
        r = np.int32(c if within else zero)
        # A side of eight: whole bricks are three bits further up.
        brick = np.int32(((p >> np.int32(3)) * n_b + (q >> np.int32(3))) * n_c + (r >> np.int32(3)))
        voxel = np.int32(((p & low) * side + (q & low)) * side + (r & low))
        keys[i] = brick * voxels + voxel if within else nowhere
    return xs.size


@kernel_part
def _add_voxels(
    key: int,
    count: int,
    bricks: NDArray[np.int32],
    counts: NDArray[np.int32],
    n_used: NDArray[np.int64],
) -> None:
    """Add a number of points to a voxel, whose brick is made if it is new."""
    if key < 0:
        return
    brick = key // VOXELS
    row = bricks[brick]
    if row < 0:
        row = np.int32(n_used[0])
        n_used[0] += 1
        bricks[brick] = row
    counts[row, key % VOXELS] += count


@compiled
def gather_voxels(
    points: BlockedPoints,
    start: int,
    frame: NDArray[np.float32],
    shape: tuple[int, int, int],
    bricks: NDArray[np.int32],
    counts: NDArray[np.int32],
    n_used: NDArray[np.int64],
) -> int:
    """Count points per voxel in bricks that are made as they are met, until the table is full.

    Args:
        points: (n,) offsets in blocks.
        start: first point, at the start of a block.
        frame: (3, 4) voxel of a point: `frame @ p - frame[:, 3]`.
        shape: bricks along a, b, c.
        bricks: (a * b * c,) row of each brick, -1 without points; changed.
        counts: (rows, VOXELS) points; added to.
        n_used: (1,) rows in use; changed.

    Returns:
        The first point that was not counted: the number of points, unless the table is full.
    """
    keys = np.empty(BLOCK_POINTS, dtype=np.int64)
    while start < points.x.size:
        if n_used[0] + BLOCK_POINTS > counts.shape[0]:
            return start
        count = place_keys(points, start, frame, shape, keys)
        first, key = 0, keys[0]
        for i in range(1, count):
            # A scan's neighbours share a voxel: runs of them are added at once.
            if keys[i] != key:
                _add_voxels(key, i - first, bricks, counts, n_used)
                first, key = i, keys[i]
        _add_voxels(key, count - first, bricks, counts, n_used)
        start += BLOCK_POINTS
    return points.x.size


@kernel_part
def _count_upright(
    places: NDArray[np.float32],
    weights: NDArray[np.int32],
    omega_rad: float,
    bin_m: float,
    cells: NDArray[np.int32],
    image: NDArray[np.int32],
) -> tuple[int, int, int, int]:
    """Count places in an upright image along a direction; (m,) cells is scratch.

    Gives the window that they lie in: first row, row behind the last, and the same for columns.
    """
    n_rows, n_columns = image.shape
    cosine, sine = np.float32(math.cos(omega_rad) / bin_m), np.float32(math.sin(omega_rad) / bin_m)
    per_m, zero, none = np.float32(1.0 / bin_m), np.float32(0.0), np.int32(-1)
    half_columns, half_rows = np.float32(0.5 * n_columns), np.float32(0.5 * n_rows)
    top_columns, top_rows = np.float32(n_columns), np.float32(n_rows)
    width = np.int32(n_columns)
    xs, ys, zs = places[0], places[1], places[2]
    left, right, bottom, top = top_columns, zero, top_rows, zero
    # Without branches, so that the processor takes several places at once.
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
    """Let places vote for all planes through them, in two stages.

    For each direction in plan the places are counted in an upright image (distance along that
    direction, height). For each phi the rows of the image are shifted and added up, or its columns
    for planes that are more level than upright: the sum is what a line of that slope meets. That is
    as exact as voting one by one up to rounding to cells, and a hundred times faster, because whole
    rows are added and nothing is scattered.

    Args:
        places: (3, m) e1, e2 and height, metres from the middle of the box.
        weights: (m,) votes of each; negative ones take votes back.
        angles: (d, 2) omega and phi of each direction, those with one omega together; radians.
        starts: (o + 1,) where the directions of each omega start.
        image: (rows, columns) scratch, zeros; its middle is the middle of the box.
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
    barred: NDArray[np.uint8],
    scores: NDArray[np.int64],
    places: NDArray[np.int64],
) -> None:
    """Find in each row the window whose votes stand out most from the emptier window beside it.

    Args:
        votes: (d, bins).
        rows: (m,) which of them are asked about.
        half: a window has 2 half + 1 bins; the windows beside begin one bin further off.
        barred: (d, bins) 1 where no window may have its middle.
        scores: (d,) set where asked.
        places: (d,) set to the middle bin.
    """
    n_bins = votes.shape[1]
    width = 2 * half + 1
    gap = width + 1
    running = np.zeros(n_bins + 2 * (half + gap) + 1, dtype=np.int64)
    windows = np.empty(n_bins + 2 * gap, dtype=np.int64)
    line = np.empty(n_bins, dtype=np.int64)
    before, middle, after = windows[:n_bins], windows[gap:], windows[2 * gap :]
    # Loops of one step each, so that the processor takes several bins at once.
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
            score = middle[k] - min(before[k], after[k])
            line[k] = np.int64(-1) if is_barred[k] != 0 else score
        for k in range(n_bins):
            best = max(best, line[k])
        scores[d], places[d] = best, 0
        for k in range(n_bins):
            if best >= 0 and line[k] == best:
                places[d] = k
                break


@compiled
def vote_tilts(
    places: NDArray[np.float32],
    weights: NDArray[np.int32],
    slopes: NDArray[np.float64],
    low_m: float,
    bin_m: float,
    votes: NDArray[np.int64],
) -> None:
    """Let places near a plane vote for planes that lean a little from it.

    Args:
        places: (3, m) u and v on the plane and the distance from it, metres.
        weights: (m,) votes of each.
        slopes: (t, 2) rise per metre along u and v.
        low_m: lower edge of the first bin.
        bin_m: width of a bin.
        votes: (t, bins) added to.
    """
    n_bins = votes.shape[1]
    bins = np.empty(places.shape[1], dtype=np.int32)
    us, vs, heights = places[0], places[1], places[2]
    zero, none, top = np.float32(0.0), np.int32(-1), np.float32(n_bins)
    for t in range(slopes.shape[0]):
        a, b = np.float32(-slopes[t, 0] / bin_m), np.float32(-slopes[t, 1] / bin_m)
        c, d = np.float32(1.0 / bin_m), np.float32(-low_m / bin_m)
        for i in range(bins.size):
            place = c * heights[i] + a * us[i] + b * vs[i] + d
            within = (place >= zero) & (place < top)
            bins[i] = np.int32(place if within else zero) if within else none
        for i in range(bins.size):
            if bins[i] >= 0:
                votes[t, bins[i]] += weights[i]
