"""The surface that a net of triangles makes of the points: what markiewicz2015 advises against."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import MethodError

_VERTICES_MOST: Final = 2_000_000
_ROWS_AT_ONCE: Final = 256


def interpolated(
    places: NDArray[np.float64],
    values: Sequence[NDArray[np.generic]],
    shape: tuple[int, int],
) -> list[NDArray[np.float32]]:
    """Values at all cell centres, linear in the triangles of a Delaunay net.

    The net spans every gap, windows included, and lays slopes where depths step.

    Args:
        places: (n, 2) column and row of the vertices, cell centres at .5.
        values: arrays (n, channels), each with values at the vertices.
        shape: rows and columns of the raster.

    Returns:
        An array (cells, channels) for each of `values`; NaN outside the net.

    Raises:
        MethodError: the points make no triangle, or too many.
    """
    from scipy.interpolate import LinearNDInterpolator
    from scipy.spatial import Delaunay, QhullError

    if len(places) > _VERTICES_MOST:
        raise MethodError(
            f"surface tin takes at most {_VERTICES_MOST} cells with points, this wall has "
            f"{len(places)}: raise gsd_m, or take another surface"
        )
    stacked = np.column_stack([np.asarray(array, dtype=np.float64) for array in values])
    no_net = MethodError(
        f"surface tin needs points that span triangles about the cells of each wall, and the "
        f"{len(places)} cells with points of this one do not: take another surface"
    )
    try:
        net = Delaunay(places)
    except (QhullError, ValueError) as error:
        raise no_net from error
    look_up = LinearNDInterpolator(net, stacked)
    rows, columns = shape
    found = np.empty((rows * columns, stacked.shape[1]), dtype=np.float32)
    for first in range(0, rows, _ROWS_AT_ONCE):
        end = min(first + _ROWS_AT_ONCE, rows)
        row, column = np.mgrid[first:end, :columns] + 0.5
        found[first * columns : end * columns] = look_up(
            np.column_stack([column.ravel(), row.ravel()])
        )
    if not np.isfinite(found).any():
        raise no_net
    widths = np.cumsum([array.shape[1] for array in values])[:-1]
    return np.split(found, widths, axis=1)
