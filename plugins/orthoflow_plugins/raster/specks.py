"""What only outliers and mixed distances measured, told from the raster of depths."""

from __future__ import annotations

from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.depth_noise import depth_noise_m
from orthoflow.geometry.rastering import in_parts
from orthoflow.geometry.speck_kernels import NEAR_CELLS, SpeckRule, find_specks

# A cell is sparse where less than this share of the cells is known as somewhere around is.
_SPARSE_SHARE: Final = 0.35
# The shadow of an edge is narrower than twice this reach, in cells.
_AROUND_CELLS: Final = 16
# Cells on one surface differ by noise, in standard deviations, and by its slope.
_CLOSE_SIGMAS: Final = 4.0


def without_specks(
    depth_m: NDArray[np.float32], *, gsd_m: float, layer_m: float, threads: int
) -> NDArray[np.float32]:
    """Leave void what only an outlier measured: a cell that hardly any of those around agrees with.

    A photo would paint it with a place far off. Where an edge casts its shadow on the scan, and
    cells are sparse that are dense beside it, what is there are outliers and distances mixed of
    both sides of the edge: most of the few cells around must agree, but for a slope.

    Args:
        depth_m: (rows, cols) metres, NaN where void.
        gsd_m: side of a cell.
        layer_m: depths that differ by more are of different layers.
        threads: how many threads work.
    """
    noise_m = min(layer_m, _CLOSE_SIGMAS * depth_noise_m(depth_m))
    rule = SpeckRule(layer_m=layer_m, noise_m=noise_m, gsd_m=gsd_m)
    is_sparse, is_speck = _sparse(np.isfinite(depth_m)), np.zeros(depth_m.shape, dtype=np.bool_)
    task = partial(find_specks, depth_m, is_sparse, rule, is_speck)
    in_parts(depth_m.shape[0], threads, task)
    return np.where(is_speck, np.float32(np.nan), depth_m)


def _sparse(is_known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Known cells with far fewer known ones near them than there are near cells around."""
    import cv2

    near = 2 * NEAR_CELLS + 1
    known = np.asarray(
        cv2.boxFilter(
            is_known.view(np.uint8),
            cv2.CV_8U,
            (near, near),
            normalize=False,
            borderType=cv2.BORDER_CONSTANT,
        )
    )
    around = cv2.dilate(known, np.ones((2 * _AROUND_CELLS + 1,) * 2, dtype=np.uint8))
    return is_known & (known < _SPARSE_SHARE * np.asarray(around))
