"""Walls of a room: which slab each takes points from, and which is nearest to a point."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.products import Layers, Wall, Walls
from tests import samples

UP = np.array([0.0, 0.0, 1.0])


def wall_at(x_m: float, name: str) -> Wall:
    """2 m x 1 m at an x, seen from the east; its lower edge at z = 0, from y = 0 on."""
    frame = samples.facing_east(0.5, 4, 2, (x_m, 0.0, 1.0))
    return samples.wall(frame, name=name)


def walls(*given: Wall) -> Walls:
    return Walls(
        walls=given, up=UP, intensity_source="none", buffer_front_m=0.3, buffer_behind_m=0.1
    )


def test_walls_share_a_reach_or_have_their_own() -> None:
    room = walls(wall_at(0.0, "west"), wall_at(8.0, "east"))
    shared = room.slab(1)
    assert (shared.front_m, shared.behind_m) == (0.3, 0.1)
    assert shared.frame is room.walls[1].frame
    assert shared.n_cells == 8
    own = replace(room, buffers_m=((0.2, 0.4), (0.05, 0.6))).slab(1)
    assert (own.front_m, own.behind_m) == (0.05, 0.6)


@pytest.mark.parametrize(
    ("point_world", "index"),
    [
        ([1.0, 1.0, 0.5], 0),
        ([7.0, 1.0, 0.5], 1),
        # The rectangle counts, not its plane: 5 m along the one, 3 m in front of the other.
        ([0.0, 7.0, 0.5], 2),
    ],
    ids=["by-the-first", "by-the-second", "beside-the-first"],
)
def test_the_nearest_wall_is_that_of_the_nearest_rectangle(
    point_world: list[float], index: int
) -> None:
    turned = samples.facing_south(0.5, 4, 2, (2.0, 10.0, 1.0))
    room = walls(
        wall_at(0.0, "west"), wall_at(8.0, "east"), replace(wall_at(0.0, "north"), frame=turned)
    )
    points_world: NDArray[np.float64] = np.array([point_world])
    assert room.nearest(points_world).tolist() == [index]


def test_people_know_a_wall_by_its_plane_and_else_by_its_place() -> None:
    frame = samples.facing_east(0.5, 4, 2, (0.0, 0.0, 1.0))
    rgb = np.zeros((*frame.shape, 3), dtype=np.uint8)
    known = [
        samples.orthoimage(frame, wall=2, rgb=rgb, plane_index=plane).number
        for plane in (None, 0, 7)
    ]
    assert known == [2, 0, 7]


@pytest.mark.parametrize(
    ("counts", "apart_m"),
    [
        # As many points as cells, or more, of cells of half a metre.
        ([[1, 1, 1, 1], [1, 1, 1, 1]], 0.5),
        ([[7, 7, 7, 7], [1, 1, 1, 1]], 0.25),
        # One in four, half of the distance each way; fewer than one in ten say nothing more.
        ([[1, 0, 0, 0], [1, 0, 0, 0]], 1.0),
        ([[0, 0, 0, 0], [0, 0, 0, 0]], 0.5 / np.sqrt(0.1)),
    ],
)
def test_points_lie_as_far_apart_as_their_number_says(
    counts: list[list[int]], apart_m: float
) -> None:
    wall = replace(wall_at(0.0, "a"), count=np.array(counts, dtype=np.uint32))
    coarse = samples.wall(samples.facing_east(0.75, 4, 2, (3.0, 0.0, 1.0)), name="coarse")
    assert walls(coarse, wall).points_apart_m() == pytest.approx(apart_m)
    assert walls(coarse, wall).spacing_m() == pytest.approx(max(0.5, apart_m))


def test_points_of_cells_that_are_not_known_do_not_count() -> None:
    wall = wall_at(0.0, "a")
    depth_m = wall.depth_m.copy()
    depth_m[0, :2] = np.nan
    count = np.array([[50, 50, 1, 0], [0, 0, 1, 1]], dtype=np.uint32)
    some = samples.wall(wall.frame, depth_m=depth_m, count=count)
    # Three points on six cells.
    assert walls(some).spacing_m() == pytest.approx(0.5 * np.sqrt(2.0))
    nothing = samples.wall(wall.frame, depth_m=np.full_like(depth_m, np.nan))
    assert walls(nothing).spacing_m() == 0.5


def test_layers_say_how_people_call_their_walls() -> None:
    layers = Layers(layers=(), names=("west",), plane_indices=(4, 6))
    assert [layers.number(wall) for wall in range(3)] == [4, 6, 2]
    assert [layers.name(wall) for wall in range(3)] == ["west", "wall 6", "wall 2"]
