"""Point clouds: coordinates relative to an origin, measured values, and scanner stations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import ProductError
from orthoflow.geometry.slabs import BOXED_POINTS, block_boxes_m
from orthoflow.products.product import JsonValue, Product, Tolerance

# A cloud with fewer blocks is always read as a whole.
_BLOCKS_LEAST: Final = 16


@dataclass(frozen=True, kw_only=True)
class PointCloud(Product):
    """Points of one or more scans in one world frame.

    The world coordinates of point i are `origin + (x[i], y[i], z[i])`. Only the offsets are
    float32, so survey coordinates of 10^6 m lose no precision.

    Attributes:
        origin: (3,) float64 metres.
        x: (n,) float32 metres, offset from the origin; y and z likewise. The arrays are separate
            because contiguous arrays are read at full memory bandwidth.
        up: (3,) float64 unit vector in world axes.
        intensity: (n,) float32, 0 to 1, NaN if not measured; None if no point has an intensity.
        rgb: (n, 3) uint8 sRGB, or None.
        has_rgb: (n,) bool, True for points with a colour; None if all have one or `rgb` is None.
        scan: (n,) uint16 index of the scan of each point, or None.
        row: (n,) uint32 row in the grid of the scan, or None; `column` likewise.
        point_id: (n,) uint32 index of each point in the cloud as read; None if it equals the index
            in this cloud. See `selected`.
        stations: (s, 3) float64 metres, positions of the scanner or the viewer, or None.
        stations_source: `file`, `view_from` (given by the user), or None if there are no stations.
        source: information for users on how the cloud was read, such as the files, the unit, the
            ranges before normalisation and the numbers of dropped points.
    """

    type_name: ClassVar[str] = "cloud"
    mapped: ClassVar[bool] = True
    embedded: ClassVar[bool] = False
    tolerances: ClassVar[Mapping[str, Tolerance]] = {
        "x": Tolerance(limit=1e-6, unit="m"),
        "y": Tolerance(limit=1e-6, unit="m"),
        "z": Tolerance(limit=1e-6, unit="m"),
        "origin": Tolerance(limit=1e-6, unit="m"),
        "intensity": Tolerance(limit=1e-6, unit="1"),
        "rgb": Tolerance(limit=1, unit="grey"),
    }

    origin: NDArray[np.float64]
    x: NDArray[np.float32]
    y: NDArray[np.float32]
    z: NDArray[np.float32]
    up: NDArray[np.float64]
    intensity: NDArray[np.float32] | None = None
    rgb: NDArray[np.uint8] | None = None
    has_rgb: NDArray[np.bool_] | None = None
    scan: NDArray[np.uint16] | None = None
    row: NDArray[np.uint32] | None = None
    column: NDArray[np.uint32] | None = None
    point_id: NDArray[np.uint32] | None = None
    stations: NDArray[np.float64] | None = None
    stations_source: str | None = None
    source: dict[str, JsonValue] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n_points = len(self.x)
        wanted: dict[str, tuple[object, tuple[int, ...], str]] = {
            "origin": (self.origin, (3,), "f8"),
            "up": (self.up, (3,), "f8"),
            "x": (self.x, (n_points,), "f4"),
            "y": (self.y, (n_points,), "f4"),
            "z": (self.z, (n_points,), "f4"),
            "intensity": (self.intensity, (n_points,), "f4"),
            "rgb": (self.rgb, (n_points, 3), "u1"),
            "has_rgb": (self.has_rgb, (n_points,), "b1"),
            "scan": (self.scan, (n_points,), "u2"),
            "row": (self.row, (n_points,), "u4"),
            "column": (self.column, (n_points,), "u4"),
            "point_id": (self.point_id, (n_points,), "u4"),
        }
        for name, (value, shape, dtype) in wanted.items():
            if value is None:
                continue
            array = np.asanyarray(value)
            if array.shape != shape or array.dtype != np.dtype(dtype):
                raise ProductError(
                    f"cloud.{name} must be {dtype} of shape {shape}, got {array.dtype} of shape "
                    f"{array.shape}"
                )

    def __len__(self) -> int:
        return len(self.x)

    def check_against(self, others: Mapping[str, Product]) -> None:
        """See `Product.check_against`.

        Raises:
            ProductError: a coordinate is not finite.
        """
        for name in ("origin", "up", "x", "y", "z"):
            if not np.isfinite(getattr(self, name)).all():
                raise ProductError(f"cloud.{name} must be finite")

    @cached_property
    def boxes_m(self) -> NDArray[np.float32] | None:
        """Return the bounding boxes (b, 2, 3) of blocks of points, metres; None for a small cloud.

        The rows of a box are its lowest and its highest x, y and z, relative to the origin.
        """
        return block_boxes_m(self) if len(self) > _BLOCKS_LEAST * BOXED_POINTS else None

    def points_world(self, index: NDArray[np.int64] | slice = slice(None)) -> NDArray[np.float64]:
        """Return a copy of the world coordinates (m, 3) of selected points, float64."""
        offsets = np.column_stack([self.x[index], self.y[index], self.z[index]])
        return self.origin + offsets.astype(np.float64)

    def selected(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> PointCloud:
        """Return a cloud of selected points with their ids and all measured values.

        Args:
            chosen: (n,) bool mask of points, or indices of points in the requested order.
        """
        fields = ("x", "y", "z", "intensity", "rgb", "has_rgb", "scan", "row", "column")
        arrays = {name: getattr(self, name) for name in fields}
        ids = np.arange(len(self), dtype=np.uint32) if self.point_id is None else self.point_id
        return replace(
            self,
            point_id=ids[chosen],
            **{name: array[chosen] for name, array in arrays.items() if array is not None},
        )

    def require_points(self, n_least: int) -> None:
        """Require a minimum number of points, and finite coordinates.

        Raises:
            ProductError: the cloud has fewer than `n_least` points, or coordinates that are not
                finite.
        """
        if len(self) < n_least:
            raise ProductError(
                f"the cloud has too few points: {len(self)}; at least {n_least} are needed"
            )
        for name, values in (("x", self.x), ("y", self.y), ("z", self.z), ("origin", self.origin)):
            # The sum is finite if and only if all values are finite, since it cannot overflow
            # float64 here. Unlike `np.isfinite(values)`, it needs no array as large as the cloud.
            if not np.isfinite(np.sum(values, dtype=np.float64)):
                raise ProductError(
                    f"cloud.{name} contains NaN or infinite coordinates: read the cloud with "
                    "read.scan, which drops such points"
                )
