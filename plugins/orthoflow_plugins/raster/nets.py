"""The surface `tin`: a triangulation of one point per cell, in tiles on large walls.

A triangle belongs to the (Delaunay) triangulation if its circumcircle contains no other point, and
only the points inside the circle need be known to decide it. So the triangle over a cell is that of
the whole wall if its circle is inside the window that was searched, and tiles give the triangles of
the whole. On large walls the triangulation consists of the triangles whose circle spans at most
`SPAN_MOST_CELLS` of the raster; this set does not depend on the tiles.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry.bands import Allocate, in_memory, row_bands
from orthoflow.geometry.rastering import wall_from_offset
from orthoflow.geometry.slabs import Slab
from orthoflow.products import PointCloud

if TYPE_CHECKING:
    from scipy.spatial import Delaunay

# Some rows and columns of a raster: the first ones, and those after the last.
_Window = tuple[int, int, int, int]
NO_POINT: Final = np.uint32(0xFFFFFFFF)
# A triangulation with more vertices is made in tiles; a vertex takes about 700 bytes.
VERTICES_MOST: Final = 2_000_000
# Maximum diameter of circumcircles within the raster, on large walls.
SPAN_MOST_CELLS: Final = 128
_TILE_CELLS: Final = 768
_ROWS_AT_ONCE: Final = 256
_ROUNDING_CELLS: Final = 1e-6


@dataclass(frozen=True, kw_only=True)
class Vertices:
    """The points of the triangulation, at most one per cell.

    Attributes:
        point: (rows, cols) uint32, index in the cloud; `NO_POINT` without one.
        depth_m: (rows, cols) float32.
    """

    point: NDArray[np.uint32]
    depth_m: NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Net:
    """Interpolated values at the centres of the cells, all arrays flat over these.

    Attributes:
        depth_m: float32, NaN without a triangle.
        intensity: float32, likewise, or None.
        rgb: (cells, 3) uint8, 0 without a triangle, or None.
    """

    depth_m: NDArray[np.float32]
    intensity: NDArray[np.float32] | None
    rgb: NDArray[np.uint8] | None

    def part(self, cells: slice) -> Net:
        """Return copies of the values of some cells."""
        return Net(
            depth_m=np.array(self.depth_m[cells]),
            intensity=None if self.intensity is None else np.array(self.intensity[cells]),
            rgb=None if self.rgb is None else np.array(self.rgb[cells]),
        )


def interpolate_net(
    cloud: PointCloud, slab: Slab, vertices: Vertices, allocate: Allocate = in_memory
) -> Net:
    """Interpolate values at all cell centres linearly in the triangles.

    The triangulation spans gaps, including windows, and makes slopes where depths step.

    Args:
        cloud: the points.
        slab: of the wall.
        vertices: of the net.
        allocate: returns the arrays of a large wall, by name.

    Raises:
        MethodError: the points form no triangle.
    """
    shape, n_cells = slab.frame.shape, slab.n_cells
    n_vertices = sum(
        int(np.count_nonzero(vertices.point[rows] != NO_POINT)) for rows in row_bands(shape)
    )
    intensity = rgb = None
    if cloud.intensity is not None:
        intensity = np.asarray(allocate("net_intensity", (n_cells,), np.float32), np.float32)
    if cloud.rgb is not None:
        rgb = np.asarray(allocate("net_rgb", (n_cells, 3), np.uint8), np.uint8)
    net = Net(
        depth_m=np.asarray(allocate("net_depth_m", (n_cells,), np.float32), np.float32),
        intensity=intensity,
        rgb=rgb,
    )
    surface = _Surface(cloud=cloud, slab=slab, vertices=vertices, net=net)
    if n_vertices <= VERTICES_MOST:
        n_set = surface.interpolate((0, 0, *shape), (0, 0, *shape), np.inf)
    else:
        n_set = 0
        for top in range(0, shape[0], _TILE_CELLS):
            for left in range(0, shape[1], _TILE_CELLS):
                bottom, right = min(shape[0], top + _TILE_CELLS), min(shape[1], left + _TILE_CELLS)
                window = (
                    max(0, top - SPAN_MOST_CELLS),
                    max(0, left - SPAN_MOST_CELLS),
                    min(shape[0], bottom + SPAN_MOST_CELLS),
                    min(shape[1], right + SPAN_MOST_CELLS),
                )
                tile = (top, left, bottom, right)
                n_set += surface.interpolate(tile, window, SPAN_MOST_CELLS)
    if not n_set:
        raise MethodError(
            "surface tin needs points that span triangles about the cells of each wall, and the "
            f"{n_vertices} cells with points of this one do not: take another surface"
        )
    return net


@dataclass(frozen=True, kw_only=True)
class _Surface:
    """A wall under triangulation."""

    cloud: PointCloud
    slab: Slab
    vertices: Vertices
    net: Net

    def interpolate(self, tile: _Window, window: _Window, span_cells: float) -> int:
        """Set the values of a tile by the triangles of a window; count the cells with a triangle.

        Args:
            tile: its first row and column, and those after the last ones.
            window: the same of the points that are triangulated.
            span_cells: maximum diameter of the triangles' circles within the raster.
        """
        from scipy.spatial import Delaunay, QhullError

        cloud, matrix = self.cloud, wall_from_offset(self.slab.frame, self.cloud.origin)
        cells = slice(window[0], window[2]), slice(window[1], window[3])
        has_point = self.vertices.point[cells] != NO_POINT
        taken = self.vertices.point[cells][has_point]
        values: list[NDArray[np.generic]] = [self.vertices.depth_m[cells][has_point][:, None]]
        if cloud.intensity is not None:
            values.append(np.asarray(cloud.intensity)[taken, np.newaxis])
        if cloud.rgb is not None:
            rgb = np.asarray(cloud.rgb)[taken].astype(np.float64)
            if cloud.has_rgb is not None:
                rgb[~np.asarray(cloud.has_rgb)[taken]] = np.nan
            values.append(rgb)
        # Columns and rows in the window, cell centres at .5.
        offsets = np.stack([axis[taken] for axis in (cloud.x, cloud.y, cloud.z)])
        corner = matrix[:2, 3] - (window[1], window[0])
        triangles = None
        with suppress(QhullError, ValueError):
            triangles = _Triangles(
                window=window,
                shape=self.slab.frame.shape,
                delaunay=Delaunay((matrix[:2, :3] @ offsets.astype(np.float64)).T + corner),
                values=np.column_stack([np.asarray(part, dtype=np.float64) for part in values]),
            )
        n_channels, n_set = sum(part.shape[1] for part in values), 0
        for top in range(tile[0], tile[2], _ROWS_AT_ONCE):
            rows, columns = (
                axis.ravel()
                for axis in np.mgrid[top : min(top + _ROWS_AT_ONCE, tile[2]), tile[1] : tile[3]]
            )
            found = np.full((rows.size, n_channels), np.nan, dtype=np.float32)
            if triangles is not None:
                triangles.interpolate(rows, columns, span_cells, found)
            at = rows * self.slab.frame.width + columns
            self.net.depth_m[at] = found[:, 0]
            if self.net.intensity is not None:
                self.net.intensity[at] = found[:, 1]
            if self.net.rgb is not None:
                self.net.rgb[at] = np.rint(np.nan_to_num(found[:, -3:])).astype(np.uint8)
            n_set += int(np.isfinite(found).any(axis=1).sum())
        return n_set


@dataclass(frozen=True, kw_only=True)
class _Triangles:
    """A triangulation over a window of a raster.

    Attributes:
        window: its window.
        shape: of the raster.
        delaunay: the triangulation, in cells of the window.
        values: (n, channels) of its vertices.
    """

    window: _Window
    shape: tuple[int, int]
    delaunay: Delaunay
    values: NDArray[np.float64]

    def interpolate(
        self,
        rows: NDArray[np.int64],
        columns: NDArray[np.int64],
        span_cells: float,
        found: NDArray[np.float32],
    ) -> None:
        """Set the values (n, channels) at cells whose triangle has a circle within the span.

        Computed as by scipy's LinearNDInterpolator, which does not return the triangle.
        """
        aside = [columns - self.window[1], rows - self.window[0]]
        centres = np.column_stack(aside).astype(np.float64) + 0.5
        simplex = np.full(len(centres), -1, dtype=np.int32)
        near = self._within_reach(centres)
        simplex[near] = self.delaunay.find_simplex(centres[near])
        inside = np.flatnonzero(simplex >= 0)
        if np.isfinite(span_cells):
            names, which = np.unique(simplex[inside], return_inverse=True)
            inside = inside[self._belongs(names, span_cells)[which]]
        simplex = simplex[inside]
        transform = self.delaunay.transform[simplex]
        from_last = centres[inside] - transform[:, 2]
        first, second = (
            transform[:, k, 0] * from_last[:, 0] + transform[:, k, 1] * from_last[:, 1]
            for k in (0, 1)
        )
        corners = self.delaunay.simplices[simplex]
        total = np.zeros((inside.size, self.values.shape[1]))
        for k, share in enumerate((first, second, 1.0 - first - second)):
            total += share[:, np.newaxis] * self.values[corners[:, k]]
        found[inside] = total

    def _within_reach(self, centres: NDArray[np.float64]) -> NDArray[np.int64]:
        """Which positions (n, 2) are inside the outline; scipy tests all triangles for others."""
        lines, line = np.unique(centres[:, 1], return_inverse=True)
        ends = self.delaunay.points[self.delaunay.convex_hull]
        ends = np.take_along_axis(ends, ends[:, :, 1:].argsort(axis=1), axis=1)
        (left, upper), (right, lower) = ends[:, 0].T, ends[:, 1].T
        with np.errstate(all="ignore"):
            share = (lines[:, np.newaxis] - upper) / (lower - upper)
        crosses = (share >= 0.0) & (share <= 1.0)
        at = left + share * (right - left)
        first = np.where(crosses, at, np.inf).min(axis=1) - _ROUNDING_CELLS
        last = np.where(crosses, at, -np.inf).max(axis=1) + _ROUNDING_CELLS
        return np.flatnonzero((centres[:, 0] >= first[line]) & (centres[:, 0] <= last[line]))

    def _belongs(self, simplices: NDArray[np.int32], span_cells: float) -> NDArray[np.bool_]:
        """Which triangles belong to the whole triangulation and have a circle within the span."""
        corners = self.delaunay.points[self.delaunay.simplices[simplices]]
        b, c = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        b_square, c_square = (b**2).sum(axis=1), (c**2).sum(axis=1)
        with np.errstate(all="ignore"):
            double = 2.0 * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0])
            aside = np.column_stack(
                [
                    (c[:, 1] * b_square - b[:, 1] * c_square) / double,
                    (b[:, 0] * c_square - c[:, 0] * b_square) / double,
                ]
            )
            centre, radius = corners[:, 0] + aside, np.hypot(*aside.T)
            # The part of the circle outside the raster contains no point of the wall.
            low = -np.array([self.window[1], self.window[0]], dtype=np.float64)
            high = low + self.shape[::-1]
            beside = np.clip(centre, low, high) - centre
            half = np.sqrt(np.maximum(radius[:, np.newaxis] ** 2 - beside[:, ::-1] ** 2, 0.0))
            span = np.minimum(centre + half, high) - np.maximum(centre - half, low)
            belongs: NDArray[np.bool_] = (span <= span_cells).all(axis=1)
        return belongs
