"""Places that a surveyor can name: crossings of painted lines, spread over the wall."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
from orthoflow_plugins.simulate import deliverables
from orthoflow_plugins.simulate.building import SceneDraft
from orthoflow_plugins.simulate.room_model import DESIGNED, build_room
from orthoflow_plugins.simulate.scanning import station_positions

from orthoflow.geometry.scene_views import SceneCameras
from orthoflow.products import CheckPoints


def of_the_room(n_most: int) -> CheckPoints:
    room = build_room()
    scan: Any = SimpleNamespace(stations=station_positions(2))
    delivery = deliverables.Delivery(
        room=room,
        scan=scan,
        world_from_room=np.eye(3),
        shift_world_m=np.zeros(3),
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
