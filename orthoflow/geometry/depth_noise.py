"""How noisy a raster of depths is, told from the raster itself."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.robust import NMAD_FACTOR

_SAMPLES: Final = 300_000


def depth_noise_m(depth_m: NDArray[np.float32]) -> float:
    """Standard deviation of a depth, told from how neighbours scatter about a line.

    The median of second differences does not see edges; a raster (rows, cols) without three
    measured neighbours has no noise that could be told: 0.
    """
    # Half of the samples lie across, half down.
    step = max(1, 2 * depth_m.size // _SAMPLES)
    rows, middle = depth_m[::step], depth_m[1:-1:step]
    across = rows[:, :-2] - 2.0 * rows[:, 1:-1] + rows[:, 2:]
    down = depth_m[:-2:step] - 2.0 * middle + depth_m[2::step]
    bends = np.concatenate([across.ravel(), down.ravel()])
    known = np.abs(bends[np.isfinite(bends)])
    return float(np.median(known)) * NMAD_FACTOR / np.sqrt(6.0) if known.size else 0.0
