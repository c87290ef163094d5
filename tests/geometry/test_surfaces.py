"""Cylinders, cones and spheres: distances, normals and angles of points whose places are known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from orthoflow.errors import GeometryError
from orthoflow.geometry.surfaces import (
    Cone,
    CurvedShape,
    Cylinder,
    Sphere,
    angles_around,
    zero_direction,
)

UP = np.array([0.0, 0.0, 1.0])
AXIS = np.array([2.0, -1.0, 2.0]) / 3.0
PLACE = np.array([4e6, -2.0, 1.0])
SHAPES = (
    Cylinder(point_world=PLACE, axis_world=AXIS, radius_m=3.0, is_concave=False),
    Cone(apex_world=PLACE, axis_world=AXIS, half_angle_rad=0.4, is_concave=False),
    Sphere(centre_world=PLACE, radius_m=7.0, is_concave=False),
)


@pytest.mark.parametrize("shape", SHAPES, ids=("cylinder", "cone", "sphere"))
@pytest.mark.parametrize("is_concave", [False, True])
def test_points_along_a_normal_have_that_distance(shape: CurvedShape, is_concave: bool) -> None:
    """The places have angles around the axis that are also given back."""
    zero = zero_direction(AXIS, UP)
    angles, along = np.array([-3.0, -0.5, 0.0, 2.5]), np.array([3.0, 4.0, 5.0, 6.0])
    radius = 3.0 if isinstance(shape, Cylinder) else along * math.tan(0.4)
    if isinstance(shape, Sphere):
        radius = np.sqrt(49.0 - along**2)
    outwards = np.cos(angles)[:, None] * zero + np.sin(angles)[:, None] * np.cross(AXIS, zero)
    places = PLACE + along[:, None] * AXIS + np.reshape(radius, (-1, 1)) * outwards
    seen = type(shape)(**(vars(shape) | {"is_concave": is_concave}))
    towards = seen.normals(places)
    assert np.sign((towards * outwards).sum(axis=1)) == pytest.approx(1 - 2 * is_concave)
    for distance in (-0.2, 0.0, 0.3):
        moved = places + distance * towards
        assert seen.distances_m(moved) == pytest.approx(distance, abs=1e-8)
        assert seen.normals(moved) == pytest.approx(towards, abs=1e-8)
    assert angles_around(places, PLACE, AXIS, zero) == pytest.approx(angles, abs=1e-8)


def test_angles_count_from_the_crown_of_a_vault_and_from_e1_of_a_tower() -> None:
    assert zero_direction(np.array([0.0, 0.6, 0.8]), UP) == pytest.approx([1.0, 0.0, 0.0])
    assert zero_direction(np.array([0.0, 0.8, 0.6]), UP) == pytest.approx([0.0, -0.6, 0.8])


@pytest.mark.parametrize(
    "changed", [{"axis_world": 2.0 * AXIS}, {"point_world": PLACE * np.nan}, {"radius_m": 0.0}]
)
def test_impossible_shapes_are_refused(changed: dict[str, object]) -> None:
    with pytest.raises(GeometryError):
        Cylinder(**(vars(SHAPES[0]) | changed))
    with pytest.raises(GeometryError):
        Cone(apex_world=PLACE, axis_world=AXIS, half_angle_rad=1.6, is_concave=False)
    with pytest.raises(GeometryError):
        Sphere(centre_world=PLACE[:2], radius_m=1.0, is_concave=False)
