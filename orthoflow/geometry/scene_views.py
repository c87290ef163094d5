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
from orthoflow.geometry.scene_kernels import (
    CastTable,
    CellTruth,
    Grid,
    Stations,
    ViewedScene,
    cast_rays,
    look_at_cells,
)
from orthoflow.geometry.scenes import Scene, SurfaceRole, Viewers
from orthoflow.geometry.texture_kernels import paint_points

_RAYS_PER_TASK: Final = 1 << 15
_ROWS_PER_TASK: Final = 16


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
    )
    viewed = viewed_scene(scene, viewers)
    in_threads(
        lambda first, last: look_at_cells(viewed, grid, truth, first, last),
        frame.height,
        _ROWS_PER_TASK,
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


def cast_table(scene: Scene) -> CastTable:
    """Lay a scene out for ray casting, with its tree of bounding boxes."""
    tree = _BoxTree(scene)
    first_hole = np.searchsorted(scene.hole_rectangle, np.arange(len(scene) + 1))
    return CastTable(
        rectangles=np.ascontiguousarray(
            np.hstack([scene.centre, scene.axis_a, scene.axis_b, scene.normal, scene.extent])
        ),
        kinds=np.array(scene.texture),
        params=np.array(scene.texture_params),
        holes=np.array(scene.hole_extent),
        first_hole=first_hole.astype(np.int64),
        box_axes=tree.axes,
        boxes=np.array(tree.boxes).reshape(-1, 6),
        links=np.array(tree.links, dtype=np.int64).reshape(-1, 3),
        order=np.array(tree.order, dtype=np.int64),
    )


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


class _BoxTree:
    """Bounding boxes over rectangles, split where rays have the least to do.

    The boxes lie along the axes of that rectangle which makes them smallest: in a room most others
    are parallel or square to it, and their boxes are as thin as they are.
    """

    def __init__(self, scene: Scene) -> None:
        self.boxes: list[list[float]] = []
        self.links: list[tuple[int, int, int]] = []
        self.order: list[int] = []
        self.axes = np.eye(3)
        if len(scene) == 0:
            return
        self.axes = _tightest_axes(scene)
        corners = scene.corners_m() @ self.axes.T
        # A micrometre of slack: a rectangle along the axes must not have an empty box.
        self._low = corners.min(axis=1) - 1e-6
        self._high = corners.max(axis=1) + 1e-6
        self._add(np.arange(len(scene)))

    def _add(self, members: NDArray[np.int64]) -> None:
        node, first = len(self.boxes), len(self.order)
        low, high = self._low[members], self._high[members]
        self.boxes.append([*low.min(axis=0), *high.max(axis=0)])
        self.links.append((0, first, first))
        first_half = self._cheapest_half(members)
        if first_half is None:
            self.order.extend(int(member) for member in members)
            self.links[node] = (len(self.boxes), first, len(self.order))
            return
        self._add(members[first_half])
        self._add(members[~first_half])
        self.links[node] = (len(self.boxes), first, first)

    def _cheapest_half(self, members: NDArray[np.int64]) -> NDArray[np.bool_] | None:
        """Choose the members of the first child; None when a leaf is cheaper.

        The cost of a child is its number of rectangles times the surface of its box, which is how
        often rays come by (Goldsmith and Salmon 1987); visiting a node costs about one rectangle.
        """
        low, high = self._low[members], self._high[members]
        whole = _surface_m2(high.max(axis=0) - low.min(axis=0))
        best_cost, best = len(members) * whole, None
        for axis in range(3):
            order = np.argsort(low[:, axis] + high[:, axis], kind="stable")
            heads = _running_surfaces(low[order], high[order])[:-1]
            tails = _running_surfaces(low[order[::-1]], high[order[::-1]])[:-1][::-1]
            counts = np.arange(1, len(members))
            costs = whole + counts * heads + (len(members) - counts) * tails
            if len(costs) and costs.min() < best_cost:
                best_cost = float(costs.min())
                best = np.zeros(len(members), dtype=np.bool_)
                best[order[: int(np.argmin(costs)) + 1]] = True
        return best


def _surface_m2(sides: NDArray[np.float64]) -> float:
    return float(sides[0] * sides[1] + sides[1] * sides[2] + sides[2] * sides[0])


def _running_surfaces(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    """Surface of the box round the first 1, 2, ... members."""
    x, y, z = (np.maximum.accumulate(high) - np.minimum.accumulate(low)).T
    surfaces: NDArray[np.float64] = x * y + y * z + z * x
    return surfaces


def _tightest_axes(scene: Scene) -> NDArray[np.float64]:
    corners = scene.corners_m()
    axes = np.stack([scene.axis_a, scene.axis_b, scene.normal], axis=1)
    # Many rectangles share their axes; each set is tried once.
    _, first = np.unique(axes.reshape(-1, 9).round(9), axis=0, return_index=True)
    axes = axes[np.sort(first)]
    surfaces = []
    for candidate in axes:
        x, y, z = np.ptp(corners @ candidate.T, axis=1).T
        surfaces.append(float(np.sum(x * y + y * z + z * x)))
    chosen: NDArray[np.float64] = axes[int(np.argmin(surfaces))]
    return chosen
