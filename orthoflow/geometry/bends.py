"""Developments of cylinders, cones and spheres: conversion between rasters and space.

Cylinders and cones consist of straight lines, their generatrices, and can be unrolled onto a plane
without stretching. A sphere cannot. It is developed by the azimuthal equidistant projection: its
generatrices are the meridians about a pole, whose lengths are kept.

Points are converted in the local axes of a raster: x and y along u and v at its top-left corner, in
metres, and z along the normal there. Positions on a raster are (x, y) in metres to the right of
this corner and below it. Depths are distances from the surface along its normal.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError

# Near the axis, cells have no width. Points are not unrolled where cells have less than this share
# of their width on the surface.
NARROWEST: Final = 0.2
# The directions at the corner of a raster are undefined if the corner is nearer to the apex.
_APEX_M: Final = 1e-9


@dataclass(frozen=True, kw_only=True)
class Revolution:
    """A cylinder, cone or sphere about its axis, and its position on the raster that shows it.

    A position on the surface is given by its distance along a generatrix from `start`, and by its
    angle about the axis. On a raster, distances along the generatrix of angle 0 are in the
    direction `along`. Unrolled, the other generatrices of a cylinder are parallel to it, and those
    of a cone meet it in the apex. Those of a sphere are meridians, which meet it in the pole.

    Attributes:
        start: (3,) point of the axis: the apex of a cone, the centre of a sphere, or the foot of
            the top-left corner.
        axes: (3, 3) unit vectors, as rows: from the axis towards angle 0, towards an angle of 90
            degrees, and along the axis in the direction of increasing distances.
        radius_m: radius of a cylinder or sphere, positive; 0 for a cone.
        half_angle_rad: angle between the axis and the generatrices; 0 for a cylinder or sphere.
        side: 1 if the surface is seen from outside, and -1 from inside.
        place_m: (2,) position on the raster of distance 0 and angle 0.
        along: (2,) unit vector on the raster.
        aside: (2,) unit vector on the raster, perpendicular to `along`: towards positive angles.
        is_sphere: whether the generatrices are meridians, with the axis from the pole (distance 0)
            to the centre.
    """

    start: NDArray[np.float64]
    axes: NDArray[np.float64]
    radius_m: float
    half_angle_rad: float
    side: float
    place_m: NDArray[np.float64]
    along: NDArray[np.float64]
    aside: NDArray[np.float64]
    is_sphere: bool = False

    @cached_property
    def fan(self) -> float:
        """Angle between two generatrices on the raster, per angle about the axis."""
        return 1.0 if self.is_sphere else self.sine

    @cached_property
    def sine(self) -> float:
        """Change of the radius per metre of a generatrix."""
        return math.sin(self.half_angle_rad)

    @cached_property
    def cosine(self) -> float:
        """Cosine of the half angle."""
        return math.cos(self.half_angle_rad)

    @property
    def numbers(self) -> dict[str, bool | float | list[float] | list[list[float]]]:
        """The surface for the scripts of pages."""
        vectors = ("start", "axes", "place_m", "along", "aside")
        return {
            **{name: getattr(self, name).tolist() for name in vectors},
            **{name: getattr(self, name) for name in ("radius_m", "sine", "cosine", "side", "fan")},
            "is_sphere": self.is_sphere,
        }

    def polar(
        self, places_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return distances along generatrices and angles about the axis, (n,) each, of places."""
        relative = places_m - self.place_m
        along, aside = relative @ self.along, relative @ self.aside
        if self.fan == 0.0:
            return along, aside / self.radius_m
        return np.hypot(along, aside), np.arctan2(aside, along) / self.fan

    def profile(
        self, distances: NDArray[np.float64], outwards: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return radii and positions along the axis, (n,) each, outwards (n,) of the surface."""
        if self.is_sphere:
            turned, radii = distances / self.radius_m, self.radius_m + outwards
            return radii * np.sin(turned), -radii * np.cos(turned)
        return (
            self.radius_m + self.sine * distances + self.cosine * outwards,
            self.cosine * distances - self.sine * outwards,
        )

    def slopes(self, distances: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return sine and cosine (2, n) of the angles between the axis and the generatrices."""
        if self.is_sphere:
            return np.array([np.cos(distances / self.radius_m), np.sin(distances / self.radius_m)])
        return np.tile([[self.sine], [self.cosine]], len(distances))


@dataclass(frozen=True, kw_only=True)
class Bend(ABC):
    """Curvature of a raster that shows a part of a cylinder, cone or sphere."""

    @property
    @abstractmethod
    def revolution(self) -> Revolution:
        """The surface in the local axes of the raster."""

    @abstractmethod
    def moved(self, corner_m: NDArray[np.float64]) -> Bend:
        """Return the curvature for a raster with another top-left corner (2,)."""

    @abstractmethod
    def contains(self, places_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether places (n, 2) of the raster are on the unrolled surface."""

    @abstractmethod
    def middle_rad(self, size_m: NDArray[np.float64]) -> float:
        """Return the angle about the axis at the middle of a raster with a size (2,)."""

    @abstractmethod
    def ribs_m(self, size_m: NDArray[np.float64], count: int) -> NDArray[np.float64]:
        """Return the ends (k, 2, 2) of generatrices, at regular angles, on a raster of a size (2,).

        Generatrices outside the raster are left out, so k may be smaller than `count`.
        """

    @abstractmethod
    def turn_rad(self, size_m: NDArray[np.float64]) -> float:
        """Return the angle about the axis that a raster with a size (2,) covers."""

    @property
    @abstractmethod
    def deepest_m(self) -> float:
        """Largest distance of the surface from the axis along its normals."""

    @property
    def is_concave(self) -> bool:
        """Whether the surface is seen from inside."""
        return self.revolution.side < 0.0

    def points(
        self, places_m: NDArray[np.float64], depths_m: NDArray[np.float64] | float
    ) -> NDArray[np.float64]:
        """Return local points (n, 3) at places (n, 2) and depths (n,)."""
        own = self.revolution
        distances, angles = own.polar(places_m)
        outwards = own.side * np.asarray(depths_m)
        radii, axial = own.profile(distances, outwards)
        about_axis = np.column_stack([radii * np.cos(angles), radii * np.sin(angles), axial])
        return np.asarray(own.start + about_axis @ own.axes)

    def places(
        self, points: NDArray[np.float64], size_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return positions (n, 3) = (x, y, depth) of local points (n, 3).

        The surface is cut opposite the middle of a raster with a size (2,). Points beyond the apex
        of a cone are placed at the apex.
        """
        own = self.revolution
        first, second, axial = own.axes @ (points - own.start).T
        angles, middle = np.arctan2(second, first), self.middle_rad(size_m)
        angles = middle + np.mod(angles - middle + math.pi, math.tau) - math.pi
        across = np.hypot(first, second)
        if own.is_sphere:
            depths = own.side * (np.hypot(across, axial) - own.radius_m)
            distances = own.radius_m * np.arctan2(across, -axial)
        else:
            outwards = across - own.radius_m
            depths = own.side * (own.cosine * outwards - own.sine * axial)
            distances = own.sine * outwards + own.cosine * axial
        if own.fan == 0.0:
            along, aside = distances, own.radius_m * angles
        else:
            distances = np.maximum(distances, 0.0)
            along = distances * np.cos(own.fan * angles)
            aside = distances * np.sin(own.fan * angles)
        on_raster = own.place_m + np.outer(along, own.along) + np.outer(aside, own.aside)
        return np.column_stack([on_raster, depths])

    def axes_at(self, places_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the local axes u, v and n, as rows (n, 3, 3), at places (n, 2)."""
        own = self.revolution
        distances, angles = own.polar(places_m)
        sine, cosine = own.slopes(distances)[..., None]
        first, second, axis = own.axes
        outwards = np.outer(np.cos(angles), first) + np.outer(np.sin(angles), second)
        around = np.outer(np.cos(angles), second) - np.outer(np.sin(angles), first)
        generatrix = sine * outwards + cosine * axis
        along, aside = self._directions(angles)
        axes = np.einsum("ni,nj->nij", along, generatrix) + np.einsum("ni,nj->nij", aside, around)
        normals = own.side * (cosine * outwards - sine * axis)
        return np.concatenate([axes, normals[:, None]], axis=1)

    def widths(
        self, places_m: NDArray[np.float64], depths_m: NDArray[np.float64] | float
    ) -> NDArray[np.float64]:
        """Return the lengths (n,) of arcs at depths (n,) relative to those on the raster."""
        own = self.revolution
        distances, _ = own.polar(places_m)
        if own.is_sphere:
            narrowing = np.sinc(distances / (math.pi * own.radius_m))
            return np.asarray(narrowing * (1.0 + own.side * np.asarray(depths_m) / own.radius_m))
        radii = own.radius_m + own.sine * distances
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(1.0 + own.side * own.cosine * np.asarray(depths_m) / radii)

    def scales(
        self, places_m: NDArray[np.float64], depths_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return lengths (n, 2) along u and v at depths (n,) relative to those on the raster."""
        own = self.revolution
        along, aside = self._directions(own.polar(places_m)[1])
        if own.is_sphere:
            along = along * (1.0 + own.side * depths_m / own.radius_m)[:, None]
        return np.hypot(along, aside * self.widths(places_m, depths_m)[:, None])

    def met_lengths(
        self, start: NDArray[np.float64], rays: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return where rays (n, 3) from a local point meet the front, in units of their lengths.

        NaN or negative if a ray does not meet it.
        """
        own = self.revolution
        first, second, axial = own.axes @ (start - own.start)
        to_first, to_second, to_axial = own.axes @ rays.T
        narrow = own.sine * axial + own.cosine * own.radius_m
        to_narrow = own.sine * to_axial
        a = own.cosine**2 * (to_first**2 + to_second**2) - to_narrow**2
        b = own.cosine**2 * (first * to_first + second * to_second) - narrow * to_narrow
        c = own.cosine**2 * (first**2 + second**2) - narrow**2
        if own.is_sphere:
            a, b, c = a + to_axial**2, b + axial * to_axial, c + axial**2
        # A ray enters a surface seen from outside, and leaves one seen from inside. Of the two
        # roots, one is on the surface, and the other one may be on the mirror image of a cone.
        lengths = (-b - own.side * np.sqrt(b * b - a * c)) / a
        lengths[narrow + lengths * to_narrow <= 0.0] = np.nan
        return np.asarray(lengths)

    def highest_shares(
        self, points: NDArray[np.float64], rays: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the shares (n,) of rays at which their depths are largest.

        If the surface is seen from outside, depths have no maximum, and the result is infinite.

        Args:
            points: (n, 3) local starts of the rays.
            rays: (n, 3) directions; their lengths are the unit of shares.
        """
        own = self.revolution
        if not self.is_concave:
            return np.full(len(points), np.inf)
        if own.is_sphere:
            along = np.einsum("ij,ij->i", points - own.start, rays)
            return np.asarray(-along / np.maximum(np.einsum("ij,ij->i", rays, rays), 1e-12))
        first, second, _ = own.axes @ (points - own.start).T
        to_first, to_second, to_axial = own.axes @ rays.T
        a = np.maximum(to_first**2 + to_second**2, 1e-12)
        b = first * to_first + second * to_second
        # The depth is `slope` times the share, minus the distance from the axis.
        slope = to_axial * math.tan(own.half_angle_rad)
        passed = np.maximum(first**2 + second**2 - b * b / a, 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            beyond = slope * np.sqrt(passed / (a * (a - slope**2)))
        beyond = np.where(slope**2 < a, beyond, np.copysign(np.inf, slope))
        return np.asarray(beyond - b / a)

    def _directions(
        self, angles: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the directions on the raster, (n, 2) each, of generatrices and of arcs."""
        own = self.revolution
        turns = own.fan * angles
        cosines, sines = np.cos(turns)[:, None], np.sin(turns)[:, None]
        return cosines * own.along + sines * own.aside, cosines * own.aside - sines * own.along


@dataclass(frozen=True, kw_only=True)
class CylinderBend(Bend):
    """Curvature of a raster that unrolls a part of a cylinder: one axis is the length of the arc.

    Attributes:
        along: `u` if rows of the raster follow the arc and columns are parallel to the axis of the
            cylinder (towers, columns and apses); `v` if columns follow the arc (barrel vaults).
        radius_m: radius in metres; positive if the surface is seen from inside, so that the axis is
            on the viewer's side, and negative if it is seen from outside.
    """

    along: Literal["u", "v"]
    radius_m: float

    def __post_init__(self) -> None:
        if self.along not in ("u", "v") or not 0.0 < abs(self.radius_m) < math.inf:
            raise GeometryError(
                "a curved raster needs an arc along u or v and a finite radius "
                f"other than 0, got {self.along!r} and {self.radius_m} m"
            )

    @cached_property
    def revolution(self) -> Revolution:
        """See `Bend.revolution`; angle 0 is at the edge of the raster where the arc begins."""
        bent, straight = (0, 1) if self.along == "u" else (1, 0)
        side = -math.copysign(1.0, self.radius_m)
        local = np.eye(3)
        return Revolution(
            start=self.radius_m * local[2],
            axes=np.array([side * local[2], local[bent], local[straight]]),
            radius_m=abs(self.radius_m),
            half_angle_rad=0.0,
            side=side,
            place_m=np.zeros(2),
            along=local[straight, :2],
            aside=local[bent, :2],
        )

    @property
    def deepest_m(self) -> float:
        """See `Bend.deepest_m`."""
        return abs(self.radius_m)

    def moved(self, corner_m: NDArray[np.float64]) -> CylinderBend:
        """See `Bend.moved`; a cylinder is the same at every corner."""
        del corner_m
        return self

    def contains(self, places_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """See `Bend.contains`."""
        return np.ones(len(places_m), dtype=np.bool_)

    def middle_rad(self, size_m: NDArray[np.float64]) -> float:
        """See `Bend.middle_rad`."""
        return 0.5 * self.turn_rad(size_m)

    def ribs_m(self, size_m: NDArray[np.float64], count: int) -> NDArray[np.float64]:
        """See `Bend.ribs_m`."""
        own, turn = self.revolution, self.turn_rad(size_m)
        starts = np.outer(own.radius_m * np.linspace(0.0, turn, count), own.aside)
        return np.stack([starts, starts + own.along * size_m], axis=1)

    def turn_rad(self, size_m: NDArray[np.float64]) -> float:
        """See `Bend.turn_rad`."""
        return float(size_m[0 if self.along == "u" else 1]) / abs(self.radius_m)


@dataclass(frozen=True, kw_only=True)
class ConeBend(Bend):
    """Curvature of a raster that unrolls a part of a cone: a sector of an annulus around the apex.

    A distance from the apex on the raster is one along a generatrix, and an angle on the raster is
    one about the axis, times the sine of the half angle. Cells outside the sector are empty.

    Attributes:
        apex_m: position of the apex relative to the top-left corner of the raster, to the right and
            down; it may be outside the raster.
        toward_rad: direction on the raster from the apex along the middle generatrix: 0 to the
            right, a quarter turn down. Opposite this generatrix, the cone is cut.
        half_angle_rad: angle between the axis and the generatrices.
        is_inside: whether the cone is seen from inside.
        slants_m: smallest and largest distance from the apex.
        half_sector_rad: half of the angle of the sector on the raster.
    """

    apex_m: tuple[float, float]
    toward_rad: float
    half_angle_rad: float
    is_inside: bool
    slants_m: tuple[float, float]
    half_sector_rad: float

    def __post_init__(self) -> None:
        least_m, most_m = self.slants_m
        if not (
            0.0 < self.half_angle_rad < 0.5 * math.pi
            and 0.0 <= least_m < most_m < math.inf
            and 0.0 < self.half_sector_rad <= math.pi * math.sin(self.half_angle_rad) * (1 + 1e-9)
            and _APEX_M < math.hypot(*self.apex_m) < math.inf
            and math.isfinite(self.toward_rad)
        ):
            raise GeometryError(
                "a raster on a cone needs a half angle between 0 and 90 degrees, ascending "
                "distances from the apex, a sector of at most one turn and an apex that is not at "
                f"its corner, got {self}"
            )

    @cached_property
    def revolution(self) -> Revolution:
        """See `Bend.revolution`; angle 0 is at the middle generatrix."""
        side, apex = -1.0 if self.is_inside else 1.0, np.array(self.apex_m)
        along = np.array([math.cos(self.toward_rad), math.sin(self.toward_rad)])
        sine = math.sin(self.half_angle_rad)
        return Revolution(
            start=np.append(apex, 0.0),
            axes=_axes_of_fan(apex, along, self.half_angle_rad, side, sine),
            radius_m=0.0,
            half_angle_rad=self.half_angle_rad,
            side=side,
            place_m=apex,
            along=along,
            aside=np.array([-along[1], along[0]]),
        )

    @property
    def deepest_m(self) -> float:
        """See `Bend.deepest_m`."""
        return self.slants_m[1] * math.tan(self.half_angle_rad)

    def moved(self, corner_m: NDArray[np.float64]) -> ConeBend:
        """See `Bend.moved`."""
        right_m, down_m = (np.array(self.apex_m) - corner_m).tolist()
        return replace(self, apex_m=(right_m, down_m))

    def contains(self, places_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """See `Bend.contains`."""
        own = self.revolution
        distances, angles = own.polar(places_m)
        inside = (distances >= self.slants_m[0]) & (distances <= self.slants_m[1])
        return np.asarray(inside & (np.abs(angles) * own.sine <= self.half_sector_rad))

    def middle_rad(self, size_m: NDArray[np.float64]) -> float:
        """See `Bend.middle_rad`; parts of a raster are cut at the same generatrix."""
        del size_m
        return 0.0

    def ribs_m(self, size_m: NDArray[np.float64], count: int) -> NDArray[np.float64]:
        """See `Bend.ribs_m`."""
        turns = self.half_sector_rad * np.linspace(-1.0, 1.0, count)
        return _ribs_of_fan(self.revolution, turns, self.slants_m, size_m)

    def turn_rad(self, size_m: NDArray[np.float64]) -> float:
        """See `Bend.turn_rad`; the angle of the whole sector."""
        del size_m
        return 2.0 * self.half_sector_rad / math.sin(self.half_angle_rad)


@dataclass(frozen=True, kw_only=True)
class SphereBend(Bend):
    """Curvature of a raster that shows a part of a sphere around a pole (azimuthal equidistant).

    Distances from the pole and directions at the pole are those on the sphere. At an angle t from
    the pole, lengths across the meridians, and therefore areas, are t / sin(t) times those on the
    sphere. Cells farther from the pole than the development extends are empty.

    Attributes:
        pole_m: position of the pole relative to the top-left corner of the raster, to the right and
            down; it may be outside the raster.
        radius_m: radius of the sphere.
        is_inside: whether the sphere is seen from inside.
        most_m: largest distance from the pole, less than half the circumference.
    """

    pole_m: tuple[float, float]
    radius_m: float
    is_inside: bool
    most_m: float

    def __post_init__(self) -> None:
        if not (
            0.0 < self.radius_m < math.inf
            and 0.0 < self.most_m < math.pi * self.radius_m
            and math.hypot(*self.pole_m) < math.inf
        ):
            raise GeometryError(
                "a raster on a sphere needs a positive radius, a finite pole and a distance from "
                f"it of less than half the circumference, got {self}"
            )

    @cached_property
    def revolution(self) -> Revolution:
        """See `Bend.revolution`; angle 0 is to the right of the pole."""
        side, pole, along = -1.0 if self.is_inside else 1.0, np.array(self.pole_m), np.eye(2)[0]
        slope_rad = 0.5 * math.pi - math.hypot(*self.pole_m) / self.radius_m
        return Revolution(
            start=np.array([0.0, 0.0, -side * self.radius_m]),
            axes=_axes_of_fan(pole, along, slope_rad, side, 1.0),
            radius_m=self.radius_m,
            half_angle_rad=0.0,
            side=side,
            place_m=pole,
            along=along,
            aside=np.eye(2)[1],
            is_sphere=True,
        )

    @property
    def deepest_m(self) -> float:
        """See `Bend.deepest_m`."""
        return self.radius_m

    @property
    def largest_stretch(self) -> float:
        """Largest length across the meridians on the raster relative to that on the sphere."""
        return 1.0 / float(np.sinc(self.most_m / (math.pi * self.radius_m)))

    def moved(self, corner_m: NDArray[np.float64]) -> SphereBend:
        """See `Bend.moved`."""
        right_m, down_m = (np.array(self.pole_m) - corner_m).tolist()
        return replace(self, pole_m=(right_m, down_m))

    def contains(self, places_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """See `Bend.contains`."""
        return np.asarray(np.linalg.norm(places_m - self.pole_m, axis=1) <= self.most_m)

    def middle_rad(self, size_m: NDArray[np.float64]) -> float:
        """See `Bend.middle_rad`; a sphere is not cut."""
        del size_m
        return 0.0

    def ribs_m(self, size_m: NDArray[np.float64], count: int) -> NDArray[np.float64]:
        """See `Bend.ribs_m`; the generatrices are those of a whole turn."""
        turns = math.pi * np.linspace(-1.0, 1.0, count)
        return _ribs_of_fan(self.revolution, turns, (0.0, self.most_m), size_m)

    def turn_rad(self, size_m: NDArray[np.float64]) -> float:
        """See `Bend.turn_rad`."""
        del size_m
        return math.tau


def _axes_of_fan(
    middle: NDArray[np.float64],
    along: NDArray[np.float64],
    slope_rad: float,
    side: float,
    fan: float,
) -> NDArray[np.float64]:
    """Return `Revolution.axes` of a surface whose generatrices meet at a place of the raster.

    Args:
        middle: (2,) this place, relative to the top-left corner.
        along: (2,) unit vector on the raster along the generatrix of angle 0.
        slope_rad: angle between the axis and the generatrix at the corner.
        side: see `Revolution`.
        fan: see `Revolution`.
    """
    sine, cosine = math.sin(slope_rad), math.cos(slope_rad)
    # The generatrix through the corner, and the direction of the arc there.
    length_m = float(np.linalg.norm(middle))
    generatrix = np.append(-middle / length_m if length_m > 0.0 else along, 0.0)
    around, outwards = np.array([-generatrix[1], generatrix[0], 0.0]), np.array([0, 0, side])
    aside = np.array([-along[1], along[0]])
    angle = math.atan2(generatrix[:2] @ aside, generatrix[:2] @ along) / fan
    radial = sine * generatrix + cosine * outwards
    return np.array(
        [
            math.cos(angle) * radial - math.sin(angle) * around,
            math.sin(angle) * radial + math.cos(angle) * around,
            cosine * generatrix - sine * outwards,
        ]
    )


def _ribs_of_fan(
    own: Revolution,
    turns: NDArray[np.float64],
    limits_m: tuple[float, float],
    size_m: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the ends (k, 2, 2) of generatrices at angles (n,) on the raster, between distances."""
    directions = np.outer(np.cos(turns), own.along) + np.outer(np.sin(turns), own.aside)
    with np.errstate(divide="ignore", invalid="ignore"):
        ends_m = -own.place_m / directions, (size_m - own.place_m) / directions
    least_m = np.maximum(np.fmin(*ends_m).max(axis=1), limits_m[0])
    most_m = np.minimum(np.fmax(*ends_m).min(axis=1), limits_m[1])
    inside = least_m < most_m
    spans_m = np.column_stack([least_m, most_m])[inside, :, None]
    return np.asarray(own.place_m + spans_m * directions[inside, None])
