"""Which ties a photo is oriented by, and whose word counts: a person's or the matcher's."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.orient import single_photo
from orthoflow_plugins.orient.parameters import OrientParams
from orthoflow_plugins.orient.single_photo import ByHand, Oriented

from orthoflow.errors import GeometryError, MethodError
from orthoflow.products import Camera, Photo, Photos, TieRole, Ties
from tests import samples


def ties(n: int = 12) -> Ties:
    """Ties of two photos in turn, their pixels numbered."""
    at = np.arange(n)
    return samples.ties(
        np.column_stack([at, 10.0 * at]).astype(np.float64),
        photo_names=("a", "b"),
        photo=(at % 2).astype(np.int32),
        points_world=np.zeros((n, 3)),
        sigma_px=0.1 + at,
        sigma_m=0.001 + at,
        role=np.full(n, TieRole.CONTROL, dtype=np.uint8),
    )


def photo(name: str) -> Photo:
    return Photo(name=name, encoded=b"", width=100, height=100)


def test_what_no_orientation_can_start_from_is_refused() -> None:
    both = Photos(photos=(photo("a"), photo("b")))
    single_photo.require(ties(), both)
    with pytest.raises(MethodError, match="there are no photos to orient"):
        single_photo.require(ties(), Photos(photos=()))
    with pytest.raises(MethodError, match="there are no ties between photos and walls"):
        single_photo.require(ties(0), both)
    with pytest.raises(MethodError, match="the ties speak of photo b, which is not among"):
        single_photo.require(ties(), Photos(photos=(photo("a"),)))


def test_ties_of_a_photo_are_found_by_its_name() -> None:
    assert single_photo.of_photo(ties(5), "b").tolist() == [1, 3]
    assert single_photo.of_photo(ties(5), "c").tolist() == []


def test_rejected_ties_are_not_used_and_many_are_thinned_evenly() -> None:
    of = ties(24)
    of.role[[0, 4]] = TieRole.REJECTED
    of.role[2] = TieRole.CHECK
    mine = [2, 6, 8, 10, 12, 14, 16, 18, 20, 22]
    assert single_photo._usable(of, "a", 10).tolist() == mine
    assert single_photo._usable(of, "a", 5).tolist() == mine[::2]
    assert single_photo._usable(of, "a", 3).tolist() == [mine[0], mine[3], mine[6]]


def test_what_a_person_measured_is_never_thinned_out() -> None:
    by_hand = np.zeros(24, dtype=np.uint8)
    by_hand[[3, 10, 22]] = 1
    of = replace(ties(24), by_hand=by_hand)
    assert single_photo._usable(of, "a", 4).tolist() == [0, 6, 10, 12, 18, 22]


def test_ties_are_split_so_that_nothing_by_hand_is_withheld() -> None:
    by_hand = np.zeros(400, dtype=np.uint8)
    by_hand[:40] = 1
    of = replace(ties(400), by_hand=by_hand)
    params = OrientParams()
    tied = single_photo.tied_photo(photo("a"), of, params, np.random.default_rng(1))
    np.testing.assert_array_equal(tied.chosen, np.arange(0, 400, 2))
    np.testing.assert_array_equal(tied.by_hand, by_hand[::2] > 0)
    assert not (tied.is_check & tied.by_hand).any()
    share = tied.is_check.sum() / (~tied.by_hand).sum()
    assert share == pytest.approx(params.check_share, abs=0.1)
    np.testing.assert_array_equal(tied.seen.pixels_photo, of.pixels_photo[::2])
    np.testing.assert_array_equal(tied.seen.sigma_px, of.sigma_px[::2])
    np.testing.assert_array_equal(tied.seen.sigma_m, of.sigma_m[::2])
    plain = single_photo.tied_photo(photo("a"), ties(400), params, np.random.default_rng(1))
    assert not plain.by_hand.any()


def test_a_radius_of_search_is_said_of_each_photo_or_boundless() -> None:
    of = replace(ties(), search_radius_px=(12.0, None))
    assert single_photo._search_radius_px(of, "a") == 12.0
    assert single_photo._search_radius_px(of, "b") == math.inf
    assert single_photo._search_radius_px(ties(), "a") == math.inf


def oriented(status: str, *roles: TieRole) -> Oriented:
    return Oriented(
        camera=Camera(photo="a", status=status),
        chosen=np.arange(len(roles)),
        role=np.array(roles, dtype=np.uint8),
        residuals_px=np.zeros((len(roles), 2)),
    )


IN, OUT = TieRole.CONTROL, TieRole.REJECTED


@pytest.mark.parametrize(
    ("alone", "other", "wins"),
    [
        # The other ties agree with those by hand: all together say most.
        ("ok", oriented("ok", IN, IN, OUT), "other"),
        ("ok", oriented("ok", OUT, IN, IN), "alone"),
        ("ok", oriented("bad", IN, IN, IN), "alone"),
        # By hand they make no sense, or there are too few of them.
        ("askew", oriented("bad", IN, IN, IN), "alone"),
        ("", oriented("bad", IN, IN, IN), "other"),
        ("", oriented("ok", IN, IN, IN), "other"),
    ],
)
def test_an_orientation_is_not_against_what_a_person_measured(
    alone: str, other: Oriented, wins: str
) -> None:
    hand = ByHand(alone=oriented(alone), kept=np.array([True, True, False]))
    assert hand.is_enough == (alone == "ok")
    assert hand.reason == ("" if alone == "ok" else alone)
    assert hand.or_alone(other) is (other if wins == "other" else hand.alone)


def tied(n: int, n_by_hand: int) -> Any:
    by_hand = np.arange(n) < n_by_hand
    return SimpleNamespace(by_hand=by_hand, seen=np.zeros(n), chosen=np.arange(n), photo=photo("a"))


def test_a_photo_of_too_few_ties_is_not_tried() -> None:
    silent = ByHand(alone=oriented(""), kept=np.zeros(0, dtype=np.bool_))
    askew = ByHand(alone=oriented("the points by hand do not fit"), kept=silent.kept)
    assert single_photo.reason_not_to_try(tied(400, 0), silent) == ""
    assert single_photo.reason_not_to_try(tied(400, 5), askew) == ""
    assert "ties" in single_photo.reason_not_to_try(tied(3, 0), silent)
    # What is wrong by hand is the reason where nothing else could do without them.
    assert single_photo.reason_not_to_try(tied(8, 6), askew) == "the points by hand do not fit"


def test_a_photo_without_an_orientation_keeps_its_ties_as_rejected() -> None:
    found = single_photo.refused(tied(4, 0), "too few")
    assert (found.camera.photo, found.camera.status) == ("a", "too few")
    assert found.role.tolist() == [TieRole.REJECTED] * 4
    assert np.isnan(found.residuals_px).all()
    assert found.residuals_px.shape == (4, 2)
    assert (found.numbers, found.table, found.notes) == (None, (), ())


def test_ties_that_determine_nothing_together_leave_those_by_hand_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(*_: object) -> None:
        raise GeometryError("the ties do not determine the camera")

    kept = np.arange(20) < 6
    by_hand = SimpleNamespace(estimate=SimpleNamespace(agreeing=kept), start=None)
    monkeypatch.setattr(single_photo, "pose_by_hand", lambda *_: by_hand)
    monkeypatch.setattr(single_photo, "candidate_of", lambda *_: None)
    monkeypatch.setattr(single_photo, "judged", lambda *_: oriented("ok", IN))
    monkeypatch.setattr(single_photo, "adjusted", fail)
    of, nothing = tied(20, 6), None
    of.is_check = of.rule = None
    hand = single_photo.oriented_by_hand(of, nothing, nothing)  # type: ignore[arg-type]
    assert hand.is_enough
    assert hand.joined is None
    np.testing.assert_array_equal(hand.kept, kept)
