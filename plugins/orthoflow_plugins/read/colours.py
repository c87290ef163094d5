"""Colours of unknown scale to 8 bits, in one pass: 0..1, 0..255, or 16 bits."""

from __future__ import annotations

from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

RgbScale = Literal["0..1", "8 bit", "16 bit", "stated limit"]

_ORDER: Final[dict[RgbScale, int]] = {"0..1": 0, "8 bit": 1, "16 bit": 2, "stated limit": 3}


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
        if self.scale is not None and _ORDER[seen] <= _ORDER[self.scale]:
            return
        before = self._stored[: self._count]
        if self.scale == "0..1" and seen == "8 bit":
            # What looked like full brightness was 0 or 1 of 255.
            before[:] = np.rint(before / np.float32(255.0)).astype(np.uint8)
        elif self.scale is not None and seen == "16 bit":
            before[:] = 0
        self.scale = seen


def _scale_of(rgb: NDArray[np.generic]) -> RgbScale:
    largest = float(np.nanmax(rgb.astype(np.float32), initial=0.0))
    if largest > 255.0:
        return "16 bit"
    return "8 bit" if rgb.dtype.kind in "iu" or largest > 1.0 else "0..1"


def _to_bytes(
    values: NDArray[np.float32], scale: RgbScale | None, limit: float | None
) -> NDArray[np.uint8]:
    if limit is not None:
        scaled = values if limit == 255.0 else values * np.float32(255.0 / limit)
    elif scale == "16 bit":
        # Exact for 8-bit values times 256 and times 257 alike.
        scaled = np.floor(values / np.float32(256.0))
    elif scale == "0..1":
        scaled = values * np.float32(255.0)
    else:
        scaled = values
    whole = np.rint(np.clip(np.nan_to_num(scaled), 0.0, 255.0))
    return whole.astype(np.uint8)
