"""Blocks of cells over which colour, brightness and depth are averaged."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.bands import row_bands
from orthoflow.geometry.levels import Colours, light_of_levels
from orthoflow.products import Layer, LayerMask

# Levels below _DARKEST are almost black, and levels above _BRIGHTEST are clipped.
_DARKEST: Final = 10.0 / 255.0
_BRIGHTEST: Final = 245.0 / 255.0
# Minimum share of levels within these limits in blocks whose brightness is measured.
_SAYING_LEAST: Final = 0.95
# Minimum height of a depth edge, where photos differ because of parallax.
_DEPTH_EDGE_M: Final = 0.03

# Rows and columns of blocks.
Box: TypeAlias = tuple[slice, slice]


@dataclass(frozen=True, kw_only=True)
class Blocks:
    """A symmetric division of a raster into blocks with about the same number of cells.

    Attributes:
        rows: first row of cells of each row of blocks, followed by the number of rows of cells.
        columns: the same for columns.
    """

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]

    @classmethod
    def over(cls, shape: tuple[int, int], side_cells: int) -> Blocks:
        """Divide a raster into blocks with sides of `side_cells` cells, or one more."""
        rows, columns = (_symmetric_edges(length, side_cells) for length in shape)
        return cls(rows=rows, columns=columns)

    @property
    def shape(self) -> tuple[int, int]:
        """The number of rows and the number of columns of blocks."""
        return len(self.rows) - 1, len(self.columns) - 1

    def cells(self, box: Box) -> tuple[slice, slice]:
        """Return the rows and columns of the cells in a box of blocks."""
        rows, columns = box
        return (
            slice(int(self.rows[rows.start]), int(self.rows[rows.stop])),
            slice(int(self.columns[columns.start]), int(self.columns[columns.stop])),
        )

    def within(self, box: Box) -> Blocks:
        """Return the blocks of a box as a division of their own; rows and columns start at 0."""
        rows = self.rows[box[0].start : box[0].stop + 1]
        columns = self.columns[box[1].start : box[1].stop + 1]
        return Blocks(rows=rows - rows[0], columns=columns - columns[0])

    def centres(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the centres of the rows of blocks, and of the columns of blocks, in cells."""
        rows, columns = (
            np.asarray(0.5 * (edges[1:] + edges[:-1]), np.float64)
            for edges in (self.rows, self.columns)
        )
        return rows, columns


def _symmetric_edges(length: int, part: int) -> NDArray[np.int64]:
    n_parts = -(-length // part)
    # If a middle cell belongs to neither half, make it a block of its own.
    n_parts += length % 2 * (1 - n_parts % 2)
    half = np.arange(n_parts // 2 + 1) * length // n_parts
    return np.concatenate([half, (length - half[::-1])[1 - n_parts % 2 :]])


def raster_means(raster: Colours | NDArray[np.float32], blocks: Blocks) -> NDArray[np.float64]:
    """Return the mean (rows, cols) of each block of a raster (rows, cols)."""
    return block_means(lambda rows: raster[rows], blocks)


def block_means(
    values: Callable[[slice], NDArray[np.generic]], blocks: Blocks
) -> NDArray[np.float64]:
    """Return the mean (rows, cols) of each block; `values` is called with a slice of rows."""
    rows, columns = blocks.rows, blocks.columns
    means = np.empty((len(rows) - 1, len(columns) - 1))
    # Process several rows of blocks at once, with about as many cells as a band.
    for some in row_bands((len(means), int(columns[-1] * np.diff(rows).max()))):
        first, last = rows[some.start], rows[some.stop]
        known = values(slice(int(first), int(last))).astype(np.float64)
        sums = np.add.reduceat(known, rows[some] - first, axis=0)
        means[some] = np.add.reduceat(sums, columns[:-1], axis=1)
    means /= np.outer(np.diff(rows), np.diff(columns))
    return means


def depth_edges(depth_m: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return a mask of cells whose right or lower neighbour differs in depth by more than 3 cm."""
    edges = np.zeros(depth_m.shape, dtype=np.bool_)
    edges[:, :-1] |= np.abs(np.diff(depth_m, axis=1)) > _DEPTH_EDGE_M
    edges[:-1] |= np.abs(np.diff(depth_m, axis=0)) > _DEPTH_EDGE_M
    return edges


def depth_edges_in(depth_m: NDArray[np.float32], rows: slice) -> NDArray[np.bool_]:
    """Return a mask of the cells in some rows that are on either side of a depth edge."""
    first = max(0, rows.start - 1)
    around = depth_m[first : rows.stop + 1]
    beside = depth_edges(around) | depth_edges(around[::-1, ::-1])[::-1, ::-1]
    return beside[rows.start - first :][: rows.stop - rows.start]


@dataclass(frozen=True, kw_only=True)
class BlockLight:
    """Mean brightness of the blocks that a layer covers completely, in a box around its cells.

    Attributes:
        box: rows and columns of blocks.
        log_light: (rows, cols, 3) float32 natural logarithm of the mean brightness; NaN for blocks
            that the layer does not cover completely, or that are largely black or clipped.
    """

    box: Box
    log_light: NDArray[np.float32]

    @property
    def is_known(self) -> NDArray[np.bool_]:
        """Mask (rows, cols) of the blocks with known brightness."""
        return ~np.isnan(self.log_light[..., 0])


def block_light(layer: Layer, blocks: Blocks) -> BlockLight:
    """Measure the brightness of the blocks of a layer, which must have coloured cells."""
    painted = block_means(lambda rows: layer.mask[rows] == LayerMask.PAINTED, blocks)
    down, right = (np.flatnonzero((painted > 0.0).any(axis=axis)) for axis in (1, 0))
    box = slice(int(down[0]), int(down[-1]) + 1), slice(int(right[0]), int(right[-1]) + 1)
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
    """Return the intersection of two boxes; None if it is empty."""
    parts = [
        slice(max(a.start, b.start), min(a.stop, b.stop)) for a, b in zip(one, other, strict=True)
    ]
    return (parts[0], parts[1]) if all(part.start < part.stop for part in parts) else None


def inside(part: Box, box: Box) -> Box:
    """Return the slices that select a part of a box from an array over this box."""
    rows, columns = (
        slice(inner.start - outer.start, inner.stop - outer.start)
        for inner, outer in zip(part, box, strict=True)
    )
    return rows, columns


def pairs(
    lights: Sequence[BlockLight],
) -> list[tuple[int, int, Box]]:
    """Return all pairs of layers with overlapping boxes, lower index first, and the overlaps."""
    found = []
    for i, one in enumerate(lights):
        for j in range(i + 1, len(lights)):
            shared = common(one.box, lights[j].box)
            if shared is not None:
                found.append((i, j, shared))
    return found
