"""How far neighbourhoods of voxels reach, and how large voxels are where a cloud is thin."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.sample import PreparedCloud, prepare
from orthoflow_plugins.plane.surface_voxels import (
    Neighbourhood,
    SurfaceVoxels,
    coarser,
    surface_voxels,
)
from orthoflow_plugins.plane.voxel_kernels import STEPS_PER_VOXEL

from tests import scenes
from tests.plane_scenes import cloud_of

CUBE = Neighbourhood(shape="cube", size_m=0.03, n_points=9, voxel_m=0.01)


def steps_of(shape: str, size_m: float) -> list[tuple[int, ...]]:
    around = replace(CUBE, shape=shape, size_m=size_m).around()  # type: ignore[type-var]
    return [tuple(row) for row in around.tolist()]


@pytest.mark.parametrize(
    ("size_m", "reach"), [(0.001, 0), (0.01, 0), (0.021, 1), (0.03, 1), (0.07, 3), (0.2, 4)]
)
def test_a_cube_reaches_half_its_side_less_the_voxel_itself(size_m: float, reach: int) -> None:
    steps = steps_of("cube", size_m)
    axis = range(-reach, reach + 1)
    expected = {
        (i, j, k, max(abs(i), abs(j), abs(k))) for i in axis for j in axis for k in axis
    } - {(0, 0, 0, 0)}
    assert set(steps) == expected
    assert len(steps) == len(expected)
    assert replace(CUBE, size_m=size_m).width_voxels() == 2 * reach + 1


@pytest.mark.parametrize(
    ("size_m", "radius"), [(0.004, 1), (0.02, 2.0), (0.025, 2.5), (0.041, 4.1)]
)
def test_a_sphere_has_the_voxels_whose_middles_are_no_farther(size_m: float, radius: float) -> None:
    steps = steps_of("radius", size_m)
    reach = math.floor(size_m / 0.01)
    axis = range(-reach, reach + 1)
    expected = {
        (i, j, k)
        for i in axis
        for j in axis
        for k in axis
        if 0 < i * i + j * j + k * k <= radius**2 + 1e-9
    }
    assert {step[:3] for step in steps} == expected
    assert replace(CUBE, shape="radius", size_m=size_m).width_voxels() == 2 * reach + 1


def test_near_voxels_come_first_shell_by_shell() -> None:
    for shape, size_m in (("cube", 0.05), ("radius", 0.04), ("knn", 0.0)):
        steps = np.array(steps_of(shape, size_m))
        squares = (steps[:, :3] ** 2).sum(axis=1)
        np.testing.assert_array_equal(steps[:, 3], np.abs(steps[:, :3]).max(axis=1))
        order = steps[:, 3] * 1_000 + squares
        assert (np.diff(order) >= 0).all()


def test_the_nearest_end_with_enough_points_and_the_others_never() -> None:
    nearest = replace(CUBE, shape="knn", n_points=30)
    assert len(nearest.around()) == 9**3 - 1
    assert nearest.enough == 30
    assert nearest.width_voxels() == 3.0
    # More than any cloud has.
    assert CUBE.enough > 10**15


def prepared(points: NDArray[np.float64]) -> PreparedCloud:
    basis = scenes.random_rotation(np.random.default_rng(3))
    return prepare(cloud_of(points @ basis), basis, cell_m=0.5, least_share=0.0, parts=2)


def on_wall(n_points: int) -> NDArray[np.float64]:
    """Points (n, 3) of 4 x 2 m."""
    return np.random.default_rng(n_points).uniform([0, 1, 0], [4, 1, 2], (n_points, 3))


def test_voxels_of_a_dense_cloud_are_those_that_are_wanted() -> None:
    # 100 points in each voxel of 4 cm squared, and nine of those in a neighbourhood.
    wanted = Neighbourhood(shape="cube", size_m=0.12, n_points=9, voxel_m=0.04)
    voxels = surface_voxels(prepared(on_wall(500_000)), wanted)
    assert voxels.neighbourhood == wanted
    assert voxels.grid.cell_m == 0.04


@pytest.mark.parametrize("n_points", [1_000, 4_000])
def test_voxels_of_a_thin_cloud_grow_until_a_neighbourhood_has_sixteen_points(
    n_points: int,
) -> None:
    wanted = Neighbourhood(shape="cube", size_m=0.12, n_points=9, voxel_m=0.04)
    voxels = surface_voxels(prepared(on_wall(n_points)), wanted)
    used = voxels.neighbourhood
    # n / 8 m2 of points on squares of three voxels: chance tells how many by a quarter.
    assert used.voxel_m == pytest.approx(math.sqrt(16.0 * 8.0 / n_points) / 3.0, rel=0.25)
    assert used.size_m == pytest.approx(3.0 * used.voxel_m)
    assert voxels.grid.cell_m == used.voxel_m


def test_voxels_are_no_larger_than_a_twentieth_of_the_scene() -> None:
    wanted = Neighbourhood(shape="cube", size_m=0.12, n_points=9, voxel_m=0.04)
    cloud = prepared(on_wall(20))
    extent_m = max(cloud.grid.shape) * cloud.grid.cell_m
    voxels = surface_voxels(cloud, wanted)
    assert voxels.grid.cell_m == pytest.approx(0.05 * extent_m)
    # What is wanted so large stays so.
    large = replace(wanted, voxel_m=0.1 * extent_m, size_m=0.3 * extent_m)
    assert surface_voxels(cloud, large).grid.cell_m == pytest.approx(0.1 * extent_m)


def moments(voxels: SurfaceVoxels) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sums over all voxels of the points, less half a step each, and of their products."""
    side = voxels.grid.cell_m
    corner = (voxels.places + 0.5) * side
    step = side / STEPS_PER_VOXEL
    first = voxels.counts[:, None] * corner + step * voxels.sums[:, 1:4]
    products = []
    for k, (i, j) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
        inner_i, inner_j = (step * voxels.sums[:, 1 + axis] for axis in (i, j))
        products.append(
            voxels.counts * corner[:, i] * corner[:, j]
            + corner[:, i] * inner_j
            + corner[:, j] * inner_i
            + step**2 * voxels.sums[:, 4 + k]
        )
    return first.sum(axis=0), np.sum(products, axis=1)


def test_wider_voxels_hold_the_moments_of_those_in_them() -> None:
    rng = np.random.default_rng(5)
    wanted = Neighbourhood(shape="cube", size_m=0.6, n_points=9, voxel_m=0.2)
    voxels = surface_voxels(prepared(rng.uniform(0.0, 3.0, (20_000, 3))), wanted)
    member = np.flatnonzero(rng.random(len(voxels.counts)) < 0.8)
    wide = coarser(voxels, member)
    some = replace(voxels, places=voxels.places[member], sums=voxels.sums[member])
    assert wide.voxels.grid.cell_m == 2.0 * voxels.grid.cell_m
    assert wide.voxels.neighbourhood.size_m == 2.0 * voxels.neighbourhood.size_m
    assert wide.voxels.neighbourhood.voxel_m == 2.0 * voxels.neighbourhood.voxel_m
    assert wide.voxels.grid.shape == tuple(-(-size // 2) for size in voxels.grid.shape)
    np.testing.assert_array_equal(wide.voxels.places[wide.of_member], voxels.places[member] // 2)
    np.testing.assert_array_equal(
        wide.voxels.counts, np.bincount(wide.of_member, voxels.counts[member])
    )
    # Numbers of voxels are where their places say.
    a, b, c = wide.voxels.places.T // 8
    i, j, k = wide.voxels.places.T % 8
    numbers = wide.voxels.numbers[wide.voxels.bricks[a, b, c], (i * 8 + j) * 8 + k]
    np.testing.assert_array_equal(numbers, np.arange(len(wide.voxels.counts)))
    assert np.count_nonzero(wide.voxels.numbers >= 0) == len(wide.voxels.counts)
    # Steps are rounded, by half of one at most of each voxel.
    tolerance = 0.5 * wide.voxels.grid.cell_m / STEPS_PER_VOXEL * len(wide.voxels.counts)
    firsts, products = zip(moments(wide.voxels), moments(some), strict=True)
    np.testing.assert_allclose(*firsts, atol=tolerance, rtol=0.0)
    # Of places up to five metres from the corner.
    np.testing.assert_allclose(*products, atol=10.0 * tolerance, rtol=0.0)
