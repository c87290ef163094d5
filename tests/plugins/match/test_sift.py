"""Matching photos with walls: exact neighbours, unbiased key points, and plain refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.match.pictures import points_on_wall
from orthoflow_plugins.match.sift import MatchSift

from orthoflow.files.images import encode_png
from orthoflow.products import Photo, TieRole, Walls
from orthoflow.testing import photographed as ms
from tests import matched_walls as mw
from tests.method_runs import run

SCENE = ms.textured_wall(1)


def inputs_of(photo: Photo, walls: Walls | None = None) -> dict[str, object]:
    return {"photos": ms.photos(photo), "walls": walls or mw.walls(1)}


@pytest.mark.parametrize("roll", [0.0, 1.57], ids=["level", "portrait"])
def test_ties_lie_where_the_true_camera_sees_their_points(tmp_path: Path, roll: float) -> None:
    camera = ms.camera_before(SCENE, roll=roll)
    ties = mw.ties_of(MatchSift, tmp_path, inputs_of(ms.photo_of(SCENE, camera)))
    error = mw.off_px(ties, camera)
    length = np.linalg.norm(error, axis=1)
    right = error[length < 3.0]
    assert len(right) > 1000
    assert np.mean(length >= 3.0) < 0.05
    # A quarter of a pixel is what OpenCV's default would give.
    np.testing.assert_allclose(right.mean(axis=0), 0.0, atol=0.05)
    # The stated deviation is that of the ties, within a factor.
    depth = camera.project(ties.points_world)[:, 2]
    stated = np.hypot(ties.sigma_px, ties.sigma_m * camera.fx / depth)[length < 3.0]
    assert 0.3 < np.sqrt(np.mean((right / stated[:, None]) ** 2)) < 1.5


def test_a_photo_of_nothing_known_is_warned_of(tmp_path: Path) -> None:
    photo = ms.photo_of(SCENE, ms.camera_before(SCENE))
    blank = replace(photo, encoded=encode_png(np.full((photo.height, photo.width), 128, np.uint8)))
    ctx = mw.context(tmp_path)
    ties = run(MatchSift, ctx, inputs_of(blank)).ties
    assert not (ties.role != TieRole.REJECTED).any()
    assert [each.code for each in ctx.diagnostics] == ["photo-shows-no-wall"]


def test_a_mirrored_photo_is_recognised_as_such(tmp_path: Path) -> None:
    # The right fifth of the wall is the mirror image of its left fifth.
    (wall,) = mw.walls(1).walls
    assert wall.intensity is not None
    side = wall.frame.width // 5
    symmetric = wall.intensity.copy()
    symmetric[:, -side:] = symmetric[:, side - 1 :: -1]
    flat = np.where(np.isfinite(symmetric), 0.0, np.nan).astype(np.float32)
    palace = replace(mw.walls(1), walls=(replace(wall, intensity=symmetric, depth_m=flat),))
    grey = np.nan_to_num(symmetric * 255.0).clip(0, 255).astype(np.uint8)
    size = {"width": grey.shape[1], "height": grey.shape[0]}
    photo = Photo(name="a.png", encoded=encode_png(grey[:, ::-1].copy()), **size)
    ctx = mw.context(tmp_path)
    ties = run(MatchSift, ctx, inputs_of(photo, palace)).ties
    assert not (ties.role != TieRole.REJECTED).any()
    assert [each.code for each in ctx.diagnostics] == ["photo-mirrored"]


@pytest.mark.parametrize("n_even", [0, 400], ids=["steps alone", "some elsewhere"])
def test_where_few_cells_have_several_points_those_on_steps_decide_no_uncertainty(
    n_even: int,
) -> None:
    # Cells half as wide as points lie apart: several fall into one on the step, hardly elsewhere.
    (wall,) = mw.walls(1).walls
    depth, sigma = wall.depth_m.copy(), np.full_like(wall.sigma_m, np.nan)
    depth[:, 300:] += 0.2
    sigma[:, 299:301] = 0.1
    count = np.where(np.isfinite(sigma), 2, 1).astype(np.uint32)
    rows, columns = np.divmod(np.arange(n_even), 20)
    sigma[rows, columns], count[rows, columns] = 0.0015, 2
    sparse = replace(wall, depth_m=depth, sigma_m=sigma, count=count)
    flat = points_on_wall(sparse, np.array([[100.3, 80.7]]))
    # Half a cell where nothing else is known; else a tenth of what the step holds.
    assert flat[1][0] < (0.01 if n_even else 0.7 * ms.GSD_M)
    edge = points_on_wall(sparse, np.array([[300.1, 80.7]]))
    assert edge[1][0] > 0.05
