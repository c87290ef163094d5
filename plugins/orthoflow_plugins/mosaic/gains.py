"""Gains of overlapping layers: what makes their colours alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.bands import row_bands
from orthoflow.geometry.levels import Colours, eight_bits
from orthoflow.products import Layer, LayerMask

# Overlaps are compared on every so manieth cell: a few thousand colours say what a gain is.
_SAMPLES_MOST: Final = 20_000
_LEAST_SAMPLES: Final = 100
# Clipped and almost black pixels say nothing of exposure.
_DARKEST, _BRIGHTEST = 10, 245
# As much as a tenth of what an overlap says, so that a chain of photos does not drift.
_PRIOR: Final = 0.1


def balanced(layers: Sequence[Layer], gains: NDArray[np.float64]) -> list[Layer]:
    """Multiply the light of each layer by its gains (k, 3), per channel."""
    return [
        replace(layer, rgb=_with_gain(layer.rgb, gain))
        for layer, gain in zip(layers, gains, strict=True)
    ]


def estimate_gains(layers: Sequence[Layer]) -> NDArray[np.float64]:
    """Gains (k, 3) per layer and channel that make overlaps most alike, in linear light.

    Least squares of the logarithms over all pairs of layers (median ratio of each), with a prior
    of 1 for every gain.
    """
    count = len(layers)
    normal = _PRIOR * np.eye(count)
    right = np.zeros((count, 3))
    for i, j in combinations(range(count), 2):
        ratio = _median_log_ratio(layers[i], layers[j])
        if ratio is None:
            continue
        # Wanted: log g_i + log c_i = log g_j + log c_j.
        normal[i, i] += 1.0
        normal[j, j] += 1.0
        normal[i, j] -= 1.0
        normal[j, i] -= 1.0
        right[i] -= ratio
        right[j] += ratio
    gains: NDArray[np.float64] = np.exp(np.linalg.solve(normal, right))
    return gains


def _median_log_ratio(first: Layer, second: Layer) -> NDArray[np.float64] | None:
    """Median of log(first / second) per channel in linear light, None without an overlap."""
    both = _sampled_overlap(first.mask, second.mask)
    one, other = (eight_bits(layer.rgb.reshape(-1, 3)[both]) for layer in (first, second))
    usable = np.all(
        (np.minimum(one, other) >= _DARKEST) & (np.maximum(one, other) <= _BRIGHTEST), axis=1
    )
    if np.count_nonzero(usable) < _LEAST_SAMPLES:
        return None
    light = _linear_light(256)
    ratio: NDArray[np.float64] = np.median(
        np.log(light[one[usable]]) - np.log(light[other[usable]]), axis=0
    )
    return ratio


def _sampled_overlap(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Every so manieth of the cells (flat) that two layers paint, in their order."""

    def overlap(rows: slice) -> NDArray[np.bool_]:
        is_painted = (first[rows] == LayerMask.PAINTED) & (second[rows] == LayerMask.PAINTED)
        return np.asarray(is_painted, dtype=np.bool_)

    bands = list(row_bands(first.shape))
    counts = [int(np.count_nonzero(overlap(rows))) for rows in bands]
    step = max(1, sum(counts) // _SAMPLES_MOST)
    found, seen = [np.empty(0, dtype=np.int64)], 0
    for rows, count in zip(bands, counts, strict=True):
        cells = np.flatnonzero(overlap(rows))[-seen % step :: step]
        found.append(cells + rows.start * first.shape[1])
        seen += count
    return np.concatenate(found)


def _linear_light(n_levels: int) -> NDArray[np.float64]:
    """Light of each of the levels of sRGB (IEC 61966-2-1), 0..1."""
    level = np.arange(n_levels) / (n_levels - 1.0)
    light: NDArray[np.float64] = np.where(
        level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4
    )
    return light


def _with_gain(rgb: Colours, gain: NDArray[np.float64]) -> Colours:
    highest = np.iinfo(rgb.dtype).max
    light = np.clip(_linear_light(highest + 1)[:, None] * gain, 0.0, 1.0)
    level = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)
    table = np.rint(float(highest) * level).astype(rgb.dtype)
    return np.stack([table[rgb[..., band], band] for band in range(3)], axis=-1)
