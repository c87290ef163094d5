"""Binning a cloud into the raster of a wall: streams the points, returns arrays per cell.

This module loads numba through `raster_kernels`: methods import it inside functions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import raster_kernels as kernels
from orthoflow.geometry.frames import WallFrame
from orthoflow.geometry.point_kernels import Offsets, read_only
from orthoflow.geometry.raster_kernels import WINNER, Entries, Target, project_points
from orthoflow.geometry.slabs import BOXED_POINTS, OffsetPoints, Slab
from orthoflow.geometry.threads import in_parts, in_threads

# Their entries (16 MB) stay in the processor's cache between the passes.
_CHUNK: Final = 1 << 20

# A gap is filled from the cells nearest to it, or from cells one farther.
_BESIDE_GAPS_CELLS: Final = 2

_Value = TypeVar("_Value", bound=np.generic)


def wall_from_offset(frame: WallFrame, origin: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the transform (3, 4) from offsets of a cloud (m) to (column, row, depth in metres).

    The difference of the two origins is taken once, in float64, so that survey coordinates of 10^6
    m lose no precision.
    """
    axes = np.vstack([frame.u_world / frame.gsd_m, frame.v_world / frame.gsd_m, frame.normal_world])
    # Adding +0.0 avoids -0.0, which sorts below +0.0 by its bits.
    return np.column_stack([axes, axes @ (origin - frame.origin_world) + 0.0])


def entries_inside(
    points: OffsetPoints,
    slab: Slab,
    *,
    threads: int,
    rows: slice | None = None,
    is_left_out: NDArray[np.bool_] | None = None,
) -> Iterator[Entries]:
    """Yield the points inside a slab, chunk by chunk, in order.

    Blocks of points whose box does not meet the slab are not read.

    Args:
        points: of the cloud.
        slab: of the wall.
        threads: number of threads.
        rows: the rows of the raster that are needed; points in others may be omitted. None for all.
        is_left_out: (n,) points to ignore; None to use all.
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
    """Yield the first point, and the one after the last, of chunks that may have points inside."""
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
    """Report which boxes (n, 2, 3) may meet a slab, which need not be aligned to the axes."""
    axes = target.wall_from_offset[:, :3]
    middles = boxes_m.mean(axis=1) @ axes.T + target.wall_from_offset[:, 3]
    halves = 0.5 * (boxes_m[:, 1] - boxes_m[:, 0]) @ np.abs(axes).T
    first_row, end_row = (0, target.height) if rows is None else (rows.start, rows.stop)
    low = np.array([0.0, first_row, target.behind_m])
    high = np.array([target.width, end_row, target.front_m])
    # Far more than is lost by rounding.
    slack = 1e-9 * (np.abs(middles) + halves) + 1e-6
    # A box with a NaN coordinate compares false, and is kept.
    is_beside = (middles + halves < low - slack) | (middles - halves > high + slack)
    found: NDArray[np.bool_] = ~is_beside.any(axis=1)
    return found


def share_cells(threads: int, *passes: Callable[[int, int], None]) -> None:
    """Run passes one after the other, each thread on the cells it owns.

    Args:
        threads: number of threads, rounded down to a power of two.
        passes: functions of the number of owners and the owner whose cells to visit.
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
    """Return the point nearest to the viewer in each cell: the rule of skarlatos2012.

    Ties go to the point nearer the centre of its cell, then to the lower index.

    Args:
        points: of the cloud.
        slab: of the wall.
        threads: number of threads.
        is_left_out: (n,) points to ignore; None to use all.

    Returns:
        (cells,) of `raster_kernels.WINNER`; `point` is `NO_POINT` where the cell is void.
    """
    winners = empty_winners(slab.n_cells)
    for entries in entries_inside(points, slab, threads=threads, is_left_out=is_left_out):
        share_cells(threads, partial(kernels.keep_topmost, entries, winners))
    return winners


def empty_winners(n_cells: int) -> NDArray[np.void]:
    """Return cells without winners."""
    winners = np.empty(n_cells, dtype=WINNER)
    winners[:] = (-np.inf, np.inf, kernels.NO_POINT, 0)
    return winners


def values_of_winners(
    winners: NDArray[np.void], values: NDArray[_Value], nothing: float
) -> NDArray[_Value]:
    """Return the values (cells, channels) of the points that won the cells.

    Args:
        winners: (cells,) of `raster_kernels.WINNER`.
        values: (n, channels) of the points of the cloud.
        nothing: value for cells without a point of their own.
    """
    taken = np.full((winners.size, values.shape[1]), nothing, dtype=values.dtype)
    has_point = winners["n_points"] > 0
    taken[has_point] = np.asarray(values)[winners["point"][has_point]]
    return taken


def places_of_winners(
    points: OffsetPoints, slab: Slab, winners: NDArray[np.void]
) -> NDArray[np.float32]:
    """Return the positions of the points that won cells next to gaps, from which these are filled.

    Returns:
        (cells, 2) right of and below the centre, in cells; 0 in cells without a void cell nearby,
        NaN in cells without a point of their own.
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
