"""Openings in walls: windows, doors, niches, and areas without data."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import ClassVar, Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import ProductError
from orthoflow.geometry.frames import FARTHEST_M
from orthoflow.products.product import JsonValue, Product, Tolerance, require_shapes

OpeningKind = Literal["through", "niche", "no data"]

_CORNERS_LEAST: Final = 3


class OutlineSource(IntEnum):
    """Source of the position of a side of an outline.

    Attributes:
        DEPTH: the depth raster of the wall.
        IMAGE: a photo, accurate to a fraction of a cell.
        UNSEEN: unknown, because the wall next to the side was not measured.
    """

    DEPTH = 0
    IMAGE = 1
    UNSEEN = 2


@dataclass(frozen=True, kw_only=True)
class Opening:
    """An opening in a wall.

    Attributes:
        wall: number of the wall, the index of its plane in `planes.json`.
        wall_name: name of the wall.
        kind: `through` (laser rays passed through it), `niche` (its back was measured) or `no data`
            (no returns, as with glass).
        outline_m: (n, 2) float64 X and Y in the coordinates of the GeoTIFF of the wall (metres
            along the wall and height, or easting and northing), counter-clockwise, not closed.
        outline_world: (n, 3) float64 metres, the same corners on the plane of the wall.
        side_sigma_m: (n,) float64 standard deviation of each side (from corner i to the next),
            perpendicular to it; NaN if the side was not seen.
        side_source: (n,) uint8 `OutlineSource` of each side.
        area_m2: area of the outline.
        width_m: extent along u.
        height_m: extent along v.
        sill_m: height of the lowest corner above the bottom edge of the raster.
        seen_share: share of the length of the outline along which the adjacent wall was measured.
        depth_m: median distance from the face of the wall to the back; None if not measured.
        crs: coordinate system of `outline_m`; see `WallFrame.crs`.
    """

    wall: int
    wall_name: str
    kind: OpeningKind
    outline_m: NDArray[np.float64]
    outline_world: NDArray[np.float64]
    side_sigma_m: NDArray[np.float64]
    side_source: NDArray[np.uint8]
    area_m2: float
    width_m: float
    height_m: float
    sill_m: float
    seen_share: float
    depth_m: float | None = None
    crs: str = "plane"

    def __post_init__(self) -> None:
        count = len(self.outline_m)
        require_shapes(
            "opening",
            {
                "outline_m": (self.outline_m, (count, 2)),
                "outline_world": (self.outline_world, (count, 3)),
                "side_sigma_m": (self.side_sigma_m, (count,)),
                "side_source": (self.side_source, (count,)),
            },
        )
        is_near = all(
            (np.abs(places) < FARTHEST_M).all() for places in (self.outline_m, self.outline_world)
        )
        if count < _CORNERS_LEAST or not is_near:
            raise ProductError(
                f"an opening must have at least {_CORNERS_LEAST} corners, all with coordinates "
                f"below {FARTHEST_M:g} m, got {count} corners"
            )
        if self.kind not in get_args(OpeningKind):
            raise ProductError(
                f"the kind of an opening must be one of {', '.join(get_args(OpeningKind))}, "
                f"got {self.kind!r}"
            )
        if int(self.side_source.max()) > max(OutlineSource):
            raise ProductError(f"opening.side_source must be at most {max(OutlineSource):d}")

    @property
    def edge_sigma_m(self) -> float | None:
        """RMS of `side_sigma_m` over the sides that were seen; None if no side was seen."""
        seen = self.side_sigma_m[np.isfinite(self.side_sigma_m)]
        return math.sqrt(float(np.mean(seen**2))) if len(seen) else None

    @property
    def said(self) -> str:
        """Description for drawings, such as `niche 0.250 m deep, 0.80 x 1.86 m`."""
        deep = f" {self.depth_m:.3f} m deep" if self.kind == "niche" and self.depth_m else ""
        return f"{self.kind}{deep}, {self.width_m:.2f} x {self.height_m:.2f} m"


@dataclass(frozen=True, kw_only=True)
class Openings(Product):
    """Openings in all walls that were searched.

    Attributes:
        openings: all openings, sorted by wall, then from left to right.
        walls: numbers of the searched walls, including walls without openings.
        map_crs: coordinate system of the world, if one is specified in the raster of any wall.
        details: further results as JSON, intended only for users.
    """

    type_name: ClassVar[str] = "openings"
    tolerances: ClassVar[Mapping[str, Tolerance]] = {
        "outline_m": Tolerance(limit=1e-3, unit="m"),
        "outline_world": Tolerance(limit=1e-3, unit="m"),
        "side_sigma_m": Tolerance(limit=1e-3, unit="m"),
        "depth_m": Tolerance(limit=1e-3, unit="m"),
    }

    openings: tuple[Opening, ...]
    walls: tuple[int, ...]
    map_crs: str | None = None
    details: dict[str, JsonValue] = field(default_factory=dict)

    def of_wall(self, number: int) -> tuple[Opening, ...]:
        """Return the openings in the wall with this number."""
        return tuple(opening for opening in self.openings if opening.wall == number)
