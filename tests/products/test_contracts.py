"""What is stored of each product type, how, and how far two of them may differ and be the same.

Tolerances stand here again on purpose: a wider one would let every golden result, replay and
comparison pass that it should stop.
"""

from __future__ import annotations

import numpy as np
import pytest

from orthoflow import products
from orthoflow.products import Product, product

MAPPED = {"cloud", "labels"}
# Named by their digest in a record; `--embed` adds them.
LEFT_OUT = {"cloud", "labels", "photos", "layers", "truth"}
FRAME = {"u_world": "1e-06 1", "v_world": "1e-06 1", "normal_world": "1e-06 1"}
TOLERANCES = {
    "cloud": {
        **dict.fromkeys(("x", "y", "z", "origin"), "1e-06 m"),
        "intensity": "1e-06 1",
        "rgb": "1 grey",
    },
    "photos": {},
    "calibration": {},
    "planes": {
        "normal": "1e-06 1",
        "offset": "1e-05 m",
        "corners": "0.001 m",
        "part_corners": "0.001 m",
        "covariance": "1e-06 1",
        "n_points": "10 1",
        "rms_m": "1e-05 m",
    },
    "labels": {},
    "walls": {
        **FRAME,
        **dict.fromkeys(("depth_m", "sigma_m", "percentiles_m"), "0.0001 m"),
        "intensity": "0.001 1",
        "rgb": "2 grey",
        "origin_world": "0.001 m",
    },
    "ties": {
        "pixels_photo": "0.05 px",
        "points_world": "0.0001 m",
        "residual_px": "0.05 px",
        "sigma_px": "0.05 px",
        "sigma_m": "0.0001 m",
    },
    "cameras": {
        "rotation_camera_from_world": "1e-05 1",
        "translation_camera_from_world": "0.001 m",
        "covariance": "0.0001 1",
        "residual_px": "0.05 px",
    },
    "layers": {"rgb": "2 grey", "quality": "0.001 1", "origin_world": "0.001 m"},
    "orthoimages": {"rgb": "2 grey", "error_m": "0.0001 m", "origin_world": "0.001 m"},
    "checkpoints": {},
    "truth": {},
    "openings": dict.fromkeys(("outline_m", "outline_world", "side_sigma_m", "depth_m"), "0.001 m"),
    "inspection": {"points_world": "0.001 m", "displacement_m": "0.0001 m"},
}

TYPES = {
    item.type_name: item
    for item in vars(products).values()
    if isinstance(item, type) and issubclass(item, Product) and hasattr(item, "type_name")
}


def test_every_type_has_its_line_here() -> None:
    assert TYPES.keys() == TOLERANCES.keys()


@pytest.mark.parametrize("name", TOLERANCES)
def test_a_type_is_stored_and_compared_as_ever(name: str) -> None:
    cls = TYPES[name]
    assert cls.mapped == (name in MAPPED)
    assert cls.embedded == (name not in LEFT_OUT)
    stated = {field: f"{limit.limit:g} {limit.unit}" for field, limit in cls.tolerances.items()}
    assert stated == {
        field: f"{float(text.split()[0]):g} {text.split()[1]}"
        for field, text in TOLERANCES[name].items()
    }


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
        monkeypatch.setattr(product, "_LARGE_BYTES", limit)
        assert points.to_payload().mapped == is_mapped
        assert labels.to_payload().mapped
