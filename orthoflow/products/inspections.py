"""Data of inspections: check points, the ground truth of a simulated scene, and results."""

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
from orthoflow.products.surfaces import Surfaces


@dataclass(frozen=True, kw_only=True)
class CheckPoints(Product):
    """Surveyed points that were not used to produce the data that they check.

    Attributes:
        names: name of each point.
        points_world: (n, 3) float64 metres.
        classes: class of each point, such as `flat` or `vertical`; empty if none is given.
        wall: (n,) int32 number of the wall in whose orthoimage the point was measured (index of the
            wall's plane in `planes.json`); -1 if not measured.
        pixels_wall: (n, 2) float64 (column, row) as measured, NaN where not measured.
        places_m: (n, 2) float64 X and Y as measured, in the coordinates of the orthoimage's
            GeoTIFF: metres in the plane of the wall, or easting and northing of a map. NaN if a
            point was measured in another way; None if this applies to all points.
        shown_world: (n, 3) float64 metres, world coordinates of the measured position. NaN if a
            point was measured in another way; None if this applies to all points.
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
            raise ProductError(
                f"checkpoints.classes must have one class per name, got {len(self.classes)} "
                f"classes for {count} names"
            )
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
    """Geometry of a simulated photo.

    Attributes:
        photo: file name.
        wall: name of the wall at which the camera is aimed.
        gsd_m: size of a pixel on the wall, at the optical axis, in metres.
        obliquity_deg: angle between the optical axis and the normal of the wall.
        roll_deg: rotation about the optical axis.
    """

    photo: str
    wall: str
    gsd_m: float
    obliquity_deg: float
    roll_deg: float


@dataclass(frozen=True, kw_only=True)
class Truth(Product):
    """Ground truth of a simulated scene.

    Attributes:
        scene: surfaces and their colours, which can be rendered from any position.
        planes: planes that a detector should find.
        labels: (n,) int16 index in `planes` of the plane of each point of the simulated cloud; -1
            if the point is on none of them.
        stations: (s, 3) float64 metres, positions of the scanner.
        lowest_elevation_deg: lowest elevation angle that the scanner measures, positive above the
            horizon.
        highest_elevation_deg: highest elevation angle that the scanner measures.
        n_spoilt: number of points that are gross outliers or mixed pixels.
        cameras: true orientations of the photos, or None if there are no photos.
        photos: geometry of the photos, in the order of `cameras`.
        surfaces: curved surfaces that a detector should find, or None if all are flat.
        details: parameters of the simulation as JSON (such as scan step, noise and relief),
            intended only for users.
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
    surfaces: Surfaces | None = None
    details: dict[str, JsonValue] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One numerical result of an inspection.

    Attributes:
        name: name of the metric; contains the unit, if there is one.
        value: the result, in `unit`.
        unit: `1` for shares and counts.
        wall: index of the wall in `Walls`; -1 if the result refers to all walls together.
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
        displacement_m: (n, 2) float64 metres along u and v, shown minus true position.
        kind: (n,) uint8 class of each point, an index in `kinds`.
        kinds: names of the classes.
        findings: numerical results.
        details: further results as JSON, intended only for users.
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
            raise ProductError(
                f"inspection.kind must be an index of one of {len(self.kinds)} kinds"
            )
