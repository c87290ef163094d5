"""Bands of rows with a reach: every row is in one of them, and knows what is about it."""

from __future__ import annotations

import pytest

from orthoflow.geometry.bands import bands_with_reach


@pytest.mark.parametrize("reach_rows", [0, 3, 40])
@pytest.mark.parametrize("cells_most", [1, 60, 200, 10_000])
def test_bands_hold_each_row_once_and_a_reach_about_it(cells_most: int, reach_rows: int) -> None:
    bands = list(bands_with_reach((37, 10), cells_most=cells_most, reach_rows=reach_rows))
    assert [row for band in bands for row in range(37)[band.rows]] == list(range(37))
    for band in bands:
        assert band.around.start == max(0, band.rows.start - reach_rows)
        assert band.around.stop == min(37, band.rows.stop + reach_rows)
        around = list(range(37))[band.around]
        assert around[band.inner] == list(range(37))[band.rows]


def test_bands_are_of_about_equal_height_and_stay_within_their_cells() -> None:
    bands = list(bands_with_reach((101, 10), cells_most=300, reach_rows=5))
    heights = [band.rows.stop - band.rows.start for band in bands]
    assert heights == [17] * 5 + [16]
    assert max(band.around.stop - band.around.start for band in bands) * 10 <= 300
