"""How well the sources of a wall agree: displacements between layers where they overlap."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.row_bands import row_bands
from orthoflow.products import Layer, LayerMask

PATCH_CELLS: Final = 64
_PATCHES_MOST: Final = 200
# Flat patches show no displacement, and weak peaks show chance.
_CONTRAST_LEAST_GREY: Final = 3.0
_RESPONSE_LEAST: Final = 0.15


def displacements_cells(layers: Sequence[Layer]) -> NDArray[np.float64]:
    """Displacements (n, 2) = (u, v) in cells between the two best layers of patches of a wall.

    Patches of 64 x 64 cells that both layers paint wholly are compared by phase correlation, which
    is good to about a tenth of a cell.
    """
    import cv2

    pairs = _best_pairs(layers)
    chosen = np.linspace(0, len(pairs) - 1, min(len(pairs), _PATCHES_MOST)).round().astype(int)
    window = cv2.createHanningWindow((PATCH_CELLS, PATCH_CELLS), cv2.CV_32F)
    found = []
    for row, column, first, second in (pairs[place] for place in chosen):
        part = (slice(row, row + PATCH_CELLS), slice(column, column + PATCH_CELLS))
        patches = [_grey(layers[index].rgb[part]) for index in (first, second)]
        if min(float(patch.std()) for patch in patches) < _CONTRAST_LEAST_GREY:
            continue
        shift, response = cv2.phaseCorrelate(patches[0], patches[1], window)
        if response >= _RESPONSE_LEAST:
            found.append(shift)
    return np.array(found, dtype=np.float64).reshape(-1, 2)


def _best_pairs(layers: Sequence[Layer]) -> list[tuple[int, int, int, int]]:
    """Row and column of patches, and the two best layers that paint them wholly."""
    n_rows, n_columns = (side // PATCH_CELLS for side in layers[0].frame.shape)
    if len(layers) < 2 or not n_rows or not n_columns:
        return []
    qualities = np.stack([_patch_qualities(layer, (n_rows, n_columns)) for layer in layers])
    order = np.argsort(-qualities, axis=0, kind="stable")[:2]
    second = np.take_along_axis(qualities, order[1:], axis=0)[0]
    return [
        (
            int(row) * PATCH_CELLS,
            int(column) * PATCH_CELLS,
            int(order[0, row, column]),
            int(order[1, row, column]),
        )
        for row, column in np.argwhere(second > 0.0)
    ]


def _patch_qualities(layer: Layer, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Mean quality of each patch, 0 where the layer does not paint all of it."""
    worths: list[NDArray[np.float64]] = []
    columns = shape[1] * PATCH_CELLS
    for rows in row_bands((shape[0] * PATCH_CELLS, columns), multiple=PATCH_CELLS):
        blocks = (-1, PATCH_CELLS, shape[1], PATCH_CELLS)
        is_painted = layer.mask[rows, :columns] == LayerMask.PAINTED
        whole = is_painted.reshape(blocks).all(axis=(1, 3))
        quality = layer.quality[rows, :columns].reshape(blocks)
        worths.append(np.where(whole, quality.mean(axis=(1, 3), dtype=np.float64), 0.0))
    return np.concatenate(worths)


def _grey(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    return np.ascontiguousarray(rgb.mean(axis=2, dtype=np.float32))
