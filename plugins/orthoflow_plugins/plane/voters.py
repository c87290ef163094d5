"""Who votes in the plan and how loud: cells with their points, occupied cells, cells on edges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.point_kernels import PlanGrid

Accumulation = Literal["counts", "unit", "canny"]

# Thresholds of the edge detector on the density image of 8 bits.
_EDGE_LOW: Final = 60
_EDGE_HIGH: Final = 160


@dataclass(frozen=True, kw_only=True)
class Voters:
    """The cells of a plan that vote.

    Attributes:
        places_m: (m, 2) float32 centres in the (e1, e2) frame, relative to `centre_m`.
        votes: (m,) int64 votes of each.
        centre_m: (2,) centre of the plan in that frame of the cloud's offsets.
    """

    places_m: NDArray[np.float32]
    votes: NDArray[np.int64]
    centre_m: NDArray[np.float64]


def plan_centre_m(grid: PlanGrid) -> NDArray[np.float64]:
    """(2,) centre of the plan in the (e1, e2) frame of the cloud's offsets."""
    centre: NDArray[np.float64] = grid.low_m[:2] + 0.5 * grid.cell_m * np.array(grid.shape[:2])
    return centre


def vote_counts(counts: NDArray[np.int64], accumulation: Accumulation) -> NDArray[np.int64]:
    """(e1, e2) votes of each cell of a plan.

    With one vote per cell, votes are multiplied by the points of a mean voter, so that they compare
    with the heights, which are counted in points.

    Args:
        counts: (e1, e2) points per cell.
        accumulation: how loud a cell is.
    """
    if accumulation == "counts":
        return counts
    chosen = _edges(counts) if accumulation == "canny" else counts != 0
    mean = float(counts[chosen].mean()) if chosen.any() else 1.0
    return chosen * np.int64(max(1, round(mean)))


def voters(grid: PlanGrid, votes: NDArray[np.int64]) -> Voters:
    """List the cells (e1, e2) that have votes."""
    first, second = np.nonzero(votes)
    places = np.column_stack(
        [
            (first + 0.5 - 0.5 * grid.shape[0]) * grid.cell_m,
            (second + 0.5 - 0.5 * grid.shape[1]) * grid.cell_m,
        ]
    ).astype(np.float32)
    return Voters(places_m=places, votes=votes[first, second], centre_m=plan_centre_m(grid))


def _edges(counts: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Occupied cells on edges of the density image, whose grey is the logarithm of the points."""
    import cv2

    grey = np.log1p(np.maximum(counts, 0))
    scaled = np.rint(255.0 * grey / max(float(grey.max()), 1e-9)).astype(np.uint8)
    edges: NDArray[np.bool_] = (cv2.Canny(scaled, _EDGE_LOW, _EDGE_HIGH) > 0) & (counts > 0)
    return edges
