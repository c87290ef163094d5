"""Walls of a family: whatever is drawn fits between floor, ceiling and neighbours, and varies."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from orthoflow_plugins.simulate.building import (
    Extent,
    Paint,
    SceneDraft,
    Side,
    Surface,
    TruePlane,
    wall_side,
)
from orthoflow_plugins.simulate.room_model import GILT as PANEL
from orthoflow_plugins.simulate.room_model import OAK as DOOR
from orthoflow_plugins.simulate.room_model import STUCCO as RELIEF
from orthoflow_plugins.simulate.room_model import draw_wall

from orthoflow.geometry.scenes import SurfaceRole, TextureKind

FULL: Extent = (-2.9, 2.9, -1.6, 1.7)
SHOWN: Extent = (-2.7, 2.7, -1.5, 1.6)
N_WALLS = 300
GROUND = Paint(TextureKind.PLAIN, (1.0, 0.0, 0.0), 0.5)


@dataclass(frozen=True)
class Drawn:
    """A wall taken apart: depth and extent of what lies along it, by paint, and its holes."""

    side: Side
    wall: Surface
    planes: list[TruePlane]
    stone: list[tuple[float, Extent]]
    panels: list[tuple[float, Extent]]
    recesses: list[tuple[float, Extent, Paint]]


def drawn(seed: int) -> Drawn:
    side = wall_side(SceneDraft(), omega_deg=90.0, phi_deg=0.0, distance_m=2.0)
    draw_wall(side, "wall", GROUND, SHOWN[:2], np.random.default_rng(seed))
    (wall,) = [item for item in side.draft.surfaces if item.role == SurfaceRole.WALL]

    def along(role: SurfaceRole) -> list[tuple[float, Surface]]:
        return [
            (float((item.centre - side.foot) @ side.normal), item)
            for item in side.draft.surfaces
            if item.role == role and abs(float(item.axis_b @ side.normal)) < 0.5
        ]

    relief_of = along(SurfaceRole.RELIEF)
    return Drawn(
        side=side,
        wall=wall,
        planes=side.draft.planes,
        stone=[(depth, item.extent) for depth, item in relief_of if item.paint is RELIEF],
        panels=[(depth, item.extent) for depth, item in relief_of if item.paint is PANEL],
        recesses=[(depth, item.extent, item.paint) for depth, item in along(SurfaceRole.RECESS)],
    )


@cache
def all_drawn() -> tuple[Drawn, ...]:
    return tuple(drawn(seed) for seed in range(N_WALLS))


def is_cornice(extent: Extent) -> bool:
    return extent[:2] == FULL[:2]


def overlap(one: Extent, other: Extent) -> bool:
    return (
        one[0] < other[1] - 1e-9
        and other[0] < one[1] - 1e-9
        and one[2] < other[3] - 1e-9
        and other[2] < one[3] - 1e-9
    )




def test_relief_and_recesses_are_as_deep_as_the_family_says() -> None:
    outwards = np.array([depth for found in all_drawn() for depth, _ in found.stone])
    niches = np.array([-d for w in all_drawn() for d, _, paint in w.recesses if paint is GROUND])
    doors = np.array([-d for w in all_drawn() for d, _, paint in w.recesses if paint is DOOR])
    # Up to 0.3 m before the wall and 0.45 m behind it, and nearly that now and then.
    assert 0.28 < outwards.max() <= 0.3
    assert 0.4 < doors.max() <= 0.45
    assert 0.31 < niches.max() <= 0.35
    assert doors.min() >= 0.05
    assert niches.min() >= 0.05
    assert min(doors.min(), niches.min()) < 0.07
    assert {round(d, 9) for found in all_drawn() for d, _ in found.panels} == {0.03}


def test_recesses_are_holes_of_the_wall_with_planes_of_their_own() -> None:
    kinds: Counter[str] = Counter()
    for found in all_drawn():
        holes = list(found.wall.holes)
        assert holes == [extent for _, extent, _ in found.recesses]
        whole, *planes = found.planes
        assert whole.name == "wall"
        assert found.wall.plane == 0
        assert len({plane.name for plane in planes}) == len(planes) == len(holes)
        for plane, (depth, extent, paint) in zip(planes, found.recesses, strict=True):
            kind = plane.name.split(" in ")[0]
            assert (kind == "niche") == (paint is GROUND)
            assert kind in {"niche", "door"}
            assert plane.name.split(" in ")[1].startswith("wall ")
            expected = depth + float(whole.plane.distances_m(found.side.foot[None])[0])
            assert float(whole.plane.distances_m(plane.outline)[0]) == pytest.approx(expected)
            kinds[kind] += 1
            # A door begins under the floor, a niche stands on a sill.
            sill = extent[2] - SHOWN[2]
            assert sill == pytest.approx(-0.1) if kind == "door" else 0.3 <= sill <= 0.7
            assert extent[1] - extent[0] <= 1.3
        kinds["panel"] += len(found.panels) // 4
        for one, other in pairwise(holes):
            assert not overlap(one, other)
    # Each kind as likely; the fourth is bare.
    assert max(kinds.values()) < 1.6 * min(kinds.values())
