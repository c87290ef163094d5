"""Published files of the smallest products: every key, every value and every cell."""

from __future__ import annotations

import base64
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
from syrupy.assertion import SnapshotAssertion

from orthoflow.files import geotiff, publishing
from orthoflow.products import (
    Camera,
    Cameras,
    Intrinsics,
    Orthoimages,
    Planes,
    TieRole,
    Ties,
)
from tests import samples

DIGEST = "sha256:" + "ab" * 32
UP = np.array([0.0, 0.0, 1.0])
FRAME = replace(
    samples.facing_east(0.5, 3, 2, (10.0, 20.0, 30.0)), up=(0.0, 0.0, 1.0), name="north"
)
# One pixel is a cell: its size, and the centre of the first one.
WORLD_FILE = "0.5\n0.0\n0.0\n-0.5\n0.25\n29.75\n"


def json_of(path: Path) -> Any:
    return json.loads(path.read_text())


def names_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_planes_are_told_completely(tmp_path: Path, snapshot: SnapshotAssertion) -> None:
    corners = np.array([[[3.0, 0, 2], [3.0, 0, 0], [3.0, 4, 0], [3.0, 4, 2]]] * 2)
    corners[1] = [[0.0, 4, 0], [0.0, 0, 0], [2.0, 0, 0], [2.0, 4, 0]]
    covariance = np.zeros((2, 4, 4))
    covariance[0] = np.diag([0.0, 4e-6, 1e-6, 9e-6])
    product = Planes(
        normal=np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
        offset=np.array([3.0, 0.0]),
        corners=corners,
        covariance=covariance,
        n_points=np.array([1234, 12], np.int64),
        rms_m=np.array([0.0025, np.nan]),
        up=UP,
        names=("north", "floor"),
        viewpoint="parameter",
        part_corners=np.concatenate([corners, corners[:1] + 1.0]),
        part_plane=np.array([0, 1, 0], np.int32),
    )
    publishing.publish_planes(product, tmp_path, DIGEST)
    document = json_of(tmp_path / "planes.json")
    # In the middle of the corners, (3, 2, 1): 4 mm^2 times 2^2, 1 times 1^2, and 9.
    first = document["planes"][0]
    assert first.pop("sigma_offset_mm") == pytest.approx(np.sqrt(26.0), rel=1e-12)
    assert first.pop("sigma_angle_deg") == pytest.approx(np.degrees(2e-3), rel=1e-12)
    assert document == snapshot
    without = replace(product, part_corners=None, part_plane=None)
    publishing.publish_planes(without, tmp_path, DIGEST)
    assert "part_corners_world" not in (tmp_path / "planes.json").read_text()


def test_surfaces_are_published_completely(tmp_path: Path, snapshot: SnapshotAssertion) -> None:
    publishing.publish_surfaces(samples.surfaces(), tmp_path, DIGEST)
    assert json_of(tmp_path / "surfaces.json") == snapshot


MASK = np.array([[0, 1, 2], [3, 4, 1]], np.uint8)
RGB = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)


@pytest.mark.parametrize(
    ("profile", "colours"),
    [(None, "sRGB"), (bytes(range(200)), "ICC profile of the photos")],
    ids=["srgb", "profile"],
)
def test_orthoimages_are_told_completely(
    tmp_path: Path, profile: bytes | None, colours: str, snapshot: SnapshotAssertion
) -> None:
    image = samples.orthoimage(
        FRAME, wall=7, name="north", rgb=RGB, mask=MASK, sources=("a.jpg", "b.jpg")
    )
    publishing.publish_orthoimages(
        Orthoimages(images=(image,), icc_profile=profile), tmp_path, DIGEST
    )
    suffixes = (".tif", ".tfw", ".json", ".png", ".pgw", "_mask.tif", "_mask.json")
    assert names_in(tmp_path) == {f"wall_7_ortho{suffix}" for suffix in suffixes}
    of_image, of_mask = (json_of(tmp_path / f"wall_7_ortho{part}.json") for part in ("", "_mask"))
    assert of_image == snapshot(name="sidecar")
    assert of_image.pop("content") == f"orthoimage, {colours}"
    assert of_mask.pop("content") == "mask of the orthoimage"
    assert of_image == of_mask
    shown = np.isin(MASK, (1, 2))
    read = geotiff.read_raster(tmp_path / "wall_7_ortho.tif")
    np.testing.assert_array_equal(read.values, RGB)
    np.testing.assert_array_equal(read.shown, shown)
    if profile is not None:
        with rasterio.open(tmp_path / "wall_7_ortho.tif") as dataset:
            kept = dataset.tags(ns="COLOR_PROFILE")["SOURCE_ICC_PROFILE"]
        assert base64.b64decode(kept) == profile
    mask = geotiff.read_raster(tmp_path / "wall_7_ortho_mask.tif")
    np.testing.assert_array_equal(mask.values, MASK)
    assert mask.tags == snapshot(name="tags of the mask")
    assert {key: read.tags[key] for key in mask.tags} == {
        **mask.tags,
        "content": f"orthoimage, {colours}",
    }
    for suffix in (".tfw", ".pgw"):
        assert (tmp_path / f"wall_7_ortho{suffix}").read_text() == WORLD_FILE
    preview: Any = cv2.imread(str(tmp_path / "wall_7_ortho.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(preview[:, :, 2::-1], RGB)
    np.testing.assert_array_equal(preview[:, :, 3], 255 * shown)


POSE: dict[str, Any] = {
    "rotation_camera_from_world": np.array([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]]),
    "translation_camera_from_world": np.array([1.0, 2.0, 3.0]),
}


def test_cameras_and_ties_are_told_completely(tmp_path: Path, snapshot: SnapshotAssertion) -> None:
    lens = replace(
        Intrinsics(width=30, height=20, fx=25.0, fy=26.0, cx=15.0, cy=10.0),
        distortion=(0.1, 0.2, 0.3, 0.4, 0.5),
    )
    cameras = (
        Camera(photo="b.jpg", status="ok", intrinsics=lens, sigma0_px=0.5, **POSE),
        Camera(photo="a.jpg", status="ok", intrinsics=lens, sigma_wall_m=0.25, **POSE),
        Camera(photo="c.jpg", status="too few ties", intrinsics=lens, sigma0_px=np.nan),
    )
    ties = Ties(
        photo_names=("b.jpg", "a, b.jpg"),
        photo=np.array([1, 0, 0], np.int32),
        wall=np.array([0, 2, 1], np.int32),
        pixels_photo=np.array([[0.5, 0.5], [100.25, 7.125], [1.0, 2.0]]),
        points_world=np.array([[634512.347, 1.0, 2.0], [0.1, 0.2, 0.3], [7.0, 8.0, 9.0]]),
        sigma_px=np.array([0.5, 1.0, np.nan]),
        sigma_m=np.array([0.001, 0.002, 0.003]),
        role=np.array([TieRole.CONTROL, TieRole.REJECTED, TieRole.CHECK], np.uint8),
        residual_px=np.array([[0.25, -0.125], [np.nan, np.nan], [np.inf, 1.0]]),
    )
    publishing.publish_cameras(Cameras(cameras=cameras, ties=ties), tmp_path, DIGEST)
    assert names_in(tmp_path) == {"cameras.json", "ties.csv"}
    assert json_of(tmp_path / "cameras.json") == snapshot(name="cameras")
    # OpenCV's first pixel centre is at (0, 0), ours at (0.5, 0.5).
    assert (tmp_path / "ties.csv").read_text() == snapshot(name="ties")
