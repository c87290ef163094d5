"""Compiled passes over voxels against plain formulations of the same, on random input."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.kernels import (
    BLOCK_POINTS,
    BlockedPoints,
    blocked,
    box_blocks,
    piece_of,
)
from orthoflow_plugins.plane.voxel_kernels import (
    N_SUMS,
    STEPS_PER_VOXEL,
    VOXELS,
    claim_voxels,
    coarsened,
    count_voxels,
    find_voxels,
    fit_neighbourhoods,
    gather_moments,
    merge_moments,
    sum_regions,
    voxel_places,
    with_room,
)

from orthoflow.geometry.point_kernels import read_only

# Bricks along a, b, c: 16 x 24 x 16 voxels.
SHAPE: Final = (2, 3, 2)
N_POINTS: Final = 4 * BLOCK_POINTS + 100
PAIRS: Final = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


@dataclass(frozen=True)
class Scene:
    """Points in voxels: (n, 3) places of their voxels and steps within, some outside the table."""

    points: BlockedPoints
    voxels: NDArray[np.int64]
    steps: NDArray[np.int64]

    # Voxel of a point: frame @ p - frame[:, 3]. All numbers are such that float32 is exact.
    axes = 4.0 * np.array([[1.0, 2.0, -1.0], [2.0, 5.0, 1.0], [3.0, 5.0, -5.0]])
    frame = np.column_stack([axes, [-8.0, -12.0, -16.0]]).astype(np.float32)

    @classmethod
    def random(cls, seed: int) -> Scene:
        rng = np.random.default_rng(seed)
        size = 8 * np.array(SHAPE)
        voxels = np.repeat(rng.integers(-1, size + 1, (N_POINTS // 3, 3)), 4, axis=0)[:N_POINTS]
        steps = 16 * rng.integers(0, STEPS_PER_VOXEL // 16, voxels.shape)
        places = voxels + steps / STEPS_PER_VOXEL
        offsets = (places + cls.frame[:, 3]) @ np.round(4.0 * np.linalg.inv(cls.axes)).T / 4.0
        columns = read_only(*np.ascontiguousarray(offsets.T.astype(np.float32)))
        points = blocked(columns, box_blocks(columns, parts=1).boxes)
        return cls(points, voxels, steps)

    @property
    def inside(self) -> NDArray[np.bool_]:
        return ((self.voxels >= 0) & (self.voxels < 8 * np.array(SHAPE))).all(axis=1)

    @property
    def keys(self) -> NDArray[np.int64]:
        """(n,) brick times its voxels plus the voxel within; -1 outside."""
        brick = np.ravel_multi_index(tuple(self.voxels.T // 8), SHAPE, mode="clip")
        within = np.ravel_multi_index(tuple(self.voxels.T % 8), (8, 8, 8))
        return np.where(self.inside, brick * VOXELS + within, -1)


class Tables:
    """What moments are gathered in."""

    def __init__(self) -> None:
        self.bricks = np.full(int(np.prod(SHAPE)), -1, dtype=np.int32)
        self.numbers = np.zeros((BLOCK_POINTS, VOXELS), dtype=np.int32)
        self.sums = np.zeros((BLOCK_POINTS, N_SUMS), dtype=np.int64)
        self.n_used = np.zeros(2, dtype=np.int64)

    def gather(self, points: BlockedPoints) -> None:
        start = 0
        while start < len(points.x):
            self.numbers = with_room(self.numbers, int(self.n_used[0]), BLOCK_POINTS)
            self.sums = with_room(self.sums, int(self.n_used[1]), BLOCK_POINTS)
            before = start
            start = gather_moments(
                points, start, Scene.frame, SHAPE, self.bricks, self.numbers, self.sums, self.n_used
            )
            assert start > before

    def by_key(self) -> dict[int, NDArray[np.int64]]:
        """Moments of voxels by their keys; each has one number, and numbers are used in turn."""
        found, numbers = {}, []
        for brick, row in enumerate(self.bricks):
            if row < 0:
                continue
            for voxel in np.flatnonzero(self.numbers[row] >= 0):
                numbers.append(int(self.numbers[row, voxel]))
                found[brick * VOXELS + int(voxel)] = self.sums[numbers[-1]]
        assert sorted(numbers) == list(range(int(self.n_used[1])))
        return found


def moments_of(steps: NDArray[np.int64]) -> NDArray[np.int64]:
    """(10,) number, sums and products of steps from the middle of a voxel."""
    centred = steps - STEPS_PER_VOXEL // 2
    products = [int((centred[:, i] * centred[:, j]).sum()) for i, j in PAIRS]
    return np.array([len(steps), *centred.sum(axis=0), *products])


@pytest.mark.parametrize("seed", range(3))
def test_voxels_hold_the_moments_of_their_points(seed: int) -> None:
    scene = Scene.random(seed)
    whole, other = Tables(), Tables()
    cut = 2 * BLOCK_POINTS
    whole.gather(piece_of(scene.points, slice(0, cut)))
    other.gather(piece_of(scene.points, slice(cut, N_POINTS)))
    n_rows, n_voxels = (int(n) for n in other.n_used)
    whole.numbers = with_room(whole.numbers, int(whole.n_used[0]), n_rows)
    whole.sums = with_room(whole.sums, int(whole.n_used[1]), n_voxels)
    merge_moments(
        other.bricks, other.numbers, other.sums,
        whole.bricks, whole.numbers, whole.sums, whole.n_used,
    )  # fmt: skip
    found = whole.by_key()
    assert found.keys() == set(scene.keys[scene.inside].tolist())
    for key, sums in found.items():
        np.testing.assert_array_equal(sums, moments_of(scene.steps[scene.keys == key]))
    bricks = whole.bricks.reshape(SHAPE)
    voxel_of = np.full(N_POINTS, -7, dtype=np.int32)
    find_voxels(scene.points, Scene.frame, bricks, whole.numbers, voxel_of)
    np.testing.assert_array_equal(voxel_of >= 0, scene.inside)
    for key in found:
        numbers = set(voxel_of[scene.keys == key].tolist())
        assert numbers == {int(whole.numbers[whole.bricks[key // VOXELS], key % VOXELS])}
    owners = np.random.default_rng(seed).integers(-1, 5, int(whole.n_used[1])).astype(np.int8)
    claims = np.full(N_POINTS, 9, dtype=np.int8)
    claim_voxels(scene.points, Scene.frame, bricks, whole.numbers, owners, claims)
    np.testing.assert_array_equal(claims, np.where(voxel_of >= 0, owners[voxel_of], -1))


def test_points_in_voxels_that_nobody_has_are_in_none() -> None:
    scene = Scene.random(0)
    tables = Tables()
    tables.gather(piece_of(scene.points, slice(0, BLOCK_POINTS)))
    known = np.isin(scene.keys, [key for key in tables.by_key() if key >= 0])
    voxel_of = np.full(N_POINTS, -7, dtype=np.int32)
    bricks = tables.bricks.reshape(SHAPE)
    find_voxels(scene.points, Scene.frame, bricks, tables.numbers, voxel_of)
    assert 0 < np.count_nonzero(known) < N_POINTS
    np.testing.assert_array_equal(voxel_of >= 0, known)


def test_voxels_count_their_points_with_more_room_whenever_the_table_is_full() -> None:
    scene = Scene.random(0)
    bricks = np.full(int(np.prod(SHAPE)), -1, dtype=np.int32)
    counts, n_used = np.zeros((BLOCK_POINTS, VOXELS), dtype=np.int32), np.zeros(1, dtype=np.int64)
    start = count_voxels(scene.points, 0, Scene.frame, SHAPE, bricks, counts, n_used)
    # One block may need as many bricks as it has points.
    assert start == BLOCK_POINTS
    while start < N_POINTS:
        counts = with_room(counts, int(n_used[0]), BLOCK_POINTS)
        start = count_voxels(scene.points, start, Scene.frame, SHAPE, bricks, counts, n_used)
    assert start == N_POINTS
    expected = np.bincount(scene.keys[scene.inside], minlength=bricks.size * VOXELS)
    occupied = np.flatnonzero(bricks >= 0)
    np.testing.assert_array_equal(np.sort(bricks[occupied]), np.arange(n_used[0]))
    found = np.zeros((bricks.size, VOXELS), dtype=np.int64)
    found[occupied] = counts[bricks[occupied]]
    np.testing.assert_array_equal(found.ravel(), expected)


def test_rooms_grow_and_keep_what_is_in_use() -> None:
    table = np.arange(12).reshape(6, 2)
    assert with_room(table, 4, 2) is table
    wider = with_room(table, 4, 3)
    assert wider.shape == (8, 2)
    np.testing.assert_array_equal(wider[:4], table[:4])
    assert not wider[4:].any()
    assert with_room(table, 1, 9).shape == (10, 2)


def test_voxels_grow_where_bricks_would_be_too_many() -> None:
    assert coarsened(0.02, np.array([10.0, 10.0, 5.0])) == 0.02
    extent_m = np.array([2000.0, 2000.0, 300.0])
    voxel_m = coarsened(0.02, extent_m)
    bricks = np.prod(extent_m / (8.0 * voxel_m))
    assert bricks == pytest.approx(8e6, rel=0.01)


def test_places_of_voxels_follow_their_bricks() -> None:
    bricks = np.zeros(SHAPE, dtype=bool)
    bricks[0, 2, 1] = bricks[1, 0, 0] = True
    occupied = np.zeros((2, VOXELS), dtype=bool)
    occupied[0, [0, 8 * 8 * 3 + 8 * 5 + 7]] = occupied[1, 8 * 8 * 7 + 1] = True
    places = voxel_places(bricks, occupied)
    np.testing.assert_array_equal(places, [[0, 16, 8], [3, 21, 15], [15, 0, 1]])


# --- planes and regions of voxels ---


def dense_voxels(
    seed: int,
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int64], list[NDArray[np.float64]]]:
    """Numbers, places and sums of voxels at the corner of a table, and the points in each.

    Points are in the middle of their steps, in sides of a voxel.
    """
    rng = np.random.default_rng(seed)
    places = np.ascontiguousarray(np.argwhere(rng.random((6, 6, 6)) < 0.4), dtype=np.int32) + 4
    numbers = np.full((int(np.prod(SHAPE)), VOXELS), -1, dtype=np.int32)
    brick = np.ravel_multi_index(tuple(places.T // 8), SHAPE)
    numbers[brick, np.ravel_multi_index(tuple(places.T % 8), (8, 8, 8))] = np.arange(len(places))
    points, sums = [], []
    for place in places:
        steps = rng.integers(0, STEPS_PER_VOXEL, (int(rng.integers(1, 4)), 3))
        sums.append(moments_of(steps))
        points.append(place + (steps + 0.5) / STEPS_PER_VOXEL - 0.5)
    return numbers, places, np.array(sums), points


def test_regions_sum_the_moments_of_all_their_points() -> None:
    _, places, sums, points = dense_voxels(0)
    regions = np.random.default_rng(1).integers(-2, 3, len(places)).astype(np.int32)
    totals = np.zeros((3, 10))
    sum_regions(places, sums, regions, totals)
    for region, total in enumerate(totals):
        held = np.concatenate([points[k] for k in np.flatnonzero(regions == region)])
        products = [(held[:, i] * held[:, j]).sum() for i, j in PAIRS]
        np.testing.assert_allclose(total, [len(held), *held.sum(axis=0), *products], rtol=1e-12)


@pytest.mark.parametrize("enough", [6, 2**62])
def test_neighbourhoods_end_with_the_shell_that_has_enough_points(enough: int) -> None:
    numbers, places, sums, points = dense_voxels(2)
    bricks = np.arange(int(np.prod(SHAPE)), dtype=np.int32).reshape(SHAPE)
    axis = np.arange(-5, 6)
    steps = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    shells = np.abs(steps).max(axis=1)
    kept = (shells > 0) & (shells <= 2)
    order = np.argsort(shells[kept], kind="stable")
    around = np.column_stack([steps[kept], shells[kept]])[order].astype(np.int32)
    first = 5
    asked = places[first:]
    normals, spreads = np.empty((2, len(asked), 3), dtype=np.float32)
    fit_neighbourhoods(asked, first, bricks, numbers, sums, around, enough, normals, spreads)
    n_enough = 0
    for place, normal, spread in zip(asked, normals, spreads, strict=True):
        away = np.abs(places - place).max(axis=1)
        for shell in range(3):
            held = np.concatenate([points[k] for k in np.flatnonzero(away <= shell)])
            if len(held) >= enough:
                n_enough += shell < 2
                break
        variances, directions = np.linalg.eigh(np.cov(held.T, bias=True))
        assert abs(normal @ directions[:, 0]) == pytest.approx(1.0, abs=1e-5)
        np.testing.assert_allclose(spread, np.sqrt(np.maximum(variances, 0.0)), atol=2e-6)
    assert (n_enough > 0) == (enough == 6)


def test_a_voxel_with_two_points_has_no_plane() -> None:
    numbers = np.full((12, VOXELS), -1, dtype=np.int32)
    numbers[0, 0], numbers[0, 7] = 0, 1
    places = np.array([[0, 0, 0], [0, 0, 7]], dtype=np.int32)
    steps = np.array([[1, 2, 3], [500, 600, 90], [900, 20, 7]])
    sums = np.array([moments_of(steps[:2]), moments_of(steps)])
    bricks = np.arange(12, dtype=np.int32).reshape(SHAPE)
    around = np.array([[-1, 0, 0, 1], [0, 0, -1, 1]], dtype=np.int32)
    normals, spreads = np.empty((2, 2, 3), dtype=np.float32)
    fit_neighbourhoods(places, 0, bricks, numbers, sums, around, 2**62, normals, spreads)
    np.testing.assert_array_equal(normals[0], [0.0, 0.0, 1.0])
    np.testing.assert_array_equal(spreads[0], [np.inf, 0.0, 0.0])
    assert np.isfinite(spreads[1]).all()
