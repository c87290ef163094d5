"""Simulated scenes of textured rectangles: what a ray hits and what colour it sees there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Rectangles with holes and procedural textures; one row per rectangle.

    Attributes:
        centre: (r, 3) float64 metres, world.
        axis_a: (r, 3) float64 unit vector in the rectangle; axis_b alike, perpendicular.
        extent: (r, 4) float64 metres: a_min, a_max, b_min, b_max from the centre.
        plane_index: (r,) int16 index of the true plane the rectangle belongs to, -1 for none.
        texture: (r,) int32 number of the texture; parameters in `texture_params`.
        texture_params: (r, 8) float64.
        hole_rectangle: (h,) int32 rectangle a hole is in.
        hole_extent: (h, 4) float64 metres, as `extent`.
    """

    centre: NDArray[np.float64]
    axis_a: NDArray[np.float64]
    axis_b: NDArray[np.float64]
    extent: NDArray[np.float64]
    plane_index: NDArray[np.int16]
    texture: NDArray[np.int32]
    texture_params: NDArray[np.float64]
    hole_rectangle: NDArray[np.int32]
    hole_extent: NDArray[np.float64]
