"""Asking photos from which side a wall is seen: turned where the guess was wrong, else left."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.match.sides import FaceByPhotos
from orthoflow_plugins.match.sift import MatchSift
from orthoflow_plugins.orient.pnp import OrientPnp
from orthoflow_plugins.raster.grid import RasterGrid

from orthoflow.products import Photos, Planes, PointCloud
from orthoflow.sdk import StepContext
from orthoflow.testing import photographed as ms
from tests import samples
from tests.long_loops import IS_LONG


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


# Two walls of a room, 6 m apart, both with the photos of them on one side or the other.
BEHIND = {"centre": (1.2, 2.6, 1.1), "towards": (1.5, 0.0, 1.0)}


@pytest.fixture(scope="module")
def room() -> tuple[ms.TexturedWall, ...]:
    far = np.array([0.5, 6.0, 2.0])
    return ms.textured_wall(1), ms.textured_wall(2, origin_world=far)


@pytest.fixture(scope="module")
def merged(room: tuple[ms.TexturedWall, ...]) -> PointCloud:
    """Both walls in one cloud, which says nothing of stations."""
    clouds = [ms.cloud_of(wall) for wall in room]
    first = clouds[0]
    points = np.concatenate([each.points_world() for each in clouds]) - first.origin
    x, y, z = np.ascontiguousarray(points.T, dtype=np.float32)
    intensity = np.concatenate([each.intensity for each in clouds if each.intensity is not None])
    return PointCloud(origin=first.origin, x=x, y=y, z=z, up=first.up, intensity=intensity)


@pytest.mark.parametrize(
    "behind",
    [
        (True, False),
        pytest.param(
            (False, True),
            marks=[
                pytest.mark.long,
                pytest.mark.skipif(not IS_LONG, reason="more of it: .ci/run --long"),
            ],
        ),
    ],
    ids=["first", "second"],
)
def test_walls_are_seen_from_the_side_of_their_photos_whichever_way_their_planes_point(
    room: tuple[ms.TexturedWall, ...],
    merged: PointCloud,
    behind: tuple[bool, bool],
    tmp_path: Path,
) -> None:
    true = [
        ms.camera_before(wall, **(BEHIND if is_behind else {}))
        for wall, is_behind in zip(room, behind, strict=True)
    ]
    photos = ms.photos(
        *(
            ms.photo_of(wall, camera, name=f"{k}.png")
            for k, (wall, camera) in enumerate(zip(room, true, strict=True))
        )
    )
    frames = [wall.frame for wall in room]
    right = Planes(
        normal=np.array([frame.normal_world for frame in frames]),
        offset=np.array([frame.plane.offset_m for frame in frames]),
        corners=np.array([frame.corners_world() for frame in frames]),
        covariance=np.zeros((2, 4, 4)),
        n_points=np.array([len(merged) // 2] * 2),
        rms_m=np.zeros(2),
        up=np.array([0.0, 0.0, 1.0]),
        names=("wall 0", "wall 1"),
        viewpoint="guess",
        tolerance_m=0.15,
    )
    wanted = right.turned(behind.index(True))
    for turned in ((), (0, 1)):
        guessed = right
        for index in turned:
            guessed = guessed.turned(index)
        found, metrics = faced(guessed, merged, photos, tmp_path)
        np.testing.assert_array_equal(found.normal, wanted.normal)
        np.testing.assert_array_equal(found.corners, wanted.corners)
        assert found.side_from == ("photos", "photos")
        assert metrics["n_planes_turned"] == (guessed.normal != wanted.normal).any(axis=1).sum()
    walls = RasterGrid().run(
        RasterGrid.In(cloud=merged, planes=found), RasterGrid.Params(gsd_m=0.01), context(tmp_path)
    )
    ctx = context(tmp_path)
    params = MatchSift.Params(max_features=2000)
    ties = MatchSift().run(MatchSift.In(photos=photos, walls=walls.walls), params, ctx).ties
    assert not [warning for warning in ctx.warnings if "mirror" in warning]
    posed = OrientPnp().run(
        OrientPnp.In(ties=ties, photos=photos), OrientPnp.Params(), context(tmp_path)
    )
    for wall, camera, truth in zip(room, posed.cameras.cameras, true, strict=True):
        assert camera.status == "ok"
        # A fifth of a cell.
        assert ms.wall_error_m(wall, camera.viewing(), truth) < 0.002


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
