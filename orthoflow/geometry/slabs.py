"""The points of a cloud, block by block, and the slab around a wall's plane that limits them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.frames import WallFrame
from orthoflow.geometry.threads import in_parts


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


# Coordinates are read at the speed of memory or of the disk, which two threads saturate.
_BOXING_THREADS: Final = 2


class OffsetPoints(Protocol):
    """The part of a `PointCloud` that raster passes read."""

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

    @property
    def boxes_m(self) -> NDArray[np.float32] | None:
        """The result of `block_boxes_m` for these points; None for too few to be worth it."""


# Points of a box: their coordinates stay in the processor's cache while it is computed.
BOXED_POINTS: Final = 1 << 16


def block_boxes_m(points: OffsetPoints) -> NDArray[np.float32]:
    """Return boxes (blocks, 2, 3) of `BOXED_POINTS` points: lowest and highest offsets, metres.

    A scan is ordered, so the points of a block are close together, and a pass over one wall need
    not read those of the others.
    """
    n_blocks = -(-len(points.x) // BOXED_POINTS)
    boxes_m = np.empty((n_blocks, 2, 3), dtype=np.float32)

    def find(first: int, end: int) -> None:
        for block in range(first, end):
            part = slice(block * BOXED_POINTS, (block + 1) * BOXED_POINTS)
            for axis, values in enumerate((points.x, points.y, points.z)):
                boxes_m[block, :, axis] = values[part].min(), values[part].max()

    in_parts(find, n_blocks, threads=_BOXING_THREADS)
    return boxes_m


@dataclass(frozen=True, kw_only=True)
class Slab:
    """The raster of a wall and the range of depths in front of and behind its plane.

    Attributes:
        frame: where the cells lie.
        front_m: range towards the viewer, measured from the plane.
        behind_m: range away from the viewer, positive.
    """

    frame: WallFrame
    front_m: float
    behind_m: float

    @property
    def n_cells(self) -> int:
        """Number of cells."""
        return self.frame.width * self.frame.height

    def over(self, rows: slice) -> Slab:
        """Return the slab over some rows of the raster."""
        frame = self.frame
        corner = frame.origin_world + rows.start * frame.gsd_m * frame.v_world
        part = replace(frame, origin_world=corner, height=rows.stop - rows.start)
        return replace(self, frame=part)
