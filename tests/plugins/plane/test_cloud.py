"""Who has which point: in the sample, plane by plane, and in the cloud, all planes at once."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane import cloud as clouds
from orthoflow_plugins.plane.cloud import draw_sample, plan_grid
from orthoflow_plugins.plane.kernels import PlanGrid
from orthoflow_plugins.plane.search import Claim
from orthoflow_plugins.plane.support import SurfaceRaster

from orthoflow.errors import ProductError
from orthoflow.geometry import Plane, wall_axes
from tests.long_loops import seeds
from tests.plane_scenes import cloud_of, prepared, search_in

UP = np.array([0.0, 0.0, 1.0])
FIND_M = 0.3


def crossing_rasters(rng: np.random.Generator, count: int) -> list[SurfaceRaster]:
    """Planes through the box at random, with rectangles that do not cover it."""
    rasters = []
    for normal in rng.normal(size=(count, 3)):
        plane = Plane(normal=normal / np.linalg.norm(normal), offset_m=rng.uniform(-0.5, 0.5))
        low, axes = rng.uniform(-1.5, -0.5, 2), wall_axes(plane.normal, UP)
        rasters.append(SurfaceRaster(plane=plane, axes=axes, low_m=low, cell_m=0.2, shape=(8, 9)))
    return rasters


def nearest_holder(points_m: NDArray[np.float64], rasters: list[SurfaceRaster]) -> NDArray[np.int8]:
    """(n,) the nearest plane in whose slab and rectangle a point lies, point by point."""
    distances = np.full((len(rasters), len(points_m)), np.inf)
    for k, raster in enumerate(rasters):
        away_m = np.abs(raster.plane.distances_m(points_m))
        placed = (points_m @ raster.axes.T - raster.low_m) / raster.cell_m
        inside = ((placed >= 0.0) & (placed <= np.array(raster.shape[::-1]))).all(axis=1)
        distances[k] = np.where(inside & (away_m <= FIND_M), away_m, np.inf)
    nearest = distances.argmin(axis=0).astype(np.int8)
    return np.where(np.isfinite(distances.min(axis=0)), nearest, np.int8(-1))


@pytest.mark.parametrize("seed", seeds(4))
def test_planes_that_cross_share_the_sample_by_distance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rasters = crossing_rasters(rng, 5)
    search = search_in(prepared(rng.uniform(-2.0, 2.0, (6_000, 3)), parts=2))
    points_m = search.cloud.sample.offsets_m
    claims = [Claim(raster.slab(), np.append(FIND_M, raster.bounds_m())) for raster in rasters]
    for k, claim in enumerate(claims):
        search.claim(claim)
        expected = nearest_holder(points_m, rasters[: k + 1])
        np.testing.assert_array_equal(search.claims, expected)
        assert search.n_points == np.count_nonzero(expected < 0)
        offsets_m, points = search.free()
        np.testing.assert_array_equal(offsets_m, points_m[expected < 0])
        np.testing.assert_array_equal(points.x, points_m[expected < 0, 0].astype(np.float32))
    # One pass for all planes assigns as one plane after the other.
    search.cloud.assign(
        np.array([claim.slab for claim in claims]), np.array([claim.bounds_m for claim in claims])
    )
    np.testing.assert_array_equal(search.cloud.claims, expected)


# --- which points stand for all, and where the scene ends ---


def test_one_point_of_each_of_200000_stretches_is_drawn_at_places_of_the_golden_ratio() -> None:
    stretch = 3.5
    points = np.random.default_rng(0).uniform(0.0, 1.0, (700_000, 3))
    sample = draw_sample(cloud_of(points))
    assert sample.n_represented == stretch
    ordinal = np.arange(200_000)
    golden = np.modf(ordinal * (np.sqrt(5.0) - 1.0) / 2.0)[0]
    np.testing.assert_array_less(np.abs(sample.index / stretch - ordinal - golden), 1.0 / stretch)
    np.testing.assert_array_equal(sample.offsets_m, points[sample.index].astype(np.float32))


def boxed_scene(
    low: tuple[float, float, float], high: tuple[float, float, float]
) -> NDArray[np.float64]:
    """Points in a box, its corners among them."""
    points = np.random.default_rng(2).uniform(low, high, (4_000, 3))
    points[0], points[1] = low, high
    return points


def grid_of(points: NDArray[np.float64], cell_m: float = 0.1) -> PlanGrid:
    sample = draw_sample(cloud_of(points))
    return plan_grid(sample, np.eye(3), cell_m=cell_m, outside_share=0.0)


def test_a_plan_has_five_cells_and_a_fiftieth_about_the_scene() -> None:
    grid = grid_of(boxed_scene((-2.0, 1.0, 0.0), (4.0, 4.0, 2.0)))
    np.testing.assert_allclose(grid.low_m, [-2.62, 0.44, -0.54], atol=1e-6)
    # 7.24 x 4.12 x 3.08 m.
    assert (grid.cell_m, grid.shape) == (0.1, (73, 42, 31))
    # What is farther off than the scene is long does not widen it: nine tenths are within 9 m.
    points = boxed_scene((0.0, 0.0, 0.0), (10.0, 4.0, 2.0))
    for beyond_m, length_m in ((8.0, 26.0), (10.5, 10.0)):
        points[2:4] = [[10.0 + beyond_m, 2.0, 1.0], [-beyond_m, 2.0, 1.0]]
        low_m = -8.0 if length_m == 26.0 else 0.0
        grid = grid_of(points)
        assert grid.low_m[0] == pytest.approx(low_m - 0.5 - 0.02 * length_m, abs=1e-6)
        assert grid.shape[0] == pytest.approx(10.4 * length_m + 10, abs=1.5)


@pytest.mark.parametrize(
    ("high", "wanted_m", "cell_m"),
    [
        # Eight million cells of the plan, and as many storeys, at most.
        ((10_000.0, 8_000.0, 2.0), 0.1, math.sqrt((10_400.0 + 1.0) * (8_320.0 + 1.0) / 8e6)),
        ((1e6, 1.0, 2.0), 0.01, math.sqrt(1.04e6 * (1.04 + 0.1) / 8e6)),
    ],
    ids=["wide", "long"],
)
def test_cells_grow_where_a_plan_would_have_too_many(
    high: tuple[float, float, float], wanted_m: float, cell_m: float
) -> None:
    grid = grid_of(boxed_scene((0.0, 0.0, 0.0), high), wanted_m)
    assert grid.cell_m == pytest.approx(cell_m, rel=1e-6)


@pytest.mark.parametrize("plan_cell_m", [None, 0.1])
def test_a_point_that_is_no_place_is_refused_though_the_sample_misses_it(
    plan_cell_m: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clouds, "SAMPLE_POINTS", 10)
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (100, 3))
    missed = np.setdiff1d(np.arange(100), draw_sample(cloud_of(points)).index)[0]
    prepared(points, plan_cell_m=plan_cell_m)
    points[missed, 1] = np.nan
    with pytest.raises(ProductError):
        prepared(points, plan_cell_m=plan_cell_m)
