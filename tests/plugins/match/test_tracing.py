"""How tracing judges what it measured: neighbours, misfits, contents, and when it goes on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from orthoflow_plugins.match import tracing, warping
from orthoflow_plugins.match.displacements import Displacements


def displacements(shifts: NDArray[np.float64]) -> Displacements:
    rows, columns = np.divmod(np.arange(len(shifts)), 5)
    return Displacements(
        places=np.column_stack([8 * columns, 8 * rows]).astype(np.intp),
        shift_cells=np.asarray(shifts, dtype=np.float64),
        score=np.ones(len(shifts)),
        sigma_cells=np.full(len(shifts), 0.1),
    )


def test_a_displacement_agrees_with_the_median_of_its_neighbours() -> None:
    shifts = np.tile([2.0, -1.0], (25, 1))
    shifts[12] += [0.5, 0.0]
    assert tracing.agrees_around(displacements(shifts)).all()
    shifts[12] += [0.2, 0.0]
    assert np.flatnonzero(~tracing.agrees_around(displacements(shifts))).tolist() == [12]
    shifts[12] = [2.0, -1.7]
    assert np.flatnonzero(~tracing.agrees_around(displacements(shifts))).tolist() == [12]


def test_where_neighbours_do_not_agree_nothing_is_believed() -> None:
    rng = np.random.default_rng(2)
    assert not tracing.agrees_around(displacements(rng.uniform(-20, 20, (25, 2)))).any()
    # A spread of half a cell lets more than a cell pass.
    loose = np.random.default_rng(3).uniform(-0.9, 0.9, (25, 2))
    assert tracing.agrees_around(displacements(loose)).sum() >= 24


def test_three_displacements_are_too_few_to_agree() -> None:
    assert not tracing.agrees_around(displacements(np.zeros((3, 2)))).any()
    assert tracing.agrees_around(displacements(np.zeros((4, 2)))).all()
    assert tracing.agrees_around(displacements(np.zeros((0, 2)))).shape == (0,)


def test_values_between_cells_are_bilinear_and_unknown_beyond_them() -> None:
    raster = np.array([[0.0, 1.0, 2.0], [10.0, 11.0, 12.0], [20.0, 21.0, np.nan]], np.float32)
    at = np.array([[0.25, 0.5], [1.0, 0.0], [0.0, 0.75], [1.5, 0.5]])
    np.testing.assert_allclose(warping.between(raster, at), [5.25, 1.0, 7.5, 6.5])
    beside = np.array([[-0.1, 0.5], [0.5, -0.1], [2.0, 0.5], [0.5, 2.0], [1.5, 1.5]])
    assert np.isnan(warping.between(raster, beside)).all()
    product = np.array([[0.0, 0.0], [0.0, 8.0]], np.float32)
    np.testing.assert_allclose(warping.between(product, np.array([[0.5, 0.25]])), [1.0])
