"""Compiled pass that tells which points of a chunk of a cloud fall into a raster, and where."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part
from orthoflow.geometry.point_kernels import Offsets

# Points handled by one task; an entry slot exists for each, so that tasks never wait for another.
BLOCK: Final = 8192
# Points transformed together; their coordinates stay in the first-level cache.
_LANE: Final = 256


class Target(NamedTuple):
    """The raster that points are laid into.

    Attributes:
        wall_from_offset: (3, 4) float64; rows give column, row and depth in metres of an offset.
        behind_m: smallest depth that counts.
        front_m: largest depth that counts.
        height: number of rows.
        width: number of columns.
    """

    wall_from_offset: NDArray[np.float64]
    behind_m: float
    front_m: float
    height: int
    width: int


class Entries(NamedTuple):
    """Points of one chunk that fall into the raster, `n_inside[b]` from slot `b * BLOCK` on.

    Attributes:
        cells: int32, row * width + column.
        depths_m: float32.
        squares: float32, squared distance to the centre of the cell, in cells.
        points: uint32, index in the cloud.
        n_inside: int64, entries per block.
    """

    cells: NDArray[np.int32]
    depths_m: NDArray[np.float32]
    squares: NDArray[np.float32]
    points: NDArray[np.uint32]
    n_inside: NDArray[np.int64]


@compiled
def project_points(
    offsets: Offsets, first: int, target: Target, entries: Entries, first_block: int, end_block: int
) -> None:
    """Fill blocks of `entries` with the points of a chunk inside the raster and its buffer.

    Both ends of the buffer are inside. A cell owns its left and upper edge.

    Args:
        offsets: of the chunk.
        first: index in the cloud of the chunk's first point.
        target: the raster.
        entries: overwritten.
        first_block: first block to fill.
        end_block: the block after the last one.
    """
    for block in range(first_block, end_block):
        slot = begin = block * BLOCK
        end = min(offsets.x.size, begin + BLOCK)
        for lane in range(begin, end, _LANE):
            stop = min(lane + _LANE, end)
            part = Offsets(offsets.x[lane:stop], offsets.y[lane:stop], offsets.z[lane:stop])
            after = slot + stop - lane
            # A scan comes in order: most lanes are wholly inside or wholly outside.
            n_inside = _set_cells(part, target, entries.cells[slot:after])
            if n_inside == 0:
                continue
            _set_depths(part, target.wall_from_offset[2], entries.depths_m[slot:after])
            _set_squares(part, target.wall_from_offset, entries.squares[slot:after])
            points = entries.points[slot:after]
            for k in range(points.size):
                points[k] = first + lane + k
            if n_inside < stop - lane:
                _close_up(entries, slot, after)
            slot += n_inside
        entries.n_inside[block] = slot - begin


# Each of the loops below writes one array and has no branches, so that the processor takes several
# points at once. float64 on purpose: the passes wait for memory, not for arithmetic.


@kernel_part
def _set_cells(part: Offsets, target: Target, cells: NDArray[np.int32]) -> int:
    """Set the cell of each point, -1 outside, and give how many are inside."""
    m = target.wall_from_offset
    u0, u1, u2, u3 = m[0, 0], m[0, 1], m[0, 2], m[0, 3]
    v0, v1, v2, v3 = m[1, 0], m[1, 1], m[1, 2], m[1, 3]
    d0, d1, d2, d3 = m[2, 0], m[2, 1], m[2, 2], m[2, 3]
    behind_m, front_m = target.behind_m, target.front_m
    last_column, last_row = np.float64(target.width), np.float64(target.height)
    width, nowhere, nothing = np.int32(target.width), np.int32(-1), np.float64(0.0)
    x, y, z = part.x, part.y, part.z
    for k in range(cells.size):
        px, py, pz = np.float64(x[k]), np.float64(y[k]), np.float64(z[k])
        u = u0 * px + u1 * py + u2 * pz + u3
        v = v0 * px + v1 * py + v2 * pz + v3
        depth = d0 * px + d1 * py + d2 * pz + d3
        is_in_raster = (u >= 0.0) & (u < last_column) & (v >= 0.0) & (v < last_row)
        is_inside = is_in_raster & (depth >= behind_m) & (depth <= front_m)
        column = np.int32(u if is_inside else nothing)
        row = np.int32(v if is_inside else nothing)
        cells[k] = np.int32(row * width + column) if is_inside else nowhere
    n_outside = np.int32(0)
    for k in range(cells.size):
        n_outside += np.int32(cells[k] >> np.int32(31))
    return int(cells.size + n_outside)


@kernel_part
def _set_depths(part: Offsets, m: NDArray[np.float64], depths_m: NDArray[np.float32]) -> None:
    d0, d1, d2, d3 = m[0], m[1], m[2], m[3]
    x, y, z = part.x, part.y, part.z
    for k in range(depths_m.size):
        px, py, pz = np.float64(x[k]), np.float64(y[k]), np.float64(z[k])
        depths_m[k] = d0 * px + d1 * py + d2 * pz + d3


@kernel_part
def _set_squares(part: Offsets, m: NDArray[np.float64], squares: NDArray[np.float32]) -> None:
    u0, u1, u2, u3 = m[0, 0], m[0, 1], m[0, 2], m[0, 3]
    v0, v1, v2, v3 = m[1, 0], m[1, 1], m[1, 2], m[1, 3]
    x, y, z = part.x, part.y, part.z
    for k in range(squares.size):
        px, py, pz = np.float64(x[k]), np.float64(y[k]), np.float64(z[k])
        u = u0 * px + u1 * py + u2 * pz + u3
        v = v0 * px + v1 * py + v2 * pz + v3
        du, dv = u - math.floor(u) - 0.5, v - math.floor(v) - 0.5
        squares[k] = du * du + dv * dv


@kernel_part
def _close_up(entries: Entries, slot: int, after: int) -> None:
    """Move the entries of a lane that are inside to its front, in their order."""
    for k in range(slot, after):
        cell = entries.cells[k]
        entries.cells[slot] = cell
        entries.depths_m[slot] = entries.depths_m[k]
        entries.squares[slot] = entries.squares[k]
        entries.points[slot] = entries.points[k]
        slot += cell >= 0
