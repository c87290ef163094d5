"""Places that a surveyor can name: crossings of painted lines, spread over the wall."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.simulate import deliverables
from orthoflow_plugins.simulate.building import SceneDraft
from orthoflow_plugins.simulate.room_model import DESIGNED, RoomPlan, build_room
from orthoflow_plugins.simulate.scanning import station_positions

from orthoflow.geometry.scene_views import SceneCameras
from orthoflow.products import CheckPoints


def fresco(extent: tuple[float, float, float, float], period_m: float = 1.0) -> Any:
    """A rectangle at (1, 2, 3) with axes along x and z, and what its texture is made of."""
    params = np.zeros((1, 8))
    params[0, 5] = period_m
    return SimpleNamespace(
        centre=np.array([[1.0, 2.0, 3.0]]),
        axis_a=np.array([[1.0, 0.0, 0.0]]),
        axis_b=np.array([[0.0, 0.0, 1.0]]),
        normal=np.array([[0.0, -1.0, 0.0]]),
        extent=np.array([extent]),
        texture_params=params,
    )


def test_lines_cross_every_nine_tenths_of_a_period_inside_the_rectangle() -> None:
    spots = deliverables._lattice(fresco((-1.0, 1.85, -0.5, 0.95)), 0)
    # From -0.9 to 1.8 across, 0 and 0.9 up: where lines of the lattice cross.
    expected = [(a, b) for b in (0.0, 0.9) for a in (-0.9, 0.0, 0.9, 1.8)]
    np.testing.assert_allclose(spots.in_rectangle, expected, atol=1e-12)
    assert spots.rectangle.tolist() == [0] * 8
    twice = deliverables._lattice(fresco((-1.0, 1.85, -0.5, 0.95), period_m=2.0), 0)
    np.testing.assert_allclose(twice.in_rectangle, [(0.0, 0.0), (1.8, 0.0)], atol=1e-12)


def test_places_on_a_rectangle_are_points_of_the_room() -> None:
    scene = fresco((-1.0, 1.0, -1.0, 1.0))
    spots = deliverables._lattice(scene, 0)
    moved = spots.moved(np.array([0.1, -0.2]))
    np.testing.assert_allclose(moved.points(scene) - spots.points(scene), [[0.1, 0.0, -0.2]] * 9)
    np.testing.assert_allclose(spots.points(scene)[4], [1.0, 2.0, 3.0], atol=1e-12)
    joined = deliverables._Spots.joined([spots, moved])
    assert len(joined.rectangle) == 18
    np.testing.assert_array_equal(joined.in_rectangle[9:], moved.in_rectangle)


def test_chosen_points_lie_far_from_each_other_and_keep_their_order() -> None:
    line = np.column_stack([[0.0, 1.0, 2.0, 3.0, 4.0, 10.0], np.zeros(6), np.zeros(6)])
    # The first, then the farthest from it, then the one farthest from both.
    assert deliverables._spread(line, 3)[:, 0].tolist() == [0.0, 4.0, 10.0]
    assert deliverables._spread(line, 4)[:, 0].tolist() == [0.0, 2.0, 4.0, 10.0]
    assert deliverables._spread(line, 6) is line
    assert deliverables._spread(line[:2], 6).tolist() == line[:2].tolist()


class Views:
    """A scene that is met at a share of the way, or somewhere else."""

    def __init__(self, *, t: float, rectangle: int = 0) -> None:
        self.t, self.rectangle = t, rectangle

    def cast(self, starts: np.ndarray, ways: np.ndarray) -> Any:
        return SimpleNamespace(
            t=np.full(len(ways), self.t), rectangle=np.full(len(ways), self.rectangle)
        )


@pytest.mark.parametrize(
    ("views", "is_seen"),
    [
        (Views(t=1.0), True),
        (Views(t=1.0 + 5e-7), True),
        (Views(t=1.0 - 2e-6), False),
        (Views(t=1.0, rectangle=1), False),
    ],
    ids=["met", "rounded", "before-it", "another"],
)
def test_a_place_is_seen_where_its_own_rectangle_is_met_there(views: Any, is_seen: bool) -> None:
    scene = fresco((-1.0, 1.0, -1.0, 1.0))
    spots = deliverables._lattice(scene, 0)
    seen = deliverables._are_seen(scene, views, spots, np.array([[0.0, -5.0, 0.0]]))
    assert seen.tolist() == [is_seen] * 9
    assert not deliverables._are_seen(scene, views, spots, np.zeros((0, 3))).any()


@pytest.mark.parametrize(
    ("height_m", "is_level"), [(0.01, True), (0.01 + 5e-5, True), (0.01 + 2e-4, False)]
)
def test_a_place_is_level_where_a_surface_goes_on_at_its_height(
    height_m: float, is_level: bool
) -> None:
    scene = fresco((-1.0, 1.0, -1.0, 1.0))
    spots = deliverables._lattice(scene, 0)
    found = deliverables._are_level(scene, Views(t=height_m), spots)  # type: ignore[arg-type]
    assert found.tolist() == [is_level] * 9


@cache
def of_the_room(n_most: int, turn_deg: float = 0.0, shift_m: float = 0.0) -> CheckPoints:
    scene = build_room(RoomPlan(relief=1.0, obstacle=True, spectral_gap=0.3)).scene
    turn = np.radians(turn_deg)
    rotation = np.array(
        [[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]]
    )
    return deliverables.check_points(
        scene,
        SceneCameras(scene, cores=1),
        station_positions(2),
        rotation,
        np.array([shift_m, -2.0 * shift_m, 0.5 * shift_m]),
        n_most=n_most,
    )


def test_points_of_the_room_lie_on_its_main_wall_and_on_corners_of_its_mouldings() -> None:
    found = of_the_room(8)
    assert found.classes == ("flat",) * 8 + ("vertical edge",) * 8
    assert found.names == tuple(f"{kind}{k:02d}" for kind in "FV" for k in range(8))
    assert (found.wall == -1).all()
    assert np.isnan(found.pixels_wall).all()
    main = DESIGNED.sides(SceneDraft())[0]
    off = (found.points_world - main.foot) @ main.normal
    np.testing.assert_allclose(off[:8], 0.0, atol=1e-9)
    # Mouldings stand out by two to fifteen centimetres.
    assert off[8:].min() > 0.015
    assert off[8:].max() < 0.16
    apart = np.linalg.norm(found.points_world[:8, None] - found.points_world[None, :8], axis=2)
    assert apart[~np.eye(8, dtype=bool)].min() > 0.3


def test_points_of_a_turned_and_shifted_room_are_turned_and_shifted() -> None:
    room, world = of_the_room(8), of_the_room(8, 30.0, 100.0)
    x, y, z = room.points_world.T
    half, high = 0.5, np.sqrt(0.75)
    expected = np.column_stack([high * x - half * y + 100.0, half * x + high * y - 200.0, z + 50.0])
    np.testing.assert_allclose(world.points_world, expected, atol=1e-9)
    assert world.names == room.names
