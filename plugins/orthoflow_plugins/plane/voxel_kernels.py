"""Compiled passes that sum points into voxels, and those of region growing on the sums.

Voxels live in bricks of 8 x 8 x 8, of which only those with points have memory: a scan is surfaces,
and a full table of two-centimetre voxels would be larger than the scan. Moments are those of whole
steps within a voxel, so that neither threads nor the order of points show in the sums.

Regions grow on the voxels, of which a room has half a million where it has fifty million points.
Lengths are in sides of a voxel, so that kernels need not know how large one is.
"""

from __future__ import annotations

import math
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part
from orthoflow_plugins.plane.kernels import BLOCK_POINTS, BlockedPoints, flattest

BRICK_SIDE: Final = 8
VOXELS: Final = BRICK_SIDE**3
# Steps along a side of a voxel: 20 micrometres in voxels of two centimetres.
STEPS_PER_VOXEL: Final = 1024
# Sums of a voxel: points, steps along a, b, c, then their products aa, ab, ac, bb, bc, cc.
N_SUMS: Final = 10
# More bricks than this in the table of a scene cost more than they show; the voxels grow instead.
_BRICKS_MOST: Final = 8_000_000
# Bits of the sum of a block's steps, and of the sum of its products of steps; a little more.
_FIELD_BITS: Final = 18
_PRODUCT_BITS: Final = 32

T = TypeVar("T", bound=np.generic)


def coarsened(voxel_m: float, extent_m: NDArray[np.float64]) -> float:
    """Enlarge voxels until a scene of (3,) this size has at most `_BRICKS_MOST` bricks of them."""
    brick_m3 = float(np.prod(extent_m + BRICK_SIDE * voxel_m)) / _BRICKS_MOST
    return max(voxel_m, math.cbrt(brick_m3) / BRICK_SIDE)


def with_room(values: NDArray[T], n_used: int, n_free: int) -> NDArray[T]:
    """Enlarge a table unless so many of its rows are free; what is in use stays."""
    if n_used + n_free <= len(values):
        return values
    larger = np.zeros((max(2 * n_used, n_used + n_free), *values.shape[1:]), dtype=values.dtype)
    larger[:n_used] = values[:n_used]
    return larger


def voxel_places(bricks: NDArray[np.bool_], occupied: NDArray[np.bool_]) -> NDArray[np.int32]:
    """(m, 3) where voxels lie, brick by brick.

    Args:
        bricks: (a, b, c) which bricks have a row.
        occupied: (rows, VOXELS) which voxels are meant; rows in the order of the bricks.
    """
    corners = np.argwhere(bricks).astype(np.int32) * np.int32(BRICK_SIDE)
    row, voxel = np.divmod(np.flatnonzero(occupied), VOXELS)
    within = np.column_stack(np.unravel_index(voxel, (BRICK_SIDE,) * 3)).astype(np.int32)
    return corners[row] + within


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
def _new_row(brick: int, bricks: NDArray[np.int32], n_used: NDArray[np.int64]) -> np.int32:
    """Return a brick that has no points yet the next row of a table."""
    row = np.int32(n_used[0])
    n_used[0] += 1
    bricks[brick] = row
    return row


@kernel_part
def _add_to_voxel(
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
        row = _new_row(brick, bricks, n_used)
    counts[row, key % VOXELS] += count


@compiled
def count_voxels(
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
                _add_to_voxel(key, i - first, bricks, counts, n_used)
                first, key = i, keys[i]
        _add_to_voxel(key, count - first, bricks, counts, n_used)
        start += BLOCK_POINTS
    return points.x.size


@kernel_part
def _place_steps(
    points: BlockedPoints,
    start: int,
    frame: NDArray[np.float32],
    axis: int,
    steps: NDArray[np.int64],
) -> None:
    """Set (BLOCK_POINTS,) steps of a block's points from the low side of their voxels."""
    stop = min(start + BLOCK_POINTS, points.x.size)
    xs, ys, zs = points.x[start:stop], points.y[start:stop], points.z[start:stop]
    a0, a1, a2, a3 = frame[axis, 0], frame[axis, 1], frame[axis, 2], frame[axis, 3]
    fine = np.float32(STEPS_PER_VOXEL)
    for i in range(xs.size):
        a = a0 * xs[i] + a1 * ys[i] + a2 * zs[i] - a3
        steps[i] = np.int64(np.int32((a - np.float32(np.int32(a))) * fine))


@kernel_part
def _voxel(
    key: int, bricks: NDArray[np.int32], numbers: NDArray[np.int32], n_used: NDArray[np.int64]
) -> int:
    """Return the number of the voxel with a key of `place_keys`, a new one if it had none."""
    brick, voxel = key // VOXELS, key % VOXELS
    row = bricks[brick]
    if row < 0:
        row = _new_row(brick, bricks, n_used)
        numbers[row, :] = -1
    number = numbers[row, voxel]
    if number < 0:
        number = np.int32(n_used[1])
        n_used[1] += 1
        numbers[row, voxel] = number
    return int(number)


@kernel_part
def _pack(steps: NDArray[np.int64], packed: NDArray[np.int64]) -> None:
    """Pack what each point of a block adds into four numbers, so that a run of points is four sums.

    Args:
        steps: (3, BLOCK_POINTS) see `_place_steps`; the sum of those of a block has 18 bits, that
            of their products 28.
        packed: (4, BLOCK_POINTS) set: one and a, b, c; aa and bb; cc and ab; ac and bc.
    """
    fields, products, one = np.int64(_FIELD_BITS), np.int64(_PRODUCT_BITS), np.int64(1)
    a, b, c = steps[0], steps[1], steps[2]
    first, second, third, fourth = packed[0], packed[1], packed[2], packed[3]
    for i in range(BLOCK_POINTS):
        first[i] = (((((one << fields) + a[i]) << fields) + b[i]) << fields) + c[i]
    for i in range(BLOCK_POINTS):
        second[i] = ((a[i] * a[i]) << products) + b[i] * b[i]
    for i in range(BLOCK_POINTS):
        third[i] = ((c[i] * c[i]) << products) + a[i] * b[i]
    for i in range(BLOCK_POINTS):
        fourth[i] = ((a[i] * c[i]) << products) + b[i] * c[i]


@kernel_part
def _add_run(
    run: tuple[np.int64, np.int64, np.int64, np.int64], sums: NDArray[np.int64], k: int
) -> None:
    """Add the packed sums of a run of points to the moments of voxel k, from the voxel's middle."""
    fields, products = np.int64(_FIELD_BITS), np.int64(_PRODUCT_BITS)
    steps, squares, mixed, others = run
    field, product = (np.int64(1) << fields) - 1, (np.int64(1) << products) - 1
    n = steps >> (3 * fields)
    a, b, c = (steps >> (2 * fields)) & field, (steps >> fields) & field, steps & field
    half = np.int64(STEPS_PER_VOXEL // 2)
    square = half * half * n
    sums[k, 0] += n
    sums[k, 1] += a - half * n
    sums[k, 2] += b - half * n
    sums[k, 3] += c - half * n
    # Sum (s - h) (t - h) = sum st - h (sum s + sum t) + h h n.
    sums[k, 4] += (squares >> products) - 2 * half * a + square
    sums[k, 5] += (mixed & product) - half * (a + b) + square
    sums[k, 6] += (others >> products) - half * (a + c) + square
    sums[k, 7] += (squares & product) - 2 * half * b + square
    sums[k, 8] += (others & product) - half * (b + c) + square
    sums[k, 9] += (mixed >> products) - 2 * half * c + square


@compiled
def gather_moments(  # noqa: PLR0913, PLR0917 - compiled code has no objects to bundle these in
    points: BlockedPoints,
    start: int,
    frame: NDArray[np.float32],
    shape: tuple[int, int, int],
    bricks: NDArray[np.int32],
    numbers: NDArray[np.int32],
    sums: NDArray[np.int64],
    n_used: NDArray[np.int64],
) -> int:
    """Add points to the moments of their voxels, which are made as they are met, until tables fill.

    A scan comes column by column, so points that follow each other share a voxel: their sums are
    kept aside and added when the voxel changes.

    Args:
        points: (n,) offsets in blocks.
        start: first point, at the start of a block.
        frame: (3, 4) voxel of a point.
        shape: bricks along a, b, c.
        bricks: (a * b * c,) row of each brick in `numbers`, -1 for none yet.
        numbers: (rows, voxels) number of each voxel, -1 for none yet.
        sums: (voxels, N_SUMS) added to.
        n_used: rows and voxels in use.

    Returns:
        The first point that was not added: the number of points, unless the tables are full.
    """
    keys = np.empty(BLOCK_POINTS, dtype=np.int64)
    steps = np.zeros((3, BLOCK_POINTS), dtype=np.int64)
    packed = np.empty((4, BLOCK_POINTS), dtype=np.int64)
    first, second, third, fourth = packed[0], packed[1], packed[2], packed[3]
    while start < points.x.size:
        if n_used[0] + BLOCK_POINTS > numbers.shape[0] or n_used[1] + BLOCK_POINTS > sums.shape[0]:
            return start
        count = place_keys(points, start, frame, shape, keys)
        for axis in range(3):
            _place_steps(points, start, frame, axis, steps[axis])
        _pack(steps, packed)
        key = keys[0]
        p = q = r = s = np.int64(0)
        for i in range(count):
            if keys[i] != key:
                if key >= 0:
                    _add_run((p, q, r, s), sums, _voxel(key, bricks, numbers, n_used))
                key = keys[i]
                p = q = r = s = np.int64(0)
            p += first[i]
            q += second[i]
            r += third[i]
            s += fourth[i]
        if key >= 0:
            _add_run((p, q, r, s), sums, _voxel(key, bricks, numbers, n_used))
        start += BLOCK_POINTS
    return points.x.size


@compiled
def merge_moments(
    other_bricks: NDArray[np.int32],
    other_numbers: NDArray[np.int32],
    other_sums: NDArray[np.int64],
    bricks: NDArray[np.int32],
    numbers: NDArray[np.int32],
    sums: NDArray[np.int64],
    n_used: NDArray[np.int64],
) -> None:
    """Add the voxels of another part to tables that have room for them."""
    for brick in range(other_bricks.size):
        slot = other_bricks[brick]
        if slot < 0:
            continue
        for voxel in range(other_numbers.shape[1]):
            other = other_numbers[slot, voxel]
            if other >= 0:
                k = _voxel(brick * VOXELS + voxel, bricks, numbers, n_used)
                for place in range(N_SUMS):
                    sums[k, place] += other_sums[other, place]


@kernel_part
def _known_voxel(key: int, bricks: NDArray[np.int32], numbers: NDArray[np.int32]) -> int:
    """Return the number of the voxel with a key of `place_keys`, -1 if it has none."""
    slot = bricks[key // VOXELS] if key >= 0 else -1
    return numbers[slot, key % VOXELS] if slot >= 0 else -1


@compiled
def find_voxels(
    points: BlockedPoints,
    frame: NDArray[np.float32],
    bricks: NDArray[np.int32],
    numbers: NDArray[np.int32],
    found: NDArray[np.int32],
) -> None:
    """Set (n,) found to the voxel of each point, -1 outside."""
    keys = np.empty(BLOCK_POINTS, dtype=np.int64)
    flat = bricks.reshape(bricks.size)
    for start in range(0, points.x.size, BLOCK_POINTS):
        count = place_keys(points, start, frame, bricks.shape, keys)
        for i in range(count):
            found[start + i] = _known_voxel(keys[i], flat, numbers)


@compiled
def claim_voxels(
    points: BlockedPoints,
    frame: NDArray[np.float32],
    bricks: NDArray[np.int32],
    numbers: NDArray[np.int32],
    owners: NDArray[np.int8],
    claims: NDArray[np.int8],
) -> None:
    """Assign each point to the plane that owns its voxel; owners (voxels,) are -1 for none."""
    keys = np.empty(BLOCK_POINTS, dtype=np.int64)
    flat = bricks.reshape(bricks.size)
    for start in range(0, points.x.size, BLOCK_POINTS):
        count = place_keys(points, start, frame, bricks.shape, keys)
        for i in range(count):
            voxel = _known_voxel(keys[i], flat, numbers)
            claims[start + i] = owners[voxel] if voxel >= 0 else -1


# A region's plane is fitted anew whenever it has grown by this share.
_REFIT_SHARE: Final = 0.2
# How often the voxels of a region ask their neighbours.
_SWEEPS_MOST: Final = 3


@kernel_part
def voxel_at(a: int, b: int, c: int, bricks: NDArray[np.int32], numbers: NDArray[np.int32]) -> int:
    """Return the number of the voxel at a place, -1 where none is."""
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
