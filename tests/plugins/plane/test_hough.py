"""`plane.hough2d` and `plane.hough3d`: accumulators, directions and sides."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.hough2d import Hough2d
from orthoflow_plugins.plane.hough3d import Hough3d, SpaceProposer, directions_over
from orthoflow_plugins.plane.votes import VOTE_SHARES, vote_planes
from pydantic import ValidationError
from scipy.spatial import KDTree

from tests.plane_scenes import (
    ROOM,
    STATION,
    Rectangle,
    cloud_of,
    detect,
    errors,
    prepared,
    sampled,
    search_in,
)


@pytest.mark.parametrize(
    ("method", "options", "n_true"),
    [
        # By cells that vote once, floor and ceiling drown the walls beside them.
        (Hough2d, {"accumulator": "unit"}, 1),
        (Hough2d, {"accumulator": "canny"}, 1),
        # "Identical result, considerably longer" (markiewicz2015).
        (Hough2d, {"coordinates": "raw"}, 7),
        (Hough3d, {"search": "full", "cell_m": 0.03, "angle_step_deg": 1.5}, 7),
        (Hough3d, {"coordinates": "raw"}, 7),
    ],
    ids=str,
)
def test_other_ways_to_vote_find_the_same_walls(
    method: Any, options: dict[str, Any], n_true: int, tmp_path: Path
) -> None:
    planes = detect(method, cloud_of(sampled(), stations=STATION), tmp_path, **options)[0].planes
    assert len(planes) >= n_true
    for truth in ROOM[:n_true]:
        angle_deg, miss_m = errors(planes, truth)
        assert angle_deg < 0.02
        assert miss_m < 3e-4


def test_raw_coordinates_with_one_vote_per_cell_are_refused() -> None:
    with pytest.raises(ValidationError, match="accumulator: counts"):
        Hough2d.Params(coordinates="raw", accumulator="unit")


@pytest.mark.parametrize("method", [Hough2d, Hough3d])
def test_floor_and_ceiling_alone_are_found_once_each(method: Any, tmp_path: Path) -> None:
    planes = detect(method, cloud_of(sampled(ROOM[4:6])), tmp_path)[0].planes
    assert sorted(planes.names) == ["ceiling 1", "floor 0"]


def test_a_perfectly_flat_wall_is_found(tmp_path: Path) -> None:
    cloud = cloud_of(sampled(ROOM[1:2], noise_m=0.0))
    planes = detect(Hough2d, cloud, tmp_path)[0].planes
    np.testing.assert_allclose(np.abs(planes.normal[0]), [0, 1, 0], atol=1e-7)
    assert abs(planes.offset[0]) == pytest.approx(2.0, abs=1e-6)


# --- all directions ---


@pytest.mark.parametrize("slope_deg", [15.0, 45.0, 70.0])
def test_a_slope_is_found_whatever_its_inclination(slope_deg: float, tmp_path: Path) -> None:
    slope = np.radians(slope_deg)
    roof = Rectangle("roof", (0, 0, 3), (3, 0, 0), (0, np.cos(slope), np.sin(slope)), 20_000)
    planes = detect(Hough3d, cloud_of(sampled((roof, ROOM[4]))), tmp_path)[0].planes
    for truth in (roof, ROOM[4]):
        angle_deg, miss_m = errors(planes, truth)
        assert angle_deg < 0.05
        assert miss_m < 3e-4


@pytest.mark.parametrize("step_deg", [1.0, 5.0])
def test_directions_cover_the_hemisphere_evenly_and_the_pole_once(step_deg: float) -> None:
    normals = directions_over(step_deg, "any", 10.0).normals
    wanted = np.random.default_rng(0).normal(size=(2_000, 3))
    wanted /= np.linalg.norm(wanted, axis=1, keepdims=True)
    chords, _ = KDTree(np.vstack([normals, -normals])).query(wanted)
    nearest_deg = np.degrees(2.0 * np.arcsin(0.5 * chords))
    assert nearest_deg.max() < 1.1 * step_deg
    assert np.count_nonzero(np.abs(normals[:, 2]) > np.cos(np.radians(0.5 * step_deg))) == 1
    # Of the hemisphere's 2 pi each direction has a square of one step.
    assert len(normals) == pytest.approx(2.0 * np.pi / np.radians(step_deg) ** 2, rel=0.1)


@pytest.mark.parametrize(
    ("family", "low_deg", "high_deg"), [("vertical", 0.0, 10.0), ("horizontal", 78.0, 90.0)]
)
def test_a_family_asks_about_its_directions_only(
    family: Any, low_deg: float, high_deg: float
) -> None:
    phis_deg = np.abs(np.degrees(directions_over(2.0, family, 10.0).angles_rad[:, 1]))
    assert phis_deg.min() == pytest.approx(low_deg, abs=1e-9)
    assert phis_deg.max() == pytest.approx(high_deg, abs=1e-9)


def votes_of(places: NDArray[np.float32], weights: NDArray[np.int32]) -> NDArray[np.int32]:
    directions = directions_over(5.0, "any", 10.0)
    votes = np.zeros((len(directions.normals), 200), dtype=np.int32)
    image = np.zeros((80, 120), dtype=np.int32)
    places = np.ascontiguousarray(places)
    vote_planes(places, weights, directions.angles_rad, directions.starts, image, 0.05, votes)
    return votes


def test_every_place_votes_once_per_direction_and_takes_its_votes_back() -> None:
    rng = np.random.default_rng(0)
    places = rng.uniform(-1.5, 1.5, (3, 500)).astype(np.float32)
    weights = rng.integers(1, 9, 500).astype(np.int32)
    votes = votes_of(places, weights)
    np.testing.assert_array_equal(votes.sum(axis=1), VOTE_SHARES * weights.sum())
    rest = votes + votes_of(places[:, 200:], -weights[200:])
    np.testing.assert_array_equal(rest, votes_of(places[:, :200], weights[:200]))


def test_voxels_grow_where_a_scene_would_have_too_many() -> None:
    search = search_in(prepared(np.random.default_rng(0).uniform(-300.0, 300.0, (20_000, 3))))
    proposer = SpaceProposer(search, Hough3d.Params(angle_step_deg=2.0, min_share=0.05))
    assert proposer._voxel_m > 0.3
    found = proposer.propose(search)
    assert found is None or proposer._votes.nbytes < 500_000_000
