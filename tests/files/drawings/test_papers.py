"""Paper, scale, and how a wall is cut into sheets."""

from __future__ import annotations

import numpy as np
import pytest

from orthoflow.errors import ArgumentError
from orthoflow.files.drawings.papers import (
    LABELS_MM,
    MARGIN_MM,
    fitting_scale,
    nice_step,
    paper_for_one,
    paper_of,
    placed_views,
)

A3 = paper_of("A3")


def test_papers_are_those_of_the_standard_or_given() -> None:
    assert (paper_of("a1").width_mm, paper_of("A1").height_mm) == (841.0, 594.0)
    assert (paper_of("700x500.5").width_mm, paper_of("700x500.5").height_mm) == (700.0, 500.5)


@pytest.mark.parametrize(
    ("size_m", "kinds", "name"),
    [
        ((1.0, 1.0), ("ortho",), "A4"),
        ((9.4, 7.0), ("ortho",), "A3"),
        ((7.0, 14.0), ("ortho",), "A3"),
        ((9.4, 7.0), ("ortho", "depth"), "A2"),
        ((40.0, 40.0), ("ortho",), "A0"),
        ((41.0, 41.0), ("ortho",), ""),
    ],
)
def test_the_smallest_paper_that_takes_each_wall_on_one_sheet_is_named(
    size_m: tuple[float, float], kinds: tuple[str, ...], name: str
) -> None:
    walls = [(kinds, size_m), (("ortho",), (0.5, 0.5))]
    assert paper_for_one(walls, 50) == name
    for tried in ("A0", "A1", "A2", "A3", "A4"):
        _, sheets = placed_views(kinds, size_m, paper_of(tried), scale=50, grid_m=0.0)
        assert (len(sheets) == 1) == (name != "" and tried <= name)


@pytest.mark.parametrize("text", ["A9", "letter", "70x500", "700x50000", "700", "1e3x500", ""])
def test_other_papers_are_refused(text: str) -> None:
    with pytest.raises(ArgumentError, match="--paper must be A0, A1, A2, A3, A4, or width x"):
        paper_of(text)


def test_the_scale_is_the_largest_at_which_all_walls_fit() -> None:
    wide, high = A3.area_mm
    # At 1:50 exactly as large as the area.
    size = (wide * 50 / 1e3, high * 50 / 1e3)
    assert fitting_scale([size, (1.0, 1.0)], A3) == 50
    assert fitting_scale([(size[0] + 0.001, size[1])], A3) == 100
    # Upright: what is high fits onto paper that is turned.
    assert fitting_scale([(0.5, 7.0)], A3) == 20
    # What fits at none is cut at the smallest.
    assert fitting_scale([(1e6, 1.0)], A3) == 10_000


@pytest.mark.parametrize("kinds", [("ortho",), ("ortho", "depth")])
@pytest.mark.parametrize("size_m", [(12.0, 4.0), (3.3, 17.1), (30.01, 20.02)])
@pytest.mark.parametrize("grid_m", [0.0, 0.7, 1.0])
def test_sheets_cover_a_wall_once_and_stay_on_the_paper(
    kinds: tuple[str, ...], size_m: tuple[float, float], grid_m: float
) -> None:
    paper, sheets = placed_views(kinds, size_m, A3, scale=20, grid_m=grid_m)
    for kind in kinds:
        views = [view for sheet in sheets for view in sheet if view.kind == kind]
        area = sum(np.prod(view.part.size_m) for view in views)
        assert area == pytest.approx(size_m[0] * size_m[1], rel=1e-12)
        assert max(view.part.right_m for view in views) == size_m[0]
        assert max(view.part.bottom_m for view in views) == size_m[1]
        for view in views:
            if grid_m:
                for cut in (view.part.left_m, view.part.top_m):
                    assert cut / grid_m == pytest.approx(round(cut / grid_m), abs=1e-9)
            wide, high = (1e3 * edge / 20 for edge in view.part.size_m)
            left, bottom = view.corner_mm
            assert left >= MARGIN_MM + LABELS_MM - 1e-6
            assert bottom >= MARGIN_MM + LABELS_MM - 1e-6
            column = paper.width_mm - MARGIN_MM - paper.column_mm
            assert left + wide <= column - LABELS_MM + 1e-2
            assert bottom + high <= paper.height_mm - MARGIN_MM - LABELS_MM + 1e-2


def test_pictures_stand_beside_each_other_where_both_fit() -> None:
    _, sheets = placed_views(("ortho", "depth"), (4.0, 3.0), A3, scale=50, grid_m=1.0)
    ((ortho, depth),) = sheets
    assert depth.corner_mm[0] == pytest.approx(ortho.corner_mm[0] + 80.0 + 2 * LABELS_MM)
    assert depth.corner_mm[1] == ortho.corner_mm[1]
    _, sheets = placed_views(("ortho", "depth"), (11.0, 3.0), A3, scale=50, grid_m=1.0)
    ((ortho, depth),) = sheets
    assert depth.corner_mm[1] == pytest.approx(ortho.corner_mm[1] - 60.0 - 2 * LABELS_MM)


def test_the_paper_is_turned_where_that_saves_sheets() -> None:
    paper, sheets = placed_views(("ortho",), (3.0, 7.0), A3, scale=20, grid_m=1.0)
    assert (paper.width_mm, len(sheets)) == (297.0, 1)


def test_too_many_sheets_are_refused_before_any_is_laid_out() -> None:
    with pytest.raises(ArgumentError, match="at most 200 are drawn: take a larger"):
        placed_views(("ortho",), (1e8, 1e8), A3, scale=1, grid_m=0.0)


def test_round_steps() -> None:
    steps = [nice_step(least) for least in (0.011, 0.02, 0.021, 0.4, 1.0, 70.0)]
    np.testing.assert_allclose(steps, [0.02, 0.02, 0.05, 0.5, 1.0, 100.0], rtol=1e-12)


@pytest.mark.parametrize(
    "scale", [1, 2, 5, 10, 20, 25, 50, 100, 200, 250, 500, 1000, 2000, 5000, 10_000]
)
def test_usual_scales_are_those_of_rulers(scale: int) -> None:
    across, down = (1e-3 * scale * edge for edge in A3.area_mm)
    assert fitting_scale([(across, down)], A3) == scale
    if scale < 10_000:
        assert fitting_scale([(1.001 * across, down)], A3) > scale


@pytest.mark.parametrize("kinds", [("ortho",), ("ortho", "depth")])
@pytest.mark.parametrize("size_m", [(4.0, 3.0), (11.0, 3.0)])
def test_pictures_on_one_sheet_stand_in_the_middle_of_its_room(
    kinds: tuple[str, ...], size_m: tuple[float, float]
) -> None:
    paper, (views,) = placed_views(kinds, size_m, A3, scale=50, grid_m=1.0)
    wide, high = (20.0 * edge for edge in size_m)
    corners = np.array([view.corner_mm for view in views])
    low, up = corners.min(axis=0), np.add(corners.max(axis=0), (wide, high))
    edge = MARGIN_MM + LABELS_MM
    # As far from the labels on the left as on the right, and above as below.
    np.testing.assert_allclose(low - edge, np.add(edge, paper.area_mm) - up)


def test_papers_are_as_small_and_as_large_as_people_print() -> None:
    assert (paper_of("150x5000").width_mm, paper_of("150x5000").height_mm) == (150.0, 5000.0)
    for text in ("149.9x200", "200x5000.1"):
        with pytest.raises(ArgumentError, match="width x height of 150 to 5000 mm"):
            paper_of(text)
