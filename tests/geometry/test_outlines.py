"""Outlines of a room: how near walls must come to join, and what is relief on another."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from orthoflow.geometry.frames import Plane
from orthoflow.geometry.outlines import RoomOutline, room_outline

UP = np.array([0.0, 0.0, 1.0])
# 8 x 6 m, 3 m high; walls are seen from inside.
SIZE = (8.0, 6.0, 3.0)


def wall(
    left: tuple[float, float], right: tuple[float, float], low: float = 0.0
) -> NDArray[np.float64]:
    """Top left, bottom left, bottom right, top right."""
    (a, b), (c, d) = left, right
    return np.array([[a, b, 3.0], [a, b, low], [c, d, low], [c, d, 3.0]])


def walls(gap: float) -> list[NDArray[np.float64]]:
    """Walls whose points end before their corners."""
    x, y, _ = SIZE
    return [
        wall((gap, y), (x - gap, y)),
        wall((x, y - gap), (x, gap)),
        wall((x - gap, 0.0), (gap, 0.0)),
        wall((0.0, gap), (0.0, y - gap)),
    ]


FLOOR = np.array([[0.0, 6.0, 0.0], [0.0, 0.0, 0.0], [8.0, 0.0, 0.0], [8.0, 6.0, 0.0]])
CEILING = np.array([[0.0, 0.0, 3.0], [0.0, 6.0, 3.0], [8.0, 6.0, 3.0], [8.0, 0.0, 3.0]])


def outline(*quads: NDArray[np.float64], turned_deg: float = 0.0) -> RoomOutline:
    """Of planes through rectangles, towards who sees their corners counter-clockwise."""
    turn = Rotation.from_euler("z", turned_deg, degrees=True).as_matrix()
    moved = np.array(quads) @ turn.T + [100.0, 200.0, 10.0]
    planes = []
    for quad in moved:
        normal = np.cross(quad[1] - quad[0], quad[3] - quad[0])
        normal /= np.linalg.norm(normal)
        planes.append(Plane(normal=normal, offset_m=float(normal @ quad.mean(axis=0))))
    found = room_outline(planes, moved, UP)
    back = [(chain - [100.0, 200.0, 10.0]) @ turn for chain in found.chains_world]
    faces = (found.faces_world - [100.0, 200.0, 10.0]) @ turn
    return RoomOutline(
        walls=found.walls,
        chains_world=tuple(back),
        closed=found.closed,
        faces_world=faces,
        floor_m=found.floor_m - 10.0,
    )


def ring(points: NDArray[np.float64]) -> set[tuple[float, ...]]:
    return {tuple(np.round(point, 6) + 0.0) for point in points}


CORNERS = {(0.0, 0.0, 0.0), (8.0, 0.0, 0.0), (8.0, 6.0, 0.0), (0.0, 6.0, 0.0)}


@pytest.mark.parametrize("turned_deg", [0.0, 37.0, 200.0])
def test_walls_join_where_their_lines_cross_within_a_metre(turned_deg: float) -> None:
    near = outline(*walls(0.95), FLOOR, CEILING, turned_deg=turned_deg)
    assert near.closed == (True,)
    assert sorted(near.walls) == [0, 1, 2, 3]
    assert ring(near.chains_world[0]) == CORNERS
    # Each face reaches from corner to corner, from floor to ceiling.
    for index, face in zip(near.walls, near.faces_world, strict=True):
        np.testing.assert_allclose(face, walls(0.0)[index], atol=1e-9)
    far = outline(*walls(1.05), FLOOR, CEILING, turned_deg=turned_deg)
    assert far.closed == far.chains_world == far.walls == ()
    assert far.faces_world.shape == (0, 4, 3)


def test_a_short_wall_is_not_prolonged_by_more_than_its_half() -> None:
    # A pier of 1.5 m, whose neighbour's line crosses a little more than its half beyond its end.
    x, y, _ = SIZE
    for apart, n_joined in ((0.7, 2), (0.8, 0)):
        pier = wall((x, y - apart), (x, y - apart - 1.5))
        found = outline(walls(0.2)[0], pier, FLOOR)
        assert len(found.walls) == n_joined


def test_an_open_chain_begins_and_ends_where_the_points_do() -> None:
    back, right, front, _ = walls(0.3)
    found = outline(back, right, front)
    assert found.closed == (False,)
    (chain,) = found.chains_world
    assert ring(chain) == {(0.3, 6.0, 0.0), (8.0, 6.0, 0.0), (8.0, 0.0, 0.0), (0.3, 0.0, 0.0)}
    assert len(chain) == 4
    # Without a floor the lowest wall tells its height, without a ceiling walls end as their points.
    raised = outline(*(quad + np.array([0.0, 0.0, 0.25]) for quad in (back, right)))
    assert raised.floor_m == pytest.approx(0.25)
    for index, face in zip(found.walls, found.faces_world, strict=True):
        np.testing.assert_allclose(face[:, 2], [3.0, 0.0, 0.0, 3.0], atol=1e-9)
        assert index in (0, 1, 2)


@pytest.mark.parametrize(
    ("before_m", "left", "is_relief"),
    [
        (0.45, (2.0, 4.0), True),
        (0.55, (2.0, 4.0), False),
        (-0.45, (2.0, 4.0), True),
        # More than half of it lies before the larger one.
        (0.3, (-0.9, 1.1), True),
        (0.3, (-1.1, 0.9), False),
    ],
)
def test_half_a_metre_before_a_wall_is_relief_on_it(
    before_m: float, left: tuple[float, float], *, is_relief: bool
) -> None:
    x, y, _ = SIZE
    panel = wall((left[0], y - before_m), (left[1], y - before_m))
    # A wall beside the panel, which would join it were it one of its own.
    beside = wall((left[1], y - before_m - 0.1), (left[1], y - before_m - 2.0))
    back = wall((0.0, y), (x, y))
    found = outline(back, panel, beside)
    assert (1 in found.walls) is not is_relief


def test_walls_that_face_each_other_are_two() -> None:
    # Both sides of a wall 0.3 m thick.
    x, y, _ = SIZE
    one, other = wall((0.0, y), (x, y)), wall((x, y + 0.3), (0.0, y + 0.3))
    side = wall((x, y + 0.3), (x, y + 4.0))
    found = outline(one, other, side)
    assert 1 in found.walls


@pytest.mark.parametrize(("lean_deg", "is_wall"), [(9.5, True), (10.5, False)])
def test_walls_are_upright_to_ten_degrees(lean_deg: float, *, is_wall: bool) -> None:
    quads = walls(0.1)
    lean = 3.0 * np.tan(np.radians(lean_deg))
    quads[0] = quads[0] - [[0.0, lean, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, lean, 0.0]]
    found = outline(*quads, FLOOR)
    assert (0 in found.walls) is is_wall


@pytest.mark.parametrize(("tilt_deg", "is_floor"), [(9.5, True), (10.5, False)])
def test_the_largest_level_plane_is_the_floor(tilt_deg: float, *, is_floor: bool) -> None:
    rise = 8.0 * np.tan(np.radians(tilt_deg))
    ramp = FLOOR + np.outer([0.0, 0.0, rise, rise], UP) - 0.5 * UP
    step = 0.3 * FLOOR + [0.0, 0.0, 0.4]
    found = outline(*walls(0.1), step, ramp)
    # A step is smaller than the ramp, and is the floor where that is none.
    assert found.floor_m == pytest.approx(0.5 * rise - 0.5 if is_floor else 0.4)


@pytest.mark.parametrize("slope", [0.0, 0.08, -0.08])
def test_walls_reach_up_to_a_ceiling_that_slopes(slope: float) -> None:
    sloping = CEILING + np.outer(CEILING[:, 0], [0.0, 0.0, slope])
    found = outline(*walls(0.5), FLOOR, sloping)
    corners = found.faces_world.reshape(-1, 3)
    top, bottom = found.faces_world[:, [0, 3]].reshape(-1, 3), found.faces_world[:, [1, 2]]
    np.testing.assert_allclose(top[:, 2], 3.0 + slope * top[:, 0], atol=1e-6)
    np.testing.assert_allclose(bottom[..., 2], 0.0, atol=1e-6)
    assert ring(corners * [1.0, 1.0, 0.0]) == CORNERS
