"""What rays meet in a simulated scene and what colour is there, in world coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.scene_rays import Hits, SceneRays
from orthoflow.geometry.scene_views import SceneCameras
from orthoflow.geometry.scenes import Scene, SurfaceRole, TextureKind

PARAMS = (200.0, 160.0, 120.0, 0.5, 0.4, 0.3, 7.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Colours:
    """How points of a scene look.

    Attributes:
        rgb: (n, 3) float64, 0..255; 0 on rectangle -1.
        reflectance: (n,) float64 for the laser, 0..1; 0 on rectangle -1.
    """

    rgb: NDArray[np.float64]
    reflectance: NDArray[np.float64]


def cast(
    scene: Scene, origins: NDArray[np.float64], directions: NDArray[np.float64], *, cores: int = 1
) -> Hits:
    """Find what rays from world points (n, 3) or (3,) along world vectors (n, 3) meet first."""
    return SceneCameras(scene, cores=cores).cast(origins - scene.origin, directions)


def colours_at(
    scene: Scene, rectangle: NDArray[np.int32], points_world: NDArray[np.float64]
) -> Colours:
    """Colours of world points (n, 3) on given rectangles (n,), e.g. those of `cast`."""
    painted = SceneRays(scene).colours(rectangle, (points_world - scene.origin).T)
    return Colours(rgb=painted[:3].T.astype(np.float64), reflectance=painted[3].astype(np.float64))


def a_scene(
    rows: list[dict[str, object]], holes: Sequence[tuple[int, tuple[float, ...]]] = ()
) -> Scene:
    """A scene of rectangles given by centre, a, b, extent and, if wanted, role and texture."""
    count = len(rows)
    return Scene(
        origin=np.zeros(3),
        centre=np.array([row["centre"] for row in rows], dtype=np.float64),
        axis_a=np.array([row["a"] for row in rows], dtype=np.float64),
        axis_b=np.array([row["b"] for row in rows], dtype=np.float64),
        extent=np.array([row["extent"] for row in rows], dtype=np.float64),
        plane_index=np.full(count, -1, dtype=np.int16),
        role=np.array([row.get("role", SurfaceRole.WALL) for row in rows], dtype=np.uint8),
        texture=np.array([row.get("kind", TextureKind.PLAIN) for row in rows], dtype=np.int32),
        texture_params=np.array([row.get("params", PARAMS) for row in rows], dtype=np.float64),
        hole_rectangle=np.array([index for index, _ in holes], dtype=np.int32),
        hole_extent=np.array([hole for _, hole in holes], dtype=np.float64).reshape(-1, 4),
    )
