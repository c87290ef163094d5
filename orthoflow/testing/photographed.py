"""A textured wall with known relief: as a raster, as a cloud, and in photos with lens distortion.

It is the example for methods that use photographs. Depth and colour are functions of the position
on the wall, so the true values of cells and pixels and the true poses are known exactly.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.images import encode_png
from orthoflow.geometry import WallFrame, up_vector
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
from orthoflow.testing.surveyed import few_points, settled

_Array: TypeAlias = NDArray[np.float64]

SIZE_M: Final = (3.0, 2.0)
GSD_M: Final = 0.006
DISTORTION: Final = (-0.09, 0.03, 6e-4, -4e-4, 0.0)
RELIEF_M: Final = 0.06
# Wavelengths of the texture. The shortest is four cells, to avoid aliasing in the raster and the
# photos.
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
    noises: tuple[_Array, ...]

    def depth_m(self, across_m: _Array, down_m: _Array) -> _Array:
        """Return the relief in metres, positive towards the viewer, at positions on the wall."""
        wave = np.sin(2.1 * across_m) * np.cos(2.9 * down_m + 0.4)
        return RELIEF_M * (wave + 0.4 * np.sin(5.0 * across_m + 1))

    def grey(self, across_m: _Array, down_m: _Array) -> _Array:
        """Return the grey value, 0 to 1, at positions in metres from the top-left corner."""
        from scipy.ndimage import map_coordinates  # noqa: PLC0415 - loads slowly, and here alone

        total = np.zeros(np.broadcast(across_m, down_m).shape)
        for step, noise in zip(_OCTAVES_M, self.noises, strict=True):
            at = [down_m / step + 8.0, across_m / step + 8.0]
            total += map_coordinates(noise, at, order=3, mode="mirror")
        return 1.0 / (1.0 + np.exp(-1.3 * total))


def textured_wall(seed: int = 1, *, gsd_m: float = GSD_M) -> TexturedWall:
    """Return a 3 m x 2 m wall with 6 cm relief, whose bottom-left corner is the origin.

    Args:
        seed: seed of the texture; the examples use the default.
        gsd_m: cell size of its raster.
    """
    rng = np.random.default_rng(seed)
    frame = WallFrame(
        origin_world=np.array([0.0, 0.0, SIZE_M[1]]),
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


def walls_of(scene: TexturedWall) -> Walls:
    """Return the scanned wall with a window; its contrast curve differs from that of the photos."""
    frame = scene.frame
    across, down = places_of_cells(frame)
    rng = np.random.default_rng(5)
    grey = scene.grey(across, down)
    intensity = 0.2 + 0.5 * grey**1.4 + 0.02 * rng.normal(size=grey.shape)
    depth = scene.depth_m(across, down) + 0.001 * rng.normal(size=across.shape)
    left, right, top, bottom = (round(m / frame.gsd_m) for m in (1.2, 1.44, 0.72, 0.9))
    intensity[top:bottom, left:right] = np.nan
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


def places_of_cells(frame: WallFrame) -> tuple[_Array, _Array]:
    """Return the metres across and down to the centres of cells, as two arrays (rows, cols)."""
    across, down = np.meshgrid(np.arange(frame.width) + 0.5, np.arange(frame.height) + 0.5)
    return across * frame.gsd_m, down * frame.gsd_m


def cloud_of(scene: TexturedWall, *, spacing_m: float = 0.005) -> PointCloud:
    """Return the wall as coloured points on a regular grid, with a station opposite its centre."""
    grid = np.meshgrid(*(np.arange(spacing_m / 2, size_m, spacing_m) for size_m in SIZE_M))
    across, down = (places.ravel() for places in grid)
    cells, origin = np.column_stack([across, down]) / scene.frame.gsd_m, scene.frame.origin_world
    points = scene.frame.world_from_wall(cells, scene.depth_m(across, down))
    grey = np.rint(255 * scene.grey(across, down)).astype(np.uint8)
    stations = origin[np.newaxis] + [[SIZE_M[0] / 2, -2.6, -1.0]]
    return replace(few_points(points - origin, grey), origin=origin.copy(), stations=stations)


def two_halves(scene: TexturedWall) -> Layers:
    """Return layers of the left and the right 60 % of the wall, in its true colours."""
    frame = scene.frame
    grey = np.rint(255.0 * scene.grey(*places_of_cells(frame))).astype(np.uint8)
    across = np.broadcast_to(np.arange(frame.width) / frame.width, frame.shape)
    layers = []
    for source, shown in (("left", across < 0.6), ("right", across > 0.4)):
        one = Layer(
            frame=frame,
            wall=0,
            source=source,
            rgb=np.where(shown, grey, 0)[..., np.newaxis].repeat(3, axis=2),
            mask=np.where(shown, LayerMask.PAINTED, LayerMask.OUTSIDE).astype(np.uint8),
            quality=shown.astype(np.float32),
        )
        layers.append(one)
    return Layers(layers=tuple(layers), names=("wall 0",))


def camera_before(
    *,
    centre: tuple[float, float, float] = (1.2, -2.6, 1.1),
    towards: tuple[float, float, float] = (1.5, 0.0, 1.0),
    roll: float = 0.0,
) -> ViewingCamera:
    """Return a camera with lens distortion that looks from `centre` at `towards`, in metres."""
    upright = looking_at(np.array(centre), np.array(towards), up_vector("z"))
    rotation = rotation_from_vector(np.array([0.0, 0.0, roll])) @ upright
    return ViewingCamera(
        width=900,
        height=640,
        fx=840.0,
        fy=843.0,
        cx=455.2,
        cy=316.4,
        distortion=np.array(DISTORTION),
        rotation=rotation,
        translation=-rotation @ np.array(centre),
    )


def photo_of(
    scene: TexturedWall, camera: ViewingCamera, *, name: str = "a.png", calibrated: bool = True
) -> Photo:
    """Return the photo that a camera takes, ray-traced at pixel centres; black outside the wall."""
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
    known: tuple[TexturedWall, ViewingCamera] = pickle.loads(pickled)
    scene, camera = known
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = camera.rays_world(np.column_stack([columns.ravel(), rows.ravel()]))
    gsd_m = scene.frame.gsd_m
    start = scene.frame.wall_from_world(camera.centre_world[None])[0] * [gsd_m, gsd_m, 1.0]
    local = scene.frame.axes_world @ rays.T
    slopes, depth = local[:2] / local[2], np.zeros(len(rays))
    for _ in range(30):
        across, down = start[:2, None] + slopes * (depth - start[2])
        before, depth = depth, scene.depth_m(across, down)
        if np.abs(depth - before).max() < 1e-7:
            break
    inside = (across > 0) & (across < SIZE_M[0]) & (down > 0) & (down < SIZE_M[1])
    grey = np.zeros(inside.shape)
    grey[inside] = np.rint(255 * scene.grey(across[inside], down[inside]))
    return encode_png(grey.astype(np.uint8).reshape(camera.height, camera.width))


def oriented(camera: ViewingCamera, *, name: str = "a.png") -> Camera:
    """Return the orientation of a photo for the `Cameras` product."""
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
    """Return the RMS error of a camera on the wall, in metres per coordinate.

    It is computed from pixels that are projected onto the wall with the found and the true camera.
    """
    pixels = np.mgrid[20.0:880.0:9j, 20.0:620.0:9j].reshape(2, -1).T
    landed = []
    for camera in (found, true):
        rays = camera.rays_world(pixels)
        plane = scene.frame.plane
        reach = -plane.distances_m(camera.centre_world[None]) / (rays @ plane.normal)
        landed.append(camera.centre_world + reach[:, None] * rays)
    cells = scene.frame.wall_from_world(landed[1])[:, :2]
    inside = ((cells > 0) & (cells < scene.frame.shape[::-1])).all(axis=1)
    difference = (landed[0] - landed[1])[inside]
    return float(np.sqrt((difference**2).sum(axis=1).mean() / 2.0))


# True cameras by photo name.
PHOTOGRAPHING: Final[Mapping[str, ViewingCamera]] = {
    "a.png": camera_before(),
    "b.png": camera_before(centre=(1.9, -2.4, 0.8), towards=(1.5, 0.0, 1.0), roll=0.05),
}


def _photos() -> Photos:
    scene = textured_wall()
    return photos(*(photo_of(scene, view, name=name) for name, view in PHOTOGRAPHING.items()))


def _cameras() -> Cameras:
    views = PHOTOGRAPHING.items()
    return cameras(*(oriented(settled_camera(view), name=name) for name, view in views))


def settled_camera(camera: ViewingCamera) -> ViewingCamera:
    """Return a camera with a rounded pose, which has the same bits on every processor."""
    rotation, translation = settled(camera.rotation), settled(camera.translation)
    return replace(camera, rotation=rotation, translation=translation)


def _calibration() -> Calibration:
    return Calibration(patterns=("*",), intrinsics=(Intrinsics.of(PHOTOGRAPHING["a.png"]),))


def _checkpoints() -> CheckPoints:
    frame = textured_wall().frame
    pixels = np.array([[50.0, 60.0], [440.0, 70.0], [250.0, 170.0], [60.0, 280.0], [430.0, 270.0]])
    return CheckPoints(
        names=("P0", "P1", "P2", "P3", "P4"),
        points_world=frame.world_from_wall(pixels),
        classes=("flat",) * 5,
        wall=np.zeros(5, dtype=np.int32),
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
        noise_m: standard deviation of the coordinates of points; the default is the one stored in
            the ties.
    """
    rng = np.random.default_rng(seed)
    scene = textured_wall()
    tables: list[_Array] = []  # photo, wall, two of the pixel, three of the point
    for index, camera in enumerate(PHOTOGRAPHING.values()):
        places = rng.random((320, 2)) * SIZE_M
        on_board = np.arange(len(places)) >= 220
        depths = np.where(on_board, _BOARD_M, scene.depth_m(places[:, 0], places[:, 1]))
        points = scene.frame.world_from_wall(places / scene.frame.gsd_m, depths)
        pixels = camera.project(points)[:, :2]
        far = [camera.width - 10.0, camera.height - 10.0]
        inside = ((pixels > 10.0) & (pixels < far)).all(axis=1)
        photo = np.full(len(places), index)
        table = np.column_stack([photo, on_board, pixels, points])[inside]
        table[:, 2:4] += _TIE_SIGMA_PX * rng.normal(size=(len(table), 2))
        is_wrong = rng.random(len(table)) < _WRONG_SHARE
        table[is_wrong, 2:4] += rng.uniform(-40.0, 40.0, (int(is_wrong.sum()), 2))
        if noise_m:
            table[:, 4:] += noise_m * rng.normal(size=(len(table), 3))
        tables.append(table)
    rows = np.concatenate(tables)
    count = len(rows)
    return Ties(
        photo_names=tuple(PHOTOGRAPHING),
        photo=rows[:, 0].astype(np.int32),
        wall=rows[:, 1].astype(np.int32),
        # Rounding errors of pixel coordinates are a millionth of the last digit kept.
        pixels_photo=settled(rows[:, 2:4], 6),
        points_world=settled(rows[:, 4:]),
        sigma_px=np.full(count, _TIE_SIGMA_PX),
        sigma_m=np.full(count, _TIE_SIGMA_M),
        role=np.full(count, TieRole.CONTROL, dtype=np.uint8),
        residual_px=np.full((count, 2), np.nan),
    )


PHOTOGRAPHED: Final[Mapping[str, Callable[[], Product]]] = {
    "photos": cache(_photos),
    "cameras": cache(_cameras),
    "calibration": cache(_calibration),
    "ties": example_ties,
    "walls": cache(lambda: walls_of(textured_wall())),
    "layers": cache(lambda: two_halves(textured_wall())),
    "cloud": cache(lambda: cloud_of(textured_wall(), spacing_m=0.01)),
    "checkpoints": cache(_checkpoints),
}
