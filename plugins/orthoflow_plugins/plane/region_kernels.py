"""Compiled passes of region growing: planes of neighbourhoods, growing, moments of regions.

All of them work on the voxels of `voxel_kernels`, of which a room has half a million where it has
fifty million points. Lengths are in sides of a voxel, so that kernels need not know how large one
is.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part
from orthoflow_plugins.plane.fit_kernels import flattest
from orthoflow_plugins.plane.voxel_kernels import BRICK_SIDE, STEPS_PER_VOXEL

# A region's plane is fitted anew whenever it has grown by this share.
_REFIT_SHARE: Final = 0.2
# How often the voxels of a region ask their neighbours.
_SWEEPS_MOST: Final = 3


@kernel_part
def voxel_at(a: int, b: int, c: int, bricks: NDArray[np.int32], numbers: NDArray[np.int32]) -> int:
    """Give the number of the voxel at a place, -1 where none is."""
    if a < 0 or b < 0 or c < 0:
        return -1
    p, q, r = a >> 3, b >> 3, c >> 3
    if p >= bricks.shape[0] or q >= bricks.shape[1] or r >= bricks.shape[2]:
        return -1
    brick = bricks[p, q, r]
    if brick < 0:
        return -1
    return int(numbers[brick, ((a & 7) * BRICK_SIDE + (b & 7)) * BRICK_SIDE + (c & 7)])


@compiled
def add_moments(
    total: NDArray[np.float64],
    sums: NDArray[np.int64],
    k: int,
    at: tuple[float, float, float],
) -> None:
    """Add voxel k to (10,) total, its middle being `at` from where the total is counted."""
    n = float(sums[k, 0])
    a, b, c = at
    fine = 1.0 / STEPS_PER_VOXEL
    # Steps were rounded down: half a step on average.
    sa = sums[k, 1] * fine + 0.5 * fine * n
    sb = sums[k, 2] * fine + 0.5 * fine * n
    sc = sums[k, 3] * fine + 0.5 * fine * n
    square = fine * fine
    shift = 0.5 * fine
    # With steps s and a shift h, sum (s + h)(t + h) = sum st + h (sum s + sum t) - h h n.
    aa = sums[k, 4] * square + 2.0 * shift * sa - shift * shift * n
    ab = sums[k, 5] * square + shift * (sa + sb) - shift * shift * n
    ac = sums[k, 6] * square + shift * (sa + sc) - shift * shift * n
    bb = sums[k, 7] * square + 2.0 * shift * sb - shift * shift * n
    bc = sums[k, 8] * square + shift * (sb + sc) - shift * shift * n
    cc = sums[k, 9] * square + 2.0 * shift * sc - shift * shift * n
    total[0] += n
    total[1] += n * a + sa
    total[2] += n * b + sb
    total[3] += n * c + sc
    total[4] += n * a * a + 2.0 * a * sa + aa
    total[5] += n * a * b + a * sb + b * sa + ab
    total[6] += n * a * c + a * sc + c * sa + ac
    total[7] += n * b * b + 2.0 * b * sb + bb
    total[8] += n * b * c + b * sc + c * sb + bc
    total[9] += n * c * c + 2.0 * c * sc + cc


@compiled
def fit_neighbourhoods(  # noqa: PLR0913, PLR0917 - compiled code has no objects to bundle these in
    places: NDArray[np.int32],
    first: int,
    bricks: NDArray[np.int32],
    numbers: NDArray[np.int32],
    sums: NDArray[np.int64],
    around: NDArray[np.int32],
    enough: int,
    normals: NDArray[np.float32],
    spreads: NDArray[np.float32],
) -> None:
    """Fit a plane to the neighbourhood of each voxel.

    Args:
        places: (m, 3) voxels to fit, of which the first has the number `first`.
        first: see above.
        bricks: (a, b, c) number of each brick.
        numbers: (bricks, VOXELS) number of each voxel.
        sums: (n, N_SUMS) moments of all voxels.
        around: (o, 4) steps to the voxels of a neighbourhood, near ones first, and the shell that
            each is in.
        enough: a neighbourhood ends with the shell in which it has so many points.
        normals: (m, 3) set; either side.
        spreads: (m, 3) set to the deviation from the plane and the two extents along it (standard
            deviations), sides of a voxel; the first is infinite with fewer than three points.
    """
    total, plane = np.empty(10), np.empty(9)
    for i in range(places.shape[0]):
        a, b, c = places[i, 0], places[i, 1], places[i, 2]
        total[:] = 0.0
        add_moments(total, sums, first + i, (0.0, 0.0, 0.0))
        shell = 0
        for j in range(around.shape[0]):
            if around[j, 3] != shell:
                if total[0] >= enough:
                    break
                shell = around[j, 3]
            da, db, dc = around[j, 0], around[j, 1], around[j, 2]
            k = voxel_at(a + da, b + db, c + dc, bricks, numbers)
            if k >= 0:
                add_moments(total, sums, k, (float(da), float(db), float(dc)))
        if total[0] < 3.0:
            normals[i, 0], normals[i, 1], normals[i, 2] = 0.0, 0.0, 1.0
            spreads[i, 0], spreads[i, 1], spreads[i, 2] = np.inf, 0.0, 0.0
            continue
        flattest(total, plane)
        for axis in range(3):
            normals[i, axis] = plane[axis]
            spreads[i, axis] = math.sqrt(max(plane[6 + axis], 0.0))


@compiled
def grow_regions(  # noqa: C901, PLR0912, PLR0913, PLR0917 - the loop that growing is
    places: NDArray[np.int32],
    bricks: NDArray[np.int32],
    numbers: NDArray[np.int32],
    sums: NDArray[np.int64],
    normals: NDArray[np.float32],
    seeds: NDArray[np.int64],
    limits: NDArray[np.float64],
    regions: NDArray[np.int32],
) -> int:
    """Grow regions over neighbouring voxels: like normal, and near the region's plane.

    The plane is that of all points of the region so far; it is fitted anew as the region grows, and
    when nothing more joins, the region's own voxels ask their neighbours again with the last one.

    Args:
        places: (n, 3) where voxels lie.
        bricks: (a, b, c) number of each brick.
        numbers: (bricks, VOXELS) number of each voxel.
        sums: (n, N_SUMS) moments.
        normals: (n, 3) of their neighbourhoods.
        seeds: (s,) voxels that may belong to a region, those to start from first.
        limits: smallest cosine between normals, largest distance in sides of a voxel.
        regions: (n,) -2 where a voxel may join, others stay; set to the region.

    Returns:
        The number of regions.
    """
    cosine, distance = limits[0], limits[1]
    queue = np.empty(seeds.size, dtype=np.int32)
    total, plane = np.empty(10), np.empty(9)
    n_regions = 0
    fine = 1.0 / STEPS_PER_VOXEL
    for s in range(seeds.size):
        seed = seeds[s]
        if regions[seed] != -2:
            continue
        regions[seed] = n_regions
        queue[0] = seed
        length = 1
        # Counted from the seed's voxel, so that a region far from the box's corner loses nothing.
        oa, ob, oc = places[seed, 0], places[seed, 1], places[seed, 2]
        total[:] = 0.0
        add_moments(total, sums, seed, (0.0, 0.0, 0.0))
        for axis in range(3):
            plane[axis] = normals[seed, axis]
            plane[3 + axis] = total[1 + axis] / total[0]
        refit = 8
        for _ in range(_SWEEPS_MOST):
            before, head = length, 0
            while head < length:
                voxel = queue[head]
                head += 1
                for da in range(-1, 2):
                    for db in range(-1, 2):
                        for dc in range(-1, 2):
                            pa, pb = places[voxel, 0] + da, places[voxel, 1] + db
                            pc = places[voxel, 2] + dc
                            k = voxel_at(pa, pb, pc, bricks, numbers)
                            if k < 0 or regions[k] != -2:
                                continue
                            turn = (
                                plane[0] * normals[k, 0]
                                + plane[1] * normals[k, 1]
                                + plane[2] * normals[k, 2]
                            )
                            if abs(turn) < cosine:
                                continue
                            per = fine / sums[k, 0]
                            away = (
                                plane[0] * (pa - oa + sums[k, 1] * per - plane[3])
                                + plane[1] * (pb - ob + sums[k, 2] * per - plane[4])
                                + plane[2] * (pc - oc + sums[k, 3] * per - plane[5])
                            )
                            if abs(away) > distance:
                                continue
                            regions[k] = n_regions
                            queue[length] = k
                            length += 1
                            at = (float(pa - oa), float(pb - ob), float(pc - oc))
                            add_moments(total, sums, k, at)
                if length >= refit:
                    flattest(total, plane)
                    refit = int((1.0 + _REFIT_SHARE) * length) + 1
            # While the plane still swayed it may have passed over voxels that it now holds.
            if length == before:
                break
            if length >= 8:
                flattest(total, plane)
        n_regions += 1
    return n_regions


@compiled
def sum_regions(
    places: NDArray[np.int32],
    sums: NDArray[np.int64],
    regions: NDArray[np.int32],
    totals: NDArray[np.float64],
) -> None:
    """Add the moments of voxels to (r, 10) of their regions, from the middle of voxel (0, 0, 0)."""
    for k in range(regions.size):
        region = regions[k]
        if region >= 0:
            at = (float(places[k, 0]), float(places[k, 1]), float(places[k, 2]))
            add_moments(totals[region], sums, k, at)
