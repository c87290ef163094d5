"""`Planes`: the sides from which they are seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from orthoflow.products import (
    Planes,
)
from tests import samples


def two_planes() -> Planes:
    return samples.planes(
        normal=np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]),
        offset=np.array([-2.0, 0.0]),
        corners=np.zeros((2, 4, 3)),
        n_points=np.array([1200, 800]),
        rms_m=np.array([0.002, 0.003]),
        names=("wall 0", "floor"),
    )


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
    planes = replace(two_planes(), viewpoint=viewpoint)
    assert [planes.side_source(index) for index in range(2)] == [source, source]
    own = replace(planes, side_from=("photos", "given"))
    assert [own.side_source(index) for index in range(2)] == ["photos", "given"]


def test_a_plane_turned_round_is_the_same_plane_seen_from_behind() -> None:
    corners = np.arange(24.0).reshape(2, 4, 3)
    parts = np.arange(36.0).reshape(3, 4, 3)
    planes = replace(
        two_planes(), corners=corners, part_corners=parts, part_plane=np.array([0, 1, 0])
    )
    turned = planes.turned(0)
    # n . p = d is the same plane as (-n) . p = -d.
    np.testing.assert_array_equal(turned.normal, [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_array_equal(turned.offset, [2.0, 0.0])
    # Top-left, bottom-left, bottom-right, top-right: from behind left and right change places.
    np.testing.assert_array_equal(turned.corners[0], corners[0][[3, 2, 1, 0]])
    np.testing.assert_array_equal(turned.corners[1], corners[1])
    assert turned.part_corners is not None
    np.testing.assert_array_equal(turned.part_corners[0], parts[0][[3, 2, 1, 0]])
    np.testing.assert_array_equal(turned.part_corners[1], parts[1])
    np.testing.assert_array_equal(turned.part_corners[2], parts[2][[3, 2, 1, 0]])
    # What was given stays as it was, and turning twice turns nothing.
    np.testing.assert_array_equal(planes.corners, np.arange(24.0).reshape(2, 4, 3))
    again = turned.turned(0)
    assert again.part_corners is not None
    np.testing.assert_array_equal(again.part_corners, parts)
    np.testing.assert_array_equal(again.offset, planes.offset)
