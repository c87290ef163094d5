"""Pictures of errors over a wall."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.images import encode_webp

if TYPE_CHECKING:
    from cv2.typing import MatLike

DEPTH_SPAN_MM: Final = 10.0
COLOUR_SPAN_GREY: Final = 60.0
DISPLACEMENT_SPAN_CELLS: Final = 1.0
_WIDEST_PX: Final = 900


def depth_error_map(depth_m: NDArray[np.float64]) -> bytes:
    """Picture of depth errors: blue behind the truth, red before it, black where nothing is."""
    import cv2

    scaled = np.nan_to_num(1e3 * depth_m / DEPTH_SPAN_MM, nan=0.0)
    grey = np.clip(127.5 * (1.0 + scaled), 0.0, 255.0).astype(np.uint8)
    return _picture(cv2.applyColorMap(grey, cv2.COLORMAP_JET), np.isnan(depth_m))


def colour_error_map(error_grey: NDArray[np.float64]) -> bytes:
    """Picture of colour errors: bright where they are large, blue where nothing is shown."""
    return _bright_where_large(error_grey / COLOUR_SPAN_GREY)


def displacement_map(displacement_cells: NDArray[np.float64]) -> bytes:
    """Picture of displacements (rows, cols): bright where large, blue where none is known."""
    return _bright_where_large(displacement_cells / DISPLACEMENT_SPAN_CELLS)


def _bright_where_large(shares: NDArray[np.float64]) -> bytes:
    import cv2

    grey = np.clip(255.0 * np.nan_to_num(shares, nan=0.0), 0.0, 255.0).astype(np.uint8)
    return _picture(cv2.applyColorMap(grey, cv2.COLORMAP_INFERNO), np.isnan(shares))


def _picture(coloured: MatLike, missing: NDArray[np.bool_]) -> bytes:
    import cv2

    bgr = np.asarray(coloured, dtype=np.uint8)
    bgr[missing] = (60, 40, 20)
    scale = min(1.0, _WIDEST_PX / max(bgr.shape[:2]))
    if scale < 1.0:
        bgr = np.asarray(
            cv2.resize(bgr, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8
        )
    return encode_webp(bgr[:, :, ::-1])
