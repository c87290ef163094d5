"""What planes state of their exactness, told from their covariance; and which planes are none."""

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


@pytest.mark.parametrize("index", [0, 2])
@pytest.mark.parametrize("sigmas_rad", [(1e-3, 2e-4), (0.0, 3e-4), (5e-4, 5e-4)])
def test_the_direction_is_as_exact_as_its_worst_axis(
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
