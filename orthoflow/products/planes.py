"""Planes found in a cloud."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import ProductError
from orthoflow.geometry import Plane
from orthoflow.products.cloud import PointCloud
from orthoflow.products.product import JsonValue, Payload, Product, Tolerance

SideSource = Literal["stations", "photos", "guess", "given"]
# Kind of a plane, which is the first part of its name. Planes of the kinds `level` and `slope` are
# neither walls nor floors nor ceilings.
PlaneKind = Literal["wall", "floor", "ceiling", "level", "slope"]

_SIDE_SOURCES: Final[Mapping[str, SideSource]] = {
    "stations": "stations",
    "view_from": "given",
    "given": "given",
    "guess": "guess",
}
# The value used in markiewicz2015.
_USUAL_TOLERANCE_M: Final = 0.05


def plane_name(kind: PlaneKind, place: int) -> str:
    """Return the name of a plane and of its wall; the number is the plane's index in `planes.json`.

    For planes of all kinds, the names of the files begin with `wall_<number>_`.

    >>> plane_name("floor", 3)
    'floor 3'
    """
    return f"{kind} {place}"


@dataclass(frozen=True, kw_only=True)
class Spread:
    """Thickness of the cloud for one class of points.

    Attributes:
        low: lower limit of the class, in its unit.
        high: upper limit of the class.
        n_points: number of measured points.
        sigma_m: robust standard deviation of the distances, as in `Thickness`.
        name: name of the material; None if the class is not a material.
    """

    low: float
    high: float
    n_points: int
    sigma_m: float
    name: str | None = None


@dataclass(frozen=True, kw_only=True)
class Thickness:
    """Thickness of the cloud on one plane.

    Attributes:
        sigma_m: robust standard deviation of the distances from the plane. To exclude relief, the
            mean of a small tile of the plane is subtracted from each distance.
        width_95_m: width of the range that contains the middle 95 % of these distances.
        scan_step_m: median distance between neighbouring points on the plane.
        incidence_deg: classes by angle of incidence; empty if unknown.
        range_m: classes by distance from the scanner; empty if unknown.
        material: classes by material; empty if unknown.
    """

    sigma_m: float
    width_95_m: float
    scan_step_m: float
    incidence_deg: tuple[Spread, ...] = ()
    range_m: tuple[Spread, ...] = ()
    material: tuple[Spread, ...] = ()


@dataclass(frozen=True, kw_only=True)
class ScanRow:
    """Thickness of the cloud along one scan row on the first plane.

    Attributes:
        row: number of the row.
        scan: number of the scan.
        n_points: number of points of the row on the plane.
        sigma_m: robust standard deviation of their distances, as in `Thickness`; None if there are
            too few points.
        material: classes by material; empty if unknown.
    """

    row: int
    scan: int
    n_points: int
    sigma_m: float | None = None
    material: tuple[Spread, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Planes(Product):
    """Planes of a scene, in descending order of their numbers of points.

    Attributes:
        normal: (k, 3) float64 unit vectors towards the viewer, world axes.
        offset: (k,) float64 metres; points x on the plane satisfy `normal . x = offset`.
        corners: (k, 4, 3) float64 metres, corners of a rectangle on each plane: top-left first,
            counter-clockwise for the viewer.
        covariance: (k, 4, 4) float64 covariance of (normal, offset); zero for planes that were
            given.
        n_points: (k,) int64 number of points of each plane.
        rms_m: (k,) float64 root mean square distance of these points.
        up: (3,) float64 unit vector of the cloud.
        names: k names from `plane_name`, such as `wall 0` or `floor 3`.
        part_corners: (p, 4, 3) float64 rectangles of connected parts, or None.
        part_plane: (p,) int32 index of the plane of each part, or None.
        viewpoint: source of the visible side of planes: `stations`, `view_from`, `given` or
            `guess`.
        side_from: source of the visible side of each plane; empty if `viewpoint` applies to all.
        tolerance_m: maximum distance of points from their plane in the detection; the default is
            that of markiewicz2015.
        thickness: thickness of the cloud on each plane; None for planes with too few points; empty
            if not measured.
        scan_row: scan row with the most points on the first plane, if the cloud has rows.
        details: further results as JSON, intended only for users.
    """

    type_name: ClassVar[str] = "planes"
    tolerances: ClassVar[Mapping[str, Tolerance]] = {
        "normal": Tolerance(limit=1e-6, unit="1"),
        "offset": Tolerance(limit=1e-5, unit="m"),
        "corners": Tolerance(limit=1e-3, unit="m"),
        "part_corners": Tolerance(limit=1e-3, unit="m"),
        "covariance": Tolerance(limit=1e-6, unit="1"),
        "n_points": Tolerance(limit=10, unit="1"),
        "rms_m": Tolerance(limit=1e-5, unit="m"),
    }

    normal: NDArray[np.float64]
    offset: NDArray[np.float64]
    corners: NDArray[np.float64]
    covariance: NDArray[np.float64]
    n_points: NDArray[np.int64]
    rms_m: NDArray[np.float64]
    up: NDArray[np.float64]
    names: tuple[str, ...]
    part_corners: NDArray[np.float64] | None = None
    part_plane: NDArray[np.int32] | None = None
    viewpoint: str = "guess"
    side_from: tuple[SideSource, ...] = ()
    tolerance_m: float = _USUAL_TOLERANCE_M
    thickness: tuple[Thickness | None, ...] = ()
    scan_row: ScanRow | None = None
    details: dict[str, JsonValue] = field(default_factory=dict)

    def __post_init__(self) -> None:
        count = len(self.offset)
        shapes = {
            "normal": (self.normal.shape, (count, 3)),
            "corners": (self.corners.shape, (count, 4, 3)),
            "covariance": (self.covariance.shape, (count, 4, 4)),
            "n_points": (self.n_points.shape, (count,)),
            "rms_m": (self.rms_m.shape, (count,)),
            "names": ((len(self.names),), (count,)),
        }
        for name, (shape, expected) in shapes.items():
            if shape != expected:
                raise ProductError(f"planes.{name} must have shape {expected}, got {shape}")
        for name in ("offset", "corners", "up"):
            if not np.isfinite(getattr(self, name)).all():
                raise ProductError(f"planes.{name} must be finite")
        if self.up.shape != (3,):
            raise ProductError(f"planes.up must have shape (3,), got {self.up.shape}")
        lengths = np.linalg.norm(self.normal, axis=1)
        if not np.allclose(lengths, 1.0, atol=1e-9):
            raise ProductError(f"planes.normal must be unit vectors, got lengths {lengths}")
        if not self.tolerance_m > 0.0:
            raise ProductError(f"planes.tolerance_m must be positive, got {self.tolerance_m}")
        if self.side_from and len(self.side_from) != count:
            raise ProductError(
                "planes.side_from must be empty or have one value per plane, got "
                f"{len(self.side_from)} for {count}"
            )
        if self.thickness and len(self.thickness) != count:
            raise ProductError(
                "planes.thickness must be empty or have one value per plane, got "
                f"{len(self.thickness)} for {count}"
            )

    def to_payload(self) -> Payload:
        """Return the planes as arrays and JSON; a value common to all planes is stored once."""
        payload = super().to_payload()
        if self.side_from:
            return payload
        metadata = {name: value for name, value in payload.metadata.items() if name != "side_from"}
        return replace(payload, metadata=metadata)

    def __len__(self) -> int:
        return len(self.offset)

    def side_source(self, index: int) -> SideSource:
        """Return the source of the visible side of a plane."""
        return (
            self.side_from[index] if self.side_from else _SIDE_SOURCES.get(self.viewpoint, "guess")
        )

    def turned(self, index: int) -> Planes:
        """Return the planes, with the plane of this index viewed from the opposite side."""
        corners, parts = self.corners.copy(), self.part_corners
        # The top-left corner seen from one side is the top-right corner seen from the other.
        corners[index] = corners[index, ::-1]
        if parts is not None and self.part_plane is not None:
            parts = parts.copy()
            own = self.part_plane == index
            parts[own] = parts[own, ::-1]
        sign = np.ones(len(self))
        sign[index] = -1.0
        return replace(
            self,
            normal=self.normal * sign[:, None],
            offset=self.offset * sign,
            corners=corners,
            part_corners=parts,
        )

    def plane(self, index: int) -> Plane:
        """Return the plane with this index."""
        return Plane(normal=self.normal[index].copy(), offset_m=float(self.offset[index]))

    def sigma_angle_deg(self, index: int) -> float:
        """Return the largest standard deviation of a plane's normal in any direction, degrees."""
        largest = float(np.linalg.eigvalsh(self.covariance[index, :3, :3])[-1])
        return math.degrees(math.sqrt(max(0.0, largest)))

    def check_against(self, others: Mapping[str, Product]) -> None:
        """See `Product.check_against`.

        Raises:
            ProductError: a covariance, a number of points or an RMS distance is invalid.
        """
        variances = np.diagonal(self.covariance, axis1=1, axis2=2)
        if not np.isfinite(self.covariance).all() or (variances < 0.0).any():
            raise ProductError("planes.covariance must be finite, with variances of at least 0")
        if not (np.isfinite(self.rms_m) & (self.rms_m >= 0.0)).all():
            raise ProductError("planes.rms_m must be finite and at least 0")
        n_all = [len(other) for other in others.values() if isinstance(other, PointCloud)]
        if (self.n_points < 0).any() or (n_all and (self.n_points > n_all[0]).any()):
            raise ProductError(
                f"planes.n_points must be between 0 and the number of points"
                f"{f', {n_all[0]}' if n_all else ''}, got {self.n_points.tolist()}"
            )

    def sigma_offset_m(self, index: int) -> float:
        """Return the standard deviation of the position of a plane at the centre of its rectangle.

        The standard deviation of the offset refers to the origin, which may be far away.
        """
        at_middle = np.append(self.corners[index].mean(axis=0), -1.0)
        return math.sqrt(max(0.0, float(at_middle @ self.covariance[index] @ at_middle)))
