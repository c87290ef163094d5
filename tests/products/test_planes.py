"""`Planes`: the sides from which they are seen, what they state of their exactness."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from orthoflow.errors import ProductError
from orthoflow.products import Planes, PointLabels
from orthoflow.testing import example_room


def planes() -> Planes:
    return example_room(n_points=600)[1]


@pytest.mark.parametrize(
    ("viewpoint", "source"),
    [
        ("stations", "stations"),
        ("view_from", "given"),
        ("given", "given"),
        ("guess", "guess"),
        ("a stranger's word", "guess"),
    ],
)
def test_the_side_of_a_plane_is_known_as_all_are_or_by_itself(viewpoint: str, source: str) -> None:
    true = replace(planes(), viewpoint=viewpoint)
    assert [true.side_source(index) for index in range(6)] == [source] * 6
    own = replace(true, side_from=("photos", "given") * 3)
    assert [own.side_source(index) for index in range(2)] == ["photos", "given"]


def test_a_plane_turned_round_is_the_same_plane_seen_from_behind() -> None:
    parts = np.arange(36.0).reshape(3, 4, 3)
    true = replace(planes(), part_corners=parts, part_plane=np.array([0, 1, 0]))
    corners, sign = true.corners.copy(), np.array([-1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    turned = true.turned(0)
    # n . p = d is the same plane as (-n) . p = -d.
    np.testing.assert_array_equal(turned.normal, sign[:, None] * true.normal)
    np.testing.assert_array_equal(turned.offset, sign * true.offset)
    # Top-left, bottom-left, bottom-right, top-right: from behind left and right change places.
    np.testing.assert_array_equal(turned.corners[0], corners[0][[3, 2, 1, 0]])
    np.testing.assert_array_equal(turned.corners[1:], corners[1:])
    assert turned.part_corners is not None
    np.testing.assert_array_equal(turned.part_corners[0], parts[0][[3, 2, 1, 0]])
    np.testing.assert_array_equal(turned.part_corners[1], parts[1])
    np.testing.assert_array_equal(turned.part_corners[2], parts[2][[3, 2, 1, 0]])
    # What was given stays as it was, and turning twice turns nothing.
    np.testing.assert_array_equal(true.corners, corners)
    again = turned.turned(0)
    assert again.part_corners is not None
    np.testing.assert_array_equal(again.part_corners, parts)
    np.testing.assert_array_equal(again.offset, true.offset)


@pytest.mark.parametrize("index", [0, 2])
@pytest.mark.parametrize("sigmas_rad", [(1e-3, 2e-4), (0.0, 3e-4), (5e-4, 5e-4)])
def test_sigma_of_the_direction_is_of_its_worst_axis(
    index: int, sigmas_rad: tuple[float, float]
) -> None:
    true = planes()
    covariance = np.zeros((6, 4, 4))
    # A normal turns about the two axes across it.
    axes = np.linalg.svd(true.normal[index][None])[2][1:]
    covariance[index, :3, :3] = sum(
        sigma**2 * np.outer(axis, axis) for sigma, axis in zip(sigmas_rad, axes, strict=True)
    )
    found = replace(true, covariance=covariance).sigma_angle_deg(index)
    assert found == pytest.approx(math.degrees(max(sigmas_rad)), rel=1e-9)
    assert replace(true, covariance=covariance).sigma_angle_deg(1) == 0.0


@pytest.mark.parametrize("shift_m", [0.0, 1e5])
def test_the_position_is_stated_in_the_middle_of_the_rectangle(shift_m: float) -> None:
    _, true = example_room(n_points=600, shift_m=np.array([shift_m, -shift_m, 100.0]))
    middle = true.corners[3].mean(axis=0)
    # Directions wrong by a milliradian about the middle, where the plane itself is exact to 2 mm.
    across = np.cross(true.normal[3], true.up)
    turned = np.append(across, across @ middle)
    along = np.array([0.0, 0.0, 0.0, 1.0])
    covariance = np.zeros((6, 4, 4))
    covariance[3] = 1e-6 * np.outer(turned, turned) + 4e-6 * np.outer(along, along)
    found = replace(true, covariance=covariance)
    assert found.sigma_offset_m(3) == pytest.approx(0.002, rel=1e-3)
    assert found.sigma_offset_m(2) == 0.0


@pytest.mark.parametrize("name", ["normal", "corners", "covariance", "n_points", "rms_m"])
def test_an_array_of_another_length_is_refused(name: str) -> None:
    true = planes()
    with pytest.raises(ProductError, match=rf"planes.{name} must have shape \(6.*got \(5"):
        replace(true, **{name: getattr(true, name)[:5]})


def test_a_plane_taken_out_does_not_hold_the_others() -> None:
    true = planes()
    plane = true.plane(4)
    assert (plane.normal.tolist(), plane.offset_m) == (true.normal[4].tolist(), true.offset[4])
    plane.normal[0] = 9.0
    assert true.normal[4, 0] != 9.0
    assert len(true) == 6


@pytest.mark.parametrize(
    "index", [np.zeros(3, dtype=np.int32), np.zeros((3, 1), dtype=np.int16), np.zeros(3)]
)
def test_labels_are_flat_short_integers(index: np.ndarray) -> None:
    with pytest.raises(
        ProductError, match=r"labels.plane_index must be a one-dimensional int16 array"
    ):
        PointLabels(plane_index=index)
