"""Kernels of the detectors: voxels and their normals, votes for hypotheses, and cells of surfaces.

A surface of revolution is a row of 13 numbers: point of the axis (3), axis (3), the direction of
angle 0 (3), radius at the point, change of the radius along the axis, 1 / sqrt(1 + change^2), and
1, or 0 for a sphere, whose point is the centre, and whose radius is that of the sphere.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part
from orthoflow.geometry.slabs import Offsets

# Number of entries of a row of moments: n, sums of x, y, z, and of xx, xy, xz, yy, yz, zz.
MOMENTS: Final = 10
# Number of points of a block of `sum_cells`.
_BLOCK: Final = 128
# Resolution of the boxes of these blocks.
_UNITS_PER_M: Final = 1024.0
# A voxel at (i, j, k) has the key i << 40 | j << 20 | k.
KEY_BITS: Final = 20


@compiled
def fill_voxels(
    points: NDArray[np.float64],
    low: NDArray[np.float64],
    voxel_m: float,
    table: NDArray[np.int32],
    keys: NDArray[np.int64],
    moments: NDArray[np.float64],
    first: NDArray[np.int64],
) -> int:
    """Sort points (m, 3) into voxels that begin at `low`; return the number of voxels.

    Args:
        points: the points.
        low: corner of the voxels at (1, 1, 1).
        voxel_m: size of a voxel.
        table: (2^k,) indices of voxels, -1 for empty entries (open addressing).
        keys: (m,) output, key of each voxel.
        moments: (m, 10) output, sums over the points of each voxel.
        first: (m,) output, index of the first point of each voxel.
    """
    count = 0
    mask = np.int64(table.shape[0] - 1)
    for p in range(points.shape[0]):
        x, y, z = points[p, 0] - low[0], points[p, 1] - low[1], points[p, 2] - low[2]
        i, j, k = int(x / voxel_m) + 1, int(y / voxel_m) + 1, int(z / voxel_m) + 1
        key = (i << (2 * KEY_BITS)) | (j << KEY_BITS) | k
        bits = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
        entry = np.int64(bits >> np.uint64(32)) & mask
        while table[entry] != -1 and keys[table[entry]] != key:
            entry = (entry + np.int64(1)) & mask
        if table[entry] == -1:
            table[entry], keys[count], first[count] = count, key, p
            count += 1
        own = moments[table[entry]]
        own[0] += 1.0
        own[1] += x
        own[2] += y
        own[3] += z
        own[4] += x * x
        own[5] += x * y
        own[6] += x * z
        own[7] += y * y
        own[8] += y * z
        own[9] += z * z
    return count


@compiled
def find_normals(
    keys: NDArray[np.int64],
    moments: NDArray[np.float64],
    part: tuple[int, int],
    least_points: int,
    normals: NDArray[np.float64],
    spreads: NDArray[np.float64],
) -> None:
    """Compute normals of voxels from the points of each voxel and its 26 neighbours.

    Args:
        keys: (v,) keys of the voxels, ascending. The neighbours of a voxel are then in nine runs
            of the list, which all move forwards from one voxel to the next.
        moments: (v, 10) sums over the points of each voxel.
        part: first voxel, and last voxel (exclusive).
        least_points: least number of points for a normal.
        normals: output (v, 3), unit vectors.
        spreads: output (v, 4): standard deviations along the normal and along the two principal
            directions of the surface, ascending, and the number of points.
    """
    total, starts = np.empty(MOMENTS), np.zeros(9, dtype=np.int64)
    for v in range(part[0], part[1]):
        total[:] = 0.0
        for run in range(9):
            aside = ((run // 3 - 1) << (2 * KEY_BITS)) + ((run % 3 - 1) << KEY_BITS)
            other = starts[run]
            while other < keys.shape[0] and keys[other] < keys[v] + aside - 1:
                other += 1
            starts[run] = other
            while other < keys.shape[0] and keys[other] <= keys[v] + aside + 1:
                for m in range(MOMENTS):
                    total[m] += moments[other, m]
                other += 1
        spreads[v, 3] = total[0]
        if total[0] >= least_points:
            _principal(total, normals[v], spreads[v])


@kernel_part
def _principal(
    moments: NDArray[np.float64], normal: NDArray[np.float64], spread: NDArray[np.float64]
) -> None:
    """Set the direction of least scatter, and the standard deviations, of points (Smith)."""
    n = moments[0]
    x, y, z = moments[1] / n, moments[2] / n, moments[3] / n
    xx, xy, xz = moments[4] / n - x * x, moments[5] / n - x * y, moments[6] / n - x * z
    yy, yz, zz = moments[7] / n - y * y, moments[8] / n - y * z, moments[9] / n - z * z
    mean = (xx + yy + zz) / 3.0
    a, b, c = xx - mean, yy - mean, zz - mean
    scale = math.sqrt((a * a + b * b + c * c + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    normal[0], normal[1], normal[2] = 0.0, 0.0, 1.0
    spread[0], spread[1], spread[2] = 0.0, 0.0, 0.0
    if scale < 1e-12:
        return
    half = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    half /= 2.0 * scale * scale * scale
    angle = math.acos(min(1.0, max(-1.0, half))) / 3.0
    largest = mean + 2.0 * scale * math.cos(angle)
    least = mean + 2.0 * scale * math.cos(angle + 2.0 * math.pi / 3.0)
    spread[0] = math.sqrt(max(0.0, least))
    spread[1] = math.sqrt(max(0.0, 3.0 * mean - largest - least))
    spread[2] = math.sqrt(max(0.0, largest))
    a, b, c = xx - least, yy - least, zz - least
    best = 0.0
    for pair in range(3):
        if pair == 0:
            u, v, w = xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy
        elif pair == 1:
            u, v, w = xy * c - xz * yz, xz * xz - a * c, a * yz - xy * xz
        else:
            u, v, w = b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz
        square = u * u + v * v + w * w
        if square > best:
            best = square
            length = math.sqrt(square)
            normal[0], normal[1], normal[2] = u / length, v / length, w / length


@compiled
def count_votes(
    guesses: NDArray[np.float64],
    max_turn: float,
    max_ratio: float,
    max_miss: float,
    votes: NDArray[np.int64],
) -> None:
    """Count for each hypothesis (h, 8) the hypotheses that agree with it.

    Args:
        guesses: point of the axis (3), axis (3), radius, side (1, -1 or 0) of each hypothesis; a
            sphere has an axis of 0, 0, 0.
        max_turn: maximum sine of the angle between two axes.
        max_ratio: maximum difference between two radii, as a share of the larger one.
        max_miss: maximum distance of a point from the other axis, as a share of the radius.
        votes: (h,) output.
    """
    count = guesses.shape[0]
    for i in range(count):
        for j in range(i + 1, count):
            radius = max(guesses[i, 6], guesses[j, 6])
            if abs(guesses[i, 6] - guesses[j, 6]) > max_ratio * radius:
                continue
            if guesses[i, 7] != guesses[j, 7]:
                continue
            along = 0.0
            for axis in range(3):
                along += guesses[i, 3 + axis] * guesses[j, 3 + axis]
            if 1.0 - along * along > max_turn * max_turn:
                continue
            square, along = 0.0, 0.0
            for axis in range(3):
                apart = guesses[j, axis] - guesses[i, axis]
                square += apart * apart
                along += apart * guesses[i, 3 + axis]
            if square - along * along <= max_miss * max_miss * radius * radius:
                votes[i] += 1
                votes[j] += 1


@compiled
def near_voxels(
    row: NDArray[np.float64],
    side: float,
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    limits: NDArray[np.float64],
    near: NDArray[np.int64],
) -> int:
    """Find the voxels near a surface whose normals agree with it; return their number.

    Args:
        row: (13,) the surface.
        side: 1 if normals point to the axis, -1 if they point away from it, 0 for both.
        points: (v, 3) the voxels.
        normals: (v, 3) their normals.
        limits: maximum distance, and minimum cosine of the angle between the normals.
        near: (v,) output, indices of the voxels.
    """
    count = 0
    for v in range(points.shape[0]):
        dx, dy, dz = points[v, 0] - row[0], points[v, 1] - row[1], points[v, 2] - row[2]
        along = dx * row[3] + dy * row[4] + dz * row[5]
        straight = row[12] * along
        radius = math.sqrt(max(1e-24, dx * dx + dy * dy + dz * dz - straight * along))
        if abs(radius - row[9] - row[10] * along) * row[11] >= limits[0]:
            continue
        tilt = normals[v, 0] * row[3] + normals[v, 1] * row[4] + normals[v, 2] * row[5]
        cosine = dx * normals[v, 0] + dy * normals[v, 1] + dz * normals[v, 2] - straight * tilt
        cosine = row[11] * (cosine / radius - row[10] * tilt)
        if (-side * cosine if side != 0.0 else abs(cosine)) > limits[1]:
            near[count] = v
            count += 1
    return count


@compiled
def solve_weighted(
    matrix: NDArray[np.float64],
    distances: NDArray[np.float64],
    weights: NDArray[np.float64],
    solution: NDArray[np.float64],
    squares: NDArray[np.float64],
) -> float:
    """Solve matrix x = distances by weighted least squares.

    Args:
        matrix: (n, k) design.
        distances: (n,) observations.
        weights: (n,) their weights.
        solution: (k,) the previous solution; changed to the new one.
        squares: (n,) output, squared residuals.

    Returns:
        The largest change of the solution.
    """
    n, k = matrix.shape
    normal, right = np.empty((k, k)), np.empty(k)
    _set_normal_equations(matrix, distances, weights, normal, right)
    change = _solve(normal, right, solution)
    for p in range(n):
        rest = distances[p]
        for a in range(k):
            rest -= matrix[p, a] * solution[a]
        squares[p] = rest * rest
    return change


@kernel_part
def _set_normal_equations(
    matrix: NDArray[np.float64],
    distances: NDArray[np.float64],
    weights: NDArray[np.float64],
    normal: NDArray[np.float64],
    right: NDArray[np.float64],
) -> None:
    """Set the lower triangle of the normal matrix (k, k), and the right side (k,)."""
    k = matrix.shape[1]
    normal[:], right[:] = 0.0, 0.0
    for p in range(matrix.shape[0]):
        for a in range(k):
            product = weights[p] * matrix[p, a]
            right[a] += product * distances[p]
            for b in range(a + 1):
                normal[a, b] += product * matrix[p, b]


@kernel_part
def _solve(
    normal: NDArray[np.float64], right: NDArray[np.float64], solution: NDArray[np.float64]
) -> float:
    """Solve by Cholesky's factorisation; return the largest change of the solution."""
    k, trace = normal.shape[0], 0.0
    for a in range(k):
        trace += normal[a, a]
    for a in range(k):
        normal[a, a] += 1e-12 * trace
        for b in range(a + 1):
            value = normal[a, b]
            for c in range(b):
                value -= normal[a, c] * normal[b, c]
            normal[a, b] = math.sqrt(max(value, 1e-300)) if a == b else value / normal[b, b]
        for c in range(a):
            right[a] -= normal[a, c] * right[c]
        right[a] /= normal[a, a]
    change = 0.0
    for a in range(k - 1, -1, -1):
        for c in range(a + 1, k):
            right[a] -= normal[c, a] * right[c]
        right[a] /= normal[a, a]
        change = max(change, abs(right[a] - solution[a]))
        solution[a] = right[a]
    return change


class Cells(NamedTuple):
    """The grids of cells on the surfaces.

    Attributes:
        rounds: (s, 13) the surfaces.
        bounds: (s, 4) float64 smallest and largest position along the axis, tolerance for the
            labels, tolerance for the sums.
        sizes: (s, 3) int64 first column of the surface, columns around, and cells along.
        columns: (a,) int64 first cell of each column, -1 where no points are accepted.
    """

    rounds: NDArray[np.float64]
    bounds: NDArray[np.float64]
    sizes: NDArray[np.int64]
    columns: NDArray[np.int64]


@kernel_part
def _quick_angle(sine: float, cosine: float) -> float:
    """Return atan2 with an error of at most 1e-4 rad (a polynomial of degree 7), for cells."""
    # Without branches, loops over arrays are vectorised.
    a, b = abs(sine), abs(cosine)
    ratio = min(a, b) / (max(a, b) + 1e-300)
    square = ratio * ratio
    angle = ((-0.0464964749 * square + 0.15931422) * square - 0.327622764) * square
    angle = angle * ratio + ratio
    angle = 0.5 * math.pi - angle if a > b else angle
    return math.copysign(math.pi - angle if cosine < 0.0 else angle, sine)


@compiled
def sum_cells(
    offsets: Offsets,
    plane: NDArray[np.int16],
    planes: NDArray[np.float64],
    cells: Cells,
    sums: NDArray[np.float64],
    labels: NDArray[np.int16],
    counts: NDArray[np.int64],
) -> None:
    """Label each point with the nearest surface, and sum the distances of the points in each cell.

    Blocks of points that are far from a surface are skipped. Points near two surfaces are labelled
    but not summed: those that are nearer to one of them have a biased mean distance from it.

    Args:
        offsets: the points.
        plane: (n,) index of the plane of each point, -1 for none; empty without planes.
        planes: (k, 4) normal and offset of each plane, from the cloud's origin; NaN for planes
            whose points may be on a surface wherever they are.
        cells: the cells.
        sums: (cells, 3) output: number of points, sum of the distances and of their squares.
            Distances are positive outwards.
        labels: (n,) output, -1 for points on no surface.
        counts: (s,) output, number of points of each surface.
    """
    middle, half, work = np.empty(3), np.empty(3), np.empty((5, _BLOCK))
    index = np.empty((2, _BLOCK), dtype=np.int64)
    for first in range(0, offsets.x.shape[0], _BLOCK):
        end = min(first + _BLOCK, offsets.x.shape[0])
        block = Offsets(offsets.x[first:end], offsets.y[first:end], offsets.z[first:end])
        own = labels[first:end]
        for p in range(end - first):
            own[p] = -1
        half[0] = _reach(block.x, 0, middle)
        half[1] = _reach(block.y, 1, middle)
        half[2] = _reach(block.z, 2, middle)
        is_empty = True
        for s in range(cells.rounds.shape[0]):
            if _may_have_points(cells, s, middle, half):
                if is_empty:
                    is_empty = False
                    _compare_planes(block, plane[first:end], planes, work, index)
                _compare(block, cells, s, work, index)
        if is_empty:
            continue
        for p in range(end - first):
            s, distance, cell = index[0, p], work[0, p], index[1, p]
            if s < 0:
                continue
            own[p] = s
            counts[s] += 1
            if abs(distance) < cells.bounds[s, 3] <= work[1, p]:
                sums[cell, 0] += 1.0
                sums[cell, 1] += distance
                sums[cell, 2] += distance * distance


@compiled
def replace_labels(
    labels: NDArray[np.int16], numbers: NDArray[np.int16], plane: NDArray[np.int16]
) -> None:
    """Replace the labels of points by the numbers of their surfaces.

    Args:
        labels: (n,) index of the surface of each point, -1 for none; changed.
        numbers: (s,) number of each surface, -1 for none.
        plane: (n,) labels of points without a number; empty for -1.
    """
    for p in range(labels.shape[0]):
        label = numbers[labels[p]] if labels[p] >= 0 else -1
        labels[p] = plane[p] if label < 0 and plane.shape[0] > 0 else label


@kernel_part
def _reach(values: NDArray[np.float32], axis: int, middle: NDArray[np.float64]) -> float:
    """Set the middle of a block along an axis; return half its length."""
    low = high = np.int32(values[0] * _UNITS_PER_M)
    for p in range(values.shape[0]):
        # Minima of floats would not be vectorised, because values may be NaN.
        value = np.int32(values[p] * _UNITS_PER_M)
        low, high = min(low, value), max(high, value)
    middle[axis] = 0.5 * (float(low) + float(high)) / _UNITS_PER_M
    return (0.5 * (float(high) - float(low)) + 1.0) / _UNITS_PER_M


@kernel_part
def _may_have_points(
    cells: Cells, s: int, middle: NDArray[np.float64], half: NDArray[np.float64]
) -> bool:
    """Return whether a box with half lengths `half` (3,) may reach a surface and its tolerance.

    The distance from an axis or a centre is convex, so it is not below its tangent plane, and at a
    displacement d, it is at most d^2 / 2R above.
    """
    r = cells.rounds
    dx, dy, dz = middle[0] - r[s, 0], middle[1] - r[s, 1], middle[2] - r[s, 2]
    along = dx * r[s, 3] + dy * r[s, 4] + dz * r[s, 5]
    across = math.sqrt(max(1e-24, dx * dx + dy * dy + dz * dz - r[s, 12] * along * along))
    distance = (across - r[s, 9] - r[s, 10] * along) * r[s, 11]
    length, reach, square = 0.0, 0.0, 0.0
    for axis in range(3):
        off = middle[axis] - r[s, axis] - r[s, 12] * along * r[s, 3 + axis]
        length += half[axis] * abs(r[s, 3 + axis])
        reach += half[axis] * abs(off / across - r[s, 10] * r[s, 3 + axis]) * r[s, 11]
        square += half[axis] * half[axis]
    is_beside = along < cells.bounds[s, 0] - length or along > cells.bounds[s, 1] + length
    within = cells.bounds[s, 2] + reach + 1e-6
    return not is_beside and -within - 0.5 * square / across * r[s, 11] <= distance <= within


@kernel_part
def _compare_planes(
    block: Offsets,
    plane: NDArray[np.int16],
    planes: NDArray[np.float64],
    work: NDArray[np.float64],
    index: NDArray[np.int64],
) -> None:
    """Set the distances of a block's points from their planes; inf for points without one."""
    for p in range(block.x.shape[0]):
        # Distances from the nearest plane or surface, and from the second nearest surface, and the
        # index of the nearest surface.
        work[0, p], work[1, p], index[0, p] = math.inf, math.inf, -1
        if plane.shape[0] > 0 and plane[p] >= 0:
            own = plane[p]
            distance = planes[own, 0] * block.x[p] + planes[own, 1] * block.y[p]
            distance += planes[own, 2] * block.z[p] - planes[own, 3]
            if not math.isnan(distance):
                work[0, p] = distance


@kernel_part
def _compare(
    block: Offsets,
    cells: Cells,
    s: int,
    work: NDArray[np.float64],
    index: NDArray[np.int64],
) -> None:
    """Compare the distances of a block's points from a surface with those from the others."""
    x, y, z = block.x, block.y, block.z
    r, bounds, sizes = cells.rounds, cells.bounds, cells.sizes
    px, py, pz, ax, ay, az = r[s, 0], r[s, 1], r[s, 2], r[s, 3], r[s, 4], r[s, 5]
    zx, zy, zz = r[s, 6], r[s, 7], r[s, 8]
    sx, sy, sz = ay * zz - az * zy, az * zx - ax * zz, ax * zy - ay * zx
    radius, slope, steepness, straight = r[s, 9], r[s, 10], r[s, 11], r[s, 12]
    least, reach, around, rows = bounds[s, 0], bounds[s, 2], sizes[s, 1], sizes[s, 2]
    columns_per_rad, rows_per_m = around / (2.0 * math.pi), rows / (bounds[s, 1] - least)
    # The loop is vectorised, as it has no branches, and as it writes to one array only: for more,
    # LLVM would need too many tests whether the arrays overlap.
    for p in range(x.shape[0]):
        dx, dy, dz = float(x[p]) - px, float(y[p]) - py, float(z[p]) - pz
        along = dx * ax + dy * ay + dz * az
        across = math.sqrt(max(0.0, dx * dx + dy * dy + dz * dz - straight * along * along))
        off = (across - radius - slope * along) * steepness
        # Cells of a sphere depend on the direction only, so noise does not affect them.
        along *= 1.0 if straight != 0.0 else radius / max(1e-12, across)
        angle = _quick_angle(dx * sx + dy * sy + dz * sz, dx * zx + dy * zy + dz * zz)
        row = (along - least) * rows_per_m
        work[2, p], work[3, p] = off, (angle + math.pi) * columns_per_rad
        work[4, p] = row if (abs(off) <= reach) & (row >= 0.0) & (row <= rows) else -1.0
    for p in range(x.shape[0]):
        off, cell = work[2, p], cells.columns[sizes[s, 0] + min(int(work[3, p]), around - 1)]
        if work[4, p] < 0.0 or cell < 0:
            continue
        if abs(off) < abs(work[0, p]):
            work[1, p] = abs(work[0, p]) if index[0, p] >= 0 else math.inf
            work[0, p], index[0, p] = off, s
            index[1, p] = cell + min(int(work[4, p]), rows - 1)
        elif index[0, p] >= 0:
            work[1, p] = min(work[1, p], abs(off))
