"""The 3D accumulator: its voxels, what planes take of them, its pictures and its maxima."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane import sample, space_accumulators
from orthoflow_plugins.plane.sample import Claim, PreparedCloud, Unassigned, prepare
from orthoflow_plugins.plane.space_accumulators import (
    SpaceProposer,
    SpaceVoting,
    VoxelCounts,
    directions_over,
    pictured,
)
from orthoflow_plugins.plane.surface_voxels import _summed
from orthoflow_plugins.plane.voxel_kernels import STEPS_PER_VOXEL

from orthoflow.geometry import angle_between_deg
from tests import scenes
from tests.plane_scenes import Rectangle, cloud_of, sampled

PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
BASIS = scenes.random_rotation(np.random.default_rng(9))


def prepared_cloud(points: NDArray[np.float64], basis: NDArray[np.float64]) -> PreparedCloud:
    return prepare(cloud_of(points), basis, cell_m=0.25, least_share=0.005, parts=2)


def random_voxels(voxel_m: float) -> tuple[VoxelCounts, PreparedCloud]:
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (4_000, 3)) * [1.0, 1.4, 0.8]
    cloud = prepared_cloud(points, BASIS)
    return VoxelCounts(cloud, voxel_m), cloud


def middles_of(voxels: VoxelCounts) -> NDArray[np.float64]:
    """(m, 3) middles of the voxels in the cloud's offsets."""
    return (voxels.middles_m.T.astype(np.float64) + voxels.middle_m) @ voxels.basis


def test_voxels_have_the_points_about_their_middle() -> None:
    voxels, cloud = random_voxels(0.3)
    placed = np.floor((cloud.sample.offsets_m @ BASIS.T - cloud.grid.low_m) / 0.3).astype(int)
    expected = Counter(map(tuple, placed.tolist()))
    framed = voxels.middles_m.T + voxels.middle_m - cloud.grid.low_m
    places = np.round(framed / 0.3 - 0.5).astype(int)
    np.testing.assert_allclose(framed / 0.3 - 0.5, places, atol=1e-4)
    found = Counter(dict(zip(map(tuple, places.tolist()), voxels.left.tolist(), strict=True)))
    # A few points lie outside of the robust box, or at the side of a voxel.
    apart = (expected - found) + (found - expected)
    assert apart.total() < 25
    assert voxels.left.sum() > 3_980
    np.testing.assert_allclose(
        voxels.raw_places(cloud.points).places_m.T,
        cloud.sample.offsets_m @ BASIS.T - voxels.middle_m,
        atol=1e-5,
    )


@pytest.mark.parametrize("find_m", [0.01, 0.35])
def test_a_plane_takes_the_voxels_that_it_runs_through_or_that_are_near(find_m: float) -> None:
    voxels, _ = random_voxels(0.1)
    before, middles = voxels.left.copy(), middles_of(voxels)
    normal = np.array([0.36, 0.48, 0.8])
    u, v = np.array([0.8, -0.6, 0.0]), np.array([0.48, 0.64, -0.6])
    bounds = [-0.5, 0.4, -0.6, 0.7]
    slab = np.array([*normal, 0.1, *u, 0.05, *v, -0.1])
    changes = voxels.take([Claim(slab=slab, bounds_m=np.array([find_m, *bounds]))])
    half = [0.05 * np.abs(BASIS @ axis).sum() for axis in (normal, u, v)]
    taken = np.abs(middles @ normal - 0.1) <= max(find_m, half[0])
    along, down = middles @ u - 0.05, middles @ v + 0.1
    taken &= (along >= bounds[0] - half[1]) & (along <= bounds[1] + half[1])
    taken &= (down >= bounds[2] - half[2]) & (down <= bounds[3] + half[2])
    assert 20 < np.count_nonzero(taken) < 0.8 * len(taken)
    np.testing.assert_array_equal(voxels.left, np.where(taken, 0, before))
    np.testing.assert_array_equal(changes.weights, -before[taken])
    np.testing.assert_array_equal(changes.places_m, voxels.middles_m[:, taken])
    # The same plane again has nothing left to take.
    claim = Claim(slab=slab, bounds_m=np.array([find_m, *bounds]))
    assert len(voxels.take([claim]).weights) == 0
    assert len(voxels.take([claim, claim]).weights) == 0
    near = voxels.near(np.array([0.0, 0.0, 1.0]), 0.3, 0.2)
    kept = (np.abs(voxels.middles_m[2] - 0.3) < 0.2) & (voxels.left > 0)
    np.testing.assert_array_equal(near.weights, voxels.left[kept])
    np.testing.assert_array_equal(near.places_m, voxels.middles_m[:, kept])


def test_a_plane_is_proposed_where_it_is_and_not_again_once_rejected() -> None:
    lean = math.radians(33.0)
    roof = Rectangle(
        "roof", (0.2, 0.1, 0.3), (1.2, 0.3, 0), (-0.2, 0.8 * math.cos(lean), 0.8 * math.sin(lean)),
        20_000,
    )  # fmt: skip
    cloud = prepared_cloud(sampled((roof,), noise_m=0.002), np.eye(3))
    voting = SpaceVoting(
        cell_m=0.04, angle_step_deg=3.0, least_points=2_000, tilt_most_deg=10.0, is_raw=False
    )
    proposer = SpaceProposer(cloud, voting)
    unassigned = Unassigned.of(cloud)
    first = proposer.propose(unassigned)
    assert first is not None
    assert first.family == "any"
    away_deg = angle_between_deg(first.plane.normal, roof.normal)
    assert min(away_deg, 180.0 - away_deg) < 0.3
    assert abs(first.plane.distances_m(np.array([roof.centre]))[0]) < 0.004
    assert 0.6 * 20_000 < first.votes <= 1.01 * 20_000
    # Nothing changed: the same again.
    again = proposer.propose(unassigned)
    assert again is not None
    np.testing.assert_array_equal(again.plane.normal, first.plane.normal)
    # Its surroundings are barred: what is proposed next are maxima further off than 2.2 steps.
    normals = proposer._directions.normals
    rejected = [proposer._last]
    votes = [first.votes]
    proposer.reject(first)
    # About the place in directions as near as that, and nowhere else.
    cosines = np.abs(normals @ normals[rejected[0][0]])
    is_near = np.degrees(np.arccos(np.minimum(cosines, 1.0))) < 2.2 * 3.0
    assert 3 < is_near.sum() < 30
    widths = np.where(is_near, 2 * proposer._smear_bins + 3, 0)
    np.testing.assert_array_equal(proposer._barred.sum(axis=1), widths)
    for _ in range(6):
        other = proposer.propose(unassigned)
        assert other is not None
        direction, place = proposer._last
        for earlier, middle in rejected:
            cosine = float(normals[direction] @ normals[earlier])
            n_bins = proposer._votes.shape[1]
            there = middle if cosine > 0.0 else n_bins - 1 - middle
            is_far = math.degrees(math.acos(min(1.0, abs(cosine)))) > 2.2 * 3.0
            assert is_far or abs(place - there) > proposer._smear_bins + 1
        rejected.append((direction, place))
        votes.append(other.votes)
        proposer.reject(other)
    assert votes == sorted(votes, reverse=True)
    assert votes[1] < 0.95 * votes[0]
    few = SpaceProposer(cloud, replace(voting, least_points=200_000))
    assert few.propose(unassigned) is None


def test_pictures_show_each_direction_where_it_is() -> None:
    directions = directions_over(30.0, "any", 10.0)
    n = len(directions.normals)
    rng = np.random.default_rng(0)
    votes = rng.integers(1, 9, (n, 12)).astype(np.int32)
    votes[:, :2] = votes[:, -3:] = 0
    scores = np.arange(1.0, n + 1.0)
    picture = pictured(directions, votes, scores, bin_m=0.5)
    # Two bins at either side are empty in all.
    assert picture.reach_m == 0.5 * 8 * 0.5
    assert picture.sections_deg == (0.0, 45.0, 90.0)
    step = math.radians(30.0)
    assert picture.best.shape == (6, 7)
    for (omega, phi), score in zip(directions.angles_rad, scores, strict=True):
        assert picture.best[round(omega / step), round((phi + 0.5 * math.pi) / step)] == score
    # The pole has one direction, which stands for all omegas; the south pole is the same one.
    assert (picture.best[:, 6] == picture.best[0, 6]).all()
    assert np.isnan(picture.best[:, 0]).all()
    shown = votes[:, 2:-2].astype(float)
    for place, cut in enumerate((0.0, 0.25 * math.pi, 0.5 * math.pi)):
        for sections, angles in (
            (picture.over_omega[place], [(k * step, cut) for k in range(6)]),
            (picture.over_phi[place], [(cut, k * step - 0.5 * math.pi) for k in range(7)]),
        ):
            for section, (omega, phi) in zip(sections, angles, strict=True):
                level = math.cos(phi)
                wanted = [level * math.cos(omega), level * math.sin(omega), math.sin(phi)]
                cosines = directions.normals @ wanted
                # Distances of directions on the other side count the other way.
                candidates = np.flatnonzero(np.abs(cosines) > np.abs(cosines).max() - 1e-9)
                rows = [shown[k] if cosines[k] > 0.0 else shown[k, ::-1] for k in candidates]
                assert any(np.array_equal(section, row) for row in rows)


def test_sections_know_nothing_where_no_direction_was_asked_about() -> None:
    directions = directions_over(10.0, "wall", 5.0)
    votes = np.ones((len(directions.normals), 4), dtype=np.int32)
    picture = pictured(directions, votes, np.ones(len(votes)), bin_m=0.1)
    phis_deg = np.arange(19) * 10.0 - 90.0
    known = np.isfinite(picture.over_phi[0]).all(axis=1)
    # Walls of 10 degrees are asked about, with a step of slack, and stand for a step and a half.
    np.testing.assert_array_equal(phis_deg[known], [-20.0, -10.0, 0.0, 10.0, 20.0])
    assert np.isfinite(picture.over_omega[0]).all()
    assert np.isnan(picture.over_omega[1:]).all()


@pytest.mark.parametrize("seed", range(3))
def test_moments_of_wider_voxels_are_those_of_half_as_many_steps(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n_voxels = 12
    owner, odd = rng.integers(0, 3, n_voxels), rng.integers(0, 2, (n_voxels, 3))
    sums, wide_steps = [], []
    for k in range(n_voxels):
        half, count = STEPS_PER_VOXEL // 2, int(rng.integers(1, 9))
        steps = rng.integers(-half, half, (count, 3))
        products = [(steps[:, i] * steps[:, j]).sum() for i, j in PAIRS]
        sums.append([len(steps), *steps.sum(axis=0), *products])
        # From the middle of the wider voxel, a quarter of its side to the one side or the other.
        wide_steps.append(0.5 * steps + np.where(odd[k], 256, -256))
    found = _summed(np.array(sums), odd.astype(np.int64), owner, 3)
    for wide in range(3):
        held = np.concatenate([wide_steps[k] for k in range(n_voxels) if owner[k] == wide])
        products = [(held[:, i] * held[:, j]).sum() for i, j in PAIRS]
        np.testing.assert_array_equal(
            found[wide], np.rint([len(held), *held.sum(axis=0), *products])
        )


def test_bins_grow_where_all_tables_would_hold_too_much(monkeypatch: pytest.MonkeyPatch) -> None:
    cloud = prepared_cloud(np.random.default_rng(0).uniform(-1.0, 1.0, (400, 3)), np.eye(3))
    voting = SpaceVoting(
        cell_m=0.02, angle_step_deg=30.0, least_points=10, tilt_most_deg=10.0, is_raw=False
    )
    n_rows, n_bins = SpaceProposer(cloud, voting)._votes.shape
    most = n_rows * n_bins // 3
    monkeypatch.setattr(space_accumulators, "_TABLE_MOST", most)
    narrow = SpaceProposer(cloud, voting)
    assert most < narrow._votes.size <= most + 4 * n_rows
    assert narrow._bin_m == pytest.approx(3.0 * 0.02, rel=0.1)


@pytest.mark.parametrize("is_raw", [False, True])
def test_votes_are_points_of_the_cloud_whether_its_voxels_vote_or_points_of_a_sample(
    is_raw: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sample, "SAMPLE_POINTS", 2_000)
    wall = Rectangle("wall", (0.0, 1.01, 0.0), (1.2, 0, 0), (0, 0, 0.8), 20_000)
    cloud = prepared_cloud(sampled((wall,), noise_m=0.002), np.eye(3))
    assert cloud.sample.n_represented == 10.0
    voting = SpaceVoting(
        cell_m=0.04, angle_step_deg=10.0, least_points=2_000, tilt_most_deg=10.0, is_raw=is_raw
    )
    found = SpaceProposer(cloud, voting).propose(Unassigned.of(cloud))
    assert found is not None
    assert 0.95 * 20_000 < found.votes <= 20_000
    few = SpaceProposer(cloud, replace(voting, least_points=90_000))
    assert few.propose(Unassigned.of(cloud)) is None
