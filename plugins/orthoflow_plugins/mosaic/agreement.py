"""Agreement between the sources of a wall: displacements in overlaps, and colour steps at seams."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.bands import row_bands
from orthoflow.geometry.levels import REC_601, eight_bits
from orthoflow.products import Layer, LayerMask
from orthoflow_plugins.mosaic.blocks import depth_edges

if TYPE_CHECKING:
    from orthoflow_plugins.mosaic.balance import Balance

PATCH_CELLS: Final = 64
_PATCHES_MOST: Final = 200
# Displacements cannot be measured in patches with less contrast than this.
_CONTRAST_LEAST_GREY: Final = 3.0
# Correlation peaks lower than this may be due to chance.
_RESPONSE_LEAST: Final = 0.15
ROWS_AT_ONCE: Final = 1024


@dataclass(frozen=True, kw_only=True)
class Overlaps:
    """Displacements between pairs of photos that show the same part of a wall.

    Attributes:
        shifts_cells: (n, 2) displacements (u, v), in cells, of the second photo relative to the
            first.
        centres: (n, 2) column and row of the centre of each patch.
        photos: names of the two photos of each patch.
    """

    shifts_cells: NDArray[np.float64]
    centres: NDArray[np.float64]
    photos: tuple[tuple[str, str], ...]


def overlaps_of(layers: Sequence[Layer], *, of_all_pairs: bool = False) -> Overlaps:
    """Measure the displacements between layers in patches of a wall.

    Phase correlation, which is accurate to about a tenth of a cell, compares the layers in patches
    of 64 x 64 cells that both layers show completely.

    Args:
        layers: photos of one wall.
        of_all_pairs: whether to compare all pairs of layers that show a patch; otherwise, only the
            two best layers are compared.
    """
    import cv2

    pairs = patch_pairs(layers, of_all_pairs=of_all_pairs)
    chosen = np.linspace(0, len(pairs) - 1, min(len(pairs), _PATCHES_MOST)).round().astype(int)
    window = cv2.createHanningWindow((PATCH_CELLS, PATCH_CELLS), cv2.CV_32F)
    shifts, centres, photos = [], [], []
    for row, column, first, second in (pairs[place] for place in chosen):
        part = (slice(row, row + PATCH_CELLS), slice(column, column + PATCH_CELLS))
        patches = [_grey(eight_bits(layers[index].rgb[part])) for index in (first, second)]
        if min(float(patch.std()) for patch in patches) < _CONTRAST_LEAST_GREY:
            continue
        shift, response = cv2.phaseCorrelate(patches[0], patches[1], window)
        if response >= _RESPONSE_LEAST:
            shifts.append(shift)
            centres.append((column + 0.5 * PATCH_CELLS, row + 0.5 * PATCH_CELLS))
            photos.append((layers[first].source, layers[second].source))
    return Overlaps(
        shifts_cells=np.array(shifts, dtype=np.float64).reshape(-1, 2),
        centres=np.array(centres, dtype=np.float64).reshape(-1, 2),
        photos=tuple(photos),
    )


def patch_pairs(layers: Sequence[Layer], *, of_all_pairs: bool) -> list[tuple[int, int, int, int]]:
    """Return (row, column, layer, layer) for each pair of layers that show a whole patch."""
    n_rows, n_columns = (side // PATCH_CELLS for side in layers[0].frame.shape)
    if len(layers) < 2 or not n_rows or not n_columns:
        return []
    qualities = np.stack([_patch_qualities(layer, (n_rows, n_columns)) for layer in layers])
    order = np.argsort(-qualities, axis=0, kind="stable")
    found = []
    for row, column in np.ndindex(n_rows, n_columns):
        whole = [index for index in order[:, row, column].tolist() if qualities[index, row, column]]
        for first, second in combinations(whole if of_all_pairs else whole[:2], 2):
            found.append((row * PATCH_CELLS, column * PATCH_CELLS, first, second))
    return found


def _patch_qualities(layer: Layer, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return the mean quality of each patch, 0 if the layer does not show the whole patch."""
    qualities: list[NDArray[np.float64]] = []
    columns = shape[1] * PATCH_CELLS
    for rows in row_bands((shape[0] * PATCH_CELLS, columns), multiple=PATCH_CELLS):
        blocks = (-1, PATCH_CELLS, shape[1], PATCH_CELLS)
        is_painted = layer.mask[rows, :columns] == LayerMask.PAINTED
        whole = is_painted.reshape(blocks).all(axis=(1, 3))
        quality = layer.quality[rows, :columns].reshape(blocks)
        qualities.append(np.where(whole, quality.mean(axis=(1, 3), dtype=np.float64), 0.0))
    return np.concatenate(qualities)


def _grey(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    return np.ascontiguousarray(rgb.mean(axis=2, dtype=np.float32))


def seam_steps(
    source: NDArray[np.int16], layers: Sequence[Layer], balance: Balance | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compare the colours of the two sources along seams.

    They are compared in the cells to the left of or above the seam, if both sources show the cell.

    Args:
        source: (rows, cols) index of the layer of each cell, -1 if none.
        layers: the layers to which `source` refers.
        balance: the colour balance, or None.

    Returns:
        (n,) luminance differences between the two sources in these cells, and (n,) colour distances
        in CIE L*a*b* (1976).
    """

    def shown(index: int, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> NDArray[np.uint8]:
        colours = layers[index].rgb[rows, columns]
        if balance is not None:
            colours = balance.shown(index, colours, rows, columns)
        return eight_bits(colours)

    nothing = np.zeros((0, 3), dtype=np.uint8)
    firsts, seconds = [nothing], [nothing]
    for axis in (0, 1):
        rows, columns = cells_before_seams(source, axis)
        mine = source[rows, columns]
        other = source[rows + (axis == 0), columns + (axis == 1)]
        for index, layer in enumerate(layers):
            chosen = (other == index) & (layer.mask[rows, columns] == LayerMask.PAINTED)
            seconds.append(shown(index, rows[chosen], columns[chosen]))
            first = np.zeros((np.count_nonzero(chosen), 3), dtype=np.uint8)
            for owner in range(len(layers)):
                is_mine = mine[chosen] == owner
                first[is_mine] = shown(owner, rows[chosen][is_mine], columns[chosen][is_mine])
            firsts.append(first)
    one, another = np.concatenate(firsts), np.concatenate(seconds)
    grey = (one.astype(np.float64) - another) @ REC_601
    return grey, np.linalg.norm(_lab(one) - _lab(another), axis=1).astype(np.float64)


def cells_before_seams(
    source: NDArray[np.int16], axis: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows and columns of the cells above (axis 0) or to the left of (axis 1) seams."""
    found: list[NDArray[np.int64]] = []
    for first in range(0, source.shape[0], ROWS_AT_ONCE):
        strip = source[first : first + ROWS_AT_ONCE + (axis == 0)]
        here = strip[:-1] if axis == 0 else strip[:, :-1]
        there = strip[1:] if axis == 0 else strip[:, 1:]
        rows, columns = np.nonzero((here != there) & (here >= 0) & (there >= 0))
        found.append(np.stack([rows + first, columns]))
    rows, columns = np.concatenate(found, axis=1)
    return rows, columns


def count_seams(source: NDArray[np.int16], depth_m: NDArray[np.float32] | None) -> tuple[int, int]:
    """Count all seam cells, and those on depth edges."""
    n_seam = n_edge_seam = 0
    for first in range(0, source.shape[0], ROWS_AT_ONCE):
        # The row below the last row determines whether the last row contains seam cells.
        rows = slice(first, first + ROWS_AT_ONCE + 1)
        seam = is_seam(source[rows])[:ROWS_AT_ONCE]
        n_seam += int(np.count_nonzero(seam))
        if depth_m is not None:
            n_edge_seam += int(np.count_nonzero(seam & depth_edges(depth_m[rows])[:ROWS_AT_ONCE]))
    return n_seam, n_edge_seam


def is_seam(source: NDArray[np.int16]) -> NDArray[np.bool_]:
    """Return a mask of the cells whose right or lower neighbour has a different source."""
    seam = np.zeros(source.shape, dtype=np.bool_)
    for into, one, other in (
        (seam[:, :-1], source[:, :-1], source[:, 1:]),
        (seam[:-1], source[:-1], source[1:]),
    ):
        np.logical_or(into, (one != other) & (one >= 0) & (other >= 0), out=into)
    return seam


def _lab(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    import cv2

    if len(rgb) == 0:
        return np.zeros((0, 3), dtype=np.float32)
    levels = rgb[None].astype(np.float32) / np.float32(255.0)
    return np.asarray(cv2.cvtColor(levels, cv2.COLOR_RGB2Lab)[0], dtype=np.float32)
