"""Where planes of a room meet, and outlines: how near walls must come to join, what is relief."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from orthoflow.errors import InputError
from orthoflow.files.drawings.key_plans import outline_of, surfaces_of
from orthoflow.geometry.frames import Plane
from orthoflow.geometry.outlines import (
    RoomOutline,
    Surface,
    corners_between,
    edges_between,
    line_of,
    room_outline,
)
from tests import samples
from tests.drawing_runs import CORNER, GAP_M, SIZE_M, box_planes, box_points

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


# Survey coordinates of 5e6 m have 1e-9 m in float64; solving a system loses a little.
_EXACT_M = 1e-7


def test_a_box_has_twelve_edges_each_as_long_as_both_planes_are_known() -> None:
    edges = edges_between(surfaces_of(box_planes()))
    lengths = sorted(edge.length_m for edge in edges)
    expected = sorted(4 * [side - 2 * GAP_M for side in SIZE_M])
    np.testing.assert_allclose(lengths, expected, atol=_EXACT_M)


def test_a_box_has_eight_corners() -> None:
    surfaces = surfaces_of(box_planes())
    corners = corners_between(surfaces, edges_between(surfaces))
    expected = box_points(np.array(list(product(*((0.0, side) for side in SIZE_M)))))
    found = np.array([corner.point_world for corner in corners])
    assert found.shape == (8, 3)
    assert cdist(expected, found).min(axis=1).max() < _EXACT_M


def test_planes_that_end_far_from_each_other_have_no_edge() -> None:
    surfaces = surfaces_of(box_planes())
    assert edges_between(surfaces, reach_m=GAP_M - 0.01) == ()
    assert len(edges_between(surfaces, reach_m=GAP_M + 0.01)) == 12


def test_an_edge_alone_has_no_corner() -> None:
    surfaces = surfaces_of(box_planes())
    edges = edges_between(surfaces)
    assert corners_between(surfaces, edges[:1]) == ()
    # Nor do three of which two do not adjoin.
    first = edges[0]
    apart = [edge for edge in edges if first.first in (edge.first, edge.second)]
    assert corners_between(surfaces, apart) == ()


def test_nearly_parallel_planes_meet_nowhere() -> None:
    up = Plane(normal=np.array([0.0, 0.0, 1.0]), offset_m=0.0)
    for angle, meets in ((19.0, False), (21.0, True)):
        radians = np.radians(angle)
        other = Plane(normal=np.array([np.sin(radians), 0.0, np.cos(radians)]), offset_m=0.0)
        assert (line_of(up, other) is not None) == meets


def test_parts_of_a_plane_have_edges_of_their_own() -> None:
    floor = np.array([[0.0, 4.0, 0.0], [0.0, 0.0, 0.0], [6.0, 0.0, 0.0], [6.0, 4.0, 0.0]])

    def part(begin: float, end: float) -> list[list[float]]:
        return [[begin, 0, 2], [begin, 0, 0], [end, 0, 0], [end, 0, 2]]

    surfaces = (
        Surface(
            plane=Plane(normal=np.array([0.0, 0.0, 1.0]), offset_m=0.0),
            rectangles_world=floor[None],
        ),
        Surface(
            plane=Plane(normal=np.array([0.0, 1.0, 0.0]), offset_m=0.0),
            rectangles_world=np.array(
                [part(0, 2), part(1.5, 2.5), part(4, 5), part(5.2, 5.29), part(5.5, 5.61)]
            ),
        ),
    )
    spans = sorted(sorted(edge.ends_world[:, 0].tolist()) for edge in edges_between(surfaces))
    # Overlapping parts are one, and what is shorter than a hand is none.
    np.testing.assert_allclose(spans, [[0.0, 2.5], [4.0, 5.0], [5.5, 5.61]])


def test_a_room_whose_up_is_x_has_the_same_outline() -> None:
    planes = box_planes()
    turn = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    turned = [
        Plane(normal=turn @ planes.normal[k], offset_m=float(planes.offset[k])) for k in range(6)
    ]
    outline = room_outline(turned, planes.corners @ turn.T, turn @ planes.up)
    straight = outline_of(planes)
    assert outline.closed == straight.closed == (True,)
    assert straight.floor_m == pytest.approx(CORNER[2], abs=_EXACT_M)
    found = np.array(outline.chains_world[0]) @ turn
    x, y, _ = SIZE_M
    expected = box_points(np.array([[0, 0, 0], [x, 0, 0], [x, y, 0], [0, y, 0]], dtype=float))
    assert len(expected) == len(found) == len(straight.chains_world[0])
    for chain in (found, straight.chains_world[0]):
        assert cdist(expected, chain).min(axis=1).max() < _EXACT_M


def test_more_planes_or_parts_than_a_drawing_bears_are_refused() -> None:
    few = box_planes()
    in_parts = replace(
        few,
        part_corners=np.repeat(few.corners[:1], 20_001, axis=0),
        part_plane=np.zeros(20_001, np.int32),
    )
    many = samples.planes(
        normal=np.repeat(few.normal[:1], 201, axis=0),
        offset=np.repeat(few.offset[:1], 201),
        corners=np.repeat(few.corners[:1], 201, axis=0),
        names=("wall",) * 201,
    )
    for planes in (many, in_parts):
        for work in (surfaces_of, outline_of):
            with pytest.raises(InputError, match=r"planes with .* connected parts; at most"):
                work(planes)
