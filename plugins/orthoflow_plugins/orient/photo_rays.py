"""Rays of pixels through lenses that may fold back inside the image."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.cameras import ViewingCamera, undistorted

_UNDONE: Final = 1e-9


def camera_rays(camera: ViewingCamera, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Directions (n, 3) with z = 1 in camera axes; NaN where the distortion cannot be undone."""
    a, b = (pixels - [camera.cx, camera.cy]).T / np.array([[camera.fx], [camera.fy]])
    found = undistorted(a, b, camera.distortion)
    rays = np.column_stack([found[0], found[1], np.ones(len(pixels))])
    rays[~(found[2] < _UNDONE)] = np.nan
    return rays
