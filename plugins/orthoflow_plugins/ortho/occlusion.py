"""What stands free between photos and walls, told from the whole cloud."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.photo_masks import before_masks
from orthoflow.geometry.bands import row_bands
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.depth_buffer_kernels import DepthBuffer
from orthoflow.geometry.occluders import (
    Box,
    Occluders,
    depth_buffer,
    nothing_in_the_way,
    occluders_in,
)
from orthoflow.products import Photo, PointCloud, Walls
from orthoflow.sdk import StepContext
from orthoflow_plugins.ortho.photos_on_walls import PhotosOnWalls, VisibilityParams


def occluders_before(
    inputs: PhotosOnWalls,
    viewers: Sequence[ViewingCamera],
    params: VisibilityParams,
    ctx: StepContext,
    *,
    method: str,
) -> Occluders | None:
    """Find what stands free before the walls; None, with a warning, where no cloud is wired.

    Raises:
        ProductError: the cloud has fewer than three points.
    """
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


def depth_buffer_of(
    occluders: Occluders | None, viewer: ViewingCamera, photo: Photo
) -> DepthBuffer:
    """Look at what stands free through a photo's camera; None for nothing but what is masked."""
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
    """Count the points between cameras and walls, to know outliers and the gaps between points.

    Args:
        cloud: the whole cloud.
        walls: nothing beyond the box about walls and cameras can hide a wall.
        cameras: all of them.
        n_least: see `Occluders`.
        threads: see `Occluders`.
    """
    low, high = _box_between(cloud, walls, cameras)
    box = Box(low=low, high=high, spacing_m=_spacing_m(walls))
    return occluders_in(cloud, box, cloud.stations, n_least=n_least, threads=threads)


def _spacing_m(walls: Walls) -> float:
    """The coarser of the finest raster's cells and the points' spacing on it."""
    wall = min(walls.walls, key=lambda wall: wall.frame.gsd_m)
    n_known = n_points = 0
    for rows in row_bands(wall.depth_m.shape):
        known = np.isfinite(wall.depth_m[rows])
        n_known += int(np.count_nonzero(known))
        n_points += int(wall.count[rows].sum(where=known, dtype=np.int64))
    density = n_points / n_known if n_known else 1.0
    return wall.frame.gsd_m / math.sqrt(min(1.0, max(density, 0.1)))


def _box_between(
    cloud: PointCloud, walls: Walls, cameras: Sequence[ViewingCamera]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    places = [camera.centre_world for camera in cameras]
    for index, wall in enumerate(walls.walls):
        corners = wall.frame.corners_world()
        places += [*(corners + walls.slab(index).front_m * wall.frame.normal_world), *corners]
    between = np.array(places) - cloud.origin
    return between.min(axis=0), between.max(axis=0)
