"""`plane.hough2d` and `plane.hough3d`: accumulators, directions and sides."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.plane.hough2d import Hough2d, PlanProposer
from orthoflow_plugins.plane.hough3d import Hough3d, SpaceProposer, directions_over
from pydantic import ValidationError
from scipy.spatial import KDTree

from orthoflow.geometry import angle_between_deg
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
    turned,
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
    cloud = cloud_of(sampled()[::2], stations=STATION)
    planes = detect(method, cloud, tmp_path, **options)[0].planes
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


@pytest.mark.parametrize(
    ("method", "options", "step_deg"),
    [(Hough2d, {}, 1.0), (Hough3d, {"search": "full", "angle_step_deg": 2.0}, 2.0)],
)
def test_the_plain_maximum_lies_in_the_middle_of_a_bin_and_of_a_step(
    method: Any, options: dict[str, Any], step_deg: float, tmp_path: Path
) -> None:
    """markiewicz2015 takes the fullest bin as it is, half a bin and half a step off at most."""
    turn = turned(17.37)
    cloud = cloud_of(sampled()[::2] @ turn.T, stations=STATION)
    found = []
    for scoring in ("votes", "contrast"):
        given = {"scoring": scoring, "constraint": "vertical", "min_share": 0.02, **options}
        planes = detect(method, cloud, tmp_path, **given)[0].planes
        raw = planes.details["raw"][0]
        normal = np.array(raw["normal"])
        omega_deg = np.degrees(np.arctan2(normal[1], normal[0])) / step_deg
        found.append(omega_deg)
        assert angle_between_deg(normal, planes.normal[0]) < 0.75 * step_deg + 0.4
        middle = planes.corners[0].mean(axis=0)
        assert abs(normal @ middle - raw["offset_m"]) < 0.04
    assert found[0] == pytest.approx(round(found[0]), abs=1e-6)
    assert found[1] != pytest.approx(round(found[1]), abs=1e-3)


def test_with_one_vote_per_cell_the_plain_maximum_is_no_wall() -> None:
    """Figure 10b of markiewicz2015: floor and ceiling drown the walls; "no clear maximum"."""
    floors = tuple(
        Rectangle(r.name, r.centre, r.half_a, r.half_b, 5 * r.n_points) for r in ROOM[4:6]
    )
    points = sampled((*ROOM[:4], *floors)) @ turned(17.37).T
    search = search_in(prepared(points, plan_cell_m=0.05), min_share=0.02)
    away_deg = []
    for accumulator in ("unit", "counts"):
        params = {"cell_m": 0.05, "constraint": "vertical", "scoring": "votes"}
        chosen = Hough2d.Params.model_validate({**params, "accumulator": accumulator})
        candidate = PlanProposer(search, chosen).propose(search)
        assert candidate is not None
        normals = turned(17.37) @ np.array([wall.normal for wall in ROOM[:4]]).T
        cosines = np.abs(candidate.plane.normal @ normals)
        away_deg.append(np.degrees(np.arccos(cosines.max())))
    # A diagonal through the middle of the room.
    assert away_deg[0] > 5.0
    assert away_deg[1] < 1.0


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


def test_voxels_grow_where_a_scene_would_have_too_many() -> None:
    search = search_in(prepared(np.random.default_rng(0).uniform(-300.0, 300.0, (20_000, 3))))
    proposer = SpaceProposer(search, Hough3d.Params(angle_step_deg=5.0, min_share=0.05))
    assert proposer._voxel_m > 0.3
    found = proposer.propose(search)
    assert found is None or proposer._votes.nbytes < 500_000_000
