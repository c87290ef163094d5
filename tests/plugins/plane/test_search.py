"""Processing of candidates: fits, cells and parts, criteria, labels and predicted errors."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.fit import (
    AdjustedPlane,
    FoundPlane,
    adjust_plane,
    independent_covariance,
    jackknife_covariance,
)
from orthoflow_plugins.plane.hough2d import Hough2d
from orthoflow_plugins.plane.kernels import STEPS_PER_TOLERANCE
from orthoflow_plugins.plane.proposing import Candidate, Constraint, Proposer
from orthoflow_plugins.plane.search import (
    CRITERIA,
    Criterion,
    Search,
    find_planes,
    fit_to_all,
    greedy_search,
    label,
    verify,
)
from orthoflow_plugins.plane.support import CellSums, SurfaceRaster, crowded_cells, support_of
from scipy import ndimage

from orthoflow.errors import MethodError
from orthoflow.geometry import Plane, angle_between_deg, wall_axes
from tests.plane_scenes import (
    ROOM,
    Rectangle,
    cloud_of,
    detect,
    prepared,
    sampled,
    search_in,
)

ALONG_Y = (0.0, 1.0, 0.0)
FAR = Rectangle("far", (0, 9, 0), (2, 0, 0), (0, 1, 1), 6_000)
WEST = Rectangle("west", (-2, 0, 0), (0, 2, 0), (0, 0, 1), 10_000)


def proposed(
    normal: tuple[float, float, float], offset_m: float, constraint: Constraint = "any"
) -> Candidate:
    unit = np.array(normal) / np.linalg.norm(normal)
    return Candidate(plane=Plane(normal=unit, offset_m=offset_m), constraint=constraint)


def surface(truth: Rectangle) -> Candidate:
    return proposed(tuple(truth.normal), float(truth.normal @ np.array(truth.centre)))


def wall(n_points: int = 8_000, *, half_m: tuple[float, float] = (2.0, 1.0)) -> Rectangle:
    """Return an upright wall at y = 2."""
    return Rectangle("wall", (0, 2, 0), (half_m[0], 0, 0), (0, 0, half_m[1]), n_points)


def barrel(radius_m: float) -> NDArray[np.float64]:
    """Return an arc of 1.2 m of an upright cylinder whose nearest line is at y = 2."""
    rng = np.random.default_rng(2)
    turn = rng.uniform(-0.6, 0.6, 8_000) / radius_m
    x, y = radius_m * np.sin(turn), 2.0 + radius_m * (1.0 - np.cos(turn))
    return np.column_stack([x, y + rng.normal(0.0, 0.001, 8_000), rng.uniform(-1.0, 1.0, 8_000)])


def filled_slab() -> NDArray[np.float64]:
    return np.random.default_rng(3).uniform([-2.0, 1.8, -1.0], [2.0, 2.2, 1.0], (8_000, 3))


STOOL = Rectangle("stool", (1, -0.5, -0.7), (0.25, 0, 0), (0, 0.25, 0), 2_500)
RAMP = Rectangle("ramp", (0, 2, 0), (2, 0, 0), (0, 0.3, 1), 8_000)


def crowd_in_a_slab() -> NDArray[np.float64]:
    """Return an evenly filled slab whose middle third is a wall."""
    rng = np.random.default_rng(4)
    thin = rng.uniform([-0.7, 1.999, -1.0], [0.7, 2.001, 1.0], (4_000, 3))
    corners = rng.uniform([-2.0, 1.9, -1.0], [2.0, 2.1, 1.0], (60_000, 3))
    corners = corners[np.abs(corners[:, 0]) > 0.7]
    ends = rng.uniform([-2.0, 1.999, -1.0], [2.0, 2.001, -0.85], (4_000, 3))
    return np.concatenate([thin, corners, ends])


@pytest.mark.parametrize(
    ("points", "candidate", "params", "criterion"),
    [
        (sampled((wall(), FAR)), proposed(ALONG_Y, 5.0), {}, "scattered"),
        (sampled((*ROOM[:6], STOOL)), surface(STOOL), {"min_share": 0.01}, "small"),
        (crowd_in_a_slab(), proposed(ALONG_Y, 2.0), {"min_share": 0.05}, "smear"),
        (barrel(3.0), proposed(ALONG_Y, 2.0), {}, "bent"),
        (sampled((RAMP, FAR)), proposed((0.0, 1.0, -0.25), 1.94, "vertical"), {}, "tilt"),
        (barrel(12.0), proposed(ALONG_Y, 2.0), {}, None),
    ],
    ids=["none", "small", "smear", "barrel", "tilt", "wide barrel"],
)
def test_a_refusal_has_the_criterion_that_refused(
    points: NDArray[np.float64], candidate: Candidate, params: dict[str, Any], criterion: str | None
) -> None:
    search = search_in(prepared(points), **params)
    assert (verify(candidate, search) is None) == (criterion is not None)
    assert [name for name, _ in search.refusals] == ([criterion] if criterion else [])


@pytest.mark.parametrize(
    ("points", "params", "criterion"),
    [
        # Candidates below 70 % of `min_share` are not refined.
        *((sampled((wall(), FAR)), {"min_share": share}, "few") for share in (0.7, 0.9)),
        (filled_slab(), {}, "scattered"),
        (sampled((wall(half_m=(2.0, 0.03)),)), {}, "strip"),
        (barrel(2.0), {}, "bent"),
        (sampled((RAMP, FAR)), {"constraint": "vertical"}, "tilt"),
    ],
    ids=["few", "far too few", "filled", "strip", "barrel", "tilt"],
)
def test_a_cloud_without_planes_is_refused_with_the_criterion(
    points: NDArray[np.float64], params: dict[str, Any], criterion: Criterion, tmp_path: Path
) -> None:
    with pytest.raises(MethodError) as refusal:
        detect(Hough2d, cloud_of(points), tmp_path, **params)
    reason = re.sub(r"\\{.*?\\}", "(.*)", re.escape(CRITERIA[criterion]))
    found = re.search(f": {reason};", str(refusal.value))
    assert found is not None
    # Not all candidates have a share; the wall has 57 %, the arc less than its 5 cm.
    for share in found.groups():
        assert 50.0 < float(share.rstrip("%")) < 65.0


@pytest.mark.parametrize("exact", [False, True])
def test_exact_walls_and_floors_lean_by_nothing(exact: bool) -> None:
    lean = math.radians(2.0)
    leaning = Rectangle("w", (0, 2, 0), (2, 0, 0), (0, math.sin(lean), math.cos(lean)), 8_000)
    sloping = Rectangle(
        "f", (0, 0, -2), (2, 0, 0), (0, 2 * math.cos(lean), 2 * math.sin(lean)), 8_000
    )
    search = search_in(prepared(sampled((leaning, sloping))), exact=exact)
    for truth, rise in ((leaning, 0.0), (sloping, 1.0)):
        found = verify(surface(truth), search)
        assert found is not None
        normal = found.raster.plane.normal
        away_deg = angle_between_deg(normal * np.sign(normal @ truth.normal), truth.normal)
        assert away_deg == pytest.approx(2.0 if exact else 0.0, abs=0.03)
        assert not exact or abs(normal[2]) == pytest.approx(rise, abs=1e-12)


class Listed(Proposer):
    """Proposes given surfaces, one after the other."""

    def __init__(self, surfaces: tuple[Rectangle, ...]) -> None:
        self._left = [surface(truth) for truth in surfaces]

    def propose(self, search: Search) -> Candidate | None:
        del search
        return self._left.pop(0) if self._left else None


@pytest.mark.parametrize(
    ("params", "n_found"),
    [
        ({"min_share": 0.005}, 7),
        ({"min_share": 0.05}, 6),
        # The table has an area of 1.6 m2, and the floor of the room 24 m2.
        ({"min_share": 0.005, "min_area_m2": 1.7}, 7),
        ({"min_share": 0.005, "n_planes_max": 3}, 3),
        # The four walls have 62 % of the points.
        ({"min_share": 0.005, "stop_unclassified_share": 0.4}, 4),
    ],
)
def test_a_search_ends_where_its_parameters_say(params: dict[str, Any], n_found: int) -> None:
    search = search_in(prepared(sampled()), **params)
    assert len(greedy_search(search, Listed(ROOM))) == n_found


def found_walls(
    rectangles: tuple[Rectangle, ...], points: NDArray[np.float64]
) -> tuple[Search, list[FoundPlane]]:
    search = search_in(prepared(points, parts=2), min_share=0.01)
    return search, find_planes(search, Listed(rectangles))


def test_labels_are_names_of_planes_and_those_without_support_of_all_points_are_omitted() -> None:
    walls = (wall(30_000), WEST)
    points = sampled(walls)
    search, found = found_walls(walls, points)
    names, labels = np.array([7, 3, -1], dtype=np.int16), np.empty(len(points), dtype=np.int16)
    search.cloud.write_labels(names, labels)
    np.testing.assert_array_equal(labels, names[search.cloud.claims])
    # Planes that are not supported by all points together are omitted.
    for share, n_left in ((0.3, 1), (0.8, 0)):
        strict = search_in(search.cloud, min_share=share)
        assert len(fit_to_all(found, strict)) == n_left
        assert {name for name, _ in strict.refusals} == {"few"}


@pytest.mark.parametrize("gap_m", [0.0, 0.8], ids=["connected", "in two parts"])
def test_a_frame_around_a_wall_leaves_the_wall_its_points(gap_m: float) -> None:
    # The rectangle of the frame covers the wall, and its plane intersects the wall at an angle of
    # one degree.
    lean = 0.02
    below = (-gap_m, 1.98 - 1.25 * lean, -1.25)
    frame = (
        Rectangle("side", (2.35, 1.98, 0), (0.15, 0, 0), (0, lean, 1), 6_000),
        Rectangle("below", below, (2.5, 0, 0), (0, 0.2 * lean, 0.2), 9_000),
    )
    on_wall, on_frame = sampled((wall(60_000),), noise_m=0.004), sampled(frame, noise_m=0.002)
    alone = [
        found_walls((truth,), points)[1][0]
        for truth, points in ((wall(60_000), on_wall), (frame[0], on_frame))
    ]
    search = search_in(prepared(np.concatenate([on_wall, on_frame]), parts=2), min_share=0.01)
    label(fit_to_all(alone, search), search.cloud)
    claims = search.cloud.claims
    assert (claims[: len(on_wall)] == 0).mean() > 0.95
    assert (claims[len(on_wall) :] == 1).mean() > 0.95


UP = np.array([0.0, 0.0, 1.0])
FLOOR = Plane(normal=UP, offset_m=1.0)
WALL = Plane(normal=np.array([0.0, -1.0, 0.0]), offset_m=-2.0)


def raster_of(plane: Plane, low_m: tuple[float, float], shape: tuple[int, int]) -> SurfaceRaster:
    axes = np.eye(3)[:2] if plane is FLOOR else wall_axes(plane.normal, UP)
    return SurfaceRaster(plane=plane, axes=axes, low_m=np.array(low_m), cell_m=0.1, shape=shape)


FIT_M = 0.015
RASTER = raster_of(FLOOR, (2.0, -1.0), (20, 30))


def tilted_heights() -> NDArray[np.float64]:
    u, v = RASTER.centres_m()
    return np.asarray(0.002 + 0.001 * (u - u.mean()) - 0.002 * (v - v.mean()))


def sums_of_steps(steps: NDArray[np.int64], squared: NDArray[np.int64]) -> CellSums:
    number = np.full(steps.shape, 25, dtype=np.int64)
    return CellSums(n_near=number, n_inner=number, n_fit=number, steps=steps, squared_steps=squared)


def adjusted(
    heights_m: NDArray[np.float64],
    raster: SurfaceRaster = RASTER,
    *,
    spread_m: float = 1e-3,
    fit_m: float = FIT_M,
    cells: NDArray[np.bool_] | None = None,
) -> AdjustedPlane | None:
    """Return the fit to cells of 25 points, whose distances have means and a spread."""
    per_m = STEPS_PER_TOLERANCE / fit_m
    steps = np.rint(25 * heights_m * per_m).astype(np.int64)
    squared = np.rint(steps**2 / 25 + 25 * (spread_m * per_m) ** 2).astype(np.int64)
    chosen = np.ones(heights_m.shape, dtype=np.bool_) if cells is None else cells
    sums = sums_of_steps(steps, squared)
    return adjust_plane(raster, sums, chosen, fit_tolerance_m=fit_m, freedom="any")


@pytest.mark.parametrize("outliers", [0, 120])
def test_cells_on_a_plane_give_that_plane_whatever_some_stand_out(outliers: int) -> None:
    heights = tilted_heights()
    # Add a moulding on a fifth of the wall, at one side.
    heights.reshape(-1)[:outliers] += 0.011
    fitted = adjusted(heights)
    assert fitted is not None
    corners = np.array([[2.0, -1.0, 0], [5.0, -1.0, 0], [5.0, 1.0, 0], [2.0, 1.0, 0]])
    corners[:, 2] = 1.002 + 0.001 * (corners[:, 0] - 3.5) - 0.002 * corners[:, 1]
    np.testing.assert_allclose(fitted.plane.distances_m(corners), 0.0, atol=2e-5)
    # The displacement refers to the centres of cells, half a cell from the edges.
    assert fitted.moved_m == pytest.approx(0.002 + 0.001 * 1.45 + 0.002 * 0.95, abs=3e-5)
    assert outliers or fitted.bend_per_m == pytest.approx(0.0, abs=1e-5)


def test_three_cells_or_a_row_of_them_fix_no_plane() -> None:
    for chosen, is_fixed in ((np.s_[0, :3], False), (np.s_[0, :], False), (np.s_[:2, :2], True)):
        cells = np.zeros((20, 30), dtype=np.bool_)
        cells[chosen] = True
        assert (adjusted(tilted_heights(), cells=cells) is not None) is is_fixed


# --- cells ---


def sums_of(n_near: NDArray[np.int64], n_inner: NDArray[np.int64] | None = None) -> CellSums:
    inner = n_near if n_inner is None else n_inner
    nothing = np.zeros_like(n_near)
    return CellSums(n_near=n_near, n_inner=inner, n_fit=inner, steps=nothing, squared_steps=nothing)


def test_a_raster_covers_the_box_with_cells_of_the_side_asked_for() -> None:
    corners = np.array(list(itertools.product((-3.0, 2.0), (1.0, 2.5), (0.0, 1.05))))
    raster = SurfaceRaster.over(WALL, corners, UP, 0.1)
    low_m = (corners @ raster.axes.T).min(axis=0)
    # The box is 5 m wide and 1.05 m high.
    assert raster.shape == (11, 50)
    u, v = raster.centres_m()
    np.testing.assert_allclose([u[0, 0], v[0, 0]], low_m + 0.05)
    np.testing.assert_allclose(raster.bounds_m()[::2], low_m)
    np.testing.assert_allclose(raster.bounds_m()[1::2], low_m + np.array([5.0, 1.1]))
    wide = SurfaceRaster.over(WALL, 1000.0 * corners, UP, 0.1)
    assert wide.shape[0] * wide.shape[1] == pytest.approx(1e6, rel=0.01)
    assert wide.cell_m == pytest.approx(np.sqrt(5000.0 * 1050.0 / 1e6))
    assert SurfaceRaster.over(WALL, corners * [1.0, 1.0, 0.0], UP, 0.1).shape == (1, 50)


def test_crowded_cells_have_most_points_in_the_inner_slab_and_like_neighbours() -> None:
    n_near = np.full((9, 9), 25)
    # At least 0.6 of 25 points plus half of their root are needed, which is 17.5.
    assert not crowded_cells(sums_of(n_near, np.full((9, 9), 17))).any()
    assert crowded_cells(sums_of(n_near, np.full((9, 9), 18))).all()
    inner = np.zeros((9, 9), dtype=np.int64)
    # Cells in the first group have three neighbours, those in the second two.
    inner[1:3, 1:3] = inner[6, 6] = inner[6, 7] = inner[7, 6] = 25
    found = crowded_cells(sums_of(n_near, inner))
    np.testing.assert_array_equal(np.argwhere(found), [[1, 1], [1, 2], [2, 1], [2, 2]])
    # Cells with two points or far fewer than the others are not crowded; a fiftieth of 400 is 8.
    n_near = np.full((6, 6), 400)
    n_near[0, :3] = [2, 7, 9]
    found = crowded_cells(sums_of(n_near))
    np.testing.assert_array_equal(found[0], [False, False, True, True, True, True])
    assert found[1:].all()
    pairs = np.full((6, 6), 2)
    assert not crowded_cells(sums_of(pairs)).any()
    # All three points are in the inner slab, where 2.7 would suffice.
    assert crowded_cells(sums_of(pairs + 1)).all()


def test_parts_are_joined_over_gaps_of_four_cells_and_listed_by_points() -> None:
    belongs = np.zeros((12, 40), dtype=bool)
    belongs[2:6, 3:8] = True
    belongs[2:6, 12:15] = True  # four cells farther to the right
    belongs[3:9, 20:30] = True  # five cells
    belongs[11, 39] = True  # one of 93 cells
    n_near = np.where(belongs, 1, 7)
    n_near[2:6, 3:15] *= 9
    raster = raster_of(WALL, (-1.0, 3.0), (12, 40))
    support = support_of(raster, belongs, sums_of(n_near))
    assert support is not None
    expected = np.where(belongs, 0, -1)
    expected[3:9, 20:30] = 1
    expected[11, 39] = -1
    np.testing.assert_array_equal(support.part_of_cell, expected)
    np.testing.assert_array_equal(support.cells, expected >= 0)
    # Columns begin at -1 m, rows at 3 m.
    parts_m = np.array([[-0.7, 0.5, 3.2, 3.6], [1.0, 2.0, 3.3, 3.9]])
    np.testing.assert_allclose(support.parts_m, parts_m, atol=1e-12)
    np.testing.assert_allclose(support.bounds_m, [-0.7, 2.0, 3.2, 3.9], atol=1e-12)
    assert support.n_points == 9 * 32 + 60
    alone = support_of(raster, belongs, sums_of(n_near), join_parts=False)
    assert alone is not None
    assert alone.n_points == 9 * 32
    np.testing.assert_allclose(alone.parts_m, parts_m[:1])
    np.testing.assert_allclose(alone.bounds_m, parts_m[0])


# Permitted range of the ratio of true to predicted errors, over many trials.
CALIBRATED = (0.7, 1.4)
SHAPE = (30, 45)
WALL_CELLS = raster_of(WALL, (-1.0, -1.5), SHAPE)


def wall_of_cells(
    seed: int, *, reach_cells: float, relief_m: float, mixed_share: float = 0.0
) -> CellSums:
    """Return 30 x 45 cells of a flat wall with uneven plaster; each has 25 points with 2 mm noise.

    Args:
        seed: seed of the wall.
        reach_cells: correlation length of the waves in cells.
        relief_m: standard deviation of the waves.
        mixed_share: in one of ten cells, share of the points up to 15 mm in front of the wall.
    """
    rng = np.random.default_rng(seed)
    waves = ndimage.gaussian_filter(rng.normal(size=SHAPE), reach_cells, mode="wrap")
    # Scale by the mean effect of the filter, not by its effect on this wall.
    waves *= relief_m * (2.0 * np.sqrt(np.pi) * max(reach_cells, 0.3))
    points = waves[..., None] + rng.normal(0.0, 0.002, (*SHAPE, 25))
    spoilt = rng.uniform(size=(*SHAPE, 25)) < mixed_share
    spoilt &= (rng.uniform(size=SHAPE) < 0.1)[..., None]
    points = np.where(spoilt, rng.uniform(0.0, FIT_M, points.shape), points)
    steps = np.rint(points * STEPS_PER_TOLERANCE / FIT_M).astype(np.int64)
    return sums_of_steps(steps.sum(axis=2), (steps**2).sum(axis=2))


def fitted_walls(n_walls: int, **how: float) -> Iterator[tuple[AdjustedPlane, NDArray[np.float64]]]:
    """Yield fits to cells of drawn walls, and the middle of the cells."""
    u, v = WALL_CELLS.centres_m()
    middle = np.array([u.mean(), v.mean()]) @ WALL_CELLS.axes - 2.0 * WALL.normal
    for seed in range(n_walls):
        sums = wall_of_cells(seed, **how)
        fit = adjust_plane(WALL_CELLS, sums, sums.n_fit > 0, fit_tolerance_m=FIT_M, freedom="any")
        assert fit is not None
        yield fit, middle


def ratios(
    found: Plane, covariance: NDArray[np.float64], true: Plane, middle: NDArray[np.float64]
) -> list[float]:
    """Return errors over predicted sigmas, of the offset and of the direction about two axes."""
    at_middle = np.append(middle, -1.0)
    off_m = float(found.distances_m(middle[None])[0] - true.distances_m(middle[None])[0])
    turned = found.normal - true.normal
    axes = wall_axes(true.normal, UP)
    return [
        off_m / np.sqrt(at_middle @ covariance @ at_middle),
        *(turned @ axis / np.sqrt(axis @ covariance[:3, :3] @ axis) for axis in axes),
    ]


def rms(values: list[list[float]]) -> NDArray[np.float64]:
    squares: NDArray[np.float64] = np.mean(np.square(values), axis=0)
    return np.sqrt(squares)


@pytest.mark.parametrize(
    ("reach_cells", "relief_m", "mixed_share"),
    [(0.0, 0.0, 0.0), (0.0, 0.001, 0.0), (2.0, 0.002, 0.0), (0.0, 5e-4, 0.3)],
    ids=["noise", "rough", "waves of 20 cm", "mixed distances"],
)
def test_stated_sigmas_of_walls_are_their_errors(
    reach_cells: float, relief_m: float, mixed_share: float
) -> None:
    how = {"reach_cells": reach_cells, "relief_m": relief_m, "mixed_share": mixed_share}
    trials = [
        ratios(fit.plane, fit.stated()[0], WALL, middle) for fit, middle in fitted_walls(60, **how)
    ]
    assert (rms(trials) > CALIBRATED[0]).all(), rms(trials)
    assert (rms(trials) < CALIBRATED[1]).all(), rms(trials)


def test_cells_with_mixed_distances_have_less_weight() -> None:
    """A tenth of the cells is off by 1.1 mm, and their mean is 2 mm / sqrt(25) exact otherwise.

    With these errors as weights, the plane would be off by an eighth of what it is without weights.
    """
    share = 0.15
    offs_m = [
        fit.plane.distances_m(middle[None])[0] - WALL.distances_m(middle[None])[0]
        for fit, middle in fitted_walls(6, reach_cells=0.0, relief_m=2e-4, mixed_share=share)
    ]
    assert abs(np.mean(offs_m)) < 0.3 * 0.1 * share * 0.5 * FIT_M


@pytest.mark.parametrize("tails", ["laplace", "two widths"])
def test_cells_that_fade_state_what_their_plane_scatters_by(tails: str) -> None:
    """If many cells fade, the weights overstate the information by a fifth to a quarter."""
    shape, squares = (40, 60), []
    raster = replace(WALL_CELLS, shape=shape)
    for seed in range(80):
        rng = np.random.default_rng(seed)
        heights_m = rng.laplace(0.0, 0.001, shape)
        if tails == "two widths":
            heights_m = np.where(rng.random(shape) < 0.4, 3.2, 1.0) * rng.normal(0.0, 0.001, shape)
        found = adjusted(heights_m, raster, spread_m=2e-4, fit_m=0.03)
        assert found is not None
        # The true unknowns are zero.
        covariance = independent_covariance(found.fit)
        squares.append(found.fit.solution**2 / np.diag(covariance))
    assert math.sqrt(np.mean(squares)) == pytest.approx(1.0, abs=0.1)


def test_the_covariance_from_tiles_is_the_jackknife_of_their_means() -> None:
    rng, tile = np.random.default_rng(0), np.repeat(np.arange(4), 9)
    heights_m = rng.normal(0.0, 0.001, 4)[tile] + rng.normal(0.0, 0.0003, 36)
    residuals = (heights_m - heights_m.mean())[:, None]
    means_m = [heights_m[tile != k].mean() for k in range(4)]
    found = jackknife_covariance(residuals, np.ones((36, 1, 1)), tile)
    assert found[0, 0] == pytest.approx(3.0 * np.var(means_m), rel=1e-3)
