"""A cloud made ready for detection: its blocks, a small even sample of it, and its robust box."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.point_kernels import (
    BlockedPoints,
    PlanGrid,
    blocked,
    box_blocks,
    read_only,
)
from orthoflow.products import PointCloud

SAMPLE_POINTS: Final = 200_000
# More cells than this cost more than they show; the cell grows instead.
PLAN_CELLS_MOST: Final = 8_000_000
# Points that are enough to see where a scene ends.
_BOX_POINTS: Final = 20_000
_TAIL_SHARE: Final = 0.05
_GOLDEN: Final = 0.6180339887498949


@dataclass(frozen=True, kw_only=True)
class Sample:
    """A few hundred thousand points that stand for all.

    Attributes:
        index: (m,) int64 positions in the cloud, ascending.
        offsets_m: (m, 3) float64 metres from the cloud's origin.
        points: the same for the compiled passes.
        n_represented: points of the cloud that one sample point stands for.
    """

    index: NDArray[np.int64]
    offsets_m: NDArray[np.float64]
    points: BlockedPoints
    n_represented: float


def draw_sample(cloud: PointCloud, *, n_most: int = SAMPLE_POINTS) -> Sample:
    """Take one point from each of `n_most` equal stretches of the cloud, or all of a small cloud.

    The place within a stretch follows the golden ratio: a fixed stride would fall in step with the
    columns of a scan, and random places would need a seed.

    Raises:
        ProductError: the cloud has fewer than three points, or coordinates that are not finite.
    """
    if len(cloud) < 3:
        cloud.require_points(3)
    index = _spread_index(len(cloud), min(n_most, len(cloud)))
    offsets = read_only(cloud.x[index], cloud.y[index], cloud.z[index])
    offsets_m = np.column_stack(offsets).astype(np.float64)
    if not np.isfinite(offsets_m).all():
        cloud.require_points(3)
    return Sample(
        index=index,
        offsets_m=offsets_m,
        points=boxed(offsets_m),
        n_represented=len(cloud) / len(index),
    )


def thinned(cloud: PointCloud, every: int) -> PointCloud:
    """Keep every n-th point, spread as those of a sample; at least three if there are any."""
    if every == 1:
        return cloud
    return picked(cloud, _spread_index(len(cloud), min(len(cloud), max(3, len(cloud) // every))))


def picked(cloud: PointCloud, index: NDArray[np.int64]) -> PointCloud:
    """Give some of the points, without intensity, colour and place in the scan."""
    return replace(
        cloud,
        x=cloud.x[index],
        y=cloud.y[index],
        z=cloud.z[index],
        scan=None if cloud.scan is None else cloud.scan[index],
        intensity=None,
        rgb=None,
        row=None,
        column=None,
    )


def _spread_index(n_points: int, count: int) -> NDArray[np.int64]:
    stretch = n_points / max(count, 1)
    ordinal = np.arange(count)
    within = np.modf(ordinal * _GOLDEN)[0] if stretch > 1.0 else np.zeros(count)
    return np.minimum((ordinal + within) * stretch, n_points - 1).astype(np.int64)


def boxed(offsets_m: NDArray[np.float64]) -> BlockedPoints:
    """Give points (m, 3) of a sample in blocks."""
    offsets = read_only(*np.ascontiguousarray(offsets_m.T, dtype=np.float32))
    return blocked(offsets, box_blocks(offsets, parts=1).boxes)


def plan_grid(
    sample: Sample, basis: NDArray[np.float64], *, cell_m: float, outside_share: float
) -> PlanGrid:
    """Lay plan cells over the cloud without its gross outliers.

    Args:
        sample: points of the cloud.
        basis: (3, 3) rows e1, e2, up.
        cell_m: side of a cell wanted; grows when the plan would have too many.
        outside_share: share of the points that may lie outside on each side, so that mirror ghosts
            and stray points do not blow up the grid. It is well below the share a plane must have,
            so no plane worth finding is cut off.
    """
    framed = sample.offsets_m[:: max(1, len(sample.index) // _BOX_POINTS)] @ basis.T
    low, high = np.quantile(framed, (_TAIL_SHARE, 1.0 - _TAIL_SHARE), axis=0)
    # The tails may be a side room or stray echoes; only what is far beyond the scene's own size
    # can be told to be stray. A lone wall is thin one way, so the largest extent is the measure.
    reach_m = float((high - low).max())
    framed = framed[((framed >= low - reach_m) & (framed <= high + reach_m)).all(axis=1)]
    low = np.quantile(framed, outside_share, axis=0)
    high = np.quantile(framed, 1.0 - outside_share, axis=0)
    margin = 0.02 * (high - low) + 5.0 * cell_m
    low, high = low - margin, high + margin
    extent = high - low
    cell_m = max(cell_m, math.sqrt(float(extent[0] * extent[1]) / PLAN_CELLS_MOST))
    # A long, thin plan, or a tall tower, must not ask for millions of storeys either.
    cell_m = max(cell_m, float(extent.max()) / PLAN_CELLS_MOST)
    cells = np.maximum(1, np.ceil(extent / cell_m)).astype(int)
    return PlanGrid(
        basis=basis,
        low_m=low,
        cell_m=cell_m,
        shape=(int(cells[0]), int(cells[1]), int(cells[2])),
    )
