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

from orthoflow.files import geotiff, publishing
from orthoflow.files.geotiff import local_crs_name
from orthoflow.products import (
    Camera,
    Cameras,
    Intrinsics,
    Orthoimage,
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
PLACED: dict[str, Any] = {
    "origin_world": [10.0, 20.0, 30.0],
    "u_world": [0.0, 1.0, 0.0],
    "v_world": [0.0, 0.0, -1.0],
    "normal_world": [1.0, 0.0, 0.0],
    "gsd_m": 0.5,
    "width": 3,
    "height": 2,
    "plane": {"normal": [1.0, 0.0, 0.0], "offset_m": 10.0},
    "corners_world": [
        [10.0, 20.0, 30.0],
        [10.0, 20.0, 29.0],
        [10.0, 21.5, 29.0],
        [10.0, 21.5, 30.0],
    ],
    "raster": {
        "world_from_raster": "origin_world + gsd_m * (column * u_world + row * v_world) + "
        "depth_m * normal_world; v_world points down, cell centres lie at .5",
        "geotiff": "X = x_of_left_m + gsd_m * column (metres along the wall from its left edge), "
        "Y = height_of_top_m - gsd_m * row (height along up_world); pixel is area",
    },
    "up_world": [0.0, 0.0, 1.0],
    "x_of_left_m": 0.0,
    "height_of_top_m": 30.0,
    "crs": local_crs_name(FRAME.crs),
}
TAGS = {
    "AREA_OR_POINT": "Area",
    "frame": '{"height_of_top_m": 30.0, "normal_world": [1.0, 0.0, 0.0], "origin_world": '
    '[10.0, 20.0, 30.0], "u_world": [0.0, 1.0, 0.0], "up_world": [0.0, 0.0, 1.0], "v_world": '
    '[0.0, 0.0, -1.0], "x_of_left_m": 0.0}',
    "gsd_m": "0.5",
    "plane": '{"normal": [1.0, 0.0, 0.0], "offset_m": 10.0}',
    "product_digest": DIGEST,
    "software": "orthoflow",
}
# One pixel is a cell: its size, and the centre of the first one.
WORLD_FILE = "0.5\n0.0\n0.0\n-0.5\n0.25\n29.75\n"


def json_of(path: Path) -> Any:
    return json.loads(path.read_text())


def picture(path: Path) -> Any:
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def names_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_planes_are_told_completely(tmp_path: Path) -> None:
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
    told = json_of(tmp_path / "planes.json")
    first, second = told.pop("planes")
    assert told == {"up": [0.0, 0.0, 1.0], "product_digest": DIGEST}
    # In the middle of the corners, (3, 2, 1): 4 mm^2 times 2^2, 1 times 1^2, and 9.
    assert first.pop("sigma_offset_mm") == pytest.approx(np.sqrt(26.0), rel=1e-12)
    assert first.pop("sigma_angle_deg") == pytest.approx(np.degrees(2e-3), rel=1e-12)
    assert first == {
        "normal": [1.0, 0.0, 0.0],
        "offset_m": 3.0,
        "corners_world": corners[0].tolist(),
        "n_points": 1234,
        "rms_mm": 2.5,
        "label": "north",
        "omega_deg": 0.0,
        "phi_deg": 0.0,
        "viewpoint": "parameter",
        "side_from": "guess",
        "part_corners_world": [corners[0].tolist(), (corners[0] + 1.0).tolist()],
    }
    assert second["rms_mm"] is None
    assert second["part_corners_world"] == [corners[1].tolist()]
    assert second["label"] == "floor"
    without = replace(product, part_corners=None, part_plane=None)
    publishing.publish_planes(without, tmp_path, DIGEST)
    plain = json_of(tmp_path / "planes.json")["planes"]
    assert ["part_corners_world" in plane for plane in plain] == [False, False]


MASK = np.array([[0, 1, 2], [3, 4, 1]], np.uint8)
RGB = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)


@pytest.mark.parametrize(
    ("profile", "colours"),
    [(None, "sRGB"), (bytes(range(200)), "ICC profile of the photos")],
    ids=["srgb", "profile"],
)
def test_orthoimages_are_told_completely(
    tmp_path: Path, profile: bytes | None, colours: str
) -> None:
    image = Orthoimage(
        frame=FRAME,
        wall=7,
        name="north",
        rgb=RGB,
        mask=MASK,
        source=np.zeros((2, 3), np.int16),
        sources=("a.jpg", "b.jpg"),
    )
    publishing.publish_orthoimages(
        Orthoimages(images=(image,), icc_profile=profile), tmp_path, DIGEST
    )
    suffixes = (".tif", ".tfw", ".json", ".png", ".pgw", "_mask.tif", "_mask.json")
    assert names_in(tmp_path) == {f"wall_7_ortho{suffix}" for suffix in suffixes}
    told: dict[str, Any] = {
        **PLACED,
        "wall": 7,
        "name": "north",
        "sources": ["a.jpg", "b.jpg"],
        "bits": 8,
        "mask": {
            "0": "none: no source covers this cell",
            "1": "painted: a source shows this cell",
            "2": "filled: inpainted from neighbouring cells",
            "3": "occluded: hidden in every source",
            "4": "no surface: the scan has no surface here",
            "5": "contradicted: painted by one photo alone, and the scan has another colour here",
        },
        "mask_counts": {"0": 1, "1": 2, "2": 1, "3": 1, "4": 1},
        "dataset_mask": "255 where the mask is painted (1, 5) or filled (2), else 0",
        "mask_raster": "wall_7_ortho_mask.tif",
        "accuracy": {
            "expected_mm_median": None,
            "expected_mm_p95": None,
            "n_check_points": 0,
            "assessed": False,
        },
        "product_digest": DIGEST,
    }
    content = f"orthoimage, {colours}"
    assert json_of(tmp_path / "wall_7_ortho.json") == {**told, "content": content}
    of_mask = "mask of the orthoimage"
    assert json_of(tmp_path / "wall_7_ortho_mask.json") == {**told, "content": of_mask}
    shown = np.isin(MASK, (1, 2))
    read = geotiff.read_raster(tmp_path / "wall_7_ortho.tif")
    np.testing.assert_array_equal(read.values, RGB)
    np.testing.assert_array_equal(read.shown, shown)
    tags = {**TAGS, "name": "north"}
    assert {key: read.tags[key] for key in [*tags, "content"]} == {**tags, "content": content}
    if profile is not None:
        with rasterio.open(tmp_path / "wall_7_ortho.tif") as dataset:
            kept = dataset.tags(ns="COLOR_PROFILE")["SOURCE_ICC_PROFILE"]
        assert base64.b64decode(kept) == profile
    mask = geotiff.read_raster(tmp_path / "wall_7_ortho_mask.tif")
    np.testing.assert_array_equal(mask.values, MASK)
    assert mask.tags == {**tags, "content": of_mask}
    for suffix in (".tfw", ".pgw"):
        assert (tmp_path / f"wall_7_ortho{suffix}").read_text() == WORLD_FILE
    preview = picture(tmp_path / "wall_7_ortho.png")
    np.testing.assert_array_equal(preview[:, :, 2::-1], RGB)
    np.testing.assert_array_equal(preview[:, :, 3], 255 * shown)


POSE: dict[str, Any] = {
    "rotation_camera_from_world": np.array([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]]),
    "translation_camera_from_world": np.array([1.0, 2.0, 3.0]),
}


def test_cameras_and_ties_are_told_completely(tmp_path: Path) -> None:
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
    inner = {
        "K": [[25.0, 0.0, 14.5], [0.0, 26.0, 9.5], [0.0, 0.0, 1.0]],
        "distortion": [0.1, 0.2, 0.3, 0.4, 0.5],
        "width": 30,
        "height": 20,
    }
    pose = {
        "R_camera_from_world": [[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]],
        "t_camera_from_world": [1.0, 2.0, 3.0],
    }
    assert json_of(tmp_path / "cameras.json") == {
        "pixel_convention": "OpenCV: the centre of the first (top-left) pixel is at (0, 0)",
        "camera_axes": "x right, y down, z forward; X_camera = R X_world + t, metres",
        "errors": "one standard deviation; sigma_wall_mm: that the orientation is expected to "
        "cause on the wall; sigma0_px: of a pixel coordinate of a control tie, as stated, "
        "times the sigma of unit weight",
        "cameras": {
            "b.jpg": {"status": "ok", **inner, **pose, "sigma0_px": 0.5},
            "a.jpg": {"status": "ok", **inner, **pose, "sigma_wall_mm": 250.0},
            "c.jpg": {"status": "too few ties", **inner, "sigma0_px": None},
        },
        "product_digest": DIGEST,
    }
    assert (tmp_path / "ties.csv").read_text() == (
        '"photo","wall","u_px","v_px","x","y","z","role","residual_u_px","residual_v_px",'
        '"sigma_px","opencv_pixel_convention"\n'
        '"a, b.jpg",0,0.0,0.0,634512.347,1.0,2.0,"control",0.25,-0.125,0.5,'
        '"first pixel centre at 0 0"\n'
        '"b.jpg",2,99.75,6.625,0.1,0.2,0.3,"rejected",,,1.0,"first pixel centre at 0 0"\n'
        '"b.jpg",1,0.5,1.5,7.0,8.0,9.0,"check",,1.0,,"first pixel centre at 0 0"\n'
    )


# --- previews ---
