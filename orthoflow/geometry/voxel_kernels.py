"""Compiled passes of the 3D Hough transform: voxels in bricks, two-stage votes, their maxima.

Voxels live in bricks of 8 x 8 x 8, of which only those with points have memory: a scan is surfaces,
and a full table of two-centimetre voxels would be larger than the scan.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.point_kernels import BLOCK_POINTS, BlockedPoints, compiled

BRICK_SIDE: Final = 8


@compiled
def _place_block(
    points: BlockedPoints,
    start: int,
    frame: NDArray[np.float32],
    shape: tuple[int, int, int],
    brick: NDArray[np.int32],
    voxel: NDArray[np.int32],
) -> int:
    """Set brick (-1 outside) and voxel of a block's points, without branches; gives their number.

    Apart from the counting, so that the processor takes several points at once.
    """
    x, y, z = points.x, points.y, points.z
    a0, a1, a2, a3 = frame[0, 0], frame[0, 1], frame[0, 2], frame[0, 3]
    b0, b1, b2, b3 = frame[1, 0], frame[1, 1], frame[1, 2], frame[1, 3]
    c0, c1, c2, c3 = frame[2, 0], frame[2, 1], frame[2, 2], frame[2, 3]
    zero, nowhere, low = np.float32(0.0), np.int32(-1), np.int32(BRICK_SIDE - 1)
    top_a = np.float32(shape[0] * BRICK_SIDE)
    top_b = np.float32(shape[1] * BRICK_SIDE)
    top_c = np.float32(shape[2] * BRICK_SIDE)
    n_b, n_c = np.int32(shape[1]), np.int32(shape[2])
    side = np.int32(BRICK_SIDE)
    count = min(BLOCK_POINTS, x.size - start)
    for i in range(count):
        px, py, pz = x[start + i], y[start + i], z[start + i]
        a = a0 * px + a1 * py + a2 * pz - a3
        b = b0 * px + b1 * py + b2 * pz - b3
        c = c0 * px + c1 * py + c2 * pz - c3
        within = (a >= zero) & (a < top_a) & (b >= zero) & (b < top_b)
        within = within & (c >= zero) & (c < top_c)
        p = np.int32(a if within else zero)
        q = np.int32(b if within else zero)
        r = np.int32(c if within else zero)
        # A side of eight: whole bricks are three bits further up.
        place = ((p >> np.int32(3)) * n_b + (q >> np.int32(3))) * n_c + (r >> np.int32(3))
        brick[i] = place if within else nowhere
        voxel[i] = ((p & low) * side + (q & low)) * side + (r & low)
    return count


@compiled
def touch_bricks(
    points: BlockedPoints, frame: NDArray[np.float32], touched: NDArray[np.uint8]
) -> None:
    """Mark the bricks that have points.

    Args:
        points: (n,) offsets in blocks.
        frame: (3, 4) voxel of a point: `frame @ p - frame[:, 3]`.
        touched: (a, b, c) set to 1.
    """
    flat = touched.reshape(touched.size)
    brick = np.empty(BLOCK_POINTS, dtype=np.int32)
    voxel = np.empty(BLOCK_POINTS, dtype=np.int32)
    for start in range(0, points.x.size, BLOCK_POINTS):
        count = _place_block(points, start, frame, touched.shape, brick, voxel)
        for i in range(count):
            if brick[i] >= 0:
                flat[brick[i]] = 1


@compiled
def count_voxels(
    points: BlockedPoints,
    claims: NDArray[np.int8],
    frame: NDArray[np.float32],
    bricks: NDArray[np.int32],
    counts: NDArray[np.int32],
) -> None:
    """Count unclaimed points per voxel.

    Args:
        points: (n,) offsets in blocks.
        claims: (n,) plane of each point, negative for none.
        frame: (3, 4) voxel of a point.
        bricks: (a, b, c) number of each brick, -1 without points.
        counts: (bricks, BRICK_SIDE ** 3) points; added to.
    """
    flat = bricks.reshape(bricks.size)
    brick = np.empty(BLOCK_POINTS, dtype=np.int32)
    voxel = np.empty(BLOCK_POINTS, dtype=np.int32)
    for start in range(0, points.x.size, BLOCK_POINTS):
        count = _place_block(points, start, frame, bricks.shape, brick, voxel)
        for i in range(count):
            if claims[start + i] < 0 and brick[i] >= 0:
                counts[flat[brick[i]], voxel[i]] += 1


@compiled
def _taken(
    image: NDArray[np.int32],
    along: NDArray[np.float32],
    height: NDArray[np.float32],
    weight: NDArray[np.int32],
) -> int:
    """List the cells of an image that hold votes, from its middle, clear it, and count them."""
    n_rows, n_columns = image.shape
    count = 0
    for row in range(n_rows):
        for column in range(n_columns):
            if image[row, column] != 0:
                along[count] = column + 0.5 - 0.5 * n_columns
                height[count] = row + 0.5 - 0.5 * n_rows
                weight[count] = image[row, column]
                image[row, column] = 0
                count += 1
    return count


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
    direction, height), and the occupied cells of the image vote: as exact as voting one by one
    up to one more rounding to cells, and many times faster, because a wall's voxels share cells.

    Args:
        places: (3, m) e1, e2 and height, metres from the middle of the box.
        weights: (m,) votes of each; negative ones take votes back.
        angles: (d, 2) omega and phi of each direction, those with one omega together; radians.
        starts: (o + 1,) where the directions of each omega start.
        image: (rows, columns) scratch, zeros; its middle is the middle of the box.
        bin_m: side of a cell of the image, width of a bin.
        votes: (d, bins) added to; the middle edge is distance zero.
    """
    n_rows, n_columns = image.shape
    n_bins = votes.shape[1]
    along = np.empty(image.size, dtype=np.float32)
    height = np.empty(image.size, dtype=np.float32)
    weight = np.empty(image.size, dtype=np.int32)
    for turn in range(starts.size - 1):
        if starts[turn] == starts[turn + 1]:
            continue
        cosine = math.cos(angles[starts[turn], 0]) / bin_m
        sine = math.sin(angles[starts[turn], 0]) / bin_m
        for i in range(places.shape[1]):
            column = int(cosine * places[0, i] + sine * places[1, i] + 0.5 * n_columns)
            row = int(places[2, i] / bin_m + 0.5 * n_rows)
            if 0 <= column < n_columns and 0 <= row < n_rows:
                image[row, column] += weights[i]
        count = _taken(image, along, height, weight)
        for d in range(starts[turn], starts[turn + 1]):
            level, rise = np.float32(math.cos(angles[d, 1])), np.float32(math.sin(angles[d, 1]))
            middle = np.float32(0.5 * n_bins)
            for i in range(count):
                place = int(level * along[i] + rise * height[i] + middle)
                if 0 <= place < n_bins:
                    votes[d, place] += weight[i]


@compiled
def best_bins(
    votes: NDArray[np.int32],
    half: int,
    barred: NDArray[np.uint8],
    scores: NDArray[np.int64],
    places: NDArray[np.int64],
) -> None:
    """Find in each row the window whose votes stand out most from the emptier window beside it.

    Args:
        votes: (d, bins).
        half: a window has 2 half + 1 bins; the windows beside begin one bin further off.
        barred: (d, bins) 1 where no window may have its middle.
        scores: (d,) set.
        places: (d,) set to the middle bin.
    """
    n_bins = votes.shape[1]
    width = 2 * half + 1
    gap = width + 1
    running = np.zeros(n_bins + 2 * (half + gap) + 1, dtype=np.int64)
    for d in range(votes.shape[0]):
        for k in range(running.size - 1):
            place = k - half - gap
            inside = votes[d, place] if 0 <= place < n_bins else 0
            running[k + 1] = running[k] + inside
        scores[d], places[d] = -1, 0
        for place in range(n_bins):
            if barred[d, place]:
                continue
            start = place + gap
            here = running[start + width] - running[start]
            before = running[start + width - gap] - running[start - gap]
            after = running[start + width + gap] - running[start + gap]
            score = here - min(before, after)
            if score > scores[d]:
                scores[d], places[d] = score, place


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
    for t in range(slopes.shape[0]):
        for i in range(places.shape[1]):
            height = places[2, i] - slopes[t, 0] * places[0, i] - slopes[t, 1] * places[1, i]
            place = (height - low_m) / bin_m
            if 0.0 <= place < n_bins:
                votes[t, int(place)] += weights[i]
