"""The simulated room: four decorated walls that are not exactly perpendicular, and furniture.

Coordinates in the room frame are in metres, with z upwards and the origin in the middle of the
room, 1.5 m above the floor. The main wall has the orientation of the wall in markiewicz2015: omega
is 102 degrees, and the inclination is 0.8 degrees. Walls can also be random, with cornices,
pilasters, niches, panels and recessed doors, and so can the positions of all planes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
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
# Maximum random changes of the planes, in degrees and metres: small enough that surfaces extend
# beyond the corners of every random room.
_DRAWN_OMEGA_DEG: Final = 0.5
_DRAWN_PHI_DEG: Final = 1.0
_DRAWN_DISTANCE_M: Final = 0.08
_DRAWN_SLOPE: Final = 0.008
# The floor is only raised, so that there is no gap below the furniture.
_DRAWN_FLOOR_M: Final = (0.03, 0.07)
_DRAWN_CEILING_M: Final = (-0.05, 0.05)
# Visible area of the main wall in square metres.
_MAIN_WALL_M2: Final = 16.7
# Share of the main wall covered by textile: the maximum, and the share in the designed room.
MOST_TEXTILE: Final = 0.35
TEXTILE_BY_DESIGN: Final = 0.095

_UP: Final = np.array([0.0, 0.0, 1.0])
# Walls extend slightly beyond the corners of the room, where other walls hide them.
_FULL: Final[Extent] = (-2.9, 2.9, FLOOR_M - 0.1, CEILING_M + 0.1)

STUCCO: Final = Paint(TextureKind.PLAIN, (214, 206, 190), 0.7, 0.18, seed=11)
GILT: Final = Paint(TextureKind.PLAIN, (196, 158, 82), 0.55, 0.3, seed=12)
OAK: Final = Paint(TextureKind.WOOD, (132, 92, 58), 0.35, 0.4, 0.12, 13)
_DARK: Final = Paint(TextureKind.PLAIN, (92, 88, 84), 0.2, 0.4, seed=14)
_OBJECT: Final = Paint(TextureKind.TILES, (38, 96, 160), 0.3, 0.5, 0.09, 15)
_DAMASK: Final = Paint(TextureKind.TEXTILE, (150, 62, 58), 0.4, period_m=0.15, seed=102)
# For each wall: name; background texture of the random wall, and its ends at the corners in metres;
# background texture of the designed wall.
_WALLS: Final = (
    (
        "main wall",
        Paint(TextureKind.FRESCO, (206, 180, 138), 0.5, period_m=0.34, seed=101),
        (-2.7, 2.7),
        Paint(TextureKind.FRESCO, (206, 180, 138), 0.5, period_m=0.32, seed=101),
    ),
    (
        "opposite wall",
        Paint(TextureKind.FRESCO, (160, 186, 152), 0.5, period_m=0.34, seed=201),
        (-2.7, 2.7),
        Paint(TextureKind.FRESCO, (160, 186, 152), 0.45, period_m=0.4, seed=201),
    ),
    (
        "right wall",
        Paint(TextureKind.FRESCO, (150, 170, 178), 0.5, period_m=0.34, seed=301),
        (-2.4, 2.0),
        Paint(TextureKind.TEXTILE, (72, 104, 120), 0.35, period_m=0.3, seed=301),
    ),
    (
        "left wall",
        Paint(TextureKind.FRESCO, (196, 150, 132), 0.5, period_m=0.34, seed=401),
        (-2.0, 2.4),
        Paint(TextureKind.FRESCO, (196, 150, 132), 0.45, period_m=0.36, seed=401),
    ),
)
# Floor and ceiling.
_LEVELS: Final = (
    ("floor", Paint(TextureKind.TILES, (150, 138, 122), 0.35, period_m=0.35, seed=501)),
    ("ceiling", Paint(TextureKind.FRESCO, (206, 206, 210), 0.8, period_m=0.5, seed=502)),
)
# For each piece of furniture: position along the main wall and towards it, rotation, size and
# paint. The first is a screen 0.6 m in front of the main wall. No face is parallel to a wall.
_FURNITURE: Final = (
    (0.1, 1.78, 6.0, (0.9, 0.1, 1.3), _OBJECT),
    (2.3, -0.9, -4.0, (0.5, 0.9, 0.75), OAK),
    (-0.2, -1.3, 20.0, (0.8, 0.5, 0.7), _DARK),
)
# Distance by which random objects extend beyond adjoining walls, floor and ceiling.
_BEYOND_M: Final = 0.1
# Narrower bays remain empty.
_BAY_LEAST_M: Final = 0.7
# Margin on each side of an object in a bay.
_BESIDE_M: Final = 0.12
_PLAQUE_GAP_M: Final = 0.1
_PLAQUE_TRIES: Final = 40


@dataclass(frozen=True, kw_only=True)
class Geometry:
    """Positions of the planes of a room, in the room frame.

    Attributes:
        walls: omega and phi in degrees, and distance from the origin in metres, of the main,
            opposite, right and left walls.
        floor: normal of the floor, and height in metres.
        ceiling: normal of the ceiling, and height in metres.
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
        """Return random positions of the planes, for a room about as large as the designed one."""

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
        """Return the main, opposite, right and left walls, still empty."""
        return [
            wall_side(draft, omega_deg=omega_deg, phi_deg=phi_deg, distance_m=distance_m)
            for omega_deg, phi_deg, distance_m in self.walls
        ]


DESIGNED: Final = Geometry()


@dataclass(frozen=True, kw_only=True)
class Room:
    """The finished room.

    Attributes:
        scene: surfaces in the room frame; `scene.plane_index` is an index into `planes`.
        planes: planes that a detector should find, clipped to the room.
    """

    scene: Scene
    planes: tuple[TruePlane, ...]


def build_room(
    rng: np.random.Generator | None = None,
    *,
    relief: float = 1.0,
    obstacle: bool = True,
    spectral_gap: float = 0.3,
    textile_share: float = TEXTILE_BY_DESIGN,
    n_plaques: int = 0,
    geometry: Geometry = DESIGNED,
) -> Room:
    """Build the room.

    Args:
        rng: random generator for random walls; None for the designed walls.
        relief: scale of all mouldings; 1 for the designed size (up to 15 cm).
        obstacle: whether a free-standing object is in front of the main wall.
        spectral_gap: 0 if the laser measures the visible patterns, 1 if it measures different ones.
        textile_share: share of the main wall that is covered by a repeated motif, at most
            `MOST_TEXTILE`.
        n_plaques: maximum number of plaques on a random main wall.
        geometry: positions of the planes of the room.
    """
    draft = SceneDraft()
    sides = geometry.sides(draft)
    if rng is None:
        for number, side in enumerate(sides):
            _build_wall(side, number, relief, [] if number else _cloths(textile_share))
    else:
        # Use separate random streams, so that cloth and plaques do not affect the rest of the
        # walls.
        cloth_rng, plaque_rng = rng.spawn(2)
        cloth = _drawn_cloth(textile_share, cloth_rng)
        for side, (name, ground, span, _) in zip(sides, _WALLS, strict=True):
            holes = draw_wall(side, name, ground, span, rng, relief=relief, cloth=cloth)
            _draw_plaques(side, span, n_plaques, holes, relief, plaque_rng)
            cloth, n_plaques = None, 0
    wide: Extent = (-3.4, 3.4, -3.2, 3.2)
    for (name, paint), (normal, height_m) in zip(
        _LEVELS, (geometry.floor, geometry.ceiling), strict=True
    ):
        level = flat_side(draft, normal=normal, height_m=height_m)
        level.place(wide, 0.0, paint, SurfaceRole.WALL, plane=level.true_plane(name, wide))
    along, towards = main_wall_axes()
    for a, t, turn_deg, size_m, paint in _FURNITURE[0 if obstacle else 1 :]:
        base = FLOOR_M * _UP + a * along + t * towards
        yaw_deg = _MAIN_OMEGA_DEG - 90.0 + turn_deg
        add_block(draft, base=base, yaw_deg=yaw_deg, size_m=size_m, paint=paint)
    return Room(scene=draft.finished(spectral_gap=spectral_gap), planes=_clipped(draft.planes))


def main_wall_axes() -> NDArray[np.float64]:
    """Return horizontal unit vectors (2, 3): to the right along the main wall, and towards it."""
    omega = math.radians(_MAIN_OMEGA_DEG)
    return np.array(
        [[math.sin(omega), -math.cos(omega), 0.0], [math.cos(omega), math.sin(omega), 0.0]]
    )


# A moulding: extent, width of the bars (of a frame; 0 for a solid moulding), height, paint, and
# depth of the base. A recess: name (if it is a separate plane), extent, depth, and paint (None for
# the paint of the wall).
Moulding = tuple[Extent, float, float, Paint, float]
Recess = tuple[str, Extent, float, Paint | None]


def _pilasters(*middles: float) -> tuple[Moulding, ...]:
    return tuple(
        ((middle - half, middle + half, low, high), 0.0, height, paint, 0.0)
        for middle in middles
        for half, low, high, height, paint in (
            (0.11, FLOOR_M - 0.1, 1.3, 0.07, STUCCO),
            (0.13, FLOOR_M - 0.1, -1.2, 0.1, STUCCO),
            (0.13, 1.12, 1.3, 0.11, GILT),
        )
    )


_CORNICE: Final[tuple[Moulding, ...]] = (
    ((-2.9, 2.9, 1.3, CEILING_M + 0.1), 0.0, 0.08, STUCCO, 0.0),
    ((-2.9, 2.9, 1.44, CEILING_M + 0.1), 0.0, 0.15, GILT, 0.0),
)
# The designed walls, in the order of `_WALLS`.
_DESIGNS: Final[tuple[tuple[tuple[Recess, ...], tuple[Moulding, ...]], ...]] = (
    (
        (
            ("niche", (-1.95, -1.15, -1.1, 0.75), 0.25, None),
            ("door", (1.22, 2.12, FLOOR_M - 0.1, 0.65), 0.12, OAK),
        ),
        (
            ((-0.53, 0.73, -0.53, 1.08), 0.08, 0.03, GILT, 0.0),
            ((-0.53, 0.73, -1.2, -0.7), 0.06, 0.025, STUCCO, 0.0),
            ((1.10, 2.24, FLOOR_M - 0.1, 0.77), 0.12, 0.04, STUCCO, 0.0),
            ((1.34, 2.0, -1.3, -0.5), 0.05, 0.02, OAK, -0.12),
            ((1.34, 2.0, -0.35, 0.5), 0.05, 0.02, OAK, -0.12),
            *_pilasters(-2.3, -0.84, 0.94, 2.48),
            ((-1.55 - 0.09, -1.55 + 0.09, 1.02 - 0.09, 1.02 + 0.09), 0.0, 0.045, GILT, 0.0),
            ((1.68 - 0.09, 1.68 + 0.09, 1.02 - 0.09, 1.02 + 0.09), 0.0, 0.045, GILT, 0.0),
            *_CORNICE,
            ((-2.17, -0.97, FLOOR_M - 0.1, -1.32), 0.0, 0.02, STUCCO, 0.0),
            ((-0.71, 0.81, FLOOR_M - 0.1, -1.32), 0.0, 0.02, STUCCO, 0.0),
        ),
    ),
    (
        (("", (-1.7, -0.7, -0.6, 1.0), 0.3, STUCCO), ("", (0.7, 1.7, -0.6, 1.0), 0.3, STUCCO)),
        (*_pilasters(-2.2, 0.0, 2.2), *_CORNICE),
    ),
    (
        (),
        (
            ((-1.9, -0.7, -0.9, 1.0), 0.07, 0.03, GILT, 0.0),
            ((-0.5, 0.7, -0.9, 1.0), 0.07, 0.03, GILT, 0.0),
            *_pilasters(1.3),
            *_CORNICE,
        ),
    ),
    ((), (((-0.6, 0.6, -0.2, 1.1), 0.0, 0.05, GILT, 0.0), *_pilasters(-1.6, 1.6), *_CORNICE)),
)


def _build_wall(
    wall: Side,
    number: int,
    relief: float,
    cloths: list[Extent],
) -> None:
    name, _, _, ground = _WALLS[number]
    recesses, mouldings = _DESIGNS[number]
    plane = wall.true_plane(name, _FULL)
    planes = [
        wall.true_plane(of, hole, -depth_m) if of else -1 for of, hole, depth_m, _ in recesses
    ]
    for (_, hole, depth_m, paint), own in zip(recesses, planes, strict=True):
        wall.recess(hole, depth_m, paint or ground, plane=own)
    holes = [*(hole for _, hole, _, _ in recesses), *cloths]
    wall.place(_FULL, 0.0, ground, SurfaceRole.WALL, plane=plane, holes=holes)
    for cloth in cloths:
        wall.place(cloth, 0.0, _DAMASK, SurfaceRole.WALL, plane=plane)
    if name == "left wall":
        hearth: Extent = (-0.45, 0.45, FLOOR_M - 0.1, -0.65)
        front: Extent = (-0.75, 0.75, FLOOR_M - 0.1, -0.4)
        wall.place(front, 0.28, STUCCO, SurfaceRole.RELIEF, holes=[hearth])
        wall.rims(front, (0.0, 0.28), STUCCO, SurfaceRole.RELIEF)
        wall.place(hearth, 0.03, _DARK, SurfaceRole.RELIEF)
        wall.rims(hearth, (0.03, 0.28), _DARK, SurfaceRole.RELIEF)
    for extent, width_m, height_m, paint, base_m in mouldings:
        if width_m:
            wall.bars(extent, width_m, height_m * relief, paint, base_m=base_m)
        else:
            wall.box(extent, height_m * relief, paint, base_m=base_m)


def _cloths(share: float) -> list[Extent]:
    """Return the extents of cloths that cover a share of the main wall, from its middle."""
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
    """Return a rectangle with a given area, similar in shape to a small and a large one."""
    one, other = np.array(small), np.array(large)
    full = _area_m2(small)
    if area_m2 <= full:
        middle = np.repeat([0.5 * (one[0] + one[1]), 0.5 * (one[2] + one[3])], 2)
        grown = middle + math.sqrt(area_m2 / full) * (one - middle)
    else:
        # Each side is extended by the same share of its growth; the share solves a quadratic
        # equation.
        (width, height), (wider, higher) = (np.diff(e.reshape(2, 2))[:, 0] for e in (one, other))
        linear = width * (higher - height) + height * (wider - width)
        square = (wider - width) * (higher - height)
        root = math.sqrt(linear**2 + 4.0 * square * (area_m2 - full))
        grown = one + min(1.0, (root - linear) / (2.0 * square)) * (other - one)
    a0, a1, b0, b1 = grown.tolist()
    return a0, a1, b0, b1


def _area_m2(extent: Sequence[float]) -> float:
    return (extent[1] - extent[0]) * (extent[3] - extent[2])


def _clipped(planes: list[TruePlane]) -> tuple[TruePlane, ...]:
    """Clip each outline to the room, and replace it by the bounding rectangle of the result."""
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
    """Return the part of a convex polygon (n, 3) in front of a plane (Sutherland-Hodgman)."""
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


def draw_wall(
    wall: Side,
    name: str,
    ground: Paint,
    span: tuple[float, float],
    rng: np.random.Generator,
    *,
    relief: float = 1.0,
    cloth: Extent | None = None,
) -> list[Extent]:
    """Build a random wall with relief up to 0.3 m high and recesses up to 0.45 m deep.

    The function returns the extents of the recesses.

    Niches and doors are added as separate planes.

    Args:
        wall: the wall.
        name: name of its plane.
        ground: background texture of the wall and of its niches.
        span: positions of the two adjoining walls, metres.
        rng: random generator for the objects.
        relief: scale of all relief.
        cloth: extent of a cloth with a repeated motif; recesses of the wall are also cut out of the
            cloth.
    """
    plane = wall.true_plane(name, _FULL)
    top_m = _draw_cornice(wall, relief, rng)
    holes = []
    for bay in _draw_pilasters(wall, span, top_m, relief, rng):
        label = f"{name} {len(wall.draft.planes)}"
        holes += _draw_bay(wall, label, (*bay, FLOOR_M, top_m), ground, relief, rng)
    cloths = [] if cloth is None else [cloth]
    for extent in cloths:
        wall.place(extent, 0.0, _DAMASK, SurfaceRole.WALL, plane=plane, holes=holes)
    wall.place(_FULL, 0.0, ground, SurfaceRole.WALL, plane=plane, holes=[*holes, *cloths])
    return holes


def _draw_plaques(
    wall: Side,
    span: tuple[float, float],
    n_plaques: int,
    holes: Sequence[Extent],
    relief: float,
    rng: np.random.Generator,
) -> None:
    """Add plaques to a wall beside its recesses: `n_plaques`, or as many as there is space for."""
    taken = list(holes)
    for _ in range(n_plaques):
        for _ in range(_PLAQUE_TRIES):
            width_m, height_m = rng.uniform(0.12, 0.45, 2)
            left_m = rng.uniform(span[0], span[1] - width_m)
            low_m = rng.uniform(FLOOR_M, CEILING_M - height_m)
            extent = (left_m, left_m + width_m, low_m, low_m + height_m)
            if not any(_overlap(extent, other) for other in taken):
                taken.append(extent)
                wall.box(extent, relief * rng.uniform(0.02, 0.15), (STUCCO, GILT)[rng.integers(2)])
                break


def _overlap(one: Extent, other: Extent) -> bool:
    return (
        one[0] < other[1] + _PLAQUE_GAP_M
        and other[0] < one[1] + _PLAQUE_GAP_M
        and one[2] < other[3] + _PLAQUE_GAP_M
        and other[2] < one[3] + _PLAQUE_GAP_M
    )


def _drawn_cloth(share: float, rng: np.random.Generator) -> Extent | None:
    if share <= 0.0:
        return None
    a0, a1 = _WALLS[0][2]
    width_m = math.sqrt(share * _MAIN_WALL_M2 * rng.uniform(1.2, 2.0))
    height_m = share * _MAIN_WALL_M2 / width_m
    left_m, low_m = rng.uniform(a0, a1 - width_m), rng.uniform(FLOOR_M, CEILING_M - height_m)
    return (left_m, left_m + width_m, low_m, low_m + height_m)


def _draw_cornice(wall: Side, relief: float, rng: np.random.Generator) -> float:
    """Build a cornice with up to three steps; return the height of its lower edge."""
    n_steps = int(rng.integers(0, 4))
    height_m, depth_m = rng.uniform(0.12, 0.45), relief * rng.uniform(0.06, 0.3)
    for step in range(n_steps):
        low_m = CEILING_M - height_m * (1.0 - step / n_steps)
        extent = (*_FULL[:2], low_m, CEILING_M + _BEYOND_M)
        wall.box(extent, depth_m * (step + 1) / n_steps, STUCCO)
    return CEILING_M - height_m if n_steps else CEILING_M


def _draw_pilasters(
    wall: Side, span: tuple[float, float], top_m: float, relief: float, rng: np.random.Generator
) -> list[tuple[float, float]]:
    """Build pilasters and skirting boards; return the bays between the pilasters."""
    a0, a1 = span
    n_inner, is_cornered = int(rng.integers(0, 4)), bool(rng.random() < 0.5)
    width_m, depth_m = rng.uniform(0.16, 0.4), relief * rng.uniform(0.03, 0.2)
    skirting_m, thick_m = rng.uniform(0.06, 0.25), relief * rng.uniform(0.01, 0.05)
    middles = np.linspace(a0, a1, n_inner + 2)[1:-1] + rng.uniform(-0.15, 0.15, n_inner)
    ends = [(middle - 0.5 * width_m, middle + 0.5 * width_m) for middle in middles]
    if is_cornered:
        ends = [(a0 - _BEYOND_M, a0 + width_m), *ends, (a1 - width_m, a1 + _BEYOND_M)]
    for left, right in ends:
        wall.box((left, right, FLOOR_M - _BEYOND_M, top_m), depth_m, STUCCO)
    starts = [right for _, right in ends][: -1 if is_cornered else None]
    stops = [left for left, _ in ends][1 if is_cornered else 0 :]
    if not is_cornered:
        starts, stops = [a0, *starts], [*stops, a1]
    bays = list(zip(starts, stops, strict=True))
    if rng.random() < 0.6:
        for left, right in bays:
            skirting = (left, right, FLOOR_M - _BEYOND_M, FLOOR_M + skirting_m)
            wall.box(skirting, thick_m, STUCCO)
    return bays


def _draw_bay(
    wall: Side, name: str, bay: Extent, ground: Paint, relief: float, rng: np.random.Generator
) -> list[Extent]:
    """Build a niche, a door, a panel or nothing in a bay; return the holes of the wall."""
    left, right, floor_m, top_m = bay
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
        wall.bars((a0, a1, low_m, high_m), 0.07, 0.03 * relief, GILT)
        return []
    low_m = low_m if kind == "niche" else floor_m - _BEYOND_M
    extent = (a0, a1, low_m, high_m)
    plane = wall.true_plane(f"{kind} in {name}", extent, -depth_m)
    return [wall.recess(extent, depth_m, ground if kind == "niche" else OAK, plane=plane)]
