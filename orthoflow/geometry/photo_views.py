"""Cameras in a simulated scene: photos of it, and which of its points a pixel shows.

Import this module where it is used: it loads compiled kernels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.photo_kernels import (
    TILE,
    Exposure,
    expose_rows,
    hit_pixels,
    workspace,
)
from orthoflow.geometry.scene_kernels import CastTable, cast_rays
from orthoflow.geometry.scene_trees import cast_table
from orthoflow.geometry.scene_views import Hits, in_threads
from orthoflow.geometry.scenes import Scene

_RAYS_PER_TASK: Final = 1 << 15
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
        self._table: CastTable = cast_table(scene)
        self._origin = scene.origin
        self._cores = cores

    def expose(
        self, camera: ViewingCamera, *, supersample: int = 2, seed: int = 0
    ) -> NDArray[np.float32]:
        """Take a photo (rows, columns, 3), grey levels 0..255, without noise.

        Colours are means of supersample^2 rays per pixel, at random places that hang on the seed.
        """
        image = np.zeros((camera.height, camera.width, 3), dtype=np.float32)
        exposure = Exposure(self._flat(camera), supersample, seed)
        n_rectangles = len(self._table.kinds)

        def expose_part(first: int, _: int) -> None:
            expose_rows(self._table, exposure, image, first, workspace(n_rectangles))

        in_threads(expose_part, camera.height, TILE, cores=self._cores)
        return image

    def trace(self, camera: ViewingCamera, pixels_photo: NDArray[np.float64]) -> SeenPoints:
        """Find what pixels (n, 2) look at; they may lie outside the image, NaN sees nothing."""
        pixels = np.ascontiguousarray(pixels_photo, dtype=np.float64)
        points = np.full((len(pixels), 3), np.nan)
        rectangle = np.full(len(pixels), -1, dtype=np.int32)
        flat = self._flat(camera)

        def trace_part(first: int, last: int) -> None:
            part = slice(first, last)
            hit_pixels(self._table, flat, pixels[part], points[part], rectangle[part])

        in_threads(trace_part, len(pixels), _RAYS_PER_TASK, cores=self._cores)
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
        starts = np.ascontiguousarray(np.broadcast_to(starts, (n_rays, 3)), dtype=np.float64)
        ways = np.ascontiguousarray(directions, dtype=np.float64)
        t = np.full(n_rays, np.inf)
        rectangle = np.full(n_rays, -1, dtype=np.int32)

        def cast_part(first: int, last: int) -> None:
            part = slice(first, last)
            cast_rays(self._table, starts[part], ways[part], t[part], rectangle[part])

        in_threads(cast_part, n_rays, _RAYS_PER_TASK, cores=self._cores)
        return Hits(t=t, rectangle=rectangle)

    def _flat(self, camera: ViewingCamera) -> NDArray[np.float64]:
        return camera.shifted(self._origin).flat
