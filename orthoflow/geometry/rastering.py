"""Binning of the points of a cloud into the raster of a wall.

The cloud is processed in chunks. `project_points` transforms a chunk. Passes then process the
points inside the raster; each thread processes the points of the cells assigned to it. The points
of each cell are therefore processed in order, and results, including sums of floats, do not depend
on the number of threads.

This module loads numba, so methods import it inside functions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, inlined
from orthoflow.geometry.frames import WallFrame
from orthoflow.geometry.slabs import BOXED_POINTS, OffsetPoints, Offsets, Slab, read_only
from orthoflow.geometry.threads import in_parts, in_threads

# Cells are assigned to threads in runs of 2^17, a few dozen rows. Consecutive points of a scan are
# in neighbouring columns or rows, and threads are faster if many consecutive points belong to the
# same thread.
_RUN_SHIFT: Final = 17
NO_POINT: Final = np.uint32(0xFFFFFFFF)
# One record per cell, because consecutive points of a scan along columns are in different rows of
# the raster, so that each point needs at least one cache line.
WINNER: Final = np.dtype([("depth_m", "f4"), ("square", "f4"), ("point", "u4"), ("n_points", "u4")])


class Target(NamedTuple):
    """The raster into which points are binned.

    Attributes:
        wall_from_offset: (3, 4) float64 transform from offsets in metres to (column, row, depth in
            metres).
        behind_m: smallest depth, in metres.
        front_m: largest depth, in metres.
        height: number of rows.
        width: number of columns.
    """

    wall_from_offset: NDArray[np.float64]
    behind_m: float
    front_m: float
    height: int
    width: int


class Entries(NamedTuple):
    """Points of a chunk that are inside the raster, in order.

    Attributes:
        cells: (n,) int32 cell, row * width + column.
        depths_m: (n,) float32 depth in metres.
        squares: (n,) float32 squared distance to the centre of the cell, in cells.
        points: (n,) uint32 index in the cloud.
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
    """Compute the cell, depth and distance from the cell's centre for the points of a chunk.

    Depths equal to a limit are inside. A cell includes its left and upper edges.

    Args:
        offsets: offsets of the chunk.
        target: the raster.
        cells: output (see `Entries`); -1 for points outside the raster or the range of depths.
        depths_m: output (see `Entries`).
        squares: output (see `Entries`).
        first: index of the first point.
        end: index after the last point.
    """
    m = target.wall_from_offset
    u0, u1, u2, u3 = m[0, 0], m[0, 1], m[0, 2], m[0, 3]
    v0, v1, v2, v3 = m[1, 0], m[1, 1], m[1, 2], m[1, 3]
    d0, d1, d2, d3 = m[2, 0], m[2, 1], m[2, 2], m[2, 3]
    x, y, z = offsets.x, offsets.y, offsets.z
    for k in range(first, end):
        # Computing in float64 takes no extra time, because memory bandwidth limits the pass.
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
    """Return whether a cell belongs to a thread; the number of owners is a power of two."""
    return (cell >> _RUN_SHIFT) & (owners - 1) == owner


@compiled
def keep_topmost(entries: Entries, winners: NDArray[np.void], owners: int, owner: int) -> None:
    """Select the point of each cell with the largest depth, or the most central of several.

    Args:
        entries: points of one chunk; of equally near points, the first is used.
        winners: (cells,) of `WINNER`, updated; depths are initially minus infinity.
        owners: number of threads that share the cells, a power of two.
        owner: the thread whose cells are processed.
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
    """Select the point nearest to the centre of each cell, and of equally near ones, the first.

    Args:
        entries: points of one chunk.
        winners: (cells,) of `WINNER`, updated; squares are initially infinity.
        owners: number of threads that share the cells, a power of two.
        owner: the thread whose cells are processed.
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


# Number of points in a chunk, whose entries (16 MB) stay in the processor's cache between passes.
_CHUNK: Final = 1 << 20

# Gaps are filled from the nearest cells and from cells at most one cell farther away.
_BESIDE_GAPS_CELLS: Final = 2

_Value = TypeVar("_Value", bound=np.generic)


def wall_from_offset(frame: WallFrame, origin: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the transform (3, 4) from offsets in metres to (column, row, depth in metres).

    The difference between the two origins is computed in float64, so that no precision is lost with
    survey coordinates of 10^6 m.
    """
    frame.require_plane("a linear transform onto the raster")
    axes = np.vstack([frame.u_world / frame.gsd_m, frame.v_world / frame.gsd_m, frame.normal_world])
    # Adding 0.0 converts -0.0, which has different bits, to 0.0.
    return np.column_stack([axes, axes @ (origin - frame.origin_world) + 0.0])


def entries_inside(
    points: OffsetPoints,
    slab: Slab,
    *,
    threads: int,
    rows: slice | None = None,
    is_left_out: NDArray[np.bool_] | None = None,
) -> Iterator[Entries]:
    """Yield the points inside a slab in order, one chunk at a time.

    Blocks of points are not read if their bounding boxes are outside the slab.

    Args:
        points: points of the cloud.
        slab: slab of the wall.
        threads: number of threads.
        rows: required rows of the raster; points in other rows may be omitted. None for all rows.
        is_left_out: (n,) True for points to ignore; None to use all points.
    """
    frame = slab.frame
    target = Target(
        wall_from_offset=wall_from_offset(frame, points.origin),
        behind_m=-float(slab.behind_m),
        front_m=float(slab.front_m),
        height=frame.height,
        width=frame.width,
    )
    x, y, z = read_only(points.x, points.y, points.z)
    cells = np.empty(min(_CHUNK, max(1, x.size)), dtype=np.int32)
    depths_m, squares = np.empty((2, cells.size), dtype=np.float32)
    for first, end in _runs(points, target, rows):
        chunk = Offsets(x[first:end], y[first:end], z[first:end])
        task = partial(project_points, chunk, target, cells, depths_m, squares)
        in_parts(task, end - first, threads=threads)
        is_inside = cells[: end - first] >= 0
        if is_left_out is not None:
            is_inside &= ~is_left_out[first:end]
        inside = np.flatnonzero(is_inside)
        points_inside = (inside + first).astype(np.uint32)
        yield Entries(cells[inside], depths_m[inside], squares[inside], points_inside)


def _runs(points: OffsetPoints, target: Target, rows: slice | None) -> Iterator[tuple[int, int]]:
    n_points, boxes_m = points.x.size, points.boxes_m
    if boxes_m is None:
        edges = np.array([[0, n_points]])
    else:
        may_hold = _may_hold_points(boxes_m.astype(np.float64), target, rows)
        steps = np.diff(np.concatenate([[False], may_hold, [False]]).astype(np.int8))
        ends = np.column_stack([np.flatnonzero(steps == 1), np.flatnonzero(steps == -1)])
        edges = np.minimum(ends * BOXED_POINTS, n_points)
    for begin, end in edges.tolist():
        for first in range(begin, end, _CHUNK):
            yield first, min(first + _CHUNK, end)


def _may_hold_points(
    boxes_m: NDArray[np.float64], target: Target, rows: slice | None
) -> NDArray[np.bool_]:
    """Return a mask of bounding boxes (n, 2, 3) that may intersect a slab of any orientation."""
    axes = target.wall_from_offset[:, :3]
    middles = boxes_m.mean(axis=1) @ axes.T + target.wall_from_offset[:, 3]
    halves = 0.5 * (boxes_m[:, 1] - boxes_m[:, 0]) @ np.abs(axes).T
    first_row, end_row = (0, target.height) if rows is None else (rows.start, rows.stop)
    low = np.array([0.0, first_row, target.behind_m])
    high = np.array([target.width, end_row, target.front_m])
    # Use a tolerance much larger than rounding errors.
    slack = 1e-9 * (np.abs(middles) + halves) + 1e-6
    # Comparisons with NaN are false, so a box with a NaN coordinate is kept.
    is_beside = (middles + halves < low - slack) | (middles - halves > high + slack)
    found: NDArray[np.bool_] = ~is_beside.any(axis=1)
    return found


def share_cells(threads: int, *passes: Callable[[int, int], None]) -> None:
    """Run passes one after the other, each in several threads that process separate cells.

    Args:
        threads: number of threads, rounded down to a power of two.
        passes: functions that are called with the number of threads (`owners`) and the index of the
            thread (`owner`) whose cells they process.
    """
    owners = 1 << (max(1, threads).bit_length() - 1)

    def visit(owner: int) -> None:
        for one_pass in passes:
            one_pass(owners, owner)

    in_threads([partial(visit, owner) for owner in range(owners)])


def topmost_points(
    points: OffsetPoints,
    slab: Slab,
    *,
    threads: int,
    is_left_out: NDArray[np.bool_] | None = None,
) -> NDArray[np.void]:
    """Find the point nearest to the viewer in each cell (skarlatos2012).

    Of equally near points, the one nearest to the centre of the cell is used, and of several such
    points, the first.

    Args:
        points: points of the cloud.
        slab: slab of the wall.
        threads: number of threads.
        is_left_out: (n,) True for points to ignore; None to use all points.

    Returns:
        (cells,) of `WINNER`; `point` is `NO_POINT` if the cell is void.
    """
    winners = empty_winners(slab.n_cells)
    for entries in entries_inside(points, slab, threads=threads, is_left_out=is_left_out):
        share_cells(threads, partial(keep_topmost, entries, winners))
    return winners


def empty_winners(n_cells: int) -> NDArray[np.void]:
    """Return records for cells without points."""
    winners = np.empty(n_cells, dtype=WINNER)
    winners[:] = (-np.inf, np.inf, NO_POINT, 0)
    return winners


def values_of_winners(
    winners: NDArray[np.void], values: NDArray[_Value], nothing: float
) -> NDArray[_Value]:
    """Return the values (cells, channels) of the points selected for the cells.

    Args:
        winners: (cells,) of `WINNER`.
        values: (n, channels) values of the points of the cloud.
        nothing: value for cells without a point.
    """
    taken = np.full((winners.size, values.shape[1]), nothing, dtype=values.dtype)
    has_point = winners["n_points"] > 0
    taken[has_point] = np.asarray(values)[winners["point"][has_point]]
    return taken


def places_of_winners(
    points: OffsetPoints, slab: Slab, winners: NDArray[np.void]
) -> NDArray[np.float32]:
    """Return the positions of the selected points in cells near gaps.

    Returns:
        (cells, 2) distances to the right and downwards from the centre of the cell, in cells; 0 if
        no void cell is nearby, NaN if the cell has no point.
    """
    from scipy import ndimage  # noqa: PLC0415 - few who load this need it

    is_void = winners["n_points"] == 0
    around = ndimage.maximum_filter(
        is_void.reshape(slab.frame.shape), 2 * _BESIDE_GAPS_CELLS + 1, mode="constant"
    )
    cells = np.flatnonzero(np.asarray(around).ravel() & ~is_void)
    won = winners["point"][cells]
    offsets = np.stack([axis[won] for axis in (points.x, points.y, points.z)]).astype(np.float64)
    matrix = wall_from_offset(slab.frame, points.origin)[:2]
    rows, columns = np.divmod(cells, slab.frame.width)
    on_wall = (matrix[:, :3] @ offsets).T + matrix[:, 3]
    places = np.zeros((winners.size, 2), dtype=np.float32)
    places[cells] = on_wall - np.column_stack([columns, rows]) - 0.5
    places[is_void] = np.nan
    return places
