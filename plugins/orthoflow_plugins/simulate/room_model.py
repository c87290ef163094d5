"""The simulated room: four decorated walls, none quite perpendicular to the next, and objects.

Room frame: metres, z up, origin in the middle of the room 1.5 m above the floor. The main wall is
that of markiewicz2015: omega 102 deg, leaning by 0.8 deg. Other rooms have walls drawn from a
family: cornices, pilasters, niches, panels, and recessed doors; where all planes lie may be drawn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane, wall_axes
from orthoflow.geometry.scenes import Scene, SurfaceRole, TextureKind
from orthoflow_plugins.simulate.building import (
    Extent,
    Paint,
    SceneDraft,
    Side,
    TruePlane,
    add_block,
    flat_side,
    wall_side,
)

FLOOR_M: Final = -1.5
CEILING_M: Final = 1.6
_MAIN_OMEGA_DEG: Final = 102.0
# Ranges of where the planes of a drawn geometry lie, degrees and metres: hidden parts of surfaces
# reach beyond the corners of every such room.
_DRAWN_OMEGA_DEG: Final = 0.5
_DRAWN_PHI_DEG: Final = 1.0
_DRAWN_DISTANCE_M: Final = 0.08
_DRAWN_SLOPE: Final = 0.008
# The floor only rises, so that furniture stands on it.
_DRAWN_FLOOR_M: Final = (0.03, 0.07)
_DRAWN_CEILING_M: Final = (-0.05, 0.05)
# Visible area of the main wall, and the share of textile on it: at most, and by design.
_MAIN_WALL_M2: Final = 16.7
MOST_TEXTILE: Final = 0.35
TEXTILE_BY_DESIGN: Final = 0.095

_UP: Final = np.array([0.0, 0.0, 1.0])
# Walls extend slightly past the corners of the room, where others hide them.
_FULL: Final[Extent] = (-2.9, 2.9, FLOOR_M - 0.1, CEILING_M + 0.1)

_STUCCO = Paint(
    kind=TextureKind.PLAIN, rgb=(214, 206, 190), reflectance=0.7, contrast=0.18, seed=11
)
_GILT = Paint(kind=TextureKind.PLAIN, rgb=(196, 158, 82), reflectance=0.55, contrast=0.3, seed=12)
_OAK = Paint(
    kind=TextureKind.WOOD, rgb=(132, 92, 58), reflectance=0.35, period_m=0.12, contrast=0.4, seed=13
)
_DARK = Paint(kind=TextureKind.PLAIN, rgb=(92, 88, 84), reflectance=0.2, contrast=0.4, seed=14)
_OBJECT = Paint(
    kind=TextureKind.TILES, rgb=(38, 96, 160), reflectance=0.3, period_m=0.09, contrast=0.5, seed=15
)
_OCHRE = Paint(
    kind=TextureKind.FRESCO, rgb=(206, 180, 138), reflectance=0.5, period_m=0.34, seed=101
)
_GREEN = Paint(
    kind=TextureKind.FRESCO, rgb=(160, 186, 152), reflectance=0.5, period_m=0.34, seed=201
)
_BLUE = Paint(
    kind=TextureKind.FRESCO, rgb=(150, 170, 178), reflectance=0.5, period_m=0.34, seed=301
)
_RED = Paint(kind=TextureKind.FRESCO, rgb=(196, 150, 132), reflectance=0.5, period_m=0.34, seed=401)
_DAMASK = Paint(
    kind=TextureKind.TEXTILE, rgb=(150, 62, 58), reflectance=0.4, period_m=0.15, seed=102
)
# Drawn walls: name, ground, and from corner to corner.
_DRAWN: Final = (
    ("main wall", _OCHRE, (-2.7, 2.7)),
    ("opposite wall", _GREEN, (-2.7, 2.7)),
    ("right wall", _BLUE, (-2.4, 2.0)),
    ("left wall", _RED, (-2.0, 2.4)),
)
# How far drawn objects extend behind the adjoining walls, the floor and the ceiling.
_BEYOND_M: Final = 0.1
# A bay narrower than this stays bare, and so does the wall beside and above what is in it.
_BAY_LEAST_M: Final = 0.7
_BESIDE_M: Final = 0.12


@dataclass(frozen=True, kw_only=True)
class Geometry:
    """Where the planes of a room lie, in its frame.

    Attributes:
        walls: omega and phi in degrees and distance in metres of the main wall, the one opposite,
            the right and the left one.
        floor: normal and height of the floor; ceiling likewise.
        ceiling: see floor.
    """

    walls: tuple[tuple[float, float, float], ...] = (
        (_MAIN_OMEGA_DEG, 0.8, 2.4),
        (282.4, -0.2, 2.0),
        (12.2, 0.3, 2.7),
        (191.7, -0.3, 2.7),
    )
    floor: tuple[tuple[float, float, float], float] = ((0.0017, 0.0, 1.0), FLOOR_M)
    ceiling: tuple[tuple[float, float, float], float] = ((0.003, 0.002, -1.0), CEILING_M)

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Geometry:
        """Draw a room about as large as the designed one, with planes in other places."""

        def about(value: float, width: float) -> float:
            return value + float(rng.uniform(-width, width))

        def level(up: float) -> tuple[float, float, float]:
            return about(0.0, _DRAWN_SLOPE), about(0.0, _DRAWN_SLOPE), up

        return cls(
            walls=tuple(
                (
                    about(omega_deg, _DRAWN_OMEGA_DEG),
                    about(0.0, _DRAWN_PHI_DEG),
                    about(distance_m, _DRAWN_DISTANCE_M),
                )
                for omega_deg, _, distance_m in DESIGNED.walls
            ),
            floor=(level(1.0), FLOOR_M + float(rng.uniform(*_DRAWN_FLOOR_M))),
            ceiling=(level(-1.0), CEILING_M + float(rng.uniform(*_DRAWN_CEILING_M))),
        )

    def sides(self, draft: SceneDraft) -> list[Side]:
        """Begin the main wall, the one opposite, the right and the left one."""
        return [
            wall_side(draft, omega_deg=omega_deg, phi_deg=phi_deg, distance_m=distance_m)
            for omega_deg, phi_deg, distance_m in self.walls
        ]


DESIGNED: Final = Geometry()


@dataclass(frozen=True, kw_only=True)
class RoomPlan:
    """The properties of the room.

    Attributes:
        relief: scale of all mouldings, 1 = as designed (up to 15 cm).
        obstacle: an object stands free in front of the main wall.
        spectral_gap: 0 when the laser sees the painted patterns, 1 when others.
        textile_share: share of the main wall covered by one repeated motif, at most `MOST_TEXTILE`.
        geometry: where its planes lie.
    """

    relief: float
    obstacle: bool
    spectral_gap: float
    textile_share: float = TEXTILE_BY_DESIGN
    geometry: Geometry = DESIGNED


@dataclass(frozen=True, kw_only=True)
class Room:
    """The room as built.

    Attributes:
        scene: its surfaces, in the room frame; `scene.plane_index` counts in `planes`.
        planes: planes that a detector should find, clipped to the room.
    """

    scene: Scene
    planes: tuple[TruePlane, ...]


def build_room(plan: RoomPlan, rng: np.random.Generator | None = None) -> Room:
    """Build the room.

    Args:
        plan: its properties.
        rng: draws the four walls from a family; without it they are as designed.
    """
    draft = SceneDraft()
    sides = plan.geometry.sides(draft)
    if rng is None:
        main, opposite, right, left = sides
        _build_main_wall(main, plan)
        _build_opposite_wall(opposite, plan)
        _build_right_wall(right, plan)
        _build_left_wall(left, plan)
    else:
        _draw_walls(sides, plan, rng)
    _build_floor_and_ceiling(draft, plan.geometry)
    _furnish(draft, plan)
    return Room(scene=draft.finished(spectral_gap=plan.spectral_gap), planes=_clipped(draft.planes))


def _draw_walls(sides: list[Side], plan: RoomPlan, rng: np.random.Generator) -> None:
    # Of a stream of their own: walls with and without a cloth are otherwise the same.
    cloth = _drawn_cloth(plan.textile_share, rng.spawn(1)[0])
    for side, (name, ground, (a0, a1)) in zip(sides, _DRAWN, strict=True):
        drawing = WallDrawing(
            full=_FULL,
            shown=(a0, a1, FLOOR_M, CEILING_M),
            relief=plan.relief,
            paints=WallPaints(ground=ground, relief=_STUCCO, panel=_GILT, door=_OAK),
            cloth=cloth if side is sides[0] else None,
        )
        draw_wall(side, name, drawing, rng)


def main_wall_axes() -> NDArray[np.float64]:
    """Horizontal directions (2, 3): along the main wall to the viewer's right, and towards it."""
    omega = math.radians(_MAIN_OMEGA_DEG)
    return np.array(
        [[math.sin(omega), -math.cos(omega), 0.0], [math.cos(omega), math.sin(omega), 0.0]]
    )


def _build_main_wall(wall: Side, plan: RoomPlan) -> None:
    fresco = Paint(
        kind=TextureKind.FRESCO, rgb=(206, 180, 138), reflectance=0.5, period_m=0.32, seed=101
    )
    niche: Extent = (-1.95, -1.15, -1.1, 0.75)
    door: Extent = (1.22, 2.12, FLOOR_M - 0.1, 0.65)
    cloths = _cloths(plan.textile_share)
    full = wall.true_plane("main wall", _FULL)
    in_niche = wall.true_plane("niche", niche, -0.25)
    in_door = wall.true_plane("door", door, -0.12)
    holes = [
        wall.recess(niche, 0.25, fresco, plane=in_niche),
        wall.recess(door, 0.12, _OAK, plane=in_door),
        *cloths,
    ]
    wall.place(_FULL, 0.0, fresco, SurfaceRole.WALL, plane=full, holes=holes)
    for cloth in cloths:
        wall.place(cloth, 0.0, _DAMASK, SurfaceRole.WALL, plane=full)
    wall.bars((-0.53, 0.73, -0.53, 1.08), 0.08, 0.03 * plan.relief, _GILT)
    wall.bars((-0.53, 0.73, -1.2, -0.7), 0.06, 0.025 * plan.relief, _STUCCO)
    wall.bars((1.10, 2.24, FLOOR_M - 0.1, 0.77), 0.12, 0.04 * plan.relief, _STUCCO)
    for bottom, top in ((-1.3, -0.5), (-0.35, 0.5)):
        wall.bars((1.34, 2.0, bottom, top), 0.05, 0.02 * plan.relief, _OAK, base_m=-0.12)
    for middle in (-2.3, -0.84, 0.94, 2.48):
        _add_pilaster(wall, middle, plan)
    for middle, height in ((-1.55, 1.02), (1.68, 1.02)):
        square: Extent = (middle - 0.09, middle + 0.09, height - 0.09, height + 0.09)
        wall.box(square, 0.045 * plan.relief, _GILT)
    _add_cornice(wall, plan)
    for start, end in ((-2.17, -0.97), (-0.71, 0.81)):
        wall.box((start, end, FLOOR_M - 0.1, -1.32), 0.02 * plan.relief, _STUCCO)


def _cloths(share: float) -> list[Extent]:
    """Cover a share of the main wall with cloth: the panel in the middle first, then beside it."""
    middle: Extent = (-0.73, 0.83, -1.3, 1.3)
    by_design: Extent = (-0.45, 0.65, -0.45, 1.0)
    beside: list[Extent] = [
        (-2.19, -0.95, 0.75, 1.3),  # over the niche
        (1.05, 2.37, 0.77, 1.3),  # over the door
        (-2.19, -1.95, -1.3, 0.75),  # left of the niche
        (-1.15, -0.95, -1.3, 0.75),  # right of it
    ]
    left_m2 = share * _MAIN_WALL_M2
    if left_m2 <= 0.0:
        return []
    cloths = [_grown(by_design, middle, left_m2)]
    left_m2 -= _area_m2(cloths[0])
    for extent in beside:
        if left_m2 > 1e-6:
            a0, a1, b0, b1 = extent
            used = min(1.0, left_m2 / _area_m2(extent))
            cloths.append((a0, a1, b1 - used * (b1 - b0), b1))
            left_m2 -= used * _area_m2(extent)
    return cloths


def _grown(small: Extent, large: Extent, area_m2: float) -> Extent:
    """Shrink the small rectangle about its middle, or grow it towards the large one."""
    full = _area_m2(small)
    if area_m2 <= full:
        a, b = 0.5 * (small[0] + small[1]), 0.5 * (small[2] + small[3])
        scale = math.sqrt(area_m2 / full)
        return (
            a + scale * (small[0] - a),
            a + scale * (small[1] - a),
            b + scale * (small[2] - b),
            b + scale * (small[3] - b),
        )
    low, high = 0.0, 1.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        if _area_m2(_between(small, large, middle)) < area_m2:
            low = middle
        else:
            high = middle
    return _between(small, large, high)


def _between(first: Extent, second: Extent, share: float) -> Extent:
    a0, a1, b0, b1 = (p + share * (q - p) for p, q in zip(first, second, strict=True))
    return a0, a1, b0, b1


def _area_m2(extent: Extent) -> float:
    return (extent[1] - extent[0]) * (extent[3] - extent[2])


def _build_opposite_wall(wall: Side, plan: RoomPlan) -> None:
    fresco = Paint(
        kind=TextureKind.FRESCO, rgb=(160, 186, 152), reflectance=0.45, period_m=0.4, seed=201
    )
    windows: list[Extent] = [(-1.7, -0.7, -0.6, 1.0), (0.7, 1.7, -0.6, 1.0)]
    full = wall.true_plane("opposite wall", _FULL)
    holes = [wall.recess(window, 0.3, _STUCCO) for window in windows]
    wall.place(_FULL, 0.0, fresco, SurfaceRole.WALL, plane=full, holes=holes)
    for middle in (-2.2, 0.0, 2.2):
        _add_pilaster(wall, middle, plan)
    _add_cornice(wall, plan)


def _build_right_wall(wall: Side, plan: RoomPlan) -> None:
    damask = Paint(
        kind=TextureKind.TEXTILE, rgb=(72, 104, 120), reflectance=0.35, period_m=0.3, seed=301
    )
    full = wall.true_plane("right wall", _FULL)
    wall.place(_FULL, 0.0, damask, SurfaceRole.WALL, plane=full)
    for start, end in ((-1.9, -0.7), (-0.5, 0.7)):
        wall.bars((start, end, -0.9, 1.0), 0.07, 0.03 * plan.relief, _GILT)
    _add_pilaster(wall, 1.3, plan)
    _add_cornice(wall, plan)


def _build_left_wall(wall: Side, plan: RoomPlan) -> None:
    fresco = Paint(
        kind=TextureKind.FRESCO, rgb=(196, 150, 132), reflectance=0.45, period_m=0.36, seed=401
    )
    full = wall.true_plane("left wall", _FULL)
    wall.place(_FULL, 0.0, fresco, SurfaceRole.WALL, plane=full)
    hearth: Extent = (-0.45, 0.45, FLOOR_M - 0.1, -0.65)
    front: Extent = (-0.75, 0.75, FLOOR_M - 0.1, -0.4)
    wall.place(front, 0.28, _STUCCO, SurfaceRole.RELIEF, holes=[hearth])
    wall.rims(front, (0.0, 0.28), _STUCCO, SurfaceRole.RELIEF)
    wall.place(hearth, 0.03, _DARK, SurfaceRole.RELIEF)
    wall.rims(hearth, (0.03, 0.28), _DARK, SurfaceRole.RELIEF)
    wall.box((-0.6, 0.6, -0.2, 1.1), 0.05 * plan.relief, _GILT)
    for middle in (-1.6, 1.6):
        _add_pilaster(wall, middle, plan)
    _add_cornice(wall, plan)


def _build_floor_and_ceiling(draft: SceneDraft, geometry: Geometry) -> None:
    tiles = Paint(
        kind=TextureKind.TILES, rgb=(150, 138, 122), reflectance=0.35, period_m=0.35, seed=501
    )
    painted = Paint(
        kind=TextureKind.FRESCO, rgb=(206, 206, 210), reflectance=0.8, period_m=0.5, seed=502
    )
    wide: Extent = (-3.4, 3.4, -3.2, 3.2)
    for name, (normal, height_m), paint in (
        ("floor", geometry.floor, tiles),
        ("ceiling", geometry.ceiling, painted),
    ):
        side = flat_side(draft, normal=normal, height_m=height_m)
        plane = side.true_plane(name, wide)
        side.place(wide, 0.0, paint, SurfaceRole.WALL, plane=plane)


def _furnish(draft: SceneDraft, plan: RoomPlan) -> None:
    along, towards = main_wall_axes()
    yaw_deg = _MAIN_OMEGA_DEG - 90.0
    floor = FLOOR_M * _UP
    if plan.obstacle:
        # A screen 0.6 m in front of the main wall, turned so that no face is parallel to it.
        add_block(
            draft,
            base=floor + 0.1 * along + 1.78 * towards,
            yaw_deg=yaw_deg + 6.0,
            size_m=(0.9, 0.1, 1.3),
            paint=_OBJECT,
        )
    add_block(
        draft,
        base=floor + 2.3 * along - 0.9 * towards,
        yaw_deg=yaw_deg - 4.0,
        size_m=(0.5, 0.9, 0.75),
        paint=_OAK,
    )
    add_block(
        draft,
        base=floor - 0.2 * along - 1.3 * towards,
        yaw_deg=yaw_deg + 20.0,
        size_m=(0.8, 0.5, 0.7),
        paint=_DARK,
    )


def _add_pilaster(wall: Side, middle: float, plan: RoomPlan) -> None:
    scale = plan.relief
    wall.box((middle - 0.11, middle + 0.11, FLOOR_M - 0.1, 1.3), 0.07 * scale, _STUCCO)
    wall.box((middle - 0.13, middle + 0.13, FLOOR_M - 0.1, -1.2), 0.1 * scale, _STUCCO)
    wall.box((middle - 0.13, middle + 0.13, 1.12, 1.3), 0.11 * scale, _GILT)


def _add_cornice(wall: Side, plan: RoomPlan) -> None:
    wall.box((-2.9, 2.9, 1.3, CEILING_M + 0.1), 0.08 * plan.relief, _STUCCO)
    wall.box((-2.9, 2.9, 1.44, CEILING_M + 0.1), 0.15 * plan.relief, _GILT)


def _clipped(planes: list[TruePlane]) -> tuple[TruePlane, ...]:
    """Cut each outline to the room; return the smallest upright rectangle of what remains."""
    bounds = [item.plane for item in planes if not item.name.startswith(("niche", "door"))]
    return tuple(
        TruePlane(name=item.name, plane=item.plane, outline=_visible_rectangle(item, bounds))
        for item in planes
    )


def _visible_rectangle(item: TruePlane, bounds: list[Plane]) -> NDArray[np.float64]:
    polygon = item.outline
    for bound in bounds:
        if abs(float(bound.normal @ item.plane.normal)) < 0.9:
            polygon = _cut(polygon, bound)
    u, v = wall_axes(item.plane.normal, _UP)
    columns, rows = polygon @ u, polygon @ v
    base = item.plane.offset_m * item.plane.normal
    ends = (
        (columns.min(), rows.min()),
        (columns.min(), rows.max()),
        (columns.max(), rows.max()),
        (columns.max(), rows.min()),
    )
    return np.array([base + column * u + row * v for column, row in ends])


def _cut(polygon: NDArray[np.float64], bound: Plane) -> NDArray[np.float64]:
    """Keep the part of a convex polygon (n, 3) in front of a plane (Sutherland and Hodgman)."""
    distances = bound.distances_m(polygon)
    kept: list[NDArray[np.float64]] = []
    for start in range(len(polygon)):
        end = (start + 1) % len(polygon)
        if distances[start] >= 0.0:
            kept.append(polygon[start])
        if (distances[start] >= 0.0) != (distances[end] >= 0.0):
            share = distances[start] / (distances[start] - distances[end])
            kept.append(polygon[start] + share * (polygon[end] - polygon[start]))
    return np.array(kept)


@dataclass(frozen=True, kw_only=True)
class WallPaints:
    """The textures of a drawn wall.

    Attributes:
        ground: the wall itself, and its niches.
        relief: cornice, pilasters and skirting.
        panel: mouldings of panels.
        door: doors.
    """

    ground: Paint
    relief: Paint
    panel: Paint
    door: Paint


@dataclass(frozen=True, kw_only=True)
class WallDrawing:
    """How a wall is drawn.

    Attributes:
        full: extent of the wall, slightly past the corners of the room.
        shown: extent between the adjoining walls, the floor and the ceiling.
        relief: scale of all relief.
        paints: its textures.
        cloth: extent of a cloth with a repeated motif; openings in the wall open it too.
    """

    full: Extent
    shown: Extent
    relief: float
    paints: WallPaints
    cloth: Extent | None = None


def draw_wall(wall: Side, name: str, drawing: WallDrawing, rng: np.random.Generator) -> None:
    """Build a wall with relief up to 0.3 m in front of it and recesses up to 0.45 m behind it.

    Niches and doors are registered as planes of their own.

    Args:
        wall: the wall.
        name: of its plane.
        drawing: how.
        rng: draws the objects.
    """
    plane = wall.true_plane(name, drawing.full)
    top_m = _draw_cornice(wall, drawing, rng)
    bays = _draw_pilasters(wall, drawing, top_m, rng)
    holes = [
        hole
        for bay in bays
        for hole in _draw_bay(wall, f"{name} {len(wall.draft.planes)}", (bay, drawing), rng)
    ]
    cloths = [] if drawing.cloth is None else [drawing.cloth]
    for cloth in cloths:
        wall.place(cloth, 0.0, _DAMASK, SurfaceRole.WALL, plane=plane, holes=holes)
    holes = [*holes, *cloths]
    wall.place(drawing.full, 0.0, drawing.paints.ground, SurfaceRole.WALL, plane=plane, holes=holes)


def _drawn_cloth(share: float, rng: np.random.Generator) -> Extent | None:
    """Hang one cloth over a share of the main wall, anywhere on it; None hangs none."""
    if share <= 0.0:
        return None
    _, _, (a0, a1) = _DRAWN[0]
    width_m = math.sqrt(share * _MAIN_WALL_M2 * rng.uniform(1.2, 2.0))
    height_m = share * _MAIN_WALL_M2 / width_m
    left_m, low_m = rng.uniform(a0, a1 - width_m), rng.uniform(FLOOR_M, CEILING_M - height_m)
    return (left_m, left_m + width_m, low_m, low_m + height_m)


def _draw_cornice(wall: Side, drawing: WallDrawing, rng: np.random.Generator) -> float:
    """Build up to three steps under the ceiling, or none; return where they begin."""
    a0, a1, _, _ = drawing.full
    ceiling_m = drawing.shown[3]
    n_steps = int(rng.integers(0, 4))
    height_m, depth_m = rng.uniform(0.12, 0.45), drawing.relief * rng.uniform(0.06, 0.3)
    for step in range(n_steps):
        low_m = ceiling_m - height_m * (1.0 - step / n_steps)
        extent = (a0, a1, low_m, ceiling_m + _BEYOND_M)
        wall.box(extent, depth_m * (step + 1) / n_steps, drawing.paints.relief)
    return ceiling_m - height_m if n_steps else ceiling_m


def _draw_pilasters(
    wall: Side, drawing: WallDrawing, top_m: float, rng: np.random.Generator
) -> list[Extent]:
    """Build pilasters, maybe in the corners too, and a skirting; return the bays between them."""
    a0, a1, floor_m, _ = drawing.shown
    n_inner, is_cornered = int(rng.integers(0, 4)), bool(rng.random() < 0.5)
    width_m, depth_m = rng.uniform(0.16, 0.4), drawing.relief * rng.uniform(0.03, 0.2)
    skirting_m, thick_m = rng.uniform(0.06, 0.25), drawing.relief * rng.uniform(0.01, 0.05)
    middles = np.linspace(a0, a1, n_inner + 2)[1:-1] + rng.uniform(-0.15, 0.15, n_inner)
    ends = [(middle - 0.5 * width_m, middle + 0.5 * width_m) for middle in middles]
    if is_cornered:
        ends = [(a0 - _BEYOND_M, a0 + width_m), *ends, (a1 - width_m, a1 + _BEYOND_M)]
    for left, right in ends:
        wall.box((left, right, floor_m - _BEYOND_M, top_m), depth_m, drawing.paints.relief)
    starts = [right for _, right in ends] if is_cornered else [a0, *(end for _, end in ends)]
    stops = [left for left, _ in ends] if is_cornered else [*(end for end, _ in ends), a1]
    if is_cornered:
        starts, stops = starts[:-1], stops[1:]
    bays = [(a, b, floor_m, top_m) for a, b in zip(starts, stops, strict=True)]
    if rng.random() < 0.6:
        for left, right, _, _ in bays:
            skirting = (left, right, floor_m - _BEYOND_M, floor_m + skirting_m)
            wall.box(skirting, thick_m, drawing.paints.relief)
    return bays


def _draw_bay(
    wall: Side, name: str, where: tuple[Extent, WallDrawing], rng: np.random.Generator
) -> list[Extent]:
    """Build a niche, a door, a panel or nothing between two pilasters; return the wall's holes."""
    (left, right, floor_m, top_m), drawing = where
    kind = str(rng.choice(["niche", "door", "panel", "bare"]))
    width_m = min(rng.uniform(0.6, 1.3), right - left - 2.0 * _BESIDE_M)
    middle_m = 0.5 * (left + right) + rng.uniform(-0.5, 0.5) * (
        right - left - width_m - 2.0 * _BESIDE_M
    )
    low_m, high_m = floor_m + rng.uniform(0.3, 0.7), top_m - rng.uniform(0.15, 0.5)
    depth_m = rng.uniform(0.05, 0.35 if kind == "niche" else 0.45)
    if kind == "bare" or right - left < _BAY_LEAST_M:
        return []
    a0, a1 = middle_m - 0.5 * width_m, middle_m + 0.5 * width_m
    if kind == "panel":
        wall.bars((a0, a1, low_m, high_m), 0.07, 0.03 * drawing.relief, drawing.paints.panel)
        return []
    paint = drawing.paints.ground if kind == "niche" else drawing.paints.door
    low_m = low_m if kind == "niche" else floor_m - _BEYOND_M
    extent = (a0, a1, low_m, high_m)
    plane = wall.true_plane(f"{kind} in {name}", extent, -depth_m)
    return [wall.recess(extent, depth_m, paint, plane=plane)]
