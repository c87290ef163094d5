"""Statistics of many values: exact medians and percentiles of more than fit into memory."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.bands import Allocate
from orthoflow.geometry.robust import NMAD_FACTOR, median_deviation

# Larger arrays are kept in files and processed this many values at once.
_AT_ONCE: Final = 1 << 22
_DIGIT_BITS: Final = 16
_SIGN: Final = np.uint64(1 << 63)

_Value = TypeVar("_Value", bound=np.generic)


@dataclass(frozen=True)
class Spread:
    """Values, times a factor, whose statistics are computed.

    Attributes:
        values: (n,) float64, at least one, none NaN; a large array may be in a file.
        factor: multiplier of each value.
    """

    values: NDArray[np.float64]
    factor: float = 1.0

    @property
    def is_large(self) -> bool:
        """Whether the values are processed in parts."""
        return len(self.values) > _AT_ONCE

    def rms(self) -> float:
        """Root mean square."""
        return math.sqrt(sum(float(np.square(part).sum()) for part in self._parts()) / self._count)

    def mean(self) -> float:
        """Mean."""
        return sum(float(part.sum()) for part in self._parts()) / self._count

    def median(self) -> float:
        """Median."""
        if not self.is_large:
            return float(np.median(self._whole()))
        return self._percentile(50.0, None)

    def median_deviation(self, middle: float | None = None) -> float:
        """Standard deviation from the median distance to a middle, the median unless given."""
        if not self.is_large:
            return median_deviation(self._whole(), middle)
        return NMAD_FACTOR * self._percentile(50.0, self.median() if middle is None else middle)

    def percentile_of_size(self, percent: float) -> float:
        """Return the percentile of the absolute values, interpolated linearly."""
        if not self.is_large:
            return float(np.percentile(np.abs(self._whole()), percent))
        return self._percentile(percent, 0.0)

    @property
    def _count(self) -> int:
        return len(self.values)

    def _whole(self) -> NDArray[np.float64]:
        return self.values if self.factor == 1.0 else self.factor * self.values

    def _parts(self) -> Iterator[NDArray[np.float64]]:
        for first in range(0, self._count, _AT_ONCE):
            yield self.factor * self.values[first : first + _AT_ONCE]

    def _percentile(self, percent: float, middle: float | None) -> float:
        """Return the percentile of the values, or of their distances to a middle."""
        place = (self._count - 1) * (percent / 100.0)
        lower = math.floor(place)
        low = self._at_rank(lower, middle)
        if place == lower:
            return low
        return low + (place - lower) * (self._at_rank(lower + 1, middle) - low)

    def _at_rank(self, rank: int, middle: float | None) -> float:
        """Return the value at a rank: its bits are found from the highest on."""
        found, n_before = 0, 0
        for shift in range(64 - _DIGIT_BITS, -1, -_DIGIT_BITS):
            counts = np.zeros(1 << _DIGIT_BITS, dtype=np.int64)
            for part in self._parts():
                keys = _keys(part if middle is None else np.abs(part - middle))
                # Those that begin with the bits found so far, initially all.
                known = shift + _DIGIT_BITS
                alike = (
                    keys if known == 64 else keys[(keys >> np.uint64(known)) == np.uint64(found)]
                )
                digits = (alike >> np.uint64(shift)) & np.uint64((1 << _DIGIT_BITS) - 1)
                counts += np.bincount(digits.astype(np.int64), minlength=counts.size)
            up_to = n_before + np.cumsum(counts)
            digit = int(np.searchsorted(up_to, rank, side="right"))
            n_before = int(up_to[digit] - counts[digit])
            found = (found << _DIGIT_BITS) | digit
        key = np.uint64(found)
        bits = key ^ _SIGN if key & _SIGN else ~key
        return float(np.array([bits], dtype=np.uint64).view(np.float64)[0])


def in_file(values: NDArray[_Value], name: str, allocate: Allocate) -> NDArray[_Value]:
    """Return a copy of an array in the memory that `allocate` returns."""
    kept: NDArray[_Value] = np.asarray(allocate(name, values.shape, values.dtype), values.dtype)
    kept[...] = values
    return kept


def _keys(values: NDArray[np.float64]) -> NDArray[np.uint64]:
    """Return integers that sort like the values."""
    bits = np.ascontiguousarray(values).view(np.uint64)
    return np.where(bits & _SIGN, ~bits, bits | _SIGN)
