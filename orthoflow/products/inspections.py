"""Inspection of products: surveyed check points, the truth of a simulated scene, and findings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import ProductError
from orthoflow.geometry.scenes import Scene
from orthoflow.products.photographs import Cameras
from orthoflow.products.planes import Planes
from orthoflow.products.product import (
    JsonValue,
    Product,
    Tolerance,
    require_shapes,
)


@dataclass(frozen=True, kw_only=True)
class CheckPoints(Product):
    """Surveyed points that were not used in anything they check.

    Attributes:
        names: names of the points.
        points_world: (n, 3) float64 metres.
        classes: class of each point, e.g. `flat`, `vertical`; empty strings without one.
        wall: (n,) int32 number of the wall in whose orthoimage the point was measured, the place of
            its plane in `planes.json`; -1 for none.
        pixels_wall: (n, 2) float64 measured (column, row), NaN where not measured.
        places_m: (n, 2) float64 measured X and Y as the orthoimage's GeoTIFF has them, metres in
            the plane of the wall, or east and north of a map; NaN where not measured so. None
            where no point was.
        shown_world: (n, 3) float64 metres, the world point shown where the point was measured; NaN
            where not measured so. None where no point was.
    """

    type_name: ClassVar[str] = "checkpoints"

    names: tuple[str, ...]
    points_world: NDArray[np.float64]
    classes: tuple[str, ...]
    wall: NDArray[np.int32]
    pixels_wall: NDArray[np.float64]
    places_m: NDArray[np.float64] | None = None
    shown_world: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        count = len(self.names)
        if len(self.classes) != count:
            raise ProductError(f"checkpoints: {count} names have {len(self.classes)} classes")
        require_shapes(
            "checkpoints",
            {
                "points_world": (self.points_world, (count, 3)),
                "wall": (self.wall, (count,)),
                "pixels_wall": (self.pixels_wall, (count, 2)),
                "places_m": (self.places_m, (count, 2)),
                "shown_world": (self.shown_world, (count, 3)),
            },
        )


@dataclass(frozen=True, kw_only=True)
class TakenPhoto:
    """How a simulated photo was taken.

    Attributes:
        photo: file name.
        wall: name of the wall that it is aimed at.
        gsd_m: side of a pixel on the wall where the optical axis meets it.
        obliquity_deg: angle between the optical axis and the wall's normal.
        roll_deg: rotation about the optical axis.
    """

    photo: str
    wall: str
    gsd_m: float
    obliquity_deg: float
    roll_deg: float


@dataclass(frozen=True, kw_only=True)
class Truth(Product):
    """The truth of a simulated scene.

    Attributes:
        scene: the surfaces with their colours; can be rendered from anywhere.
        planes: the planes a detector should find.
        labels: (n,) int16 per point of the simulated cloud: index into `planes`, -1 for none.
        stations: (s, 3) float64 metres, where the scanner stood.
        lowest_elevation_deg: lowest direction of the scanner, above the horizon positive.
        highest_elevation_deg: highest direction of the scanner.
        n_spoilt: points of the cloud that are gross outliers or mix the distances of two surfaces.
        cameras: true orientations of the photos, or None without photos.
        photos: how the photos were taken, in the order of `cameras`.
        details: parameters of the simulation (scan step, noise, relief ...), JSON, for people.
    """

    type_name: ClassVar[str] = "truth"
    embedded: ClassVar[bool] = False

    scene: Scene
    planes: Planes
    labels: NDArray[np.int16]
    stations: NDArray[np.float64]
    lowest_elevation_deg: float = -90.0
    highest_elevation_deg: float = 90.0
    n_spoilt: int = 0
    cameras: Cameras | None = None
    photos: tuple[TakenPhoto, ...] = ()
    details: dict[str, JsonValue] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One number that an inspection returns.

    Attributes:
        name: metric name, unit in the name where it has one.
        value: the number.
        unit: unit, `1` for shares and counts.
        wall: index in `Walls` of the wall that the number describes, -1 for all together.
    """

    name: str
    value: float
    unit: str
    wall: int = -1


@dataclass(frozen=True, kw_only=True)
class Inspection(Product):
    """Displacements measured in orthoimages, and their statistics.

    Attributes:
        wall: (n,) int32 index in `Walls` of the wall of each measured point.
        points_world: (n, 3) float64 metres.
        displacement_m: (n, 2) float64 metres along u and v: shown - true.
        kind: (n,) uint8 class of the point; `kinds` names them.
        kinds: names of the classes.
        findings: the numbers.
        details: further statements of the method, JSON, for people.
    """

    type_name: ClassVar[str] = "inspection"
    tolerances: ClassVar[Mapping[str, Tolerance]] = {
        "points_world": Tolerance(limit=1e-3, unit="m"),
        "displacement_m": Tolerance(limit=1e-4, unit="m"),
    }

    wall: NDArray[np.int32]
    points_world: NDArray[np.float64]
    displacement_m: NDArray[np.float64]
    kind: NDArray[np.uint8]
    kinds: tuple[str, ...]
    findings: tuple[Finding, ...]
    details: dict[str, JsonValue] = field(default_factory=dict)

    def __post_init__(self) -> None:
        count = len(self.wall)
        require_shapes(
            "inspection",
            {
                "wall": (self.wall, (count,)),
                "points_world": (self.points_world, (count, 3)),
                "displacement_m": (self.displacement_m, (count, 2)),
                "kind": (self.kind, (count,)),
            },
        )
        if count and int(self.kind.max()) >= len(self.kinds):
            raise ProductError(f"inspection.kind has more than the {len(self.kinds)} named kinds")
