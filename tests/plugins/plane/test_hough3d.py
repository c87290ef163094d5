"""`plane.hough3d`: even directions, linear votes, both searches, and slopes that no plan shows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.hough3d import Hough3d, SpaceProposer, directions_over
from orthoflow_plugins.plane.votes import VOTE_SHARES, vote_planes
from scipy.spatial import KDTree

from orthoflow.geometry import angle_between_deg
from orthoflow.products import Planes, PointCloud
from tests.plane_scenes import (
    ROOM,
    Rectangle,
    cloud_of,
    context,
    prepared,
    sampled,
    search_in,
)

STATION = np.array([[0.3, -0.2, 0.1]])


def detect(cloud: PointCloud, folder: Path, *, cores: int = 2, **params: Any) -> Hough3d.Out:
    return Hough3d().run(
        Hough3d.In(cloud=cloud), Hough3d.Params(**params), context(folder, cores=cores)
    )


def has(planes: Planes, truth: Rectangle) -> bool:
    """A plane within 0.05 degrees and 0.3 mm of a true one."""
    angles = np.array([angle_between_deg(normal, truth.normal) for normal in planes.normal])
    misses = np.abs(planes.normal @ np.array(truth.centre) - planes.offset)
    return bool(((np.minimum(angles, 180.0 - angles) < 0.05) & (misses < 3e-4)).any())


@pytest.mark.parametrize(
    "options",
    [{"search": "full", "cell_m": 0.03, "angle_step_deg": 1.5}, {"coordinates": "raw"}],
    ids=["full", "raw"],
)
def test_other_ways_to_vote_find_the_same_room(options: dict[str, Any], tmp_path: Path) -> None:
    cloud = cloud_of(sampled(), stations=STATION)
    planes = detect(cloud, tmp_path, **options).planes
    assert all(has(planes, truth) for truth in ROOM)


def test_floor_and_ceiling_are_found_once_each(tmp_path: Path) -> None:
    planes = detect(cloud_of(sampled(ROOM[4:6])), tmp_path).planes
    assert sorted(planes.names) == ["ceiling 1", "floor 0"]


@pytest.mark.parametrize("slope_deg", [15.0, 30.0, 45.0, 70.0])
def test_a_slope_is_found_whatever_its_inclination(slope_deg: float, tmp_path: Path) -> None:
    slope = np.radians(slope_deg)
    roof = Rectangle("roof", (0, 0, 3), (3, 0, 0), (0, np.cos(slope), np.sin(slope)), 20_000)
    planes = detect(cloud_of(sampled((roof, ROOM[4]))), tmp_path).planes
    assert has(planes, roof)
    assert has(planes, ROOM[4])


@pytest.mark.parametrize("step_deg", [1.0, 2.0, 5.0])
def test_directions_cover_the_hemisphere_evenly_and_the_pole_once(step_deg: float) -> None:
    directions = directions_over(step_deg, "any", 10.0)
    normals = directions.normals
    wanted = np.random.default_rng(0).normal(size=(2_000, 3))
    wanted /= np.linalg.norm(wanted, axis=1, keepdims=True)
    chords, _ = KDTree(np.vstack([normals, -normals])).query(wanted)
    nearest_deg = np.degrees(2.0 * np.arcsin(0.5 * chords))
    assert nearest_deg.max() < 1.1 * step_deg
    assert np.count_nonzero(np.abs(normals[:, 2]) > np.cos(np.radians(0.5 * step_deg))) == 1
    # Of the hemisphere's 2 pi each direction has a square of one step.
    assert len(normals) == pytest.approx(2.0 * np.pi / np.radians(step_deg) ** 2, rel=0.1)


@pytest.mark.parametrize(
    ("family", "least", "most"), [("vertical", 0.0, 12.0), ("horizontal", 78.0, 90.0)]
)
def test_a_family_asks_about_its_directions_only(family: Any, least: float, most: float) -> None:
    directions = directions_over(2.0, family, 10.0)
    phis_deg = np.abs(np.degrees(directions.angles_rad[:, 1]))
    assert (phis_deg >= least - 1e-9).all()
    assert (phis_deg <= most + 1e-9).all()


def votes_of(places: NDArray[np.float32], weights: NDArray[np.int32]) -> NDArray[np.int32]:
    directions = directions_over(5.0, "any", 10.0)
    votes = np.zeros((len(directions.normals), 200), dtype=np.int32)
    image = np.zeros((80, 120), dtype=np.int32)
    vote_planes(places, weights, directions.angles_rad, directions.starts, image, 0.05, votes)
    assert not image.any()
    return votes


def test_every_place_votes_once_per_direction_and_takes_its_votes_back() -> None:
    rng = np.random.default_rng(0)
    places = rng.uniform(-1.5, 1.5, (3, 500)).astype(np.float32)
    weights = rng.integers(1, 9, 500).astype(np.int32)
    votes = votes_of(places, weights)
    np.testing.assert_array_equal(votes.sum(axis=1), VOTE_SHARES * weights.sum())
    part = votes_of(np.ascontiguousarray(places[:, :200]), weights[:200])
    rest = votes + votes_of(np.ascontiguousarray(places[:, 200:]), -weights[200:])
    np.testing.assert_array_equal(rest, part)


def test_the_number_of_threads_does_not_change_a_bit(tmp_path: Path) -> None:
    cloud = cloud_of(sampled())
    one, three = (detect(cloud, tmp_path / str(n), cores=n) for n in (1, 3))
    np.testing.assert_array_equal(one.labels.plane_index, three.labels.plane_index)
    np.testing.assert_array_equal(one.planes.normal, three.planes.normal)


def test_voxels_grow_where_a_scene_would_have_too_many() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-300.0, 300.0, (20_000, 3))
    search = search_in(prepared(points))
    proposer = SpaceProposer(search, Hough3d.Params(angle_step_deg=2.0, min_share=0.05))
    assert proposer._voxel_m > 0.3
    found = proposer.propose(search)
    assert found is None or proposer._votes.nbytes < 500_000_000
