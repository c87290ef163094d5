"""Shooting rays at a simulated scene: what they meet, and what colour is there.

Import this module where it is used: it loads compiled kernels.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.scene_kernels import cast_rays
from orthoflow.geometry.scene_trees import cast_table
from orthoflow.geometry.scenes import Scene, SurfaceRole
from orthoflow.geometry.texture_kernels import PaintTable, paint_points

# So many that arrays of one number per ray stay in the processor's cache.
RAYS_AT_ONCE: Final = 1 << 14


@dataclass(frozen=True, kw_only=True)
class Hits:
    """Where rays first meet a scene.

    Attributes:
        t: (n,) float64 distance in units of the ray's direction, inf where nothing is met.
        rectangle: (n,) int32 row of the scene, -1 where nothing is met.
    """

    t: NDArray[np.float64]
    rectangle: NDArray[np.int32]


class SceneRays:
    """A scene laid out once for many rays.

    Starts and points are metres from the scene's origin. Arrays hold one row per coordinate,
    (3, n): numpy works on such rows several times as fast as on one row per point.

    Args:
        scene: the scene.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._table = cast_table(scene)
        self._paint = PaintTable(
            frames=np.ascontiguousarray(np.hstack([scene.centre, scene.axis_a, scene.axis_b])),
            kinds=np.array(scene.texture),
            params=np.array(scene.texture_params),
        )

    @cached_property
    def objects(self) -> SceneRays:
        """The free-standing objects alone; rectangles count among them."""
        return SceneRays(self._scene.only(self._scene.role == SurfaceRole.OBJECT))

    def cast(
        self,
        starts: NDArray[np.float64],
        ways: NDArray[np.float64],
        *,
        within: NDArray[np.float64] | float = np.inf,
    ) -> Hits:
        """Find what rays meet first.

        Args:
            starts: (3, n), or (3, 1) for all.
            ways: (3, n) directions of any length, the unit of distances.
            within: (n,) or one distance beyond which nothing counts.
        """
        n_rays = ways.shape[1]
        t = np.empty(n_rays)
        t[:] = within
        rectangle = np.empty(n_rays, dtype=np.int32)
        cast_rays(
            self._table,
            np.ascontiguousarray(starts, dtype=np.float64),
            np.ascontiguousarray(ways, dtype=np.float64),
            t,
            rectangle,
        )
        t[rectangle < 0] = np.inf
        return Hits(t=t, rectangle=rectangle)

    def colours(
        self, rectangle: NDArray[np.int32], points: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Red, green, blue 0..255 and reflectance 0..1 (4, n) of points; 0 on rectangle -1."""
        painted = np.zeros((4, len(rectangle)), dtype=np.float32)
        paint_points(
            self._paint,
            np.ascontiguousarray(rectangle, dtype=np.int32),
            np.ascontiguousarray(points, dtype=np.float64),
            painted,
        )
        return painted


def points_on(
    starts: NDArray[np.float64], ways: NDArray[np.float64], hits: Hits
) -> NDArray[np.float64]:
    """Points (3, n) that rays meet; the start where they meet nothing."""
    points: NDArray[np.float64] = starts + np.where(hits.rectangle < 0, 0.0, hits.t) * ways
    return points
