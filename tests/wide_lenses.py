"""Where the pixels of fisheyes and panoramas look, by their formulas turned round."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.cube_faces import FisheyeLens


def directions_of(lens: FisheyeLens) -> NDArray[np.float64]:
    """Unit directions (height, width, 3) of a lens without tangential terms, by a table."""
    u, v = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    b = (v - lens.cy) / lens.fy
    a = (u - lens.cx - lens.skew * b) / lens.fx
    angles = np.linspace(0.0, 0.5 * np.pi * 1.2, 40_001)
    powers = np.stack([angles ** (2 * power + 1) for power in range(5)])
    bent = np.array([1.0, *lens.radial]) @ powers
    theta = np.interp(np.hypot(a, b), bent, angles)
    around = np.arctan2(b, a)
    return np.stack(
        [np.sin(theta) * np.cos(around), np.sin(theta) * np.sin(around), np.cos(theta)], axis=-1
    )


def directions_of_panorama(width: int, height: int) -> NDArray[np.float64]:
    """Unit directions (height, width, 3): x forwards, y left, z up, as ASTM E2807 has them."""
    azimuth = (width / 2 - (np.arange(width) + 0.5)) * (2 * np.pi / width)
    elevation = ((height / 2 - (np.arange(height) + 0.5)) * (np.pi / height))[:, None]
    level = np.cos(elevation)
    return np.stack(
        [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation) + 0 * azimuth], axis=-1
    )
