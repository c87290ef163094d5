"""Removal of people and vehicles: photos are not used where others or the scan contradict them.

Photos of the same area, and the colours of the scan, are independent observations of brightness.
They are compared in blocks of a few centimetres, after smooth differences (lighting, exposure) have
been removed. In a region where two photos contradict each other, the one that fewer observations
confirm is not used. Reflections also cause contradictions. Colours are only replaced by those of
another photo.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.bands import Allocate, row_bands
from orthoflow.geometry.levels import light_of_levels
from orthoflow.geometry.robust import NMAD_FACTOR
from orthoflow.products import Layer, LayerMask, Wall
from orthoflow_plugins.mosaic.blocks import Blocks, Box, block_means, common, inside

if TYPE_CHECKING:
    from orthoflow.geometry.levels import Colours

# Side of a block, which must exceed the displacements between photos but not the width of a limb.
_BLOCK_M: Final = 0.025
_BLOCK_CELLS: Final = (4, 32)
_LEAST_PAINTED: Final = 0.5
# Added to brightness values, so that noise in almost black cells does not count as a difference.
_DARK: Final = 0.02
# Two observations contradict each other if the logarithms of their brightness differ by at least a
# limit, which is _DEVIATIONS times the standard deviation over all blocks, but not less than _APART
# and not more than twice _APART.
_APART: Final = 0.18
_DEVIATIONS: Final = 5.0
# In the core of a contradicted region, differences exceed the limit by at least this factor.
_CORE_TIMES: Final = 2.0
_LEAST_CORE_BLOCKS: Final = 6
# Differences that vary only over distances longer than this, in blocks, are attributed to lighting.
_SMOOTH_BLOCKS: Final = 40.0
# Regions narrower than this are ignored, because misaligned edges cause them.
_OPENING_BLOCKS: Final = 2
# Gaps of up to this many blocks in a region are closed.
_CLOSING_BLOCKS: Final = 9
# Regions are extended by this many blocks.
_GROWTH_BLOCKS: Final = 2
# The laser intensity is used if its correlation with the brightness of the photos is at least this.
_LEAST_CORRELATION: Final = 0.6
_LEAST_BLOCKS: Final = 100


@dataclass(frozen=True, kw_only=True)
class _Witness:
    """Logarithmic brightness (r, c, 3) of the blocks in a box, NaN where not observed."""

    box: Box
    log_light: NDArray[np.float64]
    is_grey: bool = False


def consensus(
    layers: Sequence[Layer], wall: Wall | None, *, allocate: Allocate
) -> tuple[list[Layer], int, NDArray[np.bool_] | None]:
    """Exclude from each photo the regions in which it is contradicted by better-confirmed photos.

    Args:
        layers: layers of one wall, each with coloured cells; they are not modified.
        wall: the scanned wall; None if unknown.
        allocate: function that allocates the masks of changed layers.

    Returns:
        The layers, with excluded cells marked as hidden; the number of excluded cells, summed over
        the layers; and a mask (rows, cols) of the cells that only one photo shows and in which that
        photo contradicts the scan, or None if the scan has neither colours nor a usable intensity.
    """
    shape, gsd_m = layers[0].frame.shape, layers[0].frame.gsd_m
    side = int(np.clip(math.ceil(_BLOCK_M / gsd_m), *_BLOCK_CELLS))
    blocks = Blocks.over((shape[0], shape[1]), side)
    witnesses = [_witness(layer.rgb, layer.mask == LayerMask.PAINTED, blocks) for layer in layers]
    scan = None if wall is None else _scan(wall, blocks, witnesses)
    if scan is not None:
        # Remove lighting differences between each photo and the scan first. People affect this
        # comparison less than a comparison of two photos, which have fewer cells in common.
        witnesses = [_in_light_of(scan, item) for item in witnesses]
    everyone = [*witnesses, *([] if scan is None else [scan])]
    supports, apart = _compared(everyone, len(layers), blocks)
    outvoted = [
        _regions(_contradicted(index, supports, apart, blocks)) for index in range(len(layers))
    ]
    kept, n_outvoted = _without(layers, outvoted, blocks, allocate)
    contradicted = None
    if scan is not None:
        contradicted = _of_cells(_alone(witnesses, apart, blocks), blocks)
    return kept, n_outvoted, contradicted


def _compared(
    everyone: Sequence[_Witness], n_photos: int, blocks: Blocks
) -> tuple[NDArray[np.int8], dict[tuple[int, int], NDArray[np.float64]]]:
    """Count the observations that confirm each photo in each block, and compare all pairs.

    Args:
        everyone: the photos, followed by the scan if it is used.
        n_photos: number of photos.
        blocks: blocks of the wall.

    Returns:
        (photos, rows, cols) counts, and for each pair the difference in each block relative to the
        limit for a contradiction.
    """
    supports = np.zeros((n_photos, *blocks.shape), dtype=np.int8)
    apart: dict[tuple[int, int], NDArray[np.float64]] = {}
    for i in range(n_photos):
        for j in range(i + 1, len(everyone)):
            ratio = _apart(everyone[i], everyone[j], blocks)
            if ratio is None:
                continue
            apart[i, j] = ratio
            agrees = (ratio <= 1.0).astype(np.int8)
            if j < n_photos:
                supports[i] += agrees
                supports[j] += agrees
            else:
                # The scan counts more than all photos together, since two photos may show the same
                # person at the same place.
                supports[i] += agrees * np.int8(1 if everyone[j].is_grey else n_photos)
    return supports, apart


def _contradicted(
    photo: int,
    supports: NDArray[np.int8],
    apart: dict[tuple[int, int], NDArray[np.float64]],
    blocks: Blocks,
) -> NDArray[np.float64]:
    """Return the largest difference in each block between a photo and better-confirmed photos."""
    worst = np.zeros(blocks.shape)
    for other in range(len(supports)):
        ratio = apart.get((min(photo, other), max(photo, other)))
        if ratio is not None and other != photo:
            wins = (supports[other] > supports[photo]) & np.isfinite(ratio)
            worst = np.where(wins, np.fmax(worst, ratio), worst)
    return worst


def _alone(
    photos: Sequence[_Witness],
    apart: dict[tuple[int, int], NDArray[np.float64]],
    blocks: Blocks,
) -> NDArray[np.bool_]:
    """Return a mask of the blocks in which the only photo that shows them contradicts the scan."""
    shown = np.array([_known(item, blocks) for item in photos])
    is_alone = shown.sum(axis=0) == 1
    found = np.zeros(blocks.shape, dtype=np.bool_)
    for index, mine in enumerate(shown):
        ratio = apart.get((index, len(photos)))
        if ratio is not None:
            alone = np.where(mine & is_alone, np.nan_to_num(ratio), 0.0)
            found |= _regions(alone) & mine & is_alone
    return found


def _of_cells(region: NDArray[np.bool_], blocks: Blocks) -> NDArray[np.bool_]:
    by_row = np.repeat(region, np.diff(blocks.rows), axis=0)
    return np.repeat(by_row, np.diff(blocks.columns), axis=1)


def _witness(rgb: Colours, is_painted: NDArray[np.bool_], blocks: Blocks) -> _Witness:
    painted = block_means(lambda rows: is_painted[rows], blocks)
    rows, columns = (np.flatnonzero((painted > 0.0).any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return _Witness(box=(slice(0, 0), slice(0, 0)), log_light=np.zeros((0, 0, 3)))
    box = slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
    part = blocks.cells(box)
    light = light_of_levels(int(np.iinfo(rgb.dtype).max))
    own, shows, inner = rgb[part], is_painted[part], blocks.within(box)

    def lit(channel: int, some: slice) -> NDArray[np.float32]:
        return np.asarray(light[own[some][..., channel]] * shows[some], dtype=np.float32)

    sums = np.stack([block_means(partial(lit, channel), inner) for channel in range(3)], axis=-1)
    share = painted[box][..., None]
    means = sums / np.maximum(share, 1e-6)
    return _Witness(
        box=box, log_light=np.where(share >= _LEAST_PAINTED, np.log(means + _DARK), np.nan)
    )


def _scan(wall: Wall, blocks: Blocks, photos: Sequence[_Witness]) -> _Witness | None:
    """Return the colours of the scan, or its intensity if that correlates with the photos."""
    if wall.rgb is not None and wall.rgb_mask is not None:
        return _witness(wall.rgb, wall.rgb_mask > 0, blocks)
    if wall.intensity is None:
        return None
    levels = np.empty(wall.frame.shape, dtype=np.uint8)
    is_known = np.empty(wall.frame.shape, dtype=np.bool_)
    for rows in row_bands(wall.frame.shape):
        is_known[rows] = np.isfinite(wall.intensity[rows])
        shares = np.clip(np.nan_to_num(wall.intensity[rows]), 0.0, 1.0)
        levels[rows] = np.rint(255.0 * shares)
    grey = np.broadcast_to(levels[..., None], (*levels.shape, 3))
    return _fitted(_witness(grey, is_known, blocks), photos)


def _fitted(grey: _Witness, photos: Sequence[_Witness]) -> _Witness | None:
    """Return the intensity scaled to the brightness of the photos, or None if uncorrelated."""
    given, shown = [np.empty(0)], [np.empty(0)]
    for photo in photos:
        box = common(grey.box, photo.box)
        if box is not None:
            given.append(grey.log_light[inside(box, grey.box)].mean(axis=2).ravel())
            shown.append(photo.log_light[inside(box, photo.box)].mean(axis=2).ravel())
    x, y = np.concatenate(given), np.concatenate(shown)
    known = np.isfinite(x) & np.isfinite(y)
    if known.sum() < _LEAST_BLOCKS or min(x[known].std(), y[known].std()) < 1e-6:
        return None
    x, y = x[known] - x[known].mean(), y[known]
    slope = float(x @ (y - y.mean()) / (x @ x))
    # Exclude people and vehicles from the estimate of the scale.
    near = np.abs(y - np.median(y) - slope * x) <= _CORE_TIMES * _APART
    if near.sum() < _LEAST_BLOCKS or np.corrcoef(x[near], y[near])[0, 1] < _LEAST_CORRELATION:
        return None
    slope = float(np.polyfit(x[near], y[near], 1)[0])
    return replace(grey, log_light=slope * grey.log_light, is_grey=True)


def _in_light_of(scan: _Witness, photo: _Witness) -> _Witness:
    """Remove the smooth brightness difference between a photo and the scan from the photo."""
    box = common(scan.box, photo.box)
    if box is None:
        return photo
    part = inside(box, photo.box)
    difference, _ = _difference(photo, scan, box)
    whole = np.full(photo.log_light.shape, np.nan)
    whole[part] = difference
    return replace(photo, log_light=photo.log_light - _light_between(whole))


def _known(witness: _Witness, blocks: Blocks) -> NDArray[np.bool_]:
    known = np.zeros(blocks.shape, dtype=np.bool_)
    known[witness.box] = np.isfinite(witness.log_light[..., 0])
    return known


def _difference(
    one: _Witness, other: _Witness, box: Box
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the difference between two observations, and a mask of the blocks that both have.

    The difference is that of the channel means if one observation is grey.
    """
    difference = one.log_light[inside(box, one.box)] - other.log_light[inside(box, other.box)]
    if one.is_grey or other.is_grey:
        difference = np.repeat(difference.mean(axis=2, keepdims=True), 3, axis=2)
    return difference, np.asarray(np.isfinite(difference).all(axis=2), dtype=np.bool_)


def _light_between(difference: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the smooth part (r, c, 3) of a difference that is NaN where unknown."""
    known = np.asarray(np.isfinite(difference).all(axis=2), dtype=np.bool_)
    if not known.any():
        return np.zeros(difference.shape)
    filled = np.where(known[..., None], difference, 0.0)
    light = np.broadcast_to(np.median(filled[known], axis=0), filled.shape)
    for most in (_CORE_TIMES * _APART, _APART):
        is_light = known & (np.abs(filled - light).max(axis=2) <= most)
        light = light + _smooth(filled - light, is_light)
    return np.asarray(light)


def _apart(one: _Witness, other: _Witness, blocks: Blocks) -> NDArray[np.float64] | None:
    """Return the difference between two observations in each block, relative to the limit.

    The difference is NaN where an observation is missing. The result is None if no block is
    observed twice.
    """
    box = common(one.box, other.box)
    if box is None:
        return None
    difference, known = _difference(one, other, box)
    if not known.any():
        return None
    rest = difference - _light_between(difference)
    sizes = np.abs(rest).max(axis=2)
    typical = NMAD_FACTOR * float(np.median(sizes[known]))
    least = max(_APART, min(_DEVIATIONS * typical, _CORE_TIMES * _APART))
    ratio = np.full(blocks.shape, np.nan)
    ratio[box] = np.where(known, sizes / least, np.nan)
    return ratio


def _smooth(values: NDArray[np.float64], is_used: NDArray[np.bool_]) -> NDArray[np.float64]:
    import cv2

    weights = cv2.GaussianBlur(is_used.astype(np.float64), (0, 0), _SMOOTH_BLOCKS)
    sums = cv2.GaussianBlur(np.where(is_used[..., None], values, 0.0), (0, 0), _SMOOTH_BLOCKS)
    return np.asarray(sums / np.maximum(weights, 1e-9)[..., None], dtype=np.float64)


def _regions(ratio: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask of the contradicted regions that contain a core."""
    import cv2

    square = cv2.getStructuringElement(cv2.MORPH_RECT, (_OPENING_BLOCKS, _OPENING_BLOCKS))
    is_apart = cv2.morphologyEx((ratio > 1.0).astype(np.uint8), cv2.MORPH_OPEN, square)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (_CLOSING_BLOCKS, _CLOSING_BLOCKS))
    closed = cv2.morphologyEx(is_apart, cv2.MORPH_CLOSE, disc)
    count, labels = cv2.connectedComponents(closed, connectivity=8)
    cores = np.bincount(labels[(ratio > _CORE_TIMES) & (is_apart > 0)], minlength=count)
    is_thing = cores >= _LEAST_CORE_BLOCKS
    is_thing[0] = False
    return np.asarray(is_thing[labels], dtype=np.bool_)


def _grown(region: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Extend a region by its border, where colours mix with the background."""
    import cv2

    side = 2 * _GROWTH_BLOCKS + 1
    rim = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    return np.asarray(cv2.dilate(region.astype(np.uint8), rim) > 0, dtype=np.bool_)


def _any_left(
    painted: Sequence[NDArray[np.bool_]], is_out: Sequence[NDArray[np.bool_]]
) -> NDArray[np.bool_]:
    left = [shows & ~out for shows, out in zip(painted, is_out, strict=True)]
    return np.asarray(np.logical_or.reduce(left), dtype=np.bool_)


def _without(
    layers: Sequence[Layer],
    outvoted: Sequence[NDArray[np.bool_]],
    blocks: Blocks,
    allocate: Allocate,
) -> tuple[list[Layer], int]:
    """Exclude outvoted blocks that another layer shows; return the layers and the cell count."""
    changed = [index for index, region in enumerate(outvoted) if region.any()]
    if not changed:
        return list(layers), 0
    shape = layers[0].frame.shape
    grown = [_grown(region) for region in outvoted]
    masks = {
        index: np.asarray(allocate(f"consensus.{index}", shape, np.uint8), np.uint8)
        for index in changed
    }
    n_outvoted = 0
    of_row = np.repeat(np.arange(blocks.shape[0]), np.diff(blocks.rows))
    of_column = np.repeat(np.arange(blocks.shape[1]), np.diff(blocks.columns))
    for rows in row_bands(shape):
        at = np.ix_(of_row[rows], of_column)
        painted = [layer.mask[rows] == LayerMask.PAINTED for layer in layers]
        is_out = [region[at] & shows for region, shows in zip(grown, painted, strict=True)]
        stays = _any_left(painted, is_out)
        # Where photos show two people next to each other, keep the border of one region rather than
        # the other person.
        is_out = [out & (stays | region[at]) for out, region in zip(is_out, outvoted, strict=True)]
        stays = _any_left(painted, is_out)
        for index in changed:
            loses = is_out[index] & stays
            masks[index][rows] = np.where(loses, LayerMask.OCCLUDED, layers[index].mask[rows])
            n_outvoted += int(np.count_nonzero(loses))
    kept = [
        replace(layer, mask=masks[index]) if index in masks else layer
        for index, layer in enumerate(layers)
    ]
    return kept, n_outvoted
