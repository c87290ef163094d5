"""`colour.photos`: points take the colours of photos that really see them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.colour.photos import ColourPhotos

from orthoflow.errors import MethodError
from orthoflow.files.clouds import photo_colours as module
from orthoflow.geometry.depth_buffer_kernels import DepthBuffer
from orthoflow.products import Cameras, Photos, PointCloud
from tests import ortho_scenes
from tests import raster_scenes as scenes
from tests.ortho_scenes import BLUE, BOARD, NOTHING


def coloured(
    folder: Path, cloud: PointCloud, photos: Photos, cameras: Cameras, **params: object
) -> tuple[PointCloud, dict[str, float]]:
    ctx = scenes.context(folder)
    inputs = ColourPhotos.In(cloud=cloud, photos=photos, cameras=cameras)
    out = ColourPhotos().run(inputs, ColourPhotos.Params.model_validate(params), ctx)
    return out.cloud, {metric.name: metric.value for metric in ctx.metrics}


def test_points_take_the_colour_of_what_the_photo_sees_there(tmp_path: Path) -> None:
    where = ortho_scenes.frame()
    viewer = ortho_scenes.camera(where)
    photos = ortho_scenes.photos(ortho_scenes.rendered())
    cloud, metrics = coloured(
        tmp_path,
        ortho_scenes.cloud(where),
        photos,
        ortho_scenes.cameras(viewer),
        tolerance_m=0.01,
    )
    assert cloud.rgb is not None
    points = cloud.points_world()
    truth = ortho_scenes.cast(
        where, np.broadcast_to(viewer.centre_world, points.shape), points - viewer.centre_world
    )
    # What the photo cannot see is left out: all but a rim of half a depth pixel.
    off_m = 0.004 * np.linalg.norm(
        where.wall_from_world(points)[:, :2] - truth.places[:, :2], axis=1
    )
    seen = off_m < 0.01
    assert seen.mean() > 0.97
    assert 0.5 < metrics["coloured_share"] < 1.0
    # Blue tells the surface; a few points lie at its rims, between two pixels.
    wanted = BLUE[truth.surface]
    same = np.abs(cloud.rgb[:, 2].astype(int) - wanted) <= 3
    assert same[seen].mean() > 0.97
    assert (truth.surface[seen] == BOARD).any()
    assert not (truth.surface == NOTHING).any()


def test_unseen_points_may_stay_in_grey(tmp_path: Path) -> None:
    where = ortho_scenes.frame()
    photos = ortho_scenes.photos(ortho_scenes.rendered())
    cameras = ortho_scenes.cameras(ortho_scenes.camera(where))
    bare = ortho_scenes.cloud(where)
    kept, metrics = coloured(tmp_path, bare, photos, cameras, unseen="grey", tolerance_m=0.01)
    assert len(kept) == len(bare)
    assert kept.rgb is not None
    grey = np.all(kept.rgb == 128, axis=1).mean()
    assert grey == pytest.approx(1.0 - metrics["coloured_share"], abs=0.01)


def test_photos_that_are_not_oriented_or_look_elsewhere_are_refused(tmp_path: Path) -> None:
    where = ortho_scenes.frame()
    photos = ortho_scenes.photos(ortho_scenes.rendered())
    viewer = ortho_scenes.camera(where)
    lost = Cameras(cameras=(replace(ortho_scenes.cameras(viewer).cameras[0], status="lost"),))
    with pytest.raises(MethodError, match="none of the photos is oriented"):
        coloured(tmp_path, ortho_scenes.cloud(where), photos, lost)
    away = ortho_scenes.cloud(ortho_scenes.frame(at_survey=True))
    with pytest.raises(MethodError, match="no photo sees any point"):
        coloured(tmp_path, away, photos, ortho_scenes.cameras(viewer))


# --- one photo ---


def test_points_of_a_photo_are_those_inside_it_part_by_part(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "_PROJECTED_AT_ONCE", 7)
    where = ortho_scenes.frame()
    viewer = ortho_scenes.camera(where)
    shares = np.random.default_rng(0).uniform(-1.5, 2.5, (40, 2))
    cloud = scenes.cloud_of(where.world_from_wall(shares * [where.width, where.height]))
    near = viewer.shifted(cloud.origin)
    parts = list(module._points_in_photo(cloud, near))
    offsets = np.column_stack([cloud.x, cloud.y, cloud.z]).astype(np.float64)
    projected = near.project(offsets)
    inside = np.flatnonzero(near.sees(projected[:, :2]))
    assert 0 < len(inside) < 40
    np.testing.assert_array_equal(np.concatenate([part.index for part in parts]), inside)
    pixels = np.concatenate([part.pixels for part in parts])
    np.testing.assert_allclose(pixels, projected[inside, :2])
    depths = np.concatenate([part.depth_m for part in parts])
    np.testing.assert_allclose(depths, projected[inside, 2])


def test_nearer_photos_are_better_and_their_borders_worse() -> None:
    viewer = ortho_scenes.camera(ortho_scenes.frame())
    width, height = float(viewer.width), float(viewer.height)
    middle = 0.5 * np.array([width, height])
    share = module._BORDER_SHARE * min(width, height)
    pixels = np.array(
        [middle, middle, [0.5 * share, middle[1]], [middle[0], height - 0.25 * share], [0.0, 0.0]]
    )
    shown = module._ShownPoints(
        index=np.arange(5), pixels=pixels, depth_m=np.array([2.0, 4.0, 2.0, 2.0, 2.0])
    )
    best = (viewer.fx / 2.0) ** 2
    expected = best * np.array([1.0, 0.25, 0.5, 0.25, 1e-3])
    np.testing.assert_allclose(module._quality(shown, viewer), expected, rtol=1e-5)


def test_points_behind_what_the_buffer_holds_are_not_seen() -> None:
    nearest = np.array([[1.0, 2.0], [3.0, np.inf]], dtype=np.float32)
    buffer = DepthBuffer(nearest=nearest, reduction=4.0)
    pixels = np.array([[0.0, 3.9], [4.1, 3.9], [3.9, 4.1], [7.9, 7.9]])
    for away_m, expected in ((0.09, [True] * 4), (0.11, [False, False, False, True])):
        shown = module._ShownPoints(
            index=np.arange(4), pixels=pixels, depth_m=np.array([1.0, 2.0, 3.0, 99.0]) + away_m
        )
        np.testing.assert_array_equal(module._is_seen(shown, buffer, 0.1), expected)


def test_the_box_holds_the_cameras_and_the_cloud_but_for_outliers() -> None:
    viewer = ortho_scenes.camera(ortho_scenes.frame())
    # A floor of four metres square with a point per centimetre, and a few stray points.
    x, y = np.meshgrid(np.arange(400) / 100.0, np.arange(400) / 100.0)
    floor = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    stray = np.tile([[500.0, 500.0, 500.0]], (5, 1))
    cloud = scenes.cloud_of(np.concatenate([floor, stray]))
    box = module._box_of(cloud, [viewer])
    centre, offsets = viewer.centre_world - cloud.origin, cloud.points_world()[:-5] - cloud.origin
    low, high = np.minimum(offsets.min(axis=0), centre), np.maximum(offsets.max(axis=0), centre)
    # A cube more on each side.
    assert (np.abs(box.low - low) < 0.15).all()
    assert (np.abs(box.high - high) < 0.15).all()
    assert box.spacing_m == pytest.approx(0.01, rel=0.1)
