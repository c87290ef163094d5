"""What rays meet in a simulated scene and what colour is there, in world coordinates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.scene_rays import Hits, SceneRays
from orthoflow.geometry.scene_views import SceneCameras
from orthoflow.geometry.scenes import Scene


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
