"""The points of a cloud and the slab around a wall's plane in which they count."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.frames import WallFrame


@dataclass(frozen=True, kw_only=True)
class OffsetPoints:
    """Points as a cloud keeps them.

    Attributes:
        origin: (3,) float64 metres.
        x: (n,) float32 metres from the origin; y and z alike.
        y: see x.
        z: see x.
    """

    origin: NDArray[np.float64]
    x: NDArray[np.float32]
    y: NDArray[np.float32]
    z: NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Slab:
    """The raster of a wall and how far in front of and behind its plane points count.

    Attributes:
        frame: where the cells lie.
        front_m: reach towards the viewer, measured from the plane.
        behind_m: reach away from the viewer, positive.
    """

    frame: WallFrame
    front_m: float
    behind_m: float

    @property
    def n_cells(self) -> int:
        """Number of cells."""
        return self.frame.width * self.frame.height
