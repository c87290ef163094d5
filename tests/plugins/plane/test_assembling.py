"""Sides, names and rectangles of planes, from stations and points that are known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.assembling import (
    enclosing,
    known_viewpoint,
    middle_viewpoint_m,
    plane_names,
    rectangle_m,
    side_of_remaining,
    side_of_stations,
)

from orthoflow.geometry import Plane, wall_axes
from orthoflow.products import PointCloud
from tests.plane_scenes import cloud_of

UP = np.array([0.0, 0.0, 1.0])
# At y = 2, its normal to the south; 4 x 2 m about (0, 2, 0).
WALL = Plane(normal=np.array([0.0, -1.0, 0.0]), offset_m=-2.0)
CORNERS = rectangle_m(WALL, wall_axes(WALL.normal, UP), np.array([-2.0, 2.0, -1.0, 1.0]))


def leaning(rise_deg: float) -> NDArray[np.float64]:
    rise = np.radians(rise_deg)
    return np.array([np.cos(rise), 0.0, np.sin(rise)])


def test_planes_are_named_by_inclination_and_the_lowest_and_highest_level_apart() -> None:
    rises = [0.0, 29.0, 31.0, 79.0, 81.0, 90.0, -90.0, -81.0, -79.0, -29.0]
    normals = np.array([leaning(rise) for rise in rises])
    heights = np.array([0.0, 0.0, 0.0, -9.0, 1.0, 0.5, 2.0, 2.5, 9.0, 0.0])
    assert plane_names(normals, heights, UP) == (
        "wall 0", "wall 1", "slope 2", "slope 3", "level 4", "floor 5", "level 6", "ceiling 7",
        "slope 8", "wall 9",
    )  # fmt: skip
    # Nothing is seen from below: no ceiling.
    assert plane_names(normals[4:6], heights[4:6], UP) == ("level 0", "floor 1")
    assert plane_names(normals[6:8], heights[6:8], UP) == ("level 0", "ceiling 1")


def test_corners_run_from_the_top_left_counter_clockwise() -> None:
    np.testing.assert_allclose(
        CORNERS, [[-2.0, 2.0, 1.0], [-2.0, 2.0, -1.0], [2.0, 2.0, -1.0], [2.0, 2.0, 1.0]]
    )
    back = WALL.flipped()
    again = enclosing(CORNERS, back, wall_axes(back.normal, UP))
    np.testing.assert_allclose(
        again, [[2.0, 2.0, 1.0], [2.0, 2.0, -1.0], [-2.0, 2.0, -1.0], [-2.0, 2.0, 1.0]]
    )
    turn = np.array([[0.6, 0.0, 0.8], [0.8, 0.0, -0.6]])
    wide = enclosing(CORNERS, WALL, turn)
    placed = wide @ turn.T
    np.testing.assert_allclose(placed.max(axis=0), [2.0, 2.2])
    np.testing.assert_allclose(placed.min(axis=0), [-2.0, -2.2])


# --- from which side ---


def cloud(**given: Any) -> PointCloud:
    plain = cloud_of(np.zeros((6, 3)), origin=(10.0, 20.0, 30.0))
    if "stations" in given and given["stations"] is not None:
        given["stations"] = np.array(given["stations"]) + plain.origin
        given.setdefault("stations_source", "file")
    return replace(plain, **given)


EVERY = np.arange(6)
MIDDLE = np.array([0.0, 2.0, 0.0])


def test_what_is_known_of_the_viewpoint_is_told() -> None:
    assert known_viewpoint(cloud()) == "guess"
    assert known_viewpoint(cloud(stations=np.zeros((0, 3)))) == "guess"
    assert known_viewpoint(cloud(stations=[[0, 0, 0]])) == "stations"
    assert known_viewpoint(cloud(stations=[[0, 0, 0]], stations_source="view_from")) == "view_from"
    points = np.array([[0.0, 1.0, 2.0], [4.0, 5.0, 9.0], [1.0, 2.0, 3.0]])
    np.testing.assert_allclose(middle_viewpoint_m(cloud(), points), [1.0, 2.0, 3.0])
    two = cloud(stations=[[0, 2, 0], [4, 0, 2]])
    np.testing.assert_allclose(middle_viewpoint_m(two, points), [2.0, 1.0, 1.0])


def test_the_nearest_station_that_is_clear_of_the_plane_tells_the_side() -> None:
    def side(*stations: tuple[float, float, float]) -> int:
        return side_of_stations(WALL, MIDDLE, cloud(stations=stations), EVERY)

    assert side((0, 0, 0)) == 1
    assert side((0, 5, 0)) == -1
    assert side((0, 0, 0), (0, 3, 0)) == -1
    # Five centimetres are in the plane itself.
    assert side((0, 2.04, 0)) == side((0, 1.96, 0)) == 0
    assert side((0, 2.06, 0)) == -1
    assert side((0, 1.94, 0)) == 1
    assert side((0, 2.04, 0), (0, 0, 0)) == 1
    assert side_of_stations(WALL, MIDDLE, cloud(), EVERY) == 0
    assert side_of_stations(WALL, MIDDLE, cloud(stations=np.zeros((0, 3))), EVERY) == 0


def test_scans_of_the_points_have_a_voice_each() -> None:
    stations = [[0, -9, 0], [0, 3, 0], [0, 2.01, 0]]

    def side(*scans: int) -> int:
        known = cloud(stations=stations, scan=np.array(scans, dtype=np.uint16))
        return side_of_stations(WALL, MIDDLE, known, EVERY[: len(scans)])

    assert side(0, 0, 0, 0, 1, 1) == 1
    assert side(0, 0, 1, 1, 1, 1) == -1
    assert side(0, 2, 2, 2, 2, 2) == 1
    # As many on either side, nobody, or a scan that nobody knows: the nearest station.
    assert side(0, 0, 0, 1, 1, 1) == -1
    assert side(2, 2, 2, 2, 2, 2) == -1
    assert side(0, 0, 0, 0, 0, 3) == -1
    some = cloud(stations=stations, scan=np.zeros(6, dtype=np.uint16))
    assert side_of_stations(WALL, MIDDLE, some, EVERY[:0]) == -1


def side_by(points: list[tuple[float, float, float]], parallel: list[bool] | None = None) -> int:
    is_parallel = np.array(parallel if parallel is not None else [False] * len(points))
    return side_of_remaining(WALL, CORNERS, np.array(points), is_parallel, clear_m=0.05)


def test_points_before_or_behind_the_rectangle_tell_the_side() -> None:
    assert side_by([(0, 1, 0)]) == 1
    assert side_by([(0, 3, 0)]) == -1
    # A metre says all: two points at a metre against one far away.
    assert side_by([(0, 1, 0), (0, 1, 0.5), (0, 9, 0)]) == 1
    # Relief says less: three near ones of 20 cm against one of a metre.
    assert side_by([(0, 1.8, 0)] * 3 + [(0, 3, 0)]) == -1
    assert side_by([(0, 1.8, 0)] * 6 + [(0, 3, 0)]) == 1
    # Beside it by more than 30 cm nobody is asked, unless nobody else is there.
    assert side_by([(2.2, 1, 0), (2.4, 3, 0), (2.4, 3, 0)]) == 1
    assert side_by([(-2.2, 1, 0), (-2.4, 3, 0), (-2.4, 3, 0)]) == 1
    assert side_by([(0, 1, 1.2), (0, 3, 1.4), (0, 3, 1.4)]) == 1
    assert side_by([(0, 1, -1.2), (0, 3, -1.4), (0, 3, -1.4)]) == 1
    assert side_by([(2.4, 3, 0)]) == -1
    # What is on the plane itself has no say.
    assert side_by([(0, 1.96, 0)] * 9) == 0
    assert side_by([(0, 1.96, 0)] * 9 + [(0, 2.2, 0)]) == -1


def test_parallel_planes_are_asked_last() -> None:
    behind = [(0.0, 2.5, 0.0)] * 5
    assert side_by([*behind, (0, 1, 0)], [True] * 5 + [False]) == 1
    assert side_by([*behind, (0, 1, 0)]) == -1
    assert side_by(behind, [True] * 5) == -1
    # Before the rectangle a parallel one counts more than others beside it.
    assert side_by([*behind, (9, 1, 0)], [True] * 5 + [False]) == -1
    far = [(9.0, 3.0, 0.0)]
    assert side_by([*far, (9, 1, 0), (9, 1, 0)], [False, True, True]) == -1


def test_a_small_difference_says_nothing() -> None:
    """A hundredth of what all points say, were each just clear of the plane."""
    bare = [(0.0, 2.0, 0.0)] * 1_999
    # 0.01 * 2000 * 0.05 m: one metre.
    assert side_by([*bare, (0, 1.01, 0)]) == 0
    assert side_by([*bare[:-1], (0, 1.5, 0), (0, 1.48, 0)]) == 1
    assert side_by([*bare[:-1], (0, 2.5, 0), (0, 2.52, 0)]) == -1


@pytest.mark.parametrize("n_points", [0, 1])
def test_without_other_points_no_side_is_told(n_points: int) -> None:
    points = np.tile([[0.0, 2.0, 0.0]], (n_points, 1))
    nowhere = np.zeros(n_points, dtype=np.bool_)
    assert side_of_remaining(WALL, CORNERS, points, nowhere, clear_m=0.05) == 0
