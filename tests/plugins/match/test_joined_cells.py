"""Cells between points are joined before photos are matched with a wall."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from orthoflow_plugins.match.channels import in_cells_of_points

from orthoflow.products import SurfaceMask, Wall
from tests import raster_scenes as scenes
from tests import samples

SHAPE = (301, 350)
GSD_M = 0.002
STEP_M = 0.05


def sparse_wall(spacing_cells: float, *, factor: int = 2) -> Wall:
    """Single points anywhere, carried to the centres of their cells, as `raster.grid` does.

    It shows `scenes.waves` in cells that are so many times as wide.
    """
    places = scenes.points_apart(SHAPE, spacing_cells, seed=3, in_rows=False)
    columns, rows = np.unique(np.floor(places).astype(np.intp), axis=0).T
    rasters = {
        name: np.full(SHAPE, np.nan, np.float32) for name in ("depth_m", "sigma_m", "intensity")
    }
    shade = scenes.waves((columns + 0.5) / factor, (rows + 0.5) / factor)
    rasters["intensity"][rows, columns] = shade
    noise_m = np.random.default_rng(2).normal(0.0, 0.001, len(rows))
    rasters["depth_m"][rows, columns] = np.where(columns < 150, STEP_M, 0.0) + noise_m
    count = np.zeros(SHAPE, dtype=np.uint32)
    count[rows, columns] = 1
    frame = samples.facing_south(GSD_M, SHAPE[1], SHAPE[0])
    return samples.wall(frame, count=count, **rasters)


@pytest.mark.parametrize(("spacing_cells", "factor"), [(2.2, 2), (3.3, 3)])
def test_joined_cells_show_the_wall_where_it_is(spacing_cells: float, factor: int) -> None:
    wall = sparse_wall(spacing_cells, factor=factor)
    joined = in_cells_of_points(wall)
    assert joined.frame.gsd_m == pytest.approx(factor * GSD_M)
    assert joined.frame.shape == tuple(-(-length // factor) for length in SHAPE)
    np.testing.assert_array_equal(joined.frame.origin_world, wall.frame.origin_world)
    assert joined.count.sum() == wall.count.sum()
    # Most of what was void is between points now.
    assert np.isfinite(wall.depth_m).mean() < 0.25
    assert np.isfinite(joined.depth_m).mean() > 0.9
    np.testing.assert_array_equal(joined.mask == SurfaceMask.MEASURED, joined.count > 0)
    assert joined.intensity is not None
    assert np.abs(scenes.shift_of_waves(joined.intensity)).max() < 0.01


def test_no_joined_depth_lies_between_two_surfaces() -> None:
    joined = in_cells_of_points(sparse_wall(2.2))
    depth_m = joined.depth_m[np.isfinite(joined.depth_m)]
    assert (np.minimum(np.abs(depth_m), np.abs(depth_m - STEP_M)) < 0.006).all()
    spread_m = joined.sigma_m[np.isfinite(joined.sigma_m)]
    assert np.sqrt(np.mean(spread_m**2)) == pytest.approx(0.001, rel=0.15)


def test_cells_as_wide_as_points_lie_apart_stay_and_so_does_a_wall_that_shows_nothing() -> None:
    dense = sparse_wall(1.6)
    assert in_cells_of_points(dense) is dense
    blind = replace(sparse_wall(3.3), intensity=None)
    assert in_cells_of_points(blind) is blind
