"""Selection of the gaps to fill (skarlatos2012, section 3), and computation of their colours."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.levels import Colours
from orthoflow_plugins.ortho.parameters import Inpainting

if TYPE_CHECKING:
    from orthoflow.geometry.interpolation import Surroundings


_WINDOWS: Final = (3, 5, 7)
# Interpolation needs the point positions of coloured cells within this distance of a gap.
_BESIDE_CELLS: Final = 2
# OpenCV fills gaps from cells that it has already filled, so the influence of a cell is unlimited.
# Beyond this distance, it is less than one 8-bit level.
FRONT_CELLS: Final = 64


def reach_rows(inpainting: Inpainting, radius_px: float) -> int:
    """Return the maximum distance, in rows, at which a cell influences how a gap is filled."""
    if inpainting == "none":
        return 0
    reach = max(_WINDOWS) // 2 + math.ceil(radius_px) + 1 + _BESIDE_CELLS
    return reach if inpainting == "between" else reach + FRONT_CELLS


def fillable_gaps(is_void: NDArray[np.bool_], limits: tuple[int, int, int]) -> NDArray[np.bool_]:
    """Return a mask of the void cells that have few void cells around them.

    The void cells in the 3 x 3, 5 x 5 and 7 x 7 windows around a void cell are counted, including
    the cell itself; all three counts must be within their limits. Cells outside the image count as
    void, so fewer cells are filled along the image border and the image is never extrapolated. The
    rule is applied once.

    Args:
        is_void: (rows, cols) cells without a colour.
        limits: maximum counts in the three windows.

    Returns:
        (rows, cols) mask of the cells to fill.
    """
    is_fillable = is_void.copy()
    for window, limit in zip(_WINDOWS, limits, strict=True):
        is_fillable &= void_counts(is_void, window) <= limit
    return is_fillable


def void_counts(is_void: NDArray[np.bool_], window: int) -> NDArray[np.uint8]:
    """Count the void cells in a window around each cell; cells outside the image are void."""
    import cv2

    reach = window // 2
    padded = cv2.copyMakeBorder(
        is_void.astype(np.uint8), reach, reach, reach, reach, cv2.BORDER_CONSTANT, value=1
    )
    counts = cv2.boxFilter(padded, -1, (window, window), normalize=False)
    return np.asarray(counts[reach:-reach, reach:-reach], dtype=np.uint8)


def inpainted(
    rgb: NDArray[np.uint8],
    is_void: NDArray[np.bool_],
    is_fillable: NDArray[np.bool_],
    *,
    method: Inpainting,
    radius_px: float,
) -> NDArray[np.uint8]:
    """Inpaint the fillable cells with OpenCV, using only colours of cells that are not void.

    Args:
        rgb: (rows, cols, 3); values of void cells have no influence.
        is_void: (rows, cols) cells without a colour.
        is_fillable: (rows, cols) void cells to fill.
        method: method of `cv2.inpaint`.
        radius_px: radius within which cells influence the colour of a filled cell.

    Returns:
        (rows, cols, 3) colours, 0 in void cells that are not filled.
    """
    import cv2

    painted = np.where(is_void[..., np.newaxis], np.uint8(0), rgb)
    if is_void.all() or not is_fillable.any():
        return painted
    # cv2.inpaint treats every cell outside its mask as known, so the black of large voids would
    # bleed into adjacent gaps. To prevent this, first copy the colour of the nearest coloured cell
    # into each void cell.
    _, labels = cv2.distanceTransformWithLabels(
        is_void.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    known = np.flatnonzero(~is_void)
    known_of_label = np.zeros(known.size + 1, dtype=np.int64)
    known_of_label[labels.ravel()[known]] = known
    lent = rgb.reshape(-1, 3)[known_of_label[labels.ravel()]].reshape(rgb.shape)
    flag = cv2.INPAINT_TELEA if method == "telea" else cv2.INPAINT_NS
    found = cv2.inpaint(lent, is_fillable.astype(np.uint8), radius_px, flag)
    painted[is_fillable] = found[is_fillable]
    return painted


def painted_between(
    gaps: NDArray[np.int64],
    rgb: Colours,
    around: Surroundings,
    depth_m: NDArray[np.float32],
    *,
    reach_cells: float,
    threads: int,
) -> NDArray[np.bool_]:
    """Fill gaps in place by interpolating between the coloured cells around them.

    Args:
        gaps: (n,) flat indices of the cells to fill.
        rgb: (rows, cols, 3) 8-bit or 16-bit colours; the gaps are overwritten.
        around: the coloured cells.
        depth_m: (cells,) depth of the surface; NaN if unknown.
        reach_cells: a cell is filled only if there is a coloured cell within this distance.
        threads: number of threads.

    Returns:
        (rows, cols) mask of the cells that were filled.
    """
    from orthoflow.geometry.interpolation import cell_values, interpolate

    is_filled = np.zeros(rgb.shape[:2], dtype=np.bool_)
    values = cell_values(depth_m, rgb=rgb.reshape(-1, 3))
    into = values._replace(depth_m=np.empty(0, dtype=np.float32))
    found = interpolate(gaps, around, values, into, reach_cells=reach_cells, threads=threads)
    is_filled.ravel()[gaps[found]] = True
    return is_filled
