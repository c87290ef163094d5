"""When a candidate is a plane: how it may lean, what may change, strips, smears and barrels."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.plane import candidates
from orthoflow_plugins.plane.candidates import Candidate, Family, FoundPlane, Rules
from orthoflow_plugins.plane.sample import Unassigned, prepare
from orthoflow_plugins.plane.support import SurfaceRaster

from orthoflow.geometry import Plane
from tests.plane_scenes import cloud_of

UP = np.array([0.0, 0.0, 1.0])


def rules(*, is_exact: bool = True, tilt_most_deg: float = 10.0) -> Rules:
    return Rules(
        find_m=0.05,
        fit_m=0.015,
        n_planes_most=10,
        least_share=0.1,
        stop_unclassified_share=0.05,
        tilt_most_deg=tilt_most_deg,
        stop_rest_share=0.0,
        is_exact=is_exact,
        joins_parts=True,
    )


def candidate(tilt_deg: float, family: Family = "any") -> Candidate:
    """A plane whose normal rises by so much above the horizon."""
    turn = math.radians(tilt_deg)
    normal = np.array([math.cos(turn), 0.0, math.sin(turn)])
    return Candidate(plane=Plane(normal=normal, offset_m=1.0), family=family, votes=1.0)


@pytest.mark.parametrize(
    ("tilt_deg", "family", "freedom"),
    [
        (0.0, "any", "vertical"),
        (-9.9, "any", "vertical"),
        (10.1, "any", "free"),
        (45.0, "wall", "vertical"),
        (79.9, "any", "free"),
        (80.1, "level", "level"),
        (-90.0, "any", "level"),
    ],
)
def test_exact_fits_keep_walls_upright_and_floors_level(
    tilt_deg: float, family: Family, freedom: str
) -> None:
    of = candidate(tilt_deg, family)
    assert candidates._freedom_of(of, UP, rules()) == freedom
    assert candidates._freedom_of(of, UP, rules(is_exact=False)) == "free"


@pytest.mark.parametrize(
    ("tilt_deg", "family", "leans_little"),
    [
        (9.9, "wall", True),
        (-9.9, "wall", True),
        (10.1, "wall", False),
        (80.1, "level", True),
        (-80.1, "level", True),
        (79.9, "level", False),
        (0.0, "level", False),
        (45.0, "any", True),
    ],
)
def test_a_refined_plane_leans_no_more_than_allowed(
    tilt_deg: float, family: Family, leans_little: bool
) -> None:
    refined: Any = SimpleNamespace(plane=candidate(tilt_deg).plane)
    found = candidates._leans_little(refined, candidate(0.0, family), UP, rules())
    assert found is leans_little


def raster(cell_m: float = 0.1) -> SurfaceRaster:
    return SurfaceRaster(
        plane=Plane(normal=UP, offset_m=1.0),
        axes=np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
        low_m=np.array([2.0, -1.0]),
        cell_m=cell_m,
        shape=(20, 30),
    )


@pytest.mark.parametrize(
    ("bounds_m", "is_strip"),
    [
        ([2.0, 2.26, -1.0, 1.0], False),
        ([2.0, 2.24, -1.0, 1.0], True),
        ([2.0, 5.0, 0.0, 0.26], False),
        ([2.0, 5.0, 0.0, 0.24], True),
    ],
)
def test_cells_narrower_than_two_and_a_half_are_a_strip(
    bounds_m: list[float], is_strip: bool
) -> None:
    place: Any = SimpleNamespace(bounds_m=np.array(bounds_m))
    assert candidates._is_strip(place, raster()) is is_strip


@pytest.mark.parametrize(("n_points", "is_smear"), [(50, False), (49, True)])
def test_half_of_the_points_in_the_rectangle_must_crowd(n_points: int, is_smear: bool) -> None:
    n_find = np.ones((20, 30), dtype=np.int64)
    # Ten by ten cells of one point each have their centres inside.
    place: Any = SimpleNamespace(bounds_m=np.array([2.5, 3.5, -0.5, 0.5]), n_points=n_points)
    sums: Any = SimpleNamespace(n_find=n_find)
    assert candidates._is_smear(place, raster(), sums) is is_smear


@pytest.mark.parametrize(
    ("radius_m", "share", "is_bent"),
    [(4.9, 0.6, True), (5.1, 0.6, False), (4.9, 0.4, False), (1.0, 0.51, True)],
)
def test_a_barrel_of_less_than_five_metres_that_shows_is_no_plane(
    radius_m: float, share: float, is_bent: bool
) -> None:
    adjusted: Any = SimpleNamespace(bend_per_m=1.0 / radius_m, bend_share=share)
    assert candidates._is_bent(adjusted) is is_bent


@pytest.mark.parametrize(("n_points", "n_kept"), [(10, 10), (19, 19), (20, 10), (35, 12)])
def test_many_points_are_thinned_to_about_so_many(n_points: int, n_kept: int) -> None:
    points = np.arange(3.0 * n_points).reshape(-1, 3)
    thinned = candidates._thinned(points, 10)
    assert len(thinned) == n_kept
    np.testing.assert_array_equal(thinned[0], points[0])


def test_the_spread_leaves_out_two_percent_at_either_end() -> None:
    placed = np.column_stack([np.arange(101.0), 10.0 * np.arange(101.0)])
    np.testing.assert_allclose(candidates._spread(placed), [[2.0, 20.0], [98.0, 980.0]])


def test_points_lie_in_the_cells_that_they_project_to() -> None:
    cells = np.zeros((20, 30), dtype=np.bool_)
    cells[3, 7] = cells[0, 0] = cells[19, 29] = True
    points = np.array(
        [
            [2.75, -0.65, 9.0],
            [2.65, -0.65, 1.0],
            [2.75, -0.55, 1.0],
            # Beyond the raster the outermost cell holds.
            [-9.0, -9.0, 0.0],
            [9.0, 9.0, 0.0],
        ]
    )
    inside = candidates._inside(points, raster(), cells)
    assert inside.tolist() == [True, False, False, True, True]


def found(normal: np.ndarray) -> FoundPlane:
    support: Any = SimpleNamespace(bounds_m=np.array([2.0, 5.0, -1.0, 1.0]))
    return FoundPlane(
        raster=raster(),
        support=support,
        adjusted=SimpleNamespace(),  # type: ignore[arg-type]
        candidate=Candidate(plane=Plane(normal=normal, offset_m=0.9), family="level", votes=1.0),
        freedom="free",
    )


def test_a_plane_claims_its_rectangle_and_a_tolerance_around() -> None:
    item = found(UP)
    np.testing.assert_allclose(item.label_bounds(0.05), [0.05, 1.95, 5.05, -1.05, 1.05])
    claim = item.claim(0.05)
    np.testing.assert_allclose(claim.bounds_m, [0.05, 1.95, 5.05, -1.05, 1.05])
    np.testing.assert_array_equal(claim.slab[:4], [0.0, 0.0, 1.0, 1.0])


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_plane_is_given_back_as_proposed_on_the_side_it_was_found(sign: float) -> None:
    item = candidates.as_proposed(found(sign * UP), UP)
    np.testing.assert_array_equal(item.raster.plane.normal, UP)
    assert item.raster.plane.offset_m == 0.9 * sign
    assert (item.raster.cell_m, item.raster.shape) == (0.1, (20, 30))
    np.testing.assert_array_equal(item.raster.low_m, [2.0, -1.0])


@pytest.mark.parametrize("step_m", [0.0, 0.03])
def test_parts_at_other_depths_do_not_pull_a_plane_askew(step_m: float) -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform([2.0, -1.0, 0.0], [5.0, 1.0, 0.0], (4000, 3))
    points = points[(points[:, 0] < 3.5) | (points[:, 0] > 4.0)]
    points[:, 2] = 1.0 + 0.001 * rng.normal(size=len(points))
    points[points[:, 0] > 4.0, 2] += step_m
    cells = np.ones((20, 30), dtype=np.bool_)
    part = np.zeros((20, 30), dtype=np.int64)
    part[:, 20:] = 1
    place: Any = SimpleNamespace(cells=cells, part_of_cell=part, parts_m=np.zeros((2, 4)))
    lean = Plane(
        normal=np.array([-step_m / 2, 0.0, 1.0]) / math.hypot(step_m / 2, 1.0),
        offset_m=1.0 - 2.75 * step_m / 2,
    )
    fitted = candidates._fitted_to_parts(lean, points, raster(), place, (0.05, 0.05), "free", UP)
    assert fitted is not None
    # The larger part lies at 1 m; alone it is fitted as it lies.
    largest = points[points[:, 0] < 3.5]
    assert np.median(np.abs(fitted.distances_m(largest))) < 0.0009
    beyond_m = abs(float(fitted.distances_m(np.array([[4.5, 0.0, 1.0]]))[0]))
    assert beyond_m < 0.001


def free_wall(n_points: int) -> Unassigned:
    """A wall of 4 x 2 m at y = 2, and as many points far behind it."""
    rng = np.random.default_rng(3)
    wall = rng.uniform([-2.0, 2.0, -1.0], [2.0, 2.0, 1.0], (n_points, 3))
    wall[:, 1] += rng.normal(0.0, 0.002, n_points)
    far = rng.uniform([-2.0, 7.0, -1.0], [2.0, 9.0, 1.0], (n_points, 3))
    points = np.vstack([wall, far])
    return Unassigned.of(
        prepare(cloud_of(points), np.eye(3), cell_m=0.5, least_share=0.01, parts=1)
    )


@pytest.mark.parametrize("offset_m", [2.0, 2.03, 4.5, 20.0])
def test_a_candidate_is_a_plane_where_there_are_points(offset_m: float) -> None:
    along_y = np.array([0.0, 1.0, 0.0])
    proposed = Candidate(plane=Plane(normal=along_y, offset_m=offset_m), family="wall", votes=1.0)
    item = candidates.verify(proposed, free_wall(3_000), rules(is_exact=False))
    assert (item is not None) == (offset_m < 3.0)
    if item is not None:
        assert item.candidate is proposed
        assert abs(float(item.raster.plane.offset_m)) == pytest.approx(2.0, abs=2e-4)
        np.testing.assert_allclose(
            item.support.bounds_m[1] - item.support.bounds_m[0], 4.0, atol=0.5
        )


@pytest.mark.parametrize(("least_share", "is_plane"), [(0.45, True), (0.55, False)])
def test_a_plane_holds_its_share_of_all_points(least_share: float, is_plane: bool) -> None:
    proposed = Candidate(
        plane=Plane(normal=np.array([0.0, 1.0, 0.0]), offset_m=2.0), family="wall", votes=1.0
    )
    asked = replace(rules(is_exact=False), least_share=least_share)
    assert (candidates.verify(proposed, free_wall(3_000), asked) is not None) is is_plane


def test_without_points_near_a_plane_cells_are_those_of_the_tolerance() -> None:
    left = free_wall(500)
    away = Plane(normal=np.array([0.0, 1.0, 0.0]), offset_m=-3.0)
    sums, found = candidates._cells_near(np.zeros((0, 3)), away, left, rules())
    assert not sums.n_find.any()
    assert found.cell_m == 0.05


def test_without_its_largest_part_no_plane_is_fitted() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform([4.0, -1.0, 1.0], [5.0, 1.0, 1.0], (400, 3))
    part = np.zeros((20, 30), dtype=np.int64)
    part[:, 20:] = 1
    cells = np.ones((20, 30), dtype=np.bool_)
    place: Any = SimpleNamespace(cells=cells, part_of_cell=part, parts_m=np.zeros((2, 4)))
    start = Plane(normal=UP, offset_m=1.0)

    def fitted() -> Plane | None:
        return candidates._fitted_to_parts(start, points, raster(), place, (0.05, 0.05), "free", UP)

    assert fitted() is None
    # All of it is one part.
    place.parts_m = np.zeros((1, 4))
    assert fitted() is not None
