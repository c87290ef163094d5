"""Views of a simulated scene: the true orthoimage of a wall, and photos.

Import this module inside functions, since it loads compiled kernels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.cameras import ViewingCamera, undistorted
from orthoflow.geometry.frames import WallFrame
from orthoflow.geometry.scene_rays import RAYS_AT_ONCE, Hits, SceneRays, points_on
from orthoflow.geometry.scenes import Scene, Viewers, cell_states, uniforms
from orthoflow.geometry.threads import in_runs

# A viewer sees a point unless the ray hits a surface more than this distance, in metres, before the
# point.
_SEEN_WITHIN_M: Final = 0.0005
# The corresponding limit for cameras, as a share of the distance from the camera to the point.
_SEEN_WITHIN_SHARE: Final = 2e-4


@dataclass(frozen=True, kw_only=True)
class TrueOrthoimage:
    """An error-free orthoimage of a scene.

    Attributes:
        frame: the frame of the cells.
        rgb: (rows, cols, 3) float32, 0..255, mean colours of the cells; NaN where there is no
            surface or no colour was requested.
        depth_m: (rows, cols) float32 depths along the normal at the centres of the cells; NaN where
            there is no surface.
        rectangle: (rows, cols) int32 rectangles (rows of the scene) at the centres of the cells; -1
            where there is no surface.
        seen: (rows, cols) bool, whether any viewer sees the surface point at the centre; undefined
            where not requested.
    """

    frame: WallFrame
    rgb: NDArray[np.float32]
    depth_m: NDArray[np.float32]
    rectangle: NDArray[np.int32]
    seen: NDArray[np.bool_]


def render(  # noqa: PLR0913
    scene: Scene,
    frame: WallFrame,
    *,
    front_m: float,
    behind_m: float,
    viewers: Viewers | None = None,
    supersample: int = 3,
    coloured: NDArray[np.bool_] | None = None,
    judged: NDArray[np.bool_] | None = None,
    cores: int = 1,
) -> TrueOrthoimage:
    """Render the true orthoimage of a frame.

    Args:
        scene: the scene.
        frame: the frame of the cells; its plane may deviate from a true wall.
        front_m: surfaces farther than this in front of the plane are ignored.
        behind_m: surfaces farther than this behind the plane are ignored.
        viewers: positions from which `seen` is computed; if None, no cell is seen.
        supersample: the colour of a cell is the mean colour of supersample^2 rays.
        coloured: (rows, cols) bool, cells whose colour is requested; None for all cells.
        judged: (rows, cols) bool, cells whose `seen` is requested; None for all cells.
        cores: number of threads; does not change the result.
    """
    truth = TrueOrthoimage(
        frame=frame,
        rgb=np.full((*frame.shape, 3), np.nan, dtype=np.float32),
        depth_m=np.full(frame.shape, np.nan, dtype=np.float32),
        rectangle=np.empty(frame.shape, dtype=np.int32),
        seen=np.zeros(frame.shape, dtype=np.bool_),
    )
    renderer = _Renderer(scene, truth, front_m=front_m, behind_m=behind_m, viewers=viewers)
    positions = () if viewers is None else viewers.positions_world - scene.origin

    def render_cells(first: int, last: int) -> None:
        cells = np.arange(first, last)
        points = renderer.look(cells)
        chosen = renderer.shows_something(cells, judged)
        for position in positions:
            renderer.look_from(position, cells[chosen], points[:, chosen])
        renderer.colour(cells[renderer.shows_something(cells, coloured)], supersample)

    n_cells = frame.width * frame.height
    in_runs(render_cells, n_cells, n_per_run=RAYS_AT_ONCE, threads=cores)
    return truth


@dataclass(frozen=True, kw_only=True)
class SeenPoints:
    """Surface points that are visible at pixels.

    Attributes:
        points: (n, 3) float64 metres from the scene's origin; NaN if there is no hit.
        rectangle: (n,) int32 rectangle (row of the scene); -1 if there is no hit.
    """

    points: NDArray[np.float64]
    rectangle: NDArray[np.int32]


class SceneCameras:
    """A scene prepared for many cameras.

    Args:
        scene: the scene.
        cores: number of threads; does not change the result.
    """

    def __init__(self, scene: Scene, *, cores: int = 1) -> None:
        self._rays = SceneRays(scene)
        self._origin = scene.origin
        self._cores = cores

    def expose(
        self, camera: ViewingCamera, *, supersample: int = 2, seed: int = 0
    ) -> NDArray[np.float32]:
        """Render a photo (rows, columns, 3) with values 0..255, without noise.

        The colour of a pixel is the mean colour of supersample^2 rays at random positions, which
        depend on the seed.
        """
        image = np.empty((camera.height, camera.width, 3), dtype=np.float32)
        near = camera.shifted(self._origin)

        def expose_rows(first: int, last: int) -> None:
            image[first:last] = _exposed(self._rays, near, (first, last), supersample, seed)

        n_rows = max(1, RAYS_AT_ONCE // camera.width)
        in_runs(expose_rows, camera.height, n_per_run=n_rows, threads=self._cores)
        return image

    def trace(self, camera: ViewingCamera, pixels_photo: NDArray[np.float64]) -> SeenPoints:
        """Find the surface points at pixels (n, 2), which may be outside the image or NaN."""
        pixels = np.asarray(pixels_photo, dtype=np.float64)
        points = np.full((len(pixels), 3), np.nan)
        rectangle = np.full(len(pixels), -1, dtype=np.int32)
        near = camera.shifted(self._origin)
        centre = near.centre_world[:, None]

        def trace_part(first: int, last: int) -> None:
            chosen = first + np.flatnonzero(np.isfinite(pixels[first:last]).all(axis=1))
            ways = pixel_directions(near, pixels[chosen, 0], pixels[chosen, 1])
            hits = self._rays.cast(centre, ways)
            hit = hits.rectangle >= 0
            rectangle[chosen] = hits.rectangle
            points[chosen[hit]] = points_on(centre, ways, hits)[:, hit].T

        in_runs(trace_part, len(pixels), n_per_run=RAYS_AT_ONCE, threads=self._cores)
        return SeenPoints(points=points, rectangle=rectangle)

    def sees(self, camera: ViewingCamera, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return a mask (n,) of the surface points (n, 3) that a camera sees.

        Points are in metres from the scene's origin. A point counts as seen unless the ray from the
        camera hits a surface before the point, by more than 0.02 % of the distance.
        """
        shifted = camera.shifted(self._origin)
        inside = shifted.sees(shifted.project(np.nan_to_num(points, nan=np.inf))[:, :2])
        chosen = np.flatnonzero(inside & np.isfinite(points).all(axis=1))
        centre = shifted.centre_world
        seen = np.zeros(len(points), dtype=np.bool_)
        seen[chosen[self.cast(centre, points[chosen] - centre).t > 1.0 - _SEEN_WITHIN_SHARE]] = True
        return seen

    def cast(self, starts: NDArray[np.float64], directions: NDArray[np.float64]) -> Hits:
        """Find the first hit of rays.

        Args:
            starts: (n, 3) or (3,) metres from the scene's origin.
            directions: (n, 3); the length of a direction is the unit of the distance along the ray.
        """
        n_rays = len(directions)
        starts = np.broadcast_to(starts, (n_rays, 3))
        t = np.empty(n_rays)
        rectangle = np.empty(n_rays, dtype=np.int32)

        def cast_part(first: int, last: int) -> None:
            part = slice(first, last)
            hits = self._rays.cast(starts[part].T, directions[part].T)
            t[part], rectangle[part] = hits.t, hits.rectangle

        in_runs(cast_part, n_rays, n_per_run=RAYS_AT_ONCE, threads=self._cores)
        return Hits(t=t, rectangle=rectangle)


def pixel_directions(
    camera: ViewingCamera, u: NDArray[np.float64], v: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the directions (3, n), in world axes, of rays through pixels; their depth is 1."""
    found = undistorted(*camera.bent_rays(np.stack([u, v])), camera.distortion)
    rotation = camera.rotation
    ways = np.empty((3, len(u)))
    for axis in range(3):
        ways[axis] = rotation[0, axis] * found[0] + rotation[1, axis] * found[1] + rotation[2, axis]
    return ways


class _Renderer:
    """Renders a true orthoimage; cells are numbered row by row."""

    def __init__(
        self,
        scene: Scene,
        truth: TrueOrthoimage,
        *,
        front_m: float,
        behind_m: float,
        viewers: Viewers | None,
    ) -> None:
        frame = truth.frame
        self._rays = SceneRays(scene)
        self._viewers = viewers
        self._front_m = front_m
        self._reach_m = front_m + behind_m
        # These one-dimensional views share the memory of the arrays.
        self._rgb = truth.rgb.reshape(-1, 3)
        self._depth_m = truth.depth_m.reshape(-1)
        self._rectangle = truth.rectangle.reshape(-1)
        self._seen = truth.seen.reshape(-1)
        self._width = frame.width
        self._frame, self._origin = frame, scene.origin
        self._normal = frame.normal_world[:, None]
        self._corner = (frame.origin_world - scene.origin)[:, None] + front_m * self._normal
        self._step_u = frame.gsd_m * frame.u_world[:, None]
        self._step_v = frame.gsd_m * frame.v_world[:, None]

    def look(self, cells: NDArray[np.int64]) -> NDArray[np.float64]:
        """Set depths and rectangles of cells (n,); return the points (3, n) at their centres."""
        starts, ways = self._starts(cells, 0.5, 0.5)
        hits = self._rays.cast(starts, ways, within=self._reach_m)
        if self._frame.bend is not None:
            rows, columns = np.divmod(cells, self._width)
            places = np.column_stack([columns + 0.5, rows + 0.5])
            hits.rectangle[~self._frame.shows(places)] = -1
        hit = hits.rectangle >= 0
        self._rectangle[cells] = hits.rectangle
        self._depth_m[cells[hit]] = self._front_m - hits.t[hit]
        return points_on(starts, ways, hits)

    def shows_something(
        self, cells: NDArray[np.int64], wanted: NDArray[np.bool_] | None
    ) -> NDArray[np.bool_]:
        shows: NDArray[np.bool_] = self._rectangle[cells] >= 0
        return shows if wanted is None else shows & wanted.reshape(-1)[cells]

    def look_from(
        self, position: NDArray[np.float64], cells: NDArray[np.int64], points: NDArray[np.float64]
    ) -> None:
        """Mark the cells (n,) whose surface points (3, n) are visible from a position."""
        viewers = self._viewers
        if viewers is None:
            return
        # Use a small tolerance, because rounding may make the sine of the elevation larger than 1.
        lowest = math.sin(math.radians(viewers.lowest_elevation_deg)) - 1e-12
        highest = math.sin(math.radians(viewers.highest_elevation_deg)) + 1e-12
        ways = points - position[:, None]
        lengths = np.sqrt(np.einsum("in,in->n", ways, ways))
        sines = (viewers.up @ ways) / lengths
        inside = (sines >= lowest) & (sines <= highest)
        cells, ways, within = cells[inside], ways[:, inside], 1.0 - _SEEN_WITHIN_M / lengths[inside]
        hits = self._rays.cast(position[:, None], ways, within=within)
        self._seen[cells[hits.rectangle < 0]] = True

    def colour(self, cells: NDArray[np.int64], n_sub: int) -> None:
        """Set the mean colours of cells, each from n_sub^2 rays."""
        sums, n_hits = np.zeros((3, len(cells)), dtype=np.float32), np.zeros(len(cells))
        for sub in range(n_sub * n_sub):
            # A sheared grid has n^2 different positions along each axis, so that edges along rows
            # or columns, which are frequent on walls, are not rendered in steps of 1/n of a cell.
            i, j = sub % n_sub, sub // n_sub
            starts, ways = self._starts(
                cells, (i + (j + 0.5) / n_sub) / n_sub, (j + (n_sub - i - 0.5) / n_sub) / n_sub
            )
            hits = self._rays.cast(starts, ways, within=self._reach_m)
            sums += self._rays.colours(hits.rectangle, points_on(starts, ways, hits))[:3]
            n_hits += hits.rectangle >= 0
        shown = n_hits > 0
        self._rgb[cells[shown]] = (sums[:, shown] / n_hits[shown]).T

    def _starts(
        self, cells: NDArray[np.int64], right: float, down: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return starts and directions (3, n) of rays through (right, down) in each cell."""
        rows, columns = np.divmod(cells, self._width)
        if self._frame.bend is not None:
            places = np.column_stack([columns + right, rows + down])
            points = self._frame.world_from_wall(places, self._front_m) - self._origin
            return points.T, -self._frame.axes_at(places)[:, 2].T
        starts = self._corner + (columns + right) * self._step_u + (rows + down) * self._step_v
        return starts, np.broadcast_to(-self._normal, starts.shape)


def _exposed(
    rays: SceneRays, camera: ViewingCamera, rows: tuple[int, int], n_sub: int, seed: int
) -> NDArray[np.float32]:
    """Return the colours (rows, columns, 3) of rows of pixels, means of n_sub^2 rays each."""
    first, last = rows
    shape = (last - first, camera.width)
    columns, lines = np.arange(camera.width), np.arange(first, last)
    base, right, down, twist = _pixel_ways(camera, first, last)
    states = cell_states(columns, lines[:, None], seed)
    centre = camera.centre_world[:, None]
    total = np.zeros((3, states.size), dtype=np.float32)
    for sub in range(n_sub * n_sub):
        s = (sub % n_sub + uniforms(states, 2 * sub)) / n_sub
        t = (sub // n_sub + uniforms(states, 2 * sub + 1)) / n_sub
        ways = (base + s * right + t * down + (s * t) * twist).reshape(3, -1)
        hits = rays.cast(centre, ways)
        total += rays.colours(hits.rectangle, points_on(centre, ways, hits))[:3]
    return (total / np.float32(n_sub * n_sub)).T.reshape(*shape, 3)


def _pixel_ways(camera: ViewingCamera, first: int, last: int) -> tuple[NDArray[np.float64], ...]:
    """Return ray directions at the top-left corners of pixels, and their changes inside the pixels.

    A ray at (s, t) in a pixel has the direction base + s right + t down + s t twist, where each
    term is (3, rows, columns). The directions of the corners are exact; between the corners, errors
    of the interpolation are below 1e-5 of a pixel.
    """
    u, v = np.meshgrid(
        np.arange(camera.width + 1, dtype=np.float64), np.arange(first, last + 1, dtype=np.float64)
    )
    corners = pixel_directions(camera, u.ravel(), v.ravel()).reshape(3, *u.shape)
    base = corners[:, :-1, :-1]
    right, down = corners[:, :-1, 1:] - base, corners[:, 1:, :-1] - base
    return base, right, down, corners[:, 1:, 1:] - base - right - down
