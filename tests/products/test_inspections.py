"""Truths of simulated scenes as older versions stored them."""

from __future__ import annotations

import numpy as np
import pytest

from orthoflow.errors import ProductError
from orthoflow.products import CheckPoints, JsonValue, Payload, TakenPhoto, Truth, inspections

ARRAYS = {
    "scene/origin": np.zeros(3),
    "scene/centre": np.array([[0.0, 2.0, 0.0]]),
    "scene/axis_a": np.array([[1.0, 0.0, 0.0]]),
    "scene/axis_b": np.array([[0.0, 0.0, 1.0]]),
    "scene/extent": np.array([[-1.0, 1.0, -1.0, 1.0]]),
    "scene/plane_index": np.array([0], dtype=np.int16),
    "scene/role": np.array([0], dtype=np.uint8),
    "scene/texture": np.array([0], dtype=np.int32),
    "scene/texture_params": np.ones((1, 8)),
    "scene/hole_rectangle": np.zeros(0, dtype=np.int32),
    "scene/hole_extent": np.zeros((0, 4)),
    "planes/normal": np.array([[0.0, -1.0, 0.0]]),
    "planes/offset": np.array([-2.0]),
    "planes/corners": np.array([[[-1.0, 2, 1], [-1, 2, -1], [1, 2, -1], [1, 2, 1]]]),
    "planes/covariance": np.zeros((1, 4, 4)),
    "planes/n_points": np.array([3]),
    "planes/rms_m": np.zeros(1),
    "planes/up": np.array([0.0, 0.0, 1.0]),
    "labels": np.array([0, 0, 0, -1], dtype=np.int16),
    "stations": np.zeros((2, 3)),
}


def truth_of_encoding_1(details: dict[str, JsonValue]) -> Payload:
    """A truth as version 1 had it: what others read stood in `details`."""
    metadata: dict[str, JsonValue] = {
        "scene": {},
        "planes": {"names": ["main wall"], "viewpoint": "stations", "details": {"true": True}},
        "details": details,
    }
    for name in ARRAYS:
        group, _, field = name.rpartition("/")
        place = metadata[group] if group else metadata
        assert isinstance(place, dict)
        place[field] = {"$array": "numeric"}
    return Payload(type_name="truth", encoding_version=1, metadata=metadata, arrays=ARRAYS)


def test_a_truth_of_encoding_1_has_the_fields_of_today() -> None:
    photo: dict[str, JsonValue] = {
        "name": "photo_00.jpg",
        "wall": "main wall",
        "gsd_mm": 4.0,
        "obliquity_deg": 12.5,
        "roll_deg": -1.5,
    }
    truth = Truth.from_payload(
        truth_of_encoding_1(
            {
                "parameters": {"scan_step_m": 0.1},
                "lowest_elevation_deg": -62.0,
                "highest_elevation_deg": 60.5,
                "n_points": 4,
                "n_spoilt": 1,
                "photos": [photo],
            }
        )
    )
    assert (truth.lowest_elevation_deg, truth.highest_elevation_deg) == (-62.0, 60.5)
    assert truth.n_spoilt == 1
    (taken,) = truth.photos
    assert taken.gsd_m == pytest.approx(0.004, rel=1e-15)
    assert taken == TakenPhoto(
        photo="photo_00.jpg",
        wall="main wall",
        gsd_m=taken.gsd_m,
        obliquity_deg=12.5,
        roll_deg=-1.5,
    )
    assert truth.details == {"parameters": {"scan_step_m": 0.1}, "n_points": 4}
    np.testing.assert_array_equal(truth.labels, ARRAYS["labels"])
    assert Truth.from_payload(truth.to_payload()).photos == truth.photos


def test_a_truth_of_encoding_1_without_photos_sees_all_round_unless_it_says_more() -> None:
    truth = Truth.from_payload(truth_of_encoding_1({"parameters": {}}))
    assert (truth.lowest_elevation_deg, truth.highest_elevation_deg) == (-90.0, 90.0)
    assert (truth.n_spoilt, truth.photos, truth.cameras) == (0, (), None)


@pytest.mark.parametrize(
    "photos",
    ["none", [3], [{"name": "a.jpg"}], [{"name": "a.jpg", "wall": "w", "gsd_mm": "4"}]],
    ids=["no list", "no mapping", "incomplete", "no number"],
)
def test_photos_that_version_1_did_not_write_stay_where_people_read_them(photos: JsonValue) -> None:
    truth = Truth.from_payload(truth_of_encoding_1({"photos": photos}))
    assert truth.photos == ()
    assert truth.details == {"photos": photos}


def points_of(**changes: object) -> CheckPoints:
    given: dict[str, object] = {
        "names": ("a", "b", "c"),
        "points_world": np.zeros((3, 3)),
        "classes": ("", "", ""),
        "wall": np.zeros(3, dtype=np.int32),
        "pixels_wall": np.zeros((3, 2)),
        "places_m": np.zeros((3, 2)),
        "shown_world": np.zeros((3, 3)),
    }
    return CheckPoints(**{**given, **changes})  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["points_world", "wall", "pixels_wall", "places_m", "shown_world"])
def test_check_points_have_a_row_each(name: str) -> None:
    right = getattr(points_of(), name)
    assert len(points_of().names) == len(right)
    for wrong in (right[:2], np.concatenate([right, right], axis=right.ndim - 1)):
        with pytest.raises(ProductError, match=f"checkpoints.*{name}"):
            points_of(**{name: wrong})
    with pytest.raises(ProductError, match="3 names have 2 classes"):
        points_of(classes=("", ""))


@pytest.mark.parametrize("stored", [None, {}, 7, "IMG_1.jpg", [None], ["IMG_1.jpg"]])
def test_photos_that_are_not_as_version_1_wrote_them_are_none(stored: JsonValue) -> None:
    assert inspections._photos_of_version_1(stored) is None
    assert inspections._photos_of_version_1([]) == []
