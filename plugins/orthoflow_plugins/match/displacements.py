"""How far two pictures of one wall are displaced at chosen places, to a fraction of a cell.

First the best whole cell by correlation within a radius, then least-squares matching (Grün 1985):
the shift, with its standard deviation, that brings both patches together.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.rows import Rows
from orthoflow.geometry.threads import even_parts, in_threads
from orthoflow_plugins.match.channels import HALF_PATCH_CELLS, Channels
from orthoflow_plugins.match.patch_kernels import (
    Picture,
    match_patches,
    search_mixtures,
    search_shifts,
)

# Patches of which less is known than this say nothing.
_MIN_KNOWN: Final = 0.6
CORRELATION_AREA_CELLS: Final = 6.0
"""Neighbouring residuals of smoothed pictures agree: independent ones are this much fewer."""
_MAX_DRIFT_CELLS: Final = 1.5
_MAX_DISAGREEMENT_CELLS: Final = 0.5
# About patches that are cut out: as far as they drift, and what interpolates there.
_CUT_MARGIN_CELLS: Final = 6


@dataclass(frozen=True, kw_only=True)
class Displacements(Rows):
    """Measured displacements.

    Attributes:
        places: (n, 2) intp (column, row) cells of the first picture.
        shift_cells: (n, 2) float64: what is at cell + shift in the second picture.
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

    Where the first has one channel and the second three, each patch of the first is compared with
    the mixture of the second's channels that fits it best.

    Args:
        first: the first picture.
        second: the second one.
        places: (column, row) of the first picture.
        radius_cells: how far is looked.
        min_score: smallest correlation; half of what patches of right places have (0.35), less
            where patches are many and judged by their neighbours.
        min_distinct: by how much the best correlation must exceed the next peak.
        threads: patches are shared between so many.
    """
    places = _well_known(first, second, places, radius_cells)
    is_mixed = (first.values.shape[2], second.values.shape[2]) == (1, 3)
    kernel = search_mixtures if is_mixed else search_shifts
    found = np.zeros((len(places), 7 if is_mixed else 4))
    reach = (HALF_PATCH_CELLS, radius_cells)
    in_threads(
        [
            partial(kernel, first.values, second.values, places[part], reach, found[part])
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
    """Refine each patch in a mixture of its own: all patches, cut out, one below the other."""
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
    """Cut out patches about centres (n, 2), each mixed by its gains (n, c) to a single channel."""
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
    """Places whose search stays inside the pictures and whose patches are mostly known."""
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
    # Both ways, halved: what interpolation does to one of the pictures then cancels.
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
    """Shifts (n, 2), their standard deviations (n,) and correlations (n,)."""
    one, other = (Picture(picture.values, picture.known) for picture in (first, second))
    places = np.ascontiguousarray(places)
    found = np.zeros((len(places), 4))
    found[:, :2] = begun
    # The middle of a patch counts more, the border hardly.
    steps = np.arange(-HALF_PATCH_CELLS, HALF_PATCH_CELLS + 1) / (0.6 * HALF_PATCH_CELLS)
    bell = np.exp(-0.5 * steps**2)
    window = np.outer(bell, bell)
    side, n_channels = len(window), first.values.shape[2]
    shapes = ((side, side), (side + 3, side, n_channels), (side, side, n_channels))
    in_threads(
        [
            partial(match_patches, one, other, places[part], window, rooms, found[part])
            for part in even_parts(len(places), threads)
            for rooms in [tuple(np.empty(shape) for shape in shapes)]
        ]
    )
    sigma = math.sqrt(CORRELATION_AREA_CELLS) * found[:, 2]
    return found[:, :2].copy(), sigma, found[:, 3].copy()
