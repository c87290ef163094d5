"""Compiled matching of many small patches between two pictures of several channels.

Every patch is worked on by itself, so that the number of threads does not show in the result.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

# Patches are smooth: every second cell suffices to find the whole-cell shift.
_STRIDE: Final = 2
_ITERATIONS: Final = 12
_CONVERGED_CELLS: Final = 0.002
_STEP_MOST_CELLS: Final = 0.7
_KNOWN_SHARE_LEAST: Final = 0.3


class Picture(NamedTuple):
    """A picture of several channels.

    Attributes:
        values: (rows, cols, c) float32.
        known: (rows, cols) float32, 1 where values mean something, else 0.
    """

    values: NDArray[np.float32]
    known: NDArray[np.float32]


@njit(cache=True, nogil=True)
def search_shifts(first, second, places, reach, found):  # type: ignore[no-untyped-def]  # numba infers the types
    """Find the whole-cell shift of each patch with the highest correlation.

    Args:
        first: (rows, cols, c) float32.
        second: likewise.
        places: (n, 2) int64 (column, row), at least half + radius cells from the border.
        reach: half, radius: patches are 2 half + 1 cells wide, shifts up to the radius are tried.
        found: (n, 4) float64, filled with the shift (across, down), its correlation, and its lead
            over the best place elsewhere, -1 where the best lies on the rim of the search.
    """
    half, radius = reach
    side = 2 * radius + 1
    scores = np.empty((side, side))
    for i in range(places.shape[0]):
        at = (places[i, 1], places[i, 0])
        for k in range(side * side):
            to = (at[0] + k // side - radius, at[1] + k % side - radius)
            scores[k // side, k % side] = _correlation(first, second, at, to, half)
        top = np.argmax(scores)
        down, across = top // side, top % side
        found[i, 0] = across - radius
        found[i, 1] = down - radius
        found[i, 2] = scores[down, across]
        found[i, 3] = -1.0
        if 0 < down < side - 1 and 0 < across < side - 1:
            scores[max(0, down - 2) : down + 3, max(0, across - 2) : across + 3] = -1.0
            found[i, 3] = found[i, 2] - scores.max()


@njit(cache=True, nogil=True)
def _correlation(first, second, at, to, half):  # type: ignore[no-untyped-def]
    """Correlation of two patches, each channel without its mean."""
    cross, own, other = 0.0, 0.0, 0.0
    for c in range(first.shape[2]):
        n, sa, sb, saa, sbb, sab = 0, 0.0, 0.0, 0.0, 0.0, 0.0
        for y in range(-half, half + 1, _STRIDE):
            for x in range(-half, half + 1, _STRIDE):
                a = first[at[0] + y, at[1] + x, c]
                b = second[to[0] + y, to[1] + x, c]
                n += 1
                sa += a
                sb += b
                saa += a * a
                sbb += b * b
                sab += a * b
        cross += sab - sa * sb / n
        own += saa - sa * sa / n
        other += sbb - sb * sb / n
    return cross / math.sqrt(max(own * other, 1e-20))


@njit(cache=True, nogil=True)
def match_patches(first, second, places, window, found):  # type: ignore[no-untyped-def]
    """Least-squares matching of each patch: shift, a gain, an offset per channel.

    Args:
        first: `Picture`.
        second: `Picture`.
        places: (n, 2) int64 (column, row) of the patches' centres in the first picture.
        window: (p, p) float64 weights of a patch's cells.
        found: (n, 4) float64: the shift (across, down), improved in place; filled with the
            standard deviation of a coordinate for independent cells, inf where a patch fixes none,
            and the correlation.
    """
    side, n_channels = window.shape[0], first.values.shape[2]
    weight = np.zeros((side, side))
    moved = np.zeros((side, side, n_channels))
    least = _KNOWN_SHARE_LEAST * window.sum()
    for i in range(places.shape[0]):
        place = (places[i, 1], places[i, 0])
        found[i, 2], found[i, 3] = math.inf, 0.0
        for _ in range(_ITERATIONS):
            shift = (found[i, 1], found[i, 0])
            total = _sample(first, second, place, shift, (window, weight, moved))
            if total <= least:
                found[i, 2] = math.inf
                break
            step_down, step_across, sigma, score = _improvement(
                first.values, place, weight, moved, total
            )
            found[i, 2], found[i, 3] = sigma, score
            if not math.isfinite(sigma):
                break
            found[i, 0] -= min(_STEP_MOST_CELLS, max(-_STEP_MOST_CELLS, step_across))
            found[i, 1] -= min(_STEP_MOST_CELLS, max(-_STEP_MOST_CELLS, step_down))
            if max(abs(step_across), abs(step_down)) < _CONVERGED_CELLS:
                break


@njit(cache=True, nogil=True)
def _sample(first, second, place, shift, patch):  # type: ignore[no-untyped-def]
    """Resample the second picture around a shifted place; give the sum of the weights."""
    window, weight, moved = patch
    rows, columns, n_channels = second.values.shape
    side = window.shape[0]
    half = side // 2
    low_y, low_x = math.floor(place[0] + shift[0]), math.floor(place[1] + shift[1])
    reach = half + 3
    if not (
        reach <= low_x < columns - reach
        and reach <= low_y < rows - reach
        and reach <= place[1] < columns - reach
        and reach <= place[0] < rows - reach
    ):
        return 0.0
    across = _cubic(place[1] + shift[1] - low_x)
    down = _cubic(place[0] + shift[0] - low_y)
    total = 0.0
    for y in range(side):
        for x in range(side):
            r, q = low_y + y - half, low_x + x - half
            known = second.known[r, q] * second.known[r, q + 1]
            known *= second.known[r + 1, q] * second.known[r + 1, q + 1]
            known *= first.known[place[0] + y - half, place[1] + x - half]
            weight[y, x] = window[y, x] * known
            total += weight[y, x]
            for c in range(n_channels):
                value = 0.0
                for k in range(4):
                    line = 0.0
                    for m in range(4):
                        line += across[m] * second.values[r - 1 + k, q - 1 + m, c]
                    value += down[k] * line
                moved[y, x, c] = value
    return total


@njit(cache=True, nogil=True)
def _cubic(t):  # type: ignore[no-untyped-def]
    """Cubic convolution (Keys 1981, a = -1/2): weights of four neighbours at fraction t."""
    return (
        ((-0.5 * t + 1.0) * t - 0.5) * t,
        (1.5 * t - 2.5) * t * t + 1.0,
        ((-1.5 * t + 2.0) * t + 0.5) * t,
        (0.5 * t - 0.5) * t * t,
    )


@njit(cache=True, nogil=True)
def _improvement(values, place, weight, moved, total):  # type: ignore[no-untyped-def]
    """One Gauss-Newton step (down, across), its standard deviation, and the correlation."""
    side, n_channels = weight.shape[0], values.shape[2]
    top, left = place[0] - side // 2, place[1] - side // 2
    # Sums of products of: reference, moved, slope across, slope down, channel by channel.
    products = np.zeros((4, 4))
    row = np.empty(4)
    for c in range(n_channels):
        means = np.zeros(4)
        sums = np.zeros((4, 4))
        for y in range(side):
            for x in range(side):
                w = weight[y, x]
                r, q = top + y, left + x
                row[0] = values[r, q, c]
                row[1] = moved[y, x, c]
                row[2] = 0.5 * (values[r, q + 1, c] - values[r, q - 1, c])
                row[3] = 0.5 * (values[r + 1, q, c] - values[r - 1, q, c])
                for k in range(4):
                    means[k] += w * row[k]
                    for m in range(k, 4):
                        sums[k, m] += w * row[k] * row[m]
        for k in range(4):
            for m in range(k, 4):
                products[k, m] += sums[k, m] - means[k] * means[m] / total
    saa, sab, sbb = products[0, 0], products[0, 1], products[1, 1]
    nxx, nxy, nyy = products[2, 2], products[2, 3], products[3, 3]
    determinant = nxx * nyy - nxy * nxy
    if not (determinant > 1e-12 and sbb > 0.0 and sab > 0.0):
        return 0.0, 0.0, math.inf, 0.0
    gain = sab / sbb
    across = gain * products[1, 2] - products[0, 2]
    down = gain * products[1, 3] - products[0, 3]
    noise = max(saa - gain * sab, 0.0) / (total * n_channels)
    # Inverse compositional: the slopes are those of the unmoved picture.
    return (
        (nxx * down - nxy * across) / determinant,
        (nyy * across - nxy * down) / determinant,
        math.sqrt(noise * 0.5 * (nxx + nyy) / determinant),
        sab / math.sqrt(saa * sbb),
    )
