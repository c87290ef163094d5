"""Stated planes over a cloud: from which side they are seen, what is told of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.reference import (
    Reference,
    lay_references,
    place_reference,
    prepare_for_references,
)

from orthoflow.geometry import Plane
from orthoflow.products import PointCloud
from tests.plane_scenes import cloud_of, context

ORIGIN = (100.0, 200.0, 30.0)
# At y = 2, its normal to the south.
WALL = Plane(normal=np.array([0.0, -1.0, 0.0]), offset_m=-2.0)
ROOF = Plane(normal=np.array([0.0, 0.0, 1.0]), offset_m=1.5)


def evenly(low: list[float], high: list[float], count: int) -> NDArray[np.float64]:
    points = np.random.default_rng(count).uniform(low, high, (count, 3))
    points[0], points[-1] = low, high
    return points


# 4 x 2 m.
ON_WALL = evenly([-2.0, 2.0, -1.0], [2.0, 2.0, 1.0], 4_000)
ON_ROOF = evenly([-2.0, 3.0, 1.5], [2.0, 5.0, 1.5], 6_000)


def placed(cloud: PointCloud, plane: Plane = WALL, **changes: object) -> Reference:
    found = found_or_none(cloud, plane, **changes)
    assert found is not None
    return found


def found_or_none(cloud: PointCloud, plane: Plane = WALL, **changes: object) -> Reference | None:
    asked = {"buffer_m": 0.15, "keeps_side": False, **changes}
    prepared = prepare_for_references(cloud, parts=1)
    return place_reference(plane, cloud, prepared, **asked)  # type: ignore[arg-type]


def cloud(*extra: list[float], stations: list[list[float]] | None = None) -> PointCloud:
    points = np.vstack([ON_WALL, *(np.array([point]) for point in extra)])
    return cloud_of(
        points, origin=ORIGIN, stations=None if stations is None else np.array(stations)
    )


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_plane_is_turned_to_its_stations_unless_its_side_is_kept(side: float) -> None:
    seen = cloud([0.0, 0.0, 0.0], stations=[[0.0, 2.0 - side, 0.0]])
    turned = placed(seen)
    np.testing.assert_array_equal(turned.plane.normal, [0.0, -side, 0.0])
    assert turned.plane.offset_m == -2.0 * side
    assert turned.viewpoint == "stations"
    assert placed(replace(seen, stations_source="view_from")).viewpoint == "view_from"
    kept = placed(seen, keeps_side=True)
    assert (kept.plane, kept.viewpoint) == (WALL, "given")
    # Top-left first, counter-clockwise for whoever looks at it.
    x = -2.0 * side
    expected = [[x, 2.0, 1.0], [x, 2.0, -1.0], [-x, 2.0, -1.0], [-x, 2.0, 1.0]]
    np.testing.assert_allclose(turned.corners_m, expected, atol=1e-6)
    np.testing.assert_allclose(turned.part_corners_m, [expected], atol=1e-6)


def test_the_scans_of_the_points_near_a_plane_tell_its_side() -> None:
    far = evenly([-2.0, 0.0, -1.0], [2.0, 1.0, 1.0], 9_000)
    points = np.vstack([ON_WALL, far])
    scan = np.repeat(np.array([1, 0], dtype=np.uint16), [len(ON_WALL), len(far)])
    # The first, which most points are of, is the nearer one too.
    stations = np.array([[0.0, 1.0, 0.0], [0.0, 9.0, 0.0]])
    seen = replace(cloud_of(points, stations=stations), scan=scan)
    np.testing.assert_array_equal(placed(seen).plane.normal, [0.0, 1.0, 0.0])


def test_what_is_as_near_as_a_third_of_the_buffer_says_nothing_of_a_side() -> None:
    relief = [[0.01 * k, 2.09, 0.0] for k in range(-99, 100)]
    guessed = placed(cloud(*relief, [0.0, 1.2, 0.0]), buffer_m=0.3)
    assert guessed.viewpoint == "guess"
    np.testing.assert_array_equal(guessed.plane.normal, [0.0, -1.0, 0.0])
    # Beyond a third they say so.
    guessed = placed(cloud(*relief, [0.0, 1.2, 0.0]), buffer_m=0.24)
    np.testing.assert_array_equal(guessed.plane.normal, [0.0, 1.0, 0.0])


def test_where_no_point_is_near_nothing_is_placed() -> None:
    away = Plane(normal=WALL.normal, offset_m=-9.0)
    assert found_or_none(cloud([0.0, 0.0, 0.0]), away) is None


def test_without_a_buffer_all_points_span_the_rectangle() -> None:
    # A metre before the wall, and further to the right.
    front = evenly([2.0, 1.0, -1.0], [3.0, 1.0, 0.5], 2_000)
    points = np.vstack([ON_WALL, front])
    whole = placed(cloud_of(points), buffer_m=None, keeps_side=True)
    np.testing.assert_allclose(whole.corners_m.max(axis=0), [3.0, 2.0, 1.0], atol=1e-6)
    assert whole.n_beside == 0
    near = placed(cloud_of(points), keeps_side=True)
    np.testing.assert_allclose(near.corners_m.max(axis=0), [2.0, 2.0, 1.0], atol=1e-6)


@pytest.mark.parametrize("buffer_m", [None, 5.0])
def test_points_beside_the_rectangle_are_counted_where_all_could_span_it(
    buffer_m: float | None,
) -> None:
    # Few echoes two metres off.
    echoes = evenly([4.0, 2.0, 0.0], [4.2, 2.0, 0.1], 7)
    reference = placed(cloud_of(np.vstack([ON_WALL, echoes])), buffer_m=buffer_m, keeps_side=True)
    np.testing.assert_allclose(reference.corners_m.max(axis=0), [2.0, 2.0, 1.0], atol=1e-6)
    assert reference.n_beside == (7 if buffer_m is None else 0)


def test_planes_are_laid_by_their_points_and_told_of(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    rough = ON_ROOF + np.array([0.0, 0.0, 0.003]) * rng.choice([-1.0, 1.0], (len(ON_ROOF), 1))
    points = np.vstack([ON_WALL, rough, evenly([-2.0, 0.0, 0.0], [2.0, 1.0, 0.5], 1_000)])
    seen = cloud_of(points, origin=ORIGIN)
    prepared = prepare_for_references(seen, parts=2)
    references = [
        placed(seen, keeps_side=True),
        placed(seen, ROOF, keeps_side=True),
    ]
    labels = np.empty(len(points), dtype=np.int16)
    ctx = context(tmp_path)
    planes = lay_references(references, seen, prepared, labels, tolerance_m=0.05, ctx=ctx)
    np.testing.assert_array_equal(labels, np.repeat([1, 0, -1], [4_000, 6_000, 1_000]))
    assert planes.names == ("floor 0", "wall 1")
    np.testing.assert_array_equal(planes.normal, [[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    np.testing.assert_allclose(planes.offset, [31.5, -202.0])
    np.testing.assert_array_equal(planes.n_points, [6_000, 4_000])
    np.testing.assert_allclose(planes.rms_m, [0.003, 0.0], atol=1e-5)
    assert planes.viewpoint == "given"
    assert planes.tolerance_m == 0.05
    assert planes.part_plane is not None
    np.testing.assert_array_equal(planes.part_plane, [0, 1])
    np.testing.assert_allclose(
        planes.corners[1],
        np.array(ORIGIN) + np.array([[-2, 2, 1], [-2, 2, -1], [2, 2, -1], [2, 2, 1]]),
        atol=1e-5,
    )
    np.testing.assert_array_equal(planes.part_corners, planes.corners)
    assert not planes.covariance.any()
    told = {metric.name: (metric.value, metric.unit) for metric in ctx.metrics}
    assert told["n_planes"] == (2, "1")
    assert told["labelled_share"] == (pytest.approx(10 / 11), "1")
    assert told["rms_mm"] == (pytest.approx(3.0, abs=0.01), "mm")
    assert told["phi_deg"] == (pytest.approx(90.0), "deg")
    assert told["offset_m"] == (pytest.approx(31.5), "m")
    assert list(ctx.warnings) == []


def test_one_guessed_side_makes_all_of_them_a_guess(tmp_path: Path) -> None:
    points = np.vstack([ON_WALL, ON_ROOF, [[0.0, 0.0, 0.0]]])
    seen = cloud_of(points)
    prepared = prepare_for_references(seen, parts=1)
    references = [placed(seen, ROOF, keeps_side=True), placed(seen)]
    labels = np.empty(len(points), dtype=np.int16)
    ctx = context(tmp_path)
    planes = lay_references(references, seen, prepared, labels, tolerance_m=0.05, ctx=ctx)
    assert planes.viewpoint == "guess"
    (warning,) = ctx.warnings
    assert "no scanner station says from which side 1 of 2 planes were seen" in warning


def test_a_point_near_two_planes_is_of_the_nearer(tmp_path: Path) -> None:
    slope = Plane(normal=np.array([0.0, -0.6, 0.8]), offset_m=-1.2)
    # Both planes meet at y = 2, z = 0; points between them.
    rng = np.random.default_rng(6)
    between = rng.uniform([-2.0, 1.97, -0.03], [2.0, 2.03, 0.03], (500, 3))
    away = np.abs(between - [0.0, 2.0, 0.0]) @ np.diag([0.0, 1.0, 1.0])
    assert away.max() < 0.05
    on_slope = np.column_stack(
        [rng.uniform(-2, 2, 3_000), np.zeros(3_000), rng.uniform(-1, -0.1, 3_000)]
    )
    on_slope[:, 1] = 2.0 + on_slope[:, 2] * 0.8 / 0.6
    seen = cloud_of(np.vstack([ON_WALL, on_slope, between]))
    prepared = prepare_for_references(seen, parts=1)
    references = [placed(seen, keeps_side=True), placed(seen, slope, keeps_side=True)]
    labels = np.empty(len(ON_WALL) + 3_500, dtype=np.int16)
    ctx = context(tmp_path)
    planes = lay_references(references, seen, prepared, labels, tolerance_m=0.05, ctx=ctx)
    assert planes.names == ("wall 0", "slope 1")
    to_wall = np.abs(WALL.distances_m(between))
    to_slope = np.abs(slope.distances_m(between))
    clear = np.abs(to_wall - to_slope) > 1e-5
    expected = (to_slope < to_wall).astype(np.int16)
    np.testing.assert_array_equal(labels[-500:][clear], expected[clear])
    assert 100 < expected.sum() < 400
