"""Selection of walls: relief of a larger wall does not become a separate wall."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.raster.grid import RasterGrid
from orthoflow_plugins.raster.selection import chosen_walls, covered_planes

from orthoflow.errors import MethodError
from orthoflow.products import Planes
from tests import samples

CHOICE = RasterGrid.Params(min_area_m2=0.5, n_walls_max=10)


def but(params: RasterGrid.Params, **changes: object) -> RasterGrid.Params:
    return params.model_copy(update=changes)


def buffer_m(_: int) -> tuple[float, float]:
    return 0.15, 0.15


def planes(*walls: tuple[float, float, float, float]) -> Planes:
    """Return walls facing -y, given as (depth in front of y = 3, left, width, degrees about z)."""
    normals, offsets, corners = [], [], []
    for depth_m, left_m, width_m, tilt_deg in walls:
        tilt = np.radians(tilt_deg)
        normal = np.array([np.sin(tilt), -np.cos(tilt), 0.0])
        right = np.array([np.cos(tilt), np.sin(tilt), 0.0])
        start = np.array([left_m, 3.0 - depth_m, 2.0])
        down = np.array([0.0, 0.0, -2.0])
        corners.append(_rectangle(start, right * width_m, down))
        normals.append(normal)
        offsets.append(normal @ start)
    count = len(walls)
    return samples.planes(
        normal=np.array(normals),
        offset=np.array(offsets),
        corners=np.array(corners),
        n_points=np.arange(count, 0, -1),
        names=tuple(f"wall {k}" for k in range(count)),
    )


def _rectangle(
    start: NDArray[np.float64], right: NDArray[np.float64], down: NDArray[np.float64]
) -> NDArray[np.float64]:
    return np.array([start, start + down, start + down + right, start + right])


MAIN = (0.0, 0.0, 5.0, 0.0)


@pytest.mark.parametrize(
    ("other", "is_covered"),
    [
        # Pilasters in front of the wall and panels behind it are covered, but not beyond its
        # buffers.
        ((0.08, 1.0, 3.0, 0.0), True),
        ((0.11, 1.0, 3.0, 0.0), False),
        ((-0.14, 1.0, 3.0, 0.0), True),
        ((-0.16, 1.0, 3.0, 0.0), False),
        # Planes may be inclined by up to five degrees, but must not be on the other side.
        ((0.0, 2.0, 0.5, 4.8), True),
        ((0.0, 2.0, 0.5, -5.2), False),
        ((0.0, 0.0, 5.0, 180.0), False),
        # These planes are 4 m wide, and a part of each is within the wall.
        ((0.0, 1.76, 4.0, 0.0), True),
        ((0.0, 1.84, 4.0, 0.0), False),
        ((0.0, -0.76, 4.0, 0.0), True),
        ((0.0, -0.84, 4.0, 0.0), False),
    ],
)
def test_planes_in_a_buffer_are_covered(
    other: tuple[float, float, float, float], is_covered: bool
) -> None:
    both = planes(MAIN, other)
    chosen = chosen_walls(both, CHOICE, lambda _: (0.1, 0.15))
    assert chosen == ([0] if is_covered else [0, 1])
    assert chosen_walls(both, but(CHOICE, skip_covered=False), buffer_m) == [0, 1]


def test_covered_planes_are_named_with_the_wall_that_shows_them() -> None:
    relief, other, small = (0.08, 1.0, 3.0, 0.0), (0.0, 6.0, 3.0, 0.0), (0.1, 2.0, 1.0, 0.0)
    four = planes(MAIN, relief, other, small)
    chosen = chosen_walls(four, CHOICE, buffer_m)
    assert chosen == [0, 2]
    assert covered_planes(four, CHOICE, buffer_m, chosen) == {1: 0, 3: 0}
    # Planes that are too small for a wall, or not requested, are not reported.
    assert covered_planes(four, but(CHOICE, min_area_m2=6.5), buffer_m, chosen) == {}
    assert covered_planes(four, but(CHOICE, ranks=(0, 2)), buffer_m, [0, 2]) == {}


def test_a_plane_that_a_larger_one_of_less_support_shows_is_no_wall_of_its_own() -> None:
    # The second plane is at one end of the third, which is larger and has fewer points.
    three = planes((0.0, 0.0, 3.0, -90.0), (0.1, 6.0, 3.0, 0.0), (0.0, 6.0, 9.0, 0.0))
    chosen = chosen_walls(three, CHOICE, buffer_m)
    assert chosen == [0, 2]
    assert covered_planes(three, CHOICE, buffer_m, chosen) == {1: 2}
    # The plane with the most points is always a wall.
    best = planes((0.1, 6.0, 3.0, 0.0), (0.0, 6.0, 9.0, 0.0))
    assert chosen_walls(best, CHOICE, buffer_m) == [0, 1]


def test_a_plane_is_not_covered_by_one_that_was_left_out_itself() -> None:
    # The third is within the buffer of the second, but not within that of the first.
    three = planes(MAIN, (0.10, 0.0, 5.0, 0.0), (0.20, 0.0, 5.0, 0.0))
    assert chosen_walls(three, CHOICE, buffer_m) == [0, 2]


def test_the_wall_nearest_to_a_point_is_chosen() -> None:
    # Two planes face -y, at y = 3 from x = 0 to 5 and at y = 1 from 6 to 7; a perpendicular one is
    # at x = 5.
    three = planes(MAIN, (2.0, 6.0, 1.0, 0.0), (0.0, 5.0, 2.0, -90.0))
    cases = {
        (2.0, 2.9, 1.0): 0,
        (2.0, 3.4, 1.0): 0,  # points behind a wall are as near as those in front
        (6.5, 1.2, 1.0): 1,
        (5.1, 1.5, 1.0): 2,
        (5.6, 1.1, 1.0): 1,  # on the extension of 1's plane, and nearer than 2
    }
    for place, expected in cases.items():
        assert chosen_walls(three, but(CHOICE, near=(place,)), buffer_m) == [expected], place
    both = but(CHOICE, near=((6.5, 1.2, 1.0), (2.0, 2.9, 1.0), (1.0, 2.9, 1.0)))
    assert chosen_walls(three, both, buffer_m) == [0, 1]


def test_a_covered_or_small_wall_is_chosen_when_a_point_is_near_it() -> None:
    both = planes(MAIN, (0.08, 1.0, 0.2, 0.0))
    assert chosen_walls(both, CHOICE, buffer_m) == [0]
    choice = but(CHOICE, near=((1.1, 2.9, 1.0),))
    assert chosen_walls(both, choice, buffer_m) == [1]


def test_the_parts_of_a_plane_count_and_not_the_rectangle_about_them() -> None:
    # There are two ends of one wall, and a wall 0.4 m behind the gap between them.
    ends = planes(MAIN, (-0.4, 2.0, 1.0, 0.0))
    parts = planes((0.0, 0.0, 1.0, 0.0), (0.0, 4.0, 1.0, 0.0))
    known = replace(
        ends,
        part_corners=np.concatenate([parts.corners, ends.corners[1:]]),
        part_plane=np.array([0, 0, 1], dtype=np.int32),
    )
    place = but(CHOICE, near=((2.5, 3.1, 1.0),))
    assert chosen_walls(ends, place, buffer_m) == [0]
    assert chosen_walls(known, place, buffer_m) == [1]


def test_a_rank_that_no_plane_has_is_refused() -> None:
    two = planes(MAIN, (0.5, 0.0, 5.0, 0.0))
    assert chosen_walls(two, but(CHOICE, ranks=(1,)), buffer_m) == [1]
    with pytest.raises(MethodError, match=r"ranks contains 2, but only planes 0 to 1 were found"):
        chosen_walls(two, but(CHOICE, ranks=(1, 2)), buffer_m)


def leaning(degrees: float) -> Planes:
    """Return a plane of 4 m2 whose normal rises above the horizon by an angle."""
    rise = np.radians(degrees)
    normal = np.array([[0.0, -np.cos(rise), np.sin(rise)]])
    down = np.array([0.0, -2.0 * np.sin(rise), -2.0 * np.cos(rise)])
    corners = _rectangle(np.zeros(3), np.array([2.0, 0.0, 0.0]), down)[None]
    return samples.planes(normal=normal, offset=np.zeros(1), corners=corners, names=("a",))


@pytest.mark.parametrize(
    ("degrees", "constraint", "fits"),
    [
        (9.8, "vertical", True),
        (-10.2, "vertical", False),
        (-80.2, "horizontal", True),
        (79.8, "horizontal", False),
        (45.0, "any", True),
    ],
)
def test_planes_may_lean_by_ten_degrees(degrees: float, constraint: Any, fits: bool) -> None:
    choice = but(CHOICE, constraint=constraint)
    if fits:
        assert chosen_walls(leaning(degrees), choice, buffer_m) == [0]
    else:
        with pytest.raises(MethodError, match=f"none of the 1 planes is {constraint}"):
            chosen_walls(leaning(degrees), choice, buffer_m)
