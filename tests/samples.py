"""Grids and products as tests want them: what a test does not say is plain."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthoflow.geometry import Cone, Cylinder, WallFrame
from orthoflow.geometry.cameras import ViewingCamera, looking_at
from orthoflow.geometry.key_points import Features
from orthoflow.geometry.resection import SeenPoints
from orthoflow.products import (
    Layer,
    LayerMask,
    Orthoimage,
    OrthoMask,
    Planes,
    Surface,
    SurfaceMask,
    Surfaces,
    Ties,
    TieWall,
    Wall,
    Walls,
)

UP = np.array([0.0, 0.0, 1.0])
DOWN, SOUTH = np.array([0.0, 0.0, -1.0]), np.array([0.0, -1.0, 0.0])
EAST, NORTH = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])


def facing_south(
    gsd_m: float, width: int, height: int, corner: ArrayLike = (0.0, 0.0, 0.0)
) -> WallFrame:
    """The grid of an upright wall, seen along +y: u along x."""
    return _upright(EAST, SOUTH, gsd_m, (width, height), corner)


def facing_east(
    gsd_m: float, width: int, height: int, corner: ArrayLike = (0.0, 0.0, 0.0)
) -> WallFrame:
    """The grid of an upright wall, seen along -x: u along y."""
    return _upright(NORTH, EAST, gsd_m, (width, height), corner)


def _upright(
    u_world: NDArray[np.float64],
    normal_world: NDArray[np.float64],
    gsd_m: float,
    size: tuple[int, int],
    corner: ArrayLike,
) -> WallFrame:
    return WallFrame(
        origin_world=np.array(corner, dtype=np.float64),
        u_world=u_world.copy(),
        v_world=DOWN.copy(),
        normal_world=normal_world.copy(),
        gsd_m=gsd_m,
        width=size[0],
        height=size[1],
    )


# Any: fields of the camera or product, each of its own type.
def camera(
    rotation: NDArray[np.float64], centre: NDArray[np.float64], **known: Any
) -> ViewingCamera:
    """A camera that stands at a place, without distortion."""
    lens = {"distortion": np.zeros(5), **known}
    return ViewingCamera(rotation=rotation, translation=-rotation @ centre, **lens)


def aimed(
    centre: ArrayLike, target: ArrayLike, focal_px: float, size_px: tuple[int, int], **known: Any
) -> ViewingCamera:
    """A level camera that looks at a point, whose principal point is in the middle of its image."""
    width, height = size_px
    lens = {"fx": focal_px, "fy": focal_px, "cx": 0.5 * width, "cy": 0.5 * height, **known}
    place = np.array(centre, dtype=np.float64)
    rotation = looking_at(place, np.array(target, dtype=np.float64), UP)
    return camera(rotation, place, width=width, height=height, **lens)


def wall(frame: WallFrame, **known: Any) -> Wall:
    """A raster of one point per cell, flat and void where the depth is NaN."""
    depth_m = known.get("depth_m", np.zeros(frame.shape, dtype=np.float32))
    is_void = np.isnan(depth_m)
    plain = {
        "plane_index": 0,
        "name": "wall 0",
        "depth_m": depth_m,
        "sigma_m": np.zeros(frame.shape, dtype=np.float32),
        "count": np.ones(frame.shape, dtype=np.uint32),
        "mask": np.where(is_void, SurfaceMask.VOID, SurfaceMask.MEASURED).astype(np.uint8),
    }
    return Wall(frame=frame, **{**plain, **known})


def walls(*rasters: Wall, buffer_m: float = 0.15, **known: Any) -> Walls:
    """Rasters without intensity, the same buffer before and behind them, z up."""
    plain = {
        "up": UP.copy(),
        "intensity_source": "none",
        "buffer_front_m": buffer_m,
        "buffer_behind_m": buffer_m,
    }
    return Walls(walls=rasters, **{**plain, **known})


def planes(**known: Any) -> Planes:
    """Planes that their points lie on exactly, z up."""
    count = len(known["normal"])
    plain = {
        "covariance": np.zeros((count, 4, 4)),
        "n_points": np.full(count, 100),
        "rms_m": np.zeros(count),
        "up": UP.copy(),
    }
    return Planes(**{**plain, **known})


def layer(mask: NDArray[np.uint8] | tuple[int, int], **known: Any) -> Layer:
    """A black layer of the first wall, or of its cells where it is painted everywhere."""
    if isinstance(mask, tuple):
        mask = np.full(mask, LayerMask.PAINTED, dtype=np.uint8)
    plain = {
        "frame": facing_south(0.01, mask.shape[1], mask.shape[0]),
        "wall": 0,
        "source": "a.jpg",
        "rgb": np.zeros((*mask.shape, 3), dtype=np.uint8),
        "quality": (mask == LayerMask.PAINTED).astype(np.float32),
    }
    return Layer(mask=mask, **{**plain, **known})


def orthoimage(frame: WallFrame, **known: Any) -> Orthoimage:
    """An image of the first wall that one photo paints everywhere."""
    plain = {
        "wall": 0,
        "name": "wall 0",
        "mask": np.full(frame.shape, OrthoMask.PAINTED, dtype=np.uint8),
        "source": np.zeros(frame.shape, dtype=np.int16),
        "sources": ("a.jpg",),
    }
    return Orthoimage(frame=frame, **{**plain, **known})


def ties(pixels_photo: NDArray[np.float64], **known: Any) -> Ties:
    """Ties of one photo with the first wall, before an orientation."""
    count = len(pixels_photo)
    plain = {
        "photo_names": ("a.png",),
        "photo": np.zeros(count, np.int32),
        "wall": np.zeros(count, np.int32),
        "role": np.zeros(count, np.uint8),
        "residual_px": np.full((count, 2), np.nan),
    }
    return Ties(pixels_photo=pixels_photo, **{**plain, **known})


def features(pixels: NDArray[np.float64], **known: Any) -> Features:
    """Key points of one size and direction, whose descriptors tell nothing unless given."""
    n = len(pixels)
    usual: dict[str, Any] = {
        "sizes_px": np.full(n, 4.0),
        "angles_deg": np.zeros(n),
        "descriptors": np.zeros((n, 128), dtype=np.float32),
    }
    return Features(pixels=np.asarray(pixels, dtype=np.float64), **{**usual, **known})


def seen(
    pixels: NDArray[np.float64],
    points_world: NDArray[np.float64],
    sigma_px: float = 1.0,
    sigma_m: float = 0.0,
) -> SeenPoints:
    """Points and their pixels, all with the same standard deviations."""
    n = len(pixels)
    return SeenPoints(
        pixels_photo=pixels,
        points_world=points_world,
        sigma_px=np.full(n, sigma_px),
        sigma_m=np.full(n, sigma_m),
    )


def tie_wall(corners_world: NDArray[np.float64], gsd_m: float) -> TieWall:
    """The wall of ties that looks to -y."""
    return TieWall(
        gsd_m=gsd_m,
        normal_world=(0.0, -1.0, 0.0),
        corners_world=tuple(map(tuple, corners_world.tolist())),
    )


def taken(ties: Ties, chosen: NDArray[np.bool_] | NDArray[np.intp] | slice) -> Ties:
    """Some of the ties."""
    arrays = {name: value for name, value in vars(ties).items() if isinstance(value, np.ndarray)}
    return replace(ties, **{name: array[chosen] for name, array in arrays.items()})


def surfaces() -> Surfaces:
    """A vault above the plane z = 2, seen from below, and a tower that becomes narrower."""
    vault = Cylinder(
        point_world=np.array([1.0, 2.0, 2.0]), axis_world=NORTH, radius_m=3.0, is_concave=True
    )
    tower = Cone(
        apex_world=np.array([9.0, 0.0, 50.0]),
        axis_world=DOWN,
        half_angle_rad=0.1,
        is_concave=False,
    )
    known: dict[str, Any] = {"covariance": 1e-8 * np.eye(7), "n_points": 3, "rms_m": 0.002}
    return Surfaces(
        surfaces=(
            Surface(
                name="vault 0",
                shape=vault,
                zero_world=UP,
                along_m=(-2.0, 2.0),
                arc_rad=(-1.3, 1.3),
                **known,
            ),
            Surface(
                name="cone 1",
                shape=tower,
                zero_world=EAST,
                along_m=(30.0, 50.0),
                arc_rad=(-np.pi, np.pi),
                **known,
            ),
        ),
        up=UP,
    )
