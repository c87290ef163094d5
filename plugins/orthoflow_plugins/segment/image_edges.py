"""Sides of outlines moved to edges of the orthoimage, to a fraction of a cell."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow_plugins.segment.outlines import Outline

_LONG_CELLS: Final = 20.0
_ENDS_CELLS: Final = 4.0
# Length of the profiles across a side, in steps to both sides.
_REACH_CELLS: Final = 4.0
_STEP_CELLS: Final = 0.25
# The edge must be found in this many pieces of a side.
_PIECES: Final = 5
_PIECES_LEAST: Final = 4
# Grey levels per cell: weaker edges are stains. An edge must exceed the others by this factor.
_CONTRAST_LEAST_GREY: Final = 4.0
_CONTRAST_LEAST: Final = 3.0
# Slopes of at least this share of the steepest belong to an edge.
_EDGE_SHARE: Final = 0.2
# At a step the picture was projected with the same depths, so it is no better than this.
_SIGMA_LEAST_CELLS: Final = 0.5
# If depth and picture differ by more sigmas of the depth, they show different edges.
_APART_SIGMAS: Final = 1.5
# Another edge within reach that is nearly as strong makes the choice ambiguous.
_SECOND_MOST: Final = 0.6
_PARALLEL: Final = 0.26


@dataclass(frozen=True, kw_only=True)
class Moved:
    """An outline refined by the picture.

    Attributes:
        outline: it.
        by_image: (n,) bool, sides placed by the picture.
    """

    outline: Outline
    by_image: NDArray[np.bool_]


def moved_to_edges(outline: Outline, grey: NDArray[np.float32]) -> Moved:
    """Move each long side that was seen to the matching edge of the picture, if unambiguous.

    Args:
        outline: in cells of the picture.
        grey: (rows, cols) 0..255, NaN where nothing is shown.
    """
    count = len(outline.corners)
    shifts, sigma = np.zeros(count), outline.sigma.copy()
    by_image = np.zeros(count, dtype=np.bool_)
    for side in np.flatnonzero(outline.is_seen & (outline.lengths >= _LONG_CELLS)):
        begin, end = outline.corners[side], outline.corners[(side + 1) % count]
        found = _edge(grey, begin, end)
        if found is None or found[1] >= sigma[side]:
            continue
        if abs(found[0]) > _APART_SIGMAS * sigma[side]:
            continue
        shifts[side], sigma[side] = found
        by_image[side] = True
    moved = replace(outline, corners=_shifted(outline.corners, shifts), sigma=sigma)
    return Moved(outline=moved, by_image=by_image)


def _edge(
    grey: NDArray[np.float32], begin: NDArray[np.float64], end: NDArray[np.float64]
) -> tuple[float, float] | None:
    """Return how far outwards a side's edge is in the picture, and its sigma, in cells."""
    import cv2

    way = end - begin
    length = float(np.linalg.norm(way))
    along = way / length
    outwards = np.array([-along[1], along[0]])
    offsets = np.arange(-_REACH_CELLS, _REACH_CELLS + _STEP_CELLS / 2, _STEP_CELLS)
    places = np.arange(_ENDS_CELLS, length - _ENDS_CELLS, 0.5)
    at = begin + places[:, None, None] * along + offsets[None, :, None] * outwards
    x, y = (np.ascontiguousarray(at[..., axis] - 0.5, dtype=np.float32) for axis in range(2))
    profiles = np.asarray(cv2.remap(grey, x, y, cv2.INTER_LINEAR, borderValue=(np.nan,)))
    kept = profiles[np.isfinite(profiles).all(axis=1)].astype(np.float64)
    if len(kept) < 0.5 * len(profiles) or len(kept) < 2 * _PIECES:
        return None
    whole = _slopes(kept)
    peak = int(np.abs(whole).argmax())
    size = abs(float(whole[peak]))
    if size < max(_CONTRAST_LEAST_GREY, _CONTRAST_LEAST * float(np.median(np.abs(whole)))):
        return None
    around = round(1.0 / _STEP_CELLS)
    others = np.concatenate([whole[: max(0, peak - around)], whole[peak + around + 1 :]])
    if np.abs(others).max(initial=0.0) > _SECOND_MOST * size:
        return None
    found = []
    for piece in np.array_split(kept, _PIECES):
        slopes = np.sign(whole[peak]) * _slopes(piece)
        top = int(slopes.argmax())
        if slopes[top] >= 0.5 * size and 0 < top < len(slopes) - 1:
            found.append(_STEP_CELLS * _middle(slopes, top))
    if len(found) < _PIECES_LEAST:
        return None
    # Slopes are half a cell inwards of the first offset.
    place = float(np.median(found)) - _REACH_CELLS + 0.5
    spread = float(np.std(found, ddof=1)) / np.sqrt(len(found))
    return place, float(np.hypot(_SIGMA_LEAST_CELLS, spread))


def _slopes(profiles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the change of the mean profile over a cell, at the middle of each."""
    mean = profiles.mean(axis=0)
    apart = round(1.0 / _STEP_CELLS)
    slopes: NDArray[np.float64] = mean[apart:] - mean[:-apart]
    return slopes


def _middle(slopes: NDArray[np.float64], top: int) -> float:
    """Return the position of an edge: the centroid of its slopes."""
    is_low = slopes < _EDGE_SHARE * slopes[top]
    before = np.flatnonzero(is_low[:top])
    behind = np.flatnonzero(is_low[top:])
    first = int(before[-1]) + 1 if len(before) else 0
    last = top + int(behind[0]) if len(behind) else len(slopes)
    part = slopes[first:last]
    return float(np.arange(first, last) @ part / part.sum())


def _shifted(corners: NDArray[np.float64], shifts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the corners after each side moved outwards."""
    ways = np.roll(corners, -1, axis=0) - corners
    along = ways / np.linalg.norm(ways, axis=1, keepdims=True)
    outwards = np.column_stack([-along[:, 1], along[:, 0]])
    moved = corners.copy()
    for corner in range(len(corners)):
        pair = [corner - 1, corner]
        rows = outwards[pair]
        # A corner between sides that form one line moves with their mean.
        if abs(float(np.linalg.det(rows))) < _PARALLEL:
            moved[corner] += (shifts[pair] @ rows) / 2.0
        else:
            moved[corner] += np.linalg.solve(rows, shifts[pair])
    return moved
