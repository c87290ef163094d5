"""What is stored of each product type, how far two products may differ, and what inputs allow."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from syrupy.assertion import SnapshotAssertion

from orthoflow import products
from orthoflow.errors import ProductError
from orthoflow.geometry.scenes import SurfaceRole, TextureKind
from orthoflow.products import Camera, Cameras, PointLabels, Product, product
from tests import samples
from tests.inspect_scenes import points_at
from tests.raster_scenes import cloud_of

TYPES = {
    item.type_name: item
    for item in vars(products).values()
    if isinstance(item, type) and issubclass(item, Product) and hasattr(item, "type_name")
}
NUMBERED = (
    products.SurfaceMask,
    products.LayerMask,
    products.OrthoMask,
    products.TieRole,
    SurfaceRole,
    TextureKind,
)


def test_types_are_stored_and_compared_as_ever(snapshot: SnapshotAssertion) -> None:
    stated = {
        name: {
            "mapped": cls.mapped,
            "embedded": cls.embedded,
            "tolerances": {
                field: f"{limit.limit:g} {limit.unit}" for field, limit in cls.tolerances.items()
            },
        }
        for name, cls in TYPES.items()
    }
    numbers = {kind.__name__: [(item.name, item.value) for item in kind] for kind in NUMBERED}
    assert stated | numbers == snapshot


def test_large_products_are_mapped_whatever_their_type(monkeypatch: pytest.MonkeyPatch) -> None:
    points = points_at(np.zeros((1, 3)))
    n_bytes = sum(array.nbytes for array in points.to_payload().arrays.values())
    for limit, is_mapped in ((n_bytes, False), (n_bytes - 1, True)):
        monkeypatch.setattr(product, "LARGE_BYTES", limit)
        assert points.to_payload().mapped == is_mapped
        assert labels(0, 0, 0, 0).to_payload().mapped


CLOUD = cloud_of(np.zeros((4, 3)))
PLANES = samples.planes(
    normal=np.array([[0.0, 0.0, 1.0]]),
    offset=np.zeros(1),
    corners=np.zeros((1, 4, 3)),
    covariance=np.eye(4)[None],
    n_points=np.array([4]),
    names=("floor 0",),
)
POSE: dict[str, Any] = {
    "rotation_camera_from_world": np.eye(3),
    "translation_camera_from_world": np.zeros(3),
}
CAMERA = Camera(photo="a.jpg", status="ok", covariance=np.eye(6), **POSE)
OTHERS: dict[str, Product] = {"cloud": CLOUD, "planes": PLANES}


def labels(*values: int) -> PointLabels:
    return PointLabels(plane_index=np.array(values, np.int16))


@pytest.mark.parametrize(
    ("values", "named"), [((0, 0, 0, 5), "5"), ((0, -2, 0, 0), "-2"), ((0, 0, 0), "3"), ((), "0")]
)
def test_contradictory_labels_are_refused(values: tuple[int, ...], named: str) -> None:
    labels(-1, 0, 0, -1).check_against(OTHERS)
    with pytest.raises(ProductError, match=rf"labels\.plane_index.*got {named}"):
        labels(*values).check_against(OTHERS)


@pytest.mark.parametrize(
    "changed",
    [
        {"covariance": -np.eye(4)[None]},
        {"covariance": np.full((1, 4, 4), np.nan)},
        {"rms_m": np.array([np.nan])},
        {"rms_m": np.array([-0.1])},
        {"n_points": np.array([5])},
        {"n_points": np.array([-1])},
    ],
)
def test_impossible_planes_are_refused(changed: dict[str, Any]) -> None:
    PLANES.check_against(OTHERS)
    (name,) = changed
    with pytest.raises(ProductError, match=rf"planes\.{name}"):
        replace(PLANES, **changed).check_against(OTHERS)


@pytest.mark.parametrize(
    ("rule", "changed"),
    [
        ("covariance", {"covariance": -np.eye(7)}),
        ("zero_world", {"zero_world": np.array([0.0, 0.6, 0.8])}),
        ("along_m", {"along_m": (2.0, 1.0)}),
        ("arc_rad", {"arc_rad": (-1.0, 6.0)}),
        ("rms_m", {"rms_m": -0.1}),
        ("n_points", {"n_points": 5}),
    ],
)
def test_impossible_surfaces_are_refused(rule: str, changed: dict[str, Any]) -> None:
    surfaces = samples.surfaces()
    surfaces.check_against(OTHERS)
    labels(-1, 0, 1, -1).check_against({"surfaces": surfaces})
    with pytest.raises(ProductError, match=r"labels\.plane_index.*2 surfaces.*got 2"):
        labels(-1, 0, 2, -1).check_against({"surfaces": surfaces})
    with pytest.raises(ProductError, match=r"surfaces\[0\]\.name must end in its index"):
        replace(surfaces, planes=PLANES)
    wrong = replace(surfaces.surfaces[0], **changed)
    with pytest.raises(ProductError, match=rf"surfaces\[0\]\.{rule}"):
        replace(surfaces, surfaces=(wrong, *surfaces.surfaces[1:])).check_against(OTHERS)


def test_a_cloud_without_a_place_is_refused() -> None:
    CLOUD.check_against({})
    for name in ("x", "y", "z", "origin"):
        value = np.array(getattr(CLOUD, name))
        value[1] = np.inf
        with pytest.raises(ProductError, match=rf"cloud\.{name} must be finite"):
            replace(CLOUD, **{name: value}).check_against({})


@pytest.mark.parametrize(
    "changed",
    [
        {"rotation_camera_from_world": -np.eye(3)},
        {"rotation_camera_from_world": 2.0 * np.eye(3)},
        {"rotation_camera_from_world": None},
        {"translation_camera_from_world": np.full(3, np.nan)},
        {"covariance": -np.eye(6)},
        {"covariance": np.full((6, 6), np.nan)},
    ],
)
def test_an_impossible_orientation_is_refused(changed: dict[str, Any]) -> None:
    Cameras(cameras=(CAMERA,)).check_against({})
    with pytest.raises(ProductError, match=r"camera a\.jpg"):
        Cameras(cameras=(replace(CAMERA, **changed),)).check_against({})
    refused = replace(CAMERA, status="too few ties", **changed)
    Cameras(cameras=(refused,)).check_against({})
