"""Colours of points, each from the photo that shows the point best."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.images import before_masks, decode_image
from orthoflow.geometry.cameras import ViewingCamera, to_opencv
from orthoflow.products import Photo, PointCloud

if TYPE_CHECKING:
    from orthoflow.geometry.depth_buffer_kernels import DepthBuffer
    from orthoflow.geometry.occluders import Box

UNSEEN_GREY: Final = 128
# Points up to this distance behind the nearest one are also visible.
_TOLERANCE_M: Final = 0.05
# Width of the border zone of a photo, relative to the photo's shorter side. Lens models are less
# accurate there, so the quality decreases to 0.
_BORDER_SHARE: Final = 0.05
# OpenCV's remap requires images with fewer than 32,767 rows.
_REMAPPED_AT_ONCE: Final = 30_000
_PROJECTED_AT_ONCE: Final = 1 << 19
_SAMPLED_MOST: Final = 200_000
# Percentage of points at each end of an axis that may be outliers.
_OUTSIDE_PERCENT: Final = 0.5
# Number of cubes along the cloud's longest side, used to estimate the area of its surfaces.
_CUBES: Final = 64


@dataclass(frozen=True, kw_only=True)
class PointColours:
    """Colours of a cloud's points; the arrays are filled in place and may be memory-mapped.

    Attributes:
        rgb: (n, 3) uint8, `UNSEEN_GREY` for points that no photo sees.
        best: (n,) float32 quality of the chosen photo, 0 if no photo sees the point.
        photo: (n,) int16 number of the chosen photo, or -1; None if not requested.
    """

    rgb: NDArray[np.uint8]
    best: NDArray[np.float32]
    photo: NDArray[np.int16] | None = None


def colour_points(
    cloud: PointCloud,
    oriented: Sequence[tuple[Photo, ViewingCamera]],
    colours: PointColours,
    *,
    threads: int = 1,
    progress: Callable[[float, str], object] = lambda _share, _name: None,
) -> None:
    """Assign each point the colour of the photo that shows it best.

    A point is visible unless a nearer point of the cloud hides it; outliers are ignored. If it is
    visible in several photos, the one with the most pixels per metre is used, but with a lower
    weight near the border of a photo. The colour is interpolated between four pixels.

    Args:
        cloud: the points.
        oriented: photos with their cameras.
        colours: arrays to fill.
        threads: number of threads; the result does not depend on it.
        progress: called before each photo with the completed fraction and the photo's name.
    """
    from orthoflow.geometry.occluders import depth_buffer, occluders_in

    occluders = occluders_in(
        cloud,
        box_around(cloud, [camera for _, camera in oriented]),
        cloud.stations,
        threads=threads,
    )
    for place, (photo, camera) in enumerate(oriented):
        progress(place / len(oriented), photo.name)
        buffer = before_masks(depth_buffer(occluders, camera), photo)
        _colour(cloud, photo, camera.shifted(cloud.origin), buffer, colours, place)


def spacing_of(cloud: PointCloud) -> float:
    """Estimate the point spacing on surfaces in metres, from the cubes that contain points."""
    return _extent(cloud)[3]


def _colour(
    cloud: PointCloud,
    photo: Photo,
    camera: ViewingCamera,
    buffer: DepthBuffer,
    colours: PointColours,
    place: int,
) -> None:
    """Colour the points for which this photo has the highest quality so far.

    `camera` is relative to the cloud's origin; `colours` are updated in place.
    """
    import cv2

    image = decode_image(photo.encoded, photo.name)
    size = np.array([camera.width, camera.height], dtype=np.float64)
    for start in range(0, len(cloud), _PROJECTED_AT_ONCE):
        part = slice(start, start + _PROJECTED_AT_ONCE)
        offsets = np.column_stack([cloud.x[part], cloud.y[part], cloud.z[part]])
        projected = camera.project(offsets.astype(np.float64))
        inside = np.flatnonzero(camera.sees(projected[:, :2]))
        pixels, depth_m = projected[inside, :2], projected[inside, 2]
        index = start + inside
        # A point is visible unless a surface is nearer by more than the tolerance.
        cells = (pixels / buffer.reduction).astype(np.int64)
        is_seen = depth_m <= buffer.nearest[cells[:, 1], cells[:, 0]] + _TOLERANCE_M
        # Quality: pixels per metre, squared, reduced near the photo's border.
        rim = np.minimum(pixels, size - pixels).min(axis=1) / size.min()
        quality = (camera.fx / depth_m) ** 2 * np.clip(rim / _BORDER_SHARE, 1e-3, 1.0)
        wins = is_seen & (quality.astype(np.float32) > colours.best[index])
        index = index[wins]
        if len(index) == 0:
            continue
        at = to_opencv(pixels[wins]).astype(np.float32)
        for first in range(0, len(at), _REMAPPED_AT_ONCE):
            few = slice(first, first + _REMAPPED_AT_ONCE)
            taken = cv2.remap(
                image, at[few, :1], at[few, 1:], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
            colours.rgb[index[few]] = np.asarray(taken)[:, 0]
        colours.best[index] = quality[wins]
        if colours.photo is not None:
            colours.photo[index] = place


def _extent(
    cloud: PointCloud,
) -> tuple[NDArray[np.float64], NDArray[np.float64], float, float]:
    """Return a cloud's extent without outliers, in metres from its origin, and its point spacing.

    Returns:
        (3,) lowest and (3,) highest coordinates, the side of the cubes used for the estimate, and
        the approximate point spacing on surfaces.
    """
    every = slice(None, None, max(1, len(cloud) // _SAMPLED_MOST))
    sample = np.column_stack([cloud.x[every], cloud.y[every], cloud.z[every]]).astype(np.float64)
    low, high = np.percentile(sample, (_OUTSIDE_PERCENT, 100.0 - _OUTSIDE_PERCENT), axis=0)
    inside = sample[np.all((sample >= low) & (sample <= high), axis=1)]
    side_m = max(float((high - low).max()) / _CUBES, 1e-6)
    cubes = np.unique(np.floor((inside - low) / side_m).astype(np.int64), axis=0)
    return low, high, side_m, side_m * float(np.sqrt(len(cubes) / max(1, len(cloud))))


def box_around(cloud: PointCloud, cameras: Sequence[ViewingCamera]) -> Box:
    """Return the box around the cameras and the cloud without outliers, and the point spacing."""
    from orthoflow.geometry.occluders import Box

    low, high, side_m, spacing_m = _extent(cloud)
    centres = np.array([camera.centre_world for camera in cameras]) - cloud.origin
    places = np.vstack([low - side_m, high + side_m, centres])
    return Box(low=places.min(axis=0), high=places.max(axis=0), spacing_m=spacing_m)
