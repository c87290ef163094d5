"""The simulated room as a builder would check it: closed, nothing in the way, everything flush."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.simulate.building import Extent, SceneDraft
from orthoflow_plugins.simulate.room_model import (
    CEILING_M,
    DESIGNED,
    MOST_TEXTILE,
    Room,
    build_room,
    main_wall_axes,
)

from orthoflow.geometry.scenes import SurfaceRole, TextureKind
from tests.scene_rays import cast

WALLS = ("main wall", "opposite wall", "right wall", "left wall")


@cache
def room(**changes: float) -> Room:
    return build_room(**changes)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Along:
    """What lies along a wall: depth before it (n,), extent (n, 4), role and texture."""

    depth_m: NDArray[np.float64]
    extent: NDArray[np.float64]
    role: NDArray[np.uint8]
    texture: NDArray[np.int32]
    holes: list[Extent]


def along(built: Room, name: str) -> Along:
    """Rectangles of a room along a wall, their extents from the wall's own foot."""
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
        # A room of 5.4 m by 4.4 m by 3.1 m: nothing in it is farther off than its corners.
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
    axes = main_wall_axes()
    np.testing.assert_allclose(axes @ axes.T, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(axes[0], main.axis_a)
    assert axes[1] @ -main.normal > 0.999
    assert axes[1, 2] == 0.0


@pytest.mark.parametrize("name", WALLS)
def test_every_hole_of_a_wall_is_closed_by_what_lies_in_or_behind_it(name: str) -> None:
    found = along(room(), name)
    for hole in found.holes:
        behind = [
            k
            for k in range(len(found.depth_m))
            if np.allclose(found.extent[k], hole) and found.depth_m[k] <= 1e-9
        ]
        assert len(behind) == 1
        # Inside the wall, over the floor's edge at most.
        assert hole[0] > -2.7
        assert hole[1] < 2.7
        assert hole[3] < CEILING_M
    for one, other in itertools.combinations(found.holes, 2):
        assert not overlaps(one, other)
    assert len(found.holes) == {"main wall": 3, "opposite wall": 2}.get(name, 0)


def test_relief_scales_mouldings_and_nothing_else() -> None:
    flat, usual, double = (room(relief=scale) for scale in (0.0, 1.0, 2.0))
    for name in WALLS:
        one, two = along(usual, name), along(double, name)
        np.testing.assert_array_equal(one.extent, two.extent)
        moulded = (one.role == SurfaceRole.RELIEF) & (one.depth_m > 0.0)
        if name == "left wall":
            # The fireplace and its hearth are no mouldings.
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
        # Over the skirting and under the cornice.
        assert cloth[2] >= -1.32
        assert cloth[3] <= 1.3
