"""Laying a cloud into the raster of a wall: streams the points, gives arrays per cell.

Loads numba through `raster_kernels`: methods import it where they run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import raster_gap_kernels as gaps
from orthoflow.geometry import raster_kernels as kernels
from orthoflow.geometry.frames import WallFrame
from orthoflow.geometry.point_kernels import Offsets, read_only
from orthoflow.geometry.raster_entry_kernels import BLOCK, Entries, Target, project_points
from orthoflow.geometry.raster_kernels import WINNER
from orthoflow.geometry.slabs import OffsetPoints, Slab
from orthoflow.geometry.threads import even_parts, in_threads

# 2^20 points: their entries (16 MB) stay in the processor's cache between the passes, and threads
# wait for each other seldom.
_CHUNK: Final = 1 << 20

_Value = TypeVar("_Value", bound=np.generic)


def wall_from_offset(frame: WallFrame, origin: NDArray[np.float64]) -> NDArray[np.float64]:
    """Transform (3, 4) from offsets of a cloud in metres to (column, row, depth in metres).

    The difference of the two origins is taken once, in float64: with survey coordinates of 10^6 m
    nothing is lost.
    """
    axes = np.vstack([frame.u_world / frame.gsd_m, frame.v_world / frame.gsd_m, frame.normal_world])
    # Added to +0.0, no place or depth is ever -0.0, which is smaller than +0.0 only by its bits.
    return np.column_stack([axes, axes @ (origin - frame.origin_world) + 0.0])


def entries_inside(points: OffsetPoints, slab: Slab, *, threads: int) -> Iterator[Entries]:
    """Give the points inside a slab, chunk by chunk, in their order.

    The yielded arrays are overwritten by the next chunk.
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
    size = min(_CHUNK, max(1, x.size))
    buffers = _empty_entries(size)
    for first in range(0, x.size, size):
        part = slice(first, min(first + size, x.size))
        n_blocks = -(-(part.stop - part.start) // BLOCK)
        entries = buffers._replace(n_inside=buffers.n_inside[:n_blocks])
        chunk = Offsets(x[part], y[part], z[part])
        in_parts(n_blocks, threads, partial(project_points, chunk, first, target, entries))
        yield entries


def share_cells(threads: int, *passes: Callable[[int, int], None]) -> None:
    """Run passes one after the other, each thread on the cells it owns.

    Args:
        threads: how many threads; a power of two of them is used.
        passes: take the number of owners and the owner whose cells to visit.
    """
    owners = 1 << (max(1, threads).bit_length() - 1)

    def visit(owner: int) -> None:
        for one_pass in passes:
            one_pass(owners, owner)

    in_threads([partial(visit, owner) for owner in range(owners)])


def in_parts(n_items: int, threads: int, task: Callable[[int, int], None]) -> None:
    """Run a task on parts of a range, given by first and end, one part per thread."""
    parts = even_parts(n_items, threads)
    in_threads([partial(task, part.start, part.stop) for part in parts])


def topmost_points(points: OffsetPoints, slab: Slab, *, threads: int) -> NDArray[np.void]:
    """The point nearest to the viewer in each cell: the rule of skarlatos2012.

    Ties go to the point nearer the centre of its cell, then to the lower index.

    Returns:
        (cells,) of `raster_kernels.WINNER`; `point` is `NO_POINT` where the cell is void.
    """
    winners = empty_winners(slab.n_cells, threads=threads)
    for entries in entries_inside(points, slab, threads=threads):
        share_cells(threads, partial(kernels.keep_topmost, entries, winners))
    return winners


def empty_winners(n_cells: int, *, threads: int) -> NDArray[np.void]:
    """Give cells that nobody has won yet."""
    winners = np.empty(n_cells, dtype=WINNER)
    in_parts(n_cells, threads, partial(kernels.empty_cells, winners))
    return winners


def values_of_winners(
    winners: NDArray[np.void], values: NDArray[_Value], nothing: float, *, threads: int
) -> NDArray[_Value]:
    """Values (cells, channels) of the points that won the cells.

    Args:
        winners: (cells,) of `raster_kernels.WINNER`.
        values: (n, channels) of the points of the cloud.
        nothing: for cells without a point of their own.
        threads: how many threads work.
    """
    taken = np.empty((winners.size, values.shape[1]), dtype=values.dtype)
    seen = np.asarray(values).view(np.ndarray)
    seen.flags.writeable = False
    void = values.dtype.type(nothing)
    in_parts(winners.size, threads, partial(kernels.take_values, winners, seen, void, taken))
    return taken


def spread_m(n_points: NDArray[np.uint32], moments: NDArray[np.float64]) -> NDArray[np.float32]:
    """Sample standard deviation of the depths in each cell.

    Args:
        n_points: (cells,).
        moments: (cells, 2) sums of depths and squared depths; used up.

    Returns:
        (cells,) metres, NaN with fewer than two points.
    """
    mean, squares = moments.T
    with np.errstate(divide="ignore", invalid="ignore"):
        np.divide(mean, n_points, out=mean)
        squares -= mean * mean * n_points
        np.maximum(squares, 0.0, out=squares)
        # 1.0, not 1: unsigned, 0 - 1 would be four thousand million points.
        np.divide(squares, n_points - 1.0, out=squares)
        np.sqrt(squares, out=squares)
    squares[n_points < 2] = np.nan
    sigma_m: NDArray[np.float32] = squares.astype(np.float32)
    return sigma_m


def disc_offsets(radius_cells: int) -> NDArray[np.int64]:
    """Cells (k, 2) = (row, column) within a radius of a centre cell, nearest first, without it."""
    steps = np.arange(-radius_cells, radius_cells + 1, dtype=np.int64)
    rows, columns = (grid.ravel() for grid in np.meshgrid(steps, steps, indexing="ij"))
    squares = rows * rows + columns * columns
    order = np.argsort(squares, kind="stable")
    order = order[(squares[order] > 0) & (squares[order] <= radius_cells * radius_cells)]
    return np.column_stack([rows[order], columns[order]])


def lenders_in_gaps(
    is_measured: NDArray[np.bool_], radius_cells: int, *, threads: int
) -> NDArray[np.int64]:
    """For each void cell of a narrow gap the measured cell nearest to it.

    A gap is narrow where no disc of the radius fits into it: what stays void is the morphological
    opening of the void cells, so that windows and outlines keep their shape to the cell. Cells
    outside the raster count as void. Of cells equally near, the upper and then the left one lends.

    Args:
        is_measured: (rows, cols).
        radius_cells: radius of the disc; 0 finds no gap.
        threads: how many threads work.

    Returns:
        (k, 2) flat indices: the void cell, and the measured cell that lends its values.
    """
    if radius_cells == 0:
        return np.empty((0, 2), dtype=np.int64)
    rows, columns = is_measured.shape
    # Framed with void, so that discs may lie half outside the raster.
    framed: NDArray[np.bool_] = np.pad(is_measured, radius_cells)
    is_touched = _met_by_discs(framed, radius_cells, threads=threads)
    is_open = _met_by_discs(~is_touched, radius_cells, threads=threads)
    inner = np.s_[radius_cells : radius_cells + rows, radius_cells : radius_cells + columns]
    is_narrow = np.logical_not(is_open[inner] | is_measured)
    void = np.flatnonzero(is_narrow)
    lent = np.column_stack([void, void])
    del void, framed, is_touched, is_open, is_narrow  # Of sparse rasters as large as what is given.
    measured = np.ascontiguousarray(is_measured)
    task = partial(gaps.nearest_within, measured, disc_offsets(radius_cells), lent)
    in_parts(len(lent), threads, task)
    return lent


def _met_by_discs(
    is_in_set: NDArray[np.bool_], radius_cells: int, *, threads: int
) -> NDArray[np.bool_]:
    """Cells (rows, cols) about which a disc holds a cell of a set; outside there is none."""
    rows, columns = is_in_set.shape
    steps = np.arange(-radius_cells, radius_cells + 1)
    heights = np.floor(np.sqrt(radius_cells**2 - steps**2)).astype(np.uint8)
    far = radius_cells + 1
    distances = np.full((rows, columns + 2 * radius_cells), far, dtype=np.uint8)
    inner = distances[:, radius_cells : radius_cells + columns]
    in_parts(columns, threads, partial(gaps.find_distances_down, is_in_set, far, inner))
    is_met = np.empty(is_in_set.shape, dtype=np.bool_)
    in_parts(rows, threads, partial(gaps.find_discs, distances, heights, is_met))
    return is_met


def _empty_entries(n_points: int) -> Entries:
    n_blocks = -(-n_points // BLOCK)
    slots = n_blocks * BLOCK
    return Entries(
        cells=np.empty(slots, dtype=np.int32),
        depths_m=np.empty(slots, dtype=np.float32),
        squares=np.empty(slots, dtype=np.float32),
        points=np.empty(slots, dtype=np.uint32),
        n_inside=np.zeros(n_blocks, dtype=np.int64),
    )
