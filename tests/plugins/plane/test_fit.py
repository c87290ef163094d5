"""Fits of a plane to cells and points."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane import fit
from orthoflow_plugins.plane.kernels import STEPS_PER_TOLERANCE
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


@pytest.mark.parametrize(
    ("tolerance_m", "fit_tolerance_m", "tolerances"),
    [(0.08, 0.02, (0.08, 0.04, 0.02)), (0.05, 0.05, (0.05,)), (0.05, 0.08, (0.05,))],
)
def test_tolerances_shrink_by_equal_factors(
    tolerance_m: float, fit_tolerance_m: float, tolerances: tuple[float, ...]
) -> None:
    assert fit.shrinking_tolerances(tolerance_m, fit_tolerance_m) == pytest.approx(tolerances)


def cell_sums(
    heights_m: NDArray[np.float64], *, fit_m: float = 0.015, noise_m: float = 0.001, n: int = 16
) -> CellSums:
    """Cells of 16 points each, half of them above and half below their mean."""
    steps_per_m = STEPS_PER_TOLERANCE / fit_m
    number = np.full(heights_m.shape, n, dtype=np.int64)
    mean = np.rint(heights_m * steps_per_m * n).astype(np.int64)
    squares = np.rint((heights_m**2 + noise_m**2) * steps_per_m**2 * n).astype(np.int64)
    return CellSums(n_near=number, n_inner=number, n_fit=number, steps=mean, squared_steps=squares)


def adjusted(
    heights_m: NDArray[np.float64], freedom: fit.Freedom = "free"
) -> fit.AdjustedPlane | None:
    return fit.adjust_plane(
        raster(), cell_sums(heights_m), np.ones((20, 30), dtype=np.bool_), fit_tolerance_m=0.015,
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
    assert fitted.stated()[0].shape == (4, 4)


def test_three_cells_or_a_row_of_them_fix_no_plane() -> None:
    heights = tilted_heights()
    for chosen, is_fixed in (
        (np.s_[0, :3], False),
        (np.s_[0, :], False),
        (np.s_[:2, :2], True),
    ):
        cells = np.zeros((20, 30), dtype=np.bool_)
        cells[chosen] = True
        fitted = fit.adjust_plane(
            raster(), cell_sums(heights), cells, fit_tolerance_m=0.015, freedom="free"
        )
        assert (fitted is not None) is is_fixed
