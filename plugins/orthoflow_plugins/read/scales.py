"""Normalisation of intensities to 0..1 and of colours to 8 bits.

Each scan is scaled separately. The limits in its metadata are used if the data are within these
limits; otherwise, the limits are those of the data. A few extreme values, such as those from a
reflector, do not affect the scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.levels import REC_601

RgbScale = Literal["0..1", "8 bit", "10 bit", "12 bit", "16 bit", "stated limit"]

# Values of full brightness; a scale is replaced when a value beyond it is found.
_FULL: Final[dict[RgbScale, float]] = {
    "0..1": 1.0,
    "8 bit": 255.0,
    "10 bit": 1023.0,
    "12 bit": 4095.0,
    "16 bit": 65535.0,
}

_BLOCK: Final = 1 << 16
_SAMPLE: Final = 200_000
# An intensity with at least this correlation with the brightness of the colours is considered a
# copy of it. The correlation is 0.99997 for lion-takanawa, whose intensity is such a copy. It is
# far lower for laser intensity at 532..1550 nm, unless a scene has only two colours.
_LUMINANCE_CORRELATION: Final = 0.999
# Tolerance in grey levels; two roundings to 8 bits cause differences of 0.4 grey levels.
_ROUNDING_LEVELS: Final = 0.7
# A value is extreme if its distance from the range of these percentiles exceeds the width of this
# range.
_PERCENTILES: Final = (2.0, 98.0)
# If no scan reaches at least this part of the range in its metadata, the range is that of the
# sensor, and images scaled by it would be black.
_SMALLEST_PART: Final = 0.25
# Scans whose ranges overlap by at least this part are scaled together, so that the same surface has
# the same brightness in all of them.
_COMMON_PART: Final = 0.4
# Ranges that scanners and programs write. They are used for scans that have no limits and differ
# from other scans. The first range that contains the data of a scan is used if the data cover
# enough of it.
_NOMINAL: Final = ((0.0, 1.0), (0.0, 255.0), (-2048.0, 2047.0), (0.0, 4095.0), (0.0, 65535.0))
_NOMINAL_PART: Final = 0.4
# Colours outside a scale do not change it if their share is smaller than this.
_STRAY_SHARE: Final = 0.001


@dataclass(frozen=True, kw_only=True)
class IntensityScale:
    """The linear scale from the intensities of a scan to 0..1.

    Attributes:
        low: intensity that maps to 0.
        high: intensity that maps to 1.
        rule: source of the scale: `intensity_max`, `stated`, `nominal` or `data`.
        stated: limits in the metadata that are not used because the data do not fit them.
    """

    low: float
    high: float
    rule: Literal["intensity_max", "stated", "nominal", "data"]
    stated: tuple[float, float] | None = None


def robust_range(values: NDArray[np.float32]) -> tuple[float, float] | None:
    """Return the smallest and the largest value that are not extreme; None if none is finite."""
    sample = values[:: max(1, len(values) // _SAMPLE)]
    sample = sample[np.isfinite(sample)]
    if not len(sample):
        return None
    low, high = (float(value) for value in np.percentile(sample, _PERCENTILES))
    if high > low:
        sample = sample[(sample >= 2.0 * low - high) & (sample <= 2.0 * high - low)]
    return float(sample.min()), float(sample.max())


def choose_scales(
    ranges: Sequence[tuple[float, float] | None],
    stated: Sequence[tuple[float, float] | None],
    intensity_max: float | None,
) -> list[IntensityScale | None]:
    """Choose the scale of each scan.

    Args:
        ranges: `robust_range` of the data of each scan; None if a scan has no intensity.
        stated: limits in the metadata of each scan, or None.
        intensity_max: intensity of full brightness given by the user, or None.

    Returns:
        The scale is given by the user, or by the limits in the metadata if the data are within
        these limits and cover more than a small part of them. Otherwise, it is the range of the
        data, which is common to scans with similar ranges. If scans differ, this range is replaced
        by a nominal range if the data fill enough of it.
    """
    scales: list[IntensityScale | None] = [None] * len(ranges)
    known = [(seen, one) for seen, one in zip(ranges, stated, strict=True) if seen and one]
    # Largest value of each scan, relative to the range of the limits.
    parts = [(s[1] - one[0]) / (one[1] - one[0]) for s, one in known if _is_within(s, one)]
    largest_part = max(parts, default=0.0)
    groups: list[tuple[list[int], tuple[float, float]]] = []
    for k, (seen, limits) in enumerate(zip(ranges, stated, strict=True)):
        if seen is None:
            continue
        if intensity_max is not None:
            scales[k] = IntensityScale(low=0.0, high=intensity_max, rule="intensity_max")
        elif limits is not None and _is_within(seen, limits) and largest_part >= _SMALLEST_PART:
            scales[k] = IntensityScale(low=limits[0], high=limits[1], rule="stated")
        else:
            _join(groups, k, seen)
    differ = len(groups) + any(scale is not None for scale in scales) > 1
    for members, seen in groups:
        low, high = seen if seen[1] > seen[0] else (min(0.0, seen[0]), max(seen[1], 0.0))
        nominal = _nominal(seen) if differ else None
        for k in members:
            scales[k] = IntensityScale(
                low=low if nominal is None else nominal[0],
                high=high if nominal is None else nominal[1],
                rule="data" if nominal is None else "nominal",
                stated=stated[k],
            )
    return scales


def _nominal(seen: tuple[float, float]) -> tuple[float, float] | None:
    for low, high in _NOMINAL:
        if low <= seen[0] and seen[1] <= high:
            return (low, high) if seen[1] - seen[0] >= _NOMINAL_PART * (high - low) else None
    return None


def _is_within(seen: tuple[float, float], limits: tuple[float, float]) -> bool:
    slack = 1e-6 * (limits[1] - limits[0])
    return limits[0] - slack <= seen[0] and seen[1] <= limits[1] + slack


def _join(
    groups: list[tuple[list[int], tuple[float, float]]], k: int, seen: tuple[float, float]
) -> None:
    """Add a scan to the first group with a similar range, or to a new group."""
    for place, (members, (low, high)) in enumerate(groups):
        common = min(high, seen[1]) - max(low, seen[0])
        together = max(high, seen[1]) - min(low, seen[0])
        if together <= 0.0 or common >= _COMMON_PART * together:
            groups[place] = ([*members, k], (min(low, seen[0]), max(high, seen[1])))
            return
    groups.append(([k], seen))


def normalise(intensity: NDArray[np.float32], scale: IntensityScale) -> int:
    """Scale intensities to 0..1 in place; values that are not finite become NaN.

    Args:
        intensity: (n,) values as read.
        scale: the intensities that map to 0 and 1.

    Returns:
        The number of values that were clipped because they were outside the scale.
    """
    n_clipped = 0
    width = scale.high - scale.low
    for start in range(0, len(intensity), _BLOCK):
        part = intensity[start : start + _BLOCK]
        scaled = part.astype(np.float64)
        scaled -= scale.low
        if width != 0.0:
            scaled /= width
        lowest, highest = scaled.min(), scaled.max()
        # Comparisons with NaN are False.
        if not (lowest >= -1e-6 and highest <= 1.0 + 1e-6):
            is_finite = np.isfinite(scaled)
            n_clipped += int(
                np.count_nonzero(is_finite & ((scaled < -1e-6) | (scaled > 1.0 + 1e-6)))
            )
            scaled[~is_finite] = np.nan
        part[:] = np.clip(scaled, 0.0, 1.0)
    return n_clipped


def correlation_with_grey(
    intensity: NDArray[np.float32],
    rgb: NDArray[np.uint8],
    has_rgb: NDArray[np.bool_] | None = None,
) -> float | None:
    """Return the correlation between intensity and brightness if the intensity is a copy.

    Returns:
        The correlation; None if intensity and brightness differ by more than rounding errors, or if
        too few points have both.
    """
    step = max(1, len(intensity) // _SAMPLE)
    values = intensity[::step].astype(np.float64)
    colours = rgb[::step].astype(np.float64)
    has_both = np.isfinite(values) if has_rgb is None else np.isfinite(values) & has_rgb[::step]
    values, colours = values[has_both], colours[has_both]
    greys = (colours @ REC_601, colours.mean(axis=1))
    correlation, grey = max(
        ((_correlation(values, grey), grey) for grey in greys), key=lambda item: item[0]
    )
    if correlation < _LUMINANCE_CORRELATION:
        return None
    apart_levels = float(grey.std()) * float(np.sqrt(max(0.0, 1.0 - correlation**2)))
    return correlation if apart_levels <= _ROUNDING_LEVELS else None


def is_grey(rgb: NDArray[np.uint8]) -> bool:
    """Return whether all colours in a sample of the points are grey."""
    part = rgb[:: max(1, len(rgb) // _SAMPLE)]
    return bool(np.all(part[:, 0] == part[:, 1]) and np.all(part[:, 1] == part[:, 2]))


class ColourScale:
    """Detection of the scale of the colours of a scan while they are read.

    LAS files contain 8-bit colours unscaled, or multiplied by 256 or 257. Text and PLY files use
    0..1 or 0..255. Some files contain values from 10-bit or 12-bit cameras that were not scaled to
    16 bits. If a block exceeds the current scale, the colours stored so far are rescaled. A limit
    in the metadata is used if the data reach more than 1/255 of it and do not exceed it.

    Attributes:
        scale: scale of the values read so far.
        misfit: the limit in the metadata if the data do not fit it, otherwise None.
        largest: largest value read so far, except for a few outliers.
    """

    def __init__(self, stored: NDArray[np.uint8], limit: float | None) -> None:
        """Start with the colours of a scan.

        Args:
            stored: (n, 3) output for the colours, starting at the first point of the scan.
            limit: value of full brightness in the metadata, or None.
        """
        self._stored = stored
        self._limit = limit
        self._count = 0
        self.scale: RgbScale | None = None
        self.misfit: float | None = None
        self.largest = 0.0

    def add(self, rgb: NDArray[np.generic], has_rgb: NDArray[np.bool_] | None = None) -> None:
        """Store the next colours (n, 3); `has_rgb` (n,) marks the points with valid colours."""
        values = rgb.astype(np.float32)
        valid = values if has_rgb is None else values[has_rgb]
        if valid.size:
            self._widen(_largest(valid), is_whole=rgb.dtype.kind in "iu")
        target = self._stored[self._count : self._count + len(values)]
        target[:] = _to_bytes(values, self.scale, self._limit)
        self._count += len(values)

    def _widen(self, largest: float, *, is_whole: bool) -> None:
        self.largest = max(self.largest, largest)
        limit = self._limit
        seen: RgbScale = "8 bit"
        if largest > 255.0:
            depths: tuple[RgbScale, ...] = ("10 bit", "12 bit", "16 bit")
            fitting = (one for one in depths if largest <= _FULL[one])
            # A 16-bit limit also applies to dark colours.
            is_stated = limit is not None and largest <= limit
            seen = "16 bit" if is_stated else next(fitting, "16 bit")
        elif largest <= 1.0 and (limit == 1.0 or (limit is None and not is_whole)):
            seen = "0..1"
        if limit is not None and 255.0 < largest <= limit < 65535.0:
            seen = "stated limit"
        full = {**_FULL, "stated limit": limit or 0.0}
        if self.scale is None:
            self.scale = seen
        elif full[seen] > full[self.scale]:
            # The values stored so far were scaled with too low a value for full brightness.
            before = self._stored[: self._count]
            before[:] = np.rint(before * np.float32(full[self.scale] / full[seen]))
            self.scale = seen
        fits = limit is None or full[self.scale] == limit or self.largest <= 1.0
        # Metadata may contain a 16-bit limit for any data stored in 16 bits.
        self.misfit = None if fits or (limit == 65280.0 and self.scale == "16 bit") else limit


def _correlation(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    if len(first) < 100 or first.std() == 0.0 or second.std() == 0.0:
        return 0.0
    return float(np.corrcoef(first, second)[0, 1])


def _largest(rgb: NDArray[np.float32]) -> float:
    """Return the largest value of an array (n, 3), except for a few outliers."""
    largest = float(np.nanmax(rgb, initial=0.0))
    if largest > 255.0:
        n_beyond = int(np.count_nonzero(rgb > np.float32(255.0)))
        if n_beyond < _STRAY_SHARE * rgb.size:
            return float(rgb[rgb <= np.float32(255.0)].max())
    return largest


def _to_bytes(
    values: NDArray[np.float32], scale: RgbScale | None, limit: float | None
) -> NDArray[np.uint8]:
    scaled = values
    if scale == "stated limit" and limit is not None:
        scaled = values * np.float32(255.0 / limit)
    elif scale == "16 bit":
        # The result is exact for 8-bit values that were multiplied by 256 or 257.
        scaled = np.floor(values / np.float32(256.0))
    elif scale is not None and scale != "8 bit":
        scaled = values * np.float32(255.0 / _FULL[scale])
    whole = np.rint(np.clip(np.nan_to_num(scaled), 0.0, 255.0))
    return whole.astype(np.uint8)
