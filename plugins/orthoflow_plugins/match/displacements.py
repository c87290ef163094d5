"""Subpixel displacements between two pictures of a wall at given positions.

Correlation within a radius finds the best shift in whole cells. Least-squares matching (Grün 1985)
then refines the shift and computes its standard deviation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part
from orthoflow.geometry.rows import Rows
from orthoflow.geometry.threads import even_parts, in_threads
from orthoflow_plugins.match.channels import HALF_PATCH_CELLS, Channels

# Patches are smooth, so correlating every second cell is enough to find the whole-cell shift.
_STRIDE: Final = 2
_ITERATIONS: Final = 12
_CONVERGED_CELLS: Final = 0.002
_MAX_STEP_CELLS: Final = 0.7
_MIN_KNOWN_SHARE: Final = 0.3
_RIDGE: Final = 1e-3
# In a search, neighbouring cells are correlated; this many cells count as one independent cell.
_INDEPENDENT: Final = 1.5


@compiled
def search_shifts(
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    places: NDArray[np.int64],
    reach: tuple[int, int],
    found: NDArray[np.float64],
) -> None:
    """Find, for each patch, the whole-cell shift with the highest correlation.

    If the first picture has one channel and the second three, each patch is compared with the
    combination of the three channels that fits it best.

    Args:
        first: (rows, cols, c) float32.
        second: (rows, cols, c) float32, or (rows, cols, 3) for combinations.
        places: (n, 2) int64 (column, row), whose distance from the border is at least the sum of
            both values of `reach`.
        reach: half width of a patch without its middle cell, and search radius, in cells.
        found: (n, 4) float64, filled with the shift (across, down), the correlation at this shift,
            and its lead over the highest correlation at shifts more than two cells away (-1 at the
            border of the search area); for combinations (n, 7), also filled with the gains of the
            three channels.
    """
    side, is_mixed = 2 * reach[1] + 1, found.shape[1] == 7
    scores, gains = np.empty(side * side), np.empty(3)
    for i in range(places.shape[0]):
        at = (places[i, 1], places[i, 0])
        for k in range(side * side):
            to = (at[0] + k // side - reach[1], at[1] + k % side - reach[1])
            if is_mixed:
                scores[k] = _mixed(first, second, (at, to, reach[0]), gains)
            else:
                scores[k] = _correlation(first, second, at, to, reach[0])
        _take_best(scores, found[i, :4])
        if is_mixed:
            to = (at[0] + int(found[i, 1]), at[1] + int(found[i, 0]))
            _mixed(first, second, (at, to, reach[0]), gains)
            for k in range(3):
                found[i, 4 + k] = gains[k]


@kernel_part
def _take_best(scores: NDArray[np.float64], found: NDArray[np.float64]) -> None:
    """Write the shift with the highest of the side^2 scores, its score and its lead to `found`."""
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
        # Without other shifts, the lead is relative to the lowest possible correlation.
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
    """Return the correlation of a patch with the best combination of three channels.

    The gains of the three channels are written to `gains`.
    """
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
    # The channels of one material are nearly collinear, so ridge regression prevents their small
    # differences from dominating.
    ridge = _RIDGE * (sbb + scc + sdd) + 1e-12
    sbb, scc, sdd = sbb + ridge, scc + ridge, sdd + ridge
    # Cofactors of the symmetric normal matrix.
    kbb, kcc, kdd = scc * sdd - scd * scd, sbb * sdd - sbd * sbd, sbb * scc - sbc * sbc
    kbc, kbd, kcd = scd * sbd - sbc * sdd, sbc * scd - scc * sbd, sbc * sbd - sbb * scd
    determinant = sbb * kbb + sbc * kbc + sbd * kbd
    gains[0] = (kbb * sab + kbc * sac + kbd * sad) / determinant
    gains[1] = (kbc * sab + kcc * sac + kcd * sad) / determinant
    gains[2] = (kbd * sab + kcd * sac + kdd * sad) / determinant
    explained = gains[0] * sab + gains[1] * sac + gains[2] * sad
    # Correct for the degrees of freedom, since three gains also fit some of the noise.
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
    """Correlate two patches after subtracting the mean of each channel."""
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
    first: Channels,
    second: Channels,
    places: NDArray[np.int64],
    window: NDArray[np.float64],
    patch: tuple[NDArray[np.float64], ...],
    found: NDArray[np.float64],
) -> None:
    """Match each patch by least squares, with a shift, a gain, and an offset per channel.

    Args:
        first: the first picture.
        second: the second picture.
        places: (n, 2) int64 (column, row) of the patch centres in the first picture.
        window: (p, p) float64 weights of the cells of a patch.
        patch: scratch arrays (p, p), (p + 3, p, c) and (p, p, c), float64.
        found: (n, 4) float64: the shift (across, down), refined in place; the standard deviation of
            a coordinate, assuming independent cells (inf if undetermined); and the correlation.
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
    first: Channels,
    second: Channels,
    place: tuple[int, int],
    shift: tuple[float, float],
    patch: tuple[NDArray[np.float64], ...],
) -> float:
    """Resample the second picture around a shifted position, and return the sum of the weights."""
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
    """Return weights of four neighbours at fraction t (cubic convolution, Keys 1981, a = -1/2)."""
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
    """Return a Gauss-Newton step (down, across), its standard deviation, and the correlation."""
    side, n_channels = len(weight), values.shape[2]
    top, left = place[0] - side // 2, place[1] - side // 2
    # Sums of products; a: reference patch, b: moved patch, x and y: gradients across and down.
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
    # In the inverse compositional algorithm, the gradients are those of the reference picture.
    return (
        (nxx * down - nxy * across) / determinant,
        (nyy * across - nxy * down) / determinant,
        math.sqrt(noise * 0.5 * (nxx + nyy) / determinant),
        sab / math.sqrt(saa * sbb),
    )


# Patches in which a smaller share of the cells is known are not measured.
_MIN_KNOWN: Final = 0.6
CORRELATION_AREA_CELLS: Final = 6.0
"""Smoothing correlates residuals, so this many cells count as one independent cell."""
_MAX_DRIFT_CELLS: Final = 1.5
_MAX_DISAGREEMENT_CELLS: Final = 0.5
# Margin of cut-out patches, for the drift of a patch and for the neighbours used in interpolation.
_CUT_MARGIN_CELLS: Final = 6


@dataclass(frozen=True, kw_only=True)
class Displacements(Rows):
    """Measured displacements.

    Attributes:
        places: (n, 2) intp (column, row) cells of the first picture.
        shift_cells: (n, 2) float64 shift (across, down) from a cell to the corresponding position
            in the second picture.
        score: (n,) correlation.
        sigma_cells: (n,) float64 standard deviation of a coordinate of the shift.
    """

    places: NDArray[np.intp]
    shift_cells: NDArray[np.float64]
    score: NDArray[np.float64]
    sigma_cells: NDArray[np.float64]


def measure(
    first: Channels,
    second: Channels,
    places: NDArray[np.intp],
    radius_cells: int,
    *,
    min_score: float = 0.35,
    min_distinct: float = 0.05,
    threads: int = 1,
) -> Displacements:
    """Measure displacements from the first picture to the second at cells (n, 2) of the first.

    If the first picture has one channel and the second three, each patch of the first is compared
    with the combination of the three channels that fits it best.

    Args:
        first: the first picture.
        second: the second picture.
        places: (column, row) cells of the first picture.
        radius_cells: search radius, in cells.
        min_score: minimum correlation. The default of 0.35 is half the usual correlation at correct
            positions; a lower value is possible if many patches are checked against their
            neighbours.
        min_distinct: minimum difference between the correlations of the best and the next peak.
        threads: number of threads.
    """
    places = _well_known(first, second, places, radius_cells)
    is_mixed = (first.values.shape[2], second.values.shape[2]) == (1, 3)
    found = np.zeros((len(places), 7 if is_mixed else 4))
    reach = (HALF_PATCH_CELLS, radius_cells)
    in_threads(
        [
            partial(search_shifts, first.values, second.values, places[part], reach, found[part])
            for part in even_parts(len(places), threads)
        ]
    )
    kept = (found[:, 2] >= min_score) & (found[:, 3] >= min_distinct)
    refine = _mixed_and_refined if is_mixed else _refined
    return refine(first, second, places[kept], found[kept], min_score, threads)


def _mixed_and_refined(
    first: Channels,
    second: Channels,
    places: NDArray[np.intp],
    found: NDArray[np.float64],
    min_score: float,
    threads: int,
) -> Displacements:
    """Refine each patch in its own combination of channels; patches are cut out and stacked."""
    begun = found[:, :2].astype(np.intp)
    reach = HALF_PATCH_CELLS + _CUT_MARGIN_CELLS
    one = _cut_out(first, places, reach, np.ones((len(places), 1), dtype=np.float32))
    other = _cut_out(second, places + begun, reach, found[:, 4:].astype(np.float32))
    side = 2 * reach + 1
    rows = reach + side * np.arange(len(places), dtype=np.intp)
    centres = np.column_stack([np.full_like(rows, reach), rows])
    refined = _refined(one, other, centres, np.zeros((len(places), 2)), min_score, threads)
    nth = refined.places[:, 1] // side
    return replace(refined, places=places[nth], shift_cells=refined.shift_cells + begun[nth])


def _cut_out(
    picture: Channels, centres: NDArray[np.intp], reach: int, gains: NDArray[np.float32]
) -> Channels:
    """Cut out patches around centres (n, 2), combined into one channel by their gains (n, c)."""
    side = 2 * reach + 1
    rows, columns = picture.known.shape
    values, known = (np.zeros((len(centres), side, side), dtype=np.float32) for _ in range(2))
    for nth, (column, row) in enumerate(centres.tolist()):
        top, left = max(0, row - reach), max(0, column - reach)
        part = (
            slice(top, min(rows, row + reach + 1)),
            slice(left, min(columns, column + reach + 1)),
        )
        height, width = picture.known[part].shape
        to = (nth, slice(top - row + reach, top - row + reach + height))
        across = slice(left - column + reach, left - column + reach + width)
        values[*to, across] = picture.values[part] @ gains[nth]
        known[*to, across] = picture.known[part]
    return Channels(values=values.reshape(-1, side, 1), known=known.reshape(-1, side))


def _well_known(
    first: Channels, second: Channels, places: NDArray[np.intp], radius_cells: int
) -> NDArray[np.intp]:
    """Select positions with a search area inside both pictures and a mostly known patch."""
    import cv2

    reach = radius_cells + HALF_PATCH_CELLS + 2
    ends = np.array(first.known.shape[::-1]) - reach
    places = places[((places >= reach) & (places < ends)).all(axis=1)]
    side = 2 * HALF_PATCH_CELLS + 1
    share = cv2.blur(first.known * second.known, (side, side))
    known = share[places[:, 1], places[:, 0]] >= _MIN_KNOWN
    return np.ascontiguousarray(places[known])


def _refined(
    first: Channels,
    second: Channels,
    places: NDArray[np.intp],
    found: NDArray[np.float64],
    min_score: float,
    threads: int,
) -> Displacements:
    begun = found[:, :2]
    forth, sigma_forth, score = _matched(first, second, places, begun, threads)
    # Use half the difference between the forward and backward shifts, so that interpolation errors
    # cancel out.
    middle = np.rint(forth).astype(np.intp)
    back, sigma_back, _ = _matched(second, first, places + middle, -forth, threads)
    shifts = 0.5 * (forth - back)
    disagreement = np.abs(forth + back).max(axis=1, initial=0.0)
    sigma = np.sqrt(0.5 * (sigma_forth**2 + sigma_back**2) + (0.5 * disagreement) ** 2)
    good = (
        (np.abs(shifts - begun).max(axis=1, initial=0.0) < _MAX_DRIFT_CELLS)
        & (disagreement < _MAX_DISAGREEMENT_CELLS)
        & (score >= min_score)
        & np.isfinite(sigma)
    )
    return Displacements(places=places, shift_cells=shifts, score=score, sigma_cells=sigma).take(
        good
    )


def _matched(
    first: Channels,
    second: Channels,
    places: NDArray[np.intp],
    begun: NDArray[np.float64],
    threads: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return shifts (n, 2), their standard deviations (n,) and correlations (n,)."""
    places = np.ascontiguousarray(places)
    found = np.zeros((len(places), 4))
    found[:, :2] = begun
    # With Gaussian weights, the border of a patch has little influence.
    steps = np.arange(-HALF_PATCH_CELLS, HALF_PATCH_CELLS + 1) / (0.6 * HALF_PATCH_CELLS)
    bell = np.exp(-0.5 * steps**2)
    window = np.outer(bell, bell)
    side, n_channels = len(window), first.values.shape[2]
    shapes = ((side, side), (side + 3, side, n_channels), (side, side, n_channels))
    in_threads(
        [
            partial(match_patches, first, second, places[part], window, scratch, found[part])
            for part in even_parts(len(places), threads)
            for scratch in [tuple(np.empty(shape) for shape in shapes)]
        ]
    )
    sigma = math.sqrt(CORRELATION_AREA_CELLS) * found[:, 2]
    return found[:, :2].copy(), sigma, found[:, 3].copy()
