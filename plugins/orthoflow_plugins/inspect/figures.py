"""Figures of an inspection: errors over a wall as colours, displacements as arrows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.images import encode_webp
from orthoflow.geometry.levels import eight_bits
from orthoflow.products import Orthoimage

if TYPE_CHECKING:
    from cv2.typing import MatLike

DEPTH_SPAN_MM: Final = 10.0
COLOUR_SPAN_GREY: Final = 60.0
DISPLACEMENT_SPAN_CELLS: Final = 1.0
_MAP_PX: Final = 900
_LONGEST_PX: Final = 1100
_SMALLEST_PX: Final = 500
# In larger images squares of cells are averaged before drawing.
_WHOLE_CELLS: Final = 1 << 24
# Length of the longest usual arrow.
_ARROW_PX: Final = 40.0
_NAMES_MOST: Final = 60
_HEAD_PX: Final = 8.0
_ARROWS_MOST: Final = 1500
_ENLARGED_MOST: Final = 500.0


def depth_error_map(depth_m: NDArray[np.float64]) -> bytes:
    """Return a picture of depth errors: blue behind the truth, red in front, black without data."""
    import cv2

    scaled = np.nan_to_num(1e3 * depth_m / DEPTH_SPAN_MM, nan=0.0)
    grey = np.clip(127.5 * (1.0 + scaled), 0.0, 255.0).astype(np.uint8)
    return _picture(cv2.applyColorMap(grey, cv2.COLORMAP_JET), np.isnan(depth_m))


def colour_error_map(error_grey: NDArray[np.float64]) -> bytes:
    """Return a picture of colour errors: bright if large, blue without data."""
    return _bright_where_large(error_grey / COLOUR_SPAN_GREY)


def displacement_map(displacement_cells: NDArray[np.float64]) -> bytes:
    """Return a picture of displacements (rows, cols): bright if large, blue if unknown."""
    return _bright_where_large(displacement_cells / DISPLACEMENT_SPAN_CELLS)


def vector_map(
    image: Orthoimage,
    places: NDArray[np.float64],
    shift_cells: NDArray[np.float64],
    names: Sequence[str] = (),
) -> bytes:
    """Draw an orthoimage in pale grey, and arrows from true to shown positions.

    Arrows are green up to the median length, yellow up to twice that, red beyond. Of many pairs an
    evenly spread part is drawn.

    Args:
        image: the inspected orthoimage.
        places: (n, 2) shown positions (column, row).
        shift_cells: (n, 2) shown - true.
        names: n labels of the arrows, omitted if there are many; empty for none.
    """
    import cv2

    scale = _scale(image)
    rows, columns = image.frame.shape
    size = (max(1, round(columns * scale)), max(1, round(rows * scale)))
    way = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_NEAREST
    pale = 0.5 * np.asarray(cv2.resize(_grey_means(image), size, interpolation=way)) + 100.0
    picture = np.repeat(pale.astype(np.uint8)[:, :, None], 3, axis=2)
    length = np.linalg.norm(shift_cells, axis=1)
    middle = float(np.median(length)) if len(length) else 0.0
    times = enlargement(shift_cells, image)
    for k in range(0, len(places), max(1, len(places) // _ARROWS_MOST)):
        tip = scale * places[k]
        tail = tip - scale * times * shift_cells[k]
        colour = (30, 160, 30) if length[k] <= middle else (230, 180, 0)
        colour = (220, 30, 30) if length[k] > 2.0 * middle else colour
        ends = [(round(float(x)), round(float(y))) for x, y in (tail, tip)]
        head = min(0.3, _HEAD_PX / max(scale * times * float(length[k]), 1e-9))
        cv2.arrowedLine(picture, ends[0], ends[1], colour, 1, cv2.LINE_AA, tipLength=head)
        if 0 < len(names) <= _NAMES_MOST:
            beside = (ends[1][0] + 5, ends[1][1] - 5)
            font = cv2.FONT_HERSHEY_SIMPLEX
            cv2.putText(picture, names[k], beside, font, 0.4, (20, 20, 20), 1, cv2.LINE_AA)
    return encode_webp(picture)


def _grey_means(image: Orthoimage) -> NDArray[np.float32]:
    """Return mean colours of cells; in a large image those of squares of cells.

    Cells beyond a whole number of squares are omitted.
    """
    factor = 1
    if image.mask.size > _WHOLE_CELLS:
        factor = max(1, max(image.frame.shape) // (2 * _LONGEST_PX))
    if factor == 1:
        return np.asarray(eight_bits(image.rgb).mean(axis=2, dtype=np.float32))
    rows, columns = (size // factor for size in image.frame.shape)
    means = np.empty((rows, columns), dtype=np.float32)
    for row in range(rows):
        squares = image.rgb[row * factor : (row + 1) * factor, : columns * factor]
        grey = eight_bits(squares).reshape(factor, columns, factor * 3)
        means[row] = grey.mean(axis=(0, 2), dtype=np.float32)
    return means


def enlargement(shift_cells: NDArray[np.float64], image: Orthoimage) -> float:
    """Return the magnification with which `vector_map` draws displacements (n, 2)."""
    if not len(shift_cells):
        return 1.0
    usual = float(np.percentile(np.linalg.norm(shift_cells, axis=1), 95))
    wanted = _ARROW_PX / max(usual * _scale(image), 1e-9)
    # One leading digit, for an easily readable caption.
    digits = 10.0 ** np.floor(np.log10(wanted))
    return float(np.clip(np.floor(wanted / digits) * digits, 1.0, _ENLARGED_MOST))


def _bright_where_large(shares: NDArray[np.float64]) -> bytes:
    import cv2

    grey = np.clip(255.0 * np.nan_to_num(shares, nan=0.0), 0.0, 255.0).astype(np.uint8)
    return _picture(cv2.applyColorMap(grey, cv2.COLORMAP_INFERNO), np.isnan(shares))


def _picture(coloured: MatLike, missing: NDArray[np.bool_]) -> bytes:
    import cv2

    bgr = np.asarray(coloured, dtype=np.uint8)
    bgr[missing] = (60, 40, 20)
    scale = min(1.0, _MAP_PX / max(bgr.shape[:2]))
    if scale < 1.0:
        bgr = np.asarray(
            cv2.resize(bgr, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8
        )
    return encode_webp(bgr[:, :, ::-1])


def _scale(image: Orthoimage) -> float:
    longest = max(image.frame.shape)
    return float(np.clip(1.0, _SMALLEST_PX / longest, _LONGEST_PX / longest))
