"""Which check points no picture shows, on which side of it they lie, and in how many words."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.inspect.missed_points import missed_points, ways_to_count, with_reasons

from tests import inspect_scenes
from tests.inspect_scenes import BUFFER_M, GSD_M, SHAPE, points_at


def missed(column: float, row: float, depth_m: float = 0.0) -> str:
    """Why a point before the first of two walls, the second 500 cells to its right, is missed."""
    walls = inspect_scenes.walls()
    frame = walls.walls[0].frame
    aside = replace(frame, origin_world=frame.origin_world + 500 * GSD_M * frame.u_world)
    walls = replace(walls, walls=(walls.walls[0], replace(walls.walls[0], frame=aside)))
    pictures: Any = [
        SimpleNamespace(wall=k, frame=where, image=SimpleNamespace(name=name))
        for k, (where, name) in enumerate(((frame, "left"), (aside, "right")))
    ]
    surveyed = points_at(frame.world_from_wall(np.array([[column, row]]), depth_m))
    nowhere: Any = SimpleNamespace(place=np.full(2, np.nan), how="outside", wall=-1)
    return missed_points([nowhere], surveyed, pictures, walls)["P0"]


@pytest.mark.parametrize(
    ("column", "row", "depth_m", "reason"),
    [
        (-5.0, 9.0, 0.0, "20 mm left of left"),
        (SHAPE[1] + 60.0, 9.0, 0.0, "240 mm right of left"),
        (SHAPE[1] + 80.0, 9.0, 0.0, "240 mm left of right"),
        (5.0, -250.5, 0.0, "1 m above left"),
        (5.0, -249.0, 0.0, "996 mm above left"),
        (5.0, SHAPE[0] + 10.0, 0.0, "40 mm below left"),
        (505.0, SHAPE[0] + 10.0, 0.0, "40 mm below right"),
        (5.0, 9.0, BUFFER_M + 0.03, "30 mm before left, beyond its buffer"),
        (505.0, 9.0, -BUFFER_M - 0.04, "40 mm behind right, beyond its buffer"),
        # Farther to the side than behind.
        (-5.0, 9.0, -BUFFER_M - 0.01, "20 mm left of left"),
    ],
)
def test_a_point_lies_beside_the_nearest_picture(
    column: float, row: float, depth_m: float, reason: str
) -> None:
    assert missed(column, row, depth_m) == reason


def test_four_points_are_named_and_the_rest_is_counted() -> None:
    reasons = {f"P{k}": "2 mm below wall" for k in range(6)}
    said = with_reasons(reasons)
    assert said.startswith("P0 (2 mm below wall), P1 (")
    assert said.endswith("P3 (2 mm below wall) and 2 more, see the log")
    assert with_reasons(dict([*reasons.items()][:4])).endswith("P3 (2 mm below wall)")
    assert "margin_m" in ways_to_count(reasons)
    assert "margin_m" not in ways_to_count({"P0": "nothing like it was recognised on below"})
