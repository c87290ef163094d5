"""`read.cameras` and `orient.given`: poses of another program, taken, checked or corrected."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.orient.given import OrientGiven
from orthoflow_plugins.read.cameras import ReadCameras

from orthoflow.errors import InputError, MethodError
from orthoflow.files.colmap import write_colmap_model
from orthoflow.files.publishing import publish_cameras
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.products import Camera, Cameras, InputFiles, Intrinsics, Photo, Photos, Ties
from orthoflow.testing import photographed as ms
from tests import samples
from tests.plugins.orient.test_by_hand import CAMERA, SCENE, clicked, error_share
from tests.tied_photos import context, photo

WALLS = ms.walls_of(SCENE)
PHOTO = photo()
PHOTOS = ms.photos(PHOTO)


def oriented(camera: ViewingCamera = CAMERA, *, name: str = "a.png") -> Cameras:
    return ms.cameras(ms.oriented(camera, name=name))


def read(folder: Path, photos: Photos = PHOTOS, **params: object) -> tuple[Cameras, list[str]]:
    ctx = context(folder)
    files = InputFiles(name="cameras", paths=tuple(sorted((folder / "given").iterdir())))
    inputs = ReadCameras.In(files=files, photos=photos)
    found = ReadCameras().run(inputs, ReadCameras.Params.model_validate(params), ctx).cameras
    return found, list(ctx.warnings)


def given(
    folder: Path, cameras: Cameras, ties: Ties | None = None, **params: object
) -> tuple[Cameras, list[str]]:
    ctx = context(folder)
    inputs = OrientGiven.In(cameras=cameras, photos=PHOTOS, walls=WALLS, ties=ties)
    found = OrientGiven().run(inputs, OrientGiven.Params.model_validate(params), ctx).cameras
    return found, list(ctx.warnings)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "given").mkdir()
    return tmp_path


@pytest.mark.parametrize(
    ("camera", "name", "photo", "reason"),
    [
        (
            replace(CAMERA, translation=np.array([0.0, 1e9, 0.0])),
            "a.png",
            PHOTO,
            r"from the origin",
        ),
        (CAMERA, "a.png", replace(PHOTO, width=450, height=320), r"a\.png has 450 x 320 pixels"),
        (CAMERA, "other.png", PHOTO, r"orients none of the 1 photos, such as a\.png"),
    ],
    ids=["nowhere on earth", "another size", "another photo"],
)
def test_cameras_that_cannot_be_those_of_the_photos_are_refused(
    folder: Path, camera: ViewingCamera, name: str, photo: Photo, reason: str
) -> None:
    write_colmap_model(folder / "given", oriented(camera, name=name))
    with pytest.raises(InputError, match=reason):
        read(folder, ms.photos(photo))


def test_given_poses_are_taken_as_they_are(tmp_path: Path) -> None:
    cameras, warnings = given(tmp_path, oriented())
    (found,) = cameras.cameras
    assert found.status == "ok"
    assert found.sigma_wall_m is None
    np.testing.assert_array_equal(found.rotation_camera_from_world, CAMERA.rotation)
    assert not warnings
    assert cameras.ties is None
    assert cameras.details["given"] == ["a.png"]


@pytest.mark.parametrize("where", ["elsewhere", "behind"])
def test_poses_that_show_no_wall_are_refused(tmp_path: Path, where: str) -> None:
    away = {
        "elsewhere": replace(CAMERA, translation=CAMERA.translation + np.array([500.0, 0, 0])),
        "behind": ms.camera_before(SCENE, centre=(1.3, 2.6, 1.1)),
    }[where]
    with pytest.raises(
        MethodError, match=r"none of the 1 given poses shows a wall: the cameras are"
    ):
        given(tmp_path, oriented(away))


OFF = ms.nudged(CAMERA, (0.02, -0.02, 0.01, 0.1, -0.05, 0.1))


def test_six_ties_by_hand_correct_a_given_pose_and_fewer_check_it(tmp_path: Path) -> None:
    assert ms.wall_error_m(SCENE, OFF, CAMERA) > 0.05
    cameras, _ = given(tmp_path, oriented(OFF), clicked(4))
    (found,) = cameras.cameras
    assert found.status == "ok"
    assert error_share(found) < 3.0
    assert found.intrinsics == Intrinsics.of(CAMERA)
    assert cameras.details["given"] == []
    three = samples.taken(clicked(4), slice(3))
    for camera, n_off in ((CAMERA, 0), (OFF, 3)):
        cameras, warnings = given(tmp_path, oriented(camera), three)
        assert cameras.cameras[0].status == "ok"
        assert len(warnings) == (n_off > 0)
    assert "3 of its 3 ties measured by hand disagree with the given pose, by up to" in warnings[0]


def test_ties_by_hand_orient_a_photo_without_a_pose(tmp_path: Path) -> None:
    lost = Cameras(cameras=(Camera(photo="a.png", status="Metashape did not align it"),))
    (found,) = given(tmp_path, lost)[0].cameras
    assert found.status == "Metashape did not align it"
    photos = ms.photos(photo(CAMERA))
    inputs = OrientGiven.In(cameras=lost, photos=photos, walls=WALLS, ties=clicked(4))
    (found,) = OrientGiven().run(inputs, OrientGiven.Params(), context(tmp_path)).cameras.cameras
    assert found.status == "ok"
    assert error_share(found) < 3.0


@pytest.mark.parametrize("n_by_hand", [0, 3], ids=["as they are", "checked by hand"])
def test_the_error_that_handed_on_cameras_carry_is_reported(folder: Path, n_by_hand: int) -> None:
    names_mm = {"a.png": 1.25, "b.png": 3.5, "c.png": None, "d.png": 1.5}
    handed_on = Cameras(
        cameras=tuple(
            replace(
                ms.oriented(CAMERA, name=name),
                sigma_wall_m=None if sigma_mm is None else sigma_mm / 1e3,
            )
            for name, sigma_mm in names_mm.items()
        )
    )
    publish_cameras(handed_on, folder / "given", "sha256:0")
    photos = ms.photos(*(replace(PHOTO, name=name) for name in names_mm))
    files = InputFiles(name="cameras", paths=tuple(sorted((folder / "given").iterdir())))
    first, second = context(folder), context(folder)
    cameras = ReadCameras().run(
        ReadCameras.In(files=files, photos=photos), ReadCameras.Params(), first
    )
    ties = samples.taken(clicked(4), slice(n_by_hand)) if n_by_hand else None
    inputs = OrientGiven.In(cameras=cameras.cameras, photos=photos, walls=WALLS, ties=ties)
    OrientGiven().run(inputs, OrientGiven.Params(), second)
    for ctx in (first, second):
        found = {one.name: one.value for one in ctx.metrics if one.name.startswith("sigma_wall")}
        assert found == pytest.approx({"sigma_wall_mm_median": 1.5, "sigma_wall_mm_worst": 3.5})
