"""What a run publishes: GeoTIFF, JSON beside it, tables; and what other programs read there."""

from __future__ import annotations

import base64
import json
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
from syrupy.assertion import SnapshotAssertion

from orthoflow.errors import InputError, StoreError
from orthoflow.files import geotiff, images, publishing
from orthoflow.files.calibration import read_calibration
from orthoflow.geometry import WallFrame
from orthoflow.products import (
    Camera,
    Cameras,
    Intrinsics,
    Layers,
    Orthoimages,
    Planes,
    Surfaces,
    TieRole,
    Ties,
)
from tests import samples

DIGEST = "sha256:" + "ab" * 32


@pytest.fixture
def frame() -> WallFrame:
    return samples.facing_east(0.01, 700, 40, (634512.347, 486215.781, 114.5))


def orthoimage(frame: WallFrame, **known: object) -> Orthoimages:
    rng = np.random.default_rng(5)
    rgb = rng.integers(0, 256, (*frame.shape, 3), dtype=np.uint8)
    mask = rng.integers(0, 5, frame.shape, dtype=np.uint8)
    plain = {"wall": 3, "name": "wall 3", "rgb": rgb, "mask": mask, "sources": ("cloud",)}
    return Orthoimages(images=(samples.orthoimage(frame, **(plain | known)),))


def test_no_traceback_is_printed_for_text_in_a_file_that_is_not_utf_8(
    tmp_path: Path, frame: WallFrame, capfd: pytest.CaptureFixture[str]
) -> None:
    publishing.publish_orthoimages(orthoimage(frame), tmp_path, DIGEST)
    path = tmp_path / "wall_3_ortho.tif"
    content = path.read_bytes()
    assert b"<GDALMetadata>" in content
    # GDAL quotes the name of the element that is not closed, and rasterio stumbles over it.
    path.write_bytes(content.replace(b"<GDALMetadata>", b"<GDALM\xea\x8c\xa09Y>)F", 1))
    with suppress(InputError):
        geotiff.read_raster(path)
    assert capfd.readouterr() == ("", "")


def test_previews_open_where_their_rasters_lie(
    tmp_path: Path, frame: WallFrame, monkeypatch: pytest.MonkeyPatch
) -> None:
    import rasterio

    monkeypatch.setattr(images, "IN_MEMORY_PX", 1000)
    wide = replace(frame, width=3407, height=1203)
    half = np.zeros((*wide.shape, 3), dtype=np.uint8)
    half[:, 3000:] = 200
    half[400:, :, 0] = 250
    shown = np.ones(wide.shape, dtype=np.uint8)
    image = orthoimage(wide, rgb=half, mask=shown)
    publishing.publish_orthoimages(image, tmp_path, DIGEST)
    with (
        rasterio.open(tmp_path / "wall_3_ortho.tif") as raster,
        rasterio.open(tmp_path / "wall_3_ortho.png") as preview,
    ):
        # Less than a square of averaged cells is cut off.
        np.testing.assert_allclose(preview.bounds, raster.bounds, atol=0.03)
        red, green, _, _ = preview.read()
        to_right = preview.xy(0, int(np.argmax(green[5] > 100)), offset="ul")[0]
        downwards = preview.xy(int(np.argmax(red[:, 5] > 125)), 0, offset="ul")[1]
        side_m = preview.res[0]
    assert to_right == pytest.approx(30.0, abs=side_m)
    assert downwards == pytest.approx(-4.0, abs=side_m)


def test_publishing_twice_gives_the_same_bytes(tmp_path: Path, frame: WallFrame) -> None:
    intensity = np.linspace(0, 1, 28000, dtype=np.float32).reshape(frame.shape)
    wall = samples.wall(frame, plane_index=2, name="wall 2", intensity=intensity)
    contents = []
    for name in ("first", "second"):
        folder = tmp_path / name
        folder.mkdir()
        publishing.publish_orthoimages(orthoimage(frame), folder, DIGEST)
        publishing.publish_walls(samples.walls(wall, intensity_source="laser"), folder, DIGEST)
        contents.append({path.name: path.read_bytes() for path in folder.iterdir()})
    assert contents[0] == contents[1]
    assert set(contents[0]) == {
        *(f"wall_3_ortho{suffix}" for suffix in (".tif", ".tfw", ".json", ".png", ".pgw")),
        *(f"wall_3_ortho_mask{suffix}" for suffix in (".tif", ".json")),
        *(f"wall_2_depth{suffix}" for suffix in (".tif", ".json", ".png", ".pgw")),
        *(f"wall_2_intensity{suffix}" for suffix in (".tif", ".json", ".png", ".pgw")),
    }


def test_a_folder_that_cannot_be_written_is_said_in_one_sentence(
    tmp_path: Path, frame: WallFrame
) -> None:
    with pytest.raises(StoreError, match=r"cannot write wall_3_ortho\.tif: .*No such file"):
        publishing.publish_orthoimages(orthoimage(frame), tmp_path / "missing", DIGEST)
    (tmp_path / "text.tif").write_text("no picture")
    with pytest.raises(InputError, match=r"text\.tif cannot be read as a GeoTIFF"):
        geotiff.read_raster(tmp_path / "text.tif")


def test_estimated_lenses_are_published_as_a_calibration_file(tmp_path: Path) -> None:
    lens = Intrinsics(width=30, height=20, fx=25.25, fy=25.5, cx=15.125, cy=10.0)
    lens = replace(lens, distortion=(-0.1, 0.02, 1e-3, -1e-3, 0.0), source="estimated")
    known = replace(lens, source="calibration")
    pose = {
        "rotation_camera_from_world": np.eye(3),
        "translation_camera_from_world": np.array([0.0, 0.0, 5.0]),
    }
    cameras = (
        Camera(photo="a[1].jpg", status="ok", intrinsics=lens, **pose),
        Camera(photo="b.jpg", status="ok", intrinsics=known, **pose),
    )
    publishing.publish_cameras(Cameras(cameras=cameras), tmp_path, DIGEST)
    found = read_calibration(tmp_path / "calibration.yaml")
    assert (found.patterns, found.lenses) == (("a[1].jpg",), (known,))


def test_a_layer_of_a_photo_with_any_name_has_a_file(tmp_path: Path) -> None:
    layer = samples.layer((3, 4), source=f"../../\x1b{300 * 'x'}.jpg")
    publishing.publish_layers(Layers(layers=(layer,)), tmp_path, "sha256:0")
    stem = f"wall_0_layer_0_-{99 * 'x'}"
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"{stem}.json", f"{stem}.tif"]


# Every key, every value and every cell ------------------------------------------------------------


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
    with_planes = Surfaces(surfaces=(), up=UP, planes=product)
    publishing.publish_surfaces(with_planes, tmp_path, DIGEST)
    planes = json_of(tmp_path / "planes.json")["planes"]
    listed = json_of(tmp_path / "surfaces.json")["surfaces"]
    assert listed == [{"chart": "plane", **plane} for plane in planes]
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
