"""The surface `tin`: a triangulation of the whole wall, with one point per cell."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry.rastering import NO_POINT, wall_from_offset
from orthoflow.geometry.slabs import Slab
from orthoflow.products import PointCloud

if TYPE_CHECKING:
    from scipy.spatial import Delaunay

_ROWS_AT_ONCE: Final = 256
_ROUNDING_CELLS: Final = 1e-6


# Values at the centres of the cells: depth, and, if the cloud has them, intensity and colour
# (cells, 3). Outside all triangles, depth and intensity are NaN, and colour is 0.
Net = tuple[NDArray[np.float32], NDArray[np.float32] | None, NDArray[np.uint8] | None]


def interpolate_net(
    cloud: PointCloud, slab: Slab, point: NDArray[np.uint32], depth_m: NDArray[np.float32]
) -> Net:
    """Interpolate values at all cell centres linearly in a Delaunay triangulation.

    The triangulation closes all gaps, including windows, and turns steps in depth into slopes.

    Args:
        cloud: the points.
        slab: raster and buffer of the wall.
        point: (cells,) for each cell, the index in the cloud of the point that is a vertex;
            `NO_POINT` if there is none.
        depth_m: (cells,) depth of the vertices.

    Raises:
        MethodError: no triangle covers the centre of a cell.
    """
    from scipy.spatial import Delaunay, QhullError

    taken = point[point != NO_POINT]
    values: list[NDArray[np.generic]] = [depth_m[point != NO_POINT][:, np.newaxis]]
    if cloud.intensity is not None:
        values.append(np.asarray(cloud.intensity)[taken, np.newaxis])
    if cloud.rgb is not None:
        rgb = np.asarray(cloud.rgb)[taken].astype(np.float64)
        if cloud.has_rgb is not None:
            rgb[~np.asarray(cloud.has_rgb)[taken]] = np.nan
        values.append(rgb)
    table = np.column_stack([np.asarray(part, dtype=np.float64) for part in values])
    # Vertices are in columns and rows; the centres of cells are at (column + 0.5, row + 0.5).
    matrix = wall_from_offset(slab.frame, cloud.origin)
    offsets = np.stack([axis[taken] for axis in (cloud.x, cloud.y, cloud.z)]).astype(np.float64)
    found = np.full((slab.n_cells, table.shape[1]), np.nan, dtype=np.float32)
    with suppress(QhullError, ValueError):
        delaunay = Delaunay((matrix[:2, :3] @ offsets).T + matrix[:2, 3])
        _interpolate(delaunay, table, slab, found)
    if np.isnan(found).all():
        raise MethodError(
            "surface tin triangulates the points of each wall, but the points in the "
            f"{len(taken)} occupied cells of this wall form no triangle that covers the centre of "
            "a cell: use another surface"
        )
    intensity = None if cloud.intensity is None else found[:, 1].copy()
    rgb = None if cloud.rgb is None else np.rint(np.nan_to_num(found[:, -3:])).astype(np.uint8)
    return found[:, 0].copy(), intensity, rgb


def _interpolate(
    delaunay: Delaunay, table: NDArray[np.float64], slab: Slab, found: NDArray[np.float32]
) -> None:
    from scipy.interpolate import LinearNDInterpolator
    from scipy.spatial import ConvexHull

    interpolator = LinearNDInterpolator(delaunay, table)
    sides = ConvexHull(delaunay.points).equations
    for top in range(0, slab.frame.height, _ROWS_AT_ONCE):
        bottom = min(top + _ROWS_AT_ONCE, slab.frame.height)
        rows, columns = (axis.ravel() for axis in np.mgrid[top:bottom, : slab.frame.width] + 0.5)
        # Exclude positions outside the convex hull, because scipy tests all triangles for each of
        # these.
        inside = np.ones(rows.size, dtype=np.bool_)
        for right, down, offset in sides:
            inside &= right * columns + down * rows + offset <= _ROUNDING_CELLS
        near = np.flatnonzero(inside)
        found[top * slab.frame.width + near] = interpolator(columns[near], rows[near])
