"""Sides, names, rectangles, deviations and thickness of planes; given planes."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.given import GivenPlane
from orthoflow_plugins.plane.hough2d import Hough2d
from orthoflow_plugins.plane.planes import (
    normality,
    plane_names,
    rectangle_m,
    side_of_remaining,
    side_of_stations,
)
from orthoflow_plugins.plane.ransac import Ransac
from pydantic import ValidationError
from scipy import stats

from orthoflow.errors import MethodError
from orthoflow.geometry import Plane, wall_axes
from orthoflow.products import Planes, PointCloud
from tests import plane_scenes
from tests.long_loops import long_only
from tests.plane_scenes import ROOM, Rectangle, cloud_of, detect, sampled

UP = np.array([0.0, 0.0, 1.0])
# The wall is at y = 2, with its normal to the south, and 4 x 2 m large around (0, 2, 0).
WALL = Plane(normal=np.array([0.0, -1.0, 0.0]), offset_m=-2.0)
CORNERS = rectangle_m(WALL, wall_axes(WALL.normal, UP), np.array([-2.0, 2.0, -1.0, 1.0]))


def test_planes_are_named_by_inclination_and_the_lowest_and_highest_level_apart() -> None:
    rises = np.radians([0.0, 29.0, 31.0, 79.0, 81.0, 90.0, -90.0, -81.0, -79.0, -29.0])
    normals = np.column_stack([np.cos(rises), np.zeros(10), np.sin(rises)])
    heights = np.array([0.0, 0.0, 0.0, -9.0, 1.0, 0.5, 2.0, 2.5, 9.0, 0.0])
    assert plane_names(normals, heights, UP) == (
        "wall 0", "wall 1", "slope 2", "slope 3", "level 4", "floor 5", "level 6", "ceiling 7",
        "slope 8", "wall 9",
    )  # fmt: skip
    # No plane is seen from below, so there is no ceiling.
    assert plane_names(normals[4:6], heights[4:6], UP) == ("level 0", "floor 1")
    assert plane_names(normals[6:8], heights[6:8], UP) == ("level 0", "ceiling 1")


# --- visible side ---


def test_the_nearest_station_that_is_clear_of_the_plane_tells_the_side() -> None:
    def side(*places: tuple[float, float, float], scan: tuple[int, ...] | None = None) -> int:
        stations = np.array(places).reshape(-1, 3)
        known = cloud_of(np.zeros((6, 3)), origin=(10.0, 20.0, 30.0), stations=stations)
        if scan is not None:
            known = replace(known, scan=np.resize(scan or (0,), 6).astype(np.uint16))
        chosen = np.arange(6 if scan is None else len(scan))
        return side_of_stations(WALL, np.array([0.0, 2.0, 0.0]), known, chosen)

    assert side((0, 0, 0)) == 1
    assert side((0, 5, 0)) == -1
    assert side((0, 0, 0), (0, 3, 0)) == -1
    # Stations within five centimetres are in the plane itself.
    assert side((0, 2.04, 0)) == side((0, 1.96, 0)) == side() == 0
    assert side((0, 2.06, 0)) == -1
    assert side((0, 1.94, 0)) == side((0, 2.04, 0), (0, 0, 0)) == 1
    # Each scan of the points counts.
    three: Any = ((0, -9, 0), (0, 3, 0), (0, 2.01, 0))
    assert side(*three, scan=(0, 0, 0, 0, 1, 1)) == 1
    assert side(*three, scan=(0, 0, 1, 1, 1, 1)) == -1
    assert side(*three, scan=(0, 2, 2, 2, 2, 2)) == 1
    # The nearest station decides if equal numbers of points were scanned from both sides, if there
    # are no points, and if a scan has no station.
    for scan in ((0, 0, 0, 1, 1, 1), (2,) * 6, (0, 0, 0, 0, 0, 3), ()):
        assert side(*three, scan=scan) == -1


def side_by(points: Sequence[tuple[float, ...]], parallel: list[bool] | None = None) -> int:
    is_parallel = np.array(parallel or [False] * len(points), dtype=np.bool_)
    places = np.array(points, dtype=np.float64).reshape(-1, 3)
    return side_of_remaining(WALL, CORNERS, places, is_parallel, clear_m=0.05)


def test_points_before_or_behind_the_rectangle_tell_the_side() -> None:
    assert side_by([(0, 1, 0)]) == 1
    assert side_by([(0, 3, 0)]) == -1
    assert side_by([]) == side_by([(0, 2, 0)]) == 0
    # A distance of a metre counts fully, so two points at a metre outweigh one far away.
    assert side_by([(0, 1, 0), (0, 1, 0.5), (0, 9, 0)]) == 1
    # Relief counts less, so three points at 20 cm do not outweigh one at a metre.
    assert side_by([(0, 1.8, 0)] * 3 + [(0, 3, 0)]) == -1
    assert side_by([(0, 1.8, 0)] * 6 + [(0, 3, 0)]) == 1
    # Points more than 30 cm beside the rectangle only count if there are no others.
    assert side_by([(2.2, 1, 0), (2.4, 3, 0), (2.4, 3, 0)]) == 1
    assert side_by([(-2.2, 1, 0), (-2.4, 3, 0), (-2.4, 3, 0)]) == 1
    assert side_by([(0, 1, 1.2), (0, 3, 1.4), (0, 3, 1.4)]) == 1
    assert side_by([(0, 1, -1.2), (0, 3, -1.4), (0, 3, -1.4)]) == 1
    assert side_by([(2.4, 3, 0)]) == -1
    # Points on the plane itself do not count.
    assert side_by([(0, 1.96, 0)] * 9) == 0
    assert side_by([(0, 1.96, 0)] * 9 + [(0, 2.2, 0)]) == -1


# --- products ---

ORIGIN = (300.0, -200.0, 40.0)


def two_walls(
    folder: Path,
    *stations: tuple[float, float, float],
    source: str = "file",
    origin: tuple[float, float, float] = ORIGIN,
) -> Planes:
    """Return a north wall and a west wall with a third of its points; points lie beyond both."""
    rng = np.random.default_rng(4)
    west = rng.uniform([-2.0, -1.9, -1.0], [-2.0, 1.9, 1.0], (8_000, 3))
    north = rng.uniform([-1.9, 2.0, -1.0], [2.0, 2.0, 1.0], (24_000, 3))
    north[:, 1] += rng.exponential(0.003, 24_000)
    west[:, 0] -= rng.exponential(0.002, 8_000)
    cloud = cloud_of(
        np.vstack([west, north, [[0.3, 0.0, 0.0]]]),
        origin=origin,
        stations=np.array(stations) if stations else None,
        source=source,
    )
    planes: Planes = detect(Hough2d, cloud, folder)[0].planes
    return planes


def test_planes_are_ordered_by_their_points_and_face_the_station(tmp_path: Path) -> None:
    planes = two_walls(tmp_path, (0.0, 0.0, 0.0))
    assert planes.names == ("wall 0", "wall 1")
    np.testing.assert_allclose(planes.n_points, [24_000, 8_000], atol=100)
    np.testing.assert_allclose(planes.normal, [[0, -1, 0], [1, 0, 0]], atol=2e-3)
    assert (planes.viewpoint, planes.side_from) == ("stations", ())
    # The offset refers to the world's origin, so it and its covariance change with the cloud's
    # position.
    near = two_walls(tmp_path, (0.0, 0.0, 0.0), origin=(0.0, 0.0, 0.0))
    shift = np.eye(4)
    shift[3, :3] = ORIGIN
    for k, wall in enumerate(planes.normal):
        assert planes.offset[k] == pytest.approx(near.offset[k] + wall @ ORIGIN, abs=1e-9)
        moved = shift @ near.covariance[k] @ shift.T
        np.testing.assert_allclose(planes.covariance[k], moved, rtol=1e-6, atol=1e-15)
        raw: Any = [found.details["raw"][k] for found in (planes, near)]  # type: ignore[index, call-overload]
        assert raw[0]["normal"] @ wall > 0.99
        expected = raw[1]["offset_m"] + raw[1]["normal"] @ np.array(ORIGIN)
        assert raw[0]["offset_m"] == pytest.approx(expected)


def test_deviations_and_rectangles_are_those_for_who_sees_the_wall(tmp_path: Path) -> None:
    before, behind = (two_walls(tmp_path, at) for at in ((0.0, 0.0, 0.0), (-3.0, 3.0, 0.0)))
    for k in range(2):
        # Points are beyond the walls, so skewness is negative from the inside, and positive from
        # the outside.
        shapes: Any = [found.details["normality"][k] for found in (before, behind)]  # type: ignore[index, call-overload]
        assert shapes[0]["skewness"] == pytest.approx(-shapes[1]["skewness"])
        assert shapes[0]["mean_m"] == pytest.approx(-shapes[1]["mean_m"])
        assert shapes[1]["skewness"] > 0.5
    north, west = before.corners - ORIGIN
    # Corners begin at the top left and are counter-clockwise.
    for found, axis, left, right in ((north, 0, -1.9, 2.0), (west, 1, -1.9, 1.9)):
        expected = [[left, 1], [left, -1], [right, -1], [right, 1]]
        np.testing.assert_allclose(found[:, [axis, 2]], expected, atol=0.005)
    np.testing.assert_array_equal(before.part_plane, [0, 1])
    assert before.part_corners is not None
    # Parts are accurate to a cell, and none extends beyond the points.
    np.testing.assert_allclose(before.part_corners, before.corners, atol=0.06)
    for part, whole in zip(before.part_corners, before.corners, strict=True):
        assert (part.max(axis=0) <= whole.max(axis=0) + 1e-9).all()
        assert (part.min(axis=0) >= whole.min(axis=0) - 1e-9).all()


@pytest.mark.parametrize(
    ("stations", "source", "viewpoint", "side_from"),
    [
        ([], "file", "guess", ()),
        # A station in the plane of the larger wall does not determine the side of this wall.
        ([(0.0, 2.0, 0.0)], "file", "stations", ("guess", "stations")),
        ([(0.0, 2.0, 0.0), (0.0, 0.5, 0.0)], "file", "stations", ()),
        ([(0.0, 2.0, 0.0)], "view_from", "view_from", ("guess", "given")),
    ],
)
def test_sides_that_no_station_knows_are_guessed(
    stations: list[tuple[float, float, float]],
    source: str,
    viewpoint: str,
    side_from: tuple[str, ...],
    tmp_path: Path,
) -> None:
    planes = two_walls(tmp_path, *stations, source=source)
    assert (planes.viewpoint, planes.side_from) == (viewpoint, side_from)
    # For each of them, the other wall is in front.
    np.testing.assert_allclose(planes.normal, [[0, -1, 0], [1, 0, 0]], atol=2e-3)


# --- deviations ---


def shape_of(distances_m: NDArray[np.float64], *, is_turned: bool = False) -> Any:
    counts, _ = np.histogram(distances_m, 200, (-0.05, 0.05))
    counts = counts[::-1] if is_turned else counts
    return normality(counts.astype(np.int64), tolerance_m=0.05, fit_tolerance_m=0.015)


def test_the_shape_of_deviations_is_that_of_those_within_the_tolerance_of_the_fit() -> None:
    rng = np.random.default_rng(2)
    # A moulding is on a twentieth of the wall.
    distances_m = rng.normal(0.002, 0.002, 200_000) + 0.01 * (rng.random(200_000) < 0.05)
    shape, turned = shape_of(distances_m), shape_of(distances_m, is_turned=True)
    near_m = distances_m[np.abs(distances_m) <= 0.015]
    scaled = (near_m - near_m.mean()) / near_m.std()
    assert shape.mean_m == pytest.approx(near_m.mean(), abs=1e-6)
    assert shape.sigma_m == pytest.approx(near_m.std(), rel=1e-3)
    assert shape.skewness == pytest.approx(stats.skew(near_m), abs=0.005)
    assert turned.skewness == pytest.approx(-shape.skewness)
    assert shape.excess_kurtosis == pytest.approx(stats.kurtosis(near_m), abs=0.01)
    # Bins of 0.5 mm are assumed to be evenly filled.
    within = [np.mean(np.abs(scaled) <= reach) for reach in (1, 2, 3)]
    np.testing.assert_allclose(shape.within, within, atol=0.005)
    quantiles = np.quantile(scaled, stats.norm.cdf(shape.expected_sigmas))
    np.testing.assert_allclose(shape.found_sigmas, quantiles, atol=0.03)
    # Few points, or points in a single bin, have no distribution.
    assert shape_of(distances_m[:50]) is shape_of(np.full(1000, 1e-4)) is None


# The wall of 6 x 3 m at y = 2 is seen from the middle of a room.
STATION = np.array([[0.0, 0.0, 0.0]])
N_POINTS = 90_000


def wall(noise_m: NDArray[np.float64] | float, *, bow_m: float = 0.0) -> NDArray[np.float64]:
    rng = np.random.default_rng(0)
    x, z = rng.uniform(-3.0, 3.0, N_POINTS), rng.uniform(-1.5, 1.5, N_POINTS)
    y = 2.0 + bow_m * (x / 3.0) ** 2 + rng.normal(0.0, 1.0, N_POINTS) * noise_m
    return np.column_stack([x, y, z])


def measured(cloud: PointCloud, folder: Path, **params: object) -> tuple[Any, dict[str, float]]:
    out, ctx = plane_scenes.detect(Ransac, cloud, folder, **params)
    return out.planes, {metric.name: metric.value for metric in ctx.metrics}


@pytest.mark.parametrize("noise_m", [*long_only(0.001), 0.004])
@pytest.mark.usefixtures("all_places")
def test_thickness_is_the_noise_and_not_the_bow(noise_m: float, tmp_path: Path) -> None:
    _, metrics = measured(cloud_of(wall(noise_m, bow_m=0.006), stations=STATION), tmp_path)
    # With 50 points per tile and 90,000 in total, the error is half a per cent; a bow of 6 mm
    # causes little slope in a tile.
    assert metrics["thickness_mm"] == pytest.approx(1000.0 * noise_m, rel=0.03)
    assert metrics["thickness_width_mm"] == pytest.approx(3.92 * 1000.0 * noise_m, rel=0.03)
    assert metrics["thickest_mm"] == metrics["thickness_mm"]
    step_mm = 1000.0 * np.sqrt(18.0 / N_POINTS)
    assert metrics["scan_step_mm"] == pytest.approx(step_mm, rel=0.03)
    assert metrics["thickness_scan_steps"] == pytest.approx(1000.0 * noise_m / step_mm, rel=0.05)


@pytest.mark.usefixtures("all_places")
def test_noise_that_grows_with_incidence_and_range_is_given_by_class(tmp_path: Path) -> None:
    range_m = np.linalg.norm(wall(0.0), axis=1)
    noise_m = 0.001 + 0.003 * np.arccos(2.0 / range_m)
    (classes,) = measured(cloud_of(wall(noise_m), stations=STATION), tmp_path)[0].thickness
    assert len(classes.incidence_deg) >= 5
    for item in classes.incidence_deg:
        middle = np.radians(0.5 * (item.low + item.high))
        assert item.sigma_m == pytest.approx(0.001 + 0.003 * middle, rel=0.1)
    sigmas = [item.sigma_m for item in classes.range_m]
    assert sigmas == sorted(sigmas)
    assert sum(item.n_points for item in classes.range_m) > 0.95 * N_POINTS
    # A viewpoint given by the user is not a station.
    cloud = cloud_of(wall(noise_m), stations=STATION, source="view_from")
    (classes,) = measured(cloud, tmp_path)[0].thickness
    assert (classes.incidence_deg, classes.range_m) == ((), ())


def test_materials_have_a_thickness_each_on_the_plane_and_along_a_row(tmp_path: Path) -> None:
    fabric = wall(0.0)[:, 0] > 0.0
    intensity = np.where(fabric, 0.2, 0.8) + np.random.default_rng(1).normal(0, 0.02, N_POINTS)
    cloud = dataclasses.replace(
        cloud_of(wall(np.where(fabric, 0.004, 0.001))),
        intensity=intensity.astype(np.float32),
        # Row 3 of the second scan has the most points.
        row=np.repeat([*range(30), 3], [2900] * 30 + [3000]).astype(np.uint32),
        scan=np.repeat([0, 1], [2900 * 30, 3000]).astype(np.uint16),
        column=np.zeros(N_POINTS, dtype=np.uint32),
    )
    names = {"fabric": (0.0, 0.5), "plaster": (0.5, 1.0)}
    planes, _ = measured(cloud, tmp_path, materials=names)
    thickness, row = planes.thickness[0], planes.scan_row
    for spreads, rel in ((thickness.material, 0.05), (row.material, 0.15)):
        assert [item.name for item in spreads] == ["fabric", "plaster"]
        assert spreads[0].sigma_m == pytest.approx(0.004, rel=rel)
        assert spreads[1].sigma_m == pytest.approx(0.001, rel=rel)
    assert (row.row, row.scan, row.n_points) == (3, 1, 3000)
    # Without scan numbers, a row is that of all scans; without rows, there is none.
    blind = dataclasses.replace(cloud, scan=None)
    assert measured(blind, tmp_path)[0].scan_row.n_points == 5900
    assert measured(dataclasses.replace(blind, row=None), tmp_path)[0].scan_row is None
    with pytest.raises(MethodError, match="omit materials"):
        measured(cloud_of(wall(0.002)), tmp_path, materials=names)


def test_materials_that_overlap_or_fall_are_refused() -> None:
    with pytest.raises(ValidationError, match=r"a must ascend between 0 and 1, got 0\.2 and 0\.2"):
        Ransac.Params(materials={"a": (0.2, 0.2)})
    with pytest.raises(ValidationError, match=r"b begin at 0\.2, but those of a end at 0\.3"):
        Ransac.Params(materials={"b": (0.2, 0.5), "a": (0.0, 0.3)})


SURVEY = (634512.347, 486215.781, 112.193)
# The planes are the wall at y = -2, and the floor.
TRIPLE: dict[str, Any] = {"points": ((-3.0, -2.0, -1.5), (3.0, -2.0, -1.5), (0.0, -2.0, 1.5))}
FAR: dict[str, Any] = {"normal": (0.0, 1.0, 0.0), "offset_m": 10.0}
TWO: tuple[dict[str, Any], ...] = (TRIPLE, {"horizontal": True, "height_m": -1.5})


def lay(cloud: PointCloud, folder: Path, **params: Any) -> Any:
    return detect(GivenPlane, cloud, folder, **params)[0]


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_given_normal_is_kept_with_its_side_and_what_is_near_is_labelled(
    side: float, tmp_path: Path
) -> None:
    points = np.vstack([sampled(), [[40.0, -2.0, 0.0], [-60.0, -2.0, 1.0], [0.0, -2.0, 50.0]]])
    stated = {"normal": (0.0, 4.0 * side, 0.0), "offset_m": -2.0 * side, "tolerance_m": 0.03}
    out = lay(cloud_of(points), tmp_path, **stated)
    np.testing.assert_array_equal(out.planes.normal[0], [0.0, side, 0.0])
    assert out.planes.offset[0] == -2.0 * side
    assert out.planes.viewpoint == "given"
    assert not out.planes.covariance.any()
    near = np.abs(points[:, 1] + 2.0) <= 0.03
    labels = out.labels.plane_index
    assert np.count_nonzero((labels == 0) != near) <= 3  # float32 offsets exactly at the limit
    assert out.planes.n_points[0] == np.count_nonzero(labels == 0)
    rms_m = np.sqrt(np.mean((points[near, 1] + 2.0) ** 2))
    assert out.planes.rms_m[0] == pytest.approx(rms_m, abs=1e-5)
    # Stray echoes do not widen the rectangle.
    assert np.abs(out.planes.corners).max() < 3.2


def test_three_points_face_the_station_or_else_the_other_points(tmp_path: Path) -> None:
    for y, side in ((1.0, 1.0), (-9.0, -1.0)):
        out = lay(cloud_of(sampled(), stations=np.array([[0.0, y, 0.0]])), tmp_path, **TRIPLE)
        np.testing.assert_allclose(out.planes.normal[0], [0.0, side, 0.0], atol=1e-12)
        assert out.planes.viewpoint == "stations"
    out, ctx = detect(GivenPlane, cloud_of(sampled()), tmp_path, **TRIPLE)
    np.testing.assert_allclose(out.planes.normal[0], [0.0, 1.0, 0.0], atol=1e-12)
    assert out.planes.viewpoint == "guess"
    assert any("view_from" in warning for warning in ctx.warnings)


def test_a_horizontal_plane_lies_below_the_scene_or_at_the_height_given(tmp_path: Path) -> None:
    planes = lay(cloud_of(sampled()), tmp_path).planes
    np.testing.assert_array_equal(planes.normal[0], [0.0, 0.0, 1.0])
    assert planes.offset[0] == pytest.approx(-1.5, abs=0.01)
    assert planes.names == ("floor 0",)
    # The front wall is inclined outwards by 1 cm.
    np.testing.assert_allclose(planes.corners[0].min(axis=0)[:2], [-3.0, -2.0], atol=0.02)
    np.testing.assert_allclose(planes.corners[0].max(axis=0)[:2], [3.0, 2.0], atol=0.02)
    cloud = cloud_of(sampled(), origin=SURVEY)
    planes = lay(cloud, tmp_path, horizontal=True, height_m=SURVEY[2] - 1.5).planes
    assert planes.offset[0] == pytest.approx(SURVEY[2] - 1.5, abs=1e-9)
    assert planes.n_points[0] >= ROOM[4].n_points
    swap = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0.0]])
    planes = lay(cloud_of(sampled() @ swap.T, up=(0.0, 1.0, 0.0)), tmp_path, horizontal=True).planes
    np.testing.assert_array_equal(planes.normal[0], [0.0, 1.0, 0.0])


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"normal": (0, 0, 1.0), "offset_m": 0.0, "horizontal": True}, "got normal and horizontal"),
        ({**TRIPLE, "height_m": 2.0}, "points and horizontal"),
        ({"normal": (0, 0, 0.0), "offset_m": 1.0}, "normal must not be"),
        ({"planes": TWO, "height_m": 2.0}, "are set: move the single"),
        ({"planes": ({"normal": (0, 0, 1.0)},)}, "normal and offset_m together, got only one"),
    ],
)
def test_contradicting_parameters_are_refused(params: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        GivenPlane.Params.model_validate(params)


def test_planes_without_points_are_refused(tmp_path: Path) -> None:
    for params, message in (
        ({"points": ((0, 0, 0), (1, 1, 1), (2, 2, 2))}, "three points that define a plane"),
        (FAR, r"no point .* within 0.15 m .* between -12.0\d\d m and"),
        ({"planes": (TRIPLE, FAR)}, r"planes\[1\]: no point of the cloud is within"),
    ):
        with pytest.raises(MethodError, match=message):
            lay(cloud_of(sampled()), tmp_path, **params)


def test_several_planes_are_those_that_each_alone_would_be(tmp_path: Path) -> None:
    cloud = cloud_of(sampled(), stations=np.array([[0.0, 1.0, 0.0]]))
    both = lay(cloud, tmp_path / "both", planes=TWO, tolerance_m=0.05)
    # Planes are ordered by the number of their points, as in all results, and the floor has more.
    assert both.planes.names == ("floor 0", "wall 1")
    for place, stated in zip((1, 0), TWO, strict=True):
        alone = lay(cloud, tmp_path, tolerance_m=0.05, **stated)
        for name in ("normal", "offset", "corners"):
            np.testing.assert_array_equal(
                getattr(both.planes, name)[place], getattr(alone.planes, name)[0], err_msg=name
            )
    assert set(both.planes.part_plane.tolist()) == {0, 1}
    labels = both.labels.plane_index
    assert both.planes.n_points.tolist() == [np.count_nonzero(labels == k) for k in (0, 1)]


@pytest.mark.parametrize(
    ("params", "right_m"),
    # The default is three tolerances, which are 15 cm and 36 cm.
    [({}, 1.0), ({"tolerance_m": 0.12}, 2.0), ({"tolerance_m": 0.12, "buffer_m": 0.2}, 1.0)],
)
def test_the_rectangle_spans_what_lies_within_the_buffer(
    params: dict[str, float], right_m: float, tmp_path: Path
) -> None:
    wall = Rectangle("wall", (0, 2, 0), (1, 0, 0), (0, 0, 1), 20_000)
    beside = Rectangle("beside", (1.5, 2.3, 0), (0.5, 0, 0), (0, 0, 1), 10_000)
    cloud = cloud_of(sampled((wall, beside)))
    three = ((0.0, 2.0, 0.0), (1.0, 2.0, 0.0), (0.0, 2.0, 1.0))
    corners = lay(cloud, tmp_path, points=three, **params).planes.corners
    assert corners[0, :, 0].max() == pytest.approx(right_m, abs=0.01)


def test_a_plan_reports_parts_that_it_leaves_out_and_takes_them_when_asked(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    ground = rng.uniform([0.0, 0.0, 0.0], [6.0, 4.0, 0.02], (60_000, 3))
    # A hut on half a per cent of the area is separate from the rest.
    hut = rng.uniform([8.0, 6.0, 0.0], [8.4, 6.3, 0.02], (400, 3))
    cloud = cloud_of(np.vstack([ground, hut, [[8.4, 6.3, 0.0]]]))
    for params, corner, n_warnings in (({}, [6.0, 4.0], 1), ({"part_min_share": 0}, [8.4, 6.3], 0)):
        out, ctx = detect(GivenPlane, cloud, tmp_path, horizontal=True, **params)
        assert out.planes.corners[0].max(axis=0)[:2] == pytest.approx(corner, abs=1e-3)
        assert len(ctx.warnings) == n_warnings
        for warning in ctx.warnings:
            assert "401 points (0.66%) are outside the rectangle of the plane" in warning
