"""Voxels of a cloud against loops over all of them: sums, normals, and points that are alone."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.files.clouds import neighbourhoods as module
from orthoflow.files.clouds.neighbourhoods import neighbourhoods_of
from orthoflow.products import PointCloud


def cloud_of(offsets: NDArray[np.floating]) -> PointCloud:
    x, y, z = (np.ascontiguousarray(axis) for axis in offsets.T.astype(np.float32))
    return PointCloud(origin=np.full(3, 1e6), x=x, y=y, z=z, up=np.array([0.0, 0.0, 1.0]))


def voxels(
    offsets: NDArray[np.floating], low: NDArray[np.float64], side_m: float
) -> list[tuple[int, ...]]:
    exact = offsets.astype(np.float32).astype(np.float64)
    return [tuple(place) for place in np.floor((exact - low) / side_m).astype(int).tolist()]


@pytest.mark.parametrize("at_once", [1 << 20, 17])
def test_moments_are_those_of_each_voxels_points(
    monkeypatch: pytest.MonkeyPatch, at_once: int
) -> None:
    monkeypatch.setattr(module, "_AT_ONCE", at_once)
    offsets = np.random.default_rng(1).uniform(0.0, 1.0, (90, 3)).astype(np.float32)
    low, side_m = np.full(3, -1.5), 0.25
    keys, moments = module._moments(cloud_of(offsets), low, side_m)
    of = voxels(offsets, low, side_m)
    # Keys are in the order of the voxels' places.
    assert len(keys) == len(set(of))
    assert (np.diff(keys) > 0).all()
    for place, found in zip(sorted(set(of)), moments, strict=True):
        x, y, z = offsets[[one == place for one in of]].astype(np.float64).T
        sums = [x.sum(), y.sum(), z.sum()]
        products = [x @ x, x @ y, x @ z, y @ y, y @ z, z @ z]
        np.testing.assert_allclose(found, [len(x), *sums, *products], rtol=1e-12)


def keys_of(places: NDArray[np.int64]) -> NDArray[np.int64]:
    return module._keys(places + 0.5, np.zeros(3), 1.0)


def random_places(seed: int, n: int, size: int) -> NDArray[np.int64]:
    """Voxels in the order of their keys, some of them neighbours, some not."""
    drawn = np.random.default_rng(seed).integers(5, 5 + size, (n, 3))
    return np.unique(drawn, axis=0)


@pytest.mark.parametrize("seed", range(3))
def test_neighbours_are_the_twenty_six_about_a_voxel_and_itself(seed: int) -> None:
    places = random_places(seed, 60, 6)
    values = np.random.default_rng(seed).normal(size=(len(places), 2))
    expected = [values[(np.abs(places - place) <= 1).all(axis=1)].sum(axis=0) for place in places]
    found = module._neighbour_sums(keys_of(places), values)
    np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_points_are_alone_where_fewer_than_ten_lie_about_them(seed: int) -> None:
    # Sparse: most have a handful about them.
    places = random_places(seed, 300, 40)
    counts = np.random.default_rng(seed).integers(1, 5, len(places)).astype(np.float64)
    coarse = places // 3
    about = np.array([counts[(np.abs(coarse - place) <= 1).all(axis=1)].sum() for place in coarse])
    assert {9.0, 10.0} <= set(about)
    np.testing.assert_array_equal(module._alone(keys_of(places), counts), about < 10)


def box(half: tuple[float, float, float]) -> NDArray[np.float64]:
    return np.array(list(product((-1.0, 1.0), repeat=3))) * half + 0.5


@pytest.mark.parametrize(
    ("points", "is_surface"),
    [
        # Half as thick as wide is the most.
        (box((0.4, 0.2, 0.098)), True),
        (box((0.4, 0.2, 0.102)), False),
        # Six points are enough, five are not.
        (box((0.4, 0.2, 0.01))[:6], True),
        (box((0.4, 0.2, 0.01))[:5], False),
    ],
    ids=["flat", "thick", "six", "five"],
)
def test_a_surface_is_half_as_thick_as_wide_at_most_and_has_six_points(
    points: NDArray[np.float64], is_surface: bool
) -> None:
    keys, moments = module._moments(cloud_of(points), np.full(3, -10.0), 1.0)
    assert len(keys) == 1
    (normal,) = module._normals(keys, moments)
    if is_surface:
        # Of the direction in which they spread least.
        _, vectors = np.linalg.eigh(np.cov(points.astype(np.float32).T))
        assert abs(float(normal @ vectors[:, 0])) == pytest.approx(1.0, abs=1e-4)
    else:
        assert not normal.any()


def test_normals_take_the_voxels_about_them_together() -> None:
    grid = np.stack(np.meshgrid(np.arange(24), np.arange(24)), axis=-1).reshape(-1, 2) / 8.0
    tilted = np.column_stack([grid, 0.5 * grid[:, 0] - 0.25 * grid[:, 1]])
    near = neighbourhoods_of(cloud_of(tilted))
    truth = np.array([-0.5, 0.25, 1.0]) / np.linalg.norm([-0.5, 0.25, 1.0])
    found = near.normals[near.places(tilted.astype(np.float32).astype(np.float64))]
    # At the very corner a voxel may have too few about it.
    known = found.any(axis=1)
    assert known.mean() > 0.99
    np.testing.assert_allclose(np.abs(found[known] @ truth), 1.0, atol=1e-4)
    assert not near.alone.any()
    assert (module._normals(np.zeros(0, np.int64), np.zeros((0, 10)))).shape == (0, 3)


def test_nine_points_beside_a_wall_are_alone_and_ten_are_not() -> None:
    grid = np.stack(np.meshgrid(np.arange(80), np.arange(80)), axis=-1).reshape(-1, 2) / 100.0
    wall = np.column_stack([grid, np.zeros(len(grid))])
    for n_beside in (9, 10):
        beside = np.array([0.4, 0.4, 3.0]) + 0.001 * np.arange(n_beside)[:, None]
        offsets = np.vstack([wall, beside]).astype(np.float32).astype(np.float64)
        near = neighbourhoods_of(cloud_of(offsets))
        alone = near.alone[near.places(offsets)]
        assert alone[: len(wall)].sum() == 0
        assert alone[len(wall) :].tolist() == [n_beside < 10] * n_beside


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize(("far_m", "place"), [(1e12, 2_097_144), (9e5, 1_800_000), (-1e12, 3)])
def test_what_lies_far_away_is_in_no_voxel_of_others(axis: int, far_m: float, place: int) -> None:
    offsets = np.full((1, 3), 5.1)
    offsets[0, axis] = far_m
    (key,) = module._keys(offsets, np.zeros(3), 0.5).tolist()
    # Three numbers of 21 bits, each with room for its neighbours.
    found = [key >> 42, key >> 21 & 0x1FFFFF, key & 0x1FFFFF]
    expected = [10, 10, 10]
    expected[axis] = place
    assert found == expected
