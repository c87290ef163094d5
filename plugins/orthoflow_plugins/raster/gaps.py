"""Where the cells of a surface come from: measured, recovered in narrow gaps, or void."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.rastering import lenders_in_gaps
from orthoflow.geometry.slabs import Slab
from orthoflow.products import PointCloud, SurfaceMask
from orthoflow_plugins.raster.scan_neighbours import SpanRule, recover_between_neighbours
from orthoflow_plugins.raster.surfaces import CELLS_AT_ONCE, CellSurface

# Neighbours in the scan may lie so many widths of a narrow gap's radius apart.
_SPAN_GAPS: Final = 4


@dataclass(frozen=True, kw_only=True)
class GapRule:
    """Which gaps close.

    Attributes:
        gap_cells: no disc of this radius fits into a narrow gap; 0 closes none.
        scan_steps: rows or columns of a scan between neighbours that span a gap, at most.
        layer_m: how far apart their depths are, at most.
        threads: how many threads work.
    """

    gap_cells: int
    scan_steps: int
    layer_m: float
    threads: int

    @property
    def reach_cells(self) -> int:
        """How far away a cell may lie that decides what becomes of another, at most."""
        return (_SPAN_GAPS + 2) * self.gap_cells


def close_gaps(
    cloud: PointCloud, slab: Slab, surface: CellSurface, rule: GapRule
) -> NDArray[np.uint8]:
    """Fill the narrow gaps of a surface in place; their spread stays unknown, their count 0.

    Returns:
        (cells,) `SurfaceMask`.
    """
    is_known = np.isfinite(surface.depth_m)
    mask = np.full(is_known.shape, SurfaceMask.RECOVERED, dtype=np.uint8)
    mask[surface.count > 0] = SurfaceMask.MEASURED
    mask[~is_known] = SurfaceMask.VOID
    spans = SpanRule(
        steps=rule.scan_steps,
        side_cells=_SPAN_GAPS * rule.gap_cells,
        layer_m=rule.layer_m,
        threads=rule.threads,
    )
    mask[recover_between_neighbours(cloud, slab, surface, spans)] = SurfaceMask.RECOVERED
    lent = lenders_in_gaps(is_known.reshape(slab.frame.shape), rule.gap_cells, threads=rule.threads)
    for first in range(0, len(lent), CELLS_AT_ONCE):
        part = lent[first : first + CELLS_AT_ONCE]
        # Lenders are never void, so that it does not matter which part comes first.
        void, lender = part[mask[part[:, 0]] == SurfaceMask.VOID].T
        mask[void] = SurfaceMask.RECOVERED
        for values in (surface.depth_m, surface.intensity, surface.rgb):
            if values is not None:
                values[void] = values[lender]
    return mask
