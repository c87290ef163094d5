"""Kernels of the detectors: voxels and their normals, votes for hypotheses, and cells of surfaces.

A surface of revolution is a row of 12 numbers: point of the axis (3), axis (3), the direction of
angle 0 (3), radius at the point, change of the radius along the axis, and 1 / sqrt(1 + change^2).
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
_KEY_BITS: Final = 20


class VoxelTable(NamedTuple):
    """Occupied voxels, found by hashing (open addressing).

    Attributes:
        keys: (2^k,) int64 keys, -1 for empty entries.
        slots: (2^k,) int32 index of the voxel of each entry.
        places: (v, 3) int32 position of each voxel in the grid.
        moments: (v, 10) float64 sums over the points of each voxel.
        first: (v,) int32 index of the first point of each voxel.
    """

    keys: NDArray[np.int64]
    slots: NDArray[np.int32]
    places: NDArray[np.int32]
    moments: NDArray[np.float64]
    first: NDArray[np.int32]


@kernel_part
def _find(keys: NDArray[np.int64], i: int, j: int, k: int) -> np.int64:
    """Return the entry of a voxel, or the empty entry where it belongs."""
    key = (i << (2 * _KEY_BITS)) | (j << _KEY_BITS) | k
    mask = np.int64(keys.shape[0] - 1)
    bits = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    entry = np.int64(bits >> np.uint64(32)) & mask
    while keys[entry] != -1 and keys[entry] != key:
        entry = (entry + np.int64(1)) & mask
    return entry


@kernel_part
def _voxel_at(table: VoxelTable, count: int, i: int, j: int, k: int) -> np.int64:
    """Return the index of a voxel; a new voxel is added with the index `count`."""
    entry = _find(table.keys, i, j, k)
    if table.keys[entry] == -1:
        table.keys[entry] = (i << (2 * _KEY_BITS)) | (j << _KEY_BITS) | k
        table.slots[entry] = count
        table.places[count, 0] = i
        table.places[count, 1] = j
        table.places[count, 2] = k
    return np.int64(table.slots[entry])


@compiled
def fill_voxels(
    points: NDArray[np.float64], low: NDArray[np.float64], voxel_m: float, table: VoxelTable
) -> int:
    """Sort points (m, 3) into voxels that begin at `low`; return the number of voxels."""
    count = 0
    for p in range(points.shape[0]):
        x, y, z = points[p, 0] - low[0], points[p, 1] - low[1], points[p, 2] - low[2]
        i, j, k = int(x / voxel_m) + 2, int(y / voxel_m) + 2, int(z / voxel_m) + 2
        v = _voxel_at(table, count, i, j, k)
        if v == count:
            table.first[v] = p
            count += 1
        own = table.moments[v]
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
def merge_voxels(fine: VoxelTable, n_fine: int, coarse: VoxelTable) -> int:
    """Merge voxels into voxels of twice the size, and return the number of these."""
    count = 0
    for f in range(n_fine):
        i, j, k = fine.places[f, 0], fine.places[f, 1], fine.places[f, 2]
        v = _voxel_at(coarse, count, i // 2 + 1, j // 2 + 1, k // 2 + 1)
        if v == count:
            coarse.first[v] = fine.first[f]
            count += 1
        for m in range(MOMENTS):
            coarse.moments[v, m] += fine.moments[f, m]
    return count


@compiled
def find_normals(
    table: VoxelTable, n_voxels: int, normals: NDArray[np.float64], spreads: NDArray[np.float64]
) -> None:
    """Compute the normal of each voxel from the points of the voxel and its 26 neighbours.

    Args:
        table: the voxels.
        n_voxels: their number.
        normals: output (v, 3), unit vectors.
        spreads: output (v, 4): standard deviations along the normal and along the two principal
            directions of the surface, ascending, and the number of points.
    """
    total = np.empty(MOMENTS)
    for v in range(n_voxels):
        total[:] = 0.0
        i, j, k = table.places[v, 0], table.places[v, 1], table.places[v, 2]
        for di in range(-1, 2):
            for dj in range(-1, 2):
                for dk in range(-1, 2):
                    entry = _find(table.keys, i + di, j + dj, k + dk)
                    if table.keys[entry] != -1:
                        other = table.slots[entry]
                        for m in range(MOMENTS):
                            total[m] += table.moments[other, m]
        _principal(total, normals[v], spreads[v])
        spreads[v, 3] = total[0]


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
        guesses: point of the axis (3), axis (3), radius, side (1, -1 or 0) of each hypothesis.
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


class Cells(NamedTuple):
    """The grids of cells on the surfaces.

    Attributes:
        rounds: (s, 12) the surfaces.
        bounds: (s, 4) float64 smallest and largest position along the axis, tolerance for the
            labels, tolerance for the sums.
        sizes: (s, 4) int64 first cell of the surface, cells around, cells along, and the first
            entry of its angles in `is_open`.
        is_open: (a,) bool, for each cell around each surface, whether points are accepted there.
    """

    rounds: NDArray[np.float64]
    bounds: NDArray[np.float64]
    sizes: NDArray[np.int64]
    is_open: NDArray[np.bool_]


@kernel_part
def _quick_angle(sine: float, cosine: float) -> float:
    """Return atan2 with an error of at most 1e-4 rad (a polynomial of degree 7), for cells."""
    high, low = max(abs(sine), abs(cosine)), min(abs(sine), abs(cosine))
    ratio = low / max(high, 1e-300)
    square = ratio * ratio
    angle = ((-0.0464964749 * square + 0.15931422) * square - 0.327622764) * square
    angle = angle * ratio + ratio
    if abs(sine) > abs(cosine):
        angle = 0.5 * math.pi - angle
    if cosine < 0.0:
        angle = math.pi - angle
    return angle if sine >= 0.0 else -angle


@kernel_part
def _cell_at(cells: Cells, s: int, x: float, y: float, z: float, along: float) -> int:
    """Return the cell of a position relative to the surface's point; -1 if it is excluded."""
    # Arrays of rows would be reference-counted at each use.
    r = cells.rounds
    cosine = x * r[s, 6] + y * r[s, 7] + z * r[s, 8]
    sine = (
        x * (r[s, 4] * r[s, 8] - r[s, 5] * r[s, 7])
        + y * (r[s, 5] * r[s, 6] - r[s, 3] * r[s, 8])
        + z * (r[s, 3] * r[s, 7] - r[s, 4] * r[s, 6])
    )
    around, rows = cells.sizes[s, 1], cells.sizes[s, 2]
    i = min(int((_quick_angle(sine, cosine) / (2.0 * math.pi) + 0.5) * around), around - 1)
    if not cells.is_open[cells.sizes[s, 3] + i]:
        return -1
    share = (along - cells.bounds[s, 0]) / (cells.bounds[s, 1] - cells.bounds[s, 0])
    return int(cells.sizes[s, 0] + i * rows + min(int(share * rows), rows - 1))


@kernel_part
def _distance_of_plane(
    index: int, planes: NDArray[np.float64], x: float, y: float, z: float
) -> float:
    """Return the distance of a point from its plane; inf if it has none or the plane is curved."""
    if index < 0:
        return math.inf
    distance = planes[index, 0] * x + planes[index, 1] * y + planes[index, 2] * z
    distance -= planes[index, 3]
    return math.inf if math.isnan(distance) else distance


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
    r, bounds = cells.rounds, cells.bounds
    count = r.shape[0]
    for p in range(offsets.x.shape[0]):
        labels[p] = -1
        x, y, z = float(offsets.x[p]), float(offsets.y[p]), float(offsets.z[p])
        index = plane[p] if plane.shape[0] > 0 else -1
        nearest, best, cell = _distance_of_plane(index, planes, x, y, z), -1, 0
        for s in range(count):
            dx, dy, dz = x - r[s, 0], y - r[s, 1], z - r[s, 2]
            along = dx * r[s, 3] + dy * r[s, 4] + dz * r[s, 5]
            if along < bounds[s, 0] or along > bounds[s, 1]:
                continue
            radius = r[s, 9] + r[s, 10] * along
            square = dx * dx + dy * dy + dz * dz - along * along
            reach = bounds[s, 2] / r[s, 11]
            inner = max(0.0, radius - reach)
            if square < inner * inner or square > (radius + reach) * (radius + reach):
                continue
            distance = (math.sqrt(square) - radius) * r[s, 11]
            if abs(distance) >= abs(nearest):
                continue
            at = _cell_at(cells, s, dx, dy, dz, along)
            if at >= 0:
                nearest, best, cell = distance, s, at
        if best >= 0:
            labels[p] = best
            counts[best] += 1
            if abs(nearest) < bounds[best, 3]:
                sums[cell, 0] += 1.0
                sums[cell, 1] += nearest
                sums[cell, 2] += nearest * nearest
