"""`colour.photos`: colour a cloud from photos."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from orthoflow.errors import MethodError
from orthoflow.files.images import decode_image
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.products import Cameras, Photo, Photos, PointCloud
from orthoflow.sdk import Method, MethodParams, Ports, StepContext
from orthoflow_plugins.colour.depth_images import SeenBlock, blocks, depth_image

_UNSEEN_GREY: Final = 128
# Towards the border of a photo its lens is known less well: worth falls to 0 over this share.
_BORDER_SHARE: Final = 0.05
# OpenCV takes pictures of fewer than 32,767 rows.
_REMAPPED_AT_ONCE: Final = 30_000


class ColourPhotos(Method):
    """Give each point the colour of the photo that shows it best.

    A point is seen where no nearer point of the whole cloud lies before it. Of several photos that
    see it, the one with the most pixels per metre wins, away from its border; its colour is
    interpolated between four pixels. So a cloud without colours can take the direct way to
    orthoimages (`ortho.pointcloud-direct`) with the same photos as the other methods.
    """

    id: ClassVar[str] = "colour.photos"
    result_version: ClassVar[int] = 1
    determinism = "loose"
    citations: ClassVar[tuple[str, ...]] = (
        "Skarlatos and Kiparissi 2012 (orthoimages from coloured clouds)",
    )

    class Params(MethodParams):
        """What counts as seen, and what becomes of points that no photo sees."""

        tolerance_m: float = Field(
            0.05, gt=0.0, description="A point so little behind the nearest one is seen as well."
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
        for place, (photo, camera) in enumerate(chosen):
            ctx.progress(place / len(chosen), photo.name)
            _colour(cloud, photo, camera.shifted(cloud.origin), rgb, best, params.tolerance_m)
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


def _colour(
    cloud: PointCloud,
    photo: Photo,
    camera: ViewingCamera,
    rgb: NDArray[np.uint8],
    best: NDArray[np.float32],
    tolerance_m: float,
) -> None:
    """Colour what a photo sees better than those before it; `rgb` and `best` are changed."""
    import cv2

    image = decode_image(photo.encoded, photo.name)
    depths = depth_image(cloud, camera)
    for block in blocks(cloud, camera):
        worth = _worth(block, camera)
        wins = depths.sees(block, tolerance_m) & (worth > best[block.index])
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
