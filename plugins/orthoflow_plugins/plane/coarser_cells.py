"""Cells twice as wide, where regions cannot grow because a wall was scanned thinly.

A cloud that is dense on one wall may have a point per decimetre on another: cells that suit the one
leave crumbs on the other. Moments of cells add up, so what is left is summed into wider cells
without asking the points again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.cell_kernels import STEPS_PER_CELL
from orthoflow.geometry.point_kernels import PlanGrid, plan_frame
from orthoflow.geometry.voxel_kernels import BRICK_SIDE, VOXELS
from orthoflow_plugins.plane.surface_cells import SurfaceCells, with_normals

# The products that moments hold, as pairs of axes.
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


@dataclass(frozen=True, kw_only=True)
class Coarser:
    """Some cells, summed into wider ones.

    Attributes:
        cells: the wider cells.
        of_member: (k,) the wider cell of each cell that was summed.
    """

    cells: SurfaceCells
    of_member: NDArray[np.int64]


def coarser(cells: SurfaceCells, member: NDArray[np.int64]) -> Coarser:
    """Sum cells (k,) into cells with sides twice as long, and fit their neighbourhoods."""
    places, odd = np.divmod(cells.places[member].astype(np.int64), 2)
    shape = tuple(math.ceil(size / 2) for size in cells.grid.shape)
    n_bricks = tuple(-(-size // BRICK_SIDE) for size in shape)
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
    grid = PlanGrid(
        basis=cells.grid.basis,
        low_m=cells.grid.low_m,
        cell_m=2.0 * cells.grid.cell_m,
        shape=(shape[0], shape[1], shape[2]),
    )
    used = replace(cells.neighbourhood, cell_m=grid.cell_m, size_m=2.0 * cells.neighbourhood.size_m)
    return Coarser(
        cells=with_normals(
            SurfaceCells(
                neighbourhood=used,
                grid=grid,
                frame=plan_frame(grid),
                bricks=bricks.reshape(n_bricks),
                numbers=numbers,
                places=places[first].astype(np.int32),
                sums=_summed(cells.sums[member], odd, of_member, len(keys)),
                normals=np.empty((len(keys), 3), dtype=np.float32),
                spreads=np.empty((len(keys), 3), dtype=np.float32),
            ),
            parts=1,
        ),
        of_member=of_member,
    )


def _summed(
    sums: NDArray[np.int64], odd: NDArray[np.int64], owner: NDArray[np.int64], count: int
) -> NDArray[np.int64]:
    """(count, N_SUMS) moments of wider cells: steps are twice as long, and count from their middle.

    Args:
        sums: (k, N_SUMS) moments of the cells.
        odd: (k, 3) 1 where a cell is the upper half of its wider cell.
        owner: (k,) wider cell of each.
        count: wider cells.
    """
    number = sums[:, :1]
    shift = (2 * odd - 1) * (STEPS_PER_CELL // 4)
    linear = 0.5 * sums[:, 1:4]
    moved = [number[:, 0], *(linear + number * shift).T]
    for k, (i, j) in enumerate(_PAIRS):
        moved.append(
            0.25 * sums[:, 4 + k]
            + shift[:, i] * linear[:, j]
            + shift[:, j] * linear[:, i]
            + number[:, 0] * shift[:, i] * shift[:, j]
        )
    # Sums of halves and quarters of whole numbers are exact in 53 bits: the order does not show.
    totals = [np.bincount(owner, column, minlength=count) for column in moved]
    return np.rint(np.column_stack(totals)).astype(np.int64)
