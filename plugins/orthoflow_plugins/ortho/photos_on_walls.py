"""Ports, visibility and camera lookup of the methods that project photos."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from orthoflow.errors import MethodError
from orthoflow.files.images import before_masks, decode_image, decode_levels
from orthoflow.files.photo_files import icc_profile, stated_bits
from orthoflow.geometry.levels import Colours, Level, in_levels
from orthoflow.products import (
    PHOTOS_UPSIDE_DOWN,
    Camera,
    Cameras,
    Layers,
    Photo,
    Photos,
    PointCloud,
    Walls,
)
from orthoflow.sdk import DiagnosticSpec, Ports, StepContext
from orthoflow.untrusted_text import first_few
from orthoflow_plugins.ortho.layers import LayerStack

if TYPE_CHECKING:
    from orthoflow.geometry.cameras import ViewingCamera
    from orthoflow.geometry.depth_buffer_kernels import DepthBuffer
    from orthoflow.geometry.occluders import Occluders
    from orthoflow_plugins.ortho.surfaces import Surface

_PLAIN_BITS: Final = 8
NO_CLOUD: Final = DiagnosticSpec(
    code="occluders-unknown",
    severity="warning",
    text="no cloud is connected to {step}: objects in front of a wall are not recognised and "
    "appear on it",
    remedy="connect the cloud to {step}",
)
MIXED_BITS: Final = DiagnosticSpec(
    code="photos-of-mixed-depth",
    severity="warning",
    text="{n} of {n_photos} photos ({names}) have 8 bits per channel, the others 16: the "
    "orthoimages have 16 bits, and 8-bit levels are multiplied by 257",
    rank_by="n",
)
MIXED_PROFILES: Final = DiagnosticSpec(
    code="photos-of-mixed-profiles",
    severity="warning",
    text="the photos have {n} different colour profiles, or some have none: the orthoimages have "
    "no profile, and colours may change abruptly between photos",
    remedy="export all photos with the same colour profile",
    rank_by="n",
)
WITHOUT_WALL: Final = DiagnosticSpec(
    code="photos-show-no-wall",
    severity="warning",
    text="{n} of {n_photos} oriented photos show no wall ({names})",
    remedy="if they show a surface that you need, detect more planes "
    "({step[plane]}.min_share) and select its plane ({step[raster]}.near or n_walls_max)",
    rank_by="n",
)


class PhotosOnWalls(Ports):
    """The walls, the cloud from which they were made, and the oriented photos."""

    walls: Walls
    photos: Photos
    cameras: Cameras
    cloud: PointCloud | None = None


class LayersOfPhotos(Ports):
    """One layer for each pair of a wall and a photo that shows it."""

    layers: Layers


@dataclass(frozen=True, kw_only=True)
class OpenedPhoto:
    """A photo prepared for projection onto walls.

    Attributes:
        pixels: (height, width, 3) uint8, or uint16 if any photo has more than 8 bits.
        buffer: depth buffer of objects in front of the camera.
        sigma_m: standard deviation of its projection on the walls; 0 if unknown.
    """

    name: str
    pixels: Colours
    viewer: ViewingCamera
    buffer: DepthBuffer
    sigma_m: float


def project_photos(
    inputs: PhotosOnWalls,
    ctx: StepContext,
    project: Callable[[OpenedPhoto, Surface, LayerStack, int], None],
    *,
    hides: bool = True,
) -> tuple[LayersOfPhotos, dict[str, float]]:
    """Project all photos onto all walls.

    Args:
        inputs: walls and oriented photos.
        ctx: context of the step.
        project: function that projects a photo onto a wall and adds the layer.
        hides: whether the relief of the wall and points of the cloud can hide cells.

    Returns:
        The layers, sorted by wall, and the seconds spent on each part of the work.
    """
    from orthoflow.geometry.occluders import depth_buffer, nothing_in_the_way
    from orthoflow_plugins.ortho.surfaces import surfaces_of

    oriented = oriented_photos(inputs.walls, inputs.photos, inputs.cameras)
    if values := inputs.cameras.upside_down(inputs.walls.up):
        ctx.report(PHOTOS_UPSIDE_DOWN, **values)
    photos = [photo for photo, _ in oriented]
    level = level_of_all(photos, ctx)
    surfaces = surfaces_of(inputs.walls, ctx, hides=hides)
    seconds: defaultdict[str, float] = defaultdict(float)
    started = ctx.clock_s()
    # Find occluders once for all photos, because it depends on all cameras which points are
    # outliers.
    viewers = [camera.viewing() for _, camera in oriented]
    occluders = _occluders(inputs, viewers, ctx) if hides else None
    seconds["occluders_s"] = ctx.clock_s() - started
    stack = LayerStack(inputs.walls, ctx)
    for nth, ((photo, camera), viewer) in enumerate(zip(oriented, viewers, strict=True)):
        ctx.progress(nth / len(oriented), photo.name)
        started = ctx.clock_s()
        pixels = pixels_of(photo, camera, level)
        decoded = ctx.clock_s()
        free = nothing_in_the_way(viewer) if occluders is None else depth_buffer(occluders, viewer)
        buffer = before_masks(free, photo)
        looked = ctx.clock_s()
        opened = OpenedPhoto(
            name=photo.name,
            pixels=pixels,
            viewer=viewer,
            buffer=buffer,
            sigma_m=camera.sigma_wall_m or 0.0,
        )
        n_before = len(stack.painted)
        for index, surface in enumerate(surfaces):
            project(opened, surface, stack, index)
        names = [inputs.walls.walls[layer.wall].name for layer in stack.painted[n_before:]]
        ctx.log(f"{photo.name}: projected onto {', '.join(names) or 'no wall'}")
        seconds["decoding_s"] += decoded - started
        seconds["occluders_s"] += looked - decoded
        seconds["painting_s"] += ctx.clock_s() - looked
        # Release this photo before decoding the next one.
        del pixels, free, buffer, opened
    profile = shared_profile(photos, ctx)
    used = {layer.source for layer in stack.painted}
    layers = stack.joined(level)
    idle = [photo.name for photo in photos if photo.name not in used]
    if idle:
        ctx.report(WITHOUT_WALL, n=len(idle), n_photos=len(oriented), names=first_few(idle))
    return LayersOfPhotos(layers=replace(layers, icc_profile=profile)), dict(seconds)


def _occluders(
    inputs: PhotosOnWalls, viewers: Sequence[ViewingCamera], ctx: StepContext
) -> Occluders | None:
    from orthoflow.geometry.occluders import occluders_before

    cloud, walls = inputs.cloud, inputs.walls
    if cloud is None:
        ctx.report(NO_CLOUD)
        return None
    cloud.require_points(3)
    return occluders_before(
        cloud,
        [walls.slab(index) for index in range(len(walls.walls))],
        viewers,
        spacing_m=walls.points_apart_m(),
        stations_world=cloud.stations,
        threads=ctx.cores,
    )


def oriented_photos(walls: Walls, photos: Photos, cameras: Cameras) -> list[tuple[Photo, Camera]]:
    """Return the oriented photos with their cameras.

    Raises:
        MethodError: no photo is oriented, there are no walls, or a camera has no photo.
    """
    if not walls.walls:
        raise MethodError("there are no walls to project photos onto: select planes to raster")
    by_name = {photo.name: photo for photo in photos.photos}
    posed = [camera for camera in cameras.cameras if camera.status == "ok"]
    if not posed:
        reasons = "; ".join(f"{item.photo}: {item.status}" for item in cameras.cameras)
        raise MethodError(f"no photo is oriented, so none can be projected onto a wall: {reasons}")
    missing = [camera.photo for camera in posed if camera.photo not in by_name]
    if missing:
        raise MethodError(
            f"the cameras include {', '.join(missing)}, which are not among the photos: "
            "connect the photos that were used for the orientation"
        )
    return [(by_name[camera.photo], camera) for camera in posed]


def level_of_all(photos: Sequence[Photo], ctx: StepContext) -> Level:
    """Return the numpy type of projected colours: uint16 if any photo has more than 8 bits.

    Levels of 8-bit photos are multiplied by 257 in this case, so that white stays white.
    """
    plain = [photo.name for photo in photos if (stated_bits(photo.encoded) or 0) <= _PLAIN_BITS]
    if len(plain) == len(photos):
        return np.uint8
    ctx.log("photos, layers and orthoimages have 16 bits per channel")
    if plain:
        names = ", ".join(plain[:3]) + (" ..." if len(plain) > 3 else "")
        ctx.report(MIXED_BITS, n=len(plain), n_photos=len(photos), names=names)
    return np.uint16


def pixels_of(photo: Photo, camera: Camera, level: Level) -> Colours:
    """Decode a photo into an array (height, width, 3) of 8 or 16 bits.

    Raises:
        MethodError: the photo does not have the image size of its camera.
    """
    deep = level is np.uint16
    pixels = (decode_levels if deep else decode_image)(photo.encoded, photo.name)
    viewing = camera.viewing()
    if pixels.shape[:2] != (viewing.height, viewing.width):
        raise MethodError(
            f"{photo.name} has {pixels.shape[1]} x {pixels.shape[0]} pixels, but its "
            f"camera has {viewing.width} x {viewing.height}: connect the photos that "
            "were oriented"
        )
    return in_levels(pixels, level)


def shared_profile(photos: Sequence[Photo], ctx: StepContext) -> bytes | None:
    """Return the ICC profile shared by all photos; None if there is none or if they differ."""
    profiles = {icc_profile(photo.encoded) for photo in photos}
    if len(profiles) > 1:
        ctx.report(MIXED_PROFILES, n=len(profiles))
    return profiles.pop() if len(profiles) == 1 else None
