"""Intensities and colours of unknown scale: intensity to 0..1, colours to 8 bits.

One linear scale serves the intensities of a whole cloud, and whether they are the laser's at all
is asked. Colours, 0..1, 0..255 or 16 bits, are scaled in the pass that reads them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.levels import REC_601

RgbScale = Literal["0..1", "8 bit", "16 bit", "stated limit"]

# A wider scale corrects a narrower one.
_WIDTHS: Final[dict[RgbScale, int]] = {"0..1": 0, "8 bit": 1, "16 bit": 2, "stated limit": 3}

_BLOCK: Final = 1 << 16
_SAMPLE: Final = 200_000
# lion-takanawa, whose intensity is the grey of its colours, has 0.99997; laser intensity at
# 532..1550 nm stays far below.
LUMINANCE_CORRELATION: Final = 0.999


@dataclass(frozen=True, kw_only=True)
class IntensityScale:
    """The linear scale from a file's intensities to 0..1.

    Attributes:
        low: what becomes 0.
        high: what becomes 1.
        rule: where the two come from.
    """

    low: float
    high: float
    rule: str


def choose_scale(
    seen: tuple[float, float],
    stated: Sequence[tuple[float, float] | None],
    intensity_max: float | None,
) -> IntensityScale:
    """Choose one scale for all scans, so that equal surfaces stay equal.

    Args:
        seen: smallest and largest value of the data.
        stated: limits that each file states.
        intensity_max: what the user says is full intensity, or None.

    Returns:
        The user's; else the limits that all files state, when the data keep to them; else the
        range of the data.
    """
    if intensity_max is not None:
        return IntensityScale(low=0.0, high=intensity_max, rule="0 to intensity_max")
    low, high = seen
    known = [item for item in stated if item is not None]
    if known and len(known) == len(stated):
        bottom, top = min(item[0] for item in known), max(item[1] for item in known)
        slack = 1e-6 * (top - bottom)
        if bottom - slack <= low and high <= top + slack:
            return IntensityScale(low=bottom, high=top, rule="limits that the files state")
    if high > low:
        return IntensityScale(low=low, high=high, rule="range of the data")
    return IntensityScale(low=min(0.0, low), high=max(high, 0.0), rule="0 to the only value")


def normalise(
    intensity: NDArray[np.float32], scale: IntensityScale, *, may_exceed: bool = True
) -> int:
    """Scale in place to 0..1, what is not finite to 0.

    Args:
        intensity: (n,) as read.
        scale: what becomes 0 and 1.
        may_exceed: whether there may be values beyond the scale, or that are not finite.

    Returns:
        How many values lay beyond the scale and were clipped.
    """
    n_clipped = 0
    for start in range(0, len(intensity), _BLOCK):
        part = intensity[start : start + _BLOCK]
        scaled = part.astype(np.float64)
        scaled -= scale.low
        scaled /= scale.high - scale.low
        if may_exceed:
            n_clipped += int(np.count_nonzero((scaled < -1e-6) | (scaled > 1.0 + 1e-6)))
            scaled = np.clip(np.nan_to_num(scaled, nan=0.0, posinf=0.0, neginf=0.0), 0.0, 1.0)
        part[:] = scaled
    return n_clipped


def correlation_with_grey(intensity: NDArray[np.float32], rgb: NDArray[np.uint8]) -> float:
    """Correlation of intensity with the grey of the colours, on a sample; 0 where undefined."""
    step = max(1, len(intensity) // _SAMPLE)
    values = intensity[::step].astype(np.float64)
    colours = rgb[::step].astype(np.float64)
    greys = (colours @ REC_601, colours.mean(axis=1))
    return max(_correlation(values, grey) for grey in greys)


def is_grey(rgb: NDArray[np.uint8]) -> bool:
    """Whether every colour of a sample is a grey."""
    part = rgb[:: max(1, len(rgb) // _SAMPLE)]
    return bool(np.all(part[:, 0] == part[:, 1]) and np.all(part[:, 1] == part[:, 2]))


class ColourScale:
    """Finds the scale of one file's colours while they come.

    LAS keeps 8-bit colours in the low byte, or multiplied by 256 or 257; text and PLY keep 0..1 or
    0..255. A block that goes beyond the scale believed so far corrects what was stored before.

    Attributes:
        scale: what the values seen so far say.
    """

    def __init__(self, stored: NDArray[np.uint8], limit: float | None) -> None:
        """Start a file.

        Args:
            stored: (n, 3) where the file's colours go, from its first point on.
            limit: the value of full brightness, if the file states it.
        """
        self._stored = stored
        self._limit = limit
        self._count = 0
        self.scale: RgbScale | None = None if limit is None else "stated limit"

    def add(self, rgb: NDArray[np.generic]) -> None:
        """Store the next colours (n, 3)."""
        values = rgb.astype(np.float32)
        if self._limit is None:
            self._widen(_scale_of(rgb))
        target = self._stored[self._count : self._count + len(values)]
        target[:] = _to_bytes(values, self.scale, self._limit)
        self._count += len(values)

    def _widen(self, seen: RgbScale) -> None:
        if self.scale is not None and _WIDTHS[seen] <= _WIDTHS[self.scale]:
            return
        before = self._stored[: self._count]
        if self.scale == "0..1" and seen == "8 bit":
            # What looked like full brightness was 0 or 1 of 255.
            before[:] = np.rint(before / np.float32(255.0)).astype(np.uint8)
        elif seen == "16 bit":
            before[:] = 0
        self.scale = seen


def _correlation(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    if len(first) < 100 or first.std() == 0.0 or second.std() == 0.0:
        return 0.0
    return float(np.corrcoef(first, second)[0, 1])


def _scale_of(rgb: NDArray[np.generic]) -> RgbScale:
    largest = float(np.nanmax(rgb.astype(np.float32), initial=0.0))
    if largest > 255.0:
        return "16 bit"
    return "8 bit" if rgb.dtype.kind in "iu" or largest > 1.0 else "0..1"


def _to_bytes(
    values: NDArray[np.float32], scale: RgbScale | None, limit: float | None
) -> NDArray[np.uint8]:
    scaled = values
    if limit is not None:
        scaled = values * np.float32(255.0 / limit)
    elif scale == "16 bit":
        # Exact for 8-bit values times 256 and times 257 alike.
        scaled = np.floor(values / np.float32(256.0))
    elif scale == "0..1":
        scaled = values * np.float32(255.0)
    whole = np.rint(np.clip(np.nan_to_num(scaled), 0.0, 255.0))
    return whole.astype(np.uint8)
