"""Levels of colours: 8 bits per channel, or 16 of deep photos, which mean the same shares of white.

So 255 of 8 bits are 65535 of 16, and every level of 8 bits is one of 16: times 257.
"""

from __future__ import annotations

from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

Colours: TypeAlias = NDArray[np.uint8 | np.uint16]
Level: TypeAlias = type[np.uint8] | type[np.uint16]

# Grey of red, green and blue as they are (luma of Rec. 601), as OpenCV makes it.
REC_601: Final = np.array([0.299, 0.587, 0.114])
# Levels of 16 bits for one of 8.
DEEPER: Final = 257


def eight_bits(colours: Colours) -> NDArray[np.uint8]:
    """Give colours in 8 bits: themselves, or 16 bits rounded."""
    if colours.dtype == np.uint8:
        return colours.view(np.uint8)
    return ((colours.astype(np.uint32) + DEEPER // 2) // DEEPER).astype(np.uint8)


def sixteen_bits(colours: Colours) -> NDArray[np.uint16]:
    """Give colours in 16 bits: themselves, or 8 bits times 257, of which nothing is lost."""
    if colours.dtype == np.uint16:
        return colours.view(np.uint16)
    return colours.astype(np.uint16) * np.uint16(DEEPER)


def in_levels(colours: Colours, level: Level) -> Colours:
    """Give colours in 8 or in 16 bits."""
    return eight_bits(colours) if level is np.uint8 else sixteen_bits(colours)


def level_of(colours: Colours) -> Level:
    """Say in which bits colours are."""
    return np.uint16 if colours.dtype == np.uint16 else np.uint8
