"""Outlines of areas with known borders: positions of corners, and accuracy of sides."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.segment.areas import Area, Relief
from orthoflow_plugins.segment.outlines import Outline, outline_of

from orthoflow.errors import MethodError
from tests.opening_scenes import inside

GSD_M = 0.01
SHAPE = (120, 160)
# Corners of an area in cells, counter-clockwise for the viewer, rows downwards.
LEFT, TOP, RIGHT, BOTTOM = 30, 20, 130, 90
CORNERS = np.array([[LEFT, TOP], [LEFT, BOTTOM], [RIGHT, BOTTOM], [RIGHT, TOP]], dtype=np.float64)
# Standard deviation of a position that is uniformly distributed in an interval of length 1.
UNIFORM = 12.0**-0.5


def block(
    left: int = LEFT, top: int = TOP, right: int = RIGHT, bottom: int = BOTTOM
) -> NDArray[np.bool_]:
    cells = np.zeros(SHAPE, dtype=np.bool_)
    cells[top:bottom, left:right] = True
    return cells


def drawn(
    cells: NDArray[np.bool_], *, is_face: NDArray[np.bool_] | None = None, spacing_m: float = GSD_M
) -> Any:
    """Return the outline of cells; by default, the wall's face surrounds them."""
    rows, columns = (np.flatnonzero(cells.any(axis=axis)) for axis in (1, 0))
    part = cells[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    area = Area(
        corner=(int(rows[0]) - 1, int(columns[0]) - 1),
        cells=np.pad(part, 1),
        kind="niche",
        depth_m=0.1,
    )
    nothing = np.zeros(cells.shape, dtype=np.bool_)
    relief = Relief(
        gsd_m=GSD_M,
        step=1,
        is_face=~cells if is_face is None else is_face,
        is_open=cells,
        is_empty=nothing,
        is_crossed=nothing,
        depth_m=np.zeros(cells.shape, dtype=np.float32),
        face_m=0.0,
    )
    return outline_of(area, relief, spacing_m)


def assert_corners(
    found: Outline, corners: NDArray[np.float64], *, within_cells: float = 1e-6
) -> None:
    """Compare corners in order, regardless of the first one."""
    assert len(found.corners) == len(corners)
    begin = int(np.linalg.norm(found.corners - corners[0], axis=1).argmin())
    rolled = np.roll(found.corners, -begin, axis=0)
    np.testing.assert_allclose(rolled, corners, atol=within_cells)


def test_sides_of_a_rectangle_are_the_borders_of_its_cells() -> None:
    found = drawn(block(), spacing_m=3.0 * GSD_M)
    assert_corners(found, CORNERS)
    np.testing.assert_allclose(np.sort(found.lengths), [70.0, 70.0, 100.0, 100.0], atol=1e-6)
    # A border is anywhere within two cells, and between two points that are three cells apart.
    np.testing.assert_allclose(found.sigma, UNIFORM * np.hypot(2.0, 3.0), rtol=1e-9)
    np.testing.assert_array_equal(found.seen_share, 1.0)
    assert found.is_seen.all()
    assert found.seen_of_all == pytest.approx(1.0)


def turned(corners: NDArray[np.float64], degrees: float) -> NDArray[np.float64]:
    middle, turn = np.array([80.0, 60.0]), np.radians(degrees)
    matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return middle + (corners - middle) @ matrix.T


def within(corners: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return cells whose centres are in a convex polygon with the orientation of outlines."""
    rows, columns = np.indices(SHAPE) + 0.5
    return inside(corners, np.stack([columns, rows], axis=2))


@pytest.mark.parametrize("degrees", [3.0, 17.0, 45.0, -30.0])
def test_turned_sides_lie_where_they_are_to_a_fraction_of_a_cell(degrees: float) -> None:
    corners = turned(np.array([[45.2, 35.1], [45.2, 84.7], [113.9, 84.7], [113.9, 35.1]]), degrees)
    found = drawn(within(corners))
    assert_corners(found, corners, within_cells=0.45)
    # The staircase of the cells causes a scatter of at most a third of a cell, which averages out.
    assert np.all(found.sigma >= UNIFORM * np.hypot(2.0, 1.0))
    assert np.all(found.sigma <= UNIFORM * np.hypot(2.0, 1.0) + 0.01)


@pytest.mark.parametrize("at_row", [TOP, BOTTOM], ids=["above", "below"])
@pytest.mark.parametrize(
    ("height", "is_corner"), [(1, False), (2, False), (3, True), (-2, False), (-3, True)]
)
def test_steps_of_two_cells_are_no_corners_and_of_three_are(
    at_row: int, height: int, is_corner: bool
) -> None:
    cells = block()
    outwards = height if at_row == BOTTOM else -height
    low, high = sorted((at_row, at_row + outwards))
    cells[low:high, 60:100] = height > 0
    assert (len(drawn(cells).corners) > 4) == is_corner


def test_what_sticks_out_of_a_side_a_little_does_not_move_it() -> None:
    cells = block()
    cells[TOP - 2 : TOP, 70:80] = True
    cells[BOTTOM - 1, 50:58] = False
    # Two missing cells at the corners have no effect either.
    for row in (TOP, TOP + 1, BOTTOM - 2, BOTTOM - 1):
        cells[row, [LEFT, LEFT + 1, RIGHT - 2, RIGHT - 1]] = False
    assert_corners(drawn(cells), CORNERS, within_cells=0.06)


@pytest.mark.parametrize(("cut", "is_corner"), [(4, False), (5, False), (7, True), (15, True)])
def test_a_corner_cut_short_is_put_back_and_a_long_cut_is_a_side(cut: int, is_corner: bool) -> None:
    cells = block()
    rows, columns = np.indices(SHAPE)
    cells[(rows - TOP) + (columns - LEFT) < cut] = False
    found = drawn(cells)
    if not is_corner:
        assert_corners(found, CORNERS)
    else:
        cut_off = np.array([[LEFT + cut, TOP], [LEFT, TOP + cut]], dtype=np.float64)
        assert_corners(found, np.vstack([cut_off, CORNERS[1:]]), within_cells=1.0)


def test_a_side_is_the_less_exact_the_more_it_scatters_and_the_fewer_points_it_has() -> None:
    # Every other cell projects by one, so midpoints are at 0, 1/2, 1 and 1/2.
    cells = block()
    cells[TOP - 1, LEFT + 1 : RIGHT - 1 : 2] = True
    for spacing in (1.0, 4.0, 25.0, 400.0):
        found = drawn(cells, spacing_m=spacing * GSD_M)
        at_top = int(np.abs(found.corners[:, 1] + np.roll(found.corners[:, 1], -1)).argmin())
        scatter = np.sqrt(0.125) / np.sqrt(max(1.0, found.lengths[at_top] / spacing))
        expected = np.sqrt((UNIFORM * 2.0) ** 2 + (UNIFORM * spacing) ** 2 + scatter**2)
        assert found.sigma[at_top] ** 2 == pytest.approx(expected**2, abs=0.03 * scatter**2)
        assert found.corners[at_top, 1] == pytest.approx(TOP - 0.5, abs=0.02)


def test_what_is_far_off_even_for_a_rough_side_does_not_move_it() -> None:
    # Midpoints scatter by half a cell, but ten cells are off by one and a half.
    cells = block()
    cells[TOP - 1, LEFT + 1 : RIGHT - 1 : 2] = True
    cells[TOP - 2 : TOP, 70:80] = True
    found = drawn(cells)
    begin = int(np.linalg.norm(found.corners - CORNERS[0], axis=1).argmin())
    ends = np.roll(found.corners, -begin, axis=0)[[0, -1], 1]
    np.testing.assert_allclose(ends, TOP - 0.5, atol=0.06)


def test_of_a_single_cell_nothing_is_left() -> None:
    assert drawn(block(50, 50, 51, 51)) is None


def test_cells_that_do_not_hang_together_are_no_area() -> None:
    cells = block()
    cells[:, 70:80] = False
    with pytest.raises(MethodError, match="must be connected, got 2 parts"):
        drawn(cells)


@pytest.mark.parametrize("cells_off", range(1, 8))
def test_a_side_is_seen_where_there_is_face_two_to_four_cells_beside_it(cells_off: int) -> None:
    # The face is a ring one cell wide, at a given distance in cells.
    grown = block(
        LEFT - cells_off - 1, TOP - cells_off - 1, RIGHT + cells_off + 1, BOTTOM + cells_off + 1
    )
    ring = grown & ~block(LEFT - cells_off, TOP - cells_off, RIGHT + cells_off, BOTTOM + cells_off)
    found = drawn(block(), is_face=ring)
    begin = int(np.linalg.norm(found.corners - CORNERS[0], axis=1).argmin())
    left, bottom, right, top = np.roll(found.seen_share, -begin)
    # Borders are between cells; the cell at a border is the one below or to the right.
    assert {left, top} == {1.0 if 1 <= cells_off <= 3 else 0.0}
    assert {right, bottom} == {1.0 if 2 <= cells_off <= 4 else 0.0}
