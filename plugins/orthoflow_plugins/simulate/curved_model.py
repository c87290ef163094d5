"""Simulated buildings with curved walls: vaults, apse, tower, column, spire, dome, baptistery.

All dimensions are random. Coordinates in the frame of a building are in metres, with z upwards and
the origin at eye level.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Cone, CurvedShape, Cylinder, Sphere
from orthoflow.geometry.frames import rotation_from_vector
from orthoflow.geometry.scenes import Scene, SurfaceRole, TextureKind
from orthoflow.geometry.surfaces import transformed, zero_direction
from orthoflow_plugins.simulate.building import (
    Extent,
    Paint,
    SceneDraft,
    Side,
    Surface,
    TruePlane,
    add_block,
    flat_side,
    wall_side,
)

Subject = Literal[
    "barrel-vault", "cross-vault", "apse", "tower", "column", "spire", "dome", "baptistery"
]

FLOOR_M: Final = -1.6
_UP: Final = np.array([0.0, 0.0, 1.0])
_STUCCO: Final = Paint(TextureKind.PLAIN, (214, 206, 190), 0.7, 0.18, seed=21)
_OAK: Final = Paint(TextureKind.WOOD, (132, 92, 58), 0.35, 0.4, 0.12, 23)
_STONE: Final = Paint(TextureKind.TILES, (176, 160, 132), 0.5, 0.3, 0.4, 24)
_FRESCO: Final = Paint(TextureKind.FRESCO, (196, 176, 148), 0.5, period_m=0.36, seed=25)
_FLOOR: Final = Paint(TextureKind.TILES, (150, 138, 122), 0.35, period_m=0.35, seed=26)
# Maximum tilt of a building.
_TILT_DEG: Final = 1.0
# The sides of mouldings that follow the arc consist of flat pieces, each of which covers at most
# this angle.
_PIECE_RAD: Final = math.radians(3.0)
# Width of the strips between the groins of a cross vault.
_STRIP_M: Final = 0.03


@dataclass(frozen=True, kw_only=True)
class TrueSurface:
    """A cylinder, cone or sphere that a detector should find.

    Attributes:
        shape: the surface; the point of a cylinder is at the middle of the surface's length.
        zero: (3,) unit vector perpendicular to the axis, the direction of angle 0; on a sphere,
            that of its pole.
        arc_rad: smallest and largest angle.
        along_m: smallest and largest position along the axis; on a sphere, distance from its pole.
    """

    shape: CurvedShape
    zero: NDArray[np.float64]
    arc_rad: tuple[float, float]
    along_m: tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Building:
    """A finished building.

    Attributes:
        scene: the surfaces of the building.
        planes: its large planes; `scene.plane_index` is an index into them.
        surfaces: its curved surfaces.
        on_surface: (r,) index of the curved surface that contains each rectangle of the scene; -1
            for none.
        stations: (s, 3) positions from which it is scanned.
        photographed: for each photo, the point at which it is aimed, the normal at this point, and
            the distance of the camera.
    """

    scene: Scene
    planes: tuple[TruePlane, ...]
    surfaces: tuple[TrueSurface, ...]
    on_surface: NDArray[np.int16]
    stations: NDArray[np.float64]
    photographed: tuple[tuple[NDArray[np.float64], NDArray[np.float64], float], ...]


@dataclass(kw_only=True)
class _Bend:
    """A wall on a cylinder or cone under construction.

    Positions on the wall are (a, b): arc length from angle 0 at b = 0, and distance along a
    generatrix, away from the apex of a cone. Depths are positive towards the viewer.

    Attributes:
        draft: the draft to which rectangles are added.
        shape: the cylinder or cone; a sphere is a `_Dome`.
        zero: see `TrueSurface`.
        slant_m: distance from the apex of a cone at b = 0; infinite for a cylinder.
        extents: extents of all parts of the wall, without mouldings and recesses.
        rows: indices of these parts in the draft.
    """

    draft: SceneDraft
    shape: CurvedShape
    zero: NDArray[np.float64]
    slant_m: float = math.inf
    extents: list[Extent] = field(default_factory=list)
    rows: list[int] = field(default_factory=list)

    @property
    def half_angle_rad(self) -> float:
        """Angle between axis and generatrices."""
        return self.shape.half_angle_rad if isinstance(self.shape, Cone) else 0.0

    @property
    def radius_m(self) -> float:
        """Radius at b = 0."""
        if not isinstance(self.shape, Cone):
            return self.shape.radius_m
        return self.slant_m * math.sin(self.half_angle_rad)

    @property
    def axis(self) -> NDArray[np.float64]:
        """Unit vector (3,) of the axis; from the centre of a sphere to its pole."""
        return self.zero if isinstance(self.shape, Sphere) else self.shape.axis_world

    @property
    def middle(self) -> NDArray[np.float64]:
        """Point (3,) of the axis at the height of b = 0; the centre of a sphere."""
        if isinstance(self.shape, Cylinder):
            return self.shape.point_world
        if isinstance(self.shape, Sphere):
            return self.shape.centre_world
        along_m = self.slant_m * math.cos(self.half_angle_rad)
        return self.shape.apex_world + along_m * self.shape.axis_world

    def place(
        self,
        extent: Extent,
        depth_m: float,
        paint: Paint,
        role: SurfaceRole,
        holes: Sequence[Extent] = (),
    ) -> None:
        """Add a bent rectangle; its extent is given at depth 0."""
        sign = -1.0 if self.shape.is_concave else 1.0
        centre, _, _, generatrix = self.at(0.0, 0.0, depth_m)
        # Distances from the axis along the normal, at the depth and on the wall.
        to_axis_m = self.radius_m / math.cos(self.half_angle_rad)
        scale = (to_axis_m + sign * depth_m) / to_axis_m
        self._add(
            extent,
            Surface(
                centre,
                sign * np.cross(self.axis, self.zero),
                generatrix,
                _scaled(extent, sign * scale),
                paint,
                role,
                holes=[_scaled(hole, sign * scale) for hole in holes],
                curvature_per_m=-sign / (to_axis_m + sign * depth_m),
                taper_per_m=1.0 / (scale * self.slant_m),
            ),
        )

    def _add(self, extent: Extent, surface: Surface) -> None:
        """Add a surface, and note its extent if it is a part of the wall itself."""
        self.draft.surfaces.append(surface)
        if surface.role == SurfaceRole.WALL:
            self.extents.append(extent)
            self.rows.append(len(self.draft.surfaces) - 1)

    def box(self, extent: Extent, depths_m: tuple[float, float], paint: Paint) -> None:
        """Add a moulding or a recess, given the depths of its base and its face."""
        role = SurfaceRole.RELIEF if depths_m[1] > 0.0 else SurfaceRole.RECESS
        self.place(extent, depths_m[1], paint, role)
        a0, a1, b0, b1 = extent
        for a in (a0, a1):
            foot, _, normal, generatrix = self.at(a, 0.0)
            span = (b0, b1, min(depths_m), max(depths_m))
            self.draft.surfaces.append(Surface(foot, generatrix, normal, span, paint, role))
        n_pieces = math.ceil(abs(a1 - a0) / (_PIECE_RAD * self.radius_m))
        half_m = 0.5 * (a1 - a0) / n_pieces
        for b in (b0, b1):
            reach_m = half_m * (1.0 + b / self.slant_m)
            for a in a0 + half_m * (2.0 * np.arange(n_pieces) + 1.0):
                foot, along, normal, _ = self.at(float(a), b)
                span = (-reach_m, reach_m, min(depths_m), max(depths_m))
                self.draft.surfaces.append(Surface(foot, along, normal, span, paint, role))

    def at(self, a: float, b: float, depth_m: float = 0.0) -> tuple[NDArray[np.float64], ...]:
        """Return the point at (a, b), the direction of increasing a, the normal, and that of b."""
        axis, angle = self.axis, a / self.radius_m
        depth_m = -depth_m if self.shape.is_concave else depth_m
        sine, cosine = math.sin(self.half_angle_rad), math.cos(self.half_angle_rad)
        aside = np.cross(axis, self.zero)
        outwards = math.cos(angle) * self.zero + math.sin(angle) * aside
        along = math.cos(angle) * aside - math.sin(angle) * self.zero
        generatrix = sine * outwards + cosine * axis
        middle = self.middle
        point = middle + (self.radius_m + cosine * depth_m) * outwards + b * generatrix
        point -= sine * depth_m * axis
        normal = cosine * outwards - sine * axis
        return point, along, -normal if self.shape.is_concave else normal, generatrix

    def targets(self) -> Iterator[tuple[float, float]]:
        """Yield positions of photos: at least three along the arc and two along the axis."""
        a0, a1, b0, b1 = np.array(self.extents).T
        n_along = max(2, math.ceil(float(b1.max() - b0.min()) / 1.5))
        n_around = max(3, math.ceil(float(a1.max() - a0.min()) / 1.8))
        for b in np.linspace(b0.min(), b1.max(), 2 * n_along + 1)[1::2]:
            for angle in np.linspace(*self.true_surface().arc_rad, 2 * n_around + 1)[1::2]:
                yield float(angle * self.radius_m), float(b)

    def true_surface(self) -> TrueSurface:
        """Return the surface with the extent of the wall itself."""
        a0, a1, b0, b1 = np.array(self.extents).T
        arc = np.array([a0.min(), a1.max()]) / self.radius_m
        along = np.array([b0.min(), b1.max()])
        if isinstance(self.shape, Cone):
            along = (self.slant_m + along) * math.cos(self.half_angle_rad)
        return TrueSurface(
            shape=self.shape,
            zero=self.zero,
            arc_rad=(float(arc[0]), float(arc[1])),
            along_m=(float(along[0]), float(along[1])),
        )


@dataclass(kw_only=True)
class _Dome(_Bend):
    """A wall on a sphere under construction.

    Positions are (a, b): the angle about the axis times the radius, and the distance from the pole
    along a meridian.
    """

    def place(
        self,
        extent: Extent,
        depth_m: float,
        paint: Paint,
        role: SurfaceRole,
        holes: Sequence[Extent] = (),
    ) -> None:
        """See `_Bend.place`."""
        pole, _, normal, meridian = self.at(0.0, 0.0, depth_m)
        sign = -1.0 if self.shape.is_concave else 1.0
        scale = 1.0 + sign * depth_m / self.radius_m
        a0, a1, b0, b1 = extent
        self._add(
            extent,
            Surface(
                pole,
                meridian,
                np.cross(normal, meridian),
                (*_scaled((a0, a1, 0.0, 0.0), sign * scale)[:2], scale * b0, scale * b1),
                paint,
                role,
                holes=holes,
                curvature_per_m=-sign / (scale * self.radius_m),
                taper_per_m=math.inf,
            ),
        )

    def box(self, extent: Extent, depths_m: tuple[float, float], paint: Paint) -> None:
        """See `_Bend.box`."""
        role = SurfaceRole.RELIEF if depths_m[1] > 0.0 else SurfaceRole.RECESS
        self.place(extent, depths_m[1], paint, role)
        a0, a1, b0, b1 = extent
        depths = min(depths_m), max(depths_m)
        piece_m = _PIECE_RAD * self.radius_m
        n_around, n_down = (
            math.ceil((end - start) / piece_m) for start, end in ((a0, a1), (b0, b1))
        )
        half_a, half_b = 0.5 * (a1 - a0) / n_around, 0.5 * (b1 - b0) / n_down
        for b in (b0, b1):
            reach_m = half_a * math.sin(b / self.radius_m)
            for a in a0 + half_a * (2.0 * np.arange(n_around) + 1.0):
                foot, along, normal, _ = self.at(float(a), b)
                span = (-reach_m, reach_m, *depths)
                self.draft.surfaces.append(Surface(foot, along, normal, span, paint, role))
        for a in (a0, a1):
            for b in b0 + half_b * (2.0 * np.arange(n_down) + 1.0):
                foot, _, normal, meridian = self.at(a, float(b))
                span = (-half_b, half_b, *depths)
                self.draft.surfaces.append(Surface(foot, meridian, normal, span, paint, role))

    def at(self, a: float, b: float, depth_m: float = 0.0) -> tuple[NDArray[np.float64], ...]:
        """See `_Bend.at`."""
        angle, down = a / self.radius_m, b / self.radius_m
        start = zero_direction(self.zero, _UP)
        aside = np.cross(self.zero, start)
        radial = math.cos(angle) * start + math.sin(angle) * aside
        along = math.cos(angle) * aside - math.sin(angle) * start
        outwards = math.cos(down) * self.zero + math.sin(down) * radial
        meridian = math.cos(down) * radial - math.sin(down) * self.zero
        sign = -1.0 if self.shape.is_concave else 1.0
        point = self.middle + (self.radius_m + sign * depth_m) * outwards
        return point, along, sign * outwards, meridian

    def targets(self) -> Iterator[tuple[float, float]]:
        """See `_Bend.targets`; the photos are taken around rings."""
        most_m = self.true_surface().along_m[1]
        n_rings = math.ceil(most_m / 1.2)
        for b in (np.arange(n_rings) + 0.5) * most_m / n_rings:
            turn_m = math.tau * self.radius_m
            n_around = max(3, math.ceil(turn_m * math.sin(b / self.radius_m) / 1.8))
            for k in range(n_around):
                yield turn_m * k / n_around, float(b)

    def true_surface(self) -> TrueSurface:
        """See `_Bend.true_surface`."""
        most_m = max(b1 for _, _, _, b1 in self.extents)
        most = most_m / self.radius_m
        return TrueSurface(
            shape=self.shape, zero=self.zero, arc_rad=(-most, most), along_m=(0.0, most_m)
        )


def _scaled(extent: Extent, scale: float) -> Extent:
    """Multiply a_min and a_max of an extent by a scale, which may be negative."""
    a0, a1, b0, b1 = extent
    return min(scale * a0, scale * a1), max(scale * a0, scale * a1), b0, b1


def build(subject: Subject, rng: np.random.Generator, *, relief: float, gap: float) -> Building:
    """Build a building with random dimensions.

    Args:
        subject: kind of building.
        rng: random generator for all dimensions.
        relief: scale of all mouldings.
        gap: spectral gap of the textures (see `TextureKind`).
    """
    draft = SceneDraft()
    bends, stations = _BUILDERS[subject](draft, rng, relief)
    on_surface = np.full(len(draft.surfaces), -1, dtype=np.int16)
    for index, bend in enumerate(bends):
        for row in bend.rows:
            on_surface[row] = index
    tilt = np.append(rng.uniform(-1.0, 1.0, 2) * math.radians(_TILT_DEG), 0.0)
    turn = rotation_from_vector(tilt) @ rotation_from_vector(
        np.array([0.0, 0.0, rng.uniform(0.0, 2.0 * math.pi)])
    )
    scene = draft.finished(spectral_gap=gap)
    photographed = [target for bend in bends for target in _targets(bend)]
    return Building(
        scene=scene.turned(turn),
        planes=tuple(
            TruePlane(
                name=item.name,
                plane=replace(item.plane, normal=turn @ item.plane.normal),
                outline=item.outline @ turn.T,
            )
            for item in draft.planes
        ),
        surfaces=tuple(_turned(bend.true_surface(), turn) for bend in bends),
        on_surface=on_surface,
        stations=stations @ turn.T,
        photographed=tuple((turn @ point, turn @ normal, d) for point, normal, d in photographed),
    )


def _turned(true: TrueSurface, turn: NDArray[np.float64]) -> TrueSurface:
    shape = transformed(true.shape, turn, np.zeros(3))
    return replace(true, shape=shape, zero=turn @ true.zero)


def _targets(bend: _Bend) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64], float]]:
    """Yield the photos' targets on a wall (see `Building.photographed`)."""
    distance_m = min(0.9 * bend.radius_m, 3.0) if bend.shape.is_concave else 3.0
    for a, b in bend.targets():
        point, _, normal, _ = bend.at(a, b)
        yield point, normal, distance_m


def _wall(
    draft: SceneDraft,
    name: str,
    omega_deg: float,
    distance_m: float,
    extent: Extent,
    paint: Paint,
    holes: Sequence[Extent] = (),
) -> Side:
    """Add a vertical wall, given the azimuth of its outward normal."""
    # With the same texture, walls of the same size could not be distinguished.
    paint = replace(paint, seed=paint.seed + 100 + round(omega_deg))
    wall = wall_side(draft, omega_deg=omega_deg, phi_deg=0.0, distance_m=distance_m)
    plane = wall.true_plane(name, extent)
    wall.place(extent, 0.0, paint, SurfaceRole.WALL, plane=plane, holes=holes)
    return wall


def _level(draft: SceneDraft, name: str, height_m: float, reach: tuple[float, float]) -> None:
    """Add a floor, or a ceiling if the height is positive."""
    sign = 1.0 if height_m < 0.0 else -1.0
    level = flat_side(draft, normal=(0.0, 0.0, sign), height_m=height_m)
    extent = (-reach[0], reach[0], -reach[1], reach[1])
    plane = level.true_plane(name, extent)
    level.place(extent, 0.0, _FLOOR, SurfaceRole.WALL, plane=plane)


def _furniture(draft: SceneDraft, rng: np.random.Generator, places: Sequence[float]) -> None:
    for x, y in np.reshape(places, (-1, 2)):
        size_m = tuple(rng.uniform((0.5, 0.4, 0.6), (1.2, 0.8, 1.2)).tolist())
        yaw_deg = float(rng.uniform(0.0, 90.0))
        base = np.array([x, y, FLOOR_M])
        add_block(draft, base=base, yaw_deg=yaw_deg, size_m=size_m, paint=_OAK)


def _vaulted_hall(
    draft: SceneDraft,
    rng: np.random.Generator,
    half_wide_m: float,
    half_long_m: float,
    top_m: float,
) -> None:
    """Add a floor, furniture and four walls; the walls at the ends extend up to `top_m`."""
    spring_m = 1.0
    door: Extent = (-0.5, 0.6, FLOOR_M - 0.1, 0.6)
    for name, omega_deg in (("right wall", 0.0), ("left wall", 180.0)):
        extent = (-half_long_m, half_long_m, FLOOR_M, spring_m)
        wall = _wall(draft, name, omega_deg, half_wide_m, extent, _STUCCO, [door])
        wall.recess(door, 0.2, _OAK)
    for name, omega_deg in (("end wall", 90.0), ("entrance wall", 270.0)):
        extent = (-half_wide_m, half_wide_m, FLOOR_M, top_m)
        _wall(draft, name, omega_deg, half_long_m, extent, _FRESCO)
    _level(draft, "floor", FLOOR_M, (half_wide_m, half_long_m))
    aside, along = half_wide_m - 0.9, half_long_m - 1.0
    _furniture(draft, rng, (aside, along, -aside, 0.3 * along, 0.5 * aside, -along))


def _barrel_vault(
    draft: SceneDraft, rng: np.random.Generator, relief: float
) -> tuple[list[_Bend], NDArray[np.float64]]:
    radius_m, half_long_m = rng.uniform(2.7, 3.3), rng.uniform(2.5, 4.0)
    half_rad = math.radians(rng.uniform(72.0, 78.0))
    half_wide_m = radius_m * math.sin(half_rad)
    axis_m = 1.0 - radius_m * math.cos(half_rad)
    shape = Cylinder(
        point_world=np.array([0.0, 0.0, axis_m]),
        axis_world=np.array([0.0, 1.0, 0.0]),
        radius_m=radius_m,
        is_concave=True,
    )
    vault, reach_m = _Bend(draft=draft, shape=shape, zero=_UP), half_rad * radius_m
    vault.place((-reach_m, reach_m, -half_long_m, half_long_m), 0.0, _FRESCO, SurfaceRole.WALL)
    if relief > 0.0:
        for b in rng.uniform(-0.5, 0.5, 2) + np.array([-0.5, 0.5]) * half_long_m:
            rib = (-reach_m, reach_m, b - 0.15, b + 0.15)
            vault.box(rib, (0.0, 0.06 * relief), _STUCCO)
        for a in rng.uniform(-0.6, 0.6, 4) * reach_m:
            b = rng.uniform(-0.8, 0.8) * half_long_m
            vault.box((a - 0.2, a + 0.2, b - 0.2, b + 0.2), (0.0, 0.03 * relief), _STUCCO)
    _vaulted_hall(draft, rng, half_wide_m, half_long_m, axis_m + radius_m)
    stations = rng.uniform(-0.4, 0.4, (2, 3)) + np.outer((-0.45, 0.45), (0.0, half_long_m, 0.0))
    return [vault], stations


def _cross_vault(
    draft: SceneDraft, rng: np.random.Generator, relief: float
) -> tuple[list[_Bend], NDArray[np.float64]]:
    del relief
    radius_m = rng.uniform(2.7, 3.3)
    half_rad = math.radians(rng.uniform(62.0, 72.0))
    half_m, axis_m = radius_m * math.sin(half_rad), 1.0 - radius_m * math.cos(half_rad)
    bends = []
    for number, axis in enumerate(((0.0, 1.0, 0.0), (1.0, 0.0, 0.0))):
        shape = Cylinder(
            point_world=np.array([0.0, 0.0, axis_m]),
            axis_world=np.array(axis),
            radius_m=radius_m,
            is_concave=True,
        )
        bend = _Bend(draft=draft, shape=shape, zero=_UP)
        paint, reach_m = replace(_FRESCO, seed=31 + number), half_rad * radius_m
        edges = np.linspace(-reach_m, reach_m, 2 * math.ceil(reach_m / _STRIP_M) + 1)
        for a0, a1 in itertools.pairwise(edges.tolist()):
            groin_m = abs(radius_m * math.sin(0.5 * (a0 + a1) / radius_m))
            for ends in ((-half_m, -groin_m), (groin_m, half_m)):
                bend.place((a0, a1, *ends), 0.0, paint, SurfaceRole.WALL)
        bends.append(bend)
    for omega_deg in (0.0, 90.0, 180.0, 270.0):
        extent = (-half_m, half_m, FLOOR_M, axis_m + radius_m)
        _wall(draft, f"wall {omega_deg:.0f}", omega_deg, half_m, extent, _STUCCO)
    _level(draft, "floor", FLOOR_M, (half_m, half_m))
    _furniture(draft, rng, (half_m - 0.8, half_m - 0.9, -half_m + 0.9, 0.2))
    return bends, rng.uniform(-0.3, 0.3, (2, 3)) + np.array([[-1.0, -0.8, 0.0], [1.0, 0.9, 0.0]])


def _apse(
    draft: SceneDraft, rng: np.random.Generator, relief: float
) -> tuple[list[_Bend], NDArray[np.float64]]:
    radius_m, half_rad = rng.uniform(1.6, 2.4), math.radians(rng.uniform(80.0, 90.0))
    top_m, start_m = rng.uniform(2.0, 3.0), 2.5
    opening_m = radius_m * math.sin(half_rad)
    axis_m = start_m - radius_m * math.cos(half_rad)
    shape = Cylinder(
        point_world=np.array([0.0, axis_m, 0.0]), axis_world=_UP, radius_m=radius_m, is_concave=True
    )
    apse = _Bend(draft=draft, shape=shape, zero=np.array([0.0, 1.0, 0.0]))
    reach_m = half_rad * radius_m
    window: Extent = (-0.3, 0.3, 0.4, 1.5)
    extent = (-reach_m, reach_m, FLOOR_M, top_m)
    apse.place(extent, 0.0, _FRESCO, SurfaceRole.WALL, [window])
    apse.box(window, (0.0, -0.25), _STUCCO)
    if relief > 0.0:
        apse.box((-reach_m, reach_m, 1.7, 1.85), (0.0, 0.05 * relief), _STUCCO)
    half_wide_m = opening_m + rng.uniform(0.8, 1.5)
    hole: Extent = (-opening_m, opening_m, FLOOR_M - 0.1, top_m + 0.1)
    sides: Extent = (-half_wide_m, half_wide_m, FLOOR_M, top_m)
    _wall(draft, "apse wall", 90.0, start_m, sides, _STUCCO, [hole])
    _wall(draft, "entrance wall", 270.0, 3.0, sides, _STUCCO)
    for name, omega_deg in (("right wall", 0.0), ("left wall", 180.0)):
        _wall(draft, name, omega_deg, half_wide_m, (-3.0, 3.0, FLOOR_M, top_m), _STONE)
    for name, height_m in (("floor", FLOOR_M), ("ceiling", top_m)):
        _level(draft, name, height_m, (half_wide_m, 6.0))
    _furniture(draft, rng, (0.0, axis_m, half_wide_m - 0.7, -1.0))
    return [apse], rng.uniform(-0.3, 0.3, (2, 3)) + np.array([[-0.9, 0.2, 0.0], [0.9, 0.5, 0.0]])


def _tower(
    draft: SceneDraft, rng: np.random.Generator, relief: float
) -> tuple[list[_Bend], NDArray[np.float64]]:
    radius_m, top_m = rng.uniform(2.5, 4.0), rng.uniform(6.0, 9.0)
    shape = Cylinder(point_world=np.zeros(3), axis_world=_UP, radius_m=radius_m, is_concave=False)
    tower = _Bend(draft=draft, shape=shape, zero=np.array([1.0, 0.0, 0.0]))
    turn_m = math.pi * radius_m
    windows = [(a - 0.3, a + 0.3, 1.0, 2.2) for a in rng.uniform(-0.8, 0.8, 2) * turn_m]
    windows = windows[: 1 if abs(windows[0][0] - windows[1][0]) < 1.0 else 2]
    extent = (-turn_m, turn_m, FLOOR_M, top_m)
    tower.place(extent, 0.0, _STONE, SurfaceRole.WALL, windows)
    for window in windows:
        tower.box(window, (0.0, -0.25), _OAK)
    if relief > 0.0:
        tower.box((-turn_m, turn_m, 3.0, 3.2), (0.0, 0.06 * relief), _STUCCO)
    _level(draft, "floor", FLOOR_M, (16.0, 16.0))
    # Add a house that touches the tower and hides about 60 degrees of it.
    add_block(
        draft,
        base=np.array([-radius_m - 2.2, 0.0, FLOOR_M]),
        yaw_deg=0.0,
        size_m=(5.0, radius_m, top_m + 4.0),
        paint=_STUCCO,
    )
    _furniture(draft, rng, (radius_m + 2.0, 1.0, 0.0, radius_m + 1.5))
    away_m = radius_m + rng.uniform(5.0, 7.0, 4)
    azimuth = np.radians(np.array([-120.0, -40.0, 40.0, 120.0]) + rng.uniform(-10.0, 10.0, 4))
    places = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(4)], axis=1)
    return [tower], away_m[:, None] * places


def _column(
    draft: SceneDraft, rng: np.random.Generator, relief: float
) -> tuple[list[_Bend], NDArray[np.float64]]:
    del relief
    radius_m, top_m = rng.uniform(0.18, 0.35), 1.9
    place = np.array([*rng.uniform(-0.3, 0.3, 2), 0.0])
    shape = Cylinder(point_world=place, axis_world=_UP, radius_m=radius_m, is_concave=False)
    column = _Bend(draft=draft, shape=shape, zero=np.array([1.0, 0.0, 0.0]))
    turn_m = math.pi * radius_m
    column.place((-turn_m, turn_m, FLOOR_M, top_m), 0.0, _FRESCO, SurfaceRole.WALL)
    for low_m, high_m in ((FLOOR_M, FLOOR_M + 0.25), (top_m - 0.3, top_m)):
        side_m = 2.3 * radius_m
        size_m = (side_m, side_m, high_m - low_m)
        base = place + low_m * _UP
        add_block(draft, base=base, yaw_deg=10.0, size_m=size_m, paint=_STUCCO)
    walls = (("right wall", 0.0), ("end wall", 90.0), ("left wall", 180.0), ("entrance", 270.0))
    for name, omega_deg in walls:
        _wall(draft, name, omega_deg, 3.2, (-3.2, 3.2, FLOOR_M, top_m), _STUCCO)
    for name, height_m in (("floor", FLOOR_M), ("ceiling", top_m)):
        _level(draft, name, height_m, (3.2, 3.2))
    # Add a screen beside the column, which hides a part of it from the second station.
    base = np.array([place[0] + radius_m + 0.3, place[1] - 0.9, FLOOR_M])
    add_block(draft, base=base, yaw_deg=0.0, size_m=(0.5, 0.1, 2.4), paint=_OAK)
    _furniture(draft, rng, (-2.0, -2.0, 2.2, 1.5))
    return [column], rng.uniform(-0.2, 0.2, (2, 3)) + np.array(
        [[-0.9, -2.0, 0.0], [1.0, -2.1, 0.1]]
    )


def _spire(
    draft: SceneDraft, rng: np.random.Generator, relief: float
) -> tuple[list[_Bend], NDArray[np.float64]]:
    base_m, half_rad = rng.uniform(1.3, 1.7), math.radians(rng.uniform(13.0, 18.0))
    slant_m = base_m / math.sin(half_rad)
    shape = Cone(
        apex_world=(FLOOR_M + slant_m * math.cos(half_rad)) * _UP,
        axis_world=-_UP,
        half_angle_rad=half_rad,
        is_concave=False,
    )
    # Positions are measured from the middle of the spire, whose tip is missing.
    middle_m, reach_m = 0.6 * slant_m, 0.4 * slant_m
    zero = np.array([1.0, 0.0, 0.0])
    spire = _Bend(draft=draft, shape=shape, zero=zero, slant_m=middle_m)
    turn_m = math.pi * spire.radius_m
    spire.place((-turn_m, turn_m, -reach_m, reach_m), 0.0, _FRESCO, SurfaceRole.WALL)
    if relief > 0.0:
        for b in rng.uniform(-0.1, 0.1, 2) + np.array([-0.3, 0.4]) * reach_m:
            spire.box((-turn_m, turn_m, b - 0.1, b + 0.1), (0.0, 0.06 * relief), _STUCCO)
        for a in rng.uniform(-0.8, 0.8, 3) * turn_m:
            spire.box((a - 0.2, a + 0.2, -0.2, 0.2), (0.0, 0.04 * relief), _STUCCO)
    _level(draft, "floor", FLOOR_M, (12.0, 12.0))
    away_m, azimuth = base_m + rng.uniform(3.0, 5.0, 4), 0.5 * math.pi * np.arange(4)
    azimuth += rng.uniform(-0.2, 0.2, 4)
    places = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(4)], axis=1)
    return [spire], away_m[:, None] * places


def _dome(
    draft: SceneDraft,
    rng: np.random.Generator,
    relief: float,
    radii_m: tuple[float, float] = (2.0, 3.0),
) -> tuple[list[_Bend], NDArray[np.float64]]:
    """Build a hemisphere over eight walls, whose edges meet its rim."""
    radius_m, spring_m = rng.uniform(*radii_m), rng.uniform(0.4, 1.0)
    shape = Sphere(centre_world=spring_m * _UP, radius_m=radius_m, is_concave=True)
    dome, turn_m = _Dome(draft=draft, shape=shape, zero=_UP), math.pi * radius_m
    dome.place((-turn_m, turn_m, 0.0, 0.51 * turn_m), 0.0, _FRESCO, SurfaceRole.WALL)
    if relief > 0.0:
        ring_m = rng.uniform(0.3, 0.6) * radius_m
        dome.box((-turn_m, turn_m, ring_m, ring_m + 0.15), (0.0, 0.05 * relief), _STUCCO)
        for a, b in rng.uniform((-1.0, 0.8), (1.0, 1.2), (4, 2)) * (turn_m, radius_m):
            panel = (a - 0.2, a + 0.2, b - 0.2, b + 0.2)
            dome.box(panel, (0.0, 0.03 * relief), _STUCCO)
    half_rad = 0.125 * math.pi
    half_m, apothem_m = radius_m * math.sin(half_rad), radius_m * math.cos(half_rad)
    for k in range(8):
        extent = (-half_m, half_m, FLOOR_M, spring_m + half_m + 0.02)
        _wall(draft, f"wall {k}", 45.0 * k, apothem_m, extent, _STUCCO)
    _level(draft, "floor", FLOOR_M, (radius_m, radius_m))
    _furniture(draft, rng, (apothem_m - 0.8, 0.0, 0.0, 0.8 - apothem_m))
    return [dome], rng.uniform(-0.2, 0.2, (2, 3)) + np.array([[-0.6, 0.4, 0.0], [0.6, 0.2, 0.0]])


def _baptistery(
    draft: SceneDraft, rng: np.random.Generator, relief: float
) -> tuple[list[_Bend], NDArray[np.float64]]:
    """Build a dome, two columns and a font with a conical cover below it."""
    bends, _ = _dome(draft, rng, relief, (5.0, 6.0))
    zero = np.array([1.0, 0.0, 0.0])
    for x, y in rng.uniform(-0.1, 0.1, (2, 2)) + np.array([[-1.1, -0.7], [1.1, -0.7]]):
        shape = Cylinder(
            point_world=np.array([x, y, 0.0]),
            axis_world=_UP,
            radius_m=rng.uniform(0.2, 0.3),
            is_concave=False,
        )
        column, turn_m = _Bend(draft=draft, shape=shape, zero=zero), math.pi * shape.radius_m
        column.place((-turn_m, turn_m, FLOOR_M, 0.9), 0.0, _FRESCO, SurfaceRole.WALL)
        bends.append(column)
    base = np.array([*rng.uniform((-0.1, 0.9), (0.1, 1.1)), FLOOR_M])
    add_block(draft, base=base, yaw_deg=20.0, size_m=(1.4, 1.4, 0.9), paint=_STONE)
    half_rad, base_m = math.radians(rng.uniform(18.0, 25.0)), rng.uniform(0.5, 0.65)
    slant_m = base_m / math.sin(half_rad)
    apex = base + (0.9 + slant_m * math.cos(half_rad)) * _UP
    cone = Cone(apex_world=apex, axis_world=-_UP, half_angle_rad=half_rad, is_concave=False)
    cover = _Bend(draft=draft, shape=cone, zero=zero, slant_m=0.55 * slant_m)
    turn_m, reach_m = math.pi * cover.radius_m, 0.45 * slant_m
    cover.place((-turn_m, turn_m, -reach_m, reach_m), 0.0, _FRESCO, SurfaceRole.WALL)
    around = np.array([[-2.2, 0.4, 0.0], [2.2, 0.2, 0.0], [0.3, 3.2, 0.0]])
    return [*bends, cover], rng.uniform(-0.2, 0.2, (3, 3)) + around


_BUILDERS: Final = {
    "barrel-vault": _barrel_vault,
    "cross-vault": _cross_vault,
    "apse": _apse,
    "tower": _tower,
    "column": _column,
    "spire": _spire,
    "dome": _dome,
    "baptistery": _baptistery,
}
