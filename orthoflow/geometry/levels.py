"""Conversion between colour levels with 8 and 16 bits per channel.

White is 255 with 8 bits and 65535 with 16 bits, so multiplying an 8-bit level by 257 gives the
16-bit level.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

Colours: TypeAlias = NDArray[np.uint8 | np.uint16]
Level: TypeAlias = type[np.uint8] | type[np.uint16]

# Weights of red, green and blue in luma (Rec. 601, as in OpenCV).
REC_601: Final = np.array([0.299, 0.587, 0.114])
# 16-bit levels per 8-bit level.
DEEPER: Final = 257
# Number of steps in the table from linear light to levels; the relation is nearly linear within a
# step.
_STEPS: Final = 1 << 16
# An image has a single tone if at least this share of its cells is almost black, almost white, or
# differs from the median by at most one of 256 levels.
_PLAIN_SHARE: Final = 0.98
# Cells are almost black (or white) if they differ from black (or white) by less than this share of
# the brightness of white.
_DARK: Final = 0.03
_LEVEL: Final = 0.5 / 255.0
_TONE_SAMPLE: Final = 40_000
# Images with fewer cells are not checked.
_TONE_CELLS_MIN: Final = 2000


def eight_bits(colours: Colours) -> NDArray[np.uint8]:
    """Return colours with 8 bits, rounded from 16 bits if necessary."""
    if colours.dtype == np.uint8:
        return colours.view(np.uint8)
    return ((colours.astype(np.uint32) + DEEPER // 2) // DEEPER).astype(np.uint8)


def sixteen_bits(colours: Colours) -> NDArray[np.uint16]:
    """Return colours with 16 bits; 8 bits are converted without loss."""
    if colours.dtype == np.uint16:
        return colours.view(np.uint16)
    return colours.astype(np.uint16) * np.uint16(DEEPER)


def in_levels(colours: Colours, level: Level) -> Colours:
    """Return colours with 8 or 16 bits."""
    return eight_bits(colours) if level is np.uint8 else sixteen_bits(colours)


def level_of(colours: Colours) -> Level:
    """Return the number of bits per channel of colours."""
    return np.uint16 if colours.dtype == np.uint16 else np.uint8


@cache
def light_of_levels(highest: int) -> NDArray[np.float32]:
    """Return the linear light, 0 to 1, of sRGB levels 0 to `highest` (IEC 61966-2-1)."""
    level = np.arange(highest + 1) / float(highest)
    light = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    return light.astype(np.float32)


@cache
def _share_of_light() -> NDArray[np.float32]:
    """Return levels, 0 to 1, at equal steps of light, and an extra entry for interpolation."""
    light = np.minimum(np.arange(_STEPS + 1) / (_STEPS - 1.0), 1.0)
    level = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)
    return level.astype(np.float32)


def lit_shares(
    levels: NDArray[np.floating], log_gains: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Multiply the linear light of sRGB levels (n, 3), 0 to 1, by exp(log_gains), (n, 3)."""
    light = np.interp(levels, np.linspace(0.0, 1.0, _STEPS), light_of_levels(_STEPS - 1))
    # `interp` clips light to white, the end of the table.
    gained = light * np.exp(log_gains)
    levels = np.interp(gained, np.linspace(0.0, 1.0, _STEPS), _share_of_light()[:_STEPS])
    return np.asarray(levels, dtype=np.float64)


def lit(colours: Colours, log_gains: NDArray[np.float32]) -> Colours:
    """Multiply the linear light of colours (n, 3) by exp(log_gains), (n, 3)."""
    highest = int(np.iinfo(colours.dtype).max)
    light = light_of_levels(highest)[colours] * np.exp(log_gains)
    place = np.clip(light, 0.0, 1.0) * np.float32(_STEPS - 1)
    before = place.astype(np.int32)
    table = _share_of_light()
    level = table[before] + (place - before) * (table[before + 1] - table[before])
    return np.asarray(np.rint(np.float32(highest) * level), dtype=colours.dtype)


def plain_tone(
    picture: NDArray[np.generic], mask: NDArray[np.uint8], shown: Sequence[int], *, white: float
) -> tuple[str, float] | None:
    """Check whether an image is almost entirely black, white or of a single colour.

    Args:
        picture: (rows, cols) or (rows, cols, 3); NaN is ignored.
        mask: (rows, cols) states of the cells.
        shown: the states of cells with content.
        white: the value of maximum brightness.

    Returns:
        `black`, `white` or `one value`, and the share of cells with this tone; None if the image
        has several tones or too few cells.

    >>> ramp, mask = np.linspace(0.0, 1.0, 2000)[None], np.ones((1, 2000), dtype=np.uint8)
    >>> plain_tone(0.0 * ramp, mask, (1,), white=1.0), plain_tone(ramp, mask, (1,), white=1.0)
    (('black', 1.0), None)
    >>> plain_tone(ramp[..., None], 0 * mask, (1,), white=1.0)  # no cell has content
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
