"""Clouds, walls, openings and check points: their parts, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from orthoflow.errors import ProductError
from orthoflow.geometry.slabs import BOXED_POINTS
from orthoflow.products import CheckPoints, Layers, PointCloud, Wall, Walls
from tests import samples
from tests.drawing_runs import box_openings

UP = np.array([0.0, 0.0, 1.0])


def wall_at(x_m: float, name: str) -> Wall:
    """2 m x 1 m at an x, seen from the east; its lower edge at z = 0, from y = 0 on."""
    frame = samples.facing_east(0.5, 4, 2, (x_m, 0.0, 1.0))
    return samples.wall(frame, name=name)


def walls(*given: Wall) -> Walls:
    return samples.walls(*given, buffer_front_m=0.3, buffer_behind_m=0.1)


def test_walls_share_a_reach_or_have_their_own() -> None:
    room = walls(wall_at(0.0, "west"), wall_at(8.0, "east"))
    shared = room.slab(1)
    assert (shared.front_m, shared.behind_m) == (0.3, 0.1)
    assert shared.frame is room.walls[1].frame
    assert shared.n_cells == 8
    own = replace(room, buffers_m=((0.2, 0.4), (0.05, 0.6))).slab(1)
    assert (own.front_m, own.behind_m) == (0.05, 0.6)


def test_the_nearest_wall_is_that_of_the_nearest_rectangle() -> None:
    turned = samples.facing_south(0.5, 4, 2, (2.0, 10.0, 1.0))
    room = walls(
        wall_at(0.0, "west"), wall_at(8.0, "east"), replace(wall_at(0.0, "north"), frame=turned)
    )
    # The rectangle counts, not its plane: 5 m along the first, 3 m in front of the last.
    points = np.array([[1.0, 1.0, 0.5], [7.0, 1.0, 0.5], [0.0, 7.0, 0.5]])
    assert room.nearest(points).tolist() == [0, 1, 2]


def test_people_know_a_wall_by_its_plane_and_else_by_its_place() -> None:
    frame = samples.facing_east(0.5, 4, 2, (0.0, 0.0, 1.0))
    rgb = np.zeros((*frame.shape, 3), dtype=np.uint8)
    images = [
        samples.orthoimage(frame, wall=2, rgb=rgb, plane_index=plane) for plane in (None, 0, 7)
    ]
    assert [image.number for image in images] == [2, 0, 7]
    layers = Layers(layers=(), names=("west",), plane_indices=(4, 6))
    assert [layers.number(wall) for wall in range(3)] == [4, 6, 2]
    assert [layers.name(wall) for wall in range(3)] == ["west", "wall 6", "wall 2"]


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
def test_spacing_follows_from_counts(counts: list[list[int]], apart_m: float) -> None:
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


def test_a_cloud_of_few_blocks_has_no_boxes() -> None:
    places = np.arange(16 * BOXED_POINTS + 1, dtype=np.float32)
    cloud = PointCloud(origin=np.zeros(3), x=places, y=-places, z=0.0 * places, up=UP)
    assert cloud.selected(np.arange(16 * BOXED_POINTS)).boxes_m is None
    assert cloud.boxes_m is not None
    assert len(cloud.boxes_m) == 17
    first, last = cloud.boxes_m[0], cloud.boxes_m[-1]
    np.testing.assert_array_equal(first[:, 0], [0, BOXED_POINTS - 1])
    np.testing.assert_array_equal(first[:, 1], [1 - BOXED_POINTS, 0])
    np.testing.assert_array_equal(last[:, 0], [places[-1], places[-1]])


def test_points_keep_their_ids_through_several_selections() -> None:
    x, y, z = np.random.default_rng(3).normal(size=(3, 8)).astype(np.float32)
    whole = PointCloud(
        origin=np.array([4e6, 5e6, 0.0]), up=np.array([0.0, 0.0, 1.0]), x=x, y=y, z=z, intensity=x
    )
    places = np.array([5, 1, 3])
    twice = whole.selected(places).selected(np.array([True, False, True]))
    assert twice.point_id is not None
    assert twice.intensity is not None
    np.testing.assert_array_equal(twice.point_id, [5, 3])
    np.testing.assert_array_equal(twice.points_world(), whole.points_world(places[[0, 2]]))
    np.testing.assert_array_equal(twice.intensity, x[[5, 3]])


def points_of(**changes: object) -> CheckPoints:
    given: dict[str, object] = {
        "names": ("a", "b", "c"),
        "points_world": np.zeros((3, 3)),
        "classes": ("", "", ""),
        "wall": np.zeros(3, dtype=np.int32),
        "pixels_wall": np.zeros((3, 2)),
        "places_m": np.zeros((3, 2)),
        "shown_world": np.zeros((3, 3)),
    }
    return CheckPoints(**{**given, **changes})  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["points_world", "wall", "pixels_wall", "places_m", "shown_world"])
def test_check_points_have_a_row_each(name: str) -> None:
    right = getattr(points_of(), name)
    assert len(points_of().names) == len(right)
    for wrong in (right[:2], np.concatenate([right, right], axis=right.ndim - 1)):
        with pytest.raises(ProductError, match=f"checkpoints.*{name}"):
            points_of(**{name: wrong})
    with pytest.raises(ProductError, match="2 classes for 3 names"):
        points_of(classes=("", ""))


def test_what_it_is_is_said_in_a_line() -> None:
    (opening,) = box_openings().openings
    assert opening.said == "niche 0.250 m deep, 0.80 x 1.20 m"
    assert replace(opening, kind="through", depth_m=0.1).said == "through, 0.80 x 1.20 m"


def test_the_error_of_all_sides_counts_those_that_were_seen() -> None:
    (opening,) = box_openings().openings
    assert opening.edge_sigma_m == pytest.approx(np.sqrt((9 + 2.25 + 9) / 3) * 1e-3)
    assert replace(opening, side_sigma_m=np.full(4, np.nan)).edge_sigma_m is None


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"outline_world": np.zeros((3, 3))}, "opening.outline_world must have shape"),
        ({"side_source": np.zeros(3, dtype=np.uint8)}, "opening.side_source must have shape"),
        ({"outline_m": np.full((4, 2), np.nan)}, "at least 3 corners, all with coordinates below"),
        ({"kind": "hole"}, "must be one of through, niche, no data, got 'hole'"),
        ({"side_source": np.full(4, 9, dtype=np.uint8)}, "opening.side_source must be at most 2"),
    ],
    ids=["corners", "sides", "not finite", "kind", "source"],
)
def test_what_does_not_go_together_is_refused(change: dict[str, object], said: str) -> None:
    with pytest.raises(ProductError, match=said):
        replace(box_openings().openings[0], **change)  # type: ignore[arg-type] # wrong on purpose
