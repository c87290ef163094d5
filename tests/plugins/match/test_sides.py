"""Asking photos from which side a wall is seen: turned where the guess was wrong, else left."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.match import sides
from orthoflow_plugins.match.sides import FaceByPhotos
from orthoflow_plugins.match.sift import MatchSift
from orthoflow_plugins.orient.pnp import OrientPnp
from orthoflow_plugins.raster.grid import RasterGrid

from orthoflow.geometry import WallFrame
from orthoflow.products import Photos, Planes, PointCloud
from orthoflow.sdk import StepContext
from orthoflow.testing import photographed as ms
from tests import inspect_scenes, raster_scenes, samples
from tests.long_loops import IS_LONG

FLOOR = 1


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
    params = MatchSift.Params(n_features_max=2000)
    ties = MatchSift().run(MatchSift.In(photos=photos, walls=walls.walls), params, ctx).ties
    assert not [warning for warning in ctx.warnings if "mirror" in warning]
    posed = OrientPnp().run(
        OrientPnp.In(ties=ties, photos=photos), OrientPnp.Params(), context(tmp_path)
    )
    for wall, camera, truth in zip(room, posed.cameras.cameras, true, strict=True):
        assert camera.status == "ok"
        # A fifth of a cell.
        assert ms.wall_error_m(wall, camera.viewing(), truth) < 0.002


def test_points_with_colour_alone_tell_the_side_too(
    scene: ms.TexturedWall, cloud: PointCloud, photos: Photos, tmp_path: Path
) -> None:
    assert cloud.intensity is not None
    grey = np.rint(255.0 * cloud.intensity).astype(np.uint8)
    coloured = replace(cloud, intensity=None, rgb=np.column_stack([grey, grey, grey]))
    right = planes_of(scene, cloud)
    found, _ = faced(right.turned(0), coloured, photos, tmp_path)
    np.testing.assert_array_equal(found.normal, right.normal)


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


def test_a_plane_turned_twice_is_the_plane(scene: ms.TexturedWall, cloud: PointCloud) -> None:
    planes = planes_of(scene, cloud)
    once = planes.turned(0)
    np.testing.assert_array_equal(once.normal[0], -planes.normal[0])
    np.testing.assert_array_equal(once.corners[0, 0], planes.corners[0, 3])
    np.testing.assert_array_equal(once.corners[1], planes.corners[1])
    twice = once.turned(0)
    np.testing.assert_array_equal(twice.normal, planes.normal)
    np.testing.assert_array_equal(twice.corners, planes.corners)


# --- how a verdict comes about ---


@pytest.mark.parametrize(
    ("front", "behind", "is_told"),
    [
        (15, 0, False),
        (16, 0, True),
        (0, 16, True),
        (0, 15, False),
        # Twice as many as on the other side, of whichever.
        (40, 20, True),
        (20, 40, True),
        (39, 20, False),
        (20, 39, False),
        (0, 0, False),
    ],
)
def test_a_side_is_told_by_enough_matches_and_clearly_more(
    front: int, behind: int, is_told: bool
) -> None:
    assert sides._is_told(front, behind, FaceByPhotos.Params()) is is_told


def test_holes_between_points_are_filled_and_larger_ones_are_not() -> None:
    grey = np.full((11, 20), np.nan, dtype=np.float32)
    grey[:, 2], grey[:, 6] = 0.25, 0.75
    filled = sides._filled_between(grey)
    # Two cells about each point.
    known = np.zeros((11, 20), dtype=np.bool_)
    known[:, :9] = True
    np.testing.assert_array_equal(np.isfinite(filled), known)
    np.testing.assert_array_equal(filled[:, [2, 6]], grey[:, [2, 6]])
    assert (np.diff(filled[5, 2:7]) > 0.0).all()
    assert 0.25 < filled[5, 4] < 0.75


@pytest.mark.parametrize("is_colour", [True, False])
def test_the_picture_of_a_plane_is_of_its_topmost_points(is_colour: bool) -> None:
    frame = inspect_scenes.frame(shape=(4, 6))
    # Of two points in each cell the lower one is dark; one lies too far before the plane.
    places = np.array([[c + 0.5, r + 0.5] for r in range(4) for c in range(6)])
    depths = np.repeat([0.0, 0.01, 0.5], len(places))
    points = frame.world_from_wall(np.tile(places, (3, 1)), depths)
    levels = np.repeat([0, 204, 255], len(places)).astype(np.uint8)
    known = {"rgb": np.stack([levels] * 3, axis=1)} if is_colour else {}
    bright = None if is_colour else levels.astype(np.float32) / np.float32(255.0)
    seen = replace(raster_scenes.cloud_of(points, intensity=bright), **known)
    grey = sides._grey_on(frame, 0.02, seen, 1)
    np.testing.assert_allclose(grey, 0.8, atol=1e-6)


@pytest.mark.parametrize(
    ("n_points", "cell_m"), [(1_500, 0.6 * 0.02), (10**9, np.sqrt(0.6 / 4_000_000))]
)
def test_cells_are_as_fine_as_points_lie_and_no_more_than_millions(
    monkeypatch: pytest.MonkeyPatch, n_points: int, cell_m: float
) -> None:
    # One metre by sixty centimetres: a point every two centimetres.
    corners = np.array([[0.0, 0.0, 0.6], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.6]])
    planes = samples.planes(
        normal=np.array([[0.0, -1.0, 0.0]]),
        offset=np.zeros(1),
        corners=corners[None],
        n_points=np.array([n_points]),
        names=("wall",),
    )
    asked: list[float] = []

    def grey_on(frame: WallFrame, *_: object) -> np.ndarray:
        asked.append(frame.gsd_m)
        return np.full((2, 2), np.nan, dtype=np.float32)

    monkeypatch.setattr(sides, "_grey_on", grey_on)
    monkeypatch.setattr(sides, "Wall", lambda **_: None)
    monkeypatch.setattr(sides, "wall_features", lambda *_: None)
    cloud: Any = None
    assert sides._features(planes, 0, cloud, 1) is None
    assert asked == [pytest.approx(cell_m, rel=0.01)]
