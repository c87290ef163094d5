"""Asking photos from which side a wall is seen: turned where the guess was wrong, else left."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.match.sides import FaceByPhotos

from orthoflow.products import Photos, Planes, PointCloud
from orthoflow.sdk import StepContext
from orthoflow.testing import photographed as ms
from tests import samples


def context(tmp_path: Path) -> StepContext:
    return StepContext(rng=np.random.default_rng(1), cores=2, scratch=tmp_path)


@pytest.fixture(scope="module")
def scene() -> ms.TexturedWall:
    return ms.textured_wall(1)


@pytest.fixture(scope="module")
def cloud(scene: ms.TexturedWall) -> PointCloud:
    return ms.cloud_of(scene)


@pytest.fixture(scope="module")
def photos(scene: ms.TexturedWall) -> Photos:
    return ms.photos(ms.photo_of(scene, ms.camera_before(scene)))


def planes_of(scene: ms.TexturedWall, cloud: PointCloud, *, viewpoint: str = "guess") -> Planes:
    """The wall, rightly faced, and a floor before it."""
    frame = scene.frame
    corners = frame.corners_world()
    below = corners[[1, 1, 2, 2]]
    below[1:3] += frame.normal_world
    up = np.array([0.0, 0.0, 1.0])
    floor = np.array([0.0, 0.0, 1.0])
    return samples.planes(
        normal=np.array([frame.normal_world, floor]),
        offset=np.array([frame.plane.offset_m, float(floor @ below[0])]),
        corners=np.array([corners, below]),
        n_points=np.array([len(cloud), 10]),
        up=up,
        names=("wall 0", "floor"),
        part_corners=np.array([corners, below]),
        part_plane=np.array([0, 1], dtype=np.int32),
        viewpoint=viewpoint,
        tolerance_m=0.3,
    )


def faced(
    planes: Planes, cloud: PointCloud, photos: Photos, tmp_path: Path
) -> tuple[Planes, dict[str, float]]:
    ctx = context(tmp_path)
    inputs = FaceByPhotos.In(planes=planes, cloud=cloud, photos=photos)
    found = FaceByPhotos().run(inputs, FaceByPhotos.Params(), ctx).planes
    return found, {metric.name: metric.value for metric in ctx.metrics}


def test_a_wall_guessed_from_behind_is_turned_to_the_side_of_the_photos(
    scene: ms.TexturedWall, cloud: PointCloud, photos: Photos, tmp_path: Path
) -> None:
    right = planes_of(scene, cloud)
    found, metrics = faced(right.turned(0), cloud, photos, tmp_path)
    np.testing.assert_array_equal(found.normal, right.normal)
    np.testing.assert_array_equal(found.offset, right.offset)
    np.testing.assert_array_equal(found.corners, right.corners)
    np.testing.assert_array_equal(found.part_corners, right.part_corners)
    assert found.side_from == ("photos", "guess")
    assert metrics == {"n_planes_guessed": 1, "n_planes_turned": 1, "n_planes_seen": 1}


def test_a_wall_guessed_rightly_stays_and_is_known_from_then_on(
    scene: ms.TexturedWall, cloud: PointCloud, photos: Photos, tmp_path: Path
) -> None:
    right = planes_of(scene, cloud)
    found, metrics = faced(right, cloud, photos, tmp_path)
    np.testing.assert_array_equal(found.normal, right.normal)
    np.testing.assert_array_equal(found.corners, right.corners)
    assert found.side_from == ("photos", "guess")
    assert metrics["n_planes_turned"] == 0


@pytest.mark.parametrize("viewpoint", ["stations", "view_from", "given"])
def test_planes_whose_side_is_known_are_not_asked_about(
    scene: ms.TexturedWall, cloud: PointCloud, photos: Photos, tmp_path: Path, viewpoint: str
) -> None:
    wrong = planes_of(scene, cloud, viewpoint=viewpoint).turned(0)
    found, metrics = faced(wrong, cloud, photos, tmp_path)
    assert found is wrong
    assert metrics == {"n_planes_guessed": 0, "n_planes_turned": 0}


def test_photos_that_show_something_else_leave_the_guess(
    scene: ms.TexturedWall, cloud: PointCloud, tmp_path: Path
) -> None:
    elsewhere = ms.textured_wall(2)
    photos = ms.photos(ms.photo_of(elsewhere, ms.camera_before(elsewhere)))
    wrong = planes_of(scene, cloud).turned(0)
    found, metrics = faced(wrong, cloud, photos, tmp_path)
    assert found is wrong
    assert metrics == {"n_planes_guessed": 1, "n_planes_turned": 0, "n_planes_seen": 0}


# --- how a verdict comes about ---


def test_points_with_colour_alone_tell_the_side_too(
    scene: ms.TexturedWall, cloud: PointCloud, photos: Photos, tmp_path: Path
) -> None:
    assert cloud.intensity is not None
    grey = np.rint(255.0 * cloud.intensity).astype(np.uint8)
    coloured = replace(cloud, intensity=None, rgb=np.column_stack([grey, grey, grey]))
    right = planes_of(scene, cloud)
    found, _ = faced(right.turned(0), coloured, photos, tmp_path)
    np.testing.assert_array_equal(found.normal, right.normal)
