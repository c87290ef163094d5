"""Cameras in a simulated scene: photos of it, and which of its points a pixel shows.

Import this module where it is used: it loads compiled kernels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.cameras import ViewingCamera, undistorted
from orthoflow.geometry.hashed_numbers import cell_states, uniforms
from orthoflow.geometry.scene_rays import RAYS_AT_ONCE, Hits, SceneRays, points_on
from orthoflow.geometry.scenes import Scene
from orthoflow.geometry.threads import in_runs

# A point is seen when nothing is hit more than this share of its distance before it.
_SEEN_WITHIN: Final = 2e-4


@dataclass(frozen=True, kw_only=True)
class SeenPoints:
    """What pixels look at.

    Attributes:
        points: (n, 3) float64 metres from the scene's origin, NaN where nothing is.
        rectangle: (n,) int32 row of the scene, -1 where nothing is.
    """

    points: NDArray[np.float64]
    rectangle: NDArray[np.int32]


class SceneCameras:
    """A scene laid out once for many cameras.

    Args:
        scene: the scene.
        cores: number of threads; changes no result.
    """

    def __init__(self, scene: Scene, *, cores: int = 1) -> None:
        self._rays = SceneRays(scene)
        self._origin = scene.origin
        self._cores = cores

    def expose(
        self, camera: ViewingCamera, *, supersample: int = 2, seed: int = 0
    ) -> NDArray[np.float32]:
        """Take a photo (rows, columns, 3), grey levels 0..255, without noise.

        Colours are means of supersample^2 rays per pixel, at random places that hang on the seed.
        """
        image = np.empty((camera.height, camera.width, 3), dtype=np.float32)
        near = camera.shifted(self._origin)

        def expose_rows(first: int, last: int) -> None:
            image[first:last] = _exposed(self._rays, near, (first, last), supersample, seed)

        n_rows = max(1, RAYS_AT_ONCE // camera.width)
        in_runs(expose_rows, camera.height, n_per_run=n_rows, threads=self._cores)
        return image

    def trace(self, camera: ViewingCamera, pixels_photo: NDArray[np.float64]) -> SeenPoints:
        """Find what pixels (n, 2) look at; they may lie outside the image, NaN sees nothing."""
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
        """Which surface points (n, 3), metres from the scene's origin, a camera sees; NaN is not.

        A point hidden by less than 0.02 % of its distance counts as seen.
        """
        shifted = camera.shifted(self._origin)
        inside = shifted.sees(shifted.project(np.nan_to_num(points, nan=np.inf))[:, :2])
        chosen = np.flatnonzero(inside & np.isfinite(points).all(axis=1))
        centre = shifted.centre_world
        seen = np.zeros(len(points), dtype=np.bool_)
        seen[chosen[self.cast(centre, points[chosen] - centre).t > 1.0 - _SEEN_WITHIN]] = True
        return seen

    def cast(self, starts: NDArray[np.float64], directions: NDArray[np.float64]) -> Hits:
        """Find what rays meet first.

        Args:
            starts: (n, 3) or (3,) metres from the scene's origin.
            directions: (n, 3) of any length, the unit of the hits' distances.
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
    """Directions (3, n) in world axes, one metre deep along the optical axis, of pixels."""
    found = undistorted((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, camera.distortion)
    rotation = camera.rotation
    ways = np.empty((3, len(u)))
    for axis in range(3):
        ways[axis] = rotation[0, axis] * found[0] + rotation[1, axis] * found[1] + rotation[2, axis]
    return ways


def _exposed(
    rays: SceneRays, camera: ViewingCamera, rows: tuple[int, int], n_sub: int, seed: int
) -> NDArray[np.float32]:
    """Mean colours (rows, columns, 3) of the rays of some rows of pixels."""
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
    mean: NDArray[np.float32] = (total / np.float32(n_sub * n_sub)).T.reshape(*shape, 3)
    return mean


def _pixel_ways(camera: ViewingCamera, first: int, last: int) -> tuple[NDArray[np.float64], ...]:
    """Direction of the first corner of each pixel of some rows, and how it changes inside it.

    A ray at (s, t) of a pixel has the direction base + s right + t down + s t twist, (3, rows,
    columns) each: those of the corners are exact, and the lens bends the rays between by less than
    1e-5 of a pixel from that.
    """
    u, v = np.meshgrid(
        np.arange(camera.width + 1, dtype=np.float64), np.arange(first, last + 1, dtype=np.float64)
    )
    corners = pixel_directions(camera, u.ravel(), v.ravel()).reshape(3, *u.shape)
    base = corners[:, :-1, :-1]
    right, down = corners[:, :-1, 1:] - base, corners[:, 1:, :-1] - base
    return base, right, down, corners[:, 1:, 1:] - base - right - down
