"""What detectors propose before any fit: known places, rejections, and the plain transforms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.plane.detector import Candidate
from orthoflow_plugins.plane.hough2d import Hough2d, PlanProposer
from orthoflow_plugins.plane.hough3d import Hough3d, SpaceProposer
from orthoflow_plugins.plane.ransac import ConsensusProposer, Ransac
from orthoflow_plugins.plane.region import Region, region_proposer
from orthoflow_plugins.plane.search import Search

from orthoflow.geometry import angle_between_deg
from tests.plane_scenes import ROOM, Rectangle, prepared, sampled, search_in, turned

FRONT = ROOM[0]
TURN_DEG = 17.37


def proposer_of(name: str, search: Search, /, **params: Any) -> Any:
    settled = {"min_share": 0.02, **params}
    if name == "hough2d":
        return PlanProposer(search, Hough2d.Params(**settled))
    if name == "hough3d":
        return SpaceProposer(search, Hough3d.Params(**settled))
    if name == "region":
        return region_proposer(search, Region.Params(**settled), viewer_m=np.zeros(3))
    return ConsensusProposer(search, Ransac.Params(**settled), np.random.default_rng(0))


def room_search(
    rectangles: tuple[Rectangle, ...] = ROOM, *, angle_deg: float = TURN_DEG, cell_m: float = 0.02
) -> Search:
    points = sampled(rectangles) @ turned(angle_deg).T
    return search_in(prepared(points, plan_cell_m=cell_m), min_share=0.02)


def errors(
    candidate: Candidate, truth: Rectangle, angle_deg: float = TURN_DEG
) -> tuple[float, float]:
    """Angle in degrees, and miss at the true centre in metres."""
    turn = turned(angle_deg)
    away_deg = angle_between_deg(candidate.plane.normal, turn @ truth.normal)
    miss_m = float(candidate.plane.distances_m((turn @ np.array(truth.centre))[None])[0])
    return min(away_deg, 180.0 - away_deg), abs(miss_m)


@pytest.mark.parametrize("angle_deg", [0.0, 133.91])
@pytest.mark.parametrize(
    ("name", "n_tries"), [("hough2d", 20), ("hough3d", 20), ("ransac", 3), ("region", 3)]
)
def test_the_fullest_wall_is_proposed_first_and_after_rejections_another_surface(
    name: str, n_tries: int, angle_deg: float
) -> None:
    search = room_search(angle_deg=angle_deg)
    proposer = proposer_of(name, search)
    candidate = proposer.propose(search)
    away_deg, miss_m = errors(candidate, FRONT, angle_deg)
    # The wall leans by 0.4 degrees, which an upright one of the plan does not.
    assert away_deg < 1.0
    assert miss_m < 0.02
    surfaces = set()
    for _ in range(n_tries):
        proposer.reject(candidate)
        candidate = proposer.propose(search)
        away = [max(errors(candidate, truth, angle_deg)) for truth in ROOM]
        if min(away) < 1.5:
            surfaces.add(int(np.argmin(away)))
    assert surfaces - {0}


@pytest.mark.parametrize(
    ("name", "params", "step_deg"),
    [("hough2d", {}, 1.0), ("hough3d", {"search": "full", "angle_step_deg": 2.0}, 2.0)],
)
def test_the_plain_maximum_lies_in_the_middle_of_a_bin_and_of_a_step(
    name: str, params: dict[str, Any], step_deg: float
) -> None:
    """markiewicz2015 takes the fullest bin as it is, half a bin and half a step off at most."""
    search, params = room_search(), {"constraint": "vertical", **params}
    plain = proposer_of(name, search, scoring="votes", **params).propose(search)
    normal = plain.plane.normal
    omega_deg = np.degrees(np.arctan2(normal[1], normal[0])) % 180.0
    assert omega_deg / step_deg == pytest.approx(round(omega_deg / step_deg), abs=1e-6)
    away_deg, miss_m = errors(plain, FRONT)
    assert away_deg < 0.75 * step_deg + 0.4
    assert miss_m < 0.04
    fine = errors(proposer_of(name, search, **params).propose(search), FRONT)
    assert fine != (away_deg, miss_m)


def test_with_one_vote_per_cell_the_plain_maximum_is_no_wall() -> None:
    """Figure 10b of markiewicz2015: floor and ceiling drown the walls; "no clear maximum"."""
    floors = tuple(
        Rectangle(r.name, r.centre, r.half_a, r.half_b, 5 * r.n_points) for r in ROOM[4:6]
    )
    walls = ROOM[:4]
    search = room_search((*walls, *floors), cell_m=0.05)
    unit, counts = (
        proposer_of(
            "hough2d",
            search,
            accumulator=name,
            cell_m=0.05,
            constraint="vertical",
            scoring="votes",
        ).propose(search)
        for name in ("unit", "counts")
    )
    assert min(max(*errors(counts, truth)) for truth in walls) < 1.0
    # A diagonal through the middle of the room.
    assert min(errors(unit, truth) for truth in walls)[0] > 5.0
