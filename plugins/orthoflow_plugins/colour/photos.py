"""`colour.photos`: colour a cloud from photos."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from orthoflow.errors import MethodError
from orthoflow.files.images import decode_image
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.products import Cameras, Photo, Photos, PointCloud
from orthoflow.sdk import Method, MethodParams, Ports, StepContext
from orthoflow_plugins.colour.sightings import SeenBlock, blocks, box_of, is_seen

if TYPE_CHECKING:
    from orthoflow.geometry.depth_buffer_kernels import DepthBuffer

_UNSEEN_GREY: Final = 128
# Towards the border of a photo its lens is known less well: worth falls to 0 over this share.
_BORDER_SHARE: Final = 0.05
# OpenCV takes pictures of fewer than 32,767 rows.
_REMAPPED_AT_ONCE: Final = 30_000


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
            box_of(cloud, [camera for _, camera in chosen]),
            cloud.stations,
            n_least=params.occluder_points_min,
            threads=ctx.cores,
        )
        for place, (photo, camera) in enumerate(chosen):
            ctx.progress(place / len(chosen), photo.name)
            sight = _Sight(
                camera=camera.shifted(cloud.origin),
                buffer=depth_buffer(occluders, camera),
                tolerance_m=params.tolerance_m,
            )
            _colour(cloud, photo, sight, rgb, best)
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
class _Sight:
    """A photo's camera, shifted to the cloud's origin, and how far it sees."""

    camera: ViewingCamera
    buffer: DepthBuffer
    tolerance_m: float


def _colour(
    cloud: PointCloud,
    photo: Photo,
    sight: _Sight,
    rgb: NDArray[np.uint8],
    best: NDArray[np.float32],
) -> None:
    """Colour what a photo sees better than those before it; `rgb` and `best` are changed."""
    import cv2

    image = decode_image(photo.encoded, photo.name)
    for block in blocks(cloud, sight.camera):
        worth = _worth(block, sight.camera)
        wins = is_seen(block, sight.buffer, sight.tolerance_m) & (worth > best[block.index])
        index = block.index[wins]
        if len(index) == 0:
            continue
        # OpenCV counts pixels from the centre of the first.
        at = (block.pixels[wins] - 0.5).astype(np.float32)
        for start in range(0, len(at), _REMAPPED_AT_ONCE):
            part = slice(start, start + _REMAPPED_AT_ONCE)
            colours = cv2.remap(
                image, at[part, :1], at[part, 1:], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
            rgb[index[part]] = np.asarray(colours)[:, 0]
        best[index] = worth[wins]


def _worth(block: SeenBlock, camera: ViewingCamera) -> NDArray[np.float32]:
    """Pixels per metre squared, less near the photo's border."""
    size = np.array([camera.width, camera.height], dtype=np.float64)
    rim = np.minimum(block.pixels, size - block.pixels).min(axis=1) / size.min()
    worth: NDArray[np.float32] = (
        (camera.fx / block.depth_m) ** 2 * np.clip(rim / _BORDER_SHARE, 1e-3, 1.0)
    ).astype(np.float32)
    return worth


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
