"""Blocks of the points of a cloud, and slabs around the planes of walls."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.frames import WallFrame
from orthoflow.geometry.threads import in_parts

_Scalar = TypeVar("_Scalar", bound=np.generic)


class Offsets(NamedTuple):
    """Offsets of points from the origin of their cloud along each axis, (n,) float32 metres."""

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    z: NDArray[np.float32]


def read_only(x: NDArray[np.float32], y: NDArray[np.float32], z: NDArray[np.float32]) -> Offsets:
    """Return read-only offsets, as kernels expect them; the arrays may be memory-mapped."""
    return Offsets(*map(read_only_view, (x, y, z)))


def read_only_view(values: NDArray[_Scalar]) -> NDArray[_Scalar]:
    """Return a read-only view: kernels would be compiled once more for writeable arrays."""
    view = np.asarray(values).view(np.ndarray)
    view.flags.writeable = False
    return view


# Two threads use the entire bandwidth of the memory or the disk.
_BOXING_THREADS: Final = 2


class OffsetPoints(Protocol):
    """The attributes of a `PointCloud` that are needed to compute rasters."""

    @property
    def origin(self) -> NDArray[np.float64]:
        """Origin (3,) in metres."""

    @property
    def x(self) -> NDArray[np.float32]:
        """Offsets (n,) from the origin along x, metres."""

    @property
    def y(self) -> NDArray[np.float32]:
        """Offsets (n,) from the origin along y, metres."""

    @property
    def z(self) -> NDArray[np.float32]:
        """Offsets (n,) from the origin along z, metres."""

    @property
    def boxes_m(self) -> NDArray[np.float32] | None:
        """Result of `block_boxes_m` for these points; None if there are few points."""


# Number of points per box. Their coordinates fit into the processor's cache.
BOXED_POINTS: Final = 1 << 16


def block_boxes_m(points: OffsetPoints) -> NDArray[np.float32]:
    """Return the bounding boxes (blocks, 2, 3), in metres, of blocks of `BOXED_POINTS` points.

    Consecutive points of a scan are close together, so a pass over one wall can skip the blocks of
    other walls.
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
    """The raster of a wall, and a range of depths in front of and behind its plane.

    Attributes:
        frame: raster on the plane.
        front_m: maximum distance in front of the plane.
        behind_m: maximum distance behind the plane, positive.
        rms_m: root mean square distance of the points of the plane, an upper limit of their noise;
            0 if unknown.
    """

    frame: WallFrame
    front_m: float
    behind_m: float
    rms_m: float = 0.0

    @property
    def n_cells(self) -> int:
        """Number of cells in the raster."""
        return self.frame.width * self.frame.height

    def over(self, rows: slice) -> Slab:
        """Return the slab for the given rows of the raster."""
        return replace(self, frame=self.frame.of_rows(rows))
