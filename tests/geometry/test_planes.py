"""Planes: distances, sides, three points, and the angles that the literature prints."""

from __future__ import annotations

import math

import numpy as np
import pytest

from orthoflow.errors import GeometryError
from orthoflow.geometry.frames import Plane, angle_between_deg, omega_phi_deg, plane_through
from tests import scenes
from tests.long_loops import seeds

UP = np.array([0.0, 0.0, 1.0])
# Two metres along (0.6, 0, 0.8).
PLANE = Plane(normal=np.array([0.6, 0.0, 0.8]), offset_m=2.0)


def test_distances_are_positive_on_the_side_of_the_normal() -> None:
    points = np.array([[1.2, 7.0, 1.6], [0.0, 0.0, 0.0], [3.0, -1.0, 4.0]])
    np.testing.assert_allclose(PLANE.distances_m(points), [0.0, -2.0, 3.0], atol=1e-12)
    np.testing.assert_allclose(PLANE.flipped().distances_m(points), [0.0, 2.0, -3.0], atol=1e-12)


def test_a_plane_is_turned_towards_who_looks() -> None:
    assert PLANE.towards(np.array([3.0, 0.0, 4.0])) is PLANE
    # Who stands in it sees it as it is.
    assert PLANE.towards(np.array([2.0, 5.0, 1.0])) is PLANE
    turned = PLANE.towards(np.zeros(3))
    np.testing.assert_array_equal(turned.normal, -PLANE.normal)
    assert turned.offset_m == -2.0


@pytest.mark.parametrize(
    ("normal", "is_plane"),
    [
        ([0.0, 0.0, 1.0], True),
        ([0.0, 0.0, 1.0 + 0.9e-9], True),
        ([0.0, 0.0, 1.0 + 1.1e-9], False),
        ([0.0, 0.0, 1.0 - 1.1e-9], False),
        ([0.0, 1.0], False),
    ],
)
def test_a_normal_is_a_unit_vector(normal: list[float], is_plane: bool) -> None:
    if is_plane:
        Plane(normal=np.array(normal), offset_m=0.0)
        return
    with pytest.raises(GeometryError, match=r"needs a unit normal of shape \(3,\)"):
        Plane(normal=np.array(normal), offset_m=0.0)


@pytest.mark.parametrize("seed", seeds(3))
def test_a_plane_runs_through_its_three_points_by_the_right_hand_rule(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(0.0, 5.0, (3, 3))
    plane = plane_through(points)
    np.testing.assert_allclose(plane.distances_m(points), 0.0, atol=1e-9)
    sides = np.array([points[1] - points[0], points[2] - points[0], plane.normal])
    assert np.linalg.det(sides) > 0.0


@pytest.mark.parametrize(
    "points",
    [
        [[0, 0, 0], [0, 0, 0], [0, 0, 0]],
        [[0, 0, 0], [1, 0, 0], [1, 0, 0]],
        [[1, 2, 3], [2, 4, 6], [3, 6, 9]],
        [[0, 0, 0], [1, 0, 0], [2, 1e-9, 0]],
        [[0, 0, 0], [1, 0, 0], [math.nan, 1, 0]],
    ],
)
def test_points_on_a_line_span_no_plane(points: list[list[float]]) -> None:
    with pytest.raises(GeometryError, match="three points must define a plane"):
        plane_through(np.array(points, dtype=np.float64))


def test_points_nearly_on_a_line_span_one() -> None:
    # Of a triangle two metres long five micrometres high.
    plane = plane_through(np.array([[0.0, 0.0, 0.0], [1.0, 5e-6, 0.0], [2.0, 0.0, 0.0]]))
    np.testing.assert_allclose(plane.normal, [0.0, 0.0, -1.0])


@pytest.mark.parametrize("deg", [0.0, 1e-7, 30.0, 90.0, 179.999, 180.0])
def test_angles_are_exact_near_none_and_near_a_half_turn(deg: float) -> None:
    turn = math.radians(deg)
    rotation = scenes.random_rotation(np.random.default_rng(1))
    first = rotation @ np.array([1.0, 0.0, 0.0])
    second = rotation @ np.array([math.cos(turn), math.sin(turn), 0.0])
    assert angle_between_deg(first, second) == pytest.approx(deg, abs=1e-12, rel=1e-6)


@pytest.mark.parametrize("omega_deg", [0.0, 45.0, 135.0, 200.0, 315.0, 359.0])
@pytest.mark.parametrize("phi_deg", [-89.0, -30.0, 0.0, 60.0])
def test_normals_have_a_direction_and_an_inclination(omega_deg: float, phi_deg: float) -> None:
    omega, phi = math.radians(omega_deg), math.radians(phi_deg)
    normal = np.array(
        [math.cos(phi) * math.cos(omega), math.cos(phi) * math.sin(omega), math.sin(phi)]
    )
    found = omega_phi_deg(normal, UP)
    assert found[0] % 360.0 == found[0]
    assert (found[0] - omega_deg + 180.0) % 360.0 == pytest.approx(180.0, abs=1e-9)
    assert found[1] == pytest.approx(phi_deg, abs=1e-9)


def test_straight_up_is_ninety_degrees_though_rounding_goes_beyond() -> None:
    assert omega_phi_deg(np.array([0.0, 0.0, 1.0 + 1e-12]), UP)[1] == 90.0
    assert omega_phi_deg(np.array([0.0, 0.0, -1.0 - 1e-12]), UP)[1] == -90.0
