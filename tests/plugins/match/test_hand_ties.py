"""Ties that a person measured go through matching: behind what is found, each on its wall."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.match.guided import MatchGuided
from orthoflow_plugins.match.sift import MatchSift

from orthoflow.errors import MethodError
from orthoflow.products import Ties, Walls
from orthoflow.testing import photographed as ms
from tests import matched_walls as mw
from tests import samples
from tests.method_runs import run

SCENE = ms.textured_wall(0)
CAMERA = ms.camera_before(SCENE, centre=(1.3, -2.6, 1.1))


PHOTOS = ms.photos(ms.photo_of(SCENE, CAMERA))
WALLS = mw.walls(0)


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


def sift(folder: Path, walls: Walls, hand: Ties | None) -> Ties:
    return mw.ties_of(MatchSift, folder, {"photos": PHOTOS, "walls": walls, "hand": hand})


def test_ties_by_hand_stand_behind_those_that_are_found(tmp_path: Path) -> None:
    alone = sift(tmp_path, WALLS, None)
    assert alone.by_hand is None
    hand = measured("a.png", "stranger.png", "a.png")
    both = sift(tmp_path, WALLS, hand)
    count = len(alone.photo)
    np.testing.assert_array_equal(both.pixels_photo[:count], alone.pixels_photo)
    np.testing.assert_array_equal(both.pixels_photo[count:], hand.pixels_photo[[0, 2]])
    np.testing.assert_array_equal(both.points_world[count:], hand.points_world[[0, 2]])
    assert both.photo_names == ("a.png",)
    np.testing.assert_array_equal(both.photo[count:], [0, 0])
    np.testing.assert_array_equal(both.wall[count:], [0, 0])
    np.testing.assert_array_equal(both.by_hand, [0] * count + [1, 1])


def test_a_tie_by_hand_lies_on_the_nearest_wall(tmp_path: Path) -> None:
    (wall,) = WALLS.walls
    beside = replace(wall.frame, origin_world=wall.frame.origin_world + np.array([5.0, 0, 0]))
    behind = replace(wall.frame, origin_world=wall.frame.origin_world + np.array([0, 1.0, 0]))
    walls = replace(
        WALLS,
        walls=tuple(replace(wall, frame=f, intensity=None) for f in (behind, beside, wall.frame)),
    )
    hand = measured("a.png", "a.png", "a.png")
    hand = replace(hand, points_world=np.array([[1.0, 0.9, 1], [5.5, 0.2, 1], [1.0, 0.3, 1]]))
    np.testing.assert_array_equal(sift(tmp_path, walls, hand).wall, [0, 1, 2])


def test_walls_that_show_nothing_leave_the_ties_by_hand(tmp_path: Path) -> None:
    bare = replace(WALLS, walls=tuple(replace(wall, intensity=None) for wall in WALLS.walls))
    with pytest.raises(MethodError, match="neither intensity nor colour"):
        sift(tmp_path, bare, None)
    inputs = {"photos": PHOTOS, "walls": bare, "hand": measured("a.png", "a.png")}
    cameras = {"cameras": ms.cameras(ms.oriented(CAMERA))}
    for method, more in ((MatchSift, {}), (MatchGuided, cameras)):
        ctx = mw.context(tmp_path)
        ties = run(method, ctx, {**inputs, **more}).ties
        np.testing.assert_array_equal(ties.by_hand, [1, 1])
        assert len(ties.walls) == 1
        assert [each.code for each in ctx.diagnostics] == ["scan-without-texture"]
