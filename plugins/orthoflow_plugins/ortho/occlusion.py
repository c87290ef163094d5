"""Objects between photos and walls, from the whole cloud."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from orthoflow.files.images import before_masks
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.depth_buffer_kernels import DepthBuffer
from orthoflow.geometry.occluders import (
    Occluders,
    depth_buffer,
    nothing_in_the_way,
    occluders_before,
)
from orthoflow.products import Photo, PointCloud, Walls
from orthoflow.sdk import DiagnosticSpec, StepContext
from orthoflow_plugins.ortho.photos_on_walls import PhotosOnWalls, VisibilityParams

NO_CLOUD: Final = DiagnosticSpec(
    code="occluders-unknown",
    severity="warning",
    text="no cloud is wired to {step}: objects in front of a wall hide "
    "nothing, and photos paint them onto it",
    remedy="wire the cloud to {step}",
)


def occluders_of(
    inputs: PhotosOnWalls,
    viewers: Sequence[ViewingCamera],
    params: VisibilityParams,
    ctx: StepContext,
    *,
    method: str,
) -> Occluders | None:
    """Find objects in front of the walls; None, with a warning, without a cloud.

    Raises:
        ProductError: the cloud has fewer than three points.
    """
    if inputs.cloud is None:
        ctx.report(NO_CLOUD)
        return None
    inputs.cloud.require_points(3)
    return find_occluders(
        inputs.cloud,
        inputs.walls,
        list(viewers),
        n_least=params.occluder_points_min,
        threads=ctx.cores,
    )


def depth_buffer_of(
    occluders: Occluders | None, viewer: ViewingCamera, photo: Photo
) -> DepthBuffer:
    """Render objects through a photo's camera; None if only the mask hides anything."""
    free = nothing_in_the_way(viewer) if occluders is None else depth_buffer(occluders, viewer)
    return before_masks(free, photo)


def find_occluders(
    cloud: PointCloud,
    walls: Walls,
    cameras: Sequence[ViewingCamera],
    *,
    n_least: int,
    threads: int,
) -> Occluders:
    """Count the points between cameras and walls, to detect outliers and estimate point spacing.

    Args:
        cloud: the whole cloud.
        walls: nothing outside the box around walls and cameras can hide a wall.
        cameras: all of them.
        n_least: see `Occluders`.
        threads: see `Occluders`.
    """
    return occluders_before(
        cloud,
        [walls.slab(index) for index in range(len(walls.walls))],
        cameras,
        spacing_m=walls.points_apart_m(),
        stations_world=cloud.stations,
        n_least=n_least,
        threads=threads,
    )
