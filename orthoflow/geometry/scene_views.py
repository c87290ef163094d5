"""Looking at a simulated scene: what rays hit, what colour is there, the true orthoimage.

Import this module where it is used: it loads compiled kernels.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.frames import WallFrame
from orthoflow.geometry.scene_kernels import cast_rays
from orthoflow.geometry.scene_trees import cast_table
from orthoflow.geometry.scenes import Scene, SurfaceRole, Viewers
from orthoflow.geometry.texture_kernels import paint_points
from orthoflow.geometry.view_kernels import (
    TILE,
    CellTruth,
    Grid,
    Stations,
    ViewedScene,
    look_at_cells,
)

_RAYS_PER_TASK: Final = 1 << 15


@dataclass(frozen=True, kw_only=True)
class Hits:
    """Where rays first meet a scene.

    Attributes:
        t: (n,) float64 distance in units of the ray's direction, inf where nothing is met.
        rectangle: (n,) int32 row of the scene, -1 where nothing is met.
    """

    t: NDArray[np.float64]
    rectangle: NDArray[np.int32]


@dataclass(frozen=True, kw_only=True)
class Colours:
    """How points of a scene look.

    Attributes:
        rgb: (n, 3) float64, 0..255; 0 on rectangle -1.
        reflectance: (n,) float64 for the laser, 0..1; 0 on rectangle -1.
    """

    rgb: NDArray[np.float64]
    reflectance: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class TrueOrthoimage:
    """What an error-free orthoimage of a scene shows in each cell of a frame.

    Attributes:
        frame: where the cells lie.
        rgb: (rows, cols, 3) float32, 0..255, mean over the cell; NaN where nothing is.
        depth_m: (rows, cols) float32 along the normal at the cell's centre; NaN where nothing is.
        rectangle: (rows, cols) int32 row of the scene at the centre; -1 where nothing is.
        seen: (rows, cols) bool, a viewer sees that surface point.
        behind_object: (rows, cols) bool, a free-standing object hides that point from a viewer or
            from the front.
    """

    frame: WallFrame
    rgb: NDArray[np.float32]
    depth_m: NDArray[np.float32]
    rectangle: NDArray[np.int32]
    seen: NDArray[np.bool_]
    behind_object: NDArray[np.bool_]


def cast(
    scene: Scene,
    origins: NDArray[np.float64],
    directions: NDArray[np.float64],
    *,
    cores: int = 1,
) -> Hits:
    """Find what rays meet first.

    Args:
        scene: the scene.
        origins: (n, 3) or (3,) world points in metres.
        directions: (n, 3) world vectors of any length.
        cores: number of threads; changes no result.
    """
    n_rays = len(directions)
    starts = np.ascontiguousarray(np.broadcast_to(origins - scene.origin, (n_rays, 3)))
    t = np.full(n_rays, np.inf)
    rectangle = np.full(n_rays, -1, dtype=np.int32)
    ways = np.ascontiguousarray(directions, dtype=np.float64)
    table = cast_table(scene)

    def cast_part(first: int, last: int) -> None:
        part = slice(first, last)
        cast_rays(table, starts[part], ways[part], t[part], rectangle[part])

    in_threads(cast_part, n_rays, _RAYS_PER_TASK, cores=cores)
    return Hits(t=t, rectangle=rectangle)


def colours_at(
    scene: Scene,
    rectangle: NDArray[np.int32],
    points_world: NDArray[np.float64],
    *,
    cores: int = 1,
) -> Colours:
    """Colours of points (n, 3) on given rectangles (n,), e.g. those of `cast`.

    A point off its rectangle gets the colour of its foot on the rectangle's plane.
    """
    chosen = np.maximum(rectangle, 0)
    relative = (points_world - scene.origin) - scene.centre[chosen]
    in_rectangle = np.column_stack(
        [
            np.einsum("ij,ij->i", relative, scene.axis_a[chosen]),
            np.einsum("ij,ij->i", relative, scene.axis_b[chosen]),
        ]
    )
    painted = np.zeros((len(relative), 4))
    kinds, params = np.array(scene.texture), np.array(scene.texture_params)
    chosen_rectangle = np.ascontiguousarray(rectangle, dtype=np.int32)

    def paint_part(first: int, last: int) -> None:
        part = slice(first, last)
        paint_points(kinds, params, chosen_rectangle[part], in_rectangle[part], painted[part])

    in_threads(paint_part, len(relative), _RAYS_PER_TASK, cores=cores)
    return Colours(rgb=painted[:, :3], reflectance=painted[:, 3])


def render_frame(
    scene: Scene,
    frame: WallFrame,
    *,
    buffer_front_m: float,
    buffer_behind_m: float,
    viewers: Viewers | None = None,
    supersample: int = 3,
    cores: int = 1,
) -> TrueOrthoimage:
    """Render the true orthoimage of a frame.

    Args:
        scene: the scene.
        frame: where the cells lie; it need not lie exactly on a true wall.
        buffer_front_m: surfaces further in front of the plane do not exist for the image.
        buffer_behind_m: likewise behind.
        viewers: who may see the surface; without, nobody does.
        supersample: colours are the mean of supersample^2 rays per cell.
        cores: number of threads; changes no result.
    """
    truth = CellTruth(
        rgb=np.full((*frame.shape, 3), np.nan, dtype=np.float32),
        depth_m=np.full(frame.shape, np.nan, dtype=np.float32),
        rectangle=np.full(frame.shape, -1, dtype=np.int32),
        seen=np.zeros(frame.shape, dtype=np.bool_),
        behind_object=np.zeros(frame.shape, dtype=np.bool_),
    )
    grid = Grid(
        corner=frame.origin_world - scene.origin,
        step_u=frame.gsd_m * frame.u_world,
        step_v=frame.gsd_m * frame.v_world,
        normal=np.ascontiguousarray(frame.normal_world, dtype=np.float64),
        front_m=float(buffer_front_m),
        behind_m=float(buffer_behind_m),
        n_sub=supersample,
        bounds=_bounds_in_frame(scene, frame),
    )
    viewed = viewed_scene(scene, viewers)
    in_threads(
        lambda first, _: look_at_cells(viewed, grid, truth, first),
        frame.height,
        TILE,
        cores=cores,
    )
    return TrueOrthoimage(
        frame=frame,
        rgb=truth.rgb,
        depth_m=truth.depth_m,
        rectangle=truth.rectangle,
        seen=truth.seen,
        behind_object=truth.behind_object,
    )


def in_threads(
    work: Callable[[int, int], None], n_items: int, n_per_task: int, *, cores: int
) -> None:
    """Call `work(first, last)` over runs of items, in several threads."""
    starts = range(0, n_items, n_per_task)
    with ThreadPoolExecutor(max(1, cores)) as pool:
        for task in [pool.submit(work, s, min(n_items, s + n_per_task)) for s in starts]:
            task.result()


def viewed_scene(scene: Scene, viewers: Viewers | None) -> ViewedScene:
    """Lay a scene out for rendering."""
    return ViewedScene(
        table=cast_table(scene),
        objects=cast_table(scene.only(scene.role == SurfaceRole.OBJECT)),
        stations=_stations(scene, viewers),
    )


def _bounds_in_frame(scene: Scene, frame: WallFrame) -> NDArray[np.float64]:
    """First and last column, row and depth of each rectangle, with some slack for rounding."""
    relative = scene.corners_m() - (frame.origin_world - scene.origin)
    columns = relative @ frame.u_world / frame.gsd_m
    rows = relative @ frame.v_world / frame.gsd_m
    depths = relative @ frame.normal_world
    bounds = [
        bound
        for values, slack in ((columns, 1e-3), (rows, 1e-3), (depths, 1e-6))
        for bound in (values.min(axis=1) - slack, values.max(axis=1) + slack)
    ]
    return np.ascontiguousarray(np.stack(bounds, axis=1))


def _stations(scene: Scene, viewers: Viewers | None) -> Stations:
    if viewers is None:
        return Stations(
            positions=np.zeros((0, 3)), up=np.zeros(3), lowest_sine=-1.0, highest_sine=1.0
        )
    return Stations(
        positions=np.ascontiguousarray(viewers.positions_world - scene.origin),
        up=np.array(viewers.up, dtype=np.float64),
        # A little slack: straight up must be seen although its sine may round above one.
        lowest_sine=math.sin(math.radians(viewers.lowest_elevation_deg)) - 1e-12,
        highest_sine=math.sin(math.radians(viewers.highest_elevation_deg)) + 1e-12,
    )
