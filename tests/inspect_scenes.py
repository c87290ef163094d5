"""A textured wall, the laser's view of it, and orthoimages of it that are known to be wrong."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, shift

from orthoflow.files.publishing import publish_orthoimages
from orthoflow.geometry import WallFrame
from orthoflow.products import (
    CheckPoints,
    IntensitySource,
    Orthoimage,
    Orthoimages,
    OrthoMask,
    SurfaceMask,
    Wall,
    Walls,
)
from tests.raster_scenes import UP

GSD_M = 0.004
SHAPE = (280, 360)
BUFFER_M = 0.15


def frame(*, gsd_m: float = GSD_M, shape: tuple[int, int] = SHAPE) -> WallFrame:
    """A wall that faces -y."""
    return WallFrame(
        origin_world=np.array([1.0, 2.0, 3.0]),
        u_world=np.array([1.0, 0.0, 0.0]),
        v_world=np.array([0.0, 0.0, -1.0]),
        normal_world=np.array([0.0, -1.0, 0.0]),
        gsd_m=gsd_m,
        width=shape[1],
        height=shape[0],
    )


@cache
def texture() -> NDArray[np.float64]:
    """Blobs of several sizes, (rows, cols) 30..225."""
    rng = np.random.default_rng(11)
    total = sum(
        size * gaussian_filter(rng.normal(size=SHAPE), size, mode="wrap") for size in (2.0, 5.0)
    )
    spread = np.asarray(total) / np.std(total)
    return np.asarray(np.clip(128.0 + 45.0 * spread, 30.0, 225.0))


def walls(*, source: IntensitySource = "laser", where: WallFrame | None = None) -> Walls:
    """The wall, flat, as a laser sees it: another brightness, noise, and a void of no points."""
    rng = np.random.default_rng(12)
    seen = (texture() / 255.0) ** 1.5 + 0.02 * rng.normal(size=SHAPE)
    intensity = np.clip(seen, 0.0, 1.0).astype(np.float32)
    intensity[100:130, 200:240] = np.nan
    known = np.isfinite(intensity)
    wall = Wall(
        frame=where or frame(),
        plane_index=0,
        name="wall 0",
        depth_m=np.where(known, 0.0, np.nan).astype(np.float32),
        sigma_m=np.full(SHAPE, np.nan, dtype=np.float32),
        count=known.astype(np.uint32),
        mask=np.where(known, SurfaceMask.MEASURED, SurfaceMask.VOID).astype(np.uint8),
        intensity=None if source == "none" else intensity,
    )
    return Walls(
        walls=(wall,),
        up=UP,
        intensity_source=source,
        buffer_front_m=BUFFER_M,
        buffer_behind_m=BUFFER_M,
    )


def image_of(grey: NDArray[np.float64], where: WallFrame | None = None) -> Orthoimage:
    """A grey orthoimage that shows something everywhere."""
    level = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    return Orthoimage(
        frame=where or frame(shape=(grey.shape[0], grey.shape[1])),
        wall=0,
        name="wall 0",
        rgb=np.repeat(level[:, :, None], 3, axis=2),
        mask=np.full(grey.shape, OrthoMask.PAINTED, dtype=np.uint8),
        source=np.zeros(grey.shape, dtype=np.int16),
        sources=("photo",),
    )


def displaced(right_cells: float, down_cells: float) -> Orthoimage:
    """The wall's texture, shown too far to the right and too low."""
    return image_of(np.asarray(shift(texture(), (down_cells, right_cells), mode="grid-wrap")))


def surf_inputs() -> Mapping[str, Orthoimages | Walls]:
    """What `inspect.surf` takes."""
    return {"orthoimages": Orthoimages(images=(displaced(1.4, -0.6),)), "walls": walls()}


def points_at(
    points_world: NDArray[np.float64],
    *,
    classes: tuple[str, ...] = (),
    pixels: NDArray[np.float64] | None = None,
) -> CheckPoints:
    """Check points P0, P1 ..., measured in wall 0 where pixels are given."""
    count = len(points_world)
    return CheckPoints(
        names=tuple(f"P{k}" for k in range(count)),
        points_world=points_world,
        classes=classes or ("",) * count,
        wall=np.full(count, -1 if pixels is None else 0, dtype=np.int32),
        pixels_wall=np.full((count, 2), np.nan) if pixels is None else pixels,
    )


def checkpoint_inputs() -> Mapping[str, Orthoimages | Walls | CheckPoints]:
    """What `inspect.checkpoints` takes."""
    places = np.array([[50.0, 40.0], [200.0, 90.0], [300.0, 220.0]])
    points = points_at(frame().world_from_wall(places), pixels=places + np.array([[0.5, -0.25]]))
    return {"orthoimages": Orthoimages(images=(displaced(0, 0),)), "walls": walls()} | {
        "checkpoints": points
    }


def register_inputs() -> Mapping[str, CheckPoints]:
    """Pairs of points for `register.similarity`, a few millimetres off."""
    rng = np.random.default_rng(3)
    points = rng.uniform(-3.0, 3.0, (6, 3))
    moved = 1.001 * points[:, [1, 0, 2]] * (1.0, -1.0, 1.0) + (5.0, 6.0, 7.0)
    return {
        "points": points_at(points),
        "control": points_at(moved + 0.003 * rng.normal(size=(6, 3))),
    }


def orthoimage_file() -> bytes:
    """A GeoTIFF that says itself where it lies."""
    with TemporaryDirectory() as folder:
        publish_orthoimages(Orthoimages(images=(displaced(0, 0),)), Path(folder), "digest")
        return (Path(folder) / "wall_0_ortho.tif").read_bytes()
