"""Which points of a cloud a photo sees."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.products import PointCloud

if TYPE_CHECKING:
    from orthoflow.geometry.depth_buffer_kernels import DepthBuffer
    from orthoflow.geometry.occluders import Box

AT_ONCE: Final = 1 << 19
_SAMPLE: Final = 200_000
# So much of the points at either end of an axis may be outliers.
_OUTSIDE_PERCENT: Final = 0.5
# The cloud's longest side is cut into so many cubes to see how large its surfaces are.
_CUBES: Final = 64


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


def is_seen(block: SeenBlock, buffer: DepthBuffer, tolerance_m: float) -> NDArray[np.bool_]:
    """Which points (n,) no nearer surface hides by more than the tolerance."""
    places = (block.pixels / buffer.reduction).astype(np.int64)
    seen: NDArray[np.bool_] = (
        block.depth_m <= buffer.nearest[places[:, 1], places[:, 0]] + tolerance_m
    )
    return seen


def box_of(cloud: PointCloud, cameras: Sequence[ViewingCamera]) -> Box:
    """The box about cameras and the cloud but for outliers, with the spacing of its points.

    The spacing follows from the faces of the cubes that surfaces pass through.
    """
    from orthoflow.geometry.occluders import Box

    every = slice(None, None, max(1, len(cloud) // _SAMPLE))
    sample = np.column_stack([cloud.x[every], cloud.y[every], cloud.z[every]]).astype(np.float64)
    low, high = np.percentile(sample, (_OUTSIDE_PERCENT, 100.0 - _OUTSIDE_PERCENT), axis=0)
    inside = sample[np.all((sample >= low) & (sample <= high), axis=1)]
    side_m = max(float((high - low).max()) / _CUBES, 1e-6)
    cubes = np.unique(np.floor((inside - low) / side_m).astype(np.int64), axis=0)
    spacing_m = side_m * float(np.sqrt(len(cubes) / max(1, len(cloud))))
    centres = np.array([camera.centre_world for camera in cameras]) - cloud.origin
    places = np.vstack([low - side_m, high + side_m, centres])
    return Box(low=places.min(axis=0), high=places.max(axis=0), spacing_m=spacing_m)
