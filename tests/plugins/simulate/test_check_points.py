"""Places that a surveyor can name: crossings of painted lines, spread over the wall."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
from orthoflow_plugins.simulate import deliverables
from orthoflow_plugins.simulate.building import SceneDraft
from orthoflow_plugins.simulate.room_model import DESIGNED, build_room
from orthoflow_plugins.simulate.scanning import station_positions

from orthoflow.geometry.scene_views import SceneCameras
from orthoflow.products import CheckPoints


@cache
def of_the_room(n_most: int, turn_deg: float = 0.0, shift_m: float = 0.0) -> CheckPoints:
    room = build_room()
    turn = np.radians(turn_deg)
    rotation = np.array(
        [[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]]
    )
    scan: Any = SimpleNamespace(stations=station_positions(2))
    delivery = deliverables.Delivery(
        room=room,
        scan=scan,
        world_from_room=rotation,
        shift_world_m=np.array([shift_m, -2.0 * shift_m, 0.5 * shift_m]),
    )
    views = SceneCameras(room.scene, cores=1)
    return deliverables.check_points(delivery, views, n_most=n_most)


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
