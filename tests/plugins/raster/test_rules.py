"""How far a cell may lie that decides what becomes of another."""

from __future__ import annotations

import pytest
from orthoflow_plugins.raster.rules import GapRule, RasterRule, Surface, SurfaceRule


def rule(gap_cells: int, denoise_cells: int, surface: Surface = "median") -> RasterRule:
    return RasterRule(
        surface=SurfaceRule(
            surface=surface, layer_m=0.1, denoise_cells=denoise_cells, percentiles=(), threads=1
        ),
        gaps=GapRule(gap_cells=gap_cells, scan_steps=3, layer_m=0.1, threads=1),
    )


@pytest.mark.parametrize(
    ("gap_cells", "denoise_cells", "rows"),
    # Outliers ask 32 rows; noise is taken out twice; a gap is spanned over four radii and has a
    # disc of one on either side.
    [(0, 0, 34), (5, 0, 64), (0, 8, 50), (5, 8, 80)],
)
def test_outliers_noise_and_gaps_reach_so_many_rows(
    gap_cells: int, denoise_cells: int, rows: int
) -> None:
    made = rule(gap_cells, denoise_cells)
    assert made.gaps.span_cells == 4 * gap_cells
    assert made.reach_rows == rows


@pytest.mark.parametrize(
    ("surface", "is_of_one"),
    [
        *(("nearest", True), ("centre", True), ("topmost", True), ("tin", True)),
        *(("median", False), ("denoised", False), ("mean", False)),
    ],
)
def test_some_surfaces_take_a_cell_from_one_point(surface: Surface, is_of_one: bool) -> None:
    assert rule(1, 1, surface).surface.is_of_one_point is is_of_one
