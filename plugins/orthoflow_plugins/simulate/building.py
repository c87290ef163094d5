"""Construction of scenes from rectangles: walls with relief and recesses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane
from orthoflow.geometry.scenes import Scene, SurfaceRole, TextureKind

# a_min, a_max, b_min, b_max in rectangle or wall coordinates, metres.
Extent = tuple[float, float, float, float]


@dataclass(frozen=True)
class Paint:
    """Texture of a rectangle.

    Attributes:
        kind: kind of pattern.
        rgb: background colour, 0..255.
        reflectance: laser reflectance, 0..1.
        contrast: contrast of the pattern, 0..1.
        period_m: size of the motif in metres.
        seed: seed of the random details.
    """

    kind: TextureKind
    rgb: tuple[float, float, float]
    reflectance: float
    contrast: float = 0.35
    period_m: float = 0.3
    seed: int = 1

    @property
    def numbers(self) -> tuple[float, ...]:
        """Parameters in the order of `Scene.texture_params`."""
        return (*self.rgb, self.reflectance, self.contrast, self.period_m, self.seed)


class Surface(NamedTuple):
    """A rectangle of a scene under construction, flat or bent."""

    centre: NDArray[np.float64]
    axis_a: NDArray[np.float64]
    axis_b: NDArray[np.float64]
    extent: Extent
    paint: Paint
    role: SurfaceRole
    plane: int = -1
    holes: Sequence[Extent] = ()
    curvature_per_m: float = 0.0
    taper_per_m: float = 0.0


@dataclass(frozen=True, kw_only=True)
class TruePlane:
    """A plane that a detector should find.

    Attributes:
        name: label of the plane.
        plane: the plane, with the normal towards the room.
        outline: (4, 3) float64 metres, corners of a rectangle that contains the whole surface.
    """

    name: str
    plane: Plane
    outline: NDArray[np.float64]


@dataclass(kw_only=True)
class SceneDraft:
    """A scene under construction.

    Attributes:
        surfaces: the rectangles so far.
        planes: the true planes so far; `Surface.plane` is an index into them.
    """

    surfaces: list[Surface] = field(default_factory=list)
    planes: list[TruePlane] = field(default_factory=list)

    def finished(self, *, spectral_gap: float) -> Scene:
        """Return the scene, with its origin at (0, 0, 0).

        Args:
            spectral_gap: 0 if the laser measures the visible patterns, 1 if it measures different
                ones.
        """
        surfaces = self.surfaces
        bends = np.array([surface.curvature_per_m for surface in surfaces])
        tapers = np.array([surface.taper_per_m for surface in surfaces])
        holes = [(i, hole) for i, surface in enumerate(surfaces) for hole in surface.holes]
        return Scene(
            origin=np.zeros(3),
            centre=np.array([surface.centre for surface in surfaces]),
            axis_a=np.array([surface.axis_a for surface in surfaces]),
            axis_b=np.array([surface.axis_b for surface in surfaces]),
            extent=np.array([surface.extent for surface in surfaces], dtype=np.float64),
            plane_index=np.array([surface.plane for surface in surfaces], dtype=np.int16),
            role=np.array([surface.role for surface in surfaces], dtype=np.uint8),
            texture=np.array([surface.paint.kind for surface in surfaces], dtype=np.int32),
            texture_params=np.array(
                [(*surface.paint.numbers, spectral_gap) for surface in surfaces], dtype=np.float64
            ),
            hole_rectangle=np.array([index for index, _ in holes], dtype=np.int32),
            hole_extent=np.array([hole for _, hole in holes], dtype=np.float64).reshape(-1, 4),
            curvature_per_m=bends if bends.any() else None,
            taper_per_m=tapers if tapers.any() else None,
        )


@dataclass(frozen=True, kw_only=True)
class Side:
    """A wall, floor or ceiling under construction, with its own coordinates.

    Attributes:
        draft: the draft to which rectangles are added.
        foot: (3,) point of the wall nearest to the room's origin, in metres; the position of a = b
            = 0.
        axis_a: (3,) unit vector to the right for a viewer in the room.
        axis_b: (3,) unit vector upwards in the wall.
        normal: (3,) unit vector into the room.
    """

    draft: SceneDraft
    foot: NDArray[np.float64]
    axis_a: NDArray[np.float64]
    axis_b: NDArray[np.float64]
    normal: NDArray[np.float64]

    def place(
        self,
        extent: Extent,
        depth_m: float,
        paint: Paint,
        role: SurfaceRole,
        *,
        plane: int = -1,
        holes: Sequence[Extent] = (),
    ) -> None:
        """Add a rectangle parallel to the wall, `depth_m` in front of it."""
        centre = self.foot + depth_m * self.normal
        axes = (self.axis_a, self.axis_b)
        self.draft.surfaces.append(Surface(centre, *axes, extent, paint, role, plane, holes))

    def rims(
        self, extent: Extent, depths_m: tuple[float, float], paint: Paint, role: SurfaceRole
    ) -> None:
        """Add the four faces along the outline of an extent that connect two depths."""
        a0, a1, b0, b1 = extent
        low, high = min(depths_m), max(depths_m)
        for along, axis, places, ends in (
            (self.axis_a, self.axis_b, (a0, a1), (b0, b1)),
            (self.axis_b, self.axis_a, (b0, b1), (a0, a1)),
        ):
            self.draft.surfaces += [
                Surface(
                    self.foot + place * along, axis, self.normal, (*ends, low, high), paint, role
                )
                for place in places
            ]

    def box(self, extent: Extent, depth_m: float, paint: Paint, *, base_m: float = 0.0) -> None:
        """Add a box that projects by `depth_m` from the depth `base_m`, unless `depth_m` is 0."""
        if depth_m <= 0.0:
            return
        role = SurfaceRole.RELIEF if base_m >= 0.0 else SurfaceRole.RECESS
        self.place(extent, base_m + depth_m, paint, role)
        self.rims(extent, (base_m, base_m + depth_m), paint, role)

    def bars(
        self, extent: Extent, width_m: float, depth_m: float, paint: Paint, *, base_m: float = 0.0
    ) -> None:
        """Add a frame of four mouldings inside an extent."""
        a0, a1, b0, b1 = extent
        for bar in (
            (a0, a0 + width_m, b0, b1),
            (a1 - width_m, a1, b0, b1),
            (a0 + width_m, a1 - width_m, b0, b0 + width_m),
            (a0 + width_m, a1 - width_m, b1 - width_m, b1),
        ):
            self.box(bar, depth_m, paint, base_m=base_m)

    def recess(self, extent: Extent, depth_m: float, paint: Paint, *, plane: int = -1) -> Extent:
        """Add a recess of depth `depth_m`; return the hole that must be cut into the wall."""
        self.place(extent, -depth_m, paint, SurfaceRole.RECESS, plane=plane)
        self.rims(extent, (-depth_m, 0.0), paint, SurfaceRole.RECESS)
        return extent

    def true_plane(self, name: str, extent: Extent, depth_m: float = 0.0) -> int:
        """Register a plane parallel to the wall; return its index."""
        a0, a1, b0, b1 = extent
        foot = self.foot + depth_m * self.normal
        outline = np.array(
            [
                foot + a * self.axis_a + b * self.axis_b
                for a, b in ((a0, b1), (a0, b0), (a1, b0), (a1, b1))
            ]
        )
        plane = Plane(normal=self.normal, offset_m=float(self.normal @ foot))
        self.draft.planes.append(TruePlane(name=name, plane=plane, outline=outline))
        return len(self.draft.planes) - 1


def wall_side(draft: SceneDraft, *, omega_deg: float, phi_deg: float, distance_m: float) -> Side:
    """Return an empty wall.

    Args:
        draft: the draft to which rectangles are added.
        omega_deg: azimuth of the outward normal, as in markiewicz2015.
        phi_deg: elevation of the outward normal.
        distance_m: distance from the room's origin to the wall.
    """
    omega, phi = math.radians(omega_deg), math.radians(phi_deg)
    outward = np.array(
        [math.cos(phi) * math.cos(omega), math.cos(phi) * math.sin(omega), math.sin(phi)]
    )
    right = np.array([math.sin(omega), -math.cos(omega), 0.0])
    return Side(
        draft=draft,
        foot=distance_m * outward,
        axis_a=right,
        axis_b=np.cross(right, outward),
        normal=-outward,
    )


def flat_side(draft: SceneDraft, *, normal: tuple[float, float, float], height_m: float) -> Side:
    """Return an empty floor or ceiling at a given height above the room's origin."""
    n = np.array(normal) / np.linalg.norm(normal)
    right = np.array([1.0, 0.0, 0.0]) - n[0] * n
    right /= np.linalg.norm(right)
    return Side(
        draft=draft,
        foot=float(n[2]) * height_m * n,
        axis_a=right,
        axis_b=np.cross(n, right),
        normal=n,
    )


def add_block(
    draft: SceneDraft,
    *,
    base: NDArray[np.float64],
    yaw_deg: float,
    size_m: tuple[float, float, float],
    paint: Paint,
) -> None:
    """Add a free-standing box.

    Args:
        draft: the draft to which rectangles are added.
        base: (3,) centre of its bottom, metres.
        yaw_deg: rotation about the vertical; if 0, the length is along x.
        size_m: length, depth and height in metres.
        paint: texture of all faces.
    """
    yaw = math.radians(yaw_deg)
    along = np.array([math.cos(yaw), math.sin(yaw), 0.0])
    across = np.array([-math.sin(yaw), math.cos(yaw), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    length, depth, height = size_m
    a, b = length / 2, depth / 2
    faces = [
        *((base + at * along, across, up, (-b, b, 0.0, height)) for at in (-a, a)),
        *((base + at * across, along, up, (-a, a, 0.0, height)) for at in (-b, b)),
        (base + height * up, along, across, (-a, a, -b, b)),
    ]
    draft.surfaces += [Surface(*face, paint, SurfaceRole.OBJECT) for face in faces]
