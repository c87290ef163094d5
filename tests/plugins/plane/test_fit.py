"""Fits of a plane to cells, and the cells that belong to it: parts and their rectangles."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane import fit
from orthoflow_plugins.plane.kernels import STEPS_PER_TOLERANCE
from orthoflow_plugins.plane.support import CellSums, SurfaceRaster, crowded_cells, support_of

from orthoflow.geometry import Plane, wall_axes

UP = np.array([0.0, 0.0, 1.0])
FLOOR = Plane(normal=UP, offset_m=1.0)
WALL = Plane(normal=np.array([0.0, -1.0, 0.0]), offset_m=-2.0)


def raster_of(plane: Plane, low_m: tuple[float, float], shape: tuple[int, int]) -> SurfaceRaster:
    axes = np.eye(3)[:2] if plane is FLOOR else wall_axes(plane.normal, UP)
    return SurfaceRaster(plane=plane, axes=axes, low_m=np.array(low_m), cell_m=0.1, shape=shape)


RASTER = raster_of(FLOOR, (2.0, -1.0), (20, 30))


def tilted_heights() -> NDArray[np.float64]:
    u, v = RASTER.centres_m()
    return np.asarray(0.002 + 0.001 * (u - u.mean()) - 0.002 * (v - v.mean()))


def adjusted(
    heights_m: NDArray[np.float64],
    freedom: fit.Freedom = "free",
    cells: NDArray[np.bool_] | None = None,
) -> fit.AdjustedPlane | None:
    """The fit to cells of 16 points each, half of them a millimetre above and half below."""
    fit_m, n = 0.015, 16
    steps_per_m = STEPS_PER_TOLERANCE / fit_m
    number = np.full(heights_m.shape, n, dtype=np.int64)
    sums = CellSums(
        n_near=number,
        n_inner=number,
        n_fit=number,
        steps=np.rint(heights_m * steps_per_m * n).astype(np.int64),
        squared_steps=np.rint((heights_m**2 + 1e-6) * steps_per_m**2 * n).astype(np.int64),
    )
    chosen = np.ones(heights_m.shape, dtype=np.bool_) if cells is None else cells
    return fit.adjust_plane(RASTER, sums, chosen, fit_tolerance_m=fit_m, freedom=freedom)


@pytest.mark.parametrize("outliers", [0, 120])
def test_cells_on_a_plane_give_that_plane_whatever_some_stand_out(outliers: int) -> None:
    heights = tilted_heights()
    # A moulding over a fifth of the wall, on one side of it.
    heights.reshape(-1)[:outliers] += 0.011
    fitted = adjusted(heights)
    assert fitted is not None
    corners = np.array([[2.0, -1.0, 0], [5.0, -1.0, 0], [5.0, 1.0, 0], [2.0, 1.0, 0]])
    corners[:, 2] = 1.002 + 0.001 * (corners[:, 0] - 3.5) - 0.002 * corners[:, 1]
    np.testing.assert_allclose(fitted.plane.distances_m(corners), 0.0, atol=2e-5)
    # Of the cells' centres, half a cell inside.
    assert fitted.moved_m == pytest.approx(0.002 + 0.001 * 1.45 + 0.002 * 0.95, abs=3e-5)
    assert outliers or fitted.bend_per_m == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize(
    ("freedom", "n_unknowns"), [("free", 3), ("vertical", 2), ("horizontal", 1)]
)
def test_a_fit_changes_only_what_is_free(freedom: fit.Freedom, n_unknowns: int) -> None:
    fitted = adjusted(tilted_heights(), freedom)
    assert fitted is not None
    assert fitted.jacobian.shape == (4, n_unknowns)
    normal = fitted.plane.normal
    assert (abs(normal[0]) > 1e-4) == (n_unknowns > 1)
    assert (abs(normal[1]) > 1e-4) == (n_unknowns > 2)


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
    # 5 m across, 1.05 m down.
    assert raster.shape == (11, 50)
    u, v = raster.centres_m()
    np.testing.assert_allclose([u[0, 0], v[0, 0]], low_m + 0.05)
    np.testing.assert_allclose([u[3, 7], v[3, 7]], low_m + np.array([0.75, 0.35]))
    np.testing.assert_array_equal(raster.slab().reshape(3, 4)[:, :3], [WALL.normal, *raster.axes])
    np.testing.assert_array_equal(raster.slab()[3::4], [-2.0, 0.0, 0.0])
    np.testing.assert_allclose(raster.bounds_m()[::2], low_m)
    np.testing.assert_allclose(raster.bounds_m()[1::2], low_m + np.array([5.0, 1.1]))
    wide = SurfaceRaster.over(WALL, 1000.0 * corners, UP, 0.1)
    assert wide.shape[0] * wide.shape[1] == pytest.approx(1e6, rel=0.01)
    assert wide.cell_m == pytest.approx(np.sqrt(5000.0 * 1050.0 / 1e6))
    assert SurfaceRaster.over(WALL, corners * [1.0, 1.0, 0.0], UP, 0.1).shape == (1, 50)


def test_crowded_cells_have_most_points_in_the_inner_slab_and_like_neighbours() -> None:
    n_near = np.full((9, 9), 25)
    # 0.6 of 25 points and half their root: 17.5.
    assert not crowded_cells(sums_of(n_near, np.full((9, 9), 17))).any()
    assert crowded_cells(sums_of(n_near, np.full((9, 9), 18))).all()
    inner = np.zeros((9, 9), dtype=np.int64)
    # A cell with three neighbours, one with two.
    inner[1:3, 1:3] = inner[6, 6] = inner[6, 7] = inner[7, 6] = 25
    found = crowded_cells(sums_of(n_near, inner))
    np.testing.assert_array_equal(np.argwhere(found), [[1, 1], [1, 2], [2, 1], [2, 2]])
    # Cells with two points or far fewer than the others are not: a fiftieth of 400 is 8.
    n_near = np.full((6, 6), 400)
    n_near[0, :3] = [2, 7, 9]
    found = crowded_cells(sums_of(n_near))
    np.testing.assert_array_equal(found[0], [False, False, True, True, True, True])
    assert found[1:].all()
    pairs = np.full((6, 6), 2)
    assert not crowded_cells(sums_of(pairs)).any()
    # All three of three are within: 2.7 would do.
    assert crowded_cells(sums_of(pairs + 1)).all()


def test_parts_are_joined_over_gaps_of_four_cells_and_listed_by_points() -> None:
    belongs = np.zeros((12, 40), dtype=bool)
    belongs[2:6, 3:8] = True
    belongs[2:6, 12:15] = True  # four cells further on
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
    # Columns from -1 m, rows from 3 m.
    parts_m = np.array([[-0.7, 0.5, 3.2, 3.6], [1.0, 2.0, 3.3, 3.9]])
    np.testing.assert_allclose(support.parts_m, parts_m, atol=1e-12)
    np.testing.assert_allclose(support.bounds_m, [-0.7, 2.0, 3.2, 3.9], atol=1e-12)
    assert support.n_points == 9 * 32 + 60
    alone = support_of(raster, belongs, sums_of(n_near), join_parts=False)
    assert alone is not None
    assert alone.n_points == 9 * 32
    np.testing.assert_allclose(alone.parts_m, parts_m[:1])
    np.testing.assert_allclose(alone.bounds_m, parts_m[0])


def test_cells_that_all_lie_scattered_support_nothing() -> None:
    # 7 x 7 single cells, eleven apart: no gap is closed, and each is one of forty-nine.
    belongs = np.zeros((77, 77), dtype=bool)
    raster = raster_of(WALL, (-1.0, 3.0), (77, 77))
    assert support_of(raster, belongs, sums_of(belongs.astype(np.int64))) is None
    belongs[::11, ::11] = True
    sums = sums_of(belongs.astype(np.int64))
    assert support_of(raster, belongs, sums) is None
    belongs[0, 0:2] = True
    assert support_of(raster, belongs, sums, part_share=0.04) is not None
