"""What every detector starts with: sample and robust box, then one pass for blocks and plan."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry.point_kernels import blocked, box_blocks, count_over_plan, read_only
from orthoflow.products import PointCloud
from orthoflow_plugins.plane.remainders import Remainder
from orthoflow_plugins.plane.sampling import draw_sample, plan_grid

# Thread-private plans and surface rasters must stay small beside the cloud.
_PARTS_MOST: Final = 8
# Clouds thinner than this in two directions are a line or a point.
_THINNEST_M: Final = 1e-4


def sample_alone(remainder: Remainder) -> Remainder:
    """Give the sample as a remainder of its own, nothing claimed: every point of it is asked."""
    sample = remainder.sample
    count = len(sample.index)
    return Remainder(
        points=sample.points,
        sample=replace(sample, index=np.arange(count), n_represented=1.0),
        grid=remainder.grid,
        up=remainder.up,
        parts=remainder.parts,
        claims=np.full(count, -1, dtype=np.int8),
    )


def prepare(
    cloud: PointCloud,
    basis: NDArray[np.float64],
    *,
    cell_m: float,
    least_share: float,
    parts: int,
    counts_plan: bool = False,
) -> Remainder:
    """Sample a cloud and see where its blocks lie; nothing is claimed yet.

    Args:
        cloud: the cloud.
        basis: (3, 3) rows e1, e2, up.
        cell_m: side of a plan cell.
        least_share: share of the points that a plane must hold.
        parts: threads.
        counts_plan: count the points over the plan in the same pass.

    Raises:
        ProductError: the cloud has fewer than three points, or coordinates that are not finite.
        MethodError: the points coincide or lie on one line.
    """
    sample = draw_sample(cloud)
    centred = sample.offsets_m - sample.offsets_m.mean(axis=0)
    spread_m2 = np.linalg.eigvalsh(centred.T @ centred) / len(sample.index)
    if spread_m2[1] < _THINNEST_M**2:
        where = "coincide" if spread_m2[2] < _THINNEST_M**2 else "lie on one line"
        raise MethodError(f"the {len(cloud)} points of the cloud {where}, which fixes no plane")
    grid = plan_grid(sample, basis, cell_m=cell_m, outside_share=0.25 * least_share)
    parts = max(1, min(parts, _PARTS_MOST))
    offsets = read_only(cloud.x, cloud.y, cloud.z)
    plan = count_over_plan(offsets, grid, parts=parts) if counts_plan else None
    boxes = box_blocks(offsets, parts=parts) if plan is None else plan.boxed
    if boxes.n_unusable:
        cloud.require_points(3)
    return Remainder(
        points=blocked(offsets, boxes.boxes),
        sample=sample,
        grid=grid,
        up=basis[2],
        parts=parts,
        claims=np.full(len(cloud), -1, dtype=np.int8),
        plan=plan,
    )
