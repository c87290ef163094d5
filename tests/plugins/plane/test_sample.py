"""Who has which point: in the sample, plane by plane, and in the cloud, all planes at once."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.assignment_kernels import assign_points, sum_assigned
from orthoflow_plugins.plane.block_kernels import each_part, piece_of
from orthoflow_plugins.plane.sample import Claim, PreparedCloud, Unassigned, prepare
from orthoflow_plugins.plane.slab_kernels import STEPS_PER_TOLERANCE
from orthoflow_plugins.plane.support import INNER_SHARE, SurfaceRaster, measure_cells

from orthoflow.geometry import Plane, wall_axes
from tests.plane_scenes import cloud_of

UP = np.array([0.0, 0.0, 1.0])
FIND_M, FIT_M = 0.3, 0.1


def prepared_cloud(seed: int, *, parts: int = 2) -> PreparedCloud:
    points = np.random.default_rng(seed).uniform(-2.0, 2.0, (6_000, 3))
    return prepare(cloud_of(points), np.eye(3), cell_m=0.5, least_share=0.005, parts=parts)


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


@pytest.mark.parametrize("seed", range(4))
def test_planes_that_cross_share_the_sample_by_distance(seed: int) -> None:
    rasters = crossing_rasters(seed, 5)
    unassigned = Unassigned.of(prepared_cloud(seed))
    points_m = unassigned.sample.offsets_m
    for k, raster in enumerate(rasters):
        unassigned.claim(claim_of(raster))
        expected = nearest_holder(points_m, rasters[: k + 1])
        np.testing.assert_array_equal(unassigned.claims, expected)
        assert unassigned.n_points == np.count_nonzero(expected < 0)
        free = unassigned.free()
        np.testing.assert_array_equal(free.offsets_m, points_m[expected < 0])
        np.testing.assert_array_equal(free.points.x, points_m[expected < 0, 0].astype(np.float32))


@pytest.mark.parametrize("seed", range(4))
def test_one_pass_for_all_planes_assigns_as_one_plane_after_the_other(seed: int) -> None:
    rasters = crossing_rasters(seed, 5)
    cloud = prepared_cloud(seed)
    claims = [claim_of(raster) for raster in rasters]
    slabs = np.array([claim.slab for claim in claims])
    bounds_m = np.array([claim.bounds_m for claim in claims])
    assign_points(cloud.points, cloud.claims, slabs, bounds_m)
    np.testing.assert_array_equal(cloud.claims, nearest_holder(cloud.sample.offsets_m, rasters))


@pytest.mark.parametrize("parts", [1, 3])
def test_a_plane_alone_has_the_same_sums_in_both_passes(parts: int) -> None:
    (raster,) = crossing_rasters(7, 1)
    cloud = prepared_cloud(7, parts=parts)
    alone = measure_cells(cloud.points, raster, find_m=FIND_M, fit_m=FIT_M, parts=parts)
    (left, top), (rows, columns) = raster.low_m, raster.shape
    table = np.array(
        [[left, top, 1.0 / raster.cell_m, rows, columns, 0, FIT_M, INNER_SHARE * FIND_M]]
    )
    counts = np.zeros((parts, rows * columns, 3), dtype=np.int32)
    sums = np.zeros((parts, rows * columns, 2), dtype=np.int64)
    claim = claim_of(raster)

    def add(part: int, piece: slice) -> None:
        points = piece_of(cloud.points, piece)
        slabs, bounds = claim.slab[None], claim.bounds_m[None]
        sum_assigned(points, slabs, bounds, table, counts[part], sums[part], (1, 0))

    each_part(len(cloud.claims), parts, add)
    n_find, n_inner, n_fit = counts.sum(axis=0).reshape(rows, columns, 3).transpose(2, 0, 1)
    steps, squares = sums.sum(axis=0).reshape(rows, columns, 2).transpose(2, 0, 1)
    np.testing.assert_array_equal(n_find, alone.n_find)
    np.testing.assert_array_equal(n_inner, alone.n_inner)
    np.testing.assert_array_equal(n_fit, alone.n_fit)
    # Of each point the distance is rounded to a step, and is known to a tenth of one in float32.
    assert np.abs(steps - alone.steps).max() <= n_fit.max()
    apart = np.abs(squares - alone.squared_steps)
    assert (apart <= 2 * STEPS_PER_TOLERANCE * np.maximum(n_fit, 1)).all()
