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
class Search:
    """How displacements are looked for.

    Attributes:
        radius_cells: how far.
        min_score: smallest correlation; half of what patches of right places have (0.35), less
            where patches are many and judged by their neighbours.
        min_distinct: by how much the best correlation must exceed the next peak.
        threads: patches are shared between so many.
    """

    radius_cells: int
    min_score: float = 0.35
    min_distinct: float = 0.05
    threads: int = 1


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
    first: Channels, second: Channels, places: NDArray[np.intp], search: Search
) -> Displacements:
    """Measure displacements from the first picture to the second at cells (n, 2) of the first.

    Where the first has one channel and the second three, each patch of the first is compared with
    the mixture of the second's channels that fits it best.
    """
    places = _well_known(first, second, places, search)
    is_mixed = (first.values.shape[2], second.values.shape[2]) == (1, 3)
    kernel = search_mixtures if is_mixed else search_shifts
    found = np.zeros((len(places), 7 if is_mixed else 4))
    reach = (HALF_PATCH_CELLS, search.radius_cells)
    in_threads(
        [
            partial(kernel, first.values, second.values, places[part], reach, found[part])
            for part in even_parts(len(places), search.threads)
        ]
    )
    kept = (found[:, 2] >= search.min_score) & (found[:, 3] >= search.min_distinct)
    if is_mixed:
        return _mixed_and_refined(first, second, (places[kept], found[kept]), search)
    return _refined(first, second, (places[kept], found[kept, :2]), search)


def _mixed_and_refined(
    first: Channels,
    second: Channels,
    start: tuple[NDArray[np.intp], NDArray[np.float64]],
    search: Search,
) -> Displacements:
    """Refine each patch in a mixture of its own: all patches, cut out, one below the other."""
    places, found = start
    begun = found[:, :2].astype(np.intp)
    reach = HALF_PATCH_CELLS + _CUT_MARGIN_CELLS
    one = _cut_out(first, places, reach, np.ones((len(places), 1), dtype=np.float32))
    other = _cut_out(second, places + begun, reach, found[:, 4:].astype(np.float32))
    side = 2 * reach + 1
    centres = np.column_stack(
        [np.full(len(places), reach), reach + side * np.arange(len(places))]
    ).astype(np.intp)
    refined = _refined(one, other, (centres, np.zeros((len(places), 2))), search)
    nth = refined.places[:, 1] // side
    return replace(refined, places=places[nth], shift_cells=refined.shift_cells + begun[nth])


def _cut_out(
    picture: Channels, centres: NDArray[np.intp], reach: int, gains: NDArray[np.float32]
) -> Channels:
    """Cut out patches about centres (n, 2), each mixed by its gains (n, c) to a single channel."""
    side = 2 * reach + 1
    rows, columns = picture.known.shape
    values = np.zeros((len(centres), side, side, 1), dtype=np.float32)
    known = np.zeros((len(centres), side, side), dtype=np.float32)
    for nth, (column, row) in enumerate(centres.tolist()):
        top, left = max(0, row - reach), max(0, column - reach)
        part = (
            slice(top, min(rows, row + reach + 1)),
            slice(left, min(columns, column + reach + 1)),
        )
        height, width = picture.known[part].shape
        to = (nth, slice(top - row + reach, top - row + reach + height))
        across = slice(left - column + reach, left - column + reach + width)
        values[*to, across, 0] = picture.values[part] @ gains[nth]
        known[*to, across] = picture.known[part]
    return Channels(values=values.reshape(-1, side, 1), known=known.reshape(-1, side))


def _well_known(
    first: Channels, second: Channels, places: NDArray[np.intp], search: Search
) -> NDArray[np.intp]:
    """Places whose search stays inside the pictures and whose patches are mostly known."""
    import cv2

    reach = search.radius_cells + HALF_PATCH_CELLS + 2
    rows, columns = first.known.shape
    inside = (
        (places[:, 0] >= reach)
        & (places[:, 0] < columns - reach)
        & (places[:, 1] >= reach)
        & (places[:, 1] < rows - reach)
    )
    places = places[inside]
    side = 2 * HALF_PATCH_CELLS + 1
    share = cv2.blur(first.known * second.known, (side, side))
    known = share[places[:, 1], places[:, 0]] >= _MIN_KNOWN
    return np.ascontiguousarray(places[known])


def _refined(
    first: Channels,
    second: Channels,
    start: tuple[NDArray[np.intp], NDArray[np.float64]],
    search: Search,
) -> Displacements:
    places, begun = start
    window = _window(HALF_PATCH_CELLS)
    forward = _matched((first, second), (places, begun), window, search.threads)
    # Both ways, halved: what interpolation does to one of the pictures then cancels.
    middle = np.rint(forward.shifts).astype(np.intp)
    back = _matched((second, first), (places + middle, -forward.shifts), window, search.threads)
    shifts = 0.5 * (forward.shifts - back.shifts)
    disagreement = np.abs(forward.shifts + back.shifts).max(axis=1, initial=0.0)
    sigma = np.sqrt(0.5 * (forward.sigma**2 + back.sigma**2) + (0.5 * disagreement) ** 2)
    good = (
        (np.abs(shifts - begun).max(axis=1, initial=0.0) < _MAX_DRIFT_CELLS)
        & (disagreement < _MAX_DISAGREEMENT_CELLS)
        & (forward.score >= search.min_score)
        & np.isfinite(sigma)
    )
    return Displacements(
        places=places, shift_cells=shifts, score=forward.score, sigma_cells=sigma
    ).take(good)


@dataclass(frozen=True, kw_only=True)
class _Matched:
    shifts: NDArray[np.float64]
    sigma: NDArray[np.float64]
    score: NDArray[np.float64]


def _matched(
    pictures: tuple[Channels, Channels],
    start: tuple[NDArray[np.intp], NDArray[np.float64]],
    window: NDArray[np.float64],
    threads: int,
) -> _Matched:
    first, second = (Picture(picture.values, picture.known) for picture in pictures)
    places = np.ascontiguousarray(start[0])
    found = np.zeros((len(places), 4))
    found[:, :2] = start[1]
    side, n_channels = len(window), first.values.shape[2]
    shapes = ((side, side), (side + 3, side, n_channels), (side, side, n_channels))
    in_threads(
        [
            partial(match_patches, first, second, places[part], window, rooms, found[part])
            for part in even_parts(len(places), threads)
            for rooms in [tuple(np.empty(shape) for shape in shapes)]
        ]
    )
    sigma = math.sqrt(CORRELATION_AREA_CELLS) * found[:, 2]
    return _Matched(shifts=found[:, :2].copy(), sigma=sigma, score=found[:, 3].copy())


def _window(half: int) -> NDArray[np.float64]:
    """Weights of a patch's cells: the middle counts more, the border hardly."""
    steps = np.arange(-half, half + 1) / (0.6 * half)
    bell = np.exp(-0.5 * steps**2)
    return np.outer(bell, bell)
