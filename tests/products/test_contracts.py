"""What is stored of each product type, how, and how far two of them may differ and be the same.

Reviewed in a snapshot: a wider tolerance would let every golden result, replay and comparison pass
that it should stop, and numbers that stand for names are in files.
"""

from __future__ import annotations

import numpy as np
import pytest
from syrupy.assertion import SnapshotAssertion

from orthoflow import products
from orthoflow.geometry.scenes import SurfaceRole, TextureKind
from orthoflow.products import Product, product

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
    labels = products.PointLabels(plane_index=np.zeros(4, np.int16))
    points = products.CheckPoints(
        names=("a",),
        points_world=np.zeros((1, 3)),
        classes=("",),
        wall=np.zeros(1, np.int32),
        pixels_wall=np.zeros((1, 2)),
    )
    n_bytes = sum(array.nbytes for array in points.to_payload().arrays.values())
    for limit, is_mapped in ((n_bytes, False), (n_bytes - 1, True)):
        monkeypatch.setattr(product, "LARGE_BYTES", limit)
        assert points.to_payload().mapped == is_mapped
        assert labels.to_payload().mapped
