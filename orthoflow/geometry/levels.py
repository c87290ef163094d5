"""Colour levels: 8 bits per channel, or 16 for deep photos, with the same shares of white.

So 255 in 8 bits is 65535 in 16 bits, and every 8-bit level has an exact 16-bit one: times 257.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

Colours: TypeAlias = NDArray[np.uint8 | np.uint16]
Level: TypeAlias = type[np.uint8] | type[np.uint16]

# Luma of red, green and blue as stored (Rec. 601), as in OpenCV.
REC_601: Final = np.array([0.299, 0.587, 0.114])
# 16-bit levels per 8-bit level.
DEEPER: Final = 257
# A picture has a single tone if this share of it is within a level of 256 of its median, or darker
# than this share of white, or brighter than white less this share.
_PLAIN_SHARE: Final = 0.98
_DARK: Final = 0.03
_LEVEL: Final = 0.5 / 255.0
_TONE_SAMPLE: Final = 40_000
# Smaller pictures are not judged.
_TONE_CELLS_MIN: Final = 2000


def eight_bits(colours: Colours) -> NDArray[np.uint8]:
    """Return colours in 8 bits: themselves, or 16 bits rounded."""
    if colours.dtype == np.uint8:
        return colours.view(np.uint8)
    return ((colours.astype(np.uint32) + DEEPER // 2) // DEEPER).astype(np.uint8)


def sixteen_bits(colours: Colours) -> NDArray[np.uint16]:
    """Return colours in 16 bits: themselves, or 8 bits times 257, which is lossless."""
    if colours.dtype == np.uint16:
        return colours.view(np.uint16)
    return colours.astype(np.uint16) * np.uint16(DEEPER)


def in_levels(colours: Colours, level: Level) -> Colours:
    """Return colours in 8 or in 16 bits."""
    return eight_bits(colours) if level is np.uint8 else sixteen_bits(colours)


def level_of(colours: Colours) -> Level:
    """Return the number of bits of colours."""
    return np.uint16 if colours.dtype == np.uint16 else np.uint8


def plain_tone(
    picture: NDArray[np.generic], mask: NDArray[np.uint8], shown: Sequence[int], *, white: float
) -> tuple[str, float] | None:
    """Whether a picture is nearly all black, white or one value.

    Args:
        picture: (rows, cols) or (rows, cols, 3); NaN is ignored.
        mask: (rows, cols) states of the cells.
        shown: the states of cells with content.
        white: the value of maximum brightness.

    Returns:
        `black`, `white` or `one value`, and the share of such cells; None for a picture with tones,
        or with few cells.

    >>> ramp, mask = np.linspace(0.0, 1.0, 2000)[None], np.ones((1, 2000), dtype=np.uint8)
    >>> plain_tone(0.0 * ramp, mask, (1,), white=1.0), plain_tone(ramp, mask, (1,), white=1.0)
    (('black', 1.0), None)
    >>> plain_tone(ramp[..., None], 0 * mask, (1,), white=1.0)  # shows nothing
    """
    step = max(1, math.isqrt(mask.size // _TONE_SAMPLE))
    is_shown = np.isin(mask[::step, ::step], shown)
    cells = picture[::step, ::step][is_shown].astype(np.float64) / white
    cells = cells[:, None] if picture.ndim == 2 else cells
    cells = cells[np.isfinite(cells).all(axis=1)]
    if len(cells) < _TONE_CELLS_MIN:
        return None
    shares: Mapping[str, float] = {
        "black": float((cells <= _DARK).all(axis=1).mean()),
        "white": float((cells >= 1.0 - _DARK).all(axis=1).mean()),
        "one value": float((np.abs(cells - np.median(cells, axis=0)) <= _LEVEL).all(axis=1).mean()),
    }
    tone = max(shares, key=lambda name: shares[name])
    return (tone, shares[tone]) if shares[tone] >= _PLAIN_SHARE else None
