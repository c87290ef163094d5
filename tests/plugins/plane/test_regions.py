"""Regions of voxels: which voxels join, which way normals face, and the planes of groups."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.region_kernels import grow_regions
from orthoflow_plugins.plane.regions import (
    _common_direction,
    _densest,
    _plane,
    facing,
)
from orthoflow_plugins.plane.sample import prepare
from orthoflow_plugins.plane.surface_voxels import Neighbourhood, SurfaceVoxels, surface_voxels
from orthoflow_plugins.plane.voxel_kernels import N_SUMS, STEPS_PER_VOXEL, VOXELS

from orthoflow.geometry import Plane
from tests import scenes
from tests.plane_scenes import Rectangle, cloud_of, sampled

SHAPE: Final = (3, 3, 3)
COSINE: Final = math.cos(math.radians(10.0))


class Grown:
    """Voxels of one point each, at chosen heights within them, and the regions that they form."""

    def __init__(
        self,
        places: NDArray[np.int64],
        heights: NDArray[np.float64],
        normals: NDArray[np.float64],
        *,
        reach: float = 0.3,
        seeds: NDArray[np.int64] | None = None,
    ) -> None:
        n = len(places)
        numbers = np.full((27, VOXELS), -1, dtype=np.int32)
        brick = np.ravel_multi_index(tuple(places.T // 8), SHAPE)
        numbers[brick, np.ravel_multi_index(tuple(places.T % 8), (8, 8, 8))] = np.arange(n)
        # Heights within the voxel, from its middle, in whole steps.
        sums = np.zeros((n, N_SUMS), dtype=np.int64)
        steps = np.round(heights * STEPS_PER_VOXEL).astype(np.int64)
        sums[:, 0], sums[:, 3], sums[:, 9] = 1, steps, steps**2
        self.regions = np.full(n, -2, dtype=np.int32)
        self.count = grow_regions(
            places.astype(np.int32),
            np.arange(27, dtype=np.int32).reshape(SHAPE),
            numbers,
            sums,
            normals.astype(np.float32),
            np.arange(n) if seeds is None else seeds,
            np.array([COSINE, reach]),
            self.regions,
        )


def level(rows: int, columns: int, height: int = 10) -> NDArray[np.int64]:
    """(n, 3) voxels of a level layer."""
    a, b = np.mgrid[2 : 2 + rows, 2 : 2 + columns]
    return np.column_stack([a.ravel(), b.ravel(), np.full(a.size, height)])


def up(n: int) -> NDArray[np.float64]:
    return np.tile([0.0, 0.0, 1.0], (n, 1))


def test_neighbours_join_also_across_corners_and_bricks() -> None:
    layer = level(15, 12)
    grown = Grown(layer, np.zeros(180), up(180))
    assert grown.count == 1
    assert (grown.regions == 0).all()
    diagonal = np.array([[k, k, k] for k in range(5, 12)])
    lean = np.tile([1.0, -1.0, 0.0], (7, 1)) / math.sqrt(2.0)
    assert Grown(diagonal, np.zeros(7), lean).count == 1
    # One voxel between them is a gap.
    gap = layer[layer[:, 0] != 9]
    grown = Grown(gap, np.zeros(len(gap)), up(len(gap)))
    assert grown.count == 2
    np.testing.assert_array_equal(grown.regions, (gap[:, 0] > 9).astype(int))


def test_voxels_whose_normal_turns_by_more_than_the_angle_stay_out() -> None:
    layer = level(6, 6)
    for angle_deg, joins in ((9.5, True), (10.5, False)):
        turn = math.radians(angle_deg)
        normals = up(36)
        normals[14] = [math.sin(turn), 0.0, -math.cos(turn)]
        grown = Grown(layer, np.zeros(36), normals)
        assert grown.count == (1 if joins else 2)
        assert (np.delete(grown.regions, 14) == 0).all()


def test_voxels_further_from_the_plane_than_the_reach_stay_out() -> None:
    layer = level(6, 6)
    for height, joins in ((0.28, True), (0.35, False), (-0.28, True), (-0.35, False)):
        heights = np.zeros(36)
        heights[20] = height
        grown = Grown(layer, heights, up(36))
        assert bool(grown.regions[20] == 0) is joins, height
        assert (np.delete(grown.regions, 20) == 0).all()


def test_the_plane_follows_its_region_as_it_grows() -> None:
    """A ramp of four degrees: with the first voxel's plane the far end is out of reach."""
    layer = level(20, 5, height=8)
    rise = math.tan(math.radians(4.0)) * (layer[:, 0] - 2)
    layer[:, 2] += np.round(rise).astype(int)
    grown = Grown(layer, rise - np.round(rise), up(100), reach=0.25)
    assert grown.count == 1


def test_seeds_start_in_their_order_and_voxels_that_may_not_join_do_not() -> None:
    first, second = level(4, 4), level(4, 4, height=14)
    places = np.concatenate([first, second])
    grown = Grown(places, np.zeros(32), up(32), seeds=np.arange(31, -1, -1))
    np.testing.assert_array_equal(grown.regions, np.repeat([1, 0], 16))
    only = Grown(places, np.zeros(32), up(32), seeds=np.arange(16))
    assert only.count == 1
    np.testing.assert_array_equal(only.regions, np.repeat([0, -2], 16))


# --- groups of normals ---


def wall_voxels(basis: NDArray[np.float64]) -> tuple[SurfaceVoxels, Rectangle]:
    wall = Rectangle("wall", (0.3, 2.0, 0.1), (1.2, 0.2, 0), (0, 0.1, 0.9), 30_000)
    cloud = cloud_of(sampled((wall,), noise_m=0.001))
    prepared = prepare(cloud, basis, cell_m=0.5, least_share=0.005, parts=1)
    wanted = Neighbourhood(shape="cube", size_m=0.15, n_points=30, voxel_m=0.05)
    return surface_voxels(prepared, wanted), wall


BASIS: Final = scenes.random_rotation(np.random.default_rng(2))


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_normals_face_the_viewer(side: float) -> None:
    voxels, wall = wall_voxels(BASIS)
    viewer = np.array(wall.centre) + side * wall.normal + np.array([0.1, 0.0, 0.2])
    normals = facing(voxels, viewer) @ BASIS
    assert (normals @ (side * wall.normal) > 0.9).mean() > 0.95
    np.testing.assert_allclose(np.abs(facing(voxels, viewer)), np.abs(voxels.normals), atol=1e-7)


def test_a_region_s_plane_is_that_of_its_points_whatever_the_axes() -> None:
    voxels, wall = wall_voxels(BASIS)
    points = sampled((wall,), noise_m=0.001)
    totals = np.zeros(10)
    # Moments from the middle of the first voxel, in sides of a voxel.
    local = (points @ BASIS.T - voxels.grid.low_m) / voxels.grid.cell_m - 0.5
    totals[0], totals[1:4] = len(points), local.sum(axis=0)
    products = local.T @ local
    totals[4:] = products[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    plane = _plane(totals, voxels)
    assert plane is not None
    expected = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2]
    assert abs(plane.normal @ expected) == pytest.approx(1.0, abs=1e-9)
    assert plane.distances_m(points.mean(axis=0)[None])[0] == pytest.approx(0.0, abs=1e-9)
    same = np.zeros(10)
    same[0] = 5.0
    assert _plane(same, voxels) is None


def test_the_direction_of_most_points_is_their_mean() -> None:
    rng = np.random.default_rng(0)
    true = np.array([0.6, 0.0, 0.8])
    near = true + 0.02 * rng.normal(size=(400, 3))
    far = rng.normal(size=(300, 3))
    normals = np.concatenate([near, far])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    weights = rng.uniform(1.0, 3.0, 700)
    found = _common_direction(normals, weights, 10.0)
    within = normals @ found >= COSINE
    mean = weights[within] @ normals[within]
    np.testing.assert_allclose(found, mean / np.linalg.norm(mean), atol=1e-5)
    assert found @ true > math.cos(math.radians(0.5))
    # A few heavy ones count more than many light ones.
    heavy = np.where(np.arange(700) >= 400, 1e-6, weights)
    heavy[650] = 1e6
    assert _common_direction(normals, heavy, 10.0) @ normals[650] > 0.999


def test_of_a_group_the_layer_with_most_points_gives_the_plane() -> None:
    upper = Rectangle("front", (0, 2.0, 0), (1.0, 0, 0), (0, 0, 1.0), 20_000)
    lower = Rectangle("niche", (2.5, 2.4, 0), (0.5, 0, 0), (0, 0, 1.0), 6_000)
    cloud = cloud_of(sampled((upper, lower), noise_m=0.001))
    prepared = prepare(cloud, np.eye(3), cell_m=0.5, least_share=0.005, parts=1)
    wanted = Neighbourhood(shape="cube", size_m=0.15, n_points=30, voxel_m=0.05)
    voxels: Any = surface_voxels(prepared, wanted)
    member = np.ones(len(voxels.counts), dtype=np.bool_)
    rough = Plane(normal=np.array([0.0, 1.0, 0.0]), offset_m=2.1)
    found = _densest(voxels, member, rough)
    assert abs(found.normal[1]) > math.cos(math.radians(0.5))
    assert abs(found.distances_m(np.array([[0.0, 2.0, 0.0]]))[0]) < 0.005
