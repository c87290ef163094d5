"""Light in a layer: conversion between colour levels and linear light, and means over blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.levels import Colours
from orthoflow.products import Layer, LayerMask
from orthoflow_plugins.mosaic.blocks import Blocks, Box, block_means

# Clipped and almost black pixels are useless for exposure; this share of a block may be so.
_DARKEST: Final = 10.0 / 255.0
_BRIGHTEST: Final = 245.0 / 255.0
_SAYING_LEAST: Final = 0.95
# Steps of the table from light to levels; between them it is nearly linear.
_STEPS: Final = 1 << 16


@cache
def light_of_levels(highest: int) -> NDArray[np.float32]:
    """Return light, 0 to 1, of the levels 0 to `highest` of sRGB (IEC 61966-2-1)."""
    level = np.arange(highest + 1) / float(highest)
    light = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    return light.astype(np.float32)


@cache
def _share_of_light() -> NDArray[np.float32]:
    """Levels, 0 to 1, of light in equal steps; with one more, so that there is always a next."""
    light = np.minimum(np.arange(_STEPS + 1) / (_STEPS - 1.0), 1.0)
    level = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)
    return level.astype(np.float32)


def lit_shares(
    levels: NDArray[np.floating], log_gains: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Multiply the light of levels (n, 3), 0 to 1, by the exponentials of (n, 3)."""
    light = np.interp(levels, np.linspace(0.0, 1.0, _STEPS), light_of_levels(_STEPS - 1))
    # Interpolation ends with the table: clipped light is white.
    gained = light * np.exp(log_gains)
    levels = np.interp(gained, np.linspace(0.0, 1.0, _STEPS), _share_of_light()[:_STEPS])
    return np.asarray(levels, dtype=np.float64)


def lit(colours: Colours, log_gains: NDArray[np.float32]) -> Colours:
    """Multiply the light of colours (n, 3) by the exponentials of (n, 3)."""
    highest = int(np.iinfo(colours.dtype).max)
    light = light_of_levels(highest)[colours] * np.exp(log_gains)
    place = np.clip(light, 0.0, 1.0) * np.float32(_STEPS - 1)
    before = place.astype(np.int32)
    table = _share_of_light()
    level = table[before] + (place - before) * (table[before + 1] - table[before])
    return np.asarray(np.rint(np.float32(highest) * level), dtype=colours.dtype)


@dataclass(frozen=True, kw_only=True)
class BlockLight:
    """Mean light of the blocks that a layer paints completely, in the box around its painted cells.

    Attributes:
        box: rows and columns of blocks.
        log_light: (rows, cols, 3) float32 natural logarithm of the mean light; NaN where the layer
            does not paint all of a block, or much of it is black or white.
    """

    box: Box
    log_light: NDArray[np.float32]

    @property
    def is_known(self) -> NDArray[np.bool_]:
        """Return blocks (rows, cols) whose light is known."""
        return ~np.isnan(self.log_light[..., 0])


def block_light(layer: Layer, blocks: Blocks) -> BlockLight:
    """Measure the light over blocks of a layer with painted cells."""
    painted = block_means(lambda rows: layer.mask[rows] == LayerMask.PAINTED, blocks)
    box = _box_about(painted > 0.0)
    rows, columns = blocks.cells(box)
    rgb = layer.rgb[rows, columns]
    highest = int(np.iinfo(rgb.dtype).max)
    low, high = _DARKEST * highest, _BRIGHTEST * highest
    inner = blocks.within(box)
    light = light_of_levels(highest)
    sums = np.stack(
        [block_means(partial(_light_in, light, rgb[..., c]), inner) for c in range(3)], axis=-1
    )
    saying = block_means(
        lambda band: (rgb[band].min(axis=2) >= low) & (rgb[band].max(axis=2) <= high), inner
    )
    is_known = (painted[box] == 1.0) & (saying >= _SAYING_LEAST)
    with np.errstate(divide="ignore"):
        logs = np.log(sums)
    logs[~is_known] = np.nan
    return BlockLight(box=box, log_light=logs.astype(np.float32))


def _light_in(
    light: NDArray[np.float32], levels: NDArray[np.uint8 | np.uint16], rows: slice
) -> NDArray[np.float32]:
    return np.asarray(light[levels[rows]], dtype=np.float32)


def common(one: Box, other: Box) -> Box | None:
    """Return the blocks in both boxes; None if they share none."""
    parts = [
        slice(max(a.start, b.start), min(a.stop, b.stop)) for a, b in zip(one, other, strict=True)
    ]
    return (parts[0], parts[1]) if all(part.start < part.stop for part in parts) else None


def inside(part: Box, box: Box) -> Box:
    """Return where a part of a box is in arrays of that box."""
    rows, columns = (
        slice(inner.start - outer.start, inner.stop - outer.start)
        for inner, outer in zip(part, box, strict=True)
    )
    return rows, columns


def pairs(
    lights: Sequence[BlockLight],
) -> list[tuple[int, int, Box]]:
    """Return pairs of layers whose boxes overlap, and where, by index, the lower first."""
    found = []
    for i, one in enumerate(lights):
        for j in range(i + 1, len(lights)):
            shared = common(one.box, lights[j].box)
            if shared is not None:
                found.append((i, j, shared))
    return found


def _box_about(is_set: NDArray[np.bool_]) -> Box:
    rows, columns = (np.flatnonzero(is_set.any(axis=axis)) for axis in (1, 0))
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
