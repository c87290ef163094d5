"""Ties that a person measured go through matching: behind what is found, each on its wall."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.match.guided import MatchGuided
from orthoflow_plugins.match.sift import MatchSift

from orthoflow.errors import MethodError
from orthoflow.products import Photos, Ties, Walls
from orthoflow.sdk import StepContext
from orthoflow.testing import photographed as ms
from tests import samples

SCENE = ms.textured_wall(0)
CAMERA = ms.camera_before(SCENE, centre=(1.3, -2.6, 1.1))


@cache
def photos() -> Photos:
    return ms.photos(ms.photo_of(SCENE, CAMERA))


def measured(*names: str) -> Ties:
    count = len(names)
    return samples.ties(
        np.arange(2.0 * count).reshape(count, 2),
        photo_names=("stranger.png", "a.png"),
        photo=np.array([("stranger.png", "a.png").index(name) for name in names], dtype=np.int32),
        wall=np.full(count, -1, np.int32),
        points_world=np.array([[0.5 + 0.1 * k, 0.3, 1.0] for k in range(count)]),
        sigma_px=np.ones(count),
        sigma_m=np.full(count, 0.002),
        by_hand=np.ones(count, np.uint8),
    )


def context(folder: Path) -> StepContext:
    return StepContext(rng=np.random.default_rng(1), cores=1, scratch=folder)


def sift(folder: Path, walls: Walls, hand: Ties | None) -> tuple[Ties, list[str]]:
    ctx = context(folder)
    inputs = MatchSift.In(photos=photos(), walls=walls, hand=hand)
    return MatchSift().run(inputs, MatchSift.Params(), ctx).ties, list(ctx.warnings)


def test_ties_by_hand_stand_behind_those_that_are_found(tmp_path: Path) -> None:
    walls = ms.walls_of(SCENE)
    alone, _ = sift(tmp_path, walls, None)
    assert alone.by_hand is None
    hand = measured("a.png", "stranger.png", "a.png")
    both, _ = sift(tmp_path, walls, hand)
    count = len(alone.photo)
    np.testing.assert_array_equal(both.pixels_photo[:count], alone.pixels_photo)
    np.testing.assert_array_equal(both.pixels_photo[count:], hand.pixels_photo[[0, 2]])
    np.testing.assert_array_equal(both.points_world[count:], hand.points_world[[0, 2]])
    assert both.photo_names == ("a.png",)
    np.testing.assert_array_equal(both.photo[count:], [0, 0])
    np.testing.assert_array_equal(both.wall[count:], [0, 0])
    np.testing.assert_array_equal(both.by_hand, [0] * count + [1, 1])


def test_a_tie_by_hand_lies_on_the_nearest_wall(tmp_path: Path) -> None:
    (wall,) = ms.walls_of(SCENE).walls
    beside = replace(wall.frame, origin_world=wall.frame.origin_world + np.array([5.0, 0, 0]))
    behind = replace(wall.frame, origin_world=wall.frame.origin_world + np.array([0, 1.0, 0]))
    walls = replace(
        ms.walls_of(SCENE),
        walls=tuple(replace(wall, frame=f, intensity=None) for f in (behind, beside, wall.frame)),
    )
    hand = measured("a.png", "a.png", "a.png")
    hand = replace(hand, points_world=np.array([[1.0, 0.9, 1], [5.5, 0.2, 1], [1.0, 0.3, 1]]))
    ties, _ = sift(tmp_path, walls, hand)
    np.testing.assert_array_equal(ties.wall, [0, 1, 2])


def test_walls_that_show_nothing_leave_the_ties_by_hand(tmp_path: Path) -> None:
    walls = ms.walls_of(SCENE)
    bare = replace(walls, walls=tuple(replace(wall, intensity=None) for wall in walls.walls))
    with pytest.raises(MethodError, match="neither intensity nor colour"):
        sift(tmp_path, bare, None)
    ties, warnings = sift(tmp_path, bare, measured("a.png", "a.png"))
    np.testing.assert_array_equal(ties.by_hand, [1, 1])
    assert len(ties.walls) == 1
    assert any("only the ties measured by hand are used" in text for text in warnings)
    guided = MatchGuided.In(
        photos=photos(),
        walls=bare,
        cameras=ms.cameras(ms.oriented(CAMERA)),
        hand=measured("a.png"),
    )
    again = MatchGuided().run(guided, MatchGuided.Params(), context(tmp_path)).ties
    np.testing.assert_array_equal(again.by_hand, [1])
