"""What consensus does between drawing and proposing: who is kept, who leans, who is crowded."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.plane import consensus
from orthoflow_plugins.plane.consensus import ConsensusProposer, Search
from orthoflow_plugins.plane.hypotheses import Hypotheses, Scores
from orthoflow_plugins.plane.sample import Unassigned, prepare

from tests.plane_scenes import Rectangle, cloud_of, sampled

UP = np.array([0.0, 0.0, 1.0])


def search(**changes: Any) -> Search:
    usual: dict[str, Any] = {
        "model": "3d",
        "scoring": "msac",
        "n_hypotheses": 100,
        "find_m": 0.05,
        "family": "wall",
        "tilt_most_deg": 10.0,
        "least_share": 0.1,
    }
    return Search(**{**usual, **changes})


def proposer(**changes: Any) -> Any:
    """What its methods look at of a proposer."""
    of = search(**changes)
    return SimpleNamespace(
        _search=of,
        _alike=lambda hypotheses, others: ConsensusProposer._alike(
            SimpleNamespace(_search=of),  # type: ignore[arg-type]
            hypotheses,
            others,
        ),
    )


def tilted(*tilts_deg: float) -> Hypotheses:
    """Planes whose normals rise by so much above the horizon."""
    turns = np.radians(tilts_deg)
    return Hypotheses(
        normals=np.column_stack([np.cos(turns), np.zeros(len(turns)), np.sin(turns)]),
        offsets_m=np.zeros(len(turns)),
    )


@pytest.mark.parametrize(
    ("family", "leans"),
    [
        ("wall", [True, True, False, False, False, False]),
        ("level", [False, False, False, False, True, True]),
        ("any", [True] * 6),
    ],
)
def test_hypotheses_may_lean_five_degrees_more_than_planes(family: str, leans: list[bool]) -> None:
    of = proposer(family=family)
    hypotheses = tilted(0.0, -14.9, 15.1, -74.9, 75.1, -90.0)
    assert ConsensusProposer._leans_well(of, hypotheses, UP).tolist() == leans


def test_of_hypotheses_much_the_same_five_are_kept() -> None:
    same = Hypotheses(normals=np.tile(UP, (8, 1)), offsets_m=np.linspace(0.0, 0.007, 8))
    other = Hypotheses(normals=np.tile(UP, (2, 1)), offsets_m=np.array([1.0, 1.001]))
    ranked = np.array([3, 0, 1, 2, 4, 5, 6, 7, 9, 8])
    kept = ConsensusProposer._distinct(proposer(), Hypotheses.joined([same, other]), ranked, 7)
    assert kept.tolist() == [3, 0, 1, 2, 4, 9, 8]
    # With fewer wanted, only the best of them are looked at.
    assert ConsensusProposer._distinct(
        proposer(), Hypotheses.joined([same, other]), ranked, 2
    ).tolist() == [3, 0]


@pytest.mark.parametrize(
    ("n_points", "value", "scoring", "is_worth_it"),
    [
        # 0.4 of a tenth of a hundred thousand: 4000, which is a fifth of the twenty thousand asked.
        (810, 1.0, "msac", True),
        (790, 1.0, "msac", False),
        (810, -1.0, "msac", True),
        (810, 0.0, "a-contrario", False),
        (810, 0.1, "a-contrario", True),
    ],
)
def test_a_hypothesis_is_worth_it_with_nearly_the_points_of_a_plane(
    n_points: int, value: float, scoring: str, is_worth_it: bool
) -> None:
    scores = Scores(
        value=np.array([0.0, value]),
        tolerance_m=np.array([0.05, 0.05]),
        n_points=np.array([0, n_points]),
    )
    left = SimpleNamespace(n_points=100_000, claims=np.zeros(100_000))
    found = ConsensusProposer._is_worth_it(proposer(scoring=scoring), scores, 1, left)  # type: ignore[arg-type]
    assert found is is_worth_it
    # Fewer points than are asked are all asked; the share is of the whole sample.
    few = SimpleNamespace(n_points=1000, claims=np.zeros(10_000))
    half = Scores(value=np.ones(1), tolerance_m=np.ones(1), n_points=np.array([410]))
    assert ConsensusProposer._is_worth_it(proposer(), half, 0, few)  # type: ignore[arg-type]
    half = Scores(value=np.ones(1), tolerance_m=np.ones(1), n_points=np.array([390]))
    assert not ConsensusProposer._is_worth_it(proposer(), half, 0, few)  # type: ignore[arg-type]


@pytest.mark.parametrize(("crowded", "is_layer"), [(0.55, True), (0.45, False)])
def test_half_of_the_points_must_crowd_about_a_layer(crowded: float, is_layer: bool) -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(-1.0, 1.0, (1000, 3))
    n_inner = round(1000 * crowded)
    # The inner part is 0.4 of the tolerance of 5 cm.
    points[:n_inner, 2] = rng.uniform(-0.015, 0.015, n_inner)
    points[n_inner:, 2] = rng.uniform(0.025, 0.045, 1000 - n_inner)
    points[n_inner::2, 2] *= -1.0
    hypothesis = Hypotheses(normals=UP[None], offsets_m=np.array([0.0]))
    layer = ConsensusProposer._crowded_layer(proposer(), hypothesis, points, UP)
    assert (layer is not None) is is_layer
    if layer is not None:
        assert layer.offset_m == pytest.approx(0.0, abs=0.002)


def test_a_fitted_plane_has_the_least_squared_distances() -> None:
    rng = np.random.default_rng(2)
    turn = math.radians(5.0)
    normal = np.array([math.cos(turn), 0.0, math.sin(turn)])
    points = rng.normal(size=(400, 3))
    points -= np.outer(points @ normal - 0.7 + 0.001 * rng.normal(size=400), normal)
    fitted = consensus._fitted(points, "3d", UP)
    assert fitted is not None
    assert abs(float(fitted.normals[0] @ normal)) == pytest.approx(1.0, abs=1e-6)
    assert float(fitted.offsets_m[0] * np.sign(fitted.normals[0] @ normal)) == pytest.approx(
        0.7, abs=1e-3
    )
    upright = consensus._fitted(points, "2d", UP)
    assert upright is not None
    assert upright.normals[0] @ UP == pytest.approx(0.0, abs=1e-12)
    assert abs(upright.normals[0, 0]) == pytest.approx(1.0, abs=0.01)


def test_three_points_or_a_line_fix_no_plane() -> None:
    square = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    assert consensus._fitted(square[:3], "3d", UP) is None
    found = consensus._fitted(square, "3d", UP)
    assert found is not None
    np.testing.assert_allclose(np.abs(found.normals), [[0.0, 0.0, 1.0]])
    upright = np.array([[0.0, 0, 0], [0, 0, 1], [0, 0, 2], [0, 0, 3]])
    assert consensus._fitted(upright, "2d", UP) is None


def test_a_rejected_plane_bars_what_is_near_it_about_the_centre() -> None:
    from orthoflow_plugins.plane.candidates import Candidate

    from orthoflow.geometry import Plane

    barred: list[Hypotheses] = []
    of: Any = SimpleNamespace(
        _centre_m=np.array([1.0, 2.0, 3.0]), _rejections=SimpleNamespace(add=barred.append)
    )
    plane = Plane(normal=UP, offset_m=4.5)
    candidate = Candidate(plane=plane, family="level", votes=1.0)
    ConsensusProposer.reject(of, candidate)
    assert barred[0].offsets_m.tolist() == [1.5]
    np.testing.assert_array_equal(barred[0].normals, UP[None])


# --- over a sample ---

# A wall at y = 2 and a floor at z = -1, off the middle of their offsets.
CORNER = (
    Rectangle("wall", (5.0, 2.0, 0.0), (1.5, 0.0, 0.0), (0.0, 0.0, 1.0), 2_000),
    Rectangle("floor", (5.0, 1.0, -1.0), (1.5, 0.0, 0.0), (0.0, 1.0, 0.0), 1_200),
)


def unassigned() -> Unassigned:
    cloud = prepare(cloud_of(sampled(CORNER)), np.eye(3), cell_m=0.1, least_share=0.1, parts=1)
    return Unassigned.of(cloud)


@pytest.mark.parametrize(("n_hypotheses", "n_most"), [(1000, 100), (200, 50)])
def test_a_tenth_of_the_hypotheses_is_scored_again_and_fifty_at_least(
    n_hypotheses: int, n_most: int
) -> None:
    # Within half a millimetre nearly all differ, so that no more are left out.
    wanted = search(n_hypotheses=n_hypotheses, family="any", find_m=5e-4, least_share=0.9)
    left = unassigned()
    over = ConsensusProposer(left, wanted, np.random.default_rng(0))
    over._draw(left)
    pool = over._pool
    assert pool is not None
    assert 0.95 * n_most <= len(pool.hypotheses) <= n_most
    assert (np.diff(pool.scores.value) <= 0.0).all()


def test_a_search_that_finds_nothing_draws_twice_more(monkeypatch: pytest.MonkeyPatch) -> None:
    left = unassigned()
    over = ConsensusProposer(left, search(), np.random.default_rng(0))
    drawn: list[int] = []
    monkeypatch.setattr(over, "_draw", lambda of: drawn.append(of.n_points))
    monkeypatch.setattr(over, "_best", lambda _: None)
    assert over.propose(left) is None
    assert drawn == [3_200] * 3
    # Of the same points everything was asked.
    assert over.propose(left) is None
    assert len(drawn) == 5


@pytest.mark.parametrize("scoring", ["count", "msac", "a-contrario"])
@pytest.mark.parametrize("model", ["3d", "2d"])
def test_the_plane_of_most_points_is_proposed_where_it_lies(scoring: str, model: str) -> None:
    left = unassigned()
    wanted = search(model=model, scoring=scoring, n_hypotheses=300, family="any")
    over = ConsensusProposer(left, wanted, np.random.default_rng(0))
    found = over.propose(left)
    assert found is not None
    assert found.start is not None
    # Three of its points, within the tolerance; the layer of all of them is better.
    for plane, off_m in ((found.plane, 0.05), (found.start, 0.02)):
        side = float(np.sign(plane.normal[1]))
        np.testing.assert_allclose(side * plane.normal, [0.0, 1.0, 0.0], atol=off_m)
        middle_m = side * (plane.offset_m - float(plane.normal @ [5.0, 0.0, 0.0]))
        assert middle_m == pytest.approx(2.0, abs=off_m)
    assert found.family == ("wall" if model == "2d" else "any")
    if scoring == "a-contrario":
        # Of points that scatter by 2 mm.
        assert found.own_tolerance_m is not None
        assert 0.003 < found.own_tolerance_m < 0.015
    else:
        assert found.own_tolerance_m is None


@pytest.mark.parametrize("model", ["3d", "2d"])
def test_a_rough_hypothesis_is_polished_to_the_points_near_it(model: str) -> None:
    left = unassigned()
    over = ConsensusProposer(
        left, search(model=model, scoring="a-contrario"), np.random.default_rng(0)
    )
    turn = math.radians(0.5)
    normal = np.array([math.sin(turn), math.cos(turn), 0.0])
    at = np.array([5.0, 2.004, 0.0]) - over._centre_m
    rough = Hypotheses(normals=normal[None], offsets_m=np.array([float(normal @ at)]))
    polished, own_m = over._polished(rough, over._score(rough, at[None], 1), 0, left)
    fine = polished.normals[0] * np.sign(polished.normals[0, 1])
    assert math.degrees(math.acos(min(1.0, fine[1]))) < 0.02
    offset_m = float(polished.offsets_m[0]) * np.sign(polished.normals[0, 1])
    assert offset_m + float(fine @ over._centre_m) == pytest.approx(2.0, abs=1e-3)
    assert 0.003 < own_m < 0.012


def test_good_hypotheses_stay_for_the_next_plane_and_half_as_many_are_drawn(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    left = unassigned()
    over = ConsensusProposer(left, search(n_hypotheses=200, family="any"), np.random.default_rng(0))
    over._draw(left)
    before = over._pool
    assert before is not None
    asked: list[int] = []

    def none_drawn(_points: object, count: int, *_: object) -> Hypotheses:
        asked.append(count)
        return Hypotheses(normals=np.zeros((0, 3)), offsets_m=np.zeros(0))

    monkeypatch.setattr(consensus, "draw_hypotheses", none_drawn)
    # What lies on the wall is gone: others are worth more now.
    left.claims[:] = np.where(np.abs(left.sample.offsets_m[:, 1] - 2.0) < 0.02, 0, -1)
    over._draw(left)
    after = over._pool
    assert after is not None
    assert asked == [100]
    assert {tuple(row) for row in after.hypotheses.rows().tolist()} <= {
        tuple(row) for row in before.hypotheses.rows().tolist()
    }
    assert len(after.asked_m) < 0.5 * len(before.asked_m)
    assert after.scores.value[0] < before.scores.value[0]


def test_what_was_rejected_is_looked_at_again_by_the_points_that_are_left(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    left = unassigned()
    over = ConsensusProposer(left, search(n_hypotheses=60), np.random.default_rng(0))
    told: list[np.ndarray] = []
    monkeypatch.setattr(over._rejections, "take", told.append)
    monkeypatch.setattr(over, "_best", lambda _: "found")
    left.claims[::3] = 0
    assert over.propose(left) == "found"
    assert over.propose(left) == "found"
    # Once, as long as nothing is taken.
    (free,) = told
    np.testing.assert_array_equal(free, left.claims[over._witnesses] < 0)
    assert free.mean() == pytest.approx(2 / 3, abs=1e-3)


@pytest.mark.parametrize(("n_free", "is_drawn"), [(3, True), (2, False)])
def test_three_points_make_a_hypothesis(n_free: int, is_drawn: bool) -> None:
    left = unassigned()
    over = ConsensusProposer(left, search(family="any"), np.random.default_rng(0))
    left.claims[:] = 0
    left.claims[[0, 700, 1900][:n_free]] = -1
    over._draw(left)
    assert (over._pool is not None) == is_drawn


def test_where_the_first_points_are_taken_the_others_are_asked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(consensus, "_SECOND_POINTS", 100)
    left = unassigned()
    over = ConsensusProposer(left, search(family="any"), np.random.default_rng(0))
    left.claims[over._shuffled[:350]] = 0
    over._draw(left)
    assert over._pool is not None
    wanted = left.sample.offsets_m[over._shuffled[350:450]] - over._centre_m
    np.testing.assert_array_equal(over._pool.asked_m, wanted)
