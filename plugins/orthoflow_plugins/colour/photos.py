"""`colour.photos`: colour a cloud from photos."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from orthoflow.errors import MethodError
from orthoflow.files.images import decode_image
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.opencv_border import to_opencv
from orthoflow.products import Cameras, Photo, Photos, PointCloud
from orthoflow.sdk import Method, MethodParams, Ports, StepContext

if TYPE_CHECKING:
    from orthoflow.geometry.depth_buffer_kernels import DepthBuffer
    from orthoflow.geometry.occluders import Box

_UNSEEN_GREY: Final = 128
# Towards the border of a photo its lens is known less well: quality falls to 0 over this share.
_BORDER_SHARE: Final = 0.05
# OpenCV takes pictures of fewer than 32,767 rows.
_REMAPPED_AT_ONCE: Final = 30_000
_PROJECTED_AT_ONCE: Final = 1 << 19
_SAMPLE: Final = 200_000
# So much of the points at either end of an axis may be outliers.
_OUTSIDE_PERCENT: Final = 0.5
# The cloud's longest side is cut into so many cubes to see how large its surfaces are.
_CUBES: Final = 64


class ColourPhotos(Method):
    """Give each point the colour of the photo that shows it best.

    A point is seen where no nearer point of the whole cloud lies before it, outliers left out
    (the depth buffer of `ortho.dsm-backward`). Of several photos that
    see it, the one with the most pixels per metre wins, away from its border; its colour is
    interpolated between four pixels. So a cloud without colours can take the direct way to
    orthoimages (`ortho.pointcloud-direct`) with the same photos as the other methods.
    """

    id: ClassVar[str] = "colour.photos"
    result_version: ClassVar[int] = 2
    determinism = "loose"
    metrics = (
        "coloured_share",
        "n_photos",
    )
    citations: ClassVar[tuple[str, ...]] = (
        "Skarlatos and Kiparissi 2012 (orthoimages from coloured clouds)",
    )

    class Params(MethodParams):
        """What counts as seen, and what becomes of points that no photo sees."""

        tolerance_m: float = Field(
            0.05, gt=0.0, description="A point so little behind the nearest one is seen as well."
        )
        occluder_points_min: int = Field(
            6,
            ge=1,
            description="Points with fewer about them, themselves included, are outliers and hide "
            "nothing.",
        )
        unseen: Literal["drop", "grey"] = Field(
            "drop", description="Points that no photo sees are left out, or are mid-grey."
        )

    class In(Ports):
        """The cloud, the photos, and where they were taken."""

        cloud: PointCloud
        photos: Photos
        cameras: Cameras

    class Out(Ports):
        """The cloud with colours."""

        cloud: PointCloud

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Colour photo by photo, keeping the best of each point."""
        from orthoflow.geometry.occluders import depth_buffer, occluders_in

        inputs.cloud.require_points(2)
        oriented = {camera.photo: camera for camera in inputs.cameras.cameras}
        chosen = [
            (photo, oriented[photo.name].viewing())
            for photo in inputs.photos.photos
            if photo.name in oriented and oriented[photo.name].status == "ok"
        ]
        if not chosen:
            raise MethodError(
                "none of the photos is oriented: wire cameras of the same photos (colour.photos)"
            )
        cloud = inputs.cloud
        rgb = np.full((len(cloud), 3), _UNSEEN_GREY, dtype=np.uint8)
        best = np.zeros(len(cloud), dtype=np.float32)
        occluders = occluders_in(
            cloud,
            _box_of(cloud, [camera for _, camera in chosen]),
            cloud.stations,
            n_least=params.occluder_points_min,
            threads=ctx.cores,
        )
        for place, (photo, camera) in enumerate(chosen):
            ctx.progress(place / len(chosen), photo.name)
            ready = _ReadyPhoto(
                camera=camera.shifted(cloud.origin),
                buffer=depth_buffer(occluders, camera),
                tolerance_m=params.tolerance_m,
            )
            _colour(cloud, photo, ready, rgb, best)
        seen = best > 0.0
        n_seen = int(np.count_nonzero(seen))
        ctx.metric("n_photos", len(chosen), "1")
        ctx.metric("coloured_share", n_seen / max(1, len(cloud)), "1")
        if n_seen == 0:
            raise MethodError(
                "no photo sees any point of the cloud: cloud and cameras must have one coordinate "
                "system (colour.photos)"
            )
        coloured = replace(cloud, rgb=rgb)
        return self.Out(cloud=_only(coloured, seen) if params.unseen == "drop" else coloured)


@dataclass(frozen=True, kw_only=True)
class _ReadyPhoto:
    """A photo's camera, shifted to the cloud's origin, and what stands before it."""

    camera: ViewingCamera
    buffer: DepthBuffer
    tolerance_m: float


def _colour(
    cloud: PointCloud,
    photo: Photo,
    ready: _ReadyPhoto,
    rgb: NDArray[np.uint8],
    best: NDArray[np.float32],
) -> None:
    """Colour what a photo sees better than those before it; `rgb` and `best` are changed."""
    import cv2

    image = decode_image(photo.encoded, photo.name)
    for shown in _points_in_photo(cloud, ready.camera):
        quality = _quality(shown, ready.camera)
        wins = _is_seen(shown, ready.buffer, ready.tolerance_m) & (quality > best[shown.index])
        index = shown.index[wins]
        if len(index) == 0:
            continue
        at = to_opencv(shown.pixels[wins]).astype(np.float32)
        for start in range(0, len(at), _REMAPPED_AT_ONCE):
            part = slice(start, start + _REMAPPED_AT_ONCE)
            colours = cv2.remap(
                image, at[part, :1], at[part, 1:], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
            rgb[index[part]] = np.asarray(colours)[:, 0]
        best[index] = quality[wins]


@dataclass(frozen=True, kw_only=True)
class _ShownPoints:
    """Some points of a cloud as a photo has them.

    Attributes:
        index: (n,) int64 points that lie inside the photo.
        pixels: (n, 2) float64 column, row.
        depth_m: (n,) float64 along the optical axis.
    """

    index: NDArray[np.int64]
    pixels: NDArray[np.float64]
    depth_m: NDArray[np.float64]


def _points_in_photo(cloud: PointCloud, camera: ViewingCamera) -> Iterator[_ShownPoints]:
    """Project a cloud, part by part; gives the points inside the photo.

    Args:
        cloud: the points.
        camera: shifted to the cloud's origin.
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
    """Which points (n,) no nearer surface hides by more than the tolerance."""
    places = (shown.pixels / buffer.reduction).astype(np.int64)
    seen: NDArray[np.bool_] = (
        shown.depth_m <= buffer.nearest[places[:, 1], places[:, 0]] + tolerance_m
    )
    return seen


def _quality(shown: _ShownPoints, camera: ViewingCamera) -> NDArray[np.float32]:
    """Pixels per metre squared, less near the photo's border."""
    size = np.array([camera.width, camera.height], dtype=np.float64)
    rim = np.minimum(shown.pixels, size - shown.pixels).min(axis=1) / size.min()
    quality: NDArray[np.float32] = (
        (camera.fx / shown.depth_m) ** 2 * np.clip(rim / _BORDER_SHARE, 1e-3, 1.0)
    ).astype(np.float32)
    return quality


def _box_of(cloud: PointCloud, cameras: Sequence[ViewingCamera]) -> Box:
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


def _only(cloud: PointCloud, chosen: NDArray[np.bool_]) -> PointCloud:
    """The chosen points, with all that is known of each."""
    per_point = {
        field.name: np.ascontiguousarray(value[chosen])
        for field in fields(PointCloud)
        if isinstance(value := getattr(cloud, field.name), np.ndarray)
        and field.name not in ("origin", "up", "stations")
    }
    thinner: PointCloud = replace(cloud, **per_point)  # type: ignore[arg-type] # arrays only
    return thinner
