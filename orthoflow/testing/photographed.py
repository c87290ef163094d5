"""Small inputs for methods that take photographs: a textured wall, seen by two known cameras."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.products import (
    Calibration,
    Camera,
    Cameras,
    CheckPoints,
    Intrinsics,
    Photos,
    PointCloud,
    Product,
    TieRole,
    Ties,
    Walls,
)
from orthoflow.testing.surveyed import settled
from orthoflow.testing.textured_walls import (
    SIZE_M,
    TexturedWall,
    camera_before,
    cloud_of,
    oriented,
    photo_of,
    textured_wall,
    walls_of,
)

# Ties lie on the wall and on a board before it: a method that solves for the lens with the pose
# cannot do so from control near one plane.
_BOARD_M: Final = 0.6
_TIE_SIGMA_PX: Final = 0.3
_TIE_SIGMA_M: Final = 0.001
_WRONG_SHARE: Final = 0.04


@cache
def photographed_scene(gsd_m: float = 0.006) -> TexturedWall:
    """Give the wall, its raster with cells of a given size."""
    return textured_wall(1, gsd_m=gsd_m)


def photographing_cameras() -> Mapping[str, ViewingCamera]:
    """Give the true cameras by photo name."""
    scene = photographed_scene()
    return {
        "a.png": camera_before(scene),
        "b.png": camera_before(scene, centre=(1.9, -2.4, 0.8), towards=(1.5, 0.0, 1.0), roll=0.05),
    }


@cache
def _photos() -> Photos:
    scene = photographed_scene()
    return Photos(
        photos=tuple(
            photo_of(scene, camera, name=name) for name, camera in photographing_cameras().items()
        )
    )


@cache
def _cameras() -> Cameras:
    return Cameras(
        cameras=tuple(
            settled_camera(oriented(camera, name=name))
            for name, camera in photographing_cameras().items()
        )
    )


def settled_camera(camera: Camera) -> Camera:
    """Give an orientation the same bits on every processor."""
    rotation, translation = (
        camera.rotation_camera_from_world,
        camera.translation_camera_from_world,
    )
    assert rotation is not None  # noqa: S101 - both are oriented
    assert translation is not None  # noqa: S101
    return replace(
        camera,
        rotation_camera_from_world=settled(rotation),
        translation_camera_from_world=settled(translation),
    )


@cache
def _calibration() -> Calibration:
    camera = next(iter(photographing_cameras().values()))
    return Calibration(patterns=("*",), intrinsics=(Intrinsics.of(camera),))


@cache
def _walls() -> Walls:
    return walls_of(photographed_scene())


@cache
def _cloud() -> PointCloud:
    return cloud_of(photographed_scene(), spacing_m=0.01)


@cache
def _checkpoints() -> CheckPoints:
    frame = photographed_scene().frame
    pixels = np.array([[50.0, 60.0], [440.0, 70.0], [250.0, 170.0], [60.0, 280.0], [430.0, 270.0]])
    count = len(pixels)
    return CheckPoints(
        names=tuple(f"P{index}" for index in range(count)),
        points_world=frame.world_from_wall(pixels),
        classes=("flat",) * count,
        wall=np.zeros(count, dtype=np.int32),
        pixels_wall=pixels,
    )


@cache
def example_ties() -> Ties:
    """Give ties with 0.3 px of noise, every 25th of them wrong by up to 40 px."""
    rng = np.random.default_rng(11)
    views = list(photographing_cameras().values())
    columns: list[tuple[NDArray[np.float64], ...]] = []
    for index, camera in enumerate(views):
        points, wall = _tie_points(rng)
        pixels = camera.project(points)[:, :2]
        inside = (pixels > 10.0).all(axis=1)
        inside &= (pixels < [camera.width - 10.0, camera.height - 10.0]).all(axis=1)
        points, wall, pixels = points[inside], wall[inside], pixels[inside]
        pixels = pixels + _TIE_SIGMA_PX * rng.normal(size=pixels.shape)
        is_wrong = rng.random(len(pixels)) < _WRONG_SHARE
        pixels[is_wrong] += rng.uniform(-40.0, 40.0, (int(is_wrong.sum()), 2))
        columns.append((np.full(len(wall), float(index)), wall, pixels, points))
    photo, wall, pixels, points = (np.concatenate(column) for column in zip(*columns, strict=True))
    count = len(photo)
    return Ties(
        photo_names=tuple(photographing_cameras()),
        photo=photo.astype(np.int32),
        wall=wall.astype(np.int32),
        # Rounding errors of pixels are a millionth of what is left.
        pixels_photo=settled(pixels, 6),
        points_world=settled(points),
        sigma_px=np.full(count, _TIE_SIGMA_PX),
        sigma_m=np.full(count, _TIE_SIGMA_M),
        role=np.full(count, TieRole.CONTROL, dtype=np.uint8),
        residual_px=np.full((count, 2), np.nan),
    )


def _tie_points(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    scene = photographed_scene()
    places = rng.random((320, 2)) * SIZE_M
    on_board = np.arange(len(places)) >= 220
    depths = np.where(on_board, _BOARD_M, scene.depth_m(places[:, 0], places[:, 1]))
    points = scene.frame.world_from_wall(places / scene.frame.gsd_m, depths)
    return points, on_board.astype(np.float64)


PHOTOGRAPHED: Final[Mapping[str, Callable[[], Product]]] = {
    "photos": _photos,
    "cameras": _cameras,
    "calibration": _calibration,
    "ties": example_ties,
    "walls": _walls,
    "cloud": _cloud,
    "checkpoints": _checkpoints,
}
