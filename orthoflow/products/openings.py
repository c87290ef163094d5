"""Openings of walls: windows, doors, niches, and areas without data."""

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

# The laser saw what lies behind the wall; the back was measured; nothing returned.
OpeningKind = Literal["through", "niche", "no data"]

_CORNERS_LEAST: Final = 3


class OutlineSource(IntEnum):
    """What the position of a side of an outline was found from.

    Attributes:
        DEPTH: the depths of the wall's raster.
        IMAGE: a photo, to a fraction of a cell.
        UNSEEN: nothing: the wall beside it was not measured.
    """

    DEPTH = 0
    IMAGE = 1
    UNSEEN = 2


@dataclass(frozen=True, kw_only=True)
class Opening:
    """One opening of a wall.

    Attributes:
        wall: number of the wall, the place of its plane in `planes.json`.
        wall_name: what the wall is called.
        kind: `through` (the laser saw what lies behind the wall), `niche` (its back was measured)
            or `no data` (nothing returned).
        outline_m: (n, 2) float64 X and Y as the wall's GeoTIFF has them (metres along the wall and
            height, or east and north of a map), counter-clockwise, not closed.
        outline_world: (n, 3) float64 metres, the same corners on the wall's plane.
        side_sigma_m: (n,) float64 standard deviation of each side, perpendicular to it, from corner
            i to the next; NaN for sides that were not seen.
        side_source: (n,) uint8 `OutlineSource` of each side.
        area_m2: area of the outline.
        width_m: extent along the wall's u.
        height_m: extent along the wall's v.
        sill_m: height of its lowest corner above the lower edge of the wall's raster.
        seen_share: share of the outline along which the wall beside it was measured.
        depth_m: distance of the back behind the wall's face, median; None where none was measured.
        crs: coordinate system of `outline_m`, as `WallFrame.crs`.
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
                f"an opening needs {_CORNERS_LEAST} corners or more, of numbers below "
                f"{FARTHEST_M:g}, got {count}"
            )
        if self.kind not in get_args(OpeningKind):
            raise ProductError(
                f"an opening is {', '.join(get_args(OpeningKind))}, got {self.kind!r}"
            )
        if int(self.side_source.max()) > max(OutlineSource):
            raise ProductError(f"opening.side_source must be at most {max(OutlineSource):d}")

    @property
    def edge_sigma_m(self) -> float | None:
        """Return the RMS standard deviation of the sides that were seen; None without any."""
        seen = self.side_sigma_m[np.isfinite(self.side_sigma_m)]
        return math.sqrt(float(np.mean(seen**2))) if len(seen) else None

    @property
    def said(self) -> str:
        """Return its description in a drawing: `niche 0.250 m deep, 0.80 x 1.86 m`."""
        deep = f" {self.depth_m:.3f} m deep" if self.kind == "niche" and self.depth_m else ""
        return f"{self.kind}{deep}, {self.width_m:.2f} x {self.height_m:.2f} m"


@dataclass(frozen=True, kw_only=True)
class Openings(Product):
    """Openings of all walls that were searched.

    Attributes:
        openings: by wall, then from left to right.
        walls: numbers of the walls that were searched, including those without openings.
        map_crs: coordinate system of the world, if some wall's raster names it.
        details: further statements of the method, JSON, for people.
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
        """Return the openings of one wall, by the number of its plane."""
        return tuple(opening for opening in self.openings if opening.wall == number)
