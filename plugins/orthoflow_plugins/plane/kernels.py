"""Compiled passes over points: blocks of them, the robust fit of a plane, the scoring of many.

Kernels read float32 offsets as three contiguous arrays, in `BLOCK_POINTS` blocks with a box each.
Work is split into parts, one per thread, each with tables of its own; everything summed across
parts is an integer, so the result has the same bits for any number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part
from orthoflow.geometry.point_kernels import Offsets
from orthoflow.geometry.threads import even_parts, in_threads

# Small enough that a block of a scan column is a short piece of one surface, so that its box tells
# most planes apart; large enough that boxes of 48 million points fit into the processor's cache.
BLOCK_POINTS: Final = 256


def each_part(n_items: int, parts: int, task: Callable[[int, slice], None]) -> None:
    """Cut a range into parts at multiples of `BLOCK_POINTS` and run a task on each, in threads.

    Args:
        n_items: length of the range.
        parts: into how many parts; some may be empty.
        task: gets the number of the part and its piece of the range.
    """
    pieces = even_parts(n_items, parts, multiple=BLOCK_POINTS)
    in_threads([partial(task, part, piece) for part, piece in enumerate(pieces)])


class BlockedPoints(NamedTuple):
    """Points as the passes that skip blocks take them; built by `blocked`.

    Attributes:
        x: (n,) float32 metres from the cloud's origin; y and z alike.
        boxes: (blocks, 6) float32, smallest and largest x, y, z of each block.
    """

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    z: NDArray[np.float32]
    boxes: NDArray[np.float32]


def blocked(offsets: Offsets, boxes: NDArray[np.float32]) -> BlockedPoints:
    """Join points and the boxes of their blocks."""
    return BlockedPoints(offsets.x, offsets.y, offsets.z, boxes)


def piece_of(points: BlockedPoints, piece: slice) -> BlockedPoints:
    """Return a piece of the points that starts at a block."""
    blocks = slice(piece.start // BLOCK_POINTS, -(-piece.stop // BLOCK_POINTS))
    return BlockedPoints(points.x[piece], points.y[piece], points.z[piece], points.boxes[blocks])


@dataclass(frozen=True, kw_only=True)
class PlanGrid:
    """Where the cells of a plan (a map of the cloud seen from above) and its storeys lie.

    Attributes:
        basis: (3, 3) rows e1, e2, up (see `geometry.directions.basis_from_up`).
        low_m: (3,) lower corner in the (e1, e2, up) frame of the cloud's offsets, metres.
        cell_m: side of a cell, and height of a storey of the height histogram.
        shape: cells along e1, cells along e2, storeys along up.
    """

    basis: NDArray[np.float64]
    low_m: NDArray[np.float64]
    cell_m: float
    shape: tuple[int, int, int]


@dataclass(frozen=True, kw_only=True)
class Boxes:
    """Where the blocks of a cloud lie.

    Attributes:
        boxes: (blocks, 6) float32, smallest and largest x, y, z offsets of each block.
        n_unusable: sides of boxes that are NaN or infinite.
    """

    boxes: NDArray[np.float32]
    n_unusable: int


@dataclass(frozen=True, kw_only=True)
class PlanCounts:
    """How the points of a cloud spread over a plan.

    Attributes:
        cells: (cells along e1, cells along e2) int64, points per cell.
        heights: (storeys,) int64, points per storey of those that lie over the plan.
        boxed: where the blocks lie.
    """

    cells: NDArray[np.int64]
    heights: NDArray[np.int64]
    boxed: Boxes


def box_blocks(offsets: Offsets, *, parts: int) -> Boxes:
    """Find the box of each block of points, in one pass."""
    n_points = len(offsets.x)
    boxes = np.empty((-(-n_points // BLOCK_POINTS), 6), dtype=np.float32)
    unusable = np.zeros(parts, dtype=np.int64)

    def find(part: int, piece: slice) -> None:
        points = piece_of(blocked(offsets, boxes), piece)
        unusable[part] = _set_boxes(points, points.boxes.view(np.int32))

    each_part(n_points, parts, find)
    return Boxes(boxes=boxes, n_unusable=int(unusable.sum()))


def plan_frame(grid: PlanGrid) -> NDArray[np.float32]:
    """(3, 4) that gives the cell along e1, along e2 and the storey of an offset: `f @ p - f3`."""
    frame = np.empty((3, 4), dtype=np.float32)
    frame[:, :3] = grid.basis / grid.cell_m
    frame[:, 3] = grid.low_m / grid.cell_m
    return frame


def count_over_plan(offsets: Offsets, grid: PlanGrid, *, parts: int) -> PlanCounts:
    """Count points per plan cell and per storey, and find the box of each block, in one pass."""
    n_points = len(offsets.x)
    cells = np.zeros((parts, *grid.shape[:2]), dtype=np.int32)
    heights = np.zeros((parts, grid.shape[2]), dtype=np.int32)
    boxes = np.empty((-(-n_points // BLOCK_POINTS), 6), dtype=np.float32)
    unusable = np.zeros(parts, dtype=np.int64)
    frame = plan_frame(grid)

    def count(part: int, piece: slice) -> None:
        points = piece_of(blocked(offsets, boxes), piece)
        sides = points.boxes.view(np.int32)
        unusable[part] = _count_over_plan(points, sides, frame, cells[part], heights[part])

    each_part(n_points, parts, count)
    return PlanCounts(
        cells=cells.sum(axis=0, dtype=np.int64),
        heights=heights.sum(axis=0, dtype=np.int64),
        boxed=Boxes(boxes=boxes, n_unusable=int(unusable.sum())),
    )


@kernel_part
def _set_box(points: BlockedPoints, block: int, sides: NDArray[np.int32]) -> int:
    """Set the box of a block, and give at how many of its sides values are NaN or infinite.

    Bits of floats, those of negative ones turned over, are in the order of their values: whole
    numbers are compared several at once, which floats with their NaN are not. What is not finite
    lies at the ends of that order.

    Args:
        points: (n,) offsets in blocks.
        block: which block.
        sides: (blocks, 6) the boxes as bits.
    """
    start = block * BLOCK_POINTS
    stop = min(start + BLOCK_POINTS, points.x.size)
    turned, sign = np.int32(0x7FFFFFFF), np.int32(31)
    infinite = np.int32(0x7F800000)
    bad = 0
    for axis in range(3):
        bits = (points.x, points.y, points.z)[axis][start:stop].view(np.int32)
        low, high = turned, np.int32(-0x80000000)
        for i in range(bits.size):
            ordered = np.int32(bits[i] ^ ((bits[i] >> sign) & turned))
            low = min(low, ordered)
            high = max(high, ordered)
        bad += int(low < -infinite) + int(high >= infinite)
        sides[block, 2 * axis] = low ^ ((low >> sign) & turned)
        sides[block, 2 * axis + 1] = high ^ ((high >> sign) & turned)
    return bad


@compiled
def _set_boxes(points: BlockedPoints, sides: NDArray[np.int32]) -> int:
    """Set the boxes of all blocks, and give at how many sides values are unusable."""
    bad = 0
    for block in range(sides.shape[0]):
        bad += _set_box(points, block, sides)
    return bad


@kernel_part
def _place_block(
    points: BlockedPoints,
    block: int,
    frame: NDArray[np.float32],
    shape: tuple[int, int],
    n_storeys: int,
    cell: NDArray[np.int32],
    storey: NDArray[np.int32],
) -> None:
    """Set cell and storey of a block's points, -1 outside.

    Apart from the counting, and without branches, so that the processor takes several points at
    once: the counts wait for each other, the places need not.
    """
    x, y, z = points.x, points.y, points.z
    a0, a1, a2, a3 = frame[0, 0], frame[0, 1], frame[0, 2], frame[0, 3]
    b0, b1, b2, b3 = frame[1, 0], frame[1, 1], frame[1, 2], frame[1, 3]
    c0, c1, c2, c3 = frame[2, 0], frame[2, 1], frame[2, 2], frame[2, 3]
    zero = np.float32(0.0)
    top_first, top_second = np.float32(shape[0]), np.float32(shape[1])
    top_storey = np.float32(n_storeys)
    width, nowhere = np.int32(shape[1]), np.int32(-1)
    start = block * BLOCK_POINTS
    for i in range(start, min(start + BLOCK_POINTS, x.size)):
        first = a0 * x[i] + a1 * y[i] + a2 * z[i] - a3
        second = b0 * x[i] + b1 * y[i] + b2 * z[i] - b3
        height = c0 * x[i] + c1 * y[i] + c2 * z[i] - c3
        over = (first >= zero) & (first < top_first) & (second >= zero) & (second < top_second)
        within = over & (height >= zero) & (height < top_storey)
        row = np.int32(first if over else zero)
        column = np.int32(second if over else zero)
        level = np.int32(height if within else zero)
        cell[i - start] = row * width + column if over else nowhere
        storey[i - start] = level if within else nowhere


@kernel_part
def _add_runs(places: NDArray[np.int32], count: int, table: NDArray[np.int32]) -> None:
    """Count places into a table, none of them negative; a scan's neighbours share one."""
    first, place = 0, places[0]
    for i in range(1, count):
        if places[i] != place:
            if place >= 0:
                table[place] += i - first
            first, place = i, places[i]
    if place >= 0:
        table[place] += count - first


@compiled
def _count_over_plan(
    points: BlockedPoints,
    sides: NDArray[np.int32],
    frame: NDArray[np.float32],
    cells: NDArray[np.int32],
    heights: NDArray[np.int32],
) -> int:
    """Add to cells and heights, set the boxes, and give at how many sides values are unusable."""
    flat = cells.reshape(cells.size)
    cell = np.empty(BLOCK_POINTS, dtype=np.int32)
    storey = np.empty(BLOCK_POINTS, dtype=np.int32)
    bad = 0
    for block in range(sides.shape[0]):
        start = block * BLOCK_POINTS
        stop = min(start + BLOCK_POINTS, points.x.size)
        bad += _set_box(points, block, sides)
        _place_block(points, block, frame, cells.shape, heights.size, cell, storey)
        _add_runs(cell, stop - start, flat)
        _add_runs(storey, stop - start, heights)
    return bad


# What a fit may change: everything, a normal kept across up, or one kept along up.
FREE: Final = 0
VERTICAL: Final = 1
LEVEL: Final = 2

_STEPS_MOST: Final = 20
# Points within so many tolerances of a plane are kept while it is fitted to some of them.
_REACH: Final = 2.0
# A fit has settled when a point ten metres away moves by less than this share of the tolerance.
_SETTLED_SHARE: Final = 5e-4
# Points nearer to a line than this (root mean square) do not say how the plane lies about it.
_LINE_WIDTH_M: Final = 1e-4


@compiled
def flattest(sums: NDArray[np.float64], plane: NDArray[np.float64]) -> None:
    """Set (9,) plane to normal, middle, and the variances along the three principal axes.

    The eigenvalues of a symmetric 3 x 3 matrix in closed form, because the library's solver takes
    a hundred times as long for so small a one.

    Args:
        sums: (10,) number of points, sums of a, b, c, and of aa, ab, ac, bb, bc, cc.
        plane: set; variances ascend.
    """
    n = sums[0]
    ma, mb, mc = sums[1] / n, sums[2] / n, sums[3] / n
    aa, ab, ac = sums[4] / n - ma * ma, sums[5] / n - ma * mb, sums[6] / n - ma * mc
    bb, bc, cc = sums[7] / n - mb * mb, sums[8] / n - mb * mc, sums[9] / n - mc * mc
    mean = (aa + bb + cc) / 3.0
    da, db, dc = aa - mean, bb - mean, cc - mean
    off = ab * ab + ac * ac + bc * bc
    size = math.sqrt((da * da + db * db + dc * dc + 2.0 * off) / 6.0)
    plane[3], plane[4], plane[5] = ma, mb, mc
    if size < 1e-12:
        plane[0], plane[1], plane[2] = 0.0, 0.0, 1.0
        plane[6], plane[7], plane[8] = mean, mean, mean
        return
    determinant = (
        da * (db * dc - bc * bc) - ab * (ab * dc - bc * ac) + ac * (ab * bc - db * ac)
    ) / size**3
    angle = math.acos(min(1.0, max(-1.0, 0.5 * determinant))) / 3.0
    most = mean + 2.0 * size * math.cos(angle)
    least = mean + 2.0 * size * math.cos(angle + 2.0 * math.pi / 3.0)
    plane[6], plane[7], plane[8] = max(least, 0.0), 3.0 * mean - most - least, most
    # Rows of (matrix - least) are across the normal: the longest cross product of two is the best.
    ra, rb, rc = aa - least, bb - least, cc - least
    u0, u1, u2 = ab * bc - ac * rb, ac * ab - ra * bc, ra * rb - ab * ab
    v0, v1, v2 = ab * rc - ac * bc, ac * ac - ra * rc, ra * bc - ab * ac
    w0, w1, w2 = rb * rc - bc * bc, bc * ac - ab * rc, ab * bc - rb * ac
    u, v, w = u0 * u0 + u1 * u1 + u2 * u2, v0 * v0 + v1 * v1 + v2 * v2, w0 * w0 + w1 * w1 + w2 * w2
    if v > u:
        u, u0, u1, u2 = v, v0, v1, v2
    if w > u:
        u, u0, u1, u2 = w, w0, w1, w2
    length = math.sqrt(u)
    if length > 0.0:
        plane[0], plane[1], plane[2] = u0 / length, u1 / length, u2 / length
    else:
        plane[0], plane[1], plane[2] = 0.0, 0.0, 1.0


@kernel_part
def robust_moments(
    points: NDArray[np.float64], plane: NDArray[np.float64], tolerance_m: float
) -> NDArray[np.float64]:
    """Weighted sums of the points near a plane, Tukey's weights with a cut at the tolerance.

    Args:
        points: (m, 3) offsets, metres.
        plane: (4,) normal and offset.
        tolerance_m: distance at which a point's weight has fallen to zero.

    Returns:
        (10,) sum of weights, of w x, w y, w z, and of w times xx, xy, xz, yy, yz, zz.
    """
    sums = np.zeros(10)
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        distance_m = plane[0] * x + plane[1] * y + plane[2] * z - plane[3]
        if abs(distance_m) >= tolerance_m:
            continue
        ratio = distance_m / tolerance_m
        weight = (1.0 - ratio * ratio) ** 2
        sums[0] += weight
        sums[1] += weight * x
        sums[2] += weight * y
        sums[3] += weight * z
        sums[4] += weight * x * x
        sums[5] += weight * x * y
        sums[6] += weight * x * z
        sums[7] += weight * y * y
        sums[8] += weight * y * z
        sums[9] += weight * z * z
    return sums


@kernel_part
def _nearby(
    points: NDArray[np.float64], plane: NDArray[np.float64], reach_m: float
) -> NDArray[np.float64]:
    """(k, 3) the points within reach of a plane, in their order."""
    near = np.empty_like(points)
    count = 0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        near[count, 0], near[count, 1], near[count, 2] = x, y, z
        distance_m = plane[0] * x + plane[1] * y + plane[2] * z - plane[3]
        # Without a branch: which points are near cannot be foretold.
        count += 1 if abs(distance_m) < reach_m else 0
    return near[:count]


@kernel_part
def _furthest_m(points: NDArray[np.float64]) -> float:
    """The largest distance of a point from the origin."""
    largest = 0.0
    for i in range(points.shape[0]):
        largest = max(largest, points[i, 0] ** 2 + points[i, 1] ** 2 + points[i, 2] ** 2)
    return float(np.sqrt(largest))


@kernel_part
def _without_rise(sums: NDArray[np.float64], up: NDArray[np.float64]) -> None:
    """Replace moments by those that have up as their widest direction, so that no normal leans."""
    mean, second, across = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    order = ((4, 5, 6), (5, 7, 8), (6, 8, 9))
    for i in range(3):
        mean[i] = sums[1 + i] / sums[0]
    trace = 0.0
    for i in range(3):
        for j in range(3):
            second[i, j] = sums[order[i][j]] / sums[0] - mean[i] * mean[j]
            across[i, j] = (1.0 if i == j else 0.0) - up[i] * up[j]
        trace += second[i, i]
    for i in range(3):
        for j in range(i, 3):
            total = up[i] * up[j] * trace
            for k in range(3):
                for m in range(3):
                    total += across[i, k] * second[k, m] * across[m, j]
            sums[order[i][j]] = total + mean[i] * mean[j]
    sums[0] = 1.0
    for i in range(3):
        sums[1 + i] = mean[i]


@compiled
def refine_robustly(
    points: NDArray[np.float64],
    plane: NDArray[np.float64],
    tolerance_m: float,
    freedom: int,
    up: NDArray[np.float64],
) -> bool:
    """Move a plane to the densest layer of points near it: total least squares, reweighted.

    Args:
        points: (m, 3) offsets, metres.
        plane: (4,) normal and offset to start from; changed.
        tolerance_m: points further away have no weight (Tukey's weights).
        freedom: FREE, VERTICAL or LEVEL.
        up: (3,) unit vector.

    Returns:
        Whether more than a line of points supports it; if not, the plane means nothing.
    """
    fitted = np.empty(9)
    furthest_m = _furthest_m(points)
    # Only points near the plane matter, and mostly it moves little: those near it are asked again
    # only when it may have come within the tolerance of others.
    near, asked, reach_m = points, plane.copy(), np.inf
    for step in range(_STEPS_MOST):
        turned = np.sqrt(
            (plane[0] - asked[0]) ** 2 + (plane[1] - asked[1]) ** 2 + (plane[2] - asked[2]) ** 2
        )
        may_have_moved_m = turned * furthest_m + abs(plane[3] - asked[3])
        if step == 1 or may_have_moved_m + tolerance_m > reach_m:
            reach_m = _REACH * tolerance_m
            near, asked = _nearby(points, plane, reach_m), plane.copy()
        sums = robust_moments(near, plane, tolerance_m)
        if sums[0] <= 0.0:
            return False
        if freedom == VERTICAL:
            _without_rise(sums, up)
        if freedom == LEVEL:
            fitted[0], fitted[1], fitted[2] = up[0], up[1], up[2]
        else:
            flattest(sums, fitted)
            if fitted[7] < max(_LINE_WIDTH_M**2, 1e-8 * fitted[8]):
                return False
        turn, offset_m, sign = 0.0, 0.0, 0.0
        for i in range(3):
            sign += fitted[i] * plane[i]
        sign = -1.0 if sign < 0.0 else 1.0
        for i in range(3):
            offset_m += sign * fitted[i] * sums[1 + i] / sums[0]
            turn += (sign * fitted[i] - plane[i]) ** 2
            plane[i] = sign * fitted[i]
        moved_m = abs(offset_m - plane[3])
        plane[3] = offset_m
        if max(10.0 * np.sqrt(turn), moved_m) < _SETTLED_SHARE * tolerance_m:
            break
    return True


@compiled
def consensus_sums(
    points: NDArray[np.float32],
    planes: NDArray[np.float32],
    reach_m: float,
    n_bins: int,
    sums: NDArray[np.int64],
) -> None:
    """Count the points near each of many planes, and how near they are, in bins of distance.

    Args:
        points: (3, m) metres.
        planes: (h, 4) normal and offset.
        reach_m: distances up to here are counted.
        n_bins: bins of 0..reach.
        sums: (h, 2) added to: points within reach, and 4 n^2 - (2 b + 1)^2 of the bin b of each,
            which is 4 n^2 (1 - d^2) with the distance d of its middle as a share of the reach.
    """
    per_m, top = np.float32(n_bins / reach_m), np.float32(n_bins)
    most, one = np.int32(4 * n_bins * n_bins), np.int32(1)
    last, nothing = np.int32(n_bins), np.int32(0)
    for h in range(planes.shape[0]):
        a, b, c = planes[h, 0] * per_m, planes[h, 1] * per_m, planes[h, 2] * per_m
        d = planes[h, 3] * per_m
        for start in range(0, points.shape[1], BLOCK_POINTS):
            stop = min(start + BLOCK_POINTS, points.shape[1])
            xs, ys, zs = points[0, start:stop], points[1, start:stop], points[2, start:stop]
            # Whole numbers of 32 bits, so that the processor takes several points at once.
            count, worth = nothing, nothing
            for i in range(xs.size):
                place = np.int32(min(abs(a * xs[i] + b * ys[i] + c * zs[i] - d), top))
                is_near = place < last
                middle = np.int32(place + place + one)
                count = np.int32(count + (one if is_near else nothing))
                here = np.int32(most - np.int32(middle * middle))
                worth = np.int32(worth + (here if is_near else nothing))
            sums[h, 0] += count
            sums[h, 1] += worth


@compiled
def distance_histograms(
    points: NDArray[np.float32],
    planes: NDArray[np.float32],
    reach_m: float,
    histograms: NDArray[np.int32],
) -> None:
    """Bin the distances of points to each of many planes.

    The running sum of a row is the number of points within any smaller tolerance.

    Args:
        points: (3, m) metres.
        planes: (h, 4) normal and offset.
        reach_m: distances up to here are counted.
        histograms: (h, bins) points per bin of 0..reach; added to.
    """
    n_bins = histograms.shape[1]
    per_m, top = np.float32(n_bins / reach_m), np.float32(n_bins)
    xs, ys, zs = points[0], points[1], points[2]
    bins = np.empty(points.shape[1], dtype=np.int32)
    for h in range(planes.shape[0]):
        a, b, c = planes[h, 0] * per_m, planes[h, 1] * per_m, planes[h, 2] * per_m
        d = planes[h, 3] * per_m
        # Apart from the counting, so that the processor takes several points at once.
        for i in range(bins.size):
            bins[i] = np.int32(min(abs(a * xs[i] + b * ys[i] + c * zs[i] - d), top))
        for i in range(bins.size):
            if bins[i] < n_bins:
                histograms[h, bins[i]] += 1
