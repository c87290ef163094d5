"""Rasters of walls: surfaces, photos projected onto them, and finished orthoimages."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import ProductError
from orthoflow.geometry import WallFrame
from orthoflow.geometry.bands import row_bands
from orthoflow.geometry.levels import Colours
from orthoflow.geometry.slabs import Slab
from orthoflow.products.planes import plane_name
from orthoflow.products.product import Array, JsonValue, Product, Tolerance

# Percentiles of rasters with more cells are estimated from a subset of the rows.
_CELLS_ASKED: Final = 1 << 25
# Source of a wall's intensity: the laser, the luminance of the colours, or none.
IntensitySource = Literal["laser", "luminance", "none"]


class SurfaceMask(IntEnum):
    """Source of the depth of a cell.

    Attributes:
        VOID: none; the depth is NaN.
        MEASURED: points in the cell.
        RECOVERED: interpolated from neighbouring cells, in a small gap.
    """

    VOID = 0
    MEASURED = 1
    RECOVERED = 2


class LayerMask(IntEnum):
    """State of a cell in a layer.

    Attributes:
        OUTSIDE: the cell is outside the source.
        PAINTED: the cell has a colour.
        OCCLUDED: an object hides the cell from the camera, or the cell is seen too obliquely, or is
            too near the outline of a curved surface.
        NO_SURFACE: the depth is unknown.
    """

    OUTSIDE = 0
    PAINTED = 1
    OCCLUDED = 2
    NO_SURFACE = 3


class OrthoMask(IntEnum):
    """State of a cell of an orthoimage.

    Attributes:
        NONE: the cell is outside all sources.
        PAINTED: the colour is from a source.
        FILLED: the colour is from neighbouring cells.
        OCCLUDED: the cell is hidden in all sources that face it.
        NO_SURFACE: the depth is unknown.
        CONTRADICTED: the colour is from a single photo, and it contradicts the colour of the scan.
    """

    NONE = 0
    PAINTED = 1
    FILLED = 2
    OCCLUDED = 3
    NO_SURFACE = 4
    CONTRADICTED = 5


# States of cells with a colour from a source.
PAINTED_STATES: Final = (OrthoMask.PAINTED, OrthoMask.CONTRADICTED)
# States of all cells with a colour.
SHOWN_STATES: Final = (*PAINTED_STATES, OrthoMask.FILLED)


def is_painted(mask: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return a mask of the cells that have a colour from a source, given an orthoimage's mask."""
    return np.isin(mask, PAINTED_STATES)


def is_shown(mask: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return a mask of the cells that have a colour or are filled, given an orthoimage's mask."""
    return np.isin(mask, SHOWN_STATES)


@dataclass(frozen=True, kw_only=True)
class Wall:
    """Rasters of the scanned surface on one plane or cylinder.

    Attributes:
        frame: position of the cells; all rasters have `frame.shape`.
        plane_index: index of the plane in `Planes`; curved surfaces are numbered after all planes.
        name: name of the plane.
        depth_m: float32 metres along the normal, NaN if void.
        sigma_m: float32 metres, spread of the depths in a cell, NaN if unknown.
        count: uint32 number of points in a cell.
        mask: uint8 `SurfaceMask`.
        intensity: float32 0 to 1, NaN if void; None if the scan has neither intensities nor
            colours.
        rgb: (rows, cols, 3) uint8, or None.
        rgb_mask: uint8, 1 if the cell has a colour; None if `rgb` is None.
        percentiles_m: (rows, cols, k) float32 metres, percentiles of the depths in a cell (see
            `Walls.percentiles`); NaN in cells without points; None if not requested.
    """

    frame: WallFrame
    plane_index: int
    name: str
    depth_m: NDArray[np.float32]
    sigma_m: NDArray[np.float32]
    count: NDArray[np.uint32]
    mask: NDArray[np.uint8]
    intensity: NDArray[np.float32] | None = None
    rgb: NDArray[np.uint8] | None = None
    rgb_mask: NDArray[np.uint8] | None = None
    percentiles_m: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        names = "depth_m sigma_m count mask intensity rgb rgb_mask percentiles_m"
        _check_rasters(self, self.name, names)


@dataclass(frozen=True, kw_only=True)
class Walls(Product):
    """Rasters of all selected planes.

    Attributes:
        walls: in the order of their planes; `plane_index` of each wall is the index of its plane.
        up: (3,) float64 unit vector.
        intensity_source: `laser`, `luminance` (grey value of the colours, because there is no laser
            intensity) or `none`.
        buffer_front_m: maximum distance of a wall's points in front of its plane.
        buffer_behind_m: maximum distance of a wall's points behind its plane.
        buffers_m: maximum distances in front and behind for each wall; empty if `buffer_front_m`
            and `buffer_behind_m` apply to all walls.
        percentiles: percentiles (0 to 100) in `Wall.percentiles_m`, in order; empty if none were
            requested.
        included: for each wall, the numbers of other planes that it shows and that have no wall of
            their own; empty if unknown.
        details: further results as JSON, intended only for users.
    """

    type_name: ClassVar[str] = "walls"
    tolerances: ClassVar[Mapping[str, Tolerance]] = {
        "depth_m": Tolerance(limit=1e-4, unit="m"),
        "sigma_m": Tolerance(limit=1e-4, unit="m"),
        "percentiles_m": Tolerance(limit=1e-4, unit="m"),
        "intensity": Tolerance(limit=1e-3, unit="1"),
        "rgb": Tolerance(limit=2, unit="grey"),
        "origin_world": Tolerance(limit=1e-3, unit="m"),
        "u_world": Tolerance(limit=1e-6, unit="1"),
        "v_world": Tolerance(limit=1e-6, unit="1"),
        "normal_world": Tolerance(limit=1e-6, unit="1"),
        "radius_m": Tolerance(limit=1e-4, unit="m"),
    }

    walls: tuple[Wall, ...]
    up: NDArray[np.float64]
    intensity_source: IntensitySource
    buffer_front_m: float
    buffer_behind_m: float
    buffers_m: tuple[tuple[float, float], ...] = ()
    percentiles: tuple[float, ...] = ()
    included: tuple[tuple[int, ...], ...] = ()
    details: dict[str, JsonValue] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.buffers_m and len(self.buffers_m) != len(self.walls):
            raise ProductError(
                f"walls.buffers_m must be empty or have one value per wall, got "
                f"{len(self.buffers_m)} for {len(self.walls)} walls"
            )
        if self.included and len(self.included) != len(self.walls):
            raise ProductError(
                f"walls.included must be empty or have one entry for each of {len(self.walls)} "
                "walls"
            )
        for wall in self.walls:
            rasters = wall.percentiles_m
            if rasters is not None and rasters.shape[2:] != (len(self.percentiles),):
                raise ProductError(
                    f"{wall.name}: percentiles_m has shape {rasters.shape}, but the walls "
                    f"have {len(self.percentiles)} percentiles"
                )

    def slab(self, index: int) -> Slab:
        """Return the slab of a wall: its frame and range of depths."""
        front_m, behind_m = (
            self.buffers_m[index] if self.buffers_m else (self.buffer_front_m, self.buffer_behind_m)
        )
        return Slab(frame=self.walls[index].frame, front_m=front_m, behind_m=behind_m)

    def nearest(
        self, points_world: NDArray[np.float64], *, is_within_buffer: bool = False
    ) -> NDArray[np.int32]:
        """Return the index (n,) of the wall nearest to each point (n, 3); -1 if none.

        Args:
            points_world: (n, 3) metres.
            is_within_buffer: ignore a wall if its raster is farther from the point than the larger
                of its two buffers.
        """
        nearest = np.full(len(points_world), -1, dtype=np.int32)
        if not self.walls:
            return nearest
        distances_m = np.array([wall.frame.distances_m(points_world) for wall in self.walls])
        if is_within_buffer:
            slabs = map(self.slab, range(len(self.walls)))
            limits_m = [max(slab.front_m, slab.behind_m) for slab in slabs]
            distances_m[distances_m > np.array(limits_m)[:, None]] = np.inf
        reached = np.isfinite(distances_m.min(axis=0))
        nearest[reached] = distances_m[:, reached].argmin(axis=0)
        return nearest

    def spacing_m(self) -> float:
        """Return the cell size or the point spacing of the finest raster, whichever is larger."""
        return max(min(wall.frame.gsd_m for wall in self.walls), self.points_apart_m())

    def points_apart_m(self) -> float:
        """Return the approximate point spacing of the finest raster."""
        wall = min(self.walls, key=lambda wall: wall.frame.gsd_m)
        n_known = n_points = 0
        for rows in row_bands(wall.depth_m.shape):
            known = np.isfinite(wall.depth_m[rows])
            n_known += int(np.count_nonzero(known))
            n_points += int(wall.count[rows].sum(where=known, dtype=np.int64))
        density = n_points / n_known if n_known else 1.0
        return wall.frame.gsd_m / math.sqrt(max(density, 0.1))


@dataclass(frozen=True, kw_only=True)
class Layer:
    """One source (a photo or the cloud) projected onto one wall.

    Attributes:
        frame: position of the cells.
        wall: index of the wall in `Walls`.
        source: name of the photo, or `cloud`.
        rgb: (rows, cols, 3) uint8, or uint16 if any photo has 16 bits per channel; 0 in cells
            without a colour. `geometry.levels` converts between the two types.
        mask: uint8 `LayerMask`; cells with the value 1 have a colour.
        quality: float32; larger values are better; comparable between the layers of a wall; 0 in
            cells without a colour.
        filled: uint8, 1 if the colour was interpolated from neighbours; None if no colours were
            interpolated.
    """

    frame: WallFrame
    wall: int
    source: str
    rgb: Colours
    mask: NDArray[np.uint8]
    quality: NDArray[np.float32]
    filled: NDArray[np.uint8] | None = None

    def __post_init__(self) -> None:
        _check_rasters(self, f"layer {self.source}", "rgb mask quality filled")


@dataclass(frozen=True, kw_only=True)
class Layers(Product):
    """Layers of all walls.

    Attributes:
        layers: all layers, grouped by wall in the order of `Walls`, then by source.
        names: names of the walls.
        plane_indices: index in `Planes` of the plane of each wall; if empty, the index of the wall
            is used.
        icc_profile: colour profile of all sources; None for sRGB or if unknown.
        details: further results as JSON, intended only for users.
    """

    type_name: ClassVar[str] = "layers"
    embedded: ClassVar[bool] = False
    tolerances: ClassVar[Mapping[str, Tolerance]] = {
        "rgb": Tolerance(limit=2, unit="grey"),
        "quality": Tolerance(limit=1e-3, unit="1"),
        "origin_world": Tolerance(limit=1e-3, unit="m"),
        "radius_m": Tolerance(limit=1e-4, unit="m"),
    }

    layers: tuple[Layer, ...]
    names: tuple[str, ...] = ()
    plane_indices: tuple[int, ...] = ()
    icc_profile: bytes | None = None
    details: dict[str, JsonValue] = field(default_factory=dict)

    def number(self, wall: int) -> int:
        """Return the wall number shown to users: the index of the plane in `planes.json`."""
        return self.plane_indices[wall] if wall < len(self.plane_indices) else wall

    def name(self, wall: int) -> str:
        """Return the name of the wall with this index."""
        known = wall < len(self.names)
        return self.names[wall] if known else plane_name("wall", self.number(wall))


@dataclass(frozen=True, kw_only=True)
class Orthoimage:
    """The finished orthoimage of one wall.

    Attributes:
        frame: position of the cells, an `orthoflow.geometry.WallFrame`; `frame.gsd_m` is the size
            of a cell in metres.
        wall: index of the wall in `Walls`.
        name: name of the wall.
        rgb: (rows, cols, 3) uint8 or uint16 as in the layers; 0 in cells without a colour.
            `geometry.eight_bits` converts to 8 bits.
        mask: uint8 `OrthoMask`; `is_shown(mask)` marks the cells with a colour.
        source: int16 index in `sources`, -1 if the colour is not from a source.
        sources: names of the photos, or `cloud`.
        plane_index: index in `Planes` of the plane of the wall; None if unknown.
        error_m: float32 metres, standard deviation of u and of v of a point measured in the image,
            NaN if unknown; None if unknown for all cells.
        n_check_points: number of independent points that check the photos on this wall.
    """

    frame: WallFrame
    wall: int
    name: str
    rgb: Colours
    mask: NDArray[np.uint8]
    source: NDArray[np.int16]
    sources: tuple[str, ...]
    plane_index: int | None = None
    error_m: NDArray[np.float32] | None = None
    n_check_points: int = 0

    def __post_init__(self) -> None:
        _check_rasters(self, f"orthoimage {self.name}", "rgb mask source error_m")

    @property
    def expected_mm(self) -> tuple[float, float]:
        """Return the median and 95th percentile of the expected error, in mm; NaN if unknown.

        For a large image, they are estimated from some of its rows.
        """
        if self.error_m is None:
            return math.nan, math.nan
        some = self.error_m[:: max(1, self.error_m.size // _CELLS_ASKED)]
        known = some[np.isfinite(some)]
        if not known.size:
            return math.nan, math.nan
        median, high = np.percentile(known, (50.0, 95.0))
        return 1e3 * float(median), 1e3 * float(high)

    @property
    def number(self) -> int:
        """Wall number shown to users: the index of the plane in `planes.json`."""
        return self.wall if self.plane_index is None else self.plane_index


@dataclass(frozen=True, kw_only=True)
class Orthoimages(Product):
    """Orthoimages of all walls, in the order of `Walls`.

    Attributes:
        images: orthoimage of each wall.
        icc_profile: colour profile; None for sRGB or if unknown.
        layers: layers from which the images were composed; None if not requested.
        details: further results as JSON, intended only for users.
    """

    type_name: ClassVar[str] = "orthoimages"
    tolerances: ClassVar[Mapping[str, Tolerance]] = {
        "rgb": Tolerance(limit=2, unit="grey"),
        "error_m": Tolerance(limit=1e-4, unit="m"),
        "origin_world": Tolerance(limit=1e-3, unit="m"),
        "radius_m": Tolerance(limit=1e-4, unit="m"),
    }

    images: tuple[Orthoimage, ...]
    icc_profile: bytes | None = None
    layers: tuple[Layer, ...] | None = None
    details: dict[str, JsonValue] = field(default_factory=dict)


def _check_rasters(owner: Wall | Layer | Orthoimage, called: str, names: str) -> None:
    shape = owner.frame.shape
    for name in names.split():
        raster: Array | None = getattr(owner, name)
        if raster is not None and raster.shape[:2] != shape:
            raise ProductError(
                f"{called}: {name} has {raster.shape[:2]} cells, but its frame has {shape}"
            )
