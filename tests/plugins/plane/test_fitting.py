"""Fits of a plane to cells and points: densest layers, noise, bends and tilts, by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane import fitting
from orthoflow_plugins.plane.slab_kernels import STEPS_PER_TOLERANCE
from orthoflow_plugins.plane.support import CellSums, SurfaceRaster

from orthoflow.geometry import Plane

UP = np.array([0.0, 0.0, 1.0])
FLOOR = Plane(normal=UP, offset_m=1.0)


def raster(rows: int = 20, columns: int = 30, cell_m: float = 0.1) -> SurfaceRaster:
    return SurfaceRaster(
        plane=FLOOR,
        axes=np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
        low_m=np.array([2.0, -1.0]),
        cell_m=cell_m,
        shape=(rows, columns),
    )


def placed(number: NDArray[np.int64], shape: tuple[int, int]) -> fitting._Placed:
    rows, columns = np.divmod(np.arange(shape[0] * shape[1]), shape[1])
    return fitting._Placed(rows=rows, columns=columns, number=number)


@pytest.mark.parametrize(
    ("find_m", "fit_m", "tolerances"),
    [(0.08, 0.02, (0.08, 0.04, 0.02)), (0.05, 0.05, (0.05,)), (0.05, 0.08, (0.05,))],
)
def test_tolerances_shrink_by_equal_factors(
    find_m: float, fit_m: float, tolerances: tuple[float, ...]
) -> None:
    assert fitting.shrinking_tolerances(find_m, fit_m) == pytest.approx(tolerances)


def test_the_densest_layer_is_the_middle_of_the_shortest_three_tenths() -> None:
    # Three of ten: 5, 6, 7 lie closest together; as wide as 0.7706 deviations.
    heights = np.array([7.0, 0.0, 20.0, 5.0, 6.0, 40.0, 60.0, 85.0, 115.0, 150.0])
    middle, spread = fitting._densest_layer(heights)
    assert middle == 6.0
    assert spread == pytest.approx(2.0 / 0.7706)
    # Of an even number the middle lies between two.
    fourteen = np.concatenate([[5.0, 6.0, 8.0, 9.0], 100.0 * 2.0 ** np.arange(10)])
    middle, spread = fitting._densest_layer(fourteen)
    assert (middle, spread) == (7.0, pytest.approx(4.0 / 0.7706))
    # Two at least.
    assert fitting._densest_layer(np.array([3.0, 1.0, 10.0]))[0] == 2.0


def test_the_densest_layer_of_normal_heights_tells_their_spread() -> None:
    heights = np.random.default_rng(1).normal(3.0, 0.5, 200_000)
    middle, spread = fitting._densest_layer(heights)
    assert middle == pytest.approx(3.0, abs=0.05)
    assert spread == pytest.approx(0.5, rel=0.01)


def test_a_cylinder_bends_by_one_over_its_radius() -> None:
    u, v = np.meshgrid(np.linspace(-1.0, 1.0, 21), np.linspace(-2.0, 2.0, 21))
    u, v = u.ravel(), v.ravel()
    design = np.column_stack([np.ones(u.size), u, v])
    bend, share = fitting._bend(design, 0.3 + 0.1 * u - 0.2 * v + u**2 / (2.0 * 50.0))
    assert bend == pytest.approx(1.0 / 50.0)
    assert share == pytest.approx(1.0)
    # Along a diagonal, as strong.
    across = (u + v) / math.sqrt(2.0)
    assert fitting._bend(design, -(across**2) / 100.0)[0] == pytest.approx(1.0 / 50.0)
    # A saddle bends both ways; the stronger one counts.
    assert fitting._bend(design, u**2 / 100.0 - v**2 / 80.0)[0] == pytest.approx(1.0 / 40.0)


def test_what_a_bend_explains_is_its_share_of_the_variance() -> None:
    rng = np.random.default_rng(2)
    u, v = rng.uniform(-1.0, 1.0, (2, 5000))
    design = np.column_stack([np.ones(u.size), u, v])
    bent = u**2 - np.mean(u**2)
    noise = rng.normal(size=u.size)
    noise *= bent.std() / noise.std()
    assert fitting._bend(design, bent + noise)[1] == pytest.approx(0.5, abs=0.03)
    assert fitting._bend(design, noise)[1] < 0.01
    # A plane that is as flat as a simulation makes it has nothing to explain.
    assert fitting._bend(design, 0.1 * u + 1e-5 * bent) == (0.0, 0.0)


def test_a_tilt_about_a_point_leaves_that_point_where_it_is_lifted_to() -> None:
    centre = np.array([3.5, 0.2])
    change = np.array([0.004, 0.001, -0.002])
    plane, jacobian = fitting._tilted(raster(), change, centre)

    def height_m(of: Plane, u: float, v: float) -> float:
        return (of.offset_m - of.normal[0] * u - of.normal[1] * v) / of.normal[2]

    assert height_m(plane, *centre) == pytest.approx(1.004, abs=1e-12)
    assert height_m(plane, 4.5, 0.2) == pytest.approx(1.005, abs=1e-12)
    assert height_m(plane, 3.5, 1.2) == pytest.approx(1.002, abs=1e-12)
    # The Jacobian is the derivative where nothing has changed yet.
    for unknown in range(3):
        step = 1e-6 * np.eye(3)[unknown]
        moved = fitting._tilted(raster(), step, centre)[0]
        by_step = (np.append(moved.normal, moved.offset_m) - np.append(UP, 1.0)) / 1e-6
        np.testing.assert_allclose(jacobian[:, unknown], by_step, atol=1e-5)


def test_a_cells_noise_is_its_own_blended_with_what_is_usual() -> None:
    number = np.full(64, 9)
    spread = np.full(64, 8.0e-6)  # of nine points: 9e-6 with one degree of freedom less
    noise, mixture = fitting._cell_variances(spread, placed(number, (8, 8)), 0.015)
    np.testing.assert_allclose(noise, 9.0e-6 / 9)
    np.testing.assert_array_equal(mixture, 0.0)
    # A noisier one counts as if 40 points told what is usual beside its eight.
    spread[5] = 16.0e-6
    noise, mixture = fitting._cell_variances(spread, placed(number, (8, 8)), 0.015)
    assert noise[5] == pytest.approx((8 * 18e-6 + 40 * 9e-6) / 48 / 9)
    # Twice the usual is chance: three deviations of eight degrees of freedom are 2.5 times.
    np.testing.assert_array_equal(mixture, 0.0)
    spread[5] = 24.0e-6
    _, mixture = fitting._cell_variances(spread, placed(number, (8, 8)), 0.015)
    assert mixture[5] == pytest.approx((1.5 * (27e-6 - 9e-6) / 0.015) ** 2)
    assert np.count_nonzero(mixture) == 1


def test_a_single_point_has_no_noise_of_its_own() -> None:
    number = np.full(64, 9)
    number[0] = 1
    spread = np.full(64, 8.0e-6)
    spread[0] = 0.0
    noise, _ = fitting._cell_variances(spread, placed(number, (8, 8)), 0.015)
    assert noise[0] == pytest.approx(9e-6)


def test_what_is_usual_is_the_median_of_a_block_and_no_less_than_a_tenth_of_all() -> None:
    own = np.ones((16, 24))
    own[:8, :8] = np.arange(64).reshape(8, 8)
    own[8:, 16:] = 1e-3
    everywhere = placed(np.full(own.size, 9), (16, 24))
    usual = fitting._usual_nearby(own.ravel(), everywhere).reshape(16, 24)
    assert (usual[:8, :8] == 32.0).all()
    assert (usual[:8, 8:] == 1.0).all()
    assert (usual[8:, :16] == 1.0).all()
    assert usual[8:, 16:] == pytest.approx(0.1)


@pytest.mark.parametrize(("n_cells", "usual"), [(11, 1.0), (12, 7.0)])
def test_a_block_of_a_dozen_cells_speaks_for_itself(n_cells: int, usual: float) -> None:
    rows = np.concatenate([np.zeros(n_cells), np.full(40, 8) + np.arange(40) // 8]).astype(np.int64)
    columns = np.concatenate([np.arange(n_cells) % 8, np.arange(40) % 8]).astype(np.int64)
    # The first block lies in one row of eight columns; cells may share a place here.
    own = np.concatenate([np.full(n_cells, 7.0), np.ones(40)])
    where = fitting._Placed(rows=rows, columns=columns, number=np.full(len(own), 9))
    assert fitting._usual_nearby(own, where)[0] == usual


def cell_sums(
    heights_m: NDArray[np.float64], *, fit_m: float = 0.015, noise_m: float = 0.001, n: int = 16
) -> CellSums:
    """Cells of 16 points each, half of them above and half below their mean."""
    steps_per_m = STEPS_PER_TOLERANCE / fit_m
    number = np.full(heights_m.shape, n, dtype=np.int64)
    mean = np.rint(heights_m * steps_per_m * n).astype(np.int64)
    squares = np.rint((heights_m**2 + noise_m**2) * steps_per_m**2 * n).astype(np.int64)
    return CellSums(n_find=number, n_inner=number, n_fit=number, steps=mean, squared_steps=squares)


def adjusted(
    heights_m: NDArray[np.float64], freedom: fitting.Freedom = "free"
) -> fitting.AdjustedPlane | None:
    return fitting.adjust_plane(
        raster(), cell_sums(heights_m), np.ones((20, 30), dtype=np.bool_), fit_m=0.015,
        freedom=freedom,
    )  # fmt: skip


def tilted_heights() -> NDArray[np.float64]:
    u, v = raster().centres_m()
    return np.asarray(0.002 + 0.001 * (u - u.mean()) - 0.002 * (v - v.mean()))


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
    if not outliers:
        assert fitted.bend_per_m == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize(("freedom", "n_unknowns"), [("free", 3), ("vertical", 2), ("level", 1)])
def test_a_fit_changes_only_what_is_free(freedom: fitting.Freedom, n_unknowns: int) -> None:
    fitted = adjusted(tilted_heights(), freedom)
    assert fitted is not None
    assert fitted.jacobian.shape == (4, n_unknowns)
    normal = fitted.plane.normal
    assert (abs(normal[0]) > 1e-4) == (n_unknowns > 1)
    assert (abs(normal[1]) > 1e-4) == (n_unknowns > 2)
    assert fitted.stated().covariance.shape == (4, 4)


def test_three_cells_or_a_row_of_them_fix_no_plane() -> None:
    heights = tilted_heights()
    for chosen, is_fixed in (
        (np.s_[0, :3], False),
        (np.s_[0, :], False),
        (np.s_[:2, :2], True),
    ):
        cells = np.zeros((20, 30), dtype=np.bool_)
        cells[chosen] = True
        fitted = fitting.adjust_plane(
            raster(), cell_sums(heights), cells, fit_m=0.015, freedom="free"
        )
        assert (fitted is not None) is is_fixed


def test_points_on_a_line_refine_no_plane() -> None:
    line = np.column_stack([np.linspace(0, 1, 50), np.zeros(50), np.full(50, 1.001)])
    assert fitting.refine_plane(line, FLOOR, 0.01, freedom="free", up=UP) is None
    square = np.vstack([line, line[:, [1, 0, 2]]])
    refined = fitting.refine_plane(square, FLOOR, 0.01, freedom="free", up=UP)
    assert refined is not None
    assert refined.offset_m == pytest.approx(1.001, abs=1e-9)
    np.testing.assert_allclose(refined.normal, UP, atol=1e-9)


def test_a_cell_varies_by_the_noise_of_its_points_and_by_the_surface_and_no_more() -> None:
    heights = np.random.default_rng(9).normal(0.0, 0.0006, (20, 30))
    fitted = adjusted(heights)
    assert fitted is not None
    # Sixteen points of a millimetre each.
    np.testing.assert_allclose(fitted.observed.noise_m2, 1e-6 / 15.0, rtol=0.05)
    # What cells scatter by holds that noise already.
    assert fitted.fit.scale_m == pytest.approx(0.0006, rel=0.2)
    np.testing.assert_allclose(fitted.fit.variance_m2, fitted.fit.scale_m**2, rtol=0.02)
