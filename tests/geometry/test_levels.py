"""Colours in 8 and in 16 bits mean the same."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.levels import eight_bits, in_levels, level_of, sixteen_bits

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
