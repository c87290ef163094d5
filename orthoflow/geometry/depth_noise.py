"""Estimate of the noise of a depth raster from the raster itself."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.robust import NMAD_FACTOR

_SAMPLES: Final = 300_000


def depth_noise_m(depth_m: NDArray[np.float32]) -> float:
    """Estimate the standard deviation of a depth from the scatter of neighbours about a line.

    The median of second differences ignores edges; a raster (rows, cols) without three adjacent
    measured cells gives 0.
    """
    # Half of the samples are horizontal, half vertical.
    step = max(1, 2 * depth_m.size // _SAMPLES)
    rows, middle = depth_m[::step], depth_m[1:-1:step]
    across = rows[:, :-2] - 2.0 * rows[:, 1:-1] + rows[:, 2:]
    down = depth_m[:-2:step] - 2.0 * middle + depth_m[2::step]
    bends = np.concatenate([across.ravel(), down.ravel()])
    known = np.abs(bends[np.isfinite(bends)])
    return float(np.median(known)) * NMAD_FACTOR / np.sqrt(6.0) if known.size else 0.0
