"""Photos inside E57 files: their bytes as they are, lens and pose as ASTM E2807 has them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.read.cameras import ReadCameras
from orthoflow_plugins.read.photos import ReadPhotos
from scipy.spatial.transform import Rotation

from orthoflow.errors import InputError
from orthoflow.files.e57_images import E57ImageCount, count_e57_images, read_e57_images
from orthoflow.files.images import encode_jpeg, encode_png
from orthoflow.products import Cameras, Photos
from tests import photo_files, scan_files, scenes
from tests.method_runs import Reader

PICTURE = photo_files.picture(64, 48)
NUMBERS = {
    "imageWidth": 64,
    "imageHeight": 48,
    "focalLength": 0.03,
    "pixelWidth": 5e-4,
    "pixelHeight": 6e-4,
    "principalPointX": 33.5,
    "principalPointY": 22.25,
}
CENTRE = np.array([400_000.25, 5_000_000.5, 112.0])
ROTATION = scenes.random_rotation(np.random.default_rng(3))


def pinhole(**more: Any) -> dict[str, Any]:
    return {
        "kind": "pinhole",
        "content": encode_jpeg(PICTURE),
        "numbers": NUMBERS,
        "rotation": Rotation.from_matrix(ROTATION).as_quat(scalar_first=True),
        "translation": CENTRE,
        **more,
    }


def written(folder: Path, *images: dict[str, Any]) -> Path:
    points = np.random.default_rng(0).uniform(0, 1, (5, 3))
    scan = {"fields": scan_files.cartesian(points)}
    return scan_files.write_e57(folder / "room.e57", [scan], images)


def read(path: Path) -> tuple[Photos, Cameras]:
    photos = Reader(ReadPhotos, path.parent).run((path,), {}).photos
    return photos, Reader(ReadCameras, path.parent).run((path,), {}, photos=photos).cameras


def e57_pixels(points_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """E2807: x right, y up, the camera looks along -z; rows count downwards."""
    x, y, z = points_camera.T
    return np.column_stack([33.5 - x / z * (0.03 / 5e-4), 22.25 + y / z * (0.03 / 6e-4)])


def test_a_pinhole_image_becomes_a_photo_with_lens_and_pose(tmp_path: Path) -> None:
    photos, cameras = read(written(tmp_path, pinhole(name="north wall")))
    (photo,), (camera,) = photos.photos, cameras.cameras
    assert photo.name == camera.photo == "room_000_north_wall.jpg"
    assert photo.encoded == encode_jpeg(PICTURE)
    assert photo.intrinsics is not None
    assert photo.intrinsics == camera.intrinsics
    assert camera.status == "ok"
    points_camera = np.random.default_rng(4).uniform([-1, -1, -5], [1, 1, -3], (20, 3))
    points_world = points_camera @ ROTATION.T + CENTRE
    pixels = camera.viewing().shifted(CENTRE).project(points_world - CENTRE)[:, :2]
    # Of coordinates of 5e6 m a nanometre is left, 1e-8 of a pixel.
    np.testing.assert_allclose(pixels, e57_pixels(points_camera), atol=1e-6)


def test_images_without_a_pose_are_photos_with_the_reason(tmp_path: Path) -> None:
    reference = {"kind": "visualReference", "content": encode_png(PICTURE)}
    unposed = {"kind": "pinhole", "content": encode_jpeg(PICTURE), "numbers": NUMBERS}
    images = read_e57_images(written(tmp_path, reference, unposed, pinhole()))
    assert [image.name for image in images] == ["room_000.png", "room_001.jpg", "room_002.jpg"]
    reasons = [image.camera.reason for image in images]
    assert "only for reference" in reasons[0]
    assert "contains no pose for it" in reasons[1]
    assert reasons[2] == ""
    assert images[0].content == encode_png(PICTURE)
    photos, cameras = read(tmp_path / "room.e57")
    assert len(photos.photos) == 3
    assert [camera.status == "ok" for camera in cameras.cameras] == [False, False, True]
    assert count_e57_images(tmp_path / "room.e57") == E57ImageCount(n_images=3, n_posed=1)


def spherical(width: int = 720, height: int = 360, **more: Any) -> dict[str, Any]:
    return {
        "kind": "spherical",
        "content": encode_png(photo_files.picture(width, height)),
        "name": "pano",
        "numbers": {
            "imageWidth": width,
            "imageHeight": height,
            "pixelWidth": 2 * np.pi / width,
            "pixelHeight": np.pi / height,
        },
        "rotation": Rotation.from_matrix(ROTATION).as_quat(scalar_first=True),
        "translation": CENTRE,
        **more,
    }


def test_a_panorama_becomes_six_photos_at_its_place(tmp_path: Path) -> None:
    photos, cameras = read(written(tmp_path, spherical()))
    faces = ("back", "down", "front", "left", "right", "up")
    assert [photo.name for photo in photos.photos] == [f"room_000_pano_{f}.png" for f in faces]
    # The middles of the faces: E2807 has x to the front of a panorama, y left, z up.
    towards = ([-1, 0, 0], [0, 0, -1], [1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1])
    for camera, direction in zip(cameras.cameras, towards, strict=True):
        assert camera.status == "ok"
        viewing = camera.viewing()
        np.testing.assert_allclose(viewing.centre_world, CENTRE, atol=1e-6)
        ahead = viewing.rotation[2]
        np.testing.assert_allclose(ahead, ROTATION @ direction, atol=1e-9)


def test_what_is_no_photo_is_refused_with_the_reason(tmp_path: Path) -> None:
    half = spherical()
    half["numbers"] = half["numbers"] | {"pixelHeight": 0.5 * np.pi / 360}
    (image,) = read_e57_images(written(tmp_path, half))
    assert "a part of a panorama; only full panoramas" in image.camera.reason
    with pytest.raises(InputError, match=r"room\.e57 contains no photos"):
        read(written(tmp_path))
    for change, message in (
        ({"imageWidth": 65}, "has 64 x 48 pixels, but its file declares 65 x 48"),
        ({"pixelWidth": 0.0}, r"the lens of photo room_000\.jpg is invalid"),
    ):
        with pytest.raises(InputError, match=message):
            read(written(tmp_path, pinhole(numbers=NUMBERS | change)))


def test_names_in_the_file_cannot_lead_out_of_a_folder(tmp_path: Path) -> None:
    (image,) = read_e57_images(written(tmp_path, pinhole(name="../../etc/pass wd\t.jpg")))
    assert image.name == "room_000_etc_pass_wd.jpg"
