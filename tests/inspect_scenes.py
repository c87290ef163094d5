"""A textured wall, the laser's view of it, and orthoimages of it that are known to be wrong."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, shift

from orthoflow.files.publishing import publish_orthoimages
from orthoflow.geometry import WallFrame
from orthoflow.geometry.scene_views import TrueOrthoimage, render
from orthoflow.geometry.scenes import Scene, SurfaceRole
from orthoflow.products import (
    CheckPoints,
    Inspection,
    IntensitySource,
    Layer,
    LayerMask,
    Orthoimage,
    Orthoimages,
    OrthoMask,
    Planes,
    PointLabels,
    Product,
    Truth,
    Walls,
)
from orthoflow.sdk import Method, StepContext
from tests import samples
from tests.raster_scenes import UP, numbers
from tests.scene_rays import a_scene

GSD_M = 0.004
SHAPE = (280, 360)
BUFFER_M = 0.15


def frame(*, gsd_m: float = GSD_M, shape: tuple[int, int] = SHAPE) -> WallFrame:
    """A wall that faces -y."""
    return samples.facing_south(gsd_m, shape[1], shape[0], (1.0, 2.0, 3.0))


def painted_layer(
    name: str, columns: slice, rgb: NDArray[np.uint8] | NDArray[np.uint16], quality: float
) -> Layer:
    """A layer of the first wall that paints some columns of a picture (rows, cols, 3)."""
    is_painted = np.zeros(rgb.shape[:2], dtype=np.bool_)
    is_painted[:, columns] = True
    return samples.layer(
        np.where(is_painted, LayerMask.PAINTED, LayerMask.OUTSIDE).astype(np.uint8),
        frame=frame(shape=(rgb.shape[0], rgb.shape[1])),
        source=name,
        rgb=np.where(is_painted[..., None], rgb, rgb.dtype.type(0)),
        quality=np.where(is_painted, np.float32(quality), np.float32(0.0)),
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
    wall = samples.wall(
        where or frame(),
        depth_m=np.where(known, 0.0, np.nan).astype(np.float32),
        sigma_m=np.full(SHAPE, np.nan, dtype=np.float32),
        count=known.astype(np.uint32),
        intensity=None if source == "none" else intensity,
    )
    return samples.walls(wall, up=UP, intensity_source=source, buffer_m=BUFFER_M)


def image_of(grey: NDArray[np.float64], where: WallFrame | None = None) -> Orthoimage:
    """A grey orthoimage that shows something everywhere."""
    level = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    return samples.orthoimage(
        where or frame(shape=(grey.shape[0], grey.shape[1])),
        rgb=np.repeat(level[:, :, None], 3, axis=2),
        sources=("photo",),
    )


def displaced(right_cells: float, down_cells: float) -> Orthoimage:
    """The wall's texture, shown too far to the right and too low."""
    return image_of(np.asarray(shift(texture(), (down_cells, right_cells), mode="grid-wrap")))


def surf_inputs() -> Mapping[str, Orthoimages | Walls]:
    """What `inspect.surf` takes."""
    return {"orthoimages": Orthoimages(images=(displaced(1.4, -0.6),)), "walls": walls()}


def inspected(
    method: type[Method], folder: Path, params: Mapping[str, object] | None = None, **inputs: Any
) -> tuple[dict[str, float], Inspection, StepContext]:
    """The metrics of an inspection, what it found, and what it reported."""
    ctx = StepContext(rng=np.random.default_rng(0), cores=2, scratch=folder)
    out: Any = method().run(method.In(**inputs), method.Params.model_validate(params or {}), ctx)
    return numbers(ctx), out.inspection, ctx


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


# A wall of 1.2 m x 0.8 m that faces -y, a board 6 cm before it and a chair 40 cm before it. All
# rims lie on borders of cells, between the rays that look at them. The frame lies 3 mm before it.
TRUE_FRAME = samples.facing_south(0.008, 150, 100, (0.0, -0.003, 0.8))


def truth_scene() -> Scene:
    """Wall, board and chair, each with stains of another seed."""
    rows: list[dict[str, object]] = [
        {"centre": (0.6, 0.0, 0.4), "extent": (-0.6, 0.6, -0.4, 0.4)},
        {"centre": (0.28, -0.06, 0.4), "extent": (-0.12, 0.12, -0.16, 0.16)},
        {"centre": (0.88, -0.4, 0.16), "extent": (-0.08, 0.08, -0.16, 0.16)},
    ]
    roles = (SurfaceRole.WALL, SurfaceRole.RELIEF, SurfaceRole.OBJECT)
    for row, role, seed in zip(rows, roles, (11.0, 12.0, 13.0), strict=True):
        params = (150.0, 120.0, 90.0, 0.6, 0.8, 0.25, seed, 0.0)
        row |= {"a": samples.EAST, "b": UP, "role": role, "params": params}
    return replace(a_scene(rows), plane_index=np.array([0, 1, -1], dtype=np.int16))


def true_planes(*, lift_m: float = 0.0) -> Planes:
    """Wall and board."""
    corners = np.array(
        [
            [[0.0, 0.0, 0.8], [0.0, 0.0, 0.0], [1.2, 0.0, 0.0], [1.2, 0.0, 0.8]],
            [[0.16, -0.06, 0.56], [0.16, -0.06, 0.24], [0.4, -0.06, 0.24], [0.4, -0.06, 0.56]],
        ]
    )
    return samples.planes(
        normal=np.tile([0.0, -1.0, 0.0], (2, 1)),
        offset=np.array([0.0, 0.06]) + lift_m,
        corners=corners - np.array([0.0, lift_m, 0.0]),
        n_points=np.array([600, 200]),
        rms_m=np.full(2, 0.001),
        names=("main wall", "board"),
        viewpoint="stations",
    )


def true_orthoimage(*, right_cells: float = 0.0, down_cells: float = 0.0) -> TrueOrthoimage:
    """What there is to see, shown too far to the right and too low."""
    moved = TRUE_FRAME.world_from_wall(np.array([[-right_cells, -down_cells]]))[0]
    image = render(
        truth_scene(),
        replace(TRUE_FRAME, origin_world=moved),
        front_m=BUFFER_M,
        behind_m=BUFFER_M,
    )
    return replace(image, frame=TRUE_FRAME)


def truth_inputs() -> Mapping[str, Product]:
    """What `inspect.truth` takes: all errors are introduced, and are larger than the noise.

    Displaced by 0.5 and -0.25 cells; 2 mm too near, and 8 mm on the left, four times what is
    stated; two white spots, one behind the chair; a part that is filled and one that nothing
    shows; planes 4 mm off; a tenth of the labels missing.
    """
    shown, true = true_orthoimage(right_cells=0.5, down_cells=-0.25), true_orthoimage()
    rgb = np.nan_to_num(shown.rgb).round().astype(np.uint8)
    rgb[70:80, 20:40] = rgb[70:80, 114:120] = 255
    mask = np.full(TRUE_FRAME.shape, OrthoMask.PAINTED, dtype=np.uint8)
    mask[5:15, 60:90] = OrthoMask.FILLED
    mask[40:50, 120:140] = OrthoMask.NONE
    depth = true.depth_m + np.float32(2.0**-9)
    depth[:, :20] = true.depth_m[:, :20] + np.float32(2.0**-7)
    depth[60:70, 60:80] = np.nan
    known = np.isfinite(depth)
    image = replace(image_of(np.zeros(TRUE_FRAME.shape), TRUE_FRAME), rgb=rgb, mask=mask)
    wall = samples.wall(
        TRUE_FRAME,
        name="main wall",
        depth_m=depth,
        sigma_m=np.where(known, 2.0**-9, np.nan).astype(np.float32),
        count=known.astype(np.uint32),
    )
    labels = np.repeat([0, 1, -1], [600, 200, 200]).astype(np.int16)
    found = np.where(labels < 0, -1, 1 - labels)
    found[::10] = -1
    return {
        "truth": Truth(
            scene=truth_scene(),
            planes=true_planes(),
            labels=labels,
            stations=np.array([[0.5, -2.0, 0.3]]),
        ),
        "orthoimages": Orthoimages(images=(image,)),
        "walls": samples.walls(wall, buffer_m=BUFFER_M),
        "planes": true_planes(lift_m=0.004),
        "labels": PointLabels(plane_index=found.astype(np.int16)),
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
