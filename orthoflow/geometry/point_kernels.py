"""The points of a cloud in the form that compiled passes require."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Offsets(NamedTuple):
    """Offsets of points from their cloud's origin, (n,) float32 metres each."""

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    z: NDArray[np.float32]


def read_only(x: NDArray[np.float32], y: NDArray[np.float32], z: NDArray[np.float32]) -> Offsets:
    """Return arrays, including mapped files, in the form for which kernels are compiled."""
    views = [np.asarray(values).view(np.ndarray) for values in (x, y, z)]
    for view in views:
        view.flags.writeable = False
    return Offsets(*views)
