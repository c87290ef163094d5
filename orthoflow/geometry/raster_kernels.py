"""Compiled passes that bin points into the cells of a raster.

A pass processes one chunk of the cloud after the other. `project_points` transforms a chunk; the
passes then run over the entries of the points inside, each thread on the cells it owns. Every cell
is therefore visited in the order of the points for any number of threads, and no result depends on
it, including sums of floats.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, inlined
from orthoflow.geometry.point_kernels import Offsets

# Cells are assigned to threads in runs of 2^17, some dozens of rows: a scan runs along columns or
# rows, and a thread that meets its own points in long runs is not slowed down by the others'.
_RUN_SHIFT: Final = 17
NO_POINT: Final = np.uint32(0xFFFFFFFF)
# One record per cell: a scan along columns accesses another row of the raster with every point, and
# the passes are limited by one cache line for each.
WINNER: Final = np.dtype([("depth_m", "f4"), ("square", "f4"), ("point", "u4"), ("n_points", "u4")])


class Target(NamedTuple):
    """The raster into which points are binned.

    Attributes:
        wall_from_offset: (3, 4) float64; rows give column, row and depth in metres of an offset.
        behind_m: smallest accepted depth.
        front_m: largest accepted depth.
        height: number of rows.
        width: number of columns.
    """

    wall_from_offset: NDArray[np.float64]
    behind_m: float
    front_m: float
    height: int
    width: int


class Entries(NamedTuple):
    """Points of one chunk that lie inside the raster, in order, (n,) each.

    Attributes:
        cells: int32, row * width + column.
        depths_m: float32.
        squares: float32, squared distance to the centre of the cell, in cells.
        points: uint32, index in the cloud.
    """

    cells: NDArray[np.int32]
    depths_m: NDArray[np.float32]
    squares: NDArray[np.float32]
    points: NDArray[np.uint32]


@compiled
def project_points(
    offsets: Offsets,
    target: Target,
    cells: NDArray[np.int32],
    depths_m: NDArray[np.float32],
    squares: NDArray[np.float32],
    first: int,
    end: int,
) -> None:
    """Set cell, depth and distance from the cell's centre of some points of a chunk.

    Both ends of the buffer are inside. A cell owns its left and upper edge.

    Args:
        offsets: of the chunk.
        target: the raster.
        cells: overwritten, -1 outside the raster and its buffer.
        depths_m: overwritten, as in `Entries`.
        squares: overwritten, as in `Entries`.
        first: first point to visit.
        end: the point after the last one.
    """
    m = target.wall_from_offset
    u0, u1, u2, u3 = m[0, 0], m[0, 1], m[0, 2], m[0, 3]
    v0, v1, v2, v3 = m[1, 0], m[1, 1], m[1, 2], m[1, 3]
    d0, d1, d2, d3 = m[2, 0], m[2, 1], m[2, 2], m[2, 3]
    x, y, z = offsets.x, offsets.y, offsets.z
    for k in range(first, end):
        # float64 on purpose: the pass is limited by memory, not by arithmetic.
        px, py, pz = np.float64(x[k]), np.float64(y[k]), np.float64(z[k])
        u = u0 * px + u1 * py + u2 * pz + u3
        v = v0 * px + v1 * py + v2 * pz + v3
        depth = d0 * px + d1 * py + d2 * pz + d3
        is_in_raster = 0.0 <= u < target.width and 0.0 <= v < target.height
        cells[k] = -1
        if is_in_raster and target.behind_m <= depth <= target.front_m:
            column, row = int(u), int(v)
            du, dv = u - column - 0.5, v - row - 0.5
            cells[k] = row * target.width + column
            depths_m[k], squares[k] = depth, du * du + dv * dv


@inlined
def is_own(cell, owners, owner):  # type: ignore[no-untyped-def]  # numba infers the types
    """Return whether a thread owns a cell; owners are a power of two."""
    return (cell >> _RUN_SHIFT) & (owners - 1) == owner


@compiled
def keep_topmost(entries: Entries, winners: NDArray[np.void], owners: int, owner: int) -> None:
    """Let the largest depth win; ties go to the point nearer the centre, then the lower index.

    Args:
        entries: one chunk.
        winners: (cells,) of `WINNER`, updated; depths start at minus infinity.
        owners: number of threads that share the cells, a power of two.
        owner: the thread whose cells to visit.
    """
    for k in range(entries.cells.size):
        cell = entries.cells[k]
        if not is_own(cell, owners, owner):
            continue
        winner = winners[cell]
        winner.n_points += np.uint32(1)
        depth, square = entries.depths_m[k], entries.squares[k]
        if depth > winner.depth_m or (depth == winner.depth_m and square < winner.square):
            winner.depth_m, winner.square, winner.point = depth, square, entries.points[k]


@compiled
def keep_nearest(entries: Entries, winners: NDArray[np.void], owners: int, owner: int) -> None:
    """Let the point nearest the centre of the cell win; ties go to the lower index.

    Args:
        entries: one chunk.
        winners: (cells,) of `WINNER`, updated; squares start at infinity.
        owners: number of threads that share the cells, a power of two.
        owner: the thread whose cells to visit.
    """
    for k in range(entries.cells.size):
        cell = entries.cells[k]
        if not is_own(cell, owners, owner):
            continue
        winner = winners[cell]
        winner.n_points += np.uint32(1)
        if entries.squares[k] < winner.square:
            winner.depth_m, winner.square = entries.depths_m[k], entries.squares[k]
            winner.point = entries.points[k]
