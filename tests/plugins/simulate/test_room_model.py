"""The simulated room: closed, without collisions, and with surfaces that meet."""

from __future__ import annotations

import itertools
from collections import Counter
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.simulate.building import (
    Extent,
    Paint,
    SceneDraft,
    Side,
    Surface,
    TruePlane,
    wall_side,
)
from orthoflow_plugins.simulate.room_model import (
    DESIGNED,
    MOST_TEXTILE,
    Room,
    build_room,
    draw_wall,
)
from orthoflow_plugins.simulate.room_model import GILT as PANEL
from orthoflow_plugins.simulate.room_model import STUCCO as RELIEF

from orthoflow.geometry.scenes import SurfaceRole, TextureKind
from tests.scene_rays import cast

WALLS = ("main wall", "opposite wall", "right wall", "left wall")


@cache
def room(**changes: float) -> Room:
    return build_room(**changes)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Along:
    """Rectangles parallel to a wall: depth in front of it (n,), extent (n, 4), role and texture."""

    depth_m: NDArray[np.float64]
    extent: NDArray[np.float64]
    role: NDArray[np.uint8]
    texture: NDArray[np.int32]
    holes: list[Extent]


def along(built: Room, name: str) -> Along:
    """Return the rectangles parallel to a wall, with extents relative to its foot."""
    side = DESIGNED.sides(SceneDraft())[WALLS.index(name)]
    scene = built.scene
    parallel = np.abs(scene.normal @ side.normal) > 1.0 - 1e-9
    parallel &= np.isclose(np.abs(scene.axis_a @ side.axis_a), 1.0)
    off = (scene.centre - side.foot) @ side.normal
    chosen = np.flatnonzero(parallel & (np.abs(off) < 0.5) & (scene.role != SurfaceRole.OBJECT))
    (wall,) = (k for k in chosen if scene.role[k] == SurfaceRole.WALL and scene.extent[k, 1] > 2.8)
    holes = scene.hole_extent[scene.hole_rectangle == wall]
    return Along(
        depth_m=off[chosen],
        extent=scene.extent[chosen],
        role=scene.role[chosen],
        texture=scene.texture[chosen],
        holes=[tuple(hole) for hole in holes],  # type: ignore[misc]
    )


def overlaps(one: NDArray[np.float64] | Extent, other: NDArray[np.float64] | Extent) -> bool:
    slack = 1e-9
    return bool(
        one[0] < other[1] - slack
        and other[0] < one[1] - slack
        and one[2] < other[3] - slack
        and other[2] < one[3] - slack
    )


def area_m2(extent: NDArray[np.float64] | Extent) -> float:
    return float((extent[1] - extent[0]) * (extent[3] - extent[2]))


def test_whoever_stands_in_the_room_sees_no_way_out() -> None:
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for start in ((0.0, 0.0, 0.0), (1.2, 0.9, 1.2), (-1.0, -1.2, -0.6)):
        hits = cast(room().scene, np.tile(start, (4000, 1)), directions)
        assert (hits.rectangle >= 0).all()
        reached = start + hits.t[:, None] * directions
        # In a room of 5.4 m x 4.4 m x 3.1 m, nothing is farther away than the corners.
        assert np.linalg.norm(reached, axis=1).max() < 4.2


def test_no_wall_is_quite_square_to_the_next_and_the_main_one_leans() -> None:
    sides = DESIGNED.sides(SceneDraft())
    main = sides[0]
    assert np.degrees(np.arctan2(*-main.normal[1::-1])) == pytest.approx(102.0)
    assert np.degrees(np.arcsin(-main.normal[2])) == pytest.approx(0.8)
    for one, other in itertools.combinations(sides, 2):
        angle = np.degrees(np.arccos(one.normal @ other.normal))
        off = min(abs(angle - 90.0), abs(angle - 180.0))
        assert 0.05 < off < 1.5


def test_relief_scales_mouldings_and_nothing_else() -> None:
    flat, usual, double = (room(relief=scale) for scale in (0.0, 1.0, 2.0))
    for name in WALLS:
        one, two = along(usual, name), along(double, name)
        np.testing.assert_array_equal(one.extent, two.extent)
        moulded = (one.role == SurfaceRole.RELIEF) & (one.depth_m > 0.0)
        if name == "left wall":
            # The fireplace and its hearth are not mouldings.
            still = np.isclose(one.depth_m, 0.28) | np.isclose(one.depth_m, 0.03)
            moulded &= ~still
        np.testing.assert_allclose(two.depth_m[moulded], 2.0 * one.depth_m[moulded])
        in_door = (one.depth_m < -0.05) & (one.depth_m > -0.115)
        np.testing.assert_allclose(two.depth_m[in_door] + 0.12, 2.0 * (one.depth_m[in_door] + 0.12))
        rest = ~moulded & ~in_door
        np.testing.assert_allclose(two.depth_m[rest], one.depth_m[rest])
        assert one.depth_m.max() == pytest.approx(0.28 if name == "left wall" else 0.15)
        bare = along(flat, name)
        assert not np.any(bare.depth_m > 0.3)
        assert np.count_nonzero(bare.depth_m > 0.0) == (2 if name == "left wall" else 0)


@pytest.mark.parametrize("share", [0.0, 0.04, 0.095, 0.22, MOST_TEXTILE])
def test_cloth_covers_as_much_of_the_main_wall_as_asked(share: float) -> None:
    found = along(room(textile_share=share), "main wall")
    cloths = found.extent[found.texture == TextureKind.TEXTILE]
    assert sum(map(area_m2, cloths)) == pytest.approx(share * 16.7, abs=1e-6)
    for one, other in itertools.combinations(found.holes, 2):
        assert not overlaps(one, other)
    for cloth in cloths:
        assert any(np.allclose(cloth, hole) for hole in found.holes)
        assert area_m2(cloth) > 0.0
        # Above the skirting board and below the cornice.
        assert cloth[2] >= -1.32
        assert cloth[3] <= 1.3


PAINT = Paint(kind=TextureKind.PLAIN, rgb=(10.0, 20.0, 30.0), reflectance=0.4)
EXTENT: Extent = (-0.5, 1.0, 0.25, 0.75)
Corner = tuple[float, ...]


def a_wall() -> Side:
    return wall_side(SceneDraft(), omega_deg=102.0, phi_deg=0.8, distance_m=2.4)


def corners_of(surface: Surface) -> NDArray[np.float64]:
    a0, a1, b0, b1 = surface.extent
    return np.array(
        [
            surface.centre + a * surface.axis_a + b * surface.axis_b
            for a in (a0, a1)
            for b in (b0, b1)
        ]
    )


def on_wall(side: Side, surface: Surface) -> frozenset[Corner]:
    """Return the corners of a rectangle: right, up and in front of the wall, metres."""
    off = corners_of(surface) - side.foot
    axes = np.stack([side.axis_a, side.axis_b, side.normal])
    return frozenset(tuple(np.round(corner, 9) + 0.0) for corner in off @ axes.T)


def cuboid(extent: Extent, low_m: float, high_m: float) -> dict[str, frozenset[Corner]]:
    """Return the faces of a box parallel to a wall, each as its corners."""
    a0, a1, b0, b1 = extent
    corners = list(itertools.product((a0, a1), (b0, b1), (low_m, high_m)))
    places = {"left": (0, a0), "right": (0, a1), "low": (1, b0), "high": (1, b1)}
    ends = {"back": (2, low_m), "front": (2, high_m)}
    return {
        name: frozenset(corner for corner in corners if corner[axis] == value)
        for name, (axis, value) in {**places, **ends}.items()
    }


SIDES = ("left", "right", "low", "high")


def test_a_box_is_closed_but_for_its_back() -> None:
    side = a_wall()
    side.box(EXTENT, 0.1, PAINT)
    faces = cuboid(EXTENT, 0.0, 0.1)
    found = [on_wall(side, surface) for surface in side.draft.surfaces]
    assert len(found) == 5
    assert set(found) == {faces[name] for name in (*SIDES, "front")}
    assert {surface.role for surface in side.draft.surfaces} == {SurfaceRole.RELIEF}
    assert {surface.plane for surface in side.draft.surfaces} == {-1}


def test_a_recess_leads_from_the_wall_to_its_back_and_needs_a_hole_of_its_size() -> None:
    side = a_wall()
    plane = side.true_plane("niche", EXTENT, -0.25)
    assert side.recess(EXTENT, 0.25, PAINT, plane=plane) == EXTENT
    faces = cuboid(EXTENT, -0.25, 0.0)
    back, *rims = side.draft.surfaces
    assert on_wall(side, back) == faces["back"]
    assert {on_wall(side, rim) for rim in rims} == {faces[name] for name in SIDES}
    assert len(rims) == 4
    assert (back.plane, {rim.plane for rim in rims}) == (0, {-1})
    assert {surface.role for surface in (back, *rims)} == {SurfaceRole.RECESS}
    (true,) = side.draft.planes
    assert true.name == "niche"
    np.testing.assert_allclose(true.plane.distances_m(corners_of(back)), 0.0, atol=1e-12)
    np.testing.assert_allclose(true.plane.normal, side.normal)
    # Corners are counter-clockwise for the viewer, beginning at the top left.
    a0, a1, b0, b1 = EXTENT
    expected = [
        side.foot - 0.25 * side.normal + a * side.axis_a + b * side.axis_b
        for a, b in ((a0, b1), (a0, b0), (a1, b0), (a1, b1))
    ]
    np.testing.assert_allclose(true.outline, expected, atol=1e-12)
    assert side.true_plane("next", EXTENT) == 1
    np.testing.assert_allclose(
        side.draft.planes[1].plane.distances_m(side.foot[None]), 0.0, atol=1e-12
    )


SHOWN: Extent = (-2.7, 2.7, -1.5, 1.6)
GROUND = Paint(TextureKind.PLAIN, (1.0, 0.0, 0.0), 0.5)


@dataclass(frozen=True)
class Drawn:
    """Parts of a wall: depths and extents of its rectangles, by paint, and its holes."""

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


def test_recesses_are_holes_of_the_wall_with_planes_of_their_own() -> None:
    kinds: Counter[str] = Counter()
    for found in map(drawn, range(300)):
        holes = list(found.wall.holes)
        assert holes == [extent for _, extent, _ in found.recesses]
        whole, *planes = found.planes
        assert whole.name == "wall"
        assert found.wall.plane == 0
        assert len({plane.name for plane in planes}) == len(planes) == len(holes)
        for plane, (depth, extent, paint) in zip(planes, found.recesses, strict=True):
            kind = plane.name.split(" in ")[0]
            assert (kind == "niche") == (paint is GROUND)
            assert 0.05 <= -depth <= (0.35 if kind == "niche" else 0.45)
            assert kind in {"niche", "door"}
            assert plane.name.split(" in ")[1].startswith("wall ")
            expected = depth + float(whole.plane.distances_m(found.side.foot[None])[0])
            assert float(whole.plane.distances_m(plane.outline)[0]) == pytest.approx(expected)
            kinds[kind] += 1
            # A door begins below the floor, a niche has a sill.
            sill = extent[2] - SHOWN[2]
            assert sill == pytest.approx(-0.1) if kind == "door" else 0.3 <= sill <= 0.7
            assert extent[1] - extent[0] <= 1.3
        kinds["panel"] += len(found.panels) // 4
        # Relief is up to 0.3 m in front of the wall; panels are 3 cm.
        assert all(0.0 < depth_m <= 0.3 for depth_m, _ in found.stone)
        assert all(depth_m == pytest.approx(0.03) for depth_m, _ in found.panels)
        for one, other in pairwise(holes):
            assert not overlaps(one, other)
    # All kinds are equally likely; the fourth is empty.
    assert max(kinds.values()) < 1.6 * min(kinds.values())
