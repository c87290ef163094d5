"""Sides of walls from photos: planes are turned if the guess was wrong, and otherwise unchanged."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.match import sides
from orthoflow_plugins.match.sides import FaceByPhotos

from orthoflow.products import Planes, PointCloud
from orthoflow.testing import photographed as ms
from tests import samples
from tests.method_runs import run
from tests.tied_photos import context

SCENE = ms.textured_wall(1)
CLOUD = ms.cloud_of(SCENE, spacing_m=0.008)


def planes(viewpoint: str = "guess") -> Planes:
    """Return the wall with the correct side, and a floor in front of it."""
    frame = SCENE.frame
    corners = frame.corners_world()
    below = corners[[1, 1, 2, 2]]
    below[1:3] += frame.normal_world
    return samples.planes(
        normal=np.array([frame.normal_world, samples.UP]),
        offset=np.array([frame.plane.offset_m, float(samples.UP @ below[0])]),
        corners=np.array([corners, below]),
        n_points=np.array([len(CLOUD), 10]),
        names=("wall 0", "floor"),
        part_corners=np.array([corners, below]),
        part_plane=np.array([0, 1], dtype=np.int32),
        viewpoint=viewpoint,
        tolerance_m=0.3,
    )


def faced(
    given: Planes, folder: Path, *, cloud: PointCloud = CLOUD, shown: ms.TexturedWall = SCENE
) -> tuple[Planes, dict[str, float]]:
    ctx = context(folder)
    photos = ms.photos(ms.photo_of(shown, ms.camera_before()))
    inputs = {"planes": given, "cloud": cloud, "photos": photos}
    found = run(FaceByPhotos, ctx, inputs).planes
    return found, {metric.name: metric.value for metric in ctx.metrics}


@pytest.mark.parametrize(
    ("is_wrong", "cloud"),
    [(True, CLOUD), (False, CLOUD), (True, replace(CLOUD, intensity=None))],
    ids=["guessed from behind", "guessed rightly", "points with colour alone"],
)
def test_photos_show_the_side_of_a_wall(tmp_path: Path, is_wrong: bool, cloud: PointCloud) -> None:
    right = planes()
    found, metrics = faced(right.turned(0) if is_wrong else right, tmp_path, cloud=cloud)
    for name in ("normal", "offset", "corners", "part_corners"):
        np.testing.assert_array_equal(getattr(found, name), getattr(right, name))
    assert found.side_from == ("photos", "guess")
    assert metrics == {"n_planes_guessed": 1, "n_planes_turned": is_wrong, "n_planes_seen": 1}


@pytest.mark.parametrize(
    ("front", "behind", "n_turned", "n_seen"),
    [(0, 16, 1, 1), (0, 15, 0, 0), (20, 40, 1, 1), (21, 40, 0, 0), (40, 20, 0, 1)],
)
def test_sixteen_matches_and_twice_those_of_the_other_side_decide(
    front: int, behind: int, n_turned: int, n_seen: int, tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.setattr(sides, "side_matches", lambda *_: np.array([[front, behind]]))
    _, metrics = faced(planes(), tmp_path)
    assert (metrics["n_planes_turned"], metrics["n_planes_seen"]) == (n_turned, n_seen)


@pytest.mark.parametrize("viewpoint", ["stations", "view_from", "given"])
def test_planes_whose_side_is_known_are_not_asked_about(tmp_path: Path, viewpoint: str) -> None:
    wrong = planes(viewpoint).turned(0)
    found, metrics = faced(wrong, tmp_path)
    assert found is wrong
    assert metrics == {"n_planes_guessed": 0, "n_planes_turned": 0}


def test_photos_that_show_something_else_leave_the_guess(tmp_path: Path) -> None:
    wrong = planes().turned(0)
    found, metrics = faced(wrong, tmp_path, shown=ms.textured_wall(2))
    assert found is wrong
    assert metrics == {"n_planes_guessed": 1, "n_planes_turned": 0, "n_planes_seen": 0}


@pytest.mark.parametrize(("moved_m", "is_turned"), [(1.0, True), (3.0, False)])
def test_a_plane_between_two_that_face_the_other_way_is_turned(
    tmp_path: Path, moved_m: float, is_turned: bool
) -> None:
    normal = SCENE.frame.normal_world
    offset_m = SCENE.frame.plane.offset_m
    # There are the facade, a step that the guess turned towards it, and an object farther in front.
    places_m = np.array([0.0, moved_m, 2.0])
    corners = SCENE.frame.corners_world() + places_m[:, None, None] * normal
    corners[1] = corners[1][[3, 2, 1, 0]]
    given = samples.planes(
        normal=np.array([normal, -normal, normal]),
        offset=np.array([offset_m, -(offset_m + moved_m), offset_m + 2.0]),
        corners=corners,
        n_points=np.array([len(CLOUD), 10, 10]),
        names=("wall 0", "wall 1", "wall 2"),
        side_from=("stations", "guess", "stations"),
        tolerance_m=0.3,
    )
    found, metrics = faced(given, tmp_path, shown=ms.textured_wall(2))
    assert metrics["n_planes_turned"] == is_turned
    np.testing.assert_allclose(found.normal[1], normal if is_turned else -normal)
    assert found.side_source(1) == "guess"
