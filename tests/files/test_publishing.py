"""What a run publishes: GeoTIFF, JSON beside it, tables; and what other programs read there."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

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
