"""Compiled matching of many small patches between two pictures of several channels.

Every patch is worked on by itself, so that the number of threads does not show in the result.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part

# Patches are smooth: every second cell suffices to find the whole-cell shift.
_STRIDE: Final = 2
_ITERATIONS: Final = 12
_CONVERGED_CELLS: Final = 0.002
_MAX_STEP_CELLS: Final = 0.7
_MIN_KNOWN_SHARE: Final = 0.3
_RIDGE: Final = 1e-3
# Of the cells that a search looks at, which are every second: neighbours still agree somewhat.
_INDEPENDENT: Final = 1.5


class Picture(NamedTuple):
    """A picture of several channels.

    Attributes:
        values: (rows, cols, c) float32.
        known: (rows, cols) float32, 1 where values mean something, else 0.
    """

    values: NDArray[np.float32]
    known: NDArray[np.float32]


@compiled
def search_shifts(
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    places: NDArray[np.int64],
    reach: tuple[int, int],
    found: NDArray[np.float64],
) -> None:
    """Find the whole-cell shift of each patch with the highest correlation.

    Args:
        first: (rows, cols, c) float32.
        second: likewise.
        places: (n, 2) int64 (column, row), at least half + radius cells from the border.
        reach: half, radius: patches are 2 half + 1 cells wide, shifts up to the radius are tried.
        found: (n, 4) float64, filled with the shift (across, down), its correlation, and its lead
            over the best place elsewhere, -1 where the best lies on the rim of the search.
    """
    side = 2 * reach[1] + 1
    scores = np.empty(side * side)
    for i in range(places.shape[0]):
        at = (places[i, 1], places[i, 0])
        for k in range(side * side):
            to = (at[0] + k // side - reach[1], at[1] + k % side - reach[1])
            scores[k] = _correlation(first, second, at, to, reach[0])
        _take_best(scores, found[i])


@compiled
def search_mixtures(
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    places: NDArray[np.int64],
    reach: tuple[int, int],
    found: NDArray[np.float64],
) -> None:
    """As `search_shifts`, with the mixture of the second's channels that fits best at each shift.

    Args:
        first: (rows, cols, 1) float32.
        second: (rows, cols, 3) float32.
        places: as there.
        reach: as there.
        found: (n, 7) float64, as there, and the gains of the three channels at the best shift.
    """
    side = 2 * reach[1] + 1
    scores = np.empty(side * side)
    gains = np.empty(3)
    for i in range(places.shape[0]):
        at = (places[i, 1], places[i, 0])
        for k in range(side * side):
            to = (at[0] + k // side - reach[1], at[1] + k % side - reach[1])
            scores[k] = _mixed(first, second, (at, to, reach[0]), gains)
        _take_best(scores, found[i, :4])
        to = (at[0] + int(found[i, 1]), at[1] + int(found[i, 0]))
        _mixed(first, second, (at, to, reach[0]), gains)
        found[i, 4], found[i, 5], found[i, 6] = gains[0], gains[1], gains[2]


@kernel_part
def _take_best(scores: NDArray[np.float64], found: NDArray[np.float64]) -> None:
    """Fill in the shift with the highest of (side^2,) scores, the score, and its lead."""
    side = round(math.sqrt(scores.shape[0]))
    top = 0
    for k in range(side * side):
        if scores[k] > scores[top]:
            top = k
    down, across = top // side, top % side
    found[0] = across - side // 2
    found[1] = down - side // 2
    found[2] = scores[top]
    found[3] = -1.0
    if 0 < down < side - 1 and 0 < across < side - 1:
        # Correlations reach down to -1: that much the best leads by where no other place is.
        elsewhere = -1.0
        for k in range(side * side):
            if max(abs(k // side - down), abs(k % side - across)) > 2:
                elsewhere = max(elsewhere, scores[k])
        found[3] = scores[top] - elsewhere


@kernel_part
def _mixed(
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    where: tuple[tuple[int, int], tuple[int, int], int],
    gains: NDArray[np.float64],
) -> float:
    """Correlation of a patch with the best mixture of three channels, whose gains are filled in."""
    at, to, half = where
    n, sa, sb, sc, sd = 0, 0.0, 0.0, 0.0, 0.0
    saa, sab, sac, sad = 0.0, 0.0, 0.0, 0.0
    sbb, sbc, sbd, scc, scd, sdd = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for y in range(-half, half + 1, _STRIDE):
        for x in range(-half, half + 1, _STRIDE):
            a = first[at[0] + y, at[1] + x, 0]
            b = second[to[0] + y, to[1] + x, 0]
            c = second[to[0] + y, to[1] + x, 1]
            d = second[to[0] + y, to[1] + x, 2]
            n += 1
            sa, sb, sc, sd = sa + a, sb + b, sc + c, sd + d
            saa, sab, sac, sad = saa + a * a, sab + a * b, sac + a * c, sad + a * d
            sbb, sbc, sbd = sbb + b * b, sbc + b * c, sbd + b * d
            scc, scd, sdd = scc + c * c, scd + c * d, sdd + d * d
    saa, sab, sac, sad = saa - sa * sa / n, sab - sa * sb / n, sac - sa * sc / n, sad - sa * sd / n
    sbc, sbd, scd = sbc - sb * sc / n, sbd - sb * sd / n, scd - sc * sd / n
    sbb, scc, sdd = sbb - sb * sb / n, scc - sc * sc / n, sdd - sd * sd / n
    # Colours of one material follow each other: their small differences must not decide.
    ridge = _RIDGE * (sbb + scc + sdd) + 1e-12
    sbb, scc, sdd = sbb + ridge, scc + ridge, sdd + ridge
    # Cofactors of the symmetric matrix of products.
    kbb, kcc, kdd = scc * sdd - scd * scd, sbb * sdd - sbd * sbd, sbb * scc - sbc * sbc
    kbc, kbd, kcd = scd * sbd - sbc * sdd, sbc * scd - scc * sbd, sbc * sbd - sbb * scd
    determinant = sbb * kbb + sbc * kbc + sbd * kbd
    gains[0] = (kbb * sab + kbc * sac + kbd * sad) / determinant
    gains[1] = (kbc * sab + kcc * sac + kcd * sad) / determinant
    gains[2] = (kbd * sab + kcd * sac + kdd * sad) / determinant
    explained = gains[0] * sab + gains[1] * sac + gains[2] * sad
    # Three gains fit some of what is chance: of the rest, as much as they may have taken.
    free = n / _INDEPENDENT
    share = explained / max(saa, 1e-20)
    return math.sqrt(max(0.0, 1.0 - (1.0 - share) * (free - 1.0) / max(free - 4.0, 1.0)))


@kernel_part
def _correlation(
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    at: tuple[int, int],
    to: tuple[int, int],
    half: int,
) -> float:
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


@compiled
def match_patches(
    first: Picture,
    second: Picture,
    places: NDArray[np.int64],
    window: NDArray[np.float64],
    patch: tuple[NDArray[np.float64], ...],
    found: NDArray[np.float64],
) -> None:
    """Least-squares matching of each patch: shift, a gain, an offset per channel.

    Args:
        first: `Picture`.
        second: `Picture`.
        places: (n, 2) int64 (column, row) of the patches' centres in the first picture.
        window: (p, p) float64 weights of a patch's cells.
        patch: room to work in: (p, p), (p + 3, p, c) and (p, p, c) float64.
        found: (n, 4) float64: the shift (across, down), improved in place; filled with the
            standard deviation of a coordinate for independent cells, inf where a patch fixes none,
            and the correlation.
    """
    weight, lines, moved = patch
    least = 0.0
    for y in range(len(window)):
        for x in range(len(window)):
            least += _MIN_KNOWN_SHARE * window[y, x]
    for i in range(places.shape[0]):
        place = (places[i, 1], places[i, 0])
        found[i, 2], found[i, 3] = math.inf, 0.0
        for _ in range(_ITERATIONS):
            shift = (found[i, 1], found[i, 0])
            total = _sample(first, second, place, shift, (window, weight, lines, moved))
            if total <= least:
                found[i, 2] = math.inf
                break
            step_down, step_across, sigma, score = _improvement(
                first.values, place, weight, moved, total
            )
            found[i, 2], found[i, 3] = sigma, score
            if not math.isfinite(sigma):
                break
            found[i, 0] -= min(_MAX_STEP_CELLS, max(-_MAX_STEP_CELLS, step_across))
            found[i, 1] -= min(_MAX_STEP_CELLS, max(-_MAX_STEP_CELLS, step_down))
            if max(abs(step_across), abs(step_down)) < _CONVERGED_CELLS:
                break


@kernel_part
def _sample(
    first: Picture,
    second: Picture,
    place: tuple[int, int],
    shift: tuple[float, float],
    patch: tuple[NDArray[np.float64], ...],
) -> float:
    """Resample the second picture around a shifted place; give the sum of the weights."""
    window, weight, lines, moved = patch
    rows, columns, n_channels = second.values.shape
    side = len(window)
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
    for y in range(side + 3):
        r = low_y + y - half - 1
        for x in range(side):
            q = low_x + x - half
            for c in range(n_channels):
                lines[y, x, c] = (
                    across[0] * second.values[r, q - 1, c]
                    + across[1] * second.values[r, q, c]
                    + across[2] * second.values[r, q + 1, c]
                    + across[3] * second.values[r, q + 2, c]
                )
    for y in range(side):
        for x in range(side):
            r, q = low_y + y - half, low_x + x - half
            known = second.known[r, q] * second.known[r, q + 1]
            known *= second.known[r + 1, q] * second.known[r + 1, q + 1]
            known *= first.known[place[0] + y - half, place[1] + x - half]
            weight[y, x] = window[y, x] * known
            total += weight[y, x]
            for c in range(n_channels):
                moved[y, x, c] = (
                    down[0] * lines[y, x, c]
                    + down[1] * lines[y + 1, x, c]
                    + down[2] * lines[y + 2, x, c]
                    + down[3] * lines[y + 3, x, c]
                )
    return total


@kernel_part
def _cubic(t: float) -> tuple[float, float, float, float]:
    """Cubic convolution (Keys 1981, a = -1/2): weights of four neighbours at fraction t."""
    return (
        ((-0.5 * t + 1.0) * t - 0.5) * t,
        (1.5 * t - 2.5) * t * t + 1.0,
        ((-1.5 * t + 2.0) * t + 0.5) * t,
        (0.5 * t - 0.5) * t * t,
    )


@kernel_part
def _improvement(
    values: NDArray[np.float32],
    place: tuple[int, int],
    weight: NDArray[np.float64],
    moved: NDArray[np.float64],
    total: float,
) -> tuple[float, float, float, float]:
    """One Gauss-Newton step (down, across), its standard deviation, and the correlation."""
    side, n_channels = len(weight), values.shape[2]
    top, left = place[0] - side // 2, place[1] - side // 2
    # Sums of products of: a, reference; b, moved; x and y, slopes across and down.
    saa, sab, sbb, nxx, nxy, nyy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    sax, say, sbx, sby = 0.0, 0.0, 0.0, 0.0
    for k in range(n_channels):
        ma, mb, mx, my = 0.0, 0.0, 0.0, 0.0
        for r in range(side):
            for q in range(side):
                w = weight[r, q]
                a = values[top + r, left + q, k]
                b = moved[r, q, k]
                x = 0.5 * (values[top + r, left + q + 1, k] - values[top + r, left + q - 1, k])
                y = 0.5 * (values[top + r + 1, left + q, k] - values[top + r - 1, left + q, k])
                wa, wb, wx, wy = w * a, w * b, w * x, w * y
                ma, mb, mx, my = ma + wa, mb + wb, mx + wx, my + wy
                saa, sab, sbb = saa + wa * a, sab + wa * b, sbb + wb * b
                nxx, nxy, nyy = nxx + wx * x, nxy + wx * y, nyy + wy * y
                sax, say, sbx, sby = sax + wa * x, say + wa * y, sbx + wb * x, sby + wb * y
        saa, sab, sbb = saa - ma * ma / total, sab - ma * mb / total, sbb - mb * mb / total
        nxx, nxy, nyy = nxx - mx * mx / total, nxy - mx * my / total, nyy - my * my / total
        sax, say = sax - ma * mx / total, say - ma * my / total
        sbx, sby = sbx - mb * mx / total, sby - mb * my / total
    determinant = nxx * nyy - nxy * nxy
    if not (determinant > 1e-12 and sbb > 0.0 and sab > 0.0):
        return 0.0, 0.0, math.inf, 0.0
    gain = sab / sbb
    across, down = gain * sbx - sax, gain * sby - say
    noise = max(saa - gain * sab, 0.0) / (total * n_channels)
    # Inverse compositional: the slopes are those of the unmoved picture.
    return (
        (nxx * down - nxy * across) / determinant,
        (nyy * across - nxy * down) / determinant,
        math.sqrt(noise * 0.5 * (nxx + nyy) / determinant),
        sab / math.sqrt(saa * sbb),
    )
