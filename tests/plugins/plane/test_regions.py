"""Regions of voxels: which voxels join, which way normals face, and the planes of groups."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.regions import (
    Growth,
    RegionProposer,
    Regions,
    _common_direction,
    _densest,
    _is_crumb,
    _is_thin,
    _plane,
    claim_by_region,
    facing,
)
from orthoflow_plugins.plane.sample import prepare
from orthoflow_plugins.plane.surface_voxels import Neighbourhood, SurfaceVoxels, surface_voxels
from orthoflow_plugins.plane.voxel_kernels import N_SUMS, STEPS_PER_VOXEL, VOXELS, grow_regions

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


# --- what regions propose ---


def regions_of(n_points: list[int], planes: dict[int, Plane]) -> Regions:
    return Regions(
        voxels=None,  # type: ignore[arg-type] # nobody asks them
        region_of_voxel=np.zeros(0, dtype=np.int32),
        n_points=np.array(n_points),
        planes=planes,
        starts=planes,
    )


def rising(rise_deg: float) -> Plane:
    rise = math.radians(rise_deg)
    return Plane(normal=np.array([math.cos(rise), 0.0, math.sin(rise)]), offset_m=rise_deg)


def proposer(samples: list[int], planes: dict[int, Plane], **known: Any) -> RegionProposer:
    plain: dict[str, Any] = {
        "regions": regions_of([100, 200, 300, 400], planes),
        "region_of_sample": np.array(samples, dtype=np.int32),
        "family": "any",
        "tilt_most_deg": 10.0,
        "least_points": 7.5,
        "proposes_once": False,
    }
    return RegionProposer(**{**plain, **known})


def free(claims: list[int]) -> Any:
    return SimpleNamespace(claims=np.array(claims), up=np.array([0.0, 0.0, 1.0]))


# Four points of region 2, three of 0, two of 1, one of 3, two of none.
SAMPLES = [2, 0, 1, -1, 2, 0, 2, 1, 3, 0, 2, -1]
NOBODY = [-1] * 12
PLANES = {0: rising(0.0), 1: rising(20.0), 2: rising(80.0), 3: rising(5.0)}


def test_the_region_with_most_free_points_comes_first_and_a_rejected_one_not_again() -> None:
    over = proposer(SAMPLES, PLANES)
    found = []
    while (candidate := over.propose(free(NOBODY))) is not None:
        found.append(candidate)
        over.reject(candidate)
    # A region needs a share of 0.2 of what a plane needs in the sample: one and a half.
    assert [one.plane.offset_m for one in found] == [80.0, 0.0, 20.0]
    assert [one.votes for one in found] == [300.0, 100.0, 200.0]
    assert all(one.start is one.plane and one.family == "any" for one in found)
    # What planes have taken counts no more.
    over = proposer(SAMPLES, PLANES)
    candidate = over.propose(free([0 if region == 2 else -1 for region in SAMPLES]))
    assert candidate is not None
    assert candidate.plane is PLANES[0]
    again = over.propose(free(NOBODY))
    assert again is not None
    assert again.plane is PLANES[2]


def test_a_region_that_proposes_once_has_one_plane() -> None:
    for once, second in ((False, PLANES[2]), (True, PLANES[0])):
        over = proposer(SAMPLES, PLANES, proposes_once=once)
        first = over.propose(free(NOBODY))
        assert first is not None
        assert first.plane is PLANES[2]
        again = over.propose(free(NOBODY))
        assert again is not None
        assert again.plane is second


def test_regions_without_a_plane_are_passed_over() -> None:
    found = proposer(SAMPLES, {1: PLANES[1]}).propose(free(NOBODY))
    assert found is not None
    assert found.plane is PLANES[1]
    assert proposer(SAMPLES, {}).propose(free(NOBODY)) is None


@pytest.mark.parametrize(
    ("family", "rises_deg"),
    # Ten degrees, and three more before a plane is fitted to all points.
    [
        ("wall", {0.0: True, 12.9: True, -12.9: True, 13.1: False, 90.0: False}),
        ("level", {0.0: False, 76.9: False, 77.1: True, -77.1: True, 90.0: True}),
        ("any", {0.0: True, 45.0: True, 90.0: True}),
    ],
)
def test_regions_lean_a_little_more_than_planes_may(
    family: str, rises_deg: dict[float, bool]
) -> None:
    for rise_deg, is_proposed in rises_deg.items():
        over = proposer([0] * 12, {0: rising(rise_deg)}, family=family)
        assert (over.propose(free(NOBODY)) is not None) is is_proposed


class Voxels:
    """Stand for voxels: they keep whom they are given to."""

    owners: NDArray[np.int8]

    def claim(self, _cloud: object, owners: NDArray[np.int8]) -> None:
        self.owners = owners


def test_a_region_is_of_the_plane_that_most_of_its_points_are_near() -> None:
    region_of_sample = np.array([0] * 4 + [1] * 4 + [2] * 3 + [-1])
    # Of region 0 three are near plane 1 and one near 0; of 1 half are near any; of 2 two are.
    claims = np.array([1, 1, 1, 0, 0, 0, -1, -1, 0, 0, -1, 1], dtype=np.int8)
    voxels = Voxels()
    regions: Any = SimpleNamespace(
        region_of=lambda _: region_of_sample,
        region_of_voxel=np.array([0, 1, 2, -1, 2, 0]),
        n_points=np.zeros(3),
        voxels=voxels,
    )
    cloud: Any = SimpleNamespace(sample_claims=claims, sample=SimpleNamespace(points=None))
    claim_by_region([None, None], regions, cloud)  # type: ignore[list-item]
    assert voxels.owners.tolist() == [1, -1, 0, -1, 0, 1]


def test_crumbs_are_in_no_region_or_in_one_with_few_points() -> None:
    voxels: Any = SimpleNamespace(counts=np.array([5, 7, 2, 9, 1]))
    growth = Growth(angle_deg=10.0, distance_m=0.1, least_points=12.0)
    found = _is_crumb(voxels, np.array([0, 0, 1, -1, 1], dtype=np.int32), growth)
    assert found.tolist() == [False, False, True, True, True]


@pytest.mark.parametrize(("mean", "is_thin"), [(5.3, True), (5.4, False)])
def test_a_cloud_is_thin_where_neighbourhoods_have_few_points(mean: float, is_thin: bool) -> None:
    # Three voxels across: nine on a surface; 48 points are enough.
    cube = Neighbourhood(shape="cube", size_m=0.15, n_points=30, voxel_m=0.05)
    voxels: Any = SimpleNamespace(neighbourhood=cube)
    assert _is_thin(voxels, np.array([mean - 2.0, mean + 2.0])) is is_thin


def test_normals_on_either_side_of_a_group_count_alike() -> None:
    """The direction is the mean, by points, of normals turned to one side."""
    tilts = np.radians([0.0, 8.0, 0.0, 8.0])
    sides = np.array([1.0, -1.0, -1.0, 1.0])
    normals = sides[:, None] * np.column_stack([np.sin(tilts), np.zeros(4), np.cos(tilts)])
    places = np.array([[0.5, 0.5, 2.5], [1.5, 0.5, 2.5], [2.5, 0.5, 2.5], [3.5, 0.5, 9.5]])
    voxels: Any = SimpleNamespace(
        grid=SimpleNamespace(basis=np.eye(3), cell_m=1.0),
        counts=np.array([10, 10, 30, 30]),
        normals=normals,
        centroids=lambda: places,
    )
    rough = Plane(normal=np.array([0.0, 0.0, 1.0]), offset_m=0.0)
    found = _densest(voxels, np.ones(4, dtype=bool), rough)
    mean = 40 * np.array([0.0, 0.0, 1.0]) + 40 * np.array(
        [math.sin(math.radians(8.0)), 0.0, math.cos(math.radians(8.0))]
    )
    np.testing.assert_allclose(found.normal, mean / np.linalg.norm(mean), atol=1e-9)
    # Most points lie in the lower layer, and the plane in their middle.
    along = places[:3] @ found.normal
    assert found.offset_m == pytest.approx(np.average(along, weights=[10, 10, 30]))
