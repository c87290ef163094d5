"""Products: payload round trips, validation, refusals."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import re
from enum import IntEnum
from typing import Any, ClassVar

import numpy as np
import pytest

from orthoflow.errors import ProductError
from orthoflow.geometry import WallFrame
from orthoflow.products import (
    Camera,
    Cameras,
    Intrinsics,
    JsonValue,
    Payload,
    Photo,
    Photos,
    Planes,
    PointCloud,
    PointLabels,
    Product,
    ResidualRow,
    ScanRow,
    Spread,
    Thickness,
    TieWall,
    Walls,
)
from tests import samples
from tests.drawing_runs import box_openings, box_planes, box_products


def frame(width: int = 4, height: int = 3) -> WallFrame:
    return samples.facing_south(0.01, width, height, (1.0, 2.0, 3.0))


def cloud(n_points: int = 5) -> PointCloud:
    rng = np.random.default_rng(n_points)
    x, y, z = rng.normal(size=(3, n_points)).astype(np.float32)
    return PointCloud(
        origin=np.array([634512.0, 486215.0, 112.0]),
        x=x,
        y=y,
        z=z,
        up=np.array([0.0, 0.0, 1.0]),
        rgb=rng.integers(0, 255, (n_points, 3), dtype=np.uint8),
        stations=np.zeros((2, 3)),
        stations_source="file",
        source={"files": ["a.e57"], "dropped": 3},
    )


def walls() -> Walls:
    raster = frame()
    wall = samples.wall(
        raster,
        plane_index=2,
        depth_m=np.full(raster.shape, np.nan, np.float32),
        mask=np.zeros(raster.shape, np.uint8),
    )
    return samples.walls(
        wall,
        dataclasses.replace(wall, name="floor"),
        buffer_front_m=0.15,
        buffer_behind_m=0.2,
        details={"n_void": 3, "shares": [0.5, 0.25]},
    )


def photos() -> Photos:
    lens = Intrinsics(width=30, height=20, fx=25.0, fy=25.5, cx=15.0, cy=10.0)
    return Photos(
        photos=(
            Photo(name="a.jpg", encoded=b"\xff\xd8\x00", width=30, height=20, intrinsics=lens),
            Photo(name="b.jpg", encoded=b"", width=30, height=20, exif_focal_px=1200.5),
        )
    )


def cameras() -> Cameras:
    refused = Camera(photo="b.jpg", status="only 3 ties, 8 are needed")
    return Cameras(
        cameras=(
            Camera(
                photo="a.jpg",
                status="ok",
                rotation_camera_from_world=np.eye(3),
                translation_camera_from_world=np.zeros(3),
            ),
            refused,
        )
    )


def planes() -> Planes:
    spread = Spread(low=0.0, high=1.0, n_points=60, sigma_m=0.001, name="plaster")
    thickness = Thickness(
        sigma_m=0.001, width_95_m=0.004, scan_step_m=0.003, material=(spread, spread)
    )
    row = ScanRow(row=3, scan=0, n_points=50, sigma_m=0.001, material=(spread,))
    known = {"tolerance_m": 0.02, "scan_row": row, "side_from": ("photos",) * 6}
    return dataclasses.replace(box_planes(), thickness=(None, *(thickness,) * 5), **known)


def adjusted() -> Cameras:
    """Cameras with the ties that they kept, and a table of residuals."""
    corners = ((0.0, 0.0, 2.0), (0.0, 0.0, 0.0), (3.0, 0.0, 0.0), (3.0, 0.0, 2.0))
    wall = TieWall(name="w", corners_world=corners, normal_world=(0.0, -1.0, 0.0), gsd_m=0.01)
    names = ("mean", "sd", "median", "nmad", "rmse", "p95", "max", "beyond_own", "beyond_any")
    numbers: dict[str, Any] = dict.fromkeys(names, 0.25)
    row = ResidualRow(photo="a.jpg", role="check", axis="u", unit="px", n=3, **numbers)
    ties = samples.ties(
        np.ones((2, 2)), points_world=np.ones((2, 3)), sigma_px=np.ones(2), sigma_m=np.ones(2)
    )
    return dataclasses.replace(
        cameras(),
        ties=dataclasses.replace(ties, walls=(wall,), search_radius_px=(22.0,)),
        residual_table=(row, dataclasses.replace(row, shift_p=0.5)),
    )


PRODUCTS = [
    cloud(0),
    planes(),
    adjusted(),
    box_openings(),
    cloud(),
    walls(),
    photos(),
    cameras(),
    PointLabels(plane_index=np.array([-1, 3], np.int16)),
]


def assert_equal(first: object, second: object) -> None:
    if isinstance(first, np.ndarray):
        assert isinstance(second, np.ndarray)
        assert first.dtype == second.dtype
        np.testing.assert_array_equal(first, second)
    elif dataclasses.is_dataclass(first):
        assert type(first) is type(second)
        for field in dataclasses.fields(first):
            assert_equal(getattr(first, field.name), getattr(second, field.name))
    elif isinstance(first, tuple):
        assert isinstance(second, tuple)
        assert len(first) == len(second)
        for one, other in zip(first, second, strict=True):
            assert_equal(one, other)
    else:
        assert first == second


def test_a_product_comes_back_from_its_payload() -> None:
    for product in PRODUCTS:
        assert_equal(type(product).from_payload(product.to_payload()), product)


def test_arrays_are_named_by_their_place_and_not_copied() -> None:
    product = walls()
    arrays = product.to_payload().arrays
    assert arrays["walls/1/depth_m"] is product.walls[1].depth_m


def test_the_world_points_of_a_cloud_keep_survey_coordinates() -> None:
    points = cloud()
    expected = points.origin + np.column_stack([points.x, points.y, points.z]).astype(float)
    np.testing.assert_array_equal(points.points_world(), expected)


def test_a_payload_of_another_type_is_refused() -> None:
    with pytest.raises(ProductError, match="expected a planes product, got walls"):
        Planes.from_payload(walls().to_payload())


@pytest.mark.parametrize("version", [0, 2])
def test_a_payload_of_another_encoding_is_refused(version: int) -> None:
    payload = dataclasses.replace(walls().to_payload(), encoding_version=version)
    said = f"encoding version {version}, but this version of orthoflow reads 1"
    with pytest.raises(ProductError, match=said):
        Walls.from_payload(payload)


def test_percentiles_that_do_not_fit_their_rasters_are_refused() -> None:
    percentiles_m = np.zeros((*frame().shape, 2), np.float32)
    wall = dataclasses.replace(walls().walls[0], percentiles_m=percentiles_m)
    with pytest.raises(ProductError, match=r"\(3, 4, 2\), but the walls have 1 percentiles"):
        dataclasses.replace(walls(), walls=(wall,), percentiles=(50.0,))


def test_a_payload_that_lacks_an_array_is_refused() -> None:
    payload = walls().to_payload()
    arrays = {name: array for name, array in payload.arrays.items() if name != "walls/0/mask"}
    with pytest.raises(ProductError, match="lacks the array walls/0/mask"):
        Walls.from_payload(dataclasses.replace(payload, arrays=arrays))


def test_a_payload_that_lacks_a_field_is_refused() -> None:
    version = Walls.encoding_version
    payload = Payload(type_name="walls", encoding_version=version, metadata={}, arrays={})
    with pytest.raises(ProductError, match=r"a stored Walls lacks fields: walls, .*_version"):
        Walls.from_payload(payload)


@pytest.mark.parametrize(
    ("product", "changed", "said"),
    [
        (box_planes(), {"names": "wall 0"}, "the stored names must be tuple, got str"),
        (box_planes(), {"names": [1, 2]}, "the stored names/0 must be str, got int"),
        (box_planes(), {"offset": [1.0]}, "the stored offset must be ndarray, got list"),
        (
            box_planes(),
            {"offset": {"$array": "bytes"}},
            "the stored offset must be ndarray, got bytes",
        ),
        (
            box_planes(),
            {"tolerance_m": True},
            "the stored tolerance_m must be float or int, got bool",
        ),
        (box_planes(), {"tolerance_m": math.inf}, "the stored tolerance_m must be finite, got inf"),
        (box_planes(), {"details": []}, "the stored details must be dict, got list"),
        (
            box_planes(),
            {"thickness": [3]},
            "the stored thickness/0 must be Thickness or NoneType, got",
        ),
        (walls(), {"walls": [{}]}, "a stored Wall lacks fields"),
        (walls(), {"walls": [[]]}, "the stored walls/0 must be Wall, got list"),
    ],
    ids=lambda value: str(value)[:30] if isinstance(value, dict) else "",
)
def test_what_a_field_cannot_hold_is_refused(
    product: Product, changed: dict[str, JsonValue], said: str
) -> None:
    # Whoever seals a record may store anything in it.
    payload = product.to_payload()
    metadata = {**payload.metadata, **changed}
    with pytest.raises(ProductError, match=re.escape(said)):
        type(product).from_payload(dataclasses.replace(payload, metadata=metadata))


def test_arrays_that_do_not_go_with_each_other_are_refused() -> None:
    for product in (*PRODUCTS, *box_products().values()):
        payload = product.to_payload()
        for name in payload.arrays:
            arrays = {**payload.arrays, name: np.zeros((2, 5, 3, 2, 1))}
            # A product, or a sentence: never an error of numpy's.
            with contextlib.suppress(ProductError):
                type(product).from_payload(dataclasses.replace(payload, arrays=arrays))


def test_metadata_that_is_not_finite_is_refused() -> None:
    product = dataclasses.replace(walls(), details={"share": float("nan")})
    with pytest.raises(ProductError, match="details/share must be finite"):
        product.to_payload()


def test_arrays_of_another_length_or_type_are_refused() -> None:
    with pytest.raises(
        ProductError, match=r"depth_m has \(2, 2\) cells, but its frame has \(3, 4\)"
    ):
        dataclasses.replace(walls().walls[0], depth_m=np.zeros((2, 2), np.float32))
    with pytest.raises(ProductError, match="one value per wall, got 1 for 2 walls"):
        dataclasses.replace(walls(), buffers_m=((0.2, 0.4),))
    with pytest.raises(ProductError, match="the cloud has 1 points, but at least 3 are needed"):
        cloud(1).require_points(3)
    with pytest.raises(ProductError, match=r"planes.names must have shape \(6,\), got \(5,\)"):
        dataclasses.replace(box_planes(), names=box_planes().names[:5])
    with pytest.raises(ProductError, match=r"planes.normal must be unit vectors, got lengths"):
        dataclasses.replace(box_planes(), normal=box_planes().normal * (1.0 + 2e-5))
    with pytest.raises(
        ProductError, match="must be empty or have one value per plane, got 1 for 6"
    ):
        dataclasses.replace(box_planes(), thickness=(None,))
    with pytest.raises(
        ProductError, match="side_from must be empty or have one value per plane, got 1 for 6"
    ):
        dataclasses.replace(box_planes(), side_from=("photos",))
    with pytest.raises(ProductError, match=r"planes\.tolerance_m must be positive, got 0"):
        dataclasses.replace(box_planes(), tolerance_m=0.0)
    with pytest.raises(ProductError, match=r"cloud.y must be f4 of shape \(5,\)"):
        dataclasses.replace(cloud(), y=np.zeros(4, np.float32))
    with pytest.raises(ProductError, match=r"cloud\.x must be f4"):
        dataclasses.replace(cloud(), x=np.zeros(5))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_cloud_with_coordinates_that_are_not_finite_is_refused(bad: float) -> None:
    points = cloud()
    y = points.y.copy()
    y[2] = bad
    with pytest.raises(ProductError, match="coordinates in y that are NaN or infinite"):
        dataclasses.replace(points, y=y).require_points(3)


class Mood(IntEnum):
    CALM = 0
    WILD = 4


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tempers(Product):
    type_name: ClassVar[str] = "tempers"

    one: Mood
    all: tuple[Mood, ...] = ()


def test_names_that_stand_for_numbers_come_back_as_names() -> None:
    tempers = Tempers(one=Mood.WILD, all=(Mood.CALM, Mood.WILD))
    payload = tempers.to_payload()
    assert payload.metadata == {"one": 4, "all": [0, 4]}
    read = Tempers.from_payload(payload)
    assert read == tempers
    assert isinstance(read.one, Mood)
    assert all(isinstance(mood, Mood) for mood in read.all)
    stored = dataclasses.replace(payload, metadata={"one": 3})
    with pytest.raises(ProductError, match="the stored one must be a Mood, got 3"):
        Tempers.from_payload(stored)
