"""What a product means by what nobody said: plugins rely on it, and so do older records."""

from __future__ import annotations

from dataclasses import MISSING, fields, is_dataclass
from typing import Any

import pytest

from orthoflow import products
from orthoflow.geometry.cameras import LensFreedom
from orthoflow.geometry.scenes import Viewers

# Numbers and words that stand for what is left out; what is absent is None or empty.
UNSAID: dict[str, dict[str, object]] = {
    "Photo": {"exif_orientation": 1},
    "Intrinsics": {"distortion": (0.0, 0.0, 0.0, 0.0, 0.0), "source": "calibration"},
    "Finding": {"wall": -1},
    "Truth": {"lowest_elevation_deg": -90.0, "highest_elevation_deg": 90.0, "n_spoilt": 0},
    "Payload": {"mapped": False},
}
EMPTY = (None, (), "", MISSING)


def said_of(cls: Any) -> dict[str, object]:
    return {field.name: field.default for field in fields(cls) if field.default not in EMPTY}


@pytest.mark.parametrize("name", UNSAID)
def test_what_is_not_said_means_what_it_always_meant(name: str) -> None:
    assert said_of(getattr(products, name)).items() >= UNSAID[name].items()


def test_no_other_product_has_numbers_of_its_own() -> None:
    numbers = {
        name: {key: value for key, value in said_of(cls).items() if isinstance(value, float | int)}
        for name in dir(products)
        if is_dataclass(cls := getattr(products, name)) and name not in UNSAID
    }
    assert {name: found for name, found in numbers.items() if found} == {
        "Planes": {"tolerance_m": 0.05},
        "Orthoimage": {"n_check_points": 0},
    }


def test_a_lens_is_held_unless_it_is_set_free() -> None:
    assert LensFreedom().names == ()
    assert set(said_of(LensFreedom).values()) == {0.0}


def test_viewers_see_all_round_unless_they_say_less() -> None:
    said = said_of(Viewers)
    assert (said["lowest_elevation_deg"], said["highest_elevation_deg"]) == (-90.0, 90.0)
