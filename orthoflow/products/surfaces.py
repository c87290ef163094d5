"""Surfaces found in a cloud, and the surface of each point."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import ProductError
from orthoflow.geometry.surfaces import Cone, CurvedShape, Cylinder, Sphere
from orthoflow.products.cloud import PointCloud
from orthoflow.products.planes import Planes
from orthoflow.products.product import JsonValue, Product, Tolerance

# Kind of a surface, which is the first part of its name.
SurfaceKind = Literal["vault", "apse", "tower", "column", "cylinder", "cone", "dome", "sphere"]

_VERTICAL_DEG: Final = 20.0
_COLUMN_MOST_M: Final = 0.75
_FULL_TURN: Final = 2.0 * math.pi


def surface_kind(
    shape: CurvedShape, up: NDArray[np.float64], zero_world: NDArray[np.float64]
) -> SurfaceKind:
    """Return the kind of a surface by the direction of its axis, its side and its radius.

    A sphere is a dome if its middle is in the direction of `up` (see `Surface.zero_world`).
    A concave cylinder is an apse if its axis is within 20 degrees of vertical, and a vault if its
    axis is within 20 degrees of horizontal. A convex cylinder with a vertical axis is a column if
    its radius is at most 0.75 m, and otherwise a tower.
    """
    if isinstance(shape, Cone):
        return "cone"
    if isinstance(shape, Sphere):
        return "dome" if float(zero_world @ up) > 1.0 - 1e-9 else "sphere"
    incline_deg = math.degrees(math.asin(min(1.0, abs(float(shape.axis_world @ up)))))
    if incline_deg >= 90.0 - _VERTICAL_DEG:
        if shape.is_concave:
            return "apse"
        return "column" if shape.radius_m <= _COLUMN_MOST_M else "tower"
    return "vault" if shape.is_concave and incline_deg <= _VERTICAL_DEG else "cylinder"


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A part of a cylinder, cone or sphere.

    Attributes:
        name: kind (`surface_kind`) and index of the surface, such as `vault 0` or `column 2`.
        shape: the whole cylinder, cone or sphere. The point on a cylinder's axis is at the middle
            of the surface's points. The axis of a cylinder points upwards if it is at most 45
            degrees from vertical, and otherwise towards e1 or e2 of `basis_from_up`, whichever is
            nearer.
        covariance: (7, 7) float64 covariance of (point, axis, radius) or (apex, axis, half angle),
            metres and radians; for a sphere, of (centre, 0, 0, 0, radius).
        n_points: number of points on the surface.
        rms_m: root mean square distance of these points.
        zero_world: (3,) unit vector perpendicular to the axis, in the direction of angle 0 (see
            `geometry.surfaces.zero_direction`). For a sphere, the direction from its centre to the
            middle of its points (see `geometry.surfaces.middle_direction`).
        along_m: smallest and largest coordinate of the points along the axis, relative to the point
            of the cylinder or the apex of the cone. On a sphere, arc lengths from the middle.
        arc_rad: smallest and largest angle of the points around the axis, counted from `zero_world`
            by the right-hand rule; the range begins between -pi and pi and is at most one turn. On
            a sphere, the arc across its middle.
    """

    name: str
    shape: CurvedShape
    covariance: NDArray[np.float64]
    n_points: int
    rms_m: float
    zero_world: NDArray[np.float64]
    along_m: tuple[float, float]
    arc_rad: tuple[float, float]

    @property
    def is_closed(self) -> bool:
        """Whether there are points all around the axis; otherwise, an arc is open or hidden."""
        return self.arc_rad[1] - self.arc_rad[0] >= _FULL_TURN - 1e-9

    @property
    def axis_world(self) -> NDArray[np.float64]:
        """Unit vector (3,) of the axis; on a sphere, from its centre to the middle."""
        return self.zero_world if isinstance(self.shape, Sphere) else self.shape.axis_world

    @property
    def middle_world(self) -> NDArray[np.float64]:
        """Point (3,) of the axis at the middle of the surface; the centre of a sphere."""
        shape = self.shape
        if isinstance(shape, Sphere):
            return shape.centre_world
        start = shape.point_world if isinstance(shape, Cylinder) else shape.apex_world
        return start + 0.5 * (self.along_m[0] + self.along_m[1]) * shape.axis_world

    @property
    def radius_m(self) -> float:
        """Radius of a cylinder or sphere; of a cone, at the middle of its points along the axis."""
        if not isinstance(self.shape, Cone):
            return self.shape.radius_m
        return 0.5 * (self.along_m[0] + self.along_m[1]) * math.tan(self.shape.half_angle_rad)

    @property
    def sigma_axis_deg(self) -> float:
        """Largest standard deviation of the axis direction; NaN for a sphere."""
        if isinstance(self.shape, Sphere):
            return math.nan
        largest = float(np.linalg.eigvalsh(self.covariance[3:6, 3:6])[-1])
        return math.degrees(math.sqrt(max(0.0, largest)))

    @property
    def sigma_radius_m(self) -> float:
        """Standard deviation of the radius; for a cone, of its radius halfway along the points."""
        sigma = math.sqrt(max(0.0, float(self.covariance[6, 6])))
        if not isinstance(self.shape, Cone):
            return sigma
        middle_m = 0.5 * (self.along_m[0] + self.along_m[1])
        return sigma * middle_m / math.cos(self.shape.half_angle_rad) ** 2


@dataclass(frozen=True, kw_only=True)
class Surfaces(Product):
    """Surfaces of a scene: planes, if included, and curved surfaces.

    The index of a curved surface is its place in `surfaces` plus the number of planes.

    Attributes:
        surfaces: the curved surfaces, those of the first detector first. Those of one detector are
            in descending order of their numbers of points.
        up: (3,) float64 unit vector of the cloud.
        planes: the planes, or None if they are not included.
        details: further results as JSON, intended only for users.
    """

    type_name: ClassVar[str] = "surfaces"
    tolerances: ClassVar[Mapping[str, Tolerance]] = {
        **Planes.tolerances,
        "point_world": Tolerance(limit=1e-4, unit="m"),
        "apex_world": Tolerance(limit=1e-3, unit="m"),
        "centre_world": Tolerance(limit=1e-4, unit="m"),
        "axis_world": Tolerance(limit=1e-6, unit="1"),
        "zero_world": Tolerance(limit=1e-6, unit="1"),
        "radius_m": Tolerance(limit=1e-5, unit="m"),
        "half_angle_rad": Tolerance(limit=1e-6, unit="1"),
        "along_m": Tolerance(limit=1e-3, unit="m"),
        "arc_rad": Tolerance(limit=1e-3, unit="1"),
    }

    surfaces: tuple[Surface, ...]
    up: NDArray[np.float64]
    planes: Planes | None = None
    details: dict[str, JsonValue] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.up.shape != (3,) or not np.isfinite(self.up).all():
            raise ProductError(f"surfaces.up must be finite and of shape (3,), got {self.up!r}")
        for index, surface in enumerate(self.surfaces):
            if not surface.name.endswith(f" {self.n_planes + index}"):
                raise ProductError(
                    f"surfaces[{index}].name must end in its index, got {surface.name!r}"
                )
            if surface.covariance.shape != (7, 7) or surface.zero_world.shape != (3,):
                raise ProductError(
                    f"surfaces[{index}] needs a covariance (7, 7) and zero_world (3,), got "
                    f"{surface.covariance.shape} and {surface.zero_world.shape}"
                )

    @property
    def n_planes(self) -> int:
        """Number of included planes."""
        return 0 if self.planes is None else len(self.planes)

    def __len__(self) -> int:
        return self.n_planes + len(self.surfaces)

    def check_against(self, others: Mapping[str, Product]) -> None:
        """See `Product.check_against`.

        Raises:
            ProductError: a covariance, direction, range, number of points or RMS distance is
                invalid.
        """
        if self.planes is not None:
            self.planes.check_against(others)
        n_all = [len(other) for other in others.values() if isinstance(other, PointCloud)]
        for index, surface in enumerate(self.surfaces):
            start, end = surface.arc_rad
            axis, zero = surface.axis_world, surface.zero_world
            is_sphere = isinstance(surface.shape, Sphere)
            is_perpendicular = is_sphere or abs(float(axis @ zero)) < 1e-9
            variances = np.diagonal(surface.covariance)
            rules = {
                "covariance must be finite, with variances of at least 0": bool(
                    np.isfinite(surface.covariance).all() and (variances >= 0.0).all()
                ),
                "zero_world must be a unit vector perpendicular to the axis": is_perpendicular
                and abs(float(np.linalg.norm(zero)) - 1.0) < 1e-9,
                "along_m must be an ascending range": surface.along_m[0] < surface.along_m[1],
                "along_m of a cone or sphere must not begin before its apex or middle": isinstance(
                    surface.shape, Cylinder
                )
                or surface.along_m[0] >= 0.0,
                "arc_rad must be a range of at most one turn that begins between -pi and pi": (
                    -math.pi - 1e-9 <= start <= math.pi and start < end <= start + _FULL_TURN + 1e-9
                ),
                "rms_m must be finite and at least 0": 0.0 <= surface.rms_m < math.inf,
                "n_points must be between 0 and the number of points": 0
                <= surface.n_points
                <= (n_all[0] if n_all else surface.n_points),
            }
            for rule, is_kept in rules.items():
                if not is_kept:
                    raise ProductError(f"surfaces[{index}].{rule}, got {surface!r}")


@dataclass(frozen=True, kw_only=True)
class PointLabels(Product):
    """The plane or curved surface of each point of a cloud.

    Attributes:
        plane_index: (n,) int16 index in the `Planes` or the `Surfaces` of the same step; -1 if the
            point is on none of them. In `Surfaces`, planes come first.
    """

    type_name: ClassVar[str] = "labels"
    mapped: ClassVar[bool] = True
    embedded: ClassVar[bool] = False

    plane_index: NDArray[np.int16]

    def __post_init__(self) -> None:
        if self.plane_index.ndim != 1 or self.plane_index.dtype != np.int16:
            raise ProductError(
                "labels.plane_index must be a one-dimensional int16 array, got "
                f"{self.plane_index.dtype} of shape {self.plane_index.shape}"
            )

    def check_against(self, others: Mapping[str, Product]) -> None:
        """See `Product.check_against`.

        Raises:
            ProductError: the labels do not match the points or the planes.
        """
        for product in others.values():
            if isinstance(product, PointCloud) and len(product) != len(self.plane_index):
                raise ProductError(
                    f"labels.plane_index must have one label for each of {len(product)} points, "
                    f"got {len(self.plane_index)}"
                )
            if isinstance(product, Planes | Surfaces) and self.plane_index.size:
                low, high = int(self.plane_index.min()), int(self.plane_index.max())
                if low < -1 or high >= len(product):
                    raise ProductError(
                        f"labels.plane_index must be -1 or the index of one of {len(product)} "
                        f"{product.type_name} (from 0), got {low if low < -1 else high}"
                    )
