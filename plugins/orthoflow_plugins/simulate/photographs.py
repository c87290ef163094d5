"""Photos of the room: taken, made worse as lenses and sensors do, and written as JPEG files."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.images import encode_jpeg
from orthoflow.geometry.scene_views import SceneCameras
from orthoflow.products import Calibration, Camera, Cameras, Intrinsics, JsonValue, Photo, Photos
from orthoflow.sdk import StepContext
from orthoflow_plugins.simulate.viewpoints import Shot

_JPEG_QUALITY: Final = 95
# A focal length as files state it is off by up to so much.
_EXIF_ERROR: Final = 0.02


@dataclass(frozen=True, kw_only=True)
class Film:
    """What the pictures suffer from.

    Attributes:
        noise_grey: standard deviation of a pixel and channel.
        vignetting: share of the light that is lost in the corners.
        supersample: rays per side of a pixel.
    """

    noise_grey: float
    vignetting: float
    supersample: int


def take_photos(
    views: SceneCameras,
    shots: tuple[Shot, ...],
    film: Film,
    ctx: StepContext,
    rng: np.random.Generator,
) -> Photos:
    """Take all photos of a room in its own frame; what is known of the camera is not in them."""
    if not shots:
        return Photos(photos=())
    exif_focal = shots[0].camera.fx * (1.0 + rng.uniform(-_EXIF_ERROR, _EXIF_ERROR))
    photos = []
    for place, shot in enumerate(shots):
        ctx.progress(0.5 + 0.5 * place / len(shots), f"photo {place + 1} of {len(shots)}")
        seed = int(rng.integers(0, 2**62))
        image = views.expose(shot.camera, supersample=film.supersample, seed=seed)
        photos.append(
            Photo(
                name=shot.name,
                encoded=encode_jpeg(_developed(image, film, rng), quality=_JPEG_QUALITY),
                width=shot.camera.width,
                height=shot.camera.height,
                exif_focal_px=exif_focal,
            )
        )
    return Photos(photos=tuple(photos))


def calibrated(photos: Photos, calibration: Calibration) -> Photos:
    """Give the photos with the calibration that all of them share; an empty one changes nothing."""
    if not calibration.intrinsics:
        return photos
    known = calibration.intrinsics[0]
    return Photos(photos=tuple(replace(photo, intrinsics=known) for photo in photos.photos))


def calibration_of(shots: tuple[Shot, ...], *, is_known: bool) -> Calibration:
    """Give the calibration of the one camera; empty when it is not known or there is no photo."""
    if not (shots and is_known):
        return Calibration(patterns=(), intrinsics=())
    return Calibration(patterns=("*",), intrinsics=(Intrinsics.of(shots[0].camera),))


def true_cameras(
    shots: tuple[Shot, ...],
    world_from_room: NDArray[np.float64],
    shift_world_m: NDArray[np.float64],
) -> Cameras:
    """Give the true orientations in the world.

    Args:
        shots: the photos, room frame.
        world_from_room: (3, 3) rotation.
        shift_world_m: (3,) world position of the room's origin.
    """
    cameras = []
    for shot in shots:
        rotation = shot.camera.rotation @ world_from_room.T
        cameras.append(
            Camera(
                photo=shot.name,
                status="ok",
                intrinsics=Intrinsics.of(shot.camera, source="truth"),
                rotation_camera_from_world=rotation,
                translation_camera_from_world=shot.camera.translation - rotation @ shift_world_m,
            )
        )
    return Cameras(cameras=tuple(cameras))


def shot_details(shots: tuple[Shot, ...]) -> list[JsonValue]:
    """Say of each photo how it was taken, as JSON."""
    return [
        {
            "name": shot.name,
            "wall": shot.wall,
            "gsd_mm": 1000.0 * shot.gsd_m,
            "obliquity_deg": shot.obliquity_deg,
            "roll_deg": shot.roll_deg,
        }
        for shot in shots
    ]


def _developed(
    image: NDArray[np.float32], film: Film, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Darken towards the corners, add noise, and round to grey levels."""
    height, width = image.shape[:2]
    rows = (np.arange(height, dtype=np.float32) + 0.5) / height - 0.5
    columns = (np.arange(width, dtype=np.float32) + 0.5) / width - 0.5
    radius2 = 2.0 * (rows[:, None] ** 2 + columns[None, :] ** 2)  # 1 in the corners
    noisy = image * (1.0 - film.vignetting * radius2**2)[:, :, None]
    if film.noise_grey > 0.0:
        noisy = noisy + film.noise_grey * rng.standard_normal(image.shape, dtype=np.float32)
    developed: NDArray[np.uint8] = np.clip(np.rint(noisy), 0.0, 255.0).astype(np.uint8)
    return developed
