"""Looking at a simulated scene: what rays hit, what colour is there, the true orthoimage.

Import this module where it is used: it loads compiled kernels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.frames import WallFrame
from orthoflow.geometry.scene_rays import RAYS_AT_ONCE, Hits, SceneRays, points_on
from orthoflow.geometry.scenes import Scene, Viewers
from orthoflow.geometry.threads import in_runs

# A point counts as seen when nothing is hit more than this before it, metres.
_SEEN_WITHIN_M: Final = 0.0005


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
        rgb: (rows, cols, 3) float32, 0..255, mean over the cell; NaN where nothing is, or where no
            colour was wanted.
        depth_m: (rows, cols) float32 along the normal at the cell's centre; NaN where nothing is.
        rectangle: (rows, cols) int32 row of the scene at the centre; -1 where nothing is.
        seen: (rows, cols) bool, a viewer sees that surface point; not told of cells that were
            not to be judged.
        behind_object: (rows, cols) bool, a free-standing object hides that point from a viewer or
            from the front; told of the same cells.
    """

    frame: WallFrame
    rgb: NDArray[np.float32]
    depth_m: NDArray[np.float32]
    rectangle: NDArray[np.int32]
    seen: NDArray[np.bool_]
    behind_object: NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class Rendering:
    """What of a true orthoimage is wanted, and how finely.

    Attributes:
        buffer_front_m: surfaces further in front of the plane do not exist for the image.
        buffer_behind_m: likewise behind.
        viewers: who may see the surface; without, nobody does.
        supersample: colours are the mean of supersample^2 rays per cell.
        coloured: (rows, cols) bool, cells whose colour is wanted; None for all.
        judged: (rows, cols) bool, cells of which `seen` and `behind_object` are wanted; None for
            all.
        cores: number of threads; changes no result.
    """

    buffer_front_m: float
    buffer_behind_m: float
    viewers: Viewers | None = None
    supersample: int = 3
    coloured: NDArray[np.bool_] | None = None
    judged: NDArray[np.bool_] | None = None
    cores: int = 1


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
    starts = np.broadcast_to(origins - scene.origin, (n_rays, 3)).T
    ways = np.asarray(directions, dtype=np.float64).T
    hits = Hits(t=np.empty(n_rays), rectangle=np.empty(n_rays, dtype=np.int32))
    rays = SceneRays(scene)

    def cast_part(first: int, last: int) -> None:
        part = slice(first, last)
        found = rays.cast(starts[:, part], ways[:, part])
        hits.t[part], hits.rectangle[part] = found.t, found.rectangle

    in_runs(cast_part, n_rays, n_per_run=RAYS_AT_ONCE, threads=cores)
    return hits


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
    points = (points_world - scene.origin).T
    painted = np.zeros((4, len(rectangle)))
    rays = SceneRays(scene)

    def paint_part(first: int, last: int) -> None:
        part = slice(first, last)
        painted[:, part] = rays.colours(rectangle[part], points[:, part])

    in_runs(paint_part, len(rectangle), n_per_run=RAYS_AT_ONCE, threads=cores)
    return Colours(rgb=painted[:3].T, reflectance=painted[3])


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
    """Render the true orthoimage of a frame, all of every cell.

    Args:
        scene: the scene.
        frame: where the cells lie; it need not lie exactly on a true wall.
        buffer_front_m: see `Rendering`; the rest likewise.
        buffer_behind_m: see `Rendering`.
        viewers: see `Rendering`.
        supersample: see `Rendering`.
        cores: see `Rendering`.
    """
    rendering = Rendering(
        buffer_front_m=buffer_front_m,
        buffer_behind_m=buffer_behind_m,
        viewers=viewers,
        supersample=supersample,
        cores=cores,
    )
    return render(scene, frame, rendering)


def render(scene: Scene, frame: WallFrame, rendering: Rendering) -> TrueOrthoimage:
    """Render the true orthoimage of a frame, which need not lie exactly on a true wall."""
    truth = TrueOrthoimage(
        frame=frame,
        rgb=np.full((*frame.shape, 3), np.nan, dtype=np.float32),
        depth_m=np.full(frame.shape, np.nan, dtype=np.float32),
        rectangle=np.full(frame.shape, -1, dtype=np.int32),
        seen=np.zeros(frame.shape, dtype=np.bool_),
        behind_object=np.zeros(frame.shape, dtype=np.bool_),
    )
    renderer = _Renderer(scene, truth, rendering)

    def render_cells(first: int, last: int) -> None:
        cells = np.arange(first, last)
        points = renderer.look(cells)
        chosen = renderer.shows_something(cells, rendering.judged)
        renderer.look_back(cells[chosen], points[:, chosen])
        renderer.colour(cells[renderer.shows_something(cells, rendering.coloured)])

    n_cells = frame.width * frame.height
    in_runs(render_cells, n_cells, n_per_run=RAYS_AT_ONCE, threads=rendering.cores)
    return truth


class _Renderer:
    """Fills a true orthoimage; cells are numbered row by row."""

    def __init__(self, scene: Scene, truth: TrueOrthoimage, rendering: Rendering) -> None:
        frame, front_m = truth.frame, rendering.buffer_front_m
        self._rays = SceneRays(scene)
        self._viewers = rendering.viewers
        self._n_sub = rendering.supersample
        self._front_m = front_m
        self._reach_m = front_m + rendering.buffer_behind_m
        # One long row each, views that share their memory.
        self._rgb = truth.rgb.reshape(-1, 3)
        self._depth_m = truth.depth_m.reshape(-1)
        self._rectangle = truth.rectangle.reshape(-1)
        self._seen = truth.seen.reshape(-1)
        self._behind_object = truth.behind_object.reshape(-1)
        self._width = frame.width
        self._origin = scene.origin
        self._normal = frame.normal_world[:, None]
        self._corner = (frame.origin_world - scene.origin)[:, None] + front_m * self._normal
        self._step_u = frame.gsd_m * frame.u_world[:, None]
        self._step_v = frame.gsd_m * frame.v_world[:, None]

    def look(self, cells: NDArray[np.int64]) -> NDArray[np.float64]:
        """Fill depths and rectangles of cells (n,); give the points (3, n) at their centres."""
        starts = self._starts(cells, 0.5, 0.5)
        ways = np.broadcast_to(-self._normal, starts.shape)
        hits = self._rays.cast(starts, ways, within=self._reach_m)
        hit = hits.rectangle >= 0
        self._rectangle[cells] = hits.rectangle
        self._depth_m[cells[hit]] = self._front_m - hits.t[hit]
        return points_on(starts, ways, hits)

    def shows_something(
        self, cells: NDArray[np.int64], wanted: NDArray[np.bool_] | None
    ) -> NDArray[np.bool_]:
        """Which cells (n,) show a surface, and are wanted."""
        shows: NDArray[np.bool_] = self._rectangle[cells] >= 0
        return shows if wanted is None else shows & wanted.reshape(-1)[cells]

    def look_back(self, cells: NDArray[np.int64], points: NDArray[np.float64]) -> None:
        """Tell which cells (n,), surface points (3, n), a viewer sees or an object hides."""
        ways = np.broadcast_to(self._normal, points.shape)
        before = self._rays.objects.cast(points, ways).rectangle >= 0
        self._behind_object[cells[before]] = True
        if self._viewers is not None:
            for position in self._viewers.positions_world - self._origin:
                self._look_from(position[:, None], self._viewers, cells, points)

    def _look_from(
        self,
        position: NDArray[np.float64],
        viewers: Viewers,
        cells: NDArray[np.int64],
        points: NDArray[np.float64],
    ) -> None:
        # A little slack: straight up must be seen although its sine may round above one.
        lowest = math.sin(math.radians(viewers.lowest_elevation_deg)) - 1e-12
        highest = math.sin(math.radians(viewers.highest_elevation_deg)) + 1e-12
        ways = points - position
        lengths = np.sqrt(np.einsum("in,in->n", ways, ways))
        sines = (viewers.up @ ways) / lengths
        inside = (sines >= lowest) & (sines <= highest)
        cells, ways, within = cells[inside], ways[:, inside], 1.0 - _SEEN_WITHIN_M / lengths[inside]
        blocked = self._rays.cast(position, ways, within=within).rectangle >= 0
        self._seen[cells[~blocked]] = True
        by_object = self._rays.objects.cast(position, ways[:, blocked], within=within[blocked])
        self._behind_object[cells[blocked][by_object.rectangle >= 0]] = True

    def colour(self, cells: NDArray[np.int64]) -> None:
        """Fill the mean colours of cells whose centre shows something."""
        n_sub = self._n_sub
        sums, n_hits = np.zeros((3, len(cells)), dtype=np.float32), np.zeros(len(cells))
        ways = np.broadcast_to(-self._normal, (3, len(cells)))
        for sub in range(n_sub * n_sub):
            # A sheared grid: n^2 different positions in either direction, so that edges along rows
            # or columns, which walls are full of, are not rounded to thirds of a cell.
            i, j = sub % n_sub, sub // n_sub
            starts = self._starts(
                cells, (i + (j + 0.5) / n_sub) / n_sub, (j + (n_sub - i - 0.5) / n_sub) / n_sub
            )
            hits = self._rays.cast(starts, ways, within=self._reach_m)
            sums += self._rays.colours(hits.rectangle, points_on(starts, ways, hits))[:3]
            n_hits += hits.rectangle >= 0
        shown = n_hits > 0
        self._rgb[cells[shown]] = (sums[:, shown] / n_hits[shown]).T

    def _starts(self, cells: NDArray[np.int64], right: float, down: float) -> NDArray[np.float64]:
        """Points (3, n) before places in cells, where looking begins."""
        rows, columns = np.divmod(cells, self._width)
        starts: NDArray[np.float64] = (
            self._corner + (columns + right) * self._step_u + (rows + down) * self._step_v
        )
        return starts
