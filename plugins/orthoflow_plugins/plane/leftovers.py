"""What planes leave over of counts that all points were counted into, as the sample says.

To count all points anew after each plane would cost a pass over the cloud. The sample knows which
share of a cell's points a plane took; where it is all of the cloud, it knows that exactly.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.point_kernels import PlanCounts, PlanGrid
from orthoflow_plugins.plane.neighbouring import summed_around
from orthoflow_plugins.plane.remainders import Remainder


class PlanLeftovers:
    """The points of a cloud per plan cell and storey that no plane of the sample has taken."""

    def __init__(self, plan: PlanCounts, grid: PlanGrid, whole: Remainder) -> None:
        """See in which cell and storey each point of the sample lies.

        Args:
            plan: counts of all points.
            grid: where the cells lie.
            whole: the cloud.
        """
        self._plan = plan
        framed = whole.sample.offsets_m @ grid.basis.T - grid.low_m
        places = np.floor(framed / grid.cell_m)
        shape = np.array(grid.shape)
        inside = (places >= 0) & (places < shape)
        over = inside[:, 0] & inside[:, 1]
        within = over & inside[:, 2]
        places = np.where(over[:, None], places, 0.0).astype(np.int64)
        n_cells = grid.shape[0] * grid.shape[1]
        # The last place is for points outside.
        self._cell = np.where(over, places[:, 0] * grid.shape[1] + places[:, 1], n_cells)
        self._storey = np.where(within, places[:, 2], grid.shape[2])
        # A sample has too few points per cell to ask one alone.
        self._asks_around = whole.sample.n_represented > 1.0
        self._cells_asked = self._counted(self._cell, plan.cells.shape)
        self._heights_asked = self._counted(self._storey, plan.heights.shape)

    def cells(self, claims: NDArray[np.int8]) -> NDArray[np.int64]:
        """(e1, e2) points left per plan cell, given the claims of the sample."""
        return self._left(self._plan.cells, self._cell, self._cells_asked, claims)

    def heights(self, claims: NDArray[np.int8]) -> NDArray[np.int64]:
        """(storeys,) points left per storey, given the claims of the sample."""
        return self._left(self._plan.heights, self._storey, self._heights_asked, claims)

    def _counted(self, place: NDArray[np.int64], shape: tuple[int, ...]) -> NDArray[np.int64]:
        counts = np.bincount(place, minlength=math.prod(shape) + 1)[:-1].reshape(shape)
        return summed_around(counts) if self._asks_around else counts

    def _left(
        self,
        counts: NDArray[np.int64],
        place: NDArray[np.int64],
        asked: NDArray[np.int64],
        claims: NDArray[np.int8],
    ) -> NDArray[np.int64]:
        taken = np.flatnonzero(claims >= 0)
        if len(taken) == 0:
            return counts
        left = asked - self._counted(place[taken], counts.shape)
        share = np.divide(left, asked, out=np.ones(counts.shape), where=asked > 0)
        remaining: NDArray[np.int64] = np.rint(counts * share).astype(np.int64)
        return remaining
