"""Developments of cylinders and cones: conversion between unrolled rasters and space.

Both surfaces consist of straight lines, their generatrices, and can be unrolled onto a plane
without stretching. Points are converted in the local axes of a raster: x and y along u and v at its
top-left corner, in metres, and z along the normal there. Positions on a raster are (x, y) in metres
to the right of this corner and below it. Depths are distances from the surface along its normal.
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
    """A cylinder or cone about its axis, and its position on the raster that unrolls it.

    A position on the surface is given by its distance along a generatrix from `start`, and by its
    angle about the axis. On a raster, distances along the generatrix of angle 0 are in the
    direction `along`. Unrolled, the other generatrices of a cylinder are parallel to it, and those
    of a cone meet it in the apex.

    Attributes:
        start: (3,) point of the axis: the apex of a cone, or the foot of the top-left corner.
        axes: (3, 3) unit vectors, as rows: from the axis towards angle 0, towards an angle of 90
            degrees, and along the axis in the direction of increasing distances.
        radius_m: radius of a cylinder, positive; 0 for a cone.
        half_angle_rad: angle between the axis and the generatrices; 0 for a cylinder.
        side: 1 if the surface is seen from outside, and -1 from inside.
        place_m: (2,) position on the raster of distance 0 and angle 0.
        along: (2,) unit vector on the raster.
        aside: (2,) unit vector on the raster, perpendicular to `along`: towards positive angles.
    """

    start: NDArray[np.float64]
    axes: NDArray[np.float64]
    radius_m: float
    half_angle_rad: float
    side: float
    place_m: NDArray[np.float64]
    along: NDArray[np.float64]
    aside: NDArray[np.float64]

    @cached_property
    def sine(self) -> float:
        """Change of the radius per metre of a generatrix."""
        return math.sin(self.half_angle_rad)

    @cached_property
    def cosine(self) -> float:
        """Cosine of the half angle."""
        return math.cos(self.half_angle_rad)

    @property
    def numbers(self) -> dict[str, float | list[float] | list[list[float]]]:
        """The surface for the scripts of pages."""
        vectors = ("start", "axes", "place_m", "along", "aside")
        return {
            **{name: getattr(self, name).tolist() for name in vectors},
            **{name: getattr(self, name) for name in ("radius_m", "sine", "cosine", "side")},
        }

    def polar(
        self, places_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return distances along generatrices and angles about the axis, (n,) each, of places."""
        relative = places_m - self.place_m
        along, aside = relative @ self.along, relative @ self.aside
        if self.sine == 0.0:
            return along, aside / self.radius_m
        return np.hypot(along, aside), np.arctan2(aside, along) / self.sine


@dataclass(frozen=True, kw_only=True)
class Bend(ABC):
    """Curvature of a raster that unrolls a part of a cylinder or cone."""

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
        radii = own.radius_m + own.sine * distances + own.cosine * outwards
        about_axis = np.column_stack(
            [
                radii * np.cos(angles),
                radii * np.sin(angles),
                own.cosine * distances - own.sine * outwards,
            ]
        )
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
        outwards = np.hypot(first, second) - own.radius_m
        depths = own.side * (own.cosine * outwards - own.sine * axial)
        distances = own.sine * outwards + own.cosine * axial
        if own.sine == 0.0:
            along, aside = distances, own.radius_m * angles
        else:
            distances = np.maximum(distances, 0.0)
            along = distances * np.cos(own.sine * angles)
            aside = distances * np.sin(own.sine * angles)
        on_raster = own.place_m + np.outer(along, own.along) + np.outer(aside, own.aside)
        return np.column_stack([on_raster, depths])

    def axes_at(self, places_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the local axes u, v and n, as rows (n, 3, 3), at places (n, 2)."""
        own = self.revolution
        _, angles = own.polar(places_m)
        first, second, axis = own.axes
        outwards = np.outer(np.cos(angles), first) + np.outer(np.sin(angles), second)
        around = np.outer(np.cos(angles), second) - np.outer(np.sin(angles), first)
        generatrix = own.sine * outwards + own.cosine * axis
        along, aside = self._directions(angles)
        axes = np.einsum("ni,nj->nij", along, generatrix) + np.einsum("ni,nj->nij", aside, around)
        normals = own.side * (own.cosine * outwards - own.sine * axis)
        return np.concatenate([axes, normals[:, None]], axis=1)

    def widths(
        self, places_m: NDArray[np.float64], depths_m: NDArray[np.float64] | float
    ) -> NDArray[np.float64]:
        """Return the lengths (n,) of arcs at depths (n,) relative to those on the surface."""
        own = self.revolution
        distances, _ = own.polar(places_m)
        radii = own.radius_m + own.sine * distances
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(1.0 + own.side * own.cosine * np.asarray(depths_m) / radii)

    def scales(
        self, places_m: NDArray[np.float64], depths_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return lengths (n, 2) along u and v at depths (n,) relative to those on the surface."""
        along, aside = self._directions(self.revolution.polar(places_m)[1])
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
        turns = own.sine * angles
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
        sine, cosine = math.sin(self.half_angle_rad), math.cos(self.half_angle_rad)
        side, apex = -1.0 if self.is_inside else 1.0, np.array(self.apex_m)
        # The generatrix through the corner, and the direction of the arc there.
        generatrix = np.append(-apex / np.linalg.norm(apex), 0.0)
        around, outwards = np.array([-generatrix[1], generatrix[0], 0.0]), np.array([0, 0, side])
        along = np.array([math.cos(self.toward_rad), math.sin(self.toward_rad)])
        aside = np.array([-along[1], along[0]])
        angle = math.atan2(generatrix[:2] @ aside, generatrix[:2] @ along) / sine
        radial = sine * generatrix + cosine * outwards
        return Revolution(
            start=np.append(apex, 0.0),
            axes=np.array(
                [
                    math.cos(angle) * radial - math.sin(angle) * around,
                    math.sin(angle) * radial + math.cos(angle) * around,
                    cosine * generatrix - sine * outwards,
                ]
            ),
            radius_m=0.0,
            half_angle_rad=self.half_angle_rad,
            side=side,
            place_m=apex,
            along=along,
            aside=aside,
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
        own, turns = self.revolution, self.half_sector_rad * np.linspace(-1.0, 1.0, count)
        directions = np.outer(np.cos(turns), own.along) + np.outer(np.sin(turns), own.aside)
        with np.errstate(divide="ignore", invalid="ignore"):
            ends_m = -own.place_m / directions, (size_m - own.place_m) / directions
        least_m = np.maximum(np.fmin(*ends_m).max(axis=1), self.slants_m[0])
        most_m = np.minimum(np.fmax(*ends_m).min(axis=1), self.slants_m[1])
        inside = least_m < most_m
        spans_m = np.column_stack([least_m, most_m])[inside, :, None]
        return np.asarray(own.place_m + spans_m * directions[inside, None])

    def turn_rad(self, size_m: NDArray[np.float64]) -> float:
        """See `Bend.turn_rad`; the angle of the whole sector."""
        del size_m
        return 2.0 * self.half_sector_rad / math.sin(self.half_angle_rad)
