"""What the methods that lay photos onto walls share: their ports, and what hides a cell."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import DTypeLike, NDArray
from pydantic import Field

from orthoflow.products import Cameras, Photos, PointCloud, Wall, Walls
from orthoflow.sdk import MethodParams, Ports, StepContext

if TYPE_CHECKING:
    from orthoflow.geometry.cameras import ViewingCamera
    from orthoflow.geometry.visibility_kernels import Relief
    from orthoflow_plugins.ortho.dsm_backward_occluders import Occluders
    from orthoflow_plugins.ortho.dsm_backward_painting import Surface

# Of walls with more cells lies in files what is looked up while photos are laid.
_IN_MEMORY_MOST: Final = 1 << 26


class PhotosOnWalls(Ports):
    """The walls, the cloud they were made from, and the oriented photos."""

    walls: Walls
    photos: Photos
    cameras: Cameras
    cloud: PointCloud | None = None


class SightParams(MethodParams):
    """When a photo counts as seeing a cell."""

    incidence_max_deg: float = Field(
        default=80.0, gt=0, lt=90, description="Cells seen more obliquely are not painted."
    )
    tolerance_sigma: float = Field(
        default=3.0,
        ge=0,
        description="A surface hides a cell when it is above the ray by more than so many "
        "standard deviations of depth, and tolerance_cells.",
    )
    tolerance_cells: float = Field(
        default=0.5, ge=0, description="The same in cells, for what the raster cannot hold."
    )
    occluder_points_min: int = Field(
        default=6,
        ge=1,
        description="Points of the cloud with fewer about them, themselves included, are "
        "outliers and hide nothing.",
    )
    border_share: float = Field(
        default=0.05,
        ge=0,
        le=0.5,
        description="Quality falls to 0 over this share of a photo's shorter side.",
    )


def surfaces_of(
    walls: Walls, params: SightParams, ctx: StepContext, *, hides: bool = True
) -> list[Surface]:
    """Give each wall as the surface that rays meet; with `hides` false its relief hides nothing."""
    from orthoflow.geometry.depth_noise import depth_noise_m
    from orthoflow_plugins.ortho.dsm_backward_painting import Surface
    from orthoflow_plugins.ortho.dsm_backward_surfaces import relief_of, transparent_relief_of

    def prepared(index: int, wall: Wall) -> Relief:
        if not hides:
            return transparent_relief_of(wall, threads=ctx.cores)
        return relief_of(wall, threads=ctx.cores, allocate=partial(_allocated, ctx, index))

    return [
        Surface(
            frame=wall.frame,
            relief=prepared(index, wall),
            front_m=walls.buffer_front_m,
            tolerance_m=params.tolerance_sigma * depth_noise_m(wall.depth_m)
            + params.tolerance_cells * wall.frame.gsd_m,
        )
        for index, wall in enumerate(walls.walls)
    ]


def _allocated(
    ctx: StepContext, wall: int, name: str, shape: tuple[int, ...], dtype: DTypeLike
) -> NDArray[np.generic]:
    """What is prepared of a wall, in a file for a large one."""
    if math.prod(shape) <= _IN_MEMORY_MOST:
        return np.empty(shape, dtype=dtype)
    return ctx.allocate("relief", f"{wall}.{name}", shape, dtype)


def occluders_before(
    inputs: PhotosOnWalls,
    viewers: Sequence[ViewingCamera],
    params: SightParams,
    ctx: StepContext,
    *,
    method: str,
) -> Occluders | None:
    """Find what stands free before the walls; None, with a warning, where no cloud is wired.

    Raises:
        ProductError: the cloud has fewer than three points.
    """
    from orthoflow_plugins.ortho.dsm_backward_occluders import find_occluders

    if inputs.cloud is None:
        ctx.warn(
            f"no cloud is wired to {method}: things that stand free before a wall hide nothing, "
            "and photos paint them onto it"
        )
        return None
    inputs.cloud.require_points(3)
    return find_occluders(
        inputs.cloud,
        inputs.walls,
        list(viewers),
        n_least=params.occluder_points_min,
        threads=ctx.cores,
    )
