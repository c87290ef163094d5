"""Where planes of a room meet, and the outline that its walls make: a box is known exactly."""

from __future__ import annotations

import time
from dataclasses import replace
from itertools import combinations, product

import numpy as np
import pytest

from orthoflow.errors import InputError
from orthoflow.files.drawings.key_plans import outline_of, surfaces_of
from orthoflow.geometry.frames import Plane
from orthoflow.geometry.outlines import (
    Surface,
    corners_between,
    edges_between,
    line_of,
    room_outline,
)
from orthoflow.products import Planes
from tests import samples
from tests.drawing_runs import CORNER, GAP_M, SIZE_M, box_planes, box_points

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
    for point in expected:
        assert np.linalg.norm(found - point, axis=1).min() < _EXACT_M


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


def test_the_outline_of_a_box_is_its_rectangle_at_the_height_of_the_floor() -> None:
    outline = outline_of(box_planes())
    assert outline.closed == (True,)
    assert outline.floor_m == pytest.approx(CORNER[2], abs=_EXACT_M)
    assert sorted(outline.walls) == [2, 3, 4, 5]
    x, y, _ = SIZE_M
    expected = box_points(np.array([[0, 0, 0], [x, 0, 0], [x, y, 0], [0, y, 0]], dtype=float))
    (chain,) = outline.chains_world
    for point in expected:
        assert np.linalg.norm(chain - point, axis=1).min() < _EXACT_M


def test_faces_of_walls_reach_from_corner_to_corner_and_look_into_the_room() -> None:
    planes = box_planes()
    outline = outline_of(planes)
    for index, face in zip(outline.walls, outline.faces_world, strict=True):
        normal = np.cross(face[1] - face[0], face[3] - face[0])
        width, height = np.linalg.norm(face[3] - face[0]), np.linalg.norm(face[1] - face[0])
        assert height == pytest.approx(SIZE_M[2], abs=_EXACT_M)
        assert min(abs(width - side) for side in SIZE_M[:2]) < _EXACT_M
        np.testing.assert_allclose(normal / np.linalg.norm(normal), planes.normal[index], atol=1e-9)


def test_walls_that_are_not_closed_keep_their_free_ends() -> None:
    planes = box_planes()
    kept = [0, 1, 2, 3]
    outline = room_outline([planes.plane(k) for k in kept], planes.corners[kept], planes.up)
    assert outline.closed == (False,)
    (chain,) = outline.chains_world
    x, y, _ = SIZE_M
    ends = box_points(np.array([[GAP_M, y, 0], [x, y, 0], [x, GAP_M, 0]]))
    assert len(chain) == 3
    for point in ends:
        assert np.linalg.norm(chain - point, axis=1).min() < _EXACT_M


def test_a_room_whose_up_is_x_has_the_same_outline() -> None:
    planes = box_planes()
    turn = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    turned = [
        Plane(normal=turn @ planes.normal[k], offset_m=float(planes.offset[k])) for k in range(6)
    ]
    outline = room_outline(turned, planes.corners @ turn.T, turn @ planes.up)
    straight = outline_of(planes)
    assert outline.closed == (True,)
    found = np.array(outline.chains_world[0]) @ turn
    for one, other in combinations(range(4), 2):
        assert np.linalg.norm(found[one] - found[other]) > 1.0
    for point in straight.chains_world[0]:
        assert np.linalg.norm(found - point, axis=1).min() < _EXACT_M


def _crossing_planes(count: int) -> Planes:
    """Planes through one place, each of which meets most others: what only a made record has."""
    normals = np.random.default_rng(4).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    across = np.cross(normals, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across, axis=1)[:, None]
    down = np.cross(normals, across)
    signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    return samples.planes(
        normal=normals,
        offset=np.zeros(count),
        corners=np.stack([4.0 * (a * across + b * down) for a, b in signs], axis=1),
        names=tuple(f"wall {index}" for index in range(count)),
    )


def test_planes_that_all_meet_all_others_take_little_time() -> None:
    surfaces = surfaces_of(_crossing_planes(60))
    begin = time.process_time()
    edges = edges_between(surfaces)
    corners = corners_between(surfaces, edges)
    assert time.process_time() - begin < 20.0  # 0.9 s
    assert len(edges) > 1000
    # They all pass through the origin, and so do their lines.
    assert len(corners) > 10_000
    assert max(float(np.linalg.norm(corner.point_world)) for corner in corners) < _EXACT_M


def test_more_planes_or_parts_than_a_drawing_bears_are_refused() -> None:
    few, many = _crossing_planes(3), _crossing_planes(201)
    in_parts = replace(
        few,
        part_corners=np.repeat(few.corners[:1], 20_001, axis=0),
        part_plane=np.zeros(20_001, np.int32),
    )
    for planes in (many, in_parts):
        for work in (surfaces_of, outline_of):
            with pytest.raises(InputError, match=r"planes of .* connected parts, at most"):
                work(planes)
