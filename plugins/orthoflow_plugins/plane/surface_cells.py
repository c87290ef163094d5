"""Cells that hold the points of a cloud as moments, and the plane of each one's neighbourhood.

Region growing asks for the neighbours of every point. Cells make that cheap: one pass adds each
point to ten sums of its cell, and the sums of neighbouring cells give the plane through all their
points exactly, without the points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.cell_kernels import (
    N_SUMS,
    STEPS_PER_CELL,
    claim_cells,
    find_cells,
    gather_cells,
    merge_cells,
)
from orthoflow.geometry.point_kernels import (
    BLOCK_POINTS,
    BlockedPoints,
    PlanGrid,
    each_part,
    piece_of,
    plan_frame,
)
from orthoflow.geometry.region_kernels import fit_neighbourhoods
from orthoflow.geometry.voxel_kernels import BRICK_SIDE
from orthoflow_plugins.plane.remainders import Remainder
from orthoflow_plugins.plane.voxels import coarsened, with_room

Shape = Literal["cube", "radius", "knn"]

# Points a neighbourhood should hold where the cloud is thin, so that its normal means something.
POINTS_LEAST: Final = 16.0
# A cell is no larger than this share of the scene.
_CELL_SHARE_MOST: Final = 0.05
# Rows and cells that tables begin with.
_ROWS_FIRST: Final = 4_096
_CELLS_FIRST: Final = 131_072
# A neighbourhood reaches this many cells each way at most: 9 x 9 x 9.
_REACH_MOST: Final = 4


@dataclass(frozen=True, kw_only=True)
class Neighbourhood:
    """From which points the normal at a place is taken.

    Attributes:
        shape: a cube, a sphere, or the nearest cells that hold `n_points`.
        size_m: side of the cube, radius of the sphere; not used by `knn`.
        n_points: see above.
        cell_m: side of a cell.
    """

    shape: Shape
    size_m: float
    n_points: int
    cell_m: float

    def around(self) -> NDArray[np.int32]:
        """(o, 4) steps to the cells of the neighbourhood, near ones first, and their shell."""
        if self.shape == "cube":
            reach = round(0.5 * (self.size_m / self.cell_m - 1.0))
        elif self.shape == "radius":
            reach = math.floor(self.size_m / self.cell_m)
        else:
            reach = _REACH_MOST
        reach = min(max(reach, 0), _REACH_MOST)
        axis = np.arange(-reach, reach + 1)
        steps = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
        squares = (steps**2).sum(axis=1)
        shell = np.abs(steps).max(axis=1)
        if self.shape == "radius":
            kept = squares <= max(self.size_m / self.cell_m, 1.0) ** 2
            steps, squares, shell = steps[kept], squares[kept], shell[kept]
        order = np.lexsort([squares, shell])[1:]
        return np.column_stack([steps[order], shell[order]]).astype(np.int32)

    def width_cells(self) -> float:
        """Cells across, of which the neighbourhood of a surface has the square."""
        if self.shape == "knn":
            return 3.0
        return 2.0 * float(np.abs(self.around()[:, :3]).max(initial=0)) + 1.0

    @property
    def enough(self) -> int:
        """Points with which a neighbourhood ends; the others take all their cells."""
        return self.n_points if self.shape == "knn" else 2**62


@dataclass(frozen=True, kw_only=True)
class SurfaceCells:
    """The cells of a cloud that have points.

    Attributes:
        neighbourhood: which points make a normal; its cells are those used, which may be larger
            than the ones asked for.
        grid: axes, corner and side of the cells.
        frame: (3, 4) float32 cell of an offset: `frame @ p - frame[:, 3]`.
        bricks: (a, b, c) int32 row of each brick in `numbers`, -1 without points.
        numbers: (rows, voxels) int32 number of each cell, -1 without points.
        places: (m, 3) int32 where cells lie along e1, e2, up.
        sums: (m, N_SUMS) int64 moments, see `cell_kernels`.
        normals: (m, 3) float32 along e1, e2, up, of the neighbourhoods; either side.
        spreads: (m, 3) float32 deviation from the neighbourhood's plane and extents along it, in
            sides of a cell.
    """

    neighbourhood: Neighbourhood
    grid: PlanGrid
    frame: NDArray[np.float32]
    bricks: NDArray[np.int32]
    numbers: NDArray[np.int32]
    places: NDArray[np.int32]
    sums: NDArray[np.int64]
    normals: NDArray[np.float32]
    spreads: NDArray[np.float32]

    @property
    def counts(self) -> NDArray[np.int64]:
        """(m,) points of each cell."""
        return self.sums[:, 0]

    def centroids(self) -> NDArray[np.float64]:
        """(m, 3) mean of each cell's points along e1, e2, up; metres in the offsets' frame."""
        steps = self.sums[:, 1:4] / self.counts[:, None]
        middles = self.places + 0.5 + (steps + 0.5) / STEPS_PER_CELL
        centroids: NDArray[np.float64] = self.grid.low_m + self.grid.cell_m * middles
        return centroids

    def cell_of(self, points: BlockedPoints) -> NDArray[np.int32]:
        """(n,) cell of each point, -1 for none."""
        found = np.empty(len(points.x), dtype=np.int32)
        find_cells(points, self.frame, self.bricks, self.numbers, found)
        return found

    def claim(self, whole: Remainder, owners: NDArray[np.int8]) -> None:
        """Give the points of a cloud to the planes that own (m,) their cells."""

        def give(_part: int, piece: slice) -> None:
            points = piece_of(whole.points, piece)
            claim_cells(points, self.frame, self.bricks, self.numbers, owners, whole.claims[piece])

        each_part(len(whole.claims), whole.parts, give)


def surface_cells(remainder: Remainder, wanted: Neighbourhood) -> SurfaceCells:
    """Sum a cloud into cells, and fit a plane to the neighbourhood of each.

    Where the cloud is so thin that neighbourhoods would hold too few points, cells and
    neighbourhoods are larger than what is wanted.
    """
    grid = _cell_grid(remainder, wanted)
    scale = grid.cell_m / wanted.cell_m
    used = replace(wanted, cell_m=grid.cell_m, size_m=wanted.size_m * scale)
    table = _in_order(_gathered(remainder, grid))
    bricks = table.bricks.reshape(-(-np.array(grid.shape) // BRICK_SIDE))
    places = _places(bricks, table.numbers)
    cells = SurfaceCells(
        neighbourhood=used,
        grid=grid,
        frame=plan_frame(grid),
        bricks=bricks,
        numbers=table.numbers,
        places=places,
        sums=table.sums,
        normals=np.empty((len(places), 3), dtype=np.float32),
        spreads=np.empty((len(places), 3), dtype=np.float32),
    )
    return with_normals(cells, parts=remainder.parts)


def with_normals(cells: SurfaceCells, *, parts: int) -> SurfaceCells:
    """Fit a plane to the neighbourhood of each cell, which sets normals and spreads."""
    around = cells.neighbourhood.around()

    def fit(_part: int, piece: slice) -> None:
        fit_neighbourhoods(
            cells.places[piece],
            piece.start,
            cells.bricks,
            cells.numbers,
            cells.sums,
            around,
            cells.neighbourhood.enough,
            cells.normals[piece],
            cells.spreads[piece],
        )

    each_part(len(cells.places), parts, fit)
    return cells


@dataclass(kw_only=True)
class _Table:
    """Cells as one part of the pass met them; arrays have room for more than is used."""

    bricks: NDArray[np.int32]
    numbers: NDArray[np.int32]
    sums: NDArray[np.int64]
    n_used: NDArray[np.int64]

    def make_room(self, n_rows: int, n_cells: int) -> None:
        """Enlarge the tables if fewer rows and cells than these are free."""
        self.numbers = with_room(self.numbers, int(self.n_used[0]), n_rows)
        self.sums = with_room(self.sums, int(self.n_used[1]), n_cells)


def _cell_grid(remainder: Remainder, wanted: Neighbourhood) -> PlanGrid:
    """Lay cells over the robust box of which a neighbourhood holds enough points."""
    grid, sample = remainder.grid, remainder.sample
    extent_m = np.array(grid.shape) * grid.cell_m
    placed = np.floor((sample.offsets_m @ grid.basis.T - grid.low_m) / wanted.cell_m)
    inside = ((placed >= 0) & (placed * wanted.cell_m < extent_m)).all(axis=1)
    shape = np.ceil(extent_m / wanted.cell_m).astype(np.int64) + 1
    keys = np.sort(np.ravel_multi_index(tuple(placed[inside].astype(np.int64).T), tuple(shape)))
    edges = np.flatnonzero(np.diff(keys, prepend=-1, append=-1))
    counts = np.diff(edges)
    # How many others of the sample share a point's cell: chance alone shares no cell, however few.
    others = float((counts * (counts - 1)).sum()) / max(1, len(sample.index))
    in_neighbourhood = others * sample.n_represented * wanted.width_cells() ** 2
    scale = math.sqrt(POINTS_LEAST / max(in_neighbourhood, 1e-9))
    cell_m = wanted.cell_m * scale if scale > 1.0 else wanted.cell_m
    cell_m = min(cell_m, max(wanted.cell_m, _CELL_SHARE_MOST * float(extent_m.max())))
    cell_m = coarsened(cell_m, extent_m)
    n_cells = np.maximum(1, np.ceil(extent_m / cell_m)).astype(int)
    return PlanGrid(
        basis=grid.basis,
        low_m=grid.low_m,
        cell_m=cell_m,
        shape=(int(n_cells[0]), int(n_cells[1]), int(n_cells[2])),
    )


def _gathered(remainder: Remainder, grid: PlanGrid) -> _Table:
    """Sum all points into cells, each part into tables of its own, which are then merged."""
    frame = plan_frame(grid)
    a, b, c = (-(-size // BRICK_SIDE) for size in grid.shape)
    tables = [
        _Table(
            bricks=np.full(a * b * c, -1, dtype=np.int32),
            numbers=np.zeros((_ROWS_FIRST, BRICK_SIDE**3), dtype=np.int32),
            sums=np.zeros((_CELLS_FIRST, N_SUMS), dtype=np.int64),
            n_used=np.zeros(2, dtype=np.int64),
        )
        for _ in range(remainder.parts)
    ]

    def gather(part: int, piece: slice) -> None:
        points, table, start = piece_of(remainder.points, piece), tables[part], 0
        while start < len(points.x):
            table.make_room(BLOCK_POINTS, BLOCK_POINTS)
            start = gather_cells(
                points, start, frame, (a, b, c), table.bricks, table.numbers, table.sums,
                table.n_used,
            )  # fmt: skip

    each_part(len(remainder.claims), remainder.parts, gather)
    whole, *others = tables
    for table in others:
        whole.make_room(int(table.n_used[0]), int(table.n_used[1]))
        merge_cells(
            table.bricks, table.numbers, table.sums,
            whole.bricks, whole.numbers, whole.sums, whole.n_used,
        )  # fmt: skip
    return whole


def _in_order(table: _Table) -> _Table:
    """Number rows and cells by place, so that neither threads nor the order of points show."""
    occupied = np.flatnonzero(table.bricks >= 0)
    numbers = table.numbers[table.bricks[occupied]]
    bricks = np.full(len(table.bricks), -1, dtype=np.int32)
    bricks[occupied] = np.arange(len(occupied), dtype=np.int32)
    filled = numbers >= 0
    met = numbers[filled]
    numbers[filled] = np.arange(len(met), dtype=np.int32)
    sums = np.take(table.sums, met, axis=0)
    return _Table(bricks=bricks, numbers=numbers, sums=sums, n_used=table.n_used)


def _places(bricks: NDArray[np.int32], numbers: NDArray[np.int32]) -> NDArray[np.int32]:
    """(m, 3) where the cells lie, in their order."""
    corners = np.argwhere(bricks >= 0).astype(np.int32) * np.int32(BRICK_SIDE)
    row, voxel = np.divmod(np.flatnonzero(numbers.reshape(-1) >= 0), BRICK_SIDE**3)
    within = np.column_stack(np.unravel_index(voxel, (BRICK_SIDE,) * 3)).astype(np.int32)
    places: NDArray[np.int32] = corners[row] + within
    return places
