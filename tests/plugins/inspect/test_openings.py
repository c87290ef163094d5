"""Outlines of openings against a scene whose recess is known, moved by known amounts."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.inspect import openings as inspected
from orthoflow_plugins.inspect.openings import InspectOpenings
from scipy.ndimage import maximum_filter

from orthoflow.errors import MethodError
from orthoflow.products import Inspection, Opening, Openings
from tests.raster_scenes import context
from tests.recess_scenes import DEPTH_M, GSD_M, RECESS, opening, scene


def judged(
    folder: Path, *openings: Opening, **params: float
) -> tuple[dict[str, float], Inspection]:
    truth, walls = scene()
    ctx = context(folder)
    inputs = InspectOpenings.In(
        truth=truth, walls=walls, openings=Openings(openings=openings, walls=(3,))
    )
    outputs = InspectOpenings().run(inputs, InspectOpenings.Params.model_validate(params), ctx)
    return {metric.name: metric.value for metric in ctx.metrics}, outputs.inspection


def test_the_true_outline_has_no_error(tmp_path: Path) -> None:
    numbers, inspection = judged(tmp_path, opening(scene()[1]))
    assert (numbers["n_true_openings"], numbers["n_found_openings"]) == (1, 1)
    assert (numbers["n_false_openings"], numbers["n_stray_sides"]) == (0, 0)
    assert numbers["opening_iou_mean"] == pytest.approx(1.0, abs=1e-9)
    # Rays are a sixteenth of a cell of 20 mm apart.
    assert numbers["side_max_mm"] <= 0.7
    assert numbers["opening_depth_error_max_mm"] == pytest.approx(3.0, abs=0.01)
    assert len(inspection.points_world) == 4


# The wall has 15 000 cells; of the raster, two by two are one.
@pytest.mark.parametrize(("n_told", "apart"), [(15_000, 0.0), (4_000, 0.05)])
def test_large_walls_are_judged_in_coarser_cells_but_sides_as_exactly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, n_told: int, apart: float
) -> None:
    walls = scene()[1]
    found = opening(walls, outwards_m=0.03), opening(walls, right_m=0.9)
    whole, inspection = judged(tmp_path, *found)
    monkeypatch.setattr(inspected, "_CELLS_TOLD", n_told)
    coarse, again = judged(tmp_path, *found)
    np.testing.assert_array_equal(again.displacement_m, inspection.displacement_m)
    np.testing.assert_array_equal(again.points_world, inspection.points_world)
    for name in ("opening_iou_mean", "opening_iou_min"):
        assert coarse.pop(name) == pytest.approx(whole.pop(name), abs=apart)
    assert coarse == pytest.approx(whole, abs=1e-9)


def test_a_large_wall_takes_the_memory_of_the_cells_that_it_is_looked_at_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth, walls = scene()
    (wall,) = walls.walls
    found = opening(walls, outwards_m=0.03)
    rows, columns = 20 * wall.frame.height, 20 * wall.frame.width
    frame = replace(wall.frame, gsd_m=GSD_M / 20, width=columns, height=rows)
    nothing = np.broadcast_to(np.float32(0.0), frame.shape)
    large = replace(
        wall,
        frame=frame,
        depth_m=nothing,
        sigma_m=nothing,
        count=np.broadcast_to(np.uint32(1), frame.shape),
        mask=np.broadcast_to(np.uint8(1), frame.shape),
    )
    monkeypatch.setattr(inspected, "_CELLS_TOLD", 15_000)
    inputs = InspectOpenings.In(
        truth=truth,
        walls=replace(walls, walls=(large,)),
        openings=Openings(openings=(found,), walls=(3,)),
    )
    ctx = context(tmp_path)
    InspectOpenings().run(inputs, InspectOpenings.Params(), ctx)
    tracemalloc.start()
    try:
        InspectOpenings().run(inputs, InspectOpenings.Params(), context(tmp_path))
        assert tracemalloc.get_traced_memory()[1] < rows * columns
    finally:
        tracemalloc.stop()
    numbers = {metric.name: metric.value for metric in ctx.metrics}
    # Ten cells of a millimetre do not reach an outline that is three centimetres off.
    assert (numbers["n_found_openings"], numbers["n_stray_sides"]) == (1, 4)


@pytest.mark.parametrize("outwards_m", [0.03, -0.05])
def test_an_outline_that_is_too_large_or_small_is_so_in_every_side(
    tmp_path: Path, outwards_m: float
) -> None:
    numbers, _ = judged(tmp_path, opening(scene()[1], outwards_m=outwards_m))
    assert numbers["side_mean_mm"] == pytest.approx(1e3 * outwards_m, abs=0.7)
    assert numbers["side_rmse_mm"] == pytest.approx(1e3 * abs(outwards_m), abs=0.7)
    assert numbers["side_rmse_cells"] == pytest.approx(abs(outwards_m) / GSD_M, abs=0.04)
    assert numbers["side_error_over_sigma"] == pytest.approx(1e3 * abs(outwards_m), abs=0.7)
    assert 0.8 < numbers["opening_iou_min"] < 0.95


def test_a_shift_moves_upright_sides_alike_and_level_ones_not(tmp_path: Path) -> None:
    _, inspection = judged(tmp_path, opening(scene()[1], right_m=0.04))
    shifts = np.round(1e3 * inspection.displacement_m)
    upright: NDArray[np.bool_] = np.abs(shifts[:, 0]) > 1
    np.testing.assert_allclose(shifts[upright], [[40, 0], [40, 0]], atol=1.0)
    np.testing.assert_allclose(shifts[~upright], 0.0, atol=1.0)


def test_sides_that_nobody_saw_are_not_judged(tmp_path: Path) -> None:
    moved = opening(scene()[1], right_m=0.04, unseen=0)
    assert len(judged(tmp_path, moved)[1].wall) == 3


def test_outlines_elsewhere_are_false_and_what_is_missing_counts_nothing(tmp_path: Path) -> None:
    numbers, _ = judged(tmp_path, opening(scene()[1], right_m=0.9))
    assert (numbers["n_false_openings"], numbers["n_found_openings"]) == (1, 0)
    assert numbers["opening_iou_min"] == 0.0
    assert "side_rmse_mm" not in numbers
    none, _ = judged(tmp_path)
    assert (none["n_true_openings"], none["n_found_openings"]) == (1, 0)


def test_openings_of_other_walls_are_refused(tmp_path: Path) -> None:
    truth, walls = scene()
    inputs = InspectOpenings.In(
        truth=truth, walls=walls, openings=Openings(openings=(), walls=(7,))
    )
    with pytest.raises(MethodError, match="openings of wall 7 are given, but the walls are 3"):
        InspectOpenings().run(inputs, InspectOpenings.Params(), context(tmp_path))


# Of the recess, 0.8 m by 1.22 m.
WIDTH_M, HEIGHT_M = RECESS[1] - RECESS[0], RECESS[3] - RECESS[2]


@pytest.mark.parametrize(
    ("params", "n_true"),
    [
        ({"behind_m": 0.19}, 1),
        ({"behind_m": 0.21}, 0),
        ({"area_least_m2": 0.95}, 1),
        ({"area_least_m2": 1.0}, 0),
    ],
    ids=str,
)
def test_recesses_that_are_too_shallow_or_small_are_not_asked_for(
    tmp_path: Path, params: dict[str, float], n_true: int
) -> None:
    numbers, _ = judged(tmp_path, opening(scene()[1]), **params)
    assert numbers["n_true_openings"] == numbers["n_found_openings"] == n_true
    assert numbers["n_false_openings"] == 1 - n_true


@pytest.mark.parametrize(("right_m", "is_found"), [(0.24, True), (0.29, False), (-0.24, True)])
def test_an_outline_is_of_what_it_shares_half_of_its_area_with(
    tmp_path: Path, right_m: float, is_found: bool
) -> None:
    numbers, _ = judged(tmp_path, opening(scene()[1], right_m=right_m))
    shared = (WIDTH_M - abs(right_m)) / (WIDTH_M + abs(right_m))
    assert numbers["opening_iou_min"] == pytest.approx(shared if is_found else 0.0, abs=0.02)
    assert (numbers["n_found_openings"], numbers["n_false_openings"]) == (is_found, not is_found)


@pytest.mark.parametrize(("right_m", "n_stray"), [(0.19, 0), (0.21, 2), (-0.21, 2)])
def test_sides_ten_cells_from_any_border_are_astray(
    tmp_path: Path, right_m: float, n_stray: int
) -> None:
    numbers, inspection = judged(tmp_path, opening(scene()[1], right_m=right_m))
    assert numbers["n_stray_sides"] == n_stray
    assert len(inspection.wall) == 4 - n_stray
    expected = 0.0 if n_stray else 1e3 * abs(right_m)
    assert numbers["side_max_mm"] == pytest.approx(expected, abs=0.7)


@pytest.mark.parametrize("stated_m", [0.15, 0.26])
def test_a_depth_is_judged_from_the_face(tmp_path: Path, stated_m: float) -> None:
    stated = replace(opening(scene()[1]), depth_m=stated_m)
    numbers, _ = judged(tmp_path, stated)
    expected = 1e3 * abs(stated_m - DEPTH_M)
    assert numbers["opening_depth_error_max_mm"] == pytest.approx(expected, abs=0.01)
    none, _ = judged(tmp_path, replace(stated, depth_m=None))
    assert "opening_depth_error_max_mm" not in none
    worst, _ = judged(tmp_path, opening(scene()[1]), stated)
    assert worst["opening_depth_error_max_mm"] == pytest.approx(expected, abs=0.01)


def test_of_two_outlines_of_one_recess_the_better_one_counts(tmp_path: Path) -> None:
    walls = scene()[1]
    worse, better = opening(walls, outwards_m=0.08), opening(walls, outwards_m=0.02)
    for order in ((worse, better), (better, worse)):
        numbers, inspection = judged(tmp_path, *order)
        size = (WIDTH_M + 0.04) * (HEIGHT_M + 0.04)
        assert numbers["opening_iou_mean"] == pytest.approx(WIDTH_M * HEIGHT_M / size, abs=0.02)
        assert (numbers["n_found_openings"], numbers["n_false_openings"]) == (1, 0)
        assert len(inspection.wall) == 8
        assert numbers["side_mean_mm"] == pytest.approx(50.0, abs=0.7)
        assert numbers["side_rmse_mm"] == pytest.approx(np.hypot(80.0, 20.0) / 2**0.5, abs=0.7)
        assert numbers["side_max_mm"] == pytest.approx(80.0, abs=0.7)


def test_an_arrow_stands_in_the_middle_of_its_side_and_points_outwards(tmp_path: Path) -> None:
    walls = scene()[1]
    moved = opening(walls, outwards_m=0.05)
    _, inspection = judged(tmp_path, moved)
    corners = moved.outline_world
    middles = 0.5 * (corners + np.roll(corners, -1, axis=0))
    np.testing.assert_allclose(inspection.points_world, middles, atol=1e-9)
    assert inspection.wall.tolist() == [0, 0, 0, 0]
    # u to the right and v downwards; from the top left corner down, and so on.
    outwards = np.array([[-1.0, 0.0], [0.0, 1.0], [1.0, 0.0], [0.0, -1.0]])
    np.testing.assert_allclose(inspection.displacement_m, 0.05 * outwards, atol=1e-3)


def areas(*blocks: tuple[slice, slice], n_face: int = 96, n_least: float = 0.0) -> Any:
    """Numbers of open areas of a wall whose face is so many of the cells within two of them."""
    is_open = np.zeros((40, 50), dtype=np.bool_)
    for block in blocks:
        is_open[block] = True
    near = np.asarray(maximum_filter(is_open, size=5)) & ~is_open
    is_face = np.zeros_like(is_open)
    is_face.flat[np.flatnonzero(near)[:n_face]] = True
    return inspected._labelled(is_open, is_face, n_least)


TEN_BY_TEN = np.s_[12:22, 20:30]


@pytest.mark.parametrize(("n_face", "is_opening"), [(49, True), (47, False)])
def test_half_of_what_is_about_an_opening_is_the_face_of_its_wall(
    n_face: int, is_opening: bool
) -> None:
    assert areas(TEN_BY_TEN, n_face=n_face).max() == is_opening


def test_openings_are_numbered_and_small_areas_are_none() -> None:
    other = np.s_[0:5, 0:20]
    labels = areas(TEN_BY_TEN, other, np.s_[30:33, 40:43], n_face=2000, n_least=100.0)
    assert np.unique(labels).tolist() == [0, 1, 2]
    assert len(np.unique(labels[TEN_BY_TEN])) == len(np.unique(labels[other])) == 1
    assert np.count_nonzero(labels) == 200


def side_error(is_open: Callable[[Any, Any], Any]) -> float | None:
    """Error in cells of a level side of a hundred, by what is open at a column and a row."""
    wall: Any = SimpleNamespace(
        frame=scene()[1].walls[0].frame,
        depths_m=lambda places: np.where(is_open(*places.T), -0.2, np.nan),
    )
    found = inspected._side_error(wall, np.array([0.0, 0.0]), np.array([100.0, 0.0]))
    return None if found is None else found[2] / GSD_M


def test_the_border_nearest_to_a_side_is_its_own_to_half_a_step() -> None:
    border = 3.0 + 1.0 / 32.0
    assert side_error(lambda _, row: row < border) == pytest.approx(-border, abs=1e-9)
    twice = side_error(lambda _, row: (row < -border) | ((row > 0.0) & (row < 5.0)))
    assert twice == pytest.approx(border, abs=1e-9)


@pytest.mark.parametrize(("end", "is_judged"), [(70.0, True), (60.0, False)])
def test_a_border_lies_along_half_of_a_side_without_its_ends(end: float, is_judged: bool) -> None:
    # A tenth at either end does not count; of the rest 0.56 or 0.44 have a border.
    found = side_error(
        lambda column, row: (row < 2.0) & ((np.abs(column - 50.0) > 30.0) | (column > 45.0))
        & ((column < end) | (column > 80.0))
    )  # fmt: skip
    assert (found is not None) == is_judged


def test_a_side_without_length_has_no_error() -> None:
    wall: Any = None
    assert inspected._side_error(wall, np.ones(2), np.ones(2)) is None
