"""Who has which point: in the sample, plane by plane, and in the cloud, all planes at once."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane import cloud as clouds
from orthoflow_plugins.plane.cloud import PreparedCloud, draw_sample, plan_grid, prepare
from orthoflow_plugins.plane.kernels import PlanGrid
from orthoflow_plugins.plane.search import Claim
from orthoflow_plugins.plane.support import SurfaceRaster

from orthoflow.errors import ProductError
from orthoflow.geometry import Plane, wall_axes
from tests.long_loops import seeds
from tests.plane_scenes import cloud_of, prepared, search_in

UP = np.array([0.0, 0.0, 1.0])
FIND_M = 0.3


def prepared_cloud(seed: int, *, parts: int = 2) -> PreparedCloud:
    points = np.random.default_rng(seed).uniform(-2.0, 2.0, (6_000, 3))
    return prepared(points, parts=parts)


def crossing_rasters(seed: int, count: int) -> list[SurfaceRaster]:
    """Planes through the box at random, with rectangles that do not cover it."""
    rng = np.random.default_rng(seed)
    rasters = []
    for _ in range(count):
        normal = rng.normal(size=3)
        normal /= np.linalg.norm(normal)
        plane = Plane(normal=normal / np.linalg.norm(normal), offset_m=rng.uniform(-0.5, 0.5))
        low = rng.uniform(-1.5, -0.5, 2)
        axes = wall_axes(plane.normal, UP)
        rasters.append(SurfaceRaster(plane=plane, axes=axes, low_m=low, cell_m=0.2, shape=(8, 9)))
    return rasters


def claim_of(raster: SurfaceRaster) -> Claim:
    (left, top), (rows, columns) = raster.low_m, raster.shape
    right, bottom = left + columns * raster.cell_m, top + rows * raster.cell_m
    return Claim(slab=raster.slab(), bounds_m=np.array([FIND_M, left, right, top, bottom]))


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
    rasters = crossing_rasters(seed, 5)
    search = search_in(prepared_cloud(seed))
    points_m = search.cloud.sample.offsets_m
    for k, raster in enumerate(rasters):
        search.claim(claim_of(raster))
        expected = nearest_holder(points_m, rasters[: k + 1])
        np.testing.assert_array_equal(search.claims, expected)
        assert search.n_points == np.count_nonzero(expected < 0)
        offsets_m, points = search.free()
        np.testing.assert_array_equal(offsets_m, points_m[expected < 0])
        np.testing.assert_array_equal(points.x, points_m[expected < 0, 0].astype(np.float32))


@pytest.mark.parametrize("seed", seeds(4))
def test_one_pass_for_all_planes_assigns_as_one_plane_after_the_other(seed: int) -> None:
    rasters = crossing_rasters(seed, 5)
    cloud = prepared_cloud(seed)
    claims = [claim_of(raster) for raster in rasters]
    slabs = np.array([claim.slab for claim in claims])
    bounds_m = np.array([claim.bounds_m for claim in claims])
    cloud.assign(slabs, bounds_m)
    np.testing.assert_array_equal(cloud.claims, nearest_holder(cloud.sample.offsets_m, rasters))


# --- which points stand for all, and where the scene ends ---


def test_one_point_of_each_of_200000_stretches_is_drawn_at_places_of_the_golden_ratio() -> None:
    stretch = 3.5
    points = np.random.default_rng(0).uniform(0.0, 1.0, (700_000, 3))
    cloud = cloud_of(points)
    sample = draw_sample(cloud)
    assert sample.n_represented == stretch
    ordinal = np.arange(200_000)
    golden = np.modf(ordinal * (np.sqrt(5.0) - 1.0) / 2.0)[0]
    np.testing.assert_array_less(np.abs(sample.index / stretch - ordinal - golden), 1.0 / stretch)
    np.testing.assert_array_equal(sample.offsets_m, points[sample.index].astype(np.float32))


def boxed_scene(
    low: tuple[float, float, float], high: tuple[float, float, float], *, n: int = 4_000
) -> NDArray[np.float64]:
    """Points in a box, its corners among them."""
    points = np.random.default_rng(2).uniform(low, high, (n, 3))
    points[0], points[1] = low, high
    return points


def grid_of(
    points: NDArray[np.float64], *, cell_m: float = 0.1, outside_share: float = 0.0
) -> PlanGrid:
    return plan_grid(
        draw_sample(cloud_of(points)), np.eye(3), cell_m=cell_m, outside_share=outside_share
    )


def test_a_plan_has_five_cells_and_a_fiftieth_about_the_scene() -> None:
    grid = grid_of(boxed_scene((-2.0, 1.0, 0.0), (4.0, 4.0, 2.0)))
    np.testing.assert_allclose(grid.low_m, [-2.62, 0.44, -0.54], atol=1e-6)
    assert grid.cell_m == 0.1
    # 7.24 x 4.12 x 3.08 m.
    assert grid.shape == (73, 42, 31)
    np.testing.assert_allclose(
        prepare(
            cloud_of(boxed_scene((-2.0, 1.0, 0.0), (4.0, 4.0, 2.0))),
            plan_cell_m=0.1,
            outside_share=0.0,
            parts=1,
        ).box_corners()[[0, -1]],
        [[-2.62, 0.44, -0.54], [4.68, 4.64, 2.56]],
        atol=1e-6,
    )


def test_what_is_farther_off_than_the_scene_is_long_does_not_widen_the_plan() -> None:
    points = boxed_scene((0.0, 0.0, 0.0), (10.0, 4.0, 2.0))
    # Nine tenths of the points lie within 9 m.
    points[2:4] = [[18.0, 2.0, 1.0], [-8.0, 2.0, 1.0]]
    beside = grid_of(points)
    points[2:4] = [[20.5, 2.0, 1.0], [-10.5, 2.0, 1.0]]
    stray = grid_of(points)
    assert beside.low_m[0] == pytest.approx(-8.0 - 0.5 - 0.02 * 26.0, abs=1e-6)
    assert stray.low_m[0] == pytest.approx(-0.5 - 0.02 * 10.0, abs=1e-6)
    # 26 and 10 m with their margins, to a cell.
    assert beside.shape[0] == pytest.approx(281, abs=1)
    assert stray.shape[0] == pytest.approx(114, abs=1)


@pytest.mark.parametrize(
    ("high", "cell_m"),
    [
        # Eight million cells of the plan, and as many storeys, at most.
        ((10_000.0, 8_000.0, 2.0), math.sqrt((10_400.0 + 1.0) * (8_320.0 + 1.0) / 8e6)),
        ((1e6, 1.0, 2.0), (1.04e6 + 1.0) / 8e6),
    ],
    ids=["wide", "long"],
)
def test_cells_grow_where_a_plan_would_have_too_many(
    high: tuple[float, float, float], cell_m: float
) -> None:
    wanted = 0.1 if high[0] < 1e5 else 0.01
    grid = grid_of(boxed_scene((0.0, 0.0, 0.0), high), cell_m=wanted)
    margins = {0.1: cell_m, 0.01: (1.04e6 + 0.1) / 8e6}
    assert grid.cell_m == pytest.approx(
        max(margins[wanted], math.sqrt(1.04e6 * (1.04 + 0.1) / 8e6) if wanted == 0.01 else 0.0),
        rel=1e-6,
    )


@pytest.mark.parametrize("plan_cell_m", [None, 0.1])
def test_a_point_that_is_no_place_is_refused_though_the_sample_misses_it(
    plan_cell_m: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clouds, "SAMPLE_POINTS", 10)
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (100, 3))
    cloud = cloud_of(points)
    missed = np.setdiff1d(np.arange(100), draw_sample(cloud).index)[0]
    prepared(points, plan_cell_m=plan_cell_m)
    points[missed, 1] = np.nan
    with pytest.raises(ProductError):
        prepared(points, plan_cell_m=plan_cell_m)
