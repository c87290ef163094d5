"""Rasters in a wall's plane: the surface, photos projected onto it, and the finished orthoimage."""

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

# Percentiles of larger rasters are estimated from some of their rows.
_CELLS_ASKED: Final = 1 << 25
# What the intensity of a wall is: that of the laser; the grey of the colours instead; or none.
IntensitySource = Literal["laser", "luminance", "none"]


class SurfaceMask(IntEnum):
    """Where a wall's depth comes from.

    Attributes:
        VOID: nowhere; it is NaN.
        MEASURED: points in the cell.
        RECOVERED: neighbouring cells, over a small gap.
    """

    VOID = 0
    MEASURED = 1
    RECOVERED = 2


class LayerMask(IntEnum):
    """What one source shows of a cell.

    Attributes:
        OUTSIDE: the source does not show the cell.
        PAINTED: it has a colour.
        OCCLUDED: an object is between the cell and the camera.
        NO_SURFACE: no depth is known there.
    """

    OUTSIDE = 0
    PAINTED = 1
    OCCLUDED = 2
    NO_SURFACE = 3


class OrthoMask(IntEnum):
    """The state of a cell of an orthoimage.

    Attributes:
        NONE: no source shows it.
        PAINTED: its colour comes from a source.
        FILLED: its colour comes from neighbouring cells.
        OCCLUDED: hidden from every source that could show it.
        NO_SURFACE: no depth is known there.
        CONTRADICTED: its colour is that of one photo alone, and the scan has another one there.
    """

    NONE = 0
    PAINTED = 1
    FILLED = 2
    OCCLUDED = 3
    NO_SURFACE = 4
    CONTRADICTED = 5


# States of cells whose colour is a source's, and those of cells that show something.
PAINTED_STATES: Final = (OrthoMask.PAINTED, OrthoMask.CONTRADICTED)
SHOWN_STATES: Final = (*PAINTED_STATES, OrthoMask.FILLED)


def is_painted(mask: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return which cells of an orthoimage's mask have the colour of a source."""
    return np.isin(mask, PAINTED_STATES)


def is_shown(mask: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return which cells of an orthoimage's mask show something, be it filled."""
    return np.isin(mask, SHOWN_STATES)


@dataclass(frozen=True, kw_only=True)
class Wall:
    """The scanned surface over one plane, a value per cell.

    Attributes:
        frame: where the cells lie; all rasters have `frame.shape`.
        plane_index: position of the plane in `Planes`.
        name: label of the plane.
        depth_m: float32 metres along the normal, NaN where void.
        sigma_m: float32 metres, spread of the depths seen in the cell, NaN where unknown.
        count: uint32 points in the cell.
        mask: uint8 `SurfaceMask`.
        intensity: float32 0..1, NaN where void, or None when the scan has neither intensity nor
            colour.
        rgb: (rows, cols, 3) uint8, or None.
        rgb_mask: uint8, 1 where rgb holds a colour; None without rgb.
        percentiles_m: (rows, cols, k) float32 metres, `Walls.percentiles` of the depths in the
            cell, NaN in cells without points; None if not requested.
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
    """One raster per chosen plane.

    Attributes:
        walls: in the order of the planes; `wall.plane_index` is the index of its plane.
        up: (3,) float64 unit vector.
        intensity_source: `laser`, `luminance` (no laser intensity: grey of the colours instead) or
            `none`.
        buffer_front_m: maximum distance of points in front of the planes.
        buffer_behind_m: maximum distance behind them.
        buffers_m: the same for each wall, in front and behind; empty if all walls have these.
        percentiles: percentiles (0..100) of the depths in a cell that `Wall.percentiles_m` holds,
            in order; empty if none were requested.
        included: numbers of the planes that each wall shows, so that they are not walls of their
            own; empty if unknown.
        details: further statements of the method, JSON.
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
                f"{len(self.walls)} walls need a buffer each or none, got {len(self.buffers_m)}"
            )
        if self.included and len(self.included) != len(self.walls):
            raise ProductError(f"included must tell of {len(self.walls)} walls, or of none")
        for wall in self.walls:
            rasters = wall.percentiles_m
            if rasters is not None and rasters.shape[2:] != (len(self.percentiles),):
                raise ProductError(
                    f"{wall.name}: percentiles_m has shape {rasters.shape}, but the walls "
                    f"have {len(self.percentiles)} percentiles"
                )

    def slab(self, index: int) -> Slab:
        """Return the slab of a wall: its raster, and the depths around its plane."""
        front_m, behind_m = (
            self.buffers_m[index] if self.buffers_m else (self.buffer_front_m, self.buffer_behind_m)
        )
        return Slab(frame=self.walls[index].frame, front_m=front_m, behind_m=behind_m)

    def nearest(self, points_world: NDArray[np.float64]) -> NDArray[np.int32]:
        """Index (n,) of the wall whose rectangle is nearest to each point (n, 3); -1 for none."""
        if not self.walls:
            return np.full(len(points_world), -1, dtype=np.int32)
        distances_m = [wall.frame.distances_m(points_world) for wall in self.walls]
        return np.asarray(np.argmin(distances_m, axis=0), dtype=np.int32)

    def spacing_m(self) -> float:
        """Return the finest raster's cell size, or the point spacing on it if that is larger."""
        return max(min(wall.frame.gsd_m for wall in self.walls), self.points_apart_m())

    def points_apart_m(self) -> float:
        """Return the approximate point spacing on the finest raster, however coarse it is."""
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
    """One source (a photo, or the cloud itself) projected onto one wall.

    Attributes:
        frame: where the cells lie.
        wall: index of the wall in `Walls`.
        source: name of the source, e.g. a photo's name, or `cloud`.
        rgb: (rows, cols, 3) uint8, or uint16 of deep photos (the same for all layers of a block), 0
            where not painted; `geometry.levels` converts between them.
        mask: uint8 `LayerMask`; cells of value 1 are painted.
        quality: float32, larger is better, comparable between the layers of one wall; 0 where
            not painted.
        filled: uint8, 1 where the colour was inpainted from neighbours, or None.
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
        layers: grouped by wall in the order of `Walls`, then by source.
        names: name of each wall, by its index.
        plane_indices: position of each wall's plane in `Planes`, by its index; if empty, the index
            is used.
        icc_profile: colour profile common to all sources, or None: sRGB or unknown.
        details: further statements of the method, JSON.
    """

    type_name: ClassVar[str] = "layers"
    embedded: ClassVar[bool] = False
    tolerances: ClassVar[Mapping[str, Tolerance]] = {
        "rgb": Tolerance(limit=2, unit="grey"),
        "quality": Tolerance(limit=1e-3, unit="1"),
        "origin_world": Tolerance(limit=1e-3, unit="m"),
    }

    layers: tuple[Layer, ...]
    names: tuple[str, ...] = ()
    plane_indices: tuple[int, ...] = ()
    icc_profile: bytes | None = None
    details: dict[str, JsonValue] = field(default_factory=dict)

    def number(self, wall: int) -> int:
        """Return the number of a wall as people see it: the place of its plane in `planes.json`."""
        return self.plane_indices[wall] if wall < len(self.plane_indices) else wall

    def name(self, wall: int) -> str:
        """Return the name of a wall by its index."""
        known = wall < len(self.names)
        return self.names[wall] if known else plane_name("wall", self.number(wall))


@dataclass(frozen=True, kw_only=True)
class Orthoimage:
    """The finished image of one wall.

    Attributes:
        frame: where the cells lie.
        wall: index of the wall in `Walls`.
        name: label of the wall.
        rgb: (rows, cols, 3) uint8, or uint16 of deep photos, as in the sources, 0 where nothing is
            shown; `geometry.eight_bits` converts to 8 bits.
        mask: uint8 `OrthoMask`; painted and filled cells are shown.
        source: int16 index into `sources`, -1 where not painted.
        sources: names of the sources, e.g. photo names, or `cloud`.
        plane_index: position of the wall's plane in `Planes`; None if unknown.
        error_m: float32 expected error of a point measured in the image, one standard deviation of
            u and of v, metres; NaN where unknown. None if unknown everywhere.
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
        """Return median and 95th percentile of the expected error, millimetres; NaN if unknown.

        Estimated from some of the rows of large images.
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
        """The number of the wall as people see it: the place of its plane in `planes.json`."""
        return self.wall if self.plane_index is None else self.plane_index


@dataclass(frozen=True, kw_only=True)
class Orthoimages(Product):
    """Orthoimages of all walls, in the order of `Walls`.

    Attributes:
        images: one per wall.
        icc_profile: colour profile of the colours, or None: sRGB or unknown.
        layers: what each source shows by itself, if requested; None otherwise.
        details: further statements of the method, JSON.
    """

    type_name: ClassVar[str] = "orthoimages"
    tolerances: ClassVar[Mapping[str, Tolerance]] = {
        "rgb": Tolerance(limit=2, unit="grey"),
        "error_m": Tolerance(limit=1e-4, unit="m"),
        "origin_world": Tolerance(limit=1e-3, unit="m"),
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
