"""What is prepared of a wall before photos look at it: bounds of its blocks, cameras before it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.ortho import surfaces
from orthoflow_plugins.ortho.parameters import VisibilityParams
from orthoflow_plugins.ortho.surfaces import (
    Surface,
    is_before,
    relief_of,
    surfaces_of,
    view_of,
)
from orthoflow_plugins.ortho.visibility_kernels import BLOCK_CELLS, FINE_CELLS

from orthoflow.geometry.robust import depth_noise_m
from orthoflow.products import Wall
from tests import ortho_scenes as scenes
from tests import samples
from tests.raster_scenes import context

GSD_M = 0.01


def wall_of(depths: NDArray[np.floating]) -> Wall:
    rows, columns = depths.shape
    frame = samples.facing_south(GSD_M, columns, rows, (1.0, 2.0, 3.0))
    return samples.wall(frame, depth_m=depths.astype(np.float32))


def rough(shape: tuple[int, int]) -> NDArray[np.float32]:
    """Depths with a void block, void cells, and a raised part."""
    rng = np.random.default_rng(5)
    depths = rng.normal(0.0, 0.003, shape)
    depths[rng.random(shape) < 0.02] = np.nan
    depths[shape[0] // 2 :, shape[1] // 3 :] += 0.08
    depths[:9, : BLOCK_CELLS + 3] = np.nan
    return depths.astype(np.float32)


def of_blocks(values: NDArray[np.floating], side: int, pick: Any) -> NDArray[np.float64]:
    rows, columns = (-(-n // side) for n in values.shape)
    return np.array(
        [
            [
                pick(values[side * r : side * (r + 1), side * c : side * (c + 1)])
                for c in range(columns)
            ]
            for r in range(rows)
        ],
        dtype=np.float64,
    )


SHAPES = [(9, 17), (70, 101), (5, 40)]


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_bounds_of_blocks_are_those_of_their_cells(shape: tuple[int, int]) -> None:
    depths = rough(shape)
    relief, clear = relief_of(wall_of(depths)), relief_of(wall_of(depths), hides=False)
    low = np.where(np.isnan(depths), np.inf, depths)
    for prepared in (relief, clear):
        np.testing.assert_array_equal(prepared.bottoms, of_blocks(low, BLOCK_CELLS, np.min))
        np.testing.assert_array_equal(prepared.depth, depths)
        # For others kernels would be compiled once more.
        assert not prepared.depth.flags.writeable
        assert not prepared.occluding.flags.writeable
    tops = of_blocks(relief.occluding, BLOCK_CELLS, np.max)
    np.testing.assert_array_equal(relief.tops, tops)
    fine_tops = of_blocks(relief.occluding, FINE_CELLS, np.max)
    np.testing.assert_array_equal(relief.fine_tops, fine_tops)
    np.testing.assert_array_equal(relief.fine_bottoms, of_blocks(low, FINE_CELLS, np.min))
    assert relief.highest_m == tops.max()
    assert clear.occluding.size == 0
    assert clear.highest_m == clear.tops.max() == -np.inf


def test_bands_of_a_large_wall_do_not_show(monkeypatch: pytest.MonkeyPatch) -> None:
    wall = wall_of(rough((100, 33)))
    whole = relief_of(wall).occluding
    monkeypatch.setattr(surfaces, "_BAND_CELLS", 33 * 20)
    np.testing.assert_array_equal(relief_of(wall).occluding, whole)


PARAMS = VisibilityParams(incidence_max_deg=70.0)


def surface_of(depths: NDArray[np.floating]) -> Surface:
    wall = wall_of(depths)
    return Surface(
        frame=wall.frame,
        relief=relief_of(wall, hides=False),
        front_m=0.2,
        tolerance_m=0.007,
    )


def test_a_camera_is_the_same_in_the_axes_of_a_wall() -> None:
    where = scenes.frame(at_survey=True)
    camera = replace(scenes.camera(where, aside_m=0.4), skew=2.0)
    surface = replace(surface_of(np.zeros((4, 5))), frame=where)
    view = view_of(camera, surface, PARAMS)
    (foot,) = where.wall_from_world(camera.centre_world[None])
    # The centre of the first cell is 0.
    assert (view.column, view.row) == pytest.approx((foot[0] - 0.5, foot[1] - 0.5), abs=1e-6)
    assert view.height_m == pytest.approx(foot[2], abs=1e-9)
    assert (view.gsd_m, view.front_m, view.tolerance_m) == (where.gsd_m, 0.2, 0.007)
    assert view.cosine_least == pytest.approx(math.cos(math.radians(70.0)))
    assert view.border_px == 0.05 * min(camera.width, camera.height)
    # Points in metres right, down and before the wall are seen where the camera sees them.
    at = np.random.default_rng(2).uniform([0.0, 0.0, -0.1], [1.2, 0.9, 0.1], (20, 3))
    world = where.world_from_wall(at[:, :2] / where.gsd_m, at[:, 2])
    flat = view.camera
    local = flat[:9].reshape(3, 3) @ at.T + flat[9:12, None]
    expected = camera.rotation @ world.T + camera.translation[:, None]
    np.testing.assert_allclose(local, expected, atol=1e-6)
    np.testing.assert_array_equal(flat[12:], camera.flat[12:])


@pytest.mark.parametrize(("least_m", "is_seen"), [(0.1, True), (1.99, True), (2.01, False)])
def test_a_camera_stands_before_a_wall_where_any_of_it_is_lower(
    least_m: float, is_seen: bool
) -> None:
    depths = np.full((40, 40), 2.5)
    depths[35, 36] = least_m
    surface = surface_of(depths)
    frame = surface.frame
    centre = frame.world_from_wall(np.array([[20.0, 20.0]]), 2.0)[0]
    camera = scenes.camera(scenes.frame())
    there = replace(camera, translation=-camera.rotation @ centre)
    assert is_before(view_of(there, surface, PARAMS), surface) == is_seen


def test_surfaces_tolerate_their_noise_and_what_cells_cannot_hold(tmp_path: Path) -> None:
    depths = np.random.default_rng(1).normal(0.0, 0.002, (60, 60))
    wall = wall_of(depths)
    walls = samples.walls(wall, replace(wall, plane_index=0), buffer_m=0.15)
    ctx = context(tmp_path)
    first, second = surfaces_of(walls, ctx)
    noise_m = depth_noise_m(wall.depth_m)
    assert noise_m == pytest.approx(0.002, rel=0.1)
    assert first.tolerance_m == pytest.approx(3.0 * noise_m + 0.5 * GSD_M)
    assert first.front_m == 0.15
    assert first.frame is wall.frame
    assert first.relief.occluding.size == second.relief.occluding.size == 3600
    (clear, _) = surfaces_of(walls, ctx, hides=False)
    assert clear.relief.occluding.size == 0
    assert clear.tolerance_m == 0.5 * GSD_M  # nothing to tell from noise


@pytest.mark.parametrize(("step_cells", "is_edge"), [(4.9, False), (5.1, True)])
def test_a_step_of_five_cells_is_an_edge_that_hides_in_full(
    step_cells: float, is_edge: bool
) -> None:
    depths = np.zeros((20, 20))
    depths[:, 10:] = step_cells * GSD_M
    relief = relief_of(wall_of(depths))
    beside = relief.occluding[5, 9]
    assert beside == pytest.approx(step_cells * GSD_M if is_edge else 0.0, abs=1e-5)
