"""Sides, names and rectangles of planes, from stations and points that are known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.cloud import PreparedCloud
from orthoflow_plugins.plane.detector import Candidate
from orthoflow_plugins.plane.fit import FoundPlane
from orthoflow_plugins.plane.planes import (
    Deviations,
    assemble,
    face,
    known_viewpoint,
    measure_planes,
    middle_viewpoint_m,
    plane_names,
    rectangle_m,
    side_of_remaining,
    side_of_stations,
)
from orthoflow_plugins.plane.search import Claim, label, verify
from orthoflow_plugins.plane.support import SurfaceRaster

from orthoflow.geometry import Plane, wall_axes
from orthoflow.products import Planes, PointCloud
from tests.plane_scenes import FIT_TOLERANCE_M, TOLERANCE_M, cloud_of, prepared, search_in

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
    raster = SurfaceRaster.over(WALL, CORNERS.repeat(2, axis=0), UP, 0.1)
    whole, part = np.array([-2.0, 2.0, -1.0, 1.0]), np.array([[-9.0, 1.0, 0.0, 9.0]])
    for side, corner in ((1, [-2.0, 2.0, 1.0]), (-1, [2.0, 2.0, 1.0])):
        faced = face(raster, whole, part, side, UP, is_guessed=False)
        np.testing.assert_allclose(faced.corners_m[0], corner)
        np.testing.assert_allclose(faced.plane.normal, side * WALL.normal)
        # No part reaches beyond the whole.
        low, high = faced.part_corners_m[0].min(axis=0), faced.part_corners_m[0].max(axis=0)
        np.testing.assert_allclose([low[[0, 2]], high[[0, 2]]], [[-2.0, -1.0], [1.0, 0.0]])


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


# --- products ---

ORIGIN = np.array([300.0, -200.0, 40.0])


@dataclass(frozen=True)
class Scene:
    """Two walls as a detector found them, the smaller first: its normal points to the origin."""

    cloud: PointCloud
    prepared: PreparedCloud
    found: list[FoundPlane]
    deviations: Deviations


@pytest.fixture(scope="module")
def scene() -> Scene:
    rng = np.random.default_rng(4)
    west = rng.uniform([-2.0, -1.9, -1.0], [-2.0, 1.9, 1.0], (8_000, 3))
    north = rng.uniform([-1.9, 2.0, -1.0], [2.0, 2.0, 1.0], (24_000, 3))
    # More of them beyond the wall than before it.
    north[:, 1] += rng.exponential(0.003, 24_000)
    west[:, 0] -= rng.exponential(0.002, 8_000)
    seen = cloud_of(np.vstack([west, north, [[0.3, 0.0, 0.0]]]), origin=tuple(ORIGIN))
    points = np.column_stack([seen.x, seen.y, seen.z])
    search = search_in(prepared(points, parts=2))
    found = []
    for normal, offset_m, votes in (([1.0, 0.0, 0.0], -2.0, 77.0), ([0.0, 1.0, 0.0], 2.0, 99.0)):
        rough = Candidate(
            plane=Plane(normal=np.array(normal), offset_m=offset_m),
            constraint="vertical",
            votes=votes,
        )
        item = verify(rough, search)
        assert item is not None
        search.claim(Claim.of(item.raster, item.support, TOLERANCE_M))
        found.append(item)
    label(found, search.cloud, TOLERANCE_M)
    deviations = measure_planes(
        search.cloud,
        np.array([item.raster.slab() for item in found]),
        np.array([item.support.bounds_m for item in found]),
        tolerance_m=TOLERANCE_M,
        fit_tolerance_m=FIT_TOLERANCE_M,
    )
    return Scene(cloud=seen, prepared=search.cloud, found=found, deviations=deviations)


def assembled(
    scene: Scene, *stations: tuple[float, float, float]
) -> tuple[Planes, Deviations, NDArray[np.intp]]:
    known = scene.cloud
    if stations:
        known = replace(known, stations=np.array(stations) + ORIGIN, stations_source="file")
    planes, deviations, _, order = assemble(
        scene.found, scene.prepared, known, TOLERANCE_M, FIT_TOLERANCE_M
    )
    return planes, deviations, order


def test_planes_are_ordered_by_their_points_and_face_the_station(scene: Scene) -> None:
    planes, _, order = assembled(scene, (0.0, 0.0, 0.0))
    details: Any = planes.details
    assert planes.names == ("wall 0", "wall 1")
    assert planes.n_points.tolist() == sorted(planes.n_points, reverse=True)
    np.testing.assert_array_equal(order, [1, 0])
    np.testing.assert_allclose(planes.normal, [[0, -1, 0], [1, 0, 0]], atol=2e-3)
    assert (planes.viewpoint, planes.side_from) == ("stations", ())
    for k, item in enumerate(reversed(scene.found)):
        sign = -1.0 if k == 0 else 1.0
        own = item.raster.plane
        np.testing.assert_array_equal(planes.normal[k], sign * own.normal)
        assert planes.offset[k] == sign * own.offset_m + float(planes.normal[k] @ ORIGIN)
        # The offset counts from the world's origin: it moves with the normal.
        shift = np.eye(4)
        shift[3, :3] = ORIGIN
        covariance, n_independent = item.adjusted.stated()
        np.testing.assert_allclose(
            planes.covariance[k], shift @ covariance @ shift.T, rtol=1e-6, atol=1e-15
        )
        assert details["n_independent"][k] == n_independent
        raw = details["raw"][k]
        np.testing.assert_array_equal(raw["normal"], sign * item.candidate.plane.normal)
        assert raw["offset_m"] == pytest.approx(
            sign * item.candidate.plane.offset_m + float(np.array(raw["normal"]) @ ORIGIN)
        )
        assert raw["support"] == item.candidate.votes
    assert planes.tolerance_m == TOLERANCE_M


def test_deviations_follow_a_normal_that_was_turned(scene: Scene) -> None:
    before, after = scene.deviations, assembled(scene, (0.0, 0.0, 0.0))[1]
    assert not np.array_equal(before.histogram[1], before.histogram[1, ::-1])
    np.testing.assert_array_equal(after.histogram[0], before.histogram[1, ::-1])
    np.testing.assert_array_equal(after.histogram[1], before.histogram[0])
    np.testing.assert_array_equal(after.mean_fit_m, [-before.mean_fit_m[1], before.mean_fit_m[0]])
    np.testing.assert_array_equal(after.n_fit, before.n_fit[::-1])
    np.testing.assert_array_equal(after.rms_m, before.rms_m[::-1])
    # From behind it is the other way round.
    after = assembled(scene, (-3.0, 3.0, 0.0))[1]
    np.testing.assert_array_equal(after.histogram, [before.histogram[1], before.histogram[0, ::-1]])
    np.testing.assert_array_equal(after.mean_fit_m, [before.mean_fit_m[1], -before.mean_fit_m[0]])


def test_rectangles_end_with_the_points(scene: Scene) -> None:
    planes = assembled(scene, (0.0, 0.0, 0.0))[0]
    north, west = planes.corners - ORIGIN
    np.testing.assert_allclose(
        north[:, [0, 2]], [[-1.9, 1], [-1.9, -1], [2, -1], [2, 1]], atol=0.005
    )
    np.testing.assert_allclose(
        west[:, [1, 2]], [[-1.9, 1], [-1.9, -1], [1.9, -1], [1.9, 1]], atol=0.005
    )
    assert planes.part_plane is not None
    np.testing.assert_array_equal(planes.part_plane, [0, 1])
    # Parts are known to a cell, and none reaches beyond the points.
    np.testing.assert_allclose(planes.part_corners, planes.corners, atol=0.06)
    for part, whole in zip(planes.part_corners, planes.corners, strict=True):
        assert (part.max(axis=0) <= whole.max(axis=0) + 1e-9).all()
        assert (part.min(axis=0) >= whole.min(axis=0) - 1e-9).all()


@pytest.mark.parametrize(
    ("stations", "viewpoint", "side_from", "n_guessed"),
    [
        ([], "guess", (), 2),
        # In the plane of the larger one it says nothing about that.
        ([(0.0, 2.0, 0.0)], "stations", ("guess", "stations"), 1),
        ([(0.0, 2.0, 0.0), (0.0, 0.5, 0.0)], "stations", (), 0),
    ],
)
def test_sides_that_no_station_knows_are_guessed(
    scene: Scene,
    stations: list[tuple[float, float, float]],
    viewpoint: str,
    side_from: tuple[str, ...],
    n_guessed: int,
) -> None:
    planes = assembled(scene, *stations)[0]
    assert (planes.viewpoint, planes.side_from) == (viewpoint, side_from)
    # The other wall lies before each of them.
    np.testing.assert_allclose(planes.normal, [[0, -1, 0], [1, 0, 0]], atol=2e-3)
    given = planes.details["guessed_sides"]
    assert given == [k for k in range(2) if n_guessed == 2 or "guess" in side_from[k : k + 1]]


def test_sides_that_were_stated_are_given(scene: Scene) -> None:
    known = replace(
        scene.cloud, stations=np.array([[0.0, 2.0, 0.0]]) + ORIGIN, stations_source="view_from"
    )
    planes = assemble(scene.found, scene.prepared, known, TOLERANCE_M, FIT_TOLERANCE_M)[0]
    assert (planes.viewpoint, planes.side_from) == ("view_from", ("guess", "given"))
