"""Products: payload round trips, validation, refusals."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import re
from enum import IntEnum
from functools import cache
from typing import Any, ClassVar

import numpy as np
import pytest

from orthoflow.errors import ProductError
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
    Product,
    ResidualRow,
    ScanRow,
    Spread,
    Thickness,
    Walls,
)
from orthoflow.testing.photographed import PHOTOGRAPHED
from orthoflow.testing.surveyed import SURVEYED
from tests import samples
from tests.drawing_runs import box_planes, box_products


def cameras() -> Cameras:
    """Cameras with the ties that they kept, and a table of residuals."""
    corners = samples.facing_south(0.01, 300, 200).corners_world()
    wall = dataclasses.replace(samples.tie_wall(corners, 0.01), name="w")
    names = ("mean", "sd", "median", "nmad", "rmse", "p95", "max", "beyond_own", "beyond_any")
    numbers: dict[str, Any] = dict.fromkeys(names, 0.25)
    row = ResidualRow(photo="a.jpg", role="check", axis="u", unit="px", n=3, **numbers)
    ties = samples.ties(
        np.ones((2, 2)), points_world=np.ones((2, 3)), sigma_px=np.ones(2), sigma_m=np.ones(2)
    )
    pose = {
        "rotation_camera_from_world": np.eye(3),
        "translation_camera_from_world": np.zeros(3),
    }
    refused = Camera(photo="b.jpg", status="only 3 ties, 8 are needed")
    return Cameras(
        cameras=(Camera(photo="a.jpg", status="ok", **pose), refused),
        ties=dataclasses.replace(ties, walls=(wall,), search_radius_px=(22.0,)),
        residual_table=(row, dataclasses.replace(row, shift_p=0.5)),
    )


def planes() -> Planes:
    spread = Spread(low=0.0, high=1.0, n_points=60, sigma_m=0.001, name="plaster")
    thickness = Thickness(
        sigma_m=0.001, width_95_m=0.004, scan_step_m=0.003, range_m=(spread,), material=(spread,)
    )
    row = ScanRow(row=3, scan=0, n_points=50, sigma_m=0.001, material=(spread,))
    known = {"tolerance_m": 0.02, "scan_row": row, "side_from": ("photos",) * 6}
    return dataclasses.replace(box_planes(), thickness=(None, *(thickness,) * 5), **known)


def photos() -> Photos:
    lens = Intrinsics(width=30, height=20, fx=25.0, fy=25.5, cx=15.0, cy=10.0)
    size = {"width": 30, "height": 20}
    one = Photo(name="a.jpg", encoded=b"\xff\xd8\x00", intrinsics=lens, **size)
    return Photos(photos=(one, Photo(name="b.jpg", encoded=b"", exif_focal_px=1200.5, **size)))


def walls() -> Walls:
    raster = samples.wall(samples.facing_south(0.01, 4, 3))
    return samples.walls(raster, details={"n_void": 3, "shares": [0.5, 0.25]})


@cache
def products() -> tuple[Product, ...]:
    examples = [SURVEYED[name]() for name in ("cloud", "labels")]
    examples += [PHOTOGRAPHED[name]() for name in ("walls", "layers")]
    simple = (planes(), cameras(), photos(), walls(), samples.surfaces())
    return *simple, *examples, *box_products().values()


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
    for product in products():
        assert_equal(type(product).from_payload(product.to_payload()), product)


def test_arrays_are_named_by_their_place_and_not_copied() -> None:
    product = walls()
    assert product.to_payload().arrays["walls/0/depth_m"] is product.walls[0].depth_m


def without(payload: Payload, array: str) -> Payload:
    arrays = {name: values for name, values in payload.arrays.items() if name != array}
    return dataclasses.replace(payload, arrays=arrays)


def test_payloads_of_another_type_or_encoding_and_incomplete_ones_are_refused() -> None:
    payload = walls().to_payload()
    with pytest.raises(ProductError, match="expected a planes product, got walls"):
        Planes.from_payload(payload)
    for changed, said in (
        ({"encoding_version": 0}, "encoding version 0, but this version of orthoflow reads 1"),
        ({"encoding_version": 2}, "encoding version 2, but this version of orthoflow reads 1"),
        ({"metadata": {}}, r"a stored Walls lacks fields: walls, .*_version"),
    ):
        with pytest.raises(ProductError, match=said):
            Walls.from_payload(dataclasses.replace(payload, **changed))
    with pytest.raises(ProductError, match="lacks the array walls/0/mask"):
        Walls.from_payload(without(payload, "walls/0/mask"))


@pytest.mark.parametrize(
    ("product", "changed", "said"),
    [
        (box_planes(), {"names": "wall 0"}, "names must be tuple, got str"),
        (box_planes(), {"names": [1, 2]}, "names/0 must be str, got int"),
        (box_planes(), {"offset": [1.0]}, "offset must be ndarray, got list"),
        (box_planes(), {"offset": {"$array": "bytes"}}, "offset must be ndarray, got bytes"),
        (box_planes(), {"tolerance_m": True}, "tolerance_m must be float or int, got bool"),
        (box_planes(), {"tolerance_m": math.inf}, "tolerance_m must be finite, got inf"),
        (box_planes(), {"details": []}, "details must be dict, got list"),
        (box_planes(), {"thickness": [3]}, "thickness/0 must be Thickness or NoneType, got"),
        (walls(), {"walls": [{}]}, "a stored Wall lacks fields"),
        (walls(), {"walls": [[]]}, "walls/0 must be Wall, got list"),
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
    for product in products():
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


THREE = np.zeros(3, np.float32)
CLOUD = PointCloud(origin=np.zeros(3), x=THREE, y=THREE, z=THREE, up=np.zeros(3))


@pytest.mark.parametrize(
    ("product", "changed", "said"),
    [
        (walls().walls[0], {"depth_m": np.zeros((2, 2), np.float32)}, r"depth_m has \(2, 2\) cell"),
        (walls(), {"buffers_m": ((0.2, 0.4),) * 2}, "one value per wall, got 2 for 1 walls"),
        (walls(), {"included": ((),) * 2}, "one entry for each of 1 walls"),
        (box_planes(), {"names": ("a",) * 5}, r"planes.names must have shape \(6,\), got \(5,\)"),
        (box_planes(), {"normal": np.full((6, 3), 0.6)}, "planes.normal must be unit vectors"),
        (box_planes(), {"thickness": (None,)}, "one value per plane, got 1 for 6"),
        (box_planes(), {"side_from": ("photos",)}, "side_from must .* per plane, got 1 for 6"),
        (box_planes(), {"tolerance_m": 0.0}, r"planes\.tolerance_m must be positive, got 0"),
        (CLOUD, {"y": THREE[:2]}, r"cloud.y must be f4 of shape"),
        (CLOUD, {"x": np.zeros(3)}, r"cloud\.x must be f4"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_values_that_do_not_go_with_the_others_are_refused(
    product: Any, changed: dict[str, Any], said: str
) -> None:
    with pytest.raises(ProductError, match=said):
        dataclasses.replace(product, **changed)


def test_percentiles_that_do_not_fit_their_rasters_are_refused() -> None:
    (wall,) = walls().walls
    wall = dataclasses.replace(wall, percentiles_m=np.zeros((*wall.frame.shape, 2), np.float32))
    with pytest.raises(ProductError, match="2\\), but the walls have 1 percentiles"):
        dataclasses.replace(walls(), walls=(wall,), percentiles=(50.0,))


def test_a_cloud_with_few_points_or_coordinates_that_are_not_finite_is_refused() -> None:
    CLOUD.require_points(3)
    with pytest.raises(
        ProductError, match="the cloud has too few points: 3; at least 4 are needed"
    ):
        CLOUD.require_points(4)
    for bad in (np.nan, np.inf, -np.inf):
        y = np.array([0.0, 0.0, bad], dtype=np.float32)
        with pytest.raises(ProductError, match=r"cloud\.y contains NaN or infinite coordinates"):
            dataclasses.replace(CLOUD, y=y).require_points(3)


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
