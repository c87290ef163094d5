"""How far pixels are drawn out, from views whose stretch is known by algebra."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from orthoflow_plugins.inspect import image_quality
from orthoflow_plugins.inspect.image_quality import cells_per_pixel, stretch_findings

from orthoflow.geometry import bands
from orthoflow.geometry.cameras import ViewingCamera, looking_at
from orthoflow.products import Orthoimage, OrthoMask, Wall
from orthoflow.testing import photographed as ms
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


@pytest.mark.parametrize(("slope_deg", "turn_deg"), [(40.0, 30.0), (-40.0, 30.0), (20.0, 60.0)])
def test_a_slope_is_stretched_by_its_own_view(slope_deg: float, turn_deg: float) -> None:
    # Stepping one cell to the right and tan(slope) forward moves cos(turn) - tan(slope) sin(turn)
    # cells along the photo, which is taken from the right.
    columns = np.arange(SIDE) * GSD_M * math.tan(math.radians(slope_deg))
    viewing = camera(turn_deg, 1.0)
    spread = cells_per_pixel(image(), wall(np.tile(columns, (SIDE, 1))), ("a.jpg", viewing))
    turn = math.radians(turn_deg)
    shown = math.cos(turn) - math.tan(math.radians(slope_deg)) * math.sin(turn)
    expected = max(1.0, 1.0 / shown) if shown > 0.0 else math.inf
    np.testing.assert_allclose(spread, expected, rtol=2e-2)


def test_a_depth_step_is_no_slope() -> None:
    depth = np.zeros(FRAME.shape)
    depth[:, SIDE // 2 :] = 0.5
    viewing = camera(45.0, 1.0)
    spread = cells_per_pixel(image(), wall(depth), ("a.jpg", viewing))
    np.testing.assert_allclose(spread, math.sqrt(2.0), rtol=2e-2)


def test_shares_count_cells_of_pixels_over_two_and_over_five_cells() -> None:
    # Of ten columns eight slope away on both sides, so far that the view meets their back.
    depth = np.zeros(FRAME.shape)
    depth[:, 10:20] = np.arange(10) * GSD_M * 3.0
    depth[:, 20:] = depth[0, 19]
    cameras = ms.cameras(ms.oriented(camera(45.0, 1.5), name="a.jpg"))
    found = {f.name: f.value for f in stretch_findings(image(), wall(depth), cameras)}
    # 1.5 cells over cos 45 are 2.1: everything is stretched, the slope is smeared.
    assert found["stretch_share"] == 1.0
    assert found["smear_share"] == pytest.approx(8 / SIDE)
    assert stretch_findings(image(), wall(depth), None) == []


def test_the_same_cells_are_asked_whether_a_wall_is_large_or_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(3)
    shown = dataclasses.replace(
        image(), mask=rng.choice([OrthoMask.NONE, OrthoMask.PAINTED], FRAME.shape).astype(np.uint8)
    )
    monkeypatch.setattr(image_quality, "_ASKED_MOST", 100)
    asked = []
    for band_cells in (1 << 24, 7 * SIDE):
        monkeypatch.setattr(bands, "_BAND_CELLS", band_cells)
        asked.append(
            image_quality._asked_cells(shown, wall(np.zeros(FRAME.shape)), shown.sources[0])
        )
    expected = np.flatnonzero(shown.mask == OrthoMask.PAINTED)
    np.testing.assert_array_equal(asked[0], expected[:: len(expected) // 100])
    np.testing.assert_array_equal(asked[1], asked[0])
