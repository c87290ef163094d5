"""The COLMAP text model: COLMAP opens it and sees every tie where the orientation has it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from orthoflow.errors import ArgumentError
from orthoflow.files.colmap import write_colmap_model
from orthoflow.products import Camera, Cameras, TieRole
from orthoflow.testing import photographed as ms
from tests import block_scenes as bs


def oriented() -> Cameras:
    """Four photos, the last of them refused; ties with exact residuals, some rejected."""
    ties = bs.scan_ties(0, n=40)
    cameras = [
        ms.oriented(camera, name=name)
        for camera, name in zip(bs.viewers(), bs.names(), strict=True)
    ]
    cameras[3] = Camera(photo=bs.names()[3], status="too few ties")
    residuals = np.full_like(ties.pixels_photo, np.nan)
    role = np.full(len(ties.photo), TieRole.REJECTED, dtype=np.uint8)
    for index, camera in enumerate(bs.viewers()[:3]):
        mine = ties.photo == index
        residuals[mine] = ties.pixels_photo[mine] - camera.project(ties.points_world[mine])[:, :2]
        role[mine] = np.where(np.arange(mine.sum()) % 5 == 0, TieRole.CHECK, TieRole.CONTROL)
    role[np.linalg.norm(residuals, axis=1) > 3.0] = TieRole.REJECTED
    return Cameras(cameras=tuple(cameras), ties=replace(ties, residual_px=residuals, role=role))


def test_colmap_opens_the_model_and_sees_the_same_residuals(tmp_path: Path) -> None:
    cameras = oriented()
    ties = cameras.ties
    assert ties is not None
    written = write_colmap_model(tmp_path, cameras)
    scene = pycolmap.Reconstruction(str(tmp_path))
    kept = ties.role != TieRole.REJECTED
    assert (written.n_images, written.n_points) == (3, int(kept.sum()))
    assert (scene.num_images(), scene.num_points3D()) == (3, int(kept.sum()))
    assert {image.name for image in scene.images.values()} == set(bs.names()[:3])
    found = []
    for image in scene.images.values():
        at = bs.names().index(image.name)
        np.testing.assert_allclose(
            image.projection_center(), bs.viewers()[at].centre_world, atol=1e-12
        )
        for point in image.points2D:
            pixel = image.project_point(scene.points3D[point.point3D_id].xyz)
            found.append(point.xy - pixel)
    expected = ties.residual_px[kept]
    np.testing.assert_allclose(
        np.sort(np.linalg.norm(found, axis=1)), np.sort(np.linalg.norm(expected, axis=1)), atol=1e-9
    )


def test_photos_of_one_lens_share_a_camera_and_k3_takes_the_fuller_model(tmp_path: Path) -> None:
    cameras = oriented()
    assert write_colmap_model(tmp_path, cameras).n_cameras == 1
    first = cameras.cameras[0]
    assert first.intrinsics is not None
    fuller = replace(first.intrinsics, distortion=(-0.1, 0.02, 0.0, 0.0, 0.01))
    own = replace(cameras, cameras=(replace(first, intrinsics=fuller), *cameras.cameras[1:]))
    assert write_colmap_model(tmp_path, own).n_cameras == 2
    lenses = pycolmap.Reconstruction(str(tmp_path)).cameras
    assert [lenses[number].model_name for number in (1, 2)] == ["FULL_OPENCV", "OPENCV"]


def test_a_place_that_two_photos_see_is_one_point(tmp_path: Path) -> None:
    cameras = oriented()
    ties = cameras.ties
    assert ties is not None
    points = ties.points_world.copy()
    first, second = (
        np.flatnonzero((ties.photo == at) & (ties.role != TieRole.REJECTED))[0] for at in (0, 1)
    )
    points[second] = points[first]
    joined = replace(cameras, ties=replace(ties, points_world=points))
    written = write_colmap_model(tmp_path, joined)
    assert written.n_points == int((ties.role != TieRole.REJECTED).sum()) - 1
    written = write_colmap_model(tmp_path, replace(cameras, ties=None))
    assert (written.n_cameras, written.n_images, written.n_points) == (1, 3, 0)
    assert pycolmap.Reconstruction(str(tmp_path)).num_images() == 3


def test_what_colmap_cannot_hold_is_refused(tmp_path: Path) -> None:
    camera = oriented().cameras[0]
    assert camera.intrinsics is not None
    skewed = replace(camera.intrinsics, skew=-2.0)
    for one, message in (
        (replace(camera, photo="north wall 1.jpg"), r'such as "north wall 1\.jpg"'),
        (Camera(photo="a.png", status="too few ties"), "no photo is oriented"),
        (replace(camera, intrinsics=skewed), "has a skew of -2.0 px, which no COLMAP camera model"),
    ):
        with pytest.raises(ArgumentError, match=message):
            write_colmap_model(tmp_path, Cameras(cameras=(one,)))
