"""A textured wall with known relief: as a raster, as a cloud, and seen by a distorted camera.

It is the example for methods that use photographs. Depth and colour are functions of the position
on the wall, so the true values of cells, pixels and poses are known exactly.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from orthoflow.files.images import encode_png
from orthoflow.geometry import WallFrame
from orthoflow.geometry.cameras import ViewingCamera, looking_at
from orthoflow.geometry.frames import rotation_from_vector
from orthoflow.products import (
    Calibration,
    Camera,
    Cameras,
    CheckPoints,
    Intrinsics,
    Layer,
    LayerMask,
    Layers,
    Photo,
    Photos,
    PointCloud,
    Product,
    TieRole,
    Ties,
    Wall,
    Walls,
)
from orthoflow.testing.surveyed import settled

SIZE_M: Final = (3.0, 2.0)
GSD_M: Final = 0.006
DISTORTION: Final = (-0.09, 0.03, 6e-4, -4e-4, 0.0)
RELIEF_M: Final = 0.06
# Wavelengths of the texture; the shortest is four cells, to avoid aliasing in raster and photo.
_OCTAVES_M: Final = (0.024, 0.06, 0.2)
# Distance of a board in front of the wall. Ties are on the wall and on the board, because control
# points close to a single plane do not determine both lens and pose.
_BOARD_M: Final = 0.6
_TIE_SIGMA_PX: Final = 0.3
_TIE_SIGMA_M: Final = 0.001
_WRONG_SHARE: Final = 0.04


@dataclass(frozen=True, kw_only=True)
class TexturedWall:
    """A wall whose depth and grey value are smooth functions of the position on it.

    Attributes:
        frame: frame of the raster; the wall faces -y, so viewers are at negative y.
        noises: one grid of random numbers per octave of the texture.
    """

    frame: WallFrame
    noises: tuple[NDArray[np.float64], ...]

    def depth_m(
        self, across_m: NDArray[np.float64], down_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the relief towards the viewer, at positions in metres from the top-left corner."""
        wave = np.sin(2.1 * across_m) * np.cos(2.9 * down_m + 0.4) + 0.4 * np.sin(
            5.0 * across_m + 1
        )
        return RELIEF_M * wave

    def grey(
        self, across_m: NDArray[np.float64], down_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the grey value, 0 to 1, at positions in metres from the top-left corner."""
        total = np.zeros(np.broadcast(across_m, down_m).shape)
        for step, noise in zip(_OCTAVES_M, self.noises, strict=True):
            at = [down_m / step + 8.0, across_m / step + 8.0]
            total += map_coordinates(noise, at, order=3, mode="mirror")
        return 1.0 / (1.0 + np.exp(-1.3 * total))


def textured_wall(
    seed: int, *, origin_world: NDArray[np.float64] | None = None, gsd_m: float = GSD_M
) -> TexturedWall:
    """Return a 3 m x 2 m wall with 6 cm relief, whose plane contains `origin_world`."""
    rng = np.random.default_rng(seed)
    frame = WallFrame(
        origin_world=np.array([0.0, 0.0, SIZE_M[1]]) if origin_world is None else origin_world,
        u_world=np.array([1.0, 0.0, 0.0]),
        v_world=np.array([0.0, 0.0, -1.0]),
        normal_world=np.array([0.0, -1.0, 0.0]),
        gsd_m=gsd_m,
        width=round(SIZE_M[0] / gsd_m),
        height=round(SIZE_M[1] / gsd_m),
    )
    noises = tuple(
        rng.normal(size=(int(SIZE_M[1] / step) + 18, int(SIZE_M[0] / step) + 18))
        for step in _OCTAVES_M
    )
    return TexturedWall(frame=frame, noises=noises)


def walls_of(scene: TexturedWall, *, noise: float = 0.02, seed: int = 5) -> Walls:
    """Return the scanned wall, with a window and a different contrast curve from the photos."""
    frame = scene.frame
    across, down = places_of_cells(frame)
    rng = np.random.default_rng(seed)
    grey = scene.grey(across, down)
    intensity = 0.2 + 0.5 * grey**1.4
    intensity += noise * rng.normal(size=intensity.shape)
    depth = scene.depth_m(across, down) + 0.001 * rng.normal(size=across.shape)
    _cut_window(intensity, frame.gsd_m)
    known = np.isfinite(intensity)
    wall = Wall(
        frame=frame,
        plane_index=0,
        name="wall 0",
        depth_m=np.where(known, depth, np.nan).astype(np.float32),
        sigma_m=np.full(frame.shape, 0.001, dtype=np.float32),
        count=np.where(known, 3, 0).astype(np.uint32),
        mask=known.astype(np.uint8),
        intensity=intensity.astype(np.float32),
        rgb=np.repeat(np.rint(255 * grey)[..., np.newaxis], 3, axis=2).astype(np.uint8),
        rgb_mask=known.astype(np.uint8),
    )
    return Walls(
        walls=(wall,),
        up=np.array([0.0, 0.0, 1.0]),
        intensity_source="laser",
        buffer_front_m=0.2,
        buffer_behind_m=0.2,
    )


def places_of_cells(frame: WallFrame) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the positions of raster cell centres, metres across and down, each (rows, cols)."""
    across, down = np.meshgrid(np.arange(frame.width) + 0.5, np.arange(frame.height) + 0.5)
    return across * frame.gsd_m, down * frame.gsd_m


def _cut_window(values: NDArray[np.float64], gsd_m: float) -> None:
    left, right, top, bottom = (round(metres / gsd_m) for metres in (1.2, 1.44, 0.72, 0.9))
    values[top:bottom, left:right] = np.nan


def cloud_of(scene: TexturedWall, *, spacing_m: float = 0.005) -> PointCloud:
    """Return the wall as coloured points on a regular grid, with a station opposite its centre."""
    across, down = (
        places.ravel()
        for places in np.meshgrid(
            np.arange(spacing_m / 2, SIZE_M[0], spacing_m),
            np.arange(spacing_m / 2, SIZE_M[1], spacing_m),
        )
    )
    gsd_m, origin = scene.frame.gsd_m, scene.frame.origin_world
    points = scene.frame.world_from_wall(
        np.column_stack([across, down]) / gsd_m, scene.depth_m(across, down)
    )
    x, y, z = np.ascontiguousarray((points - origin).T, dtype=np.float32)
    grey = np.rint(255 * scene.grey(across, down)).astype(np.uint8)
    return PointCloud(
        origin=origin.copy(),
        x=x,
        y=y,
        z=z,
        up=np.array([0.0, 0.0, 1.0]),
        intensity=(grey / 255.0).astype(np.float32),
        rgb=np.repeat(grey[:, np.newaxis], 3, axis=1),
        stations=origin[np.newaxis] + [[SIZE_M[0] / 2, -2.6, -1.0]],
        stations_source="file",
    )


def two_halves(scene: TexturedWall) -> Layers:
    """Return layers of the left and the right 60 % of the wall, in its true colours."""
    frame = scene.frame
    grey = np.rint(255.0 * scene.grey(*places_of_cells(frame))).astype(np.uint8)
    across = np.broadcast_to(np.arange(frame.width) / frame.width, frame.shape)
    layers = []
    for source, shown in (("left", across < 0.6), ("right", across > 0.4)):
        mask = np.where(shown, LayerMask.PAINTED, LayerMask.OUTSIDE).astype(np.uint8)
        layers.append(
            Layer(
                frame=frame,
                wall=0,
                source=source,
                rgb=np.where(shown, grey, 0)[..., np.newaxis].repeat(3, axis=2),
                mask=mask,
                quality=shown.astype(np.float32),
            )
        )
    return Layers(layers=tuple(layers), names=("wall 0",))


def camera_before(
    scene: TexturedWall,
    *,
    centre: tuple[float, float, float] = (1.2, -2.6, 1.1),
    towards: tuple[float, float, float] = (1.5, 0.0, 1.0),
    roll: float = 0.0,
) -> ViewingCamera:
    """Return a distorted camera; positions are in metres from the wall's bottom-left corner."""
    corner = scene.frame.origin_world - [0.0, 0.0, SIZE_M[1]]
    rotation = looking_at(
        corner + np.array(centre), corner + np.array(towards), np.array([0.0, 0.0, 1.0])
    )
    rotation = rotation_from_vector(np.array([0.0, 0.0, roll])) @ rotation
    return ViewingCamera(
        width=900,
        height=640,
        fx=840.0,
        fy=843.0,
        cx=455.2,
        cy=316.4,
        distortion=np.array(DISTORTION),
        rotation=rotation,
        translation=-rotation @ (corner + np.array(centre)),
    )


def photo_of(
    scene: TexturedWall, camera: ViewingCamera, *, name: str = "a.png", calibrated: bool = True
) -> Photo:
    """Return the image that a camera takes, traced at pixel centres; black outside the wall."""
    return Photo(
        name=name,
        encoded=_picture(pickle.dumps((scene, camera))),
        width=camera.width,
        height=camera.height,
        exif_focal_px=None if calibrated else 1.02 * camera.fx,
        intrinsics=Intrinsics.of(camera) if calibrated else None,
    )


# An image takes half a second, and most tests of a method use the same few images.
@lru_cache(maxsize=32)
def _picture(pickled: bytes) -> bytes:
    """Return the image of a pickled scene and camera; equal ones share an entry of the cache."""
    scene: TexturedWall
    camera: ViewingCamera
    scene, camera = pickle.loads(pickled)
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = camera.rays_world(np.column_stack([columns.ravel(), rows.ravel()]))
    gsd_m = scene.frame.gsd_m
    start = scene.frame.wall_from_world(camera.centre_world[None])[0] * [gsd_m, gsd_m, 1.0]
    axes = np.vstack([scene.frame.u_world, scene.frame.v_world, scene.frame.normal_world])
    local = rays @ axes.T
    depth = np.zeros(len(rays))
    for _ in range(30):
        across, down = (start[i] + local[:, i] * (depth - start[2]) / local[:, 2] for i in range(2))
        before, depth = depth, scene.depth_m(across, down)
        if np.abs(depth - before).max() < 1e-7:
            break
    grey = np.where(
        (across > 0) & (across < SIZE_M[0]) & (down > 0) & (down < SIZE_M[1]),
        scene.grey(across, down),
        0.0,
    )
    return encode_png(np.rint(255 * grey).astype(np.uint8).reshape(camera.height, camera.width))


def oriented(camera: ViewingCamera, *, name: str = "a.png") -> Camera:
    """Return a photo's orientation as it is stored in the `Cameras` product."""
    return Camera(
        photo=name,
        status="ok",
        intrinsics=Intrinsics.of(camera),
        rotation_camera_from_world=camera.rotation,
        translation_camera_from_world=camera.translation,
    )


def photos(*items: Photo) -> Photos:
    """Return photos as a product."""
    return Photos(photos=items)


def cameras(*items: Camera) -> Cameras:
    """Return orientations as a product."""
    return Cameras(cameras=items)


def nudged(camera: ViewingCamera, vector: tuple[float, ...]) -> ViewingCamera:
    """Return the camera rotated by a small rotation vector (rad) and shifted (m)."""
    rotation = rotation_from_vector(np.array(vector[:3])) @ camera.rotation
    centre = camera.centre_world + np.array(vector[3:])
    return replace(camera, rotation=rotation, translation=-rotation @ centre)


def wall_error_m(scene: TexturedWall, found: ViewingCamera, true: ViewingCamera) -> float:
    """Return the RMS per coordinate, in the wall's plane, of projected pixels: found minus true."""
    steps = np.linspace(20.0, 620.0, 9)
    pixels = np.array([(u, v) for u in np.linspace(20.0, 880.0, 9) for v in steps])
    landed = []
    for camera in (found, true):
        rays = camera.rays_world(pixels)
        normal, offset = scene.frame.normal_world, scene.frame.plane.offset_m
        reach = (offset - camera.centre_world @ normal) / (rays @ normal)
        landed.append(camera.centre_world + reach[:, None] * rays)
    cells = scene.frame.wall_from_world(landed[1])[:, :2]
    inside = ((cells > 0) & (cells < [scene.frame.width, scene.frame.height])).all(axis=1)
    difference = (landed[0] - landed[1])[inside]
    return float(np.sqrt((difference**2).sum(axis=1).mean() / 2.0))


@cache
def photographed_scene(gsd_m: float = 0.006) -> TexturedWall:
    """Return the wall with the given cell size of its raster."""
    return textured_wall(1, gsd_m=gsd_m)


def photographing_cameras() -> Mapping[str, ViewingCamera]:
    """Return the true cameras by photo name."""
    scene = photographed_scene()
    return {
        "a.png": camera_before(scene),
        "b.png": camera_before(scene, centre=(1.9, -2.4, 0.8), towards=(1.5, 0.0, 1.0), roll=0.05),
    }


@cache
def _photos() -> Photos:
    scene, views = photographed_scene(), photographing_cameras()
    return photos(*(photo_of(scene, camera, name=name) for name, camera in views.items()))


@cache
def _cameras() -> Cameras:
    views = photographing_cameras()
    return cameras(*(oriented(settled_camera(view), name=name) for name, view in views.items()))


def settled_camera(camera: ViewingCamera) -> ViewingCamera:
    """Return a camera with a rounded pose, which has the same bits on every processor."""
    rotation, translation = settled(camera.rotation), settled(camera.translation)
    return replace(camera, rotation=rotation, translation=translation)


@cache
def _calibration() -> Calibration:
    camera = next(iter(photographing_cameras().values()))
    return Calibration(patterns=("*",), intrinsics=(Intrinsics.of(camera),))


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
    """Return ties with 0.3 px noise, of which every 25th is wrong by up to 40 px."""
    return drawn_ties(11, noise_m=0.0)


def drawn_ties(seed: int, *, noise_m: float = _TIE_SIGMA_M) -> Ties:
    """Return ties like those of the example, with other random numbers.

    Args:
        seed: seed of positions, noise and wrong ties.
        noise_m: standard deviation of the coordinates of points; by default, that stored in the
            ties.
    """
    rng = np.random.default_rng(seed)
    scene = photographed_scene()
    views = list(photographing_cameras().values())
    columns: list[tuple[NDArray[np.float64], ...]] = []
    for index, camera in enumerate(views):
        places = rng.random((320, 2)) * SIZE_M
        on_board = np.arange(len(places)) >= 220
        depths = np.where(on_board, _BOARD_M, scene.depth_m(places[:, 0], places[:, 1]))
        points = scene.frame.world_from_wall(places / scene.frame.gsd_m, depths)
        wall = on_board.astype(np.float64)
        pixels = camera.project(points)[:, :2]
        inside = (pixels > 10.0).all(axis=1)
        inside &= (pixels < [camera.width - 10.0, camera.height - 10.0]).all(axis=1)
        points, wall, pixels = points[inside], wall[inside], pixels[inside]
        pixels = pixels + _TIE_SIGMA_PX * rng.normal(size=pixels.shape)
        is_wrong = rng.random(len(pixels)) < _WRONG_SHARE
        pixels[is_wrong] += rng.uniform(-40.0, 40.0, (int(is_wrong.sum()), 2))
        if noise_m:
            points = points + noise_m * rng.normal(size=points.shape)
        columns.append((np.full(len(wall), float(index)), wall, pixels, points))
    photo, wall, pixels, points = (np.concatenate(column) for column in zip(*columns, strict=True))
    count = len(photo)
    return Ties(
        photo_names=tuple(photographing_cameras()),
        photo=photo.astype(np.int32),
        wall=wall.astype(np.int32),
        # Rounding errors of pixels are a millionth of the last digit kept.
        pixels_photo=settled(pixels, 6),
        points_world=settled(points),
        sigma_px=np.full(count, _TIE_SIGMA_PX),
        sigma_m=np.full(count, _TIE_SIGMA_M),
        role=np.full(count, TieRole.CONTROL, dtype=np.uint8),
        residual_px=np.full((count, 2), np.nan),
    )


PHOTOGRAPHED: Final[Mapping[str, Callable[[], Product]]] = {
    "photos": _photos,
    "cameras": _cameras,
    "calibration": _calibration,
    "ties": example_ties,
    "walls": cache(lambda: walls_of(photographed_scene())),
    "layers": cache(lambda: two_halves(photographed_scene())),
    "cloud": cache(lambda: cloud_of(photographed_scene(), spacing_m=0.01)),
    "checkpoints": _checkpoints,
}
