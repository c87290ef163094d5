"""Photos with their cameras, as every method that lays photos onto walls takes them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import MethodError
from orthoflow.files.containers import icc_profile
from orthoflow.files.images import decode_image
from orthoflow.geometry import WallFrame
from orthoflow.geometry.row_bands import row_bands
from orthoflow.products import Camera, Cameras, Layer, LayerMask, Photo, Photos, Walls
from orthoflow.sdk import StepContext

NO_SOURCE: Final = "no photo"
UNSEEN_WALLS: Final = (
    "no oriented photo sees a wall: their cameras stand behind the walls, look past them, or "
    "something hides the walls; look at cameras.json and planes.json"
)


def oriented_photos(walls: Walls, photos: Photos, cameras: Cameras) -> list[tuple[Photo, Camera]]:
    """The photos that have a pose, with it.

    Raises:
        MethodError: there is none, there are no walls, or a camera has no photo.
    """
    if not walls.walls:
        raise MethodError("there are no walls to lay photos onto: choose planes to raster")
    by_name = {photo.name: photo for photo in photos.photos}
    posed = [camera for camera in cameras.cameras if camera.status == "ok"]
    if not posed:
        reasons = "; ".join(f"{item.photo}: {item.status}" for item in cameras.cameras)
        raise MethodError(f"no photo is oriented, so none can be laid onto a wall: {reasons}")
    missing = [camera.photo for camera in posed if camera.photo not in by_name]
    if missing:
        raise MethodError(
            f"the cameras know {', '.join(missing)}, which the photos do not hold: wire the "
            "photos that were oriented"
        )
    return [(by_name[camera.photo], camera) for camera in posed]


def pixels_of(photo: Photo, camera: Camera) -> NDArray[np.uint8]:
    """Decode a photo (height, width, 3).

    Raises:
        MethodError: the camera belongs to a photo of another size.
    """
    pixels = decode_image(photo.encoded, photo.name)
    viewing = camera.viewing()
    if pixels.shape[:2] != (viewing.height, viewing.width):
        raise MethodError(
            f"{photo.name} has {pixels.shape[1]} x {pixels.shape[0]} pixels, but its camera "
            f"{viewing.width} x {viewing.height}: wire the photos that were oriented"
        )
    return pixels


def shared_profile(photos: Sequence[Photo], ctx: StepContext) -> bytes | None:
    """The ICC profile that all photos have; None where they have none, or not the same."""
    profiles = {icc_profile(photo.encoded) for photo in photos}
    if len(profiles) > 1:
        ctx.warn(
            f"the photos have {len(profiles)} different colour profiles, or some have none: the "
            "orthoimages get none, and colours may step where photos meet"
        )
    return profiles.pop() if len(profiles) == 1 else None


def bare_layer(
    frame: WallFrame,
    wall: int,
    depth: NDArray[np.float32],
    reached: NDArray[np.uint8] | None = None,
) -> Layer:
    """The layer of a wall that no photo paints.

    Args:
        frame: of the wall.
        wall: its index.
        depth: (rows, cols) metres, NaN where void.
        reached: (rows, cols) `LayerMask`, what photos reach of it, if that is known.
    """
    if reached is None:
        reached = np.full(depth.shape, LayerMask.OUTSIDE, dtype=np.uint8)
        for rows in row_bands(depth.shape):
            reached[rows][np.isnan(depth[rows])] = LayerMask.NO_SURFACE
    return Layer(
        frame=frame,
        wall=wall,
        source=NO_SOURCE,
        rgb=np.zeros((*reached.shape, 3), dtype=np.uint8),
        mask=reached,
        quality=np.zeros(reached.shape, dtype=np.float32),
    )


def weighted_median(values: NDArray[np.float64], weights: NDArray[np.int64]) -> float:
    """The value below which half of the weight lies."""
    order = np.argsort(values, kind="stable")
    totals = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(totals, totals[-1] / 2.0)])
