"""The points of a cloud and the slab around a wall's plane in which they count."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.frames import WallFrame


class OffsetPoints(Protocol):
    """What the raster passes read of a `PointCloud`."""

    @property
    def origin(self) -> NDArray[np.float64]:
        """(3,) metres."""

    @property
    def x(self) -> NDArray[np.float32]:
        """(n,) metres from the origin along x."""

    @property
    def y(self) -> NDArray[np.float32]:
        """(n,) metres from the origin along y."""

    @property
    def z(self) -> NDArray[np.float32]:
        """(n,) metres from the origin along z."""


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
