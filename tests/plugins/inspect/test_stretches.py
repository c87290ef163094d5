"""How far pixels are drawn out, from views whose stretch is known by algebra."""

from __future__ import annotations

import math

import numpy as np
import pytest
from orthoflow_plugins.inspect.image_quality import cells_per_pixel

from orthoflow.geometry.cameras import ViewingCamera, looking_at
from orthoflow.products import Orthoimage, Wall
from tests import samples

SIDE = 40
GSD_M = 0.01
UP = np.array([0.0, 0.0, 1.0])
# u along x, v down; the viewer stands at negative y. Far from the origin, as surveys are.
FRAME = samples.facing_south(GSD_M, SIDE, SIDE, (5.0e6, 4.0e5, 100.0))
MIDDLE = FRAME.world_from_wall(np.array([[SIDE / 2, SIDE / 2]]))[0]
DISTANCE_M = 100.0


def wall(depth_m: np.ndarray) -> Wall:
    ones = np.ones(FRAME.shape, dtype=np.uint8)
    return Wall(
        frame=FRAME,
        plane_index=0,
        name="wall",
        depth_m=depth_m.astype(np.float32),
        sigma_m=np.full(FRAME.shape, np.nan, dtype=np.float32),
        count=ones.astype(np.uint32),
        mask=ones,
    )


def image() -> Orthoimage:
    return samples.orthoimage(FRAME, name="wall", rgb=np.zeros((*FRAME.shape, 3), dtype=np.uint8))


def camera(turn_deg: float, cells_per_pixel: float) -> ViewingCamera:
    """Far away, so that the view is nearly parallel; to the right of the wall's normal."""
    turn = math.radians(turn_deg)
    centre = MIDDLE + DISTANCE_M * np.array([math.sin(turn), -math.cos(turn), 0.0])
    focal = DISTANCE_M / (cells_per_pixel * GSD_M)
    lens = {"fx": focal, "fy": focal, "cx": 500.0, "cy": 500.0, "width": 1000, "height": 1000}
    return samples.camera(looking_at(centre, MIDDLE, UP), centre, **lens)


@pytest.mark.parametrize("turn_deg", [0.0, 30.0, 60.0])
def test_a_flat_wall_is_stretched_by_the_cosine_of_the_view(turn_deg: float) -> None:
    viewing = camera(turn_deg, 0.7)
    spread = cells_per_pixel(image(), wall(np.zeros(FRAME.shape)), ("a.jpg", viewing))
    assert len(spread) == SIDE * SIDE
    # The wall is 0.4 m wide and 100 m away: 0.4 % of perspective.
    np.testing.assert_allclose(spread, 0.7 / math.cos(math.radians(turn_deg)), rtol=5e-3)
