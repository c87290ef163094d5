"""The photo that shows a point best, and the point's colour there."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.images import before_masks, decode_image
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.opencv_border import to_opencv
from orthoflow.products import Photo, PointCloud

if TYPE_CHECKING:
    from orthoflow.geometry.depth_buffer_kernels import DepthBuffer
    from orthoflow.geometry.occluders import Box

UNSEEN_GREY: Final = 128
# Default tolerance behind the nearest point, and minimum number of neighbours of points that hide
# others.
TOLERANCE_M: Final = 0.05
OCCLUDER_POINTS_MIN: Final = 6
# Towards the border of a photo its lens is less certain: quality decreases to 0 over this share.
_BORDER_SHARE: Final = 0.05
# OpenCV accepts pictures of fewer than 32,767 rows.
_REMAPPED_AT_ONCE: Final = 30_000
_PROJECTED_AT_ONCE: Final = 1 << 19
_SAMPLED_MOST: Final = 200_000
# This share of the points at either end of an axis may be outliers.
_OUTSIDE_PERCENT: Final = 0.5
# The cloud's longest side is divided into this many cubes to estimate the size of its surfaces.
_CUBES: Final = 64


@dataclass(frozen=True, kw_only=True)
class PointColours:
    """Colours of a cloud's points; the arrays are filled in place and may be mapped from files.

    Attributes:
        rgb: (n, 3) uint8, `UNSEEN_GREY` where no photo sees the point.
        best: (n,) float32 quality of the chosen photo, 0 if none sees the point.
        photo: (n,) int16 chosen photo, -1 for none; None if not requested.
    """

    rgb: NDArray[np.uint8]
    best: NDArray[np.float32]
    photo: NDArray[np.int16] | None = None


def colour_points(
    cloud: PointCloud,
    oriented: Sequence[tuple[Photo, ViewingCamera]],
    colours: PointColours,
    *,
    tolerance_m: float = TOLERANCE_M,
    occluder_points_min: int = OCCLUDER_POINTS_MIN,
    threads: int = 1,
    progress: Callable[[float, str], object] = lambda _share, _name: None,
) -> None:
    """Assign each point the colour of the photo that shows it best.

    A point is seen if no nearer point of the whole cloud hides it, outliers excluded. Of several
    photos that see it, the one with the most pixels per metre is used, away from its border; its
    colour is interpolated between four pixels.

    Args:
        cloud: the points.
        oriented: photos with their cameras.
        colours: output.
        tolerance_m: points at most this far behind the nearest one are seen, too.
        occluder_points_min: points with fewer neighbours, themselves included, hide nothing.
        threads: number of threads; it does not change the result.
        progress: called with the finished share and the photo's name before each photo.
    """
    from orthoflow.geometry.occluders import depth_buffer, occluders_in

    occluders = occluders_in(
        cloud,
        _box_of(cloud, [camera for _, camera in oriented]),
        cloud.stations,
        n_least=occluder_points_min,
        threads=threads,
    )
    for place, (photo, camera) in enumerate(oriented):
        progress(place / len(oriented), photo.name)
        ready = _ReadyPhoto(
            camera=camera.shifted(cloud.origin),
            buffer=before_masks(depth_buffer(occluders, camera), photo),
            tolerance_m=tolerance_m,
            place=place,
        )
        _colour(cloud, photo, ready, colours)


def spacing_of(cloud: PointCloud) -> float:
    """Estimate the spacing of points of a surface, metres, from the cubes that they occupy."""
    return _extent(cloud).spacing_m


@dataclass(frozen=True, kw_only=True)
class _ReadyPhoto:
    """A photo's camera, relative to the cloud's origin, and its depth buffer."""

    camera: ViewingCamera
    buffer: DepthBuffer
    tolerance_m: float
    place: int


def _colour(
    cloud: PointCloud,
    photo: Photo,
    ready: _ReadyPhoto,
    colours: PointColours,
) -> None:
    """Colour the points that a photo sees better than those before it, replacing their colours."""
    import cv2

    image = decode_image(photo.encoded, photo.name)
    for shown in _points_in_photo(cloud, ready.camera):
        quality = _quality(shown, ready.camera)
        wins = _is_seen(shown, ready.buffer, ready.tolerance_m) & (
            quality > colours.best[shown.index]
        )
        index = shown.index[wins]
        if len(index) == 0:
            continue
        at = to_opencv(shown.pixels[wins]).astype(np.float32)
        for start in range(0, len(at), _REMAPPED_AT_ONCE):
            part = slice(start, start + _REMAPPED_AT_ONCE)
            taken = cv2.remap(
                image, at[part, :1], at[part, 1:], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
            colours.rgb[index[part]] = np.asarray(taken)[:, 0]
        colours.best[index] = quality[wins]
        if colours.photo is not None:
            colours.photo[index] = ready.place


@dataclass(frozen=True, kw_only=True)
class _ShownPoints:
    """Some points of a cloud projected into a photo.

    Attributes:
        index: (n,) int64 points inside the photo.
        pixels: (n, 2) float64 column, row.
        depth_m: (n,) float64 along the optical axis.
    """

    index: NDArray[np.int64]
    pixels: NDArray[np.float64]
    depth_m: NDArray[np.float64]


def _points_in_photo(cloud: PointCloud, camera: ViewingCamera) -> Iterator[_ShownPoints]:
    """Project a cloud, part by part; return the points inside the photo.

    Args:
        cloud: the points.
        camera: relative to the cloud's origin.
    """
    for start in range(0, len(cloud), _PROJECTED_AT_ONCE):
        part = slice(start, start + _PROJECTED_AT_ONCE)
        offsets = np.column_stack([cloud.x[part], cloud.y[part], cloud.z[part]])
        projected = camera.project(offsets.astype(np.float64))
        inside = np.flatnonzero(camera.sees(projected[:, :2]))
        yield _ShownPoints(
            index=start + inside, pixels=projected[inside, :2], depth_m=projected[inside, 2]
        )


def _is_seen(shown: _ShownPoints, buffer: DepthBuffer, tolerance_m: float) -> NDArray[np.bool_]:
    """Report which points (n,) no nearer surface hides by more than the tolerance."""
    places = (shown.pixels / buffer.reduction).astype(np.int64)
    return shown.depth_m <= buffer.nearest[places[:, 1], places[:, 0]] + tolerance_m


def _quality(shown: _ShownPoints, camera: ViewingCamera) -> NDArray[np.float32]:
    """Return pixels per metre squared, decreasing near the photo's border."""
    size = np.array([camera.width, camera.height], dtype=np.float64)
    rim = np.minimum(shown.pixels, size - shown.pixels).min(axis=1) / size.min()
    quality: NDArray[np.float32] = (
        (camera.fx / shown.depth_m) ** 2 * np.clip(rim / _BORDER_SHARE, 1e-3, 1.0)
    ).astype(np.float32)
    return quality


@dataclass(frozen=True, kw_only=True)
class _Extent:
    """The extent of most of a cloud, metres from its origin, and its point spacing.

    Attributes:
        low: (3,) float64.
        high: (3,) float64.
        side_m: side of the cubes used for the estimate.
        spacing_m: approximate spacing of the points of a surface.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    side_m: float
    spacing_m: float


def _extent(cloud: PointCloud) -> _Extent:
    every = slice(None, None, max(1, len(cloud) // _SAMPLED_MOST))
    sample = np.column_stack([cloud.x[every], cloud.y[every], cloud.z[every]]).astype(np.float64)
    low, high = np.percentile(sample, (_OUTSIDE_PERCENT, 100.0 - _OUTSIDE_PERCENT), axis=0)
    inside = sample[np.all((sample >= low) & (sample <= high), axis=1)]
    side_m = max(float((high - low).max()) / _CUBES, 1e-6)
    cubes = np.unique(np.floor((inside - low) / side_m).astype(np.int64), axis=0)
    spacing_m = side_m * float(np.sqrt(len(cubes) / max(1, len(cloud))))
    return _Extent(low=low, high=high, side_m=side_m, spacing_m=spacing_m)


def _box_of(cloud: PointCloud, cameras: Sequence[ViewingCamera]) -> Box:
    """Return the box around cameras and cloud without outliers, with the point spacing."""
    from orthoflow.geometry.occluders import Box

    extent = _extent(cloud)
    centres = np.array([camera.centre_world for camera in cameras]) - cloud.origin
    places = np.vstack([extent.low - extent.side_m, extent.high + extent.side_m, centres])
    return Box(low=places.min(axis=0), high=places.max(axis=0), spacing_m=extent.spacing_m)
