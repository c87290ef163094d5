"""Voxels of a cloud with the moments of their points, planes of neighbourhoods, and regions.

Region growing needs the neighbours of each point. Voxels make this fast: a single pass adds each
point to the ten sums of its voxel, and the sums of neighbouring voxels give the exact plane of best
fit to all their points. A room with fifty million points has half a million voxels.

Voxels are grouped into bricks of 8 x 8 x 8. Only bricks with points are stored, because a full
table of 2 cm voxels would be larger than the scan. Moments are sums of integer steps from the
centre of a voxel, so they depend neither on the number of threads nor on the order of points. In
kernels, the unit of length is the side of a voxel.

A cloud that is dense on one wall may have a point spacing of a decimetre on another wall, on which
regions of small voxels are fragmented. Moments are additive, so such voxels can be merged into
larger ones without another pass over the points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part
from orthoflow.geometry.rows import group_sums
from orthoflow_plugins.plane.cloud import PreparedCloud
from orthoflow_plugins.plane.kernels import (
    BLOCK_POINTS,
    BlockedPoints,
    each_part,
    flattest,
    piece_of,
)

BRICK_SIDE: Final = 8
VOXELS: Final = BRICK_SIDE**3
# Number of half steps from the centre of a voxel to its sides. In a voxel of 2 cm, a step is 20
# micrometres. The centre of a step is an odd number of half steps from the centre of the voxel.
HALF_STEPS: Final = 1024
# Number of sums of a voxel: the number of points, the half steps along a, b and c, and their
# products aa, ab, ac, bb, bc and cc.
N_SUMS: Final = 10
# The two axes of each product sum (aa, ab, ac, bb, bc, cc), in the order of the sums.
_PAIRS: Final = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
# Maximum number of bricks in a scene; larger scenes have larger voxels.
_BRICKS_MOST: Final = 8_000_000
# Minimum number of points in a neighbourhood for a reliable normal.
POINTS_LEAST: Final = 16.0
# Maximum side of a voxel, as a share of the size of the scene.
_VOXEL_SHARE_MOST: Final = 0.05
# Initial numbers of rows and voxels in tables.
_ROWS_FIRST: Final = 2_048
_VOXELS_FIRST: Final = 131_072
# Maximum number of voxels from the centre of a neighbourhood to each side (9 x 9 x 9 voxels).
_REACH_MOST: Final = 4
# The plane of a region is refitted each time the region has grown by this share.
_REFIT_SHARE: Final = 0.2
# Maximum number of passes over the voxels of a region.
_SWEEPS_MOST: Final = 3
T = TypeVar("T", bound=np.generic)


@dataclass(frozen=True, kw_only=True)
class Neighbourhood:
    """The points from which a normal is computed.

    Attributes:
        shape: a cube, a sphere (`radius`), or the nearest voxels that together contain at least
            `n_points` points (`knn`).
        size_m: side of the cube, or radius of the sphere; not used by `knn`.
        n_points: minimum number of points for `knn`.
        voxel_m: side of a voxel.
    """

    shape: Literal["cube", "radius", "knn"]
    size_m: float
    n_points: int
    voxel_m: float

    def around(self) -> NDArray[np.int32]:
        """Return (o, 4): steps to the voxels of the neighbourhood, nearest first, and shells."""
        across = self.size_m / self.voxel_m
        reaches = {
            "cube": round(0.5 * (across - 1.0)),
            "radius": math.floor(across),
            "knn": _REACH_MOST,
        }
        reach = min(max(reaches[self.shape], 0), _REACH_MOST)
        axis = np.arange(-reach, reach + 1)
        steps = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
        squares = (steps**2).sum(axis=1)
        shell = np.abs(steps).max(axis=1)
        if self.shape == "radius":
            kept = squares <= max(across, 1.0) ** 2
            steps, squares, shell = steps[kept], squares[kept], shell[kept]
        order = np.lexsort([squares, shell])[1:]
        return np.column_stack([steps[order], shell[order]]).astype(np.int32)

    def width_voxels(self) -> float:
        """Return the width in voxels; its square is the number of voxels on a surface."""
        if self.shape == "knn":
            return 3.0
        return 2.0 * float(np.abs(self.around()[:, :3]).max(initial=0)) + 1.0

    def with_voxels(self, voxel_m: float) -> Neighbourhood:
        """Return the neighbourhood with voxels of another size, scaled by the same factor."""
        return replace(self, voxel_m=voxel_m, size_m=self.size_m * (voxel_m / self.voxel_m))


@dataclass(frozen=True, kw_only=True)
class VoxelTable:
    """The occupied voxels of a cloud, numbered by position.

    Attributes:
        basis: (3, 3) rows e1, e2 and up, the axes of the voxels.
        low_m: (3,) lower corner of the first voxel, as offsets in the (e1, e2, up) frame.
        voxel_m: side of a voxel.
        bricks: (a, b, c) int32 row of each brick in `numbers`; -1 for bricks without points.
        numbers: (rows, VOXELS) int32 number of each voxel; -1 for voxels without points.
        places: (m, 3) int32 position of each voxel along e1, e2 and up.
        sums: (m, N_SUMS) int64 moments.
    """

    basis: NDArray[np.float64]
    low_m: NDArray[np.float64]
    voxel_m: float
    bricks: NDArray[np.int32]
    numbers: NDArray[np.int32]
    places: NDArray[np.int32]
    sums: NDArray[np.int64]

    @classmethod
    def over(cls, cloud: PreparedCloud, voxel_m: float) -> VoxelTable:
        """Sum the points of a cloud in voxels over its box; enlarge voxels if there are too many.

        Each part of the pass has its own tables, which are merged afterwards.
        """
        brick_m3 = float(np.prod(cloud.extent_m + BRICK_SIDE * voxel_m)) / _BRICKS_MOST
        voxel_m = max(voxel_m, math.cbrt(brick_m3) / BRICK_SIDE)
        frame = _frame(cloud.basis, cloud.low_m, voxel_m)
        a, b, c = np.ceil(cloud.extent_m / (BRICK_SIDE * voxel_m)).astype(int).tolist()
        shape = (a, b, c)
        n_bricks = math.prod(shape)
        tables = [
            (
                np.full(n_bricks, -1, dtype=np.int32),
                np.zeros((_ROWS_FIRST, VOXELS), dtype=np.int32),
                np.zeros((_VOXELS_FIRST, N_SUMS), dtype=np.int64),
                np.zeros(2, dtype=np.int64),
            )
            for _ in range(cloud.parts)
        ]

        def gather(part: int, piece: slice) -> None:
            points, start = piece_of(cloud.points, piece), 0
            bricks, numbers, sums, n_used = tables[part]
            while start < len(points.x):
                numbers = _with_room(numbers, int(n_used[0]), BLOCK_POINTS)
                sums = _with_room(sums, int(n_used[1]), BLOCK_POINTS)
                start = gather_moments(points, start, frame, shape, bricks, numbers, sums, n_used)
            tables[part] = (bricks, numbers, sums, n_used)

        each_part(len(cloud.claims), cloud.parts, gather)
        # Number the voxels by position, so that numbers depend neither on threads nor on the order
        # of points.
        occupied = np.flatnonzero(np.max([table[0] for table in tables], axis=0) >= 0)
        bricks = np.full(n_bricks, -1, dtype=np.int32)
        bricks[occupied] = np.arange(len(occupied), dtype=np.int32)
        held = np.zeros(len(occupied) * VOXELS, dtype=bool)
        met = []
        for own_bricks, own_numbers, own_sums, n_used in tables:
            known = np.flatnonzero(own_bricks >= 0)
            rows = np.empty(len(known), dtype=np.int64)
            rows[own_bricks[known]] = bricks[known]
            own = own_numbers[: n_used[0]].ravel()
            used = np.flatnonzero(own >= 0)
            keys = rows[used // VOXELS] * VOXELS + used % VOXELS
            held[keys] = True
            met.append((keys, own_sums[own[used]]))
        filled = np.flatnonzero(held)
        numbers = np.full(len(held), -1, dtype=np.int32)
        numbers[filled] = np.arange(len(filled), dtype=np.int32)
        sums = np.zeros((len(filled), N_SUMS), dtype=np.int64)
        for keys, own_sums in met:
            sums[numbers[keys]] += own_sums
        corners = np.stack(np.unravel_index(occupied, shape), axis=1) * BRICK_SIDE
        within = np.stack(np.unravel_index(filled % VOXELS, (BRICK_SIDE,) * 3), axis=1)
        return cls(
            basis=cloud.basis,
            low_m=cloud.low_m,
            voxel_m=voxel_m,
            bricks=bricks.reshape(shape),
            numbers=numbers.reshape(-1, VOXELS),
            places=(corners[filled // VOXELS] + within).astype(np.int32),
            sums=sums,
        )

    def coarser(self, member: NDArray[np.int64]) -> tuple[VoxelTable, NDArray[np.int64]]:
        """Merge voxels (k,) into voxels twice as wide; return these, and their indices (k,)."""
        places, odd = np.divmod(self.places[member].astype(np.int64), 2)
        shape = tuple(-(-size // 2) for size in self.bricks.shape)
        brick, within = np.divmod(places, BRICK_SIDE)
        brick_key = np.ravel_multi_index(tuple(brick.T), shape)
        voxel = np.ravel_multi_index(tuple(within.T), (BRICK_SIDE,) * 3)
        keys, first, of_member = np.unique(
            brick_key * VOXELS + voxel, return_index=True, return_inverse=True
        )
        occupied, rows = np.unique(keys // VOXELS, return_inverse=True)
        bricks = np.full(math.prod(shape), -1, dtype=np.int32)
        bricks[occupied] = np.arange(len(occupied), dtype=np.int32)
        numbers = np.full((len(occupied), VOXELS), -1, dtype=np.int32)
        numbers[rows, keys % VOXELS] = np.arange(len(keys), dtype=np.int32)
        # In the larger voxel, half steps are twice as long and are counted from its centre.
        moved = _moved(self.sums[member], (2 * odd - 1) * HALF_STEPS)
        moved *= 0.5 ** np.array([0, 1, 1, 1, 2, 2, 2, 2, 2, 2])
        sums = np.rint(group_sums(moved, of_member, len(keys))).astype(np.int64)
        wider = replace(
            self,
            voxel_m=2.0 * self.voxel_m,
            bricks=bricks.reshape(shape),
            numbers=numbers,
            places=places[first].astype(np.int32),
            sums=sums,
        )
        return wider, of_member

    def sums_of(self, regions: NDArray[np.int32], n_regions: int) -> NDArray[np.float64]:
        """Return moments (r, N_SUMS) of regions relative to the grid's corner, in voxels."""
        held = np.flatnonzero(regions >= 0)
        unit = 1.0 / (2 * HALF_STEPS)
        moved = _moved(self.sums[held], (2 * self.places[held] + 1) * HALF_STEPS)
        moved *= unit ** np.array([0, 1, 1, 1, 2, 2, 2, 2, 2, 2])
        return group_sums(moved, regions[held], n_regions)

    def centroids(self) -> NDArray[np.float64]:
        """Return centroids (m, 3) of voxels along e1, e2 and up, metres from the origin."""
        half_steps = self.sums[:, 1:4] / self.sums[:, :1]
        middles = self.places + 0.5 + half_steps / (2 * HALF_STEPS)
        return self.low_m + self.voxel_m * middles

    def voxel_of(self, points: BlockedPoints) -> NDArray[np.int32]:
        """Return the voxels (n,) of points; -1 for points in no voxel."""
        found = np.empty(len(points.x), dtype=np.int32)
        frame = _frame(self.basis, self.low_m, self.voxel_m)
        find_voxels(points, frame, self.bricks, self.numbers, found)
        return found


def _frame(
    basis: NDArray[np.float64], low_m: NDArray[np.float64], voxel_m: float
) -> NDArray[np.float32]:
    """Return F (3, 4); the position of an offset p is `F[:, :3] @ p - F[:, 3]`, in voxels."""
    return (np.column_stack([basis, low_m]) / voxel_m).astype(np.float32, order="C")


def _with_room(values: NDArray[T], n_used: int, n_free: int) -> NDArray[T]:
    if n_used + n_free <= len(values):
        return values
    return np.concatenate([values, np.zeros_like(values)])


def _moved(sums: NDArray[np.int64], shift: NDArray[np.integer[Any]]) -> NDArray[np.float64]:
    """Return the moments (k, N_SUMS) about origins displaced by -shift (k, 3)."""
    number, linear, away = sums[:, 0], sums[:, 1:4], shift.astype(np.float64)
    columns = [number, *(linear + number[:, None] * away).T]
    for k, (i, j) in enumerate(_PAIRS):
        mixed = away[:, i] * linear[:, j] + away[:, j] * linear[:, i]
        columns.append(sums[:, 4 + k] + mixed + number * away[:, i] * away[:, j])
    return np.stack(columns, axis=1)


@dataclass(frozen=True, kw_only=True)
class SurfaceVoxels:
    """Voxels and the planes of their neighbourhoods.

    Attributes:
        neighbourhood: neighbourhood used for normals; its voxels may be larger than requested.
        table: the voxels.
        normals: (m, 3) float32 normals of the neighbourhoods along e1, e2 and up, with arbitrary
            sign.
        spreads: (m, 3) float32 standard deviations of the points of the neighbourhood, in sides of
            a voxel: across its plane, and along the two axes of the plane.
    """

    neighbourhood: Neighbourhood
    table: VoxelTable
    normals: NDArray[np.float32]
    spreads: NDArray[np.float32]

    @classmethod
    def of(cls, table: VoxelTable, wanted: Neighbourhood, *, parts: int) -> SurfaceVoxels:
        """Fit a plane to the neighbourhood of each voxel."""
        neighbourhood = wanted.with_voxels(table.voxel_m)
        places, around = table.places, neighbourhood.around()
        normals, spreads = np.empty((2, len(places), 3), dtype=np.float32)
        # Number of points at which a knn neighbourhood is complete; other neighbourhoods use all
        # voxels.
        enough = neighbourhood.n_points if neighbourhood.shape == "knn" else 2**62

        def fit(_part: int, piece: slice) -> None:
            tables = (table.bricks, table.numbers, table.sums)
            own = (normals[piece], spreads[piece])
            fit_neighbourhoods(places[piece], piece.start, *tables, around, enough, *own)

        each_part(len(places), parts, fit)
        return cls(neighbourhood=neighbourhood, table=table, normals=normals, spreads=spreads)

    @property
    def counts(self) -> NDArray[np.int64]:
        """Return the numbers of points (m,) in voxels."""
        return self.table.sums[:, 0]


def surface_voxels(cloud: PreparedCloud, wanted: Neighbourhood) -> SurfaceVoxels:
    """Sum a cloud in voxels, and fit a plane to the neighbourhood of each voxel.

    If the cloud is so sparse that neighbourhoods would have too few points, voxels and
    neighbourhoods are larger than requested.
    """
    sample = cloud.sample
    placed = np.floor((sample.offsets_m @ cloud.basis.T - cloud.low_m) / wanted.voxel_m)
    inside = ((placed >= 0) & (placed * wanted.voxel_m < cloud.extent_m)).all(axis=1)
    shape = np.ceil(cloud.extent_m / wanted.voxel_m).astype(np.int64) + 1
    keys = np.sort(np.ravel_multi_index(tuple(placed[inside].astype(np.int64).T), tuple(shape)))
    counts = np.diff(np.flatnonzero(np.diff(keys, prepend=-1, append=-1)))
    # Mean number of other sample points in the voxel of a sample point.
    others = float((counts * (counts - 1)).sum()) / max(1, len(sample.index))
    in_neighbourhood = others * sample.n_represented * wanted.width_voxels() ** 2
    voxel_m = wanted.voxel_m * max(1.0, math.sqrt(POINTS_LEAST / max(in_neighbourhood, 1e-9)))
    most_m = max(wanted.voxel_m, _VOXEL_SHARE_MOST * float(cloud.extent_m.max()))
    table = VoxelTable.over(cloud, min(voxel_m, most_m))
    return SurfaceVoxels.of(table, wanted, parts=cloud.parts)


@kernel_part
def _place_block(
    points: BlockedPoints, start: int, frame: NDArray[np.float32], places: NDArray[np.float32]
) -> int:
    """Set the positions (3, BLOCK_POINTS), in voxels, of a block's points; return their number.

    The loops have no branches, and each writes to one array, so that the compiler can vectorise
    them.
    """
    stop = min(start + BLOCK_POINTS, points.x.size)
    xs, ys, zs = points.x[start:stop], points.y[start:stop], points.z[start:stop]
    for axis in range(3):
        a, b, c, d = frame[axis, 0], frame[axis, 1], frame[axis, 2], frame[axis, 3]
        own = places[axis]
        for i in range(xs.size):
            own[i] = a * xs[i] + b * ys[i] + c * zs[i] - d
    return xs.size


@kernel_part
def _set_keys(
    places: NDArray[np.float32], shape: tuple[int, int, int], keys: NDArray[np.int64]
) -> None:
    """Set keys (BLOCK_POINTS,): brick * VOXELS + voxel in the brick; -1 outside the grid."""
    zero, low = np.float32(0.0), np.int32(BRICK_SIDE - 1)
    top_a = np.float32(shape[0] * BRICK_SIDE)
    top_b = np.float32(shape[1] * BRICK_SIDE)
    top_c = np.float32(shape[2] * BRICK_SIDE)
    n_b, n_c, side = np.int32(shape[1]), np.int32(shape[2]), np.int32(BRICK_SIDE)
    voxels, nowhere = np.int64(VOXELS), np.int64(-1)
    for i in range(keys.size):
        a, b, c = places[0, i], places[1, i], places[2, i]
        within = (a >= zero) & (a < top_a) & (b >= zero) & (b < top_b)
        within = within & (c >= zero) & (c < top_c)
        p = np.int32(a if within else zero)
        q = np.int32(b if within else zero)
        r = np.int32(c if within else zero)
        # A brick has eight voxels along each side, so the position in it has three bits per axis.
        brick = np.int32(((p >> np.int32(3)) * n_b + (q >> np.int32(3))) * n_c + (r >> np.int32(3)))
        voxel = np.int32(((p & low) * side + (q & low)) * side + (r & low))
        keys[i] = brick * voxels + voxel if within else nowhere


@kernel_part
def _voxel(
    key: int, bricks: NDArray[np.int32], numbers: NDArray[np.int32], n_used: NDArray[np.int64]
) -> int:
    brick, voxel = key // VOXELS, key % VOXELS
    row = bricks[brick]
    if row < 0:
        row = np.int32(n_used[0])
        n_used[0] += 1
        bricks[brick] = row
        numbers[row, :] = -1
    number = numbers[row, voxel]
    if number < 0:
        number = np.int32(n_used[1])
        n_used[1] += 1
        numbers[row, voxel] = number
    return int(number)


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
    """Add points to the moments of their voxels, and new voxels to the tables until these are full.

    Consecutive points of a scan are often in the same voxel, so sums are added to the table only
    when the voxel changes.

    Args:
        points: (n,) offsets in blocks.
        start: first point, at the start of a block.
        frame: (3, 4) transform from an offset p to a position in voxels: `frame[:, :3] @ p -
            frame[:, 3]`.
        shape: numbers of bricks along a, b and c.
        bricks: (a * b * c,) row of each brick in `numbers`; -1 if not yet assigned.
        numbers: (rows, VOXELS) number of each voxel; -1 if not yet assigned.
        sums: (voxels, N_SUMS) updated.
        n_used: numbers of rows and voxels in use.

    Returns:
        The index of the first point that was not added, or the number of points.
    """
    keys = np.empty(BLOCK_POINTS, dtype=np.int64)
    places = np.zeros((3, BLOCK_POINTS), dtype=np.float32)
    fine, one, middle = np.float32(HALF_STEPS), np.int64(1), np.int64(HALF_STEPS - 1)
    while start < points.x.size:
        if n_used[0] + BLOCK_POINTS > numbers.shape[0] or n_used[1] + BLOCK_POINTS > sums.shape[0]:
            return start
        count = _place_block(points, start, frame, places)
        _set_keys(places, shape, keys)
        first = 0
        while first < count:
            last, key = first + 1, keys[first]
            while last < count and keys[last] == key:
                last += 1
            if key >= 0:
                k = _voxel(key, bricks, numbers, n_used)
                sums[k, 0] += last - first
                sa = sb = sc = aa = ab = ac = bb = bc = cc = np.int64(0)
                for i in range(first, last):
                    p, q, r = places[0, i], places[1, i], places[2, i]
                    a = (np.int64((p - np.float32(np.int32(p))) * fine) << one) - middle
                    b = (np.int64((q - np.float32(np.int32(q))) * fine) << one) - middle
                    c = (np.int64((r - np.float32(np.int32(r))) * fine) << one) - middle
                    sa, sb, sc = sa + a, sb + b, sc + c
                    aa, ab, ac = aa + a * a, ab + a * b, ac + a * c
                    bb, bc, cc = bb + b * b, bc + b * c, cc + c * c
                total = (sa, sb, sc, aa, ab, ac, bb, bc, cc)
                for place in range(9):
                    sums[k, 1 + place] += total[place]
            first = last
        start += BLOCK_POINTS
    return points.x.size


@compiled
def find_voxels(
    points: BlockedPoints,
    frame: NDArray[np.float32],
    bricks: NDArray[np.int32],
    numbers: NDArray[np.int32],
    found: NDArray[np.int32],
) -> None:
    """Set `found` (n,) to the voxel of each point; -1 for points in no voxel."""
    keys = np.empty(BLOCK_POINTS, dtype=np.int64)
    places = np.zeros((3, BLOCK_POINTS), dtype=np.float32)
    flat = bricks.reshape(bricks.size)
    for start in range(0, points.x.size, BLOCK_POINTS):
        count = _place_block(points, start, frame, places)
        _set_keys(places, bricks.shape, keys)
        for i in range(count):
            row = flat[keys[i] // VOXELS] if keys[i] >= 0 else -1
            found[start + i] = numbers[row, keys[i] % VOXELS] if row >= 0 else -1


@kernel_part
def _voxel_at(a: int, b: int, c: int, bricks: NDArray[np.int32], numbers: NDArray[np.int32]) -> int:
    if a < 0 or b < 0 or c < 0:
        return -1
    p, q, r = a >> 3, b >> 3, c >> 3
    if p >= bricks.shape[0] or q >= bricks.shape[1] or r >= bricks.shape[2]:
        return -1
    brick = bricks[p, q, r]
    if brick < 0:
        return -1
    return int(numbers[brick, ((a & 7) * BRICK_SIDE + (b & 7)) * BRICK_SIDE + (c & 7)])


@kernel_part
def _add_moments(
    total: NDArray[np.float64], sums: NDArray[np.int64], k: int, at: tuple[float, float, float]
) -> None:
    """Add the moments of voxel k, whose centre is `at`, to `total` (10,), in voxels."""
    n, (a, b, c) = float(sums[k, 0]), at
    unit = 1.0 / (2 * HALF_STEPS)
    sa, sb, sc = sums[k, 1] * unit, sums[k, 2] * unit, sums[k, 3] * unit
    square = unit * unit
    total[0] += n
    total[1] += n * a + sa
    total[2] += n * b + sb
    total[3] += n * c + sc
    total[4] += n * a * a + 2.0 * a * sa + sums[k, 4] * square
    total[5] += n * a * b + a * sb + b * sa + sums[k, 5] * square
    total[6] += n * a * c + a * sc + c * sa + sums[k, 6] * square
    total[7] += n * b * b + 2.0 * b * sb + sums[k, 7] * square
    total[8] += n * b * c + b * sc + c * sb + sums[k, 8] * square
    total[9] += n * c * c + 2.0 * c * sc + sums[k, 9] * square


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
        places: (m, 3) positions of the voxels.
        first: number of the first of these voxels.
        bricks: (a, b, c) number of each brick.
        numbers: (bricks, VOXELS) number of each voxel.
        sums: (n, N_SUMS) moments of all voxels.
        around: (o, 4) steps to the voxels of a neighbourhood, sorted by distance, and their shells.
        enough: a neighbourhood ends with the shell in which it reaches this number of points.
        normals: (m, 3) output, with arbitrary sign.
        spreads: (m, 3) output, standard deviations across the plane and along its two axes, in
            sides of a voxel; the first is infinite if there are fewer than three points.
    """
    total, plane = np.empty(10), np.empty(9)
    for i in range(places.shape[0]):
        a, b, c = places[i, 0], places[i, 1], places[i, 2]
        total[:] = 0.0
        _add_moments(total, sums, first + i, (0.0, 0.0, 0.0))
        shell = 0
        for j in range(around.shape[0]):
            if around[j, 3] != shell:
                if total[0] >= enough:
                    break
                shell = around[j, 3]
            da, db, dc = around[j, 0], around[j, 1], around[j, 2]
            k = _voxel_at(a + da, b + db, c + dc, bricks, numbers)
            if k >= 0:
                _add_moments(total, sums, k, (float(da), float(db), float(dc)))
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
    """Grow regions of neighbouring voxels that have similar normals and are near a common plane.

    The plane is fitted to all points of the region and refitted as the region grows. When no more
    voxels are added, all neighbours of the region are tested again with the last plane.

    Args:
        places: (n, 3) positions of voxels.
        bricks: (a, b, c) number of each brick.
        numbers: (bricks, VOXELS) number of each voxel.
        sums: (n, N_SUMS) moments.
        normals: (n, 3) normals of the neighbourhoods.
        seeds: (s,) voxels that may belong to a region, in the order in which they are used as
            seeds.
        limits: smallest cosine of the angle between normals, and largest distance from the plane,
            in sides of a voxel.
        regions: (n,) -2 for voxels that may be added to a region; set to the region.

    Returns:
        The number of regions.
    """
    cosine, distance = limits[0], limits[1]
    queue = np.empty(seeds.size, dtype=np.int32)
    total, plane = np.empty(10), np.empty(9)
    n_regions = 0
    unit = 1.0 / (2 * HALF_STEPS)
    for s in range(seeds.size):
        seed = seeds[s]
        if regions[seed] != -2:
            continue
        regions[seed] = n_regions
        queue[0] = seed
        length = 1
        # Compute moments relative to the seed, so that no precision is lost for regions far from
        # the corner of the box.
        oa, ob, oc = places[seed, 0], places[seed, 1], places[seed, 2]
        total[:] = 0.0
        _add_moments(total, sums, seed, (0.0, 0.0, 0.0))
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
                            k = _voxel_at(pa, pb, pc, bricks, numbers)
                            if k < 0 or regions[k] != -2:
                                continue
                            turn = (
                                plane[0] * normals[k, 0]
                                + plane[1] * normals[k, 1]
                                + plane[2] * normals[k, 2]
                            )
                            if abs(turn) < cosine:
                                continue
                            per = unit / sums[k, 0]
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
                            _add_moments(total, sums, k, at)
                if length >= refit:
                    flattest(total, plane)
                    refit = int((1.0 + _REFIT_SHARE) * length) + 1
            # Test all neighbours again: earlier planes may have excluded voxels that are near the
            # last one.
            if length == before:
                break
            if length >= 8:
                flattest(total, plane)
        n_regions += 1
    return n_regions
