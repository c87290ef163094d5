"""The pair of pictures that skarlatos2012 shows in Figure 5: before and after filling."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.products import Layer, LayerMask

_SIDE_CELLS: Final = 240
_ZOOM: Final = 3
_GUTTER_PX: Final = 12
_VOID_RGB: Final = (255, 0, 255)


def filling_preview(rgb_before: NDArray[np.uint8], layer: Layer) -> bytes:
    """PNG of the part of a layer where most was filled: left before, right after, enlarged.

    Args:
        rgb_before: (rows, cols, 3) colours before filling.
        layer: the layer after it.
    """
    import cv2

    is_filled = np.zeros(layer.mask.shape, dtype=bool) if layer.filled is None else layer.filled > 0
    is_shown = layer.mask == LayerMask.PAINTED
    part = _busiest_part(is_filled)
    before, after = rgb_before[part].copy(), layer.rgb[part].copy()
    before[~is_shown[part] | is_filled[part]] = _VOID_RGB
    after[~is_shown[part]] = _VOID_RGB
    pair = [np.repeat(np.repeat(picture, _ZOOM, 0), _ZOOM, 1) for picture in (before, after)]
    gutter = np.full((pair[0].shape[0], _GUTTER_PX, 3), 255, dtype=np.uint8)
    picture = np.hstack([pair[0], gutter, pair[1]])
    return bytes(cv2.imencode(".png", picture[..., ::-1])[1])


def _busiest_part(is_filled: NDArray[np.bool_]) -> tuple[slice, slice]:
    """The tile of `_SIDE_CELLS` with the most filled cells; the first one among equals."""
    rows, columns = is_filled.shape
    tiles = [
        (slice(row, row + _SIDE_CELLS), slice(column, column + _SIDE_CELLS))
        for row in range(0, rows, _SIDE_CELLS)
        for column in range(0, columns, _SIDE_CELLS)
    ]
    return max(tiles, key=lambda tile: np.count_nonzero(is_filled[tile]))
