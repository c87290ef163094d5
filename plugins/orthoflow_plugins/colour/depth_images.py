"""How far a photo sees: the nearest points of a cloud per pixel of a coarse depth image."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.products import PointCloud

AT_ONCE: Final = 1 << 19
_FINEST_PX: Final = 4
# So many points per pixel of the depth image leave no holes in a surface.
_POINTS_PER_PIXEL: Final = 6.0


@dataclass(frozen=True, kw_only=True)
class SeenBlock:
    """Some points of a cloud as a photo has them.

    Attributes:
        index: (n,) int64 points that lie inside the photo.
        pixels: (n, 2) float64 column, row.
        depth_m: (n,) float64 along the optical axis.
    """

    index: NDArray[np.int64]
    pixels: NDArray[np.float64]
    depth_m: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class DepthImage:
    """Distance of the nearest points.

    Attributes:
        nearest_m: (rows, cols) float32, infinite where nothing is.
        reduction: photo pixels per pixel of this image.
    """

    nearest_m: NDArray[np.float32]
    reduction: int

    def sees(self, block: SeenBlock, tolerance_m: float) -> NDArray[np.bool_]:
        """Which points (n,) no nearer surface hides by more than the tolerance."""
        rows, columns = _cells(block, self.reduction)
        seen: NDArray[np.bool_] = block.depth_m <= self.nearest_m[rows, columns] + tolerance_m
        return seen


def blocks(cloud: PointCloud, camera: ViewingCamera) -> Iterator[SeenBlock]:
    """Project a cloud, part by part; gives the points inside the photo.

    Args:
        cloud: the points.
        camera: shifted to the cloud's origin.
    """
    for start in range(0, len(cloud), AT_ONCE):
        part = slice(start, start + AT_ONCE)
        offsets = np.column_stack([cloud.x[part], cloud.y[part], cloud.z[part]])
        projected = camera.project(offsets.astype(np.float64))
        inside = np.flatnonzero(camera.sees(projected[:, :2]))
        yield SeenBlock(
            index=start + inside, pixels=projected[inside, :2], depth_m=projected[inside, 2]
        )


def depth_image(cloud: PointCloud, camera: ViewingCamera) -> DepthImage:
    """Look at a cloud through a camera that is shifted to the cloud's origin.

    The image is as coarse as the points are sparse, and holes in it are closed, so that no surface
    lets another shine through between its points.
    """
    import cv2

    n_inside = sum(len(block.index) for block in blocks(cloud, camera))
    area = camera.width * camera.height
    side = math.ceil(math.sqrt(_POINTS_PER_PIXEL * area / max(1, n_inside)))
    reduction = min(max(_FINEST_PX, side), max(camera.width, camera.height))
    shape = (-(-camera.height // reduction), -(-camera.width // reduction))
    nearest = np.full(shape, np.inf, dtype=np.float32)
    for block in blocks(cloud, camera):
        cells = _cells(block, reduction)
        np.minimum.at(nearest, cells, block.depth_m.astype(np.float32))
    window = np.ones((3, 3), dtype=np.uint8)
    closed = cv2.dilate(cv2.erode(nearest, window), window)
    return DepthImage(nearest_m=np.asarray(closed, dtype=np.float32), reduction=reduction)


def _cells(block: SeenBlock, reduction: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    cells = (block.pixels / reduction).astype(np.int64)
    return cells[:, 1], cells[:, 0]
