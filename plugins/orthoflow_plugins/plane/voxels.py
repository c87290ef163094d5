"""Voxels that hold the points of a cloud as moments, and the plane of each one's neighbourhood.

Region growing asks for the neighbours of every point. Voxels make that cheap: one pass adds each
point to ten sums of its voxel, and the sums of neighbouring voxels give the plane through all their
points exactly, without the points.

A cloud that is dense on one wall may have a point per decimetre on another: voxels that suit the
one leave crumbs on the other. Moments add up, so what is left is summed into wider voxels without
asking the points again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow_plugins.plane.cloud import PreparedCloud
from orthoflow_plugins.plane.kernels import (
    BLOCK_POINTS,
    BlockedPoints,
    PlanGrid,
    each_part,
    piece_of,
    plan_frame,
)
from orthoflow_plugins.plane.voxel_kernels import (
    BRICK_SIDE,
    N_SUMS,
    STEPS_PER_VOXEL,
    VOXELS,
    claim_voxels,
    coarsened,
    find_voxels,
    fit_neighbourhoods,
    gather_moments,
    merge_moments,
    voxel_places,
    with_room,
)

# Points a neighbourhood should hold where the cloud is thin, so that its normal means something.
POINTS_LEAST: Final = 16.0
# A voxel is no larger than this share of the scene.
_VOXEL_SHARE_MOST: Final = 0.05
# Rows and voxels that tables begin with.
_ROWS_FIRST: Final = 4_096
_VOXELS_FIRST: Final = 131_072
# A neighbourhood reaches this many voxels each way at most: 9 x 9 x 9.
_REACH_MOST: Final = 4
# The products that moments hold, as pairs of axes.
_PAIRS: Final = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


@dataclass(frozen=True, kw_only=True)
class Neighbourhood:
    """From which points the normal at a place is taken.

    Attributes:
        shape: a cube, a sphere, or the nearest voxels that hold `n_points`.
        size_m: side of the cube, radius of the sphere; not used by `knn`.
        n_points: see above.
        voxel_m: side of a voxel.
    """

    shape: Literal["cube", "radius", "knn"]
    size_m: float
    n_points: int
    voxel_m: float

    def around(self) -> NDArray[np.int32]:
        """(o, 4) steps to the voxels of the neighbourhood, near ones first, and their shell."""
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
        """Voxels across, of which the neighbourhood of a surface has the square."""
        if self.shape == "knn":
            return 3.0
        return 2.0 * float(np.abs(self.around()[:, :3]).max(initial=0)) + 1.0

    def with_voxels(self, voxel_m: float) -> Neighbourhood:
        """Return the same in voxels of another size."""
        return replace(self, voxel_m=voxel_m, size_m=self.size_m * (voxel_m / self.voxel_m))


@dataclass(frozen=True, kw_only=True)
class SurfaceVoxels:
    """The voxels of a cloud that have points.

    Attributes:
        neighbourhood: which points make a normal; its voxels are those used, which may be larger
            than the ones asked for.
        grid: axes, corner and side of the voxels.
        bricks: (a, b, c) int32 row of each brick in `numbers`, -1 without points.
        numbers: (rows, voxels) int32 number of each voxel, -1 without points.
        places: (m, 3) int32 where voxels lie along e1, e2, up.
        sums: (m, N_SUMS) int64 moments, see `voxel_kernels`.
        normals: (m, 3) float32 along e1, e2, up, of the neighbourhoods; either side.
        spreads: (m, 3) float32 deviation from the neighbourhood's plane and extents along it, in
            sides of a voxel.
    """

    neighbourhood: Neighbourhood
    grid: PlanGrid
    bricks: NDArray[np.int32]
    numbers: NDArray[np.int32]
    places: NDArray[np.int32]
    sums: NDArray[np.int64]
    normals: NDArray[np.float32]
    spreads: NDArray[np.float32]

    @classmethod
    def of(
        cls,
        neighbourhood: Neighbourhood,
        grid: PlanGrid,
        bricks: NDArray[np.int32],
        numbers: NDArray[np.int32],
        places: NDArray[np.int32],
        sums: NDArray[np.int64],
        *,
        parts: int,
    ) -> SurfaceVoxels:
        """Fit a plane to the neighbourhood of each voxel, in so many parts."""
        normals = np.empty((len(places), 3), dtype=np.float32)
        spreads = np.empty((len(places), 3), dtype=np.float32)
        around = neighbourhood.around()
        # Points with which a neighbourhood ends; the others take all their voxels.
        enough = neighbourhood.n_points if neighbourhood.shape == "knn" else 2**62

        def fit(_part: int, piece: slice) -> None:
            own, start = (normals[piece], spreads[piece]), piece.start
            fit_neighbourhoods(places[piece], start, bricks, numbers, sums, around, enough, *own)

        each_part(len(places), parts, fit)
        return cls(
            neighbourhood=neighbourhood,
            grid=grid,
            bricks=bricks,
            numbers=numbers,
            places=places,
            sums=sums,
            normals=normals,
            spreads=spreads,
        )

    @property
    def counts(self) -> NDArray[np.int64]:
        """(m,) points of each voxel."""
        return self.sums[:, 0]

    def centroids(self) -> NDArray[np.float64]:
        """(m, 3) mean of each voxel's points along e1, e2, up; metres in the offsets' frame."""
        steps = self.sums[:, 1:4] / self.counts[:, None]
        middles = self.places + 0.5 + (steps + 0.5) / STEPS_PER_VOXEL
        return self.grid.low_m + self.grid.cell_m * middles

    def voxel_of(self, points: BlockedPoints) -> NDArray[np.int32]:
        """(n,) voxel of each point, -1 for none."""
        found = np.empty(len(points.x), dtype=np.int32)
        find_voxels(points, plan_frame(self.grid), self.bricks, self.numbers, found)
        return found

    def claim(self, cloud: PreparedCloud, owners: NDArray[np.int8]) -> None:
        """Return the points of a cloud to the planes that own (m,) their voxels."""
        frame = plan_frame(self.grid)

        def give(_part: int, piece: slice) -> None:
            points = piece_of(cloud.points, piece)
            claim_voxels(points, frame, self.bricks, self.numbers, owners, cloud.claims[piece])

        each_part(len(cloud.claims), cloud.parts, give)


def surface_voxels(cloud: PreparedCloud, wanted: Neighbourhood) -> SurfaceVoxels:
    """Sum a cloud into voxels, and fit a plane to the neighbourhood of each.

    Where the cloud is so thin that neighbourhoods would hold too few points, voxels and
    neighbourhoods are larger than what is wanted.
    """
    grid = _voxel_grid(cloud, wanted)
    table = _gathered(cloud, grid)
    # Numbered by place, so that neither threads nor the order of points show.
    occupied = np.flatnonzero(table.bricks >= 0)
    numbers = table.numbers[table.bricks[occupied]]
    bricks = np.full(len(table.bricks), -1, dtype=np.int32)
    bricks[occupied] = np.arange(len(occupied), dtype=np.int32)
    filled = numbers >= 0
    met = numbers[filled]
    numbers[filled] = np.arange(len(met), dtype=np.int32)
    bricks = bricks.reshape(-(-np.array(grid.shape) // BRICK_SIDE))
    return SurfaceVoxels.of(
        wanted.with_voxels(grid.cell_m),
        grid,
        bricks,
        numbers,
        voxel_places(bricks >= 0, filled),
        np.take(table.sums, met, axis=0),
        parts=cloud.parts,
    )


def coarser(
    voxels: SurfaceVoxels, member: NDArray[np.int64]
) -> tuple[SurfaceVoxels, NDArray[np.int64]]:
    """Sum voxels (k,) into voxels twice as wide; gives those, and which one each is in."""
    places, odd = np.divmod(voxels.places[member].astype(np.int64), 2)
    a, b, c = (math.ceil(size / 2) for size in voxels.grid.shape)
    n_bricks = tuple(-(-size // BRICK_SIDE) for size in (a, b, c))
    brick, within = np.divmod(places, BRICK_SIDE)
    brick_key = np.ravel_multi_index(tuple(brick.T), n_bricks)
    voxel = np.ravel_multi_index(tuple(within.T), (BRICK_SIDE,) * 3)
    keys, first, of_member = np.unique(
        brick_key * VOXELS + voxel, return_index=True, return_inverse=True
    )
    occupied, rows = np.unique(keys // VOXELS, return_inverse=True)
    bricks = np.full(math.prod(n_bricks), -1, dtype=np.int32)
    bricks[occupied] = np.arange(len(occupied), dtype=np.int32)
    numbers = np.full((len(occupied), VOXELS), -1, dtype=np.int32)
    numbers[rows, keys % VOXELS] = np.arange(len(keys), dtype=np.int32)
    grid = replace(voxels.grid, cell_m=2.0 * voxels.grid.cell_m, shape=(a, b, c))
    wider = SurfaceVoxels.of(
        voxels.neighbourhood.with_voxels(grid.cell_m),
        grid,
        bricks.reshape(n_bricks),
        numbers,
        places[first].astype(np.int32),
        _summed(voxels.sums[member], odd, of_member, len(keys)),
        parts=1,
    )
    return wider, of_member


@dataclass(kw_only=True)
class _Table:
    """Voxels as one part of the pass met them; arrays have room for more than is used."""

    bricks: NDArray[np.int32]
    numbers: NDArray[np.int32]
    sums: NDArray[np.int64]
    n_used: NDArray[np.int64]

    def make_room(self, n_rows: int, n_voxels: int) -> None:
        """Enlarge the tables if fewer rows and voxels than these are free."""
        self.numbers = with_room(self.numbers, int(self.n_used[0]), n_rows)
        self.sums = with_room(self.sums, int(self.n_used[1]), n_voxels)


def _voxel_grid(cloud: PreparedCloud, wanted: Neighbourhood) -> PlanGrid:
    """Lay voxels over the robust box of which a neighbourhood holds enough points."""
    grid, sample = cloud.grid, cloud.sample
    extent_m = np.array(grid.shape) * grid.cell_m
    placed = np.floor((sample.offsets_m @ grid.basis.T - grid.low_m) / wanted.voxel_m)
    inside = ((placed >= 0) & (placed * wanted.voxel_m < extent_m)).all(axis=1)
    shape = np.ceil(extent_m / wanted.voxel_m).astype(np.int64) + 1
    keys = np.sort(np.ravel_multi_index(tuple(placed[inside].astype(np.int64).T), tuple(shape)))
    counts = np.diff(np.flatnonzero(np.diff(keys, prepend=-1, append=-1)))
    # How many others of the sample share a point's voxel: chance alone shares none, however few.
    others = float((counts * (counts - 1)).sum()) / max(1, len(sample.index))
    in_neighbourhood = others * sample.n_represented * wanted.width_voxels() ** 2
    scale = math.sqrt(POINTS_LEAST / max(in_neighbourhood, 1e-9))
    cell_m = wanted.voxel_m * scale if scale > 1.0 else wanted.voxel_m
    cell_m = min(cell_m, max(wanted.voxel_m, _VOXEL_SHARE_MOST * float(extent_m.max())))
    cell_m = coarsened(cell_m, extent_m)
    a, b, c = np.maximum(1, np.ceil(extent_m / cell_m)).astype(int).tolist()
    return replace(grid, cell_m=cell_m, shape=(a, b, c))


def _gathered(cloud: PreparedCloud, grid: PlanGrid) -> _Table:
    """Sum all points into voxels, each part into tables of its own, which are then merged."""
    frame = plan_frame(grid)
    a, b, c = (-(-size // BRICK_SIDE) for size in grid.shape)
    tables = [
        _Table(
            bricks=np.full(a * b * c, -1, dtype=np.int32),
            numbers=np.zeros((_ROWS_FIRST, VOXELS), dtype=np.int32),
            sums=np.zeros((_VOXELS_FIRST, N_SUMS), dtype=np.int64),
            n_used=np.zeros(2, dtype=np.int64),
        )
        for _ in range(cloud.parts)
    ]

    def gather(part: int, piece: slice) -> None:
        points, table, start = piece_of(cloud.points, piece), tables[part], 0
        while start < len(points.x):
            table.make_room(BLOCK_POINTS, BLOCK_POINTS)
            own = (table.bricks, table.numbers, table.sums, table.n_used)
            start = gather_moments(points, start, frame, (a, b, c), *own)

    each_part(len(cloud.claims), cloud.parts, gather)
    whole, *others = tables
    for table in others:
        whole.make_room(int(table.n_used[0]), int(table.n_used[1]))
        own = (whole.bricks, whole.numbers, whole.sums, whole.n_used)
        merge_moments(table.bricks, table.numbers, table.sums, *own)
    return whole


def _summed(
    sums: NDArray[np.int64], odd: NDArray[np.int64], owner: NDArray[np.int64], count: int
) -> NDArray[np.int64]:
    """(count, N_SUMS) moments of wider voxels: steps are twice as long, from their middle.

    Args:
        sums: (k, N_SUMS) moments of the voxels.
        odd: (k, 3) 1 where a voxel is the upper half of its wider voxel.
        owner: (k,) wider voxel of each.
        count: wider voxels.
    """
    number = sums[:, 0]
    shift = (2 * odd - 1) * (STEPS_PER_VOXEL // 4)
    linear = 0.5 * sums[:, 1:4]
    moved = [number, *(linear + number[:, None] * shift).T]
    for k, (i, j) in enumerate(_PAIRS):
        moved.append(
            0.25 * sums[:, 4 + k]
            + shift[:, i] * linear[:, j]
            + shift[:, j] * linear[:, i]
            + number * shift[:, i] * shift[:, j]
        )
    # Sums of halves and quarters of whole numbers are exact in 53 bits: the order does not show.
    totals = [np.bincount(owner, column, minlength=count) for column in moved]
    return np.rint(np.column_stack(totals)).astype(np.int64)
