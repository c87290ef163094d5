"""Bands of rows, rows of arrays, and colours in 8 and in 16 bits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.geometry import bands as module
from orthoflow.geometry.bands import (
    bands_with_reach,
    count_cells,
    count_known,
    holds_cells,
    row_bands,
)
from orthoflow.geometry.levels import eight_bits, in_levels, level_of, sixteen_bits
from orthoflow.geometry.rows import Rows


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


def test_cells_are_counted_in_bands_as_in_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    mask = rng.integers(0, 4, (103, 37), dtype=np.uint8)
    depths = np.where(mask == 2, np.nan, 1.0)
    monkeypatch.setattr(module, "BAND_CELLS", 37 * 10)
    parts = list(row_bands(mask.shape, multiple=4))
    assert [part.stop - part.start for part in parts] == [8] * 12 + [7]
    assert [part.start for part in parts[1:]] == [part.stop for part in parts[:-1]]
    assert count_cells(mask, 3) == np.count_nonzero(mask == 3)
    assert count_known(depths) == np.count_nonzero(mask != 2)
    assert holds_cells(mask, 3)
    assert not holds_cells(mask, 4)


@dataclass(frozen=True, kw_only=True)
class Places(Rows):
    wall: int
    at: NDArray[np.float64]
    names: NDArray[np.str_]


PLACES = Places(wall=3, at=np.arange(6.0).reshape(3, 2), names=np.array(["a", "b", "c"]))


def test_taking_and_joining_keep_the_rows_of_all_arrays_together() -> None:
    some = PLACES.take(np.array([True, False, True]))
    assert (some.wall, len(some), some.at.tolist()) == (3, 2, [[0.0, 1.0], [4.0, 5.0]])
    again = Places.joined([some.take(np.array([1, 0])), PLACES.take(slice(1, 2))])
    assert (again.wall, again.names.tolist()) == (3, ["c", "a", "b"])
    assert again.at.tolist() == [[4.0, 5.0], [0.0, 1.0], [2.0, 3.0]]


PLAIN: NDArray[np.uint8] = np.arange(256, dtype=np.uint8)
DEEP: NDArray[np.uint16] = np.arange(65536, dtype=np.uint32).astype(np.uint16)


def test_every_level_of_eight_bits_is_one_of_sixteen() -> None:
    deep = sixteen_bits(PLAIN)
    assert deep.dtype == np.uint16
    assert (deep[0], deep[-1]) == (0, 65535)
    np.testing.assert_array_equal(eight_bits(deep), PLAIN)


def test_sixteen_bits_are_rounded_to_the_nearest_of_eight() -> None:
    np.testing.assert_array_equal(eight_bits(DEEP), np.rint(np.arange(65536) / 257.0))


def test_colours_stay_themselves_where_they_have_the_bits() -> None:
    for colours, level in ((PLAIN, np.uint8), (DEEP, np.uint16)):
        assert level_of(colours) is level
        assert np.shares_memory(in_levels(colours, level), colours)
