"""Kernels for points: blocks, slabs, the robust fit of a plane, and histograms of distances.

Kernels read float32 offsets from three contiguous arrays, which are divided into blocks of
`BLOCK_POINTS` points. Each block has a bounding box. Work is divided into one part per thread, and
each part has its own tables. All sums over parts are sums of integers (distances are multiples of a
fixed step), so results are identical for any number of threads.

A slab is a row of 12 float64: normal (3) and offset of the plane, for offsets from the cloud's
origin; axis u (3) in the plane, and its origin; axis v (3), and its origin. The bounds of a slab
are a row of 5: maximum distance of points from the plane, smallest and largest u, smallest and
largest v. The points of a block are compared only with the slabs that intersect its box, usually
one or two, so sixteen planes take little more time than one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part
from orthoflow.geometry.slabs import Offsets
from orthoflow.geometry.threads import even_parts, in_threads

# Number of points per block. It is so small that a block is usually a short piece of a single
# surface, whose box excludes most planes, and so large that the boxes of 48 million points fit into
# the processor's cache.
BLOCK_POINTS: Final = 256
# Distances are summed in steps of the fit tolerance divided by this number (half a micrometre for
# 15 mm). The sum of the squares of 48 million distances still fits into 64 bits.
STEPS_PER_TOLERANCE: Final = 32768
# Number of bins in the histogram of the deviations of points from their plane.
HISTOGRAM_BINS: Final = 200


def each_part(n_items: int, parts: int, task: Callable[[int, slice], None]) -> None:
    """Divide a range at multiples of `BLOCK_POINTS`, and run a task on each part in a thread.

    Args:
        n_items: length of the range.
        parts: number of parts; some may be empty.
        task: function called with the index of the part and its slice of the range.
    """
    pieces = even_parts(n_items, parts, multiple=BLOCK_POINTS)
    in_threads([partial(task, part, piece) for part, piece in enumerate(pieces)])


class BlockedPoints(NamedTuple):
    """Points in the form that kernels need.

    Attributes:
        x: (n,) float32 metres from the cloud's origin.
        y: (n,) float32 metres from the cloud's origin.
        z: (n,) float32 metres from the cloud's origin.
        boxes: (blocks, 6) float32 bounds of the x, y and z coordinates in each block.
    """

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    z: NDArray[np.float32]
    boxes: NDArray[np.float32]


def piece_of(points: BlockedPoints, piece: slice) -> BlockedPoints:
    """Return a slice of the points that starts at a block."""
    blocks = slice(piece.start // BLOCK_POINTS, -(-piece.stop // BLOCK_POINTS))
    return BlockedPoints(points.x[piece], points.y[piece], points.z[piece], points.boxes[blocks])


def in_blocks(offsets: Offsets, *, parts: int) -> BlockedPoints:
    """Return points in blocks; NaN and infinite values also appear in the box of their block."""
    boxes = np.empty((-(-len(offsets.x) // BLOCK_POINTS), 6), dtype=np.float32)
    points = BlockedPoints(*offsets, boxes)

    def enclose(_part: int, piece: slice) -> None:
        own = piece_of(points, piece)
        starts = np.arange(0, len(own.x), BLOCK_POINTS)
        if len(starts):
            for axis in range(3):
                np.minimum.reduceat(own[axis], starts, out=own.boxes[:, 2 * axis])
                np.maximum.reduceat(own[axis], starts, out=own.boxes[:, 2 * axis + 1])

    each_part(len(offsets.x), parts, enclose)
    return points


@kernel_part
def _meet(box: NDArray[np.float32], slab: NDArray[np.float64], bounds: NDArray[np.float64]) -> int:
    """Return 0 if a slab and a box are disjoint, 2 if the slab contains the box, otherwise 1."""
    verdict = 2
    for row in range(3):
        centre, half = -slab[4 * row + 3], 0.0
        for axis in range(3):
            low, high = np.float64(box[2 * axis]), np.float64(box[2 * axis + 1])
            centre += slab[4 * row + axis] * 0.5 * (low + high)
            half += abs(slab[4 * row + axis]) * 0.5 * (high - low)
        least = -bounds[0] if row == 0 else bounds[2 * row - 1]
        most = bounds[0] if row == 0 else bounds[2 * row]
        if centre + half < least or centre - half > most:
            return 0
        if centre - half < least or centre + half > most:
            verdict = 1
    return verdict


@kernel_part
def _list_active(
    box: NDArray[np.float32],
    slabs: NDArray[np.float64],
    bounds: NDArray[np.float64],
    active: NDArray[np.int64],
) -> tuple[int, int]:
    """List the slabs that intersect the box of a block; return their number and the holder.

    The holder is the only intersecting slab if it contains the entire block, otherwise -1.
    """
    n_active, last = 0, 0
    for k in range(slabs.shape[0]):
        verdict = _meet(box, slabs[k], bounds[k])
        if verdict > 0:
            active[n_active] = k
            n_active += 1
            last = verdict
    return n_active, int(active[0]) if n_active == 1 and last == 2 else -1


@kernel_part
def _measure_block(
    points: BlockedPoints, start: int, slab: NDArray[np.float64], distances: NDArray[np.float64]
) -> int:
    """Set the distances of a block's points from the plane of a slab; return their number.

    This is a separate function, so that the compiler can vectorise the loop.
    """
    stop = min(start + BLOCK_POINTS, points.x.size)
    xs, ys, zs = points.x[start:stop], points.y[start:stop], points.z[start:stop]
    n0, n1, n2, n3 = slab[0], slab[1], slab[2], slab[3]
    for i in range(xs.size):
        distances[i] = n0 * xs[i] + n1 * ys[i] + n2 * zs[i] - n3
    return xs.size


@kernel_part
def _own_block(  # noqa: PLR0913, PLR0917 - compiled code has no objects to bundle these in
    points: BlockedPoints,
    start: int,
    slabs: NDArray[np.float64],
    bounds: NDArray[np.float64],
    active: NDArray[np.int64],
    owner: NDArray[np.int32],
    nearest: NDArray[np.float64],
    distances: NDArray[np.float64],
) -> int:
    """Find the nearest slab that contains each point of a block (-1 if none), and the distances.

    The function returns the number of points.
    """
    stop = min(start + BLOCK_POINTS, points.x.size)
    xs, ys, zs = points.x[start:stop], points.y[start:stop], points.z[start:stop]
    owner[:] = -1
    nearest[:] = np.inf
    for k in active:
        slab = slabs[k]
        _measure_block(points, start, slab, distances)
        for i in range(xs.size):
            here = distances[i]
            if abs(here) > bounds[k, 0] or abs(here) >= abs(nearest[i]):
                continue
            x, y, z = np.float64(xs[i]), np.float64(ys[i]), np.float64(zs[i])
            u = slab[4] * x + slab[5] * y + slab[6] * z - slab[7]
            v = slab[8] * x + slab[9] * y + slab[10] * z - slab[11]
            if bounds[k, 1] <= u <= bounds[k, 2] and bounds[k, 3] <= v <= bounds[k, 4]:
                owner[i] = k
                nearest[i] = here
    return xs.size


@kernel_part
def _find_cells(
    points: BlockedPoints,
    start: int,
    slab: NDArray[np.float64],
    raster: NDArray[np.float64],
    slab_index: np.int32,
    owner: NDArray[np.int32],
    cells: NDArray[np.int32],
) -> None:
    """Set the cells, in the tables, of the points of a block that belong to a slab.

    The loop has no branches, so that the compiler can vectorise it.
    """
    stop = min(start + BLOCK_POINTS, points.x.size)
    xs, ys, zs = points.x[start:stop], points.y[start:stop], points.z[start:stop]
    per_m, width, first = raster[2], np.int32(raster[4]), np.int32(raster[5])
    u0, u1, u2, u3 = slab[4] * per_m, slab[5] * per_m, slab[6] * per_m, slab[7] * per_m
    v0, v1, v2, v3 = slab[8] * per_m, slab[9] * per_m, slab[10] * per_m, slab[11] * per_m
    u3 += raster[0] * per_m
    v3 += raster[1] * per_m
    last_row, last_column, zero = raster[3] - 1.0, raster[4] - 1.0, 0.0
    for i in range(xs.size):
        column = min(max(u0 * xs[i] + u1 * ys[i] + u2 * zs[i] - u3, zero), last_column)
        row = min(max(v0 * xs[i] + v1 * ys[i] + v2 * zs[i] - v3, zero), last_row)
        cell = first + np.int32(row) * width + np.int32(column)
        cells[i] = cell if owner[i] == slab_index else cells[i]


@kernel_part
def _sum_runs(
    cells: NDArray[np.int32],
    distances: NDArray[np.float64],
    fit_tolerance_m: float,
    inner_tolerance_m: float,
    counts: NDArray[np.int32],
    sums: NDArray[np.int64],
) -> None:
    """Add points to their cells (-1 for none), summing runs of points in the same cell first."""
    per_step = STEPS_PER_TOLERANCE / fit_tolerance_m
    n_find = n_inner = n_fit = total = squares = 0
    for i in range(cells.size):
        cell = cells[i]
        if cell >= 0:
            away_m = abs(distances[i])
            n_find += 1
            n_inner += int(away_m <= inner_tolerance_m)
            if away_m <= fit_tolerance_m:
                steps = math.floor(distances[i] * per_step + 0.5)
                n_fit += 1
                total += steps
                squares += steps * steps
        if i + 1 == cells.size or cells[i + 1] != cell:
            if cell >= 0:
                counts[cell, 0] += n_find
                counts[cell, 1] += n_inner
                counts[cell, 2] += n_fit
                sums[cell, 0] += total
                sums[cell, 1] += squares
            n_find = n_inner = n_fit = total = squares = 0


@compiled
def assign_points(
    points: BlockedPoints,
    claims: NDArray[np.int8],
    slabs: NDArray[np.float64],
    bounds: NDArray[np.float64],
) -> None:
    """Assign each point to the nearest slab that contains it, or the first of equally near ones.

    Args:
        points: (n,) offsets in blocks.
        claims: (n,) output, slab of each point; -1 for points in no slab.
        slabs: (k, 12) see the module's docstring.
        bounds: (k, 5) see the module's docstring.
    """
    listed = np.empty(slabs.shape[0], dtype=np.int64)
    owner = np.empty(BLOCK_POINTS, dtype=np.int32)
    nearest, distances = np.empty(BLOCK_POINTS), np.empty(BLOCK_POINTS)
    for block in range(points.boxes.shape[0]):
        n_active, holder = _list_active(points.boxes[block], slabs, bounds, listed)
        start = block * BLOCK_POINTS
        taken = claims[start : min(start + BLOCK_POINTS, claims.size)]
        if n_active == 0 or holder >= 0:
            # Most blocks are short pieces of a wall inside a single slab, so their points need not
            # be tested.
            taken[:] = np.int8(holder)
            continue
        _own_block(points, start, slabs, bounds, listed[:n_active], owner, nearest, distances)
        for i in range(taken.size):
            taken[i] = np.int8(owner[i])


@compiled
def sum_assigned(
    points: BlockedPoints,
    slabs: NDArray[np.float64],
    bounds: NDArray[np.float64],
    rasters: NDArray[np.float64],
    drawn: NDArray[np.bool_],
    counts: NDArray[np.int32],
    sums: NDArray[np.int64],
) -> None:
    """Sum the distances of points from the nearest slab that contains them, in each of its cells.

    Args:
        points: (n,) offsets in blocks.
        slabs: (k, 12) see the module's docstring.
        bounds: (k, 5) see the module's docstring.
        rasters: (k, 8) smallest u, smallest v, cells per metre, number of rows, number of columns,
            first cell in the tables, fit tolerance and inner tolerance; the tolerances are the same
            for all slabs. Points in slabs without rows are not summed.
        drawn: (blocks,) True for blocks whose points are summed.
        counts: (cells, 3) numbers of points within the slab, within the inner tolerance, and within
            the fit tolerance; updated.
        sums: (cells, 2) sums of distances and squared distances, in steps, of points within the fit
            tolerance; updated.
    """
    listed = np.empty(slabs.shape[0], dtype=np.int64)
    owner = np.empty(BLOCK_POINTS, dtype=np.int32)
    cells = np.empty(BLOCK_POINTS, dtype=np.int32)
    nearest, distances = np.empty(BLOCK_POINTS), np.empty(BLOCK_POINTS)
    for block in range(points.boxes.shape[0]):
        if not drawn[block]:
            continue
        n_active, holder = _list_active(points.boxes[block], slabs, bounds, listed)
        n_summed, start = 0, block * BLOCK_POINTS
        for k in listed[:n_active]:
            n_summed += int(rasters[k, 3] > 0.0)
        if n_summed == 0:
            continue
        active = listed[:n_active]
        if holder >= 0:
            count = _measure_block(points, start, slabs[holder], nearest)
            owner[:] = holder
        else:
            count = _own_block(points, start, slabs, bounds, active, owner, nearest, distances)
        cells[:] = -1
        for k in active:
            if rasters[k, 3] > 0.0:
                _find_cells(points, start, slabs[k], rasters[k], np.int32(k), owner, cells)
        _sum_runs(
            cells[:count], nearest, rasters[active[0], 6], rasters[active[0], 7], counts, sums
        )


@compiled
def measure_deviations(
    points: BlockedPoints,
    claims: NDArray[np.int8],
    slabs: NDArray[np.float64],
    limits: NDArray[np.float64],
    sums: NDArray[np.int64],
    histogram: NDArray[np.int64],
    extents: NDArray[np.float64],
) -> None:
    """Compute sums and histograms of the points' distances from their planes, and their extents.

    Args:
        points: (n,) offsets in blocks.
        claims: (n,) plane of each point; negative for points on no plane.
        slabs: (k, 12) the planes.
        limits: (k, 6) tolerance for labelling, fit tolerance, and smallest u, largest u, smallest v
            and largest v of the plane's rectangle; metres.
        sums: (k, 6) number, sum of steps and sum of squared steps of points within the tolerance
            for labelling, then the same within the fit tolerance; updated.
        histogram: (k, HISTOGRAM_BINS) number of points in bins between minus and plus the tolerance
            for labelling; updated.
        extents: (k, 4) smallest u, largest u, smallest v and largest v of the points inside the fit
            tolerance and the rectangle; updated.
    """
    half = 0.5 * HISTOGRAM_BINS
    for i in range(claims.size):
        k = claims[i]
        if k < 0:
            continue
        x, y, z = np.float64(points.x[i]), np.float64(points.y[i]), np.float64(points.z[i])
        distance = slabs[k, 0] * x + slabs[k, 1] * y + slabs[k, 2] * z - slabs[k, 3]
        place = min(max(distance / limits[k, 0] * half + half, 0.0), HISTOGRAM_BINS - 1.0)
        histogram[k, int(place)] += 1
        steps = math.floor(distance * (STEPS_PER_TOLERANCE / limits[k, 1]) + 0.5)
        sums[k, 0] += 1
        sums[k, 1] += steps
        sums[k, 2] += steps * steps
        if abs(distance) > limits[k, 1]:
            continue
        sums[k, 3] += 1
        sums[k, 4] += steps
        sums[k, 5] += steps * steps
        u = slabs[k, 4] * x + slabs[k, 5] * y + slabs[k, 6] * z - slabs[k, 7]
        v = slabs[k, 8] * x + slabs[k, 9] * y + slabs[k, 10] * z - slabs[k, 11]
        if limits[k, 2] <= u <= limits[k, 3] and limits[k, 4] <= v <= limits[k, 5]:
            extents[k, 0], extents[k, 1] = min(extents[k, 0], u), max(extents[k, 1], u)
            extents[k, 2], extents[k, 3] = min(extents[k, 2], v), max(extents[k, 3], v)


# Constraints on the plane of a fit: none, normal perpendicular to up, and normal along up.
FREE: Final = 0
VERTICAL: Final = 1
LEVEL: Final = 2

_STEPS_MOST: Final = 20
# A fit has converged if it moves no point of the plane within ten metres of the origin by more than
# this share of the tolerance.
_SETTLED_SHARE: Final = 5e-4
# Points whose RMS distance from a line is smaller than this do not determine a rotation about the
# line.
_LINE_WIDTH_M: Final = 1e-4


@compiled
def flattest(sums: NDArray[np.float64], plane: NDArray[np.float64]) -> None:
    """Set `plane` (9,) to the normal, the centroid, and the variances along the principal axes.

    The eigenvalues of the symmetric 3 x 3 matrix are computed in closed form, because LAPACK takes
    a hundred times as long.

    Args:
        sums: (10,) number of points, and sums of the coordinates a, b and c, and of the products
            aa, ab, ac, bb, bc and cc.
        plane: output; variances are ascending.
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
    plane[0], plane[1], plane[2] = 0.0, 0.0, 1.0
    if size < 1e-12:
        plane[6], plane[7], plane[8] = mean, mean, mean
        return
    determinant = (
        da * (db * dc - bc * bc) - ab * (ab * dc - bc * ac) + ac * (ab * bc - db * ac)
    ) / size**3
    angle = math.acos(min(1.0, max(-1.0, 0.5 * determinant))) / 3.0
    most = mean + 2.0 * size * math.cos(angle)
    least = mean + 2.0 * size * math.cos(angle + 2.0 * math.pi / 3.0)
    plane[6], plane[7], plane[8] = max(least, 0.0), 3.0 * mean - most - least, most
    # The normal is perpendicular to the rows of (matrix - least), so use the longest cross product
    # of two rows.
    ra, rb, rc = aa - least, bb - least, cc - least
    longest = 0.0
    for p0, p1, p2 in (
        (ab * bc - ac * rb, ac * ab - ra * bc, ra * rb - ab * ab),
        (ab * rc - ac * bc, ac * ac - ra * rc, ra * bc - ab * ac),
        (rb * rc - bc * bc, bc * ac - ab * rc, ab * bc - rb * ac),
    ):
        length = math.sqrt(p0 * p0 + p1 * p1 + p2 * p2)
        if length > longest:
            longest = length
            plane[0], plane[1], plane[2] = p0 / length, p1 / length, p2 / length


@compiled
def refine_robustly(
    points: NDArray[np.float64], plane: NDArray[np.float64], tolerance_m: float, freedom: int
) -> bool:
    """Move a plane to the densest layer of points near it, by reweighted total least squares.

    Args:
        points: (m, 3) metres; unless the fit is free, the third axis must be up.
        plane: (4,) normal and offset: initial values, updated.
        tolerance_m: points farther away have no weight (Tukey's weights).
        freedom: FREE, VERTICAL or LEVEL.

    Returns:
        Whether the points determine a plane; otherwise, `plane` is undefined.
    """
    sums, fitted = np.empty(10), np.empty(9)
    for _ in range(_STEPS_MOST):
        sums[:] = 0.0
        for i in range(points.shape[0]):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            distance_m = plane[0] * x + plane[1] * y + plane[2] * z - plane[3]
            if abs(distance_m) >= tolerance_m:
                continue
            weight = (1.0 - (distance_m / tolerance_m) ** 2) ** 2
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
        if sums[0] <= 0.0:
            return False
        if freedom == VERTICAL:
            # Modify the moments so that the major axis is up and the normal is horizontal.
            x, y, z = sums[1] / sums[0], sums[2] / sums[0], sums[3] / sums[0]
            sums[6], sums[8] = sums[1] * z, sums[2] * z
            sums[9] += sums[4] - sums[1] * x + sums[7] - sums[2] * y
        flattest(sums, fitted)
        if freedom == LEVEL:
            fitted[0], fitted[1], fitted[2] = 0.0, 0.0, 1.0
        elif fitted[7] < max(_LINE_WIDTH_M**2, 1e-8 * fitted[8]):
            return False
        sign = fitted[0] * plane[0] + fitted[1] * plane[1] + fitted[2] * plane[2]
        sign = -1.0 if sign < 0.0 else 1.0
        turn, offset_m = 0.0, 0.0
        for i in range(3):
            offset_m += sign * fitted[i] * fitted[3 + i]
            turn += (sign * fitted[i] - plane[i]) ** 2
            plane[i] = sign * fitted[i]
        moved_m = abs(offset_m - plane[3])
        plane[3] = offset_m
        if max(10.0 * math.sqrt(turn), moved_m) < _SETTLED_SHARE * tolerance_m:
            break
    return True


@compiled
def bin_distances(
    points: NDArray[np.float32],
    planes: NDArray[np.float32],
    reach_m: float,
    histograms: NDArray[np.int64],
) -> None:
    """Add the points near each of several planes to a histogram of distances.

    Args:
        points: (3, m) metres.
        planes: (h, 4) normal and offset.
        reach_m: maximum distance.
        histograms: (h, bins) number of points in bins between 0 and `reach_m`; updated.
    """
    n_bins = histograms.shape[1]
    per_m, top = np.float32(n_bins / reach_m), np.float32(n_bins)
    places = np.empty(BLOCK_POINTS, dtype=np.int32)
    for h in range(planes.shape[0]):
        a, b, c = planes[h, 0] * per_m, planes[h, 1] * per_m, planes[h, 2] * per_m
        d, own = planes[h, 3] * per_m, histograms[h]
        for start in range(0, points.shape[1], BLOCK_POINTS):
            stop = min(start + BLOCK_POINTS, points.shape[1])
            xs, ys, zs = points[0, start:stop], points[1, start:stop], points[2, start:stop]
            # This is a separate loop, so that the compiler can vectorise it.
            for i in range(xs.size):
                places[i] = np.int32(min(abs(a * xs[i] + b * ys[i] + c * zs[i] - d), top))
            for i in range(xs.size):
                if places[i] < n_bins:
                    own[places[i]] += 1
