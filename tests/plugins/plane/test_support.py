"""Cells that belong to a plane, the parts that they form, and their rectangles."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.support import (
    CellSums,
    SurfaceRaster,
    crowded_cells,
    support_of,
)

from orthoflow.geometry import Plane, wall_axes

UP = np.array([0.0, 0.0, 1.0])
PLANE = Plane(normal=np.array([0.0, -1.0, 0.0]), offset_m=-2.0)


def raster_of(shape: tuple[int, int]) -> SurfaceRaster:
    return SurfaceRaster(
        plane=PLANE,
        axes=wall_axes(PLANE.normal, UP),
        low_m=np.array([-1.0, 3.0]),
        cell_m=0.1,
        shape=shape,
    )


def sums_of(n_near: NDArray[np.int64], n_inner: NDArray[np.int64] | None = None) -> CellSums:
    inner = n_near if n_inner is None else n_inner
    nothing = np.zeros_like(n_near)
    return CellSums(n_near=n_near, n_inner=inner, n_fit=inner, steps=nothing, squared_steps=nothing)


def test_a_raster_covers_the_box_with_cells_of_the_side_asked_for() -> None:
    corners = np.array(list(itertools.product((-3.0, 2.0), (1.0, 2.5), (0.0, 1.05))))
    raster = SurfaceRaster.over(PLANE, corners, UP, 0.1)
    placed = corners @ raster.axes.T
    np.testing.assert_allclose(raster.low_m, placed.min(axis=0))
    # 5 m across, 1.05 m down.
    assert raster.shape == (11, 50)
    u, v = raster.centres_m()
    assert u.shape == v.shape == (11, 50)
    np.testing.assert_allclose([u[0, 0], v[0, 0]], raster.low_m + 0.05)
    np.testing.assert_allclose([u[3, 7], v[3, 7]], raster.low_m + np.array([0.75, 0.35]))
    wide = SurfaceRaster.over(PLANE, 1000.0 * corners, UP, 0.1)
    assert wide.shape[0] * wide.shape[1] == pytest.approx(1e6, rel=0.01)
    assert wide.cell_m == pytest.approx(np.sqrt(5000.0 * 1050.0 / 1e6))
    flat = SurfaceRaster.over(PLANE, corners * [1.0, 1.0, 0.0], UP, 0.1)
    assert flat.shape == (1, 50)


def test_slabs_and_bounds_count_from_the_origin() -> None:
    raster = raster_of((4, 5))
    rows = raster.slab().reshape(3, 4)
    np.testing.assert_array_equal(rows[:, :3], [PLANE.normal, *raster.axes])
    np.testing.assert_array_equal(rows[:, 3], [-2.0, 0.0, 0.0])
    np.testing.assert_allclose(raster.bounds_m(), [-1.0, -0.5, 3.0, 3.4])


def test_crowded_cells_have_most_points_in_the_inner_slab_and_like_neighbours() -> None:
    n_near = np.full((9, 9), 25)
    # 0.6 of 25 points and half their root: 17.5.
    for n_inner, crowded in ((17, False), (18, True)):
        found = crowded_cells(sums_of(n_near, np.full((9, 9), n_inner)))
        assert found.all() if crowded else not found.any()
    inner = np.zeros((9, 9), dtype=np.int64)
    # A cell with three neighbours, one with two.
    inner[1:3, 1:3] = inner[6, 6] = inner[6, 7] = inner[7, 6] = 25
    found = crowded_cells(sums_of(n_near, inner))
    np.testing.assert_array_equal(np.argwhere(found), [[1, 1], [1, 2], [2, 1], [2, 2]])


def test_cells_with_two_points_or_far_fewer_than_the_others_are_not_crowded() -> None:
    n_near = np.full((6, 6), 400)
    n_near[0, :3] = [2, 7, 9]
    found = crowded_cells(sums_of(n_near))
    # A fiftieth of 400 is 8.
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
    raster = raster_of((12, 40))
    support = support_of(raster, belongs, sums_of(n_near))
    assert support is not None
    assert not support.cells[11, 39]
    np.testing.assert_array_equal(support.cells[:, :38], belongs[:, :38])
    np.testing.assert_array_equal(np.unique(support.part_of_cell[2:6, 3:8]), [0])
    np.testing.assert_array_equal(np.unique(support.part_of_cell[2:6, 12:15]), [0])
    np.testing.assert_array_equal(np.unique(support.part_of_cell[3:9, 20:30]), [1])
    assert (support.part_of_cell[~support.cells] == -1).all()
    # Columns from -1 m, rows from 3 m.
    np.testing.assert_allclose(
        support.parts_m, [[-0.7, 0.5, 3.2, 3.6], [1.0, 2.0, 3.3, 3.9]], atol=1e-12
    )
    np.testing.assert_allclose(support.bounds_m, [-0.7, 2.0, 3.2, 3.9], atol=1e-12)
    assert support.n_points == 9 * 32 + 60
    alone = support_of(raster, belongs, sums_of(n_near), join_parts=False)
    assert alone is not None
    assert alone.n_points == 9 * 32
    np.testing.assert_allclose(alone.parts_m, support.parts_m[:1])
    np.testing.assert_allclose(alone.bounds_m, support.parts_m[0])


def test_cells_that_all_lie_scattered_support_nothing() -> None:
    # 7 x 7 single cells, eleven apart: no gap is closed, and each is one of forty-nine.
    belongs = np.zeros((77, 77), dtype=bool)
    belongs[::11, ::11] = True
    sums = sums_of(belongs.astype(np.int64))
    assert support_of(raster_of((77, 77)), belongs, sums) is None
    belongs[0, 0:2] = True
    assert support_of(raster_of((77, 77)), belongs, sums, part_share=0.04) is not None


def test_nothing_supports_nothing() -> None:
    nothing = np.zeros((4, 5), dtype=bool)
    assert support_of(raster_of((4, 5)), nothing, sums_of(nothing.astype(np.int64))) is None
