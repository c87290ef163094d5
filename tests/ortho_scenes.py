"""A wall with a step and a board that stands free before it, and photos of it, known exactly.

The wall's colours tell the place: red and green count four grey levels per column and row, blue
tells the surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.images import encode_png
from orthoflow.geometry import WallFrame, wall_axes
from orthoflow.geometry.cameras import ViewingCamera, looking_at
from orthoflow.products import (
    Cameras,
    Layer,
    Photo,
    Photos,
    PointCloud,
    Walls,
)
from orthoflow.sdk import StepContext
from orthoflow.testing import photographed as ms
from tests import samples
from tests.method_runs import run
from tests.raster_scenes import SURVEY, UP, cell_centres, cloud_of, context

GSD_M = 0.004
SHAPE = (240, 320)
STEP_COLUMN = 192
STEP_M = 0.05
BOARD_COLUMNS = (70.0, 130.0)
BOARD_ROWS = (60.0, 150.0)
BOARD_M = 0.4
BUFFER_M = 0.15
DISTORTION = np.array([-0.11, 0.04, 1.2e-3, -8e-4, -5e-3])

BASE, RAISED, SIDE, BOARD, NOTHING = range(5)
BLUE = np.array([40, 90, 140, 255, 0])


@dataclass(frozen=True, kw_only=True)
class Seen:
    """Where rays first meet the scene: (n, 3) column, row, depth in metres, and the surface."""

    places: NDArray[np.float64]
    surface: NDArray[np.int64]


def frame(*, at_survey: bool = False) -> WallFrame:
    """A wall turned by 102 degrees."""
    omega = np.radians(102.0)
    normal = np.array([np.cos(omega), np.sin(omega), 0.0])
    u, v = wall_axes(normal, UP)
    return WallFrame(
        origin_world=np.array([1.0, 2.0, 3.0]) + (SURVEY if at_survey else 0.0),
        u_world=u,
        v_world=v,
        normal_world=normal,
        gsd_m=GSD_M,
        width=SHAPE[1],
        height=SHAPE[0],
    )


def camera(
    where: WallFrame, *, aside_m: float = -0.7, width: int = 1000, distorted: bool = True
) -> ViewingCamera:
    """A camera 2 m before the wall, beside its middle."""
    middle = np.array([[0.5 * where.width, 0.5 * where.height]])
    target = where.world_from_wall(middle)[0]
    centre = target + 2.0 * where.normal_world + aside_m * where.u_world - 0.1 * where.v_world
    rotation = looking_at(centre, target, UP)
    return samples.camera(
        rotation,
        centre,
        width=width,
        height=width * 4 // 5,
        fx=1.5 * width,
        fy=1.51 * width,
        cx=0.51 * width,
        cy=0.39 * width,
        distortion=DISTORTION if distorted else np.zeros(5),
    )


def cast(where: WallFrame, origins: NDArray[np.float64], directions: NDArray[np.float64]) -> Seen:
    """Follow rays (n, 3) from (n, 3) in world coordinates; the scene is solid behind its front."""
    axes = np.column_stack([where.u_world / GSD_M, where.v_world / GSD_M, where.normal_world])
    start = (origins - where.origin_world) @ axes
    along = directions @ axes
    best = np.full(len(start), np.inf)
    surface = np.full(len(start), NOTHING)
    planes = [
        (2, 0.0, BASE, lambda p: p[:, 0] < STEP_COLUMN),
        (2, STEP_M, RAISED, lambda p: p[:, 0] >= STEP_COLUMN),
        (0, STEP_COLUMN, SIDE, lambda p: (p[:, 2] > 0.0) & (p[:, 2] < STEP_M)),
        (2, BOARD_M, BOARD, _is_on_board),
    ]
    for axis, value, name, is_there in planes:
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (value - start[:, axis]) / along[:, axis]
            hit = is_there(start + t[:, None] * along) & (t > 1e-9) & (t < best)
        best[hit], surface[hit] = t[hit], name
    reach = np.where(np.isfinite(best), best, 0.0)
    return Seen(places=start + reach[:, None] * along, surface=surface)


def _is_on_board(places: NDArray[np.float64]) -> NDArray[np.bool_]:
    (left, right), (top, bottom) = BOARD_COLUMNS, BOARD_ROWS
    across = (places[:, 0] >= left) & (places[:, 0] < right)
    down = (places[:, 1] >= top) & (places[:, 1] < bottom)
    return np.asarray(across & down)


def colours(seen: Seen) -> NDArray[np.uint8]:
    """Colours (n, 3) of what rays meet."""
    counts = np.floor(4.0 * seen.places[:, :2]) % 256
    on_wall = np.isin(seen.surface, (BASE, RAISED))[:, None]
    places = np.where(on_wall, counts, 0.0)
    return np.column_stack([places, BLUE[seen.surface]]).astype(np.uint8)


@lru_cache(maxsize=8)
def _rendered(aside_m: float, width: int) -> NDArray[np.uint8]:
    where = frame()
    viewer = camera(where, aside_m=aside_m, width=width)
    rays = viewer.rays_world(np.column_stack(cell_centres((viewer.height, viewer.width))))
    origins = np.broadcast_to(viewer.centre_world, rays.shape)
    return colours(cast(where, origins, rays)).reshape(viewer.height, viewer.width, 3)


def rendered(*, aside_m: float = -0.7, width: int = 1000) -> NDArray[np.uint8]:
    """What the camera sees, (height, width, 3)."""
    return _rendered(aside_m, width)


def photos(*pictures: NDArray[np.uint8]) -> Photos:
    """Photos named 0.png, 1.png ..."""
    return Photos(
        photos=tuple(
            Photo(
                name=f"{k}.png",
                encoded=encode_png(picture),
                width=picture.shape[1],
                height=picture.shape[0],
            )
            for k, picture in enumerate(pictures)
        )
    )


def cameras(*viewers: ViewingCamera) -> Cameras:
    """Orientations of photos 0.png, 1.png ..."""
    return ms.cameras(*(ms.oriented(viewer, name=f"{k}.png") for k, viewer in enumerate(viewers)))


def depth_m() -> NDArray[np.float32]:
    """The true depth of each cell of the wall."""
    depths = np.zeros(SHAPE, dtype=np.float32)
    depths[:, STEP_COLUMN:] = STEP_M
    return depths


def walls(where: WallFrame, depths: NDArray[np.float32] | None = None) -> Walls:
    """The wall as a raster."""
    surface = depth_m() if depths is None else depths
    wall = samples.wall(
        where, depth_m=surface, sigma_m=np.full(surface.shape, np.nan, dtype=np.float32)
    )
    return samples.walls(wall, buffer_m=BUFFER_M)


def cloud(where: WallFrame, *, spacing_cells: float = 0.9, n_outliers: int = 0) -> PointCloud:
    """Points on the wall and on the board, and outliers in between, alone."""
    rng = np.random.default_rng(5)
    wall = _grid((0.0, SHAPE[1]), (0.0, SHAPE[0]), spacing_cells)
    wall_depths = np.where(wall[:, 0] < STEP_COLUMN, 0.0, STEP_M)
    board = _grid(BOARD_COLUMNS, BOARD_ROWS, spacing_cells)
    far = rng.uniform([0, 0], [SHAPE[1], SHAPE[0]], (n_outliers, 2))
    points = [
        where.world_from_wall(wall, wall_depths),
        where.world_from_wall(board, np.full(len(board), BOARD_M)),
        where.world_from_wall(far, rng.uniform(0.5, 1.5, n_outliers)),
    ]
    return cloud_of(np.vstack(points))


def _grid(
    across: tuple[float, float], down: tuple[float, float], spacing: float
) -> NDArray[np.float64]:
    columns, rows = np.meshgrid(np.arange(*across, spacing), np.arange(*down, spacing))
    return np.column_stack([columns.ravel(), rows.ravel()])


def truth(where: WallFrame, viewer: ViewingCamera) -> Seen:
    """What the camera sees where each cell of the wall should be, (n,) cell by cell."""
    places = np.column_stack(cell_centres(SHAPE))
    points = where.world_from_wall(places, depth_m().ravel().astype(np.float64))
    origins = np.broadcast_to(viewer.centre_world, points.shape)
    return cast(where, origins, points - viewer.centre_world)


# Any: ports and parameters differ by method.
def inputs(
    *pictures: NDArray[np.uint8], viewers: Sequence[ViewingCamera] = (), **known: Any
) -> dict[str, Any]:
    """Inputs of a method: pictures of the wall, rendered unless given, and the cloud."""
    where = frame()
    return {
        "walls": walls(where),
        "photos": photos(*(pictures or (rendered(),))),
        "cameras": cameras(*(viewers or (camera(where),))),
        "cloud": cloud(where),
        **known,
    }


def laid(
    method: Any, folder: Path, given: dict[str, Any] | None = None, *, cores: int = 2, **params: Any
) -> tuple[tuple[Layer, ...], StepContext]:
    """Layers that a method makes of the scene, or of given inputs, and what it reported."""
    ctx = context(folder, cores=cores)
    return run(method, ctx, given or inputs(), **params).layers.layers, ctx


def visible(viewer: ViewingCamera) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Cells that a camera sees, and cells that the board hides from it."""
    surface = truth(frame(), viewer).surface.reshape(SHAPE)
    return np.isin(surface, (BASE, RAISED)), surface == BOARD


def places_off(layer: Layer) -> NDArray[np.float64]:
    """Errors (rows, cols, 2) in cells of the places that the colours stand for."""
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]] + 0.5
    shown = layer.rgb[..., :2].astype(np.float64) + 0.5
    return ((shown - 4.0 * np.dstack([columns, rows]) + 128.0) % 256.0 - 128.0) / 4.0


def seen_at(viewer: ViewingCamera) -> NDArray[np.float64]:
    """Return photo positions (rows, cols, 2) of the cells of the wall."""
    places = np.column_stack(cell_centres(SHAPE))
    depths = depth_m().ravel().astype(np.float64)
    points = frame().world_from_wall(places, depths)
    return viewer.project(points)[:, :2].reshape(*SHAPE, 2)
