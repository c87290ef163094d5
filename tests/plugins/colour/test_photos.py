"""`colour.photos`: points get the colours of photos that show them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.colour.photos import ColourPhotos

from orthoflow.errors import MethodError
from orthoflow.files.clouds import photo_colours as module
from orthoflow.products import Cameras, PointCloud, Product
from tests import ortho_scenes
from tests import raster_scenes as scenes
from tests.method_runs import run
from tests.ortho_scenes import BLUE, BOARD, NOTHING


def coloured(
    folder: Path, *, unseen: str = "drop", **changes: Product
) -> tuple[PointCloud, dict[str, float]]:
    """Return the points of a scene, coloured by a photo, and the metrics."""
    scene = ortho_scenes.inputs(**changes)
    ctx = scenes.context(folder)
    inputs = {name: scene[name] for name in ("cloud", "photos", "cameras")}
    return run(ColourPhotos, ctx, inputs, unseen=unseen).cloud, scenes.numbers(ctx)


def test_points_take_the_colour_of_what_the_photo_sees_there(tmp_path: Path) -> None:
    where = ortho_scenes.frame()
    viewer = ortho_scenes.camera(where)
    cloud, metrics = coloured(tmp_path)
    points = cloud.points_world()
    # Each point keeps its index in the given cloud, which is needed to compare labels with the
    # truth.
    given = ortho_scenes.cloud(where)
    np.testing.assert_array_equal(given.points_world()[cloud.point_id], points)
    truth = ortho_scenes.cast(
        where, np.broadcast_to(viewer.centre_world, points.shape), points - viewer.centre_world
    )
    # Points that the photo does not show are omitted, except along edges of half a depth pixel.
    off_m = 0.004 * np.linalg.norm(
        where.wall_from_world(points)[:, :2] - truth.places[:, :2], axis=1
    )
    seen = off_m < 0.01
    assert seen.mean() > 0.97
    assert 0.5 < metrics["coloured_share"] < 1.0
    # Blue identifies the surface; a few points are at its edges, between two pixels.
    wanted = BLUE[truth.surface]
    same = np.abs(cloud.rgb[:, 2].astype(int) - wanted) <= 3
    assert same[seen].mean() > 0.97
    assert (truth.surface[seen] == BOARD).any()
    assert not (truth.surface == NOTHING).any()
    # Unseen points may stay, in grey.
    kept, metrics = coloured(tmp_path, unseen="grey")
    assert len(kept) == len(given)
    grey = np.all(kept.rgb == 128, axis=1).mean()
    assert grey == pytest.approx(1.0 - metrics["coloured_share"], abs=0.01)


def test_photos_that_are_not_oriented_or_look_elsewhere_are_refused(tmp_path: Path) -> None:
    (found,) = ortho_scenes.cameras(ortho_scenes.camera(ortho_scenes.frame())).cameras
    with pytest.raises(MethodError, match="none of the photos is oriented"):
        coloured(tmp_path, cameras=Cameras(cameras=(replace(found, status="lost"),)))
    with pytest.raises(MethodError, match="no photo shows a point"):
        coloured(tmp_path, cloud=ortho_scenes.cloud(ortho_scenes.frame(at_survey=True)))


def test_the_box_holds_the_cameras_and_the_cloud_but_for_outliers() -> None:
    viewer = ortho_scenes.camera(ortho_scenes.frame())
    # A floor of 4 m x 4 m with a point per centimetre, and a few stray points.
    x, y = np.meshgrid(np.arange(400) / 100.0, np.arange(400) / 100.0)
    floor = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    stray = np.tile([[500.0, 500.0, 500.0]], (5, 1))
    cloud = scenes.cloud_of(np.concatenate([floor, stray]))
    box = module.box_around(cloud, [viewer])
    centre, offsets = viewer.centre_world - cloud.origin, cloud.points_world()[:-5] - cloud.origin
    low, high = np.minimum(offsets.min(axis=0), centre), np.maximum(offsets.max(axis=0), centre)
    # The box has a margin of one cube on each side.
    assert (np.abs(box.low - low) < 0.15).all()
    assert (np.abs(box.high - high) < 0.15).all()
    assert box.spacing_m == pytest.approx(0.01, rel=0.1)
