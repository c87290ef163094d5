"""Where the simulated photographer stands, and with which camera: layouts of markiewicz2015."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.cameras import ViewingCamera, looking_at
from orthoflow_plugins.simulate.building import SceneDraft, Side
from orthoflow_plugins.simulate.palace import main_wall_axes, wall_sides

PhotoLayout = Literal["none", "quick", "variant1", "variant2"]

# Free of furniture and walls: along the main wall, towards it, and over the room's origin.
_FREE_LOW_M: Final = (-2.3, -1.65, -1.15)
_FREE_HIGH_M: Final = (2.3, 1.95, 1.3)
# Between floor and this height furniture stands behind the middle of the room.
_FURNITURE_M: Final = -0.45
_WORST_ROLL_DEG: Final = 3.0
_UP: Final = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, kw_only=True)
class Shot:
    """One photo to take.

    Attributes:
        name: file name.
        wall: name of the wall it is meant for.
        camera: the camera, room frame.
        gsd_m: side of a pixel on the wall where the optical axis meets it.
        obliquity_deg: angle between the optical axis and the wall's normal.
        roll_deg: turn about the optical axis.
    """

    name: str
    wall: str
    camera: ViewingCamera
    gsd_m: float
    obliquity_deg: float
    roll_deg: float


@dataclass(frozen=True, kw_only=True)
class ShotPlan:
    """What photos are wanted.

    Attributes:
        layout: which walls, and how many photos.
        gsd_m: side of a pixel on the wall.
        obliquity_deg: largest intended angle between optical axis and wall normal.
    """

    layout: PhotoLayout
    gsd_m: float
    obliquity_deg: float


@dataclass(frozen=True, kw_only=True)
class _Layout:
    """A camera and what it is pointed at.

    Attributes:
        footprint_m: width and height of a photo on the wall.
        distance_m: from the wall.
        targets: number of the wall, and (a, b) on it.
    """

    footprint_m: tuple[float, float]
    distance_m: float
    targets: tuple[tuple[int, float, float], ...]


def _block(
    wall: int, along: Sequence[float], up: Sequence[float]
) -> tuple[tuple[int, float, float], ...]:
    return tuple((wall, a, b) for b in up for a in along)


_LAYOUTS: Final = {
    # Six photos of the main wall that overlap by a quarter.
    "quick": _Layout(
        footprint_m=(2.4, 1.8),
        distance_m=2.6,
        targets=_block(0, (-1.75, 0.0, 1.75), (-0.65, 0.75)),
    ),
    # Eight photos, each of a whole wall; four walls.
    "variant1": _Layout(
        footprint_m=(5.9, 3.5),
        distance_m=3.95,
        targets=tuple((wall, a, 0.05) for wall in range(4) for a in (-0.1, 0.1)),
    ),
    # A block over the main wall: 70 % overlap along, 50 % across.
    "variant2": _Layout(
        footprint_m=(2.4, 1.8),
        distance_m=2.6,
        targets=_block(0, (-1.8, -1.08, -0.36, 0.36, 1.08, 1.8), (-0.8, 0.1, 1.0)),
    ),
}
_WALL_NAMES: Final = ("main wall", "opposite wall", "right wall", "left wall")


def planned_shots(plan: ShotPlan, rng: np.random.Generator) -> tuple[Shot, ...]:
    """Plan the photos of a layout; where exactly each is taken from hangs on the generator.

    The photographer aims at a place, but stands aside and holds the camera a little askew. All
    photos share one camera with Brown distortion.
    """
    if plan.layout == "none":
        return ()
    layout = _LAYOUTS[plan.layout]
    sides = wall_sides(SceneDraft())
    lens = _lens(layout, plan.gsd_m, rng)
    return tuple(
        _shot(f"photo_{place:02d}.jpg", layout, target, sides, lens, plan.obliquity_deg, rng)
        for place, target in enumerate(layout.targets)
    )


@dataclass(frozen=True, kw_only=True)
class _Lens:
    """Interior orientation: pixels, and k1, k2, p1, p2, k3."""

    width: int
    height: int
    focal: float
    cx: float
    cy: float
    distortion: NDArray[np.float64]


def _lens(layout: _Layout, gsd_m: float, rng: np.random.Generator) -> _Lens:
    width, height = (max(16, round(side / gsd_m)) for side in layout.footprint_m)
    off_centre = rng.uniform(-0.006, 0.006, 2) * width
    scatter = rng.uniform(-1.0, 1.0, 4)
    return _Lens(
        width=width,
        height=height,
        focal=layout.distance_m / gsd_m,
        cx=width / 2 + off_centre[0],
        cy=height / 2 + off_centre[1],
        distortion=np.array([-0.08, 0.02, 0.0, 0.0, 0.0])
        + np.array([0.01, 0.005, 0.0005, 0.0005, 0.0]) * np.append(scatter, 0.0),
    )


def _shot(
    name: str,
    layout: _Layout,
    target: tuple[int, float, float],
    sides: Sequence[Side],
    lens: _Lens,
    obliquity_deg: float,
    rng: np.random.Generator,
) -> Shot:
    wall, a, b = target
    side = sides[wall]
    a, b = np.array([a, b]) + rng.uniform(-0.02, 0.02, 2) * layout.footprint_m
    aim = side.foot + a * side.axis_a + b * side.axis_b
    tilt = math.radians(obliquity_deg) * rng.uniform(0.4, 1.0)
    turn = rng.uniform(0.0, 2.0 * math.pi)
    aside = math.cos(turn) * side.axis_a + math.sin(turn) * side.axis_b
    wanted = aim + layout.distance_m * (math.cos(tilt) * side.normal + math.sin(tilt) * aside)
    centre = _where_one_can_stand(wanted)
    roll_deg = float(rng.uniform(-_WORST_ROLL_DEG, _WORST_ROLL_DEG))
    rotation = _rolled(looking_at(centre, aim, _UP), roll_deg)
    return Shot(
        name=name,
        wall=_WALL_NAMES[wall],
        camera=ViewingCamera(
            width=lens.width,
            height=lens.height,
            fx=lens.focal,
            fy=lens.focal,
            cx=lens.cx,
            cy=lens.cy,
            distortion=lens.distortion,
            rotation=rotation,
            translation=-rotation @ centre,
        ),
        gsd_m=float(np.linalg.norm(aim - centre)) / lens.focal,
        obliquity_deg=math.degrees(math.acos(min(1.0, float(-rotation[2] @ side.normal)))),
        roll_deg=roll_deg,
    )


def _where_one_can_stand(wanted: NDArray[np.float64]) -> NDArray[np.float64]:
    """The nearest place to one (3,) that is inside the room and outside the furniture."""
    axes = np.vstack([main_wall_axes(), _UP])
    place = np.clip(axes @ wanted, _FREE_LOW_M, _FREE_HIGH_M)
    if place[1] < -0.35 or place[1] > 1.2:
        place[2] = max(place[2], _FURNITURE_M + (0.4 if place[1] > 1.2 else 0.0))
    standing: NDArray[np.float64] = axes.T @ place
    return standing


def _rolled(rotation: NDArray[np.float64], roll_deg: float) -> NDArray[np.float64]:
    cos, sin = math.cos(math.radians(roll_deg)), math.sin(math.radians(roll_deg))
    about_axis = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    rolled: NDArray[np.float64] = about_axis @ rotation
    return rolled
