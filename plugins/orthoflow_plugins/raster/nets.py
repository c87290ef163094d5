"""The surface `tin`: a triangulation of one point per cell, in tiles on large walls.

A triangle belongs to the (Delaunay) triangulation if its circumcircle contains no other point, and
only the points inside the circle need be known to decide it. So the triangle over a cell is that of
the whole wall if its circle is inside the window that was searched, and tiles give the triangles of
the whole. On large walls the triangulation consists of the triangles whose circle spans at most
`SPAN_MOST_CELLS` of the raster; this set does not depend on the tiles.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry.bands import Allocate, in_memory, row_bands
from orthoflow.geometry.rastering import wall_from_offset
from orthoflow.geometry.slabs import Slab
from orthoflow.products import PointCloud

if TYPE_CHECKING:
    from scipy.spatial import Delaunay, cKDTree

NO_POINT: Final = np.uint32(0xFFFFFFFF)
# A triangulation with more vertices is made in tiles; a vertex takes about 700 bytes.
VERTICES_MOST: Final = 2_000_000
# Maximum diameter of circumcircles within the raster.
SPAN_MOST_CELLS: Final = 512
# Most triangles are small, so that a smaller window suffices.
_SPAN_CELLS: Final = 64
_TILE_CELLS: Final = 768
_ROWS_AT_ONCE: Final = 256
# Vertices of wide triangles are this close to cells that are this far from all points.
_RIM_CELLS: Final = 20
_EMPTY_CELLS: Final = 16
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
    n_vertices, n_set = n_vertices_of(vertices), 0
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
        n_set = surface.interpolate(_Window(0, 0, *shape))
    else:
        for tile in _tiles(shape):
            n_set += surface.interpolate_tile(tile)
    if not n_set:
        raise MethodError(
            "surface tin needs points that span triangles about the cells of each wall, and the "
            f"{n_vertices} cells with points of this one do not: take another surface"
        )
    return net


def n_vertices_of(vertices: Vertices) -> int:
    """Return the number of vertices."""
    return sum(
        int(np.count_nonzero(vertices.point[rows] != NO_POINT))
        for rows in row_bands(vertices.point.shape)
    )


class _Window(NamedTuple):
    """Some rows and columns of a raster: the first ones, and those after the last."""

    top: int
    left: int
    bottom: int
    right: int

    def widened(self, cells: int, shape: tuple[int, int]) -> _Window:
        return _Window(
            max(0, self.top - cells),
            max(0, self.left - cells),
            min(shape[0], self.bottom + cells),
            min(shape[1], self.right + cells),
        )

    @property
    def cells(self) -> tuple[slice, slice]:
        return slice(self.top, self.bottom), slice(self.left, self.right)


def _tiles(shape: tuple[int, int]) -> Iterator[_Window]:
    for top in range(0, shape[0], _TILE_CELLS):
        for left in range(0, shape[1], _TILE_CELLS):
            yield _Window(top, left, top + _TILE_CELLS, left + _TILE_CELLS).widened(0, shape)


@dataclass(frozen=True, kw_only=True)
class _Surface:
    """A wall under triangulation."""

    cloud: PointCloud
    slab: Slab
    vertices: Vertices
    net: Net

    def interpolate(self, window: _Window) -> int:
        """Triangulate a whole wall; return the number of cells with a triangle."""
        triangles = self._triangles(window)
        return sum(
            self._set(rows, columns, triangles, np.inf).size for rows, columns in _cells_of(window)
        )

    def interpolate_tile(self, tile: _Window) -> int:
        """Triangulate one tile of a large wall; return the number of cells with a triangle."""
        shape, n_set = self.slab.frame.shape, 0
        near = self._triangles(tile.widened(_SPAN_CELLS, shape))
        wide = []
        for rows, columns in _cells_of(tile):
            found_here = self._set(rows, columns, near, _SPAN_CELLS)
            is_set = np.zeros(rows.size, dtype=np.bool_)
            is_set[found_here] = True
            wide.append(np.stack([rows[~is_set], columns[~is_set]]))
            n_set += found_here.size
        rows, columns = np.concatenate(wide, axis=1)
        if rows.size:
            around = tile.widened(SPAN_MOST_CELLS, shape)
            far = self._triangles(around, rim_only=True)
            n_set += self._set(rows, columns, far, SPAN_MOST_CELLS).size
        return n_set

    def _triangles(self, window: _Window, *, rim_only: bool = False) -> _Triangles | None:
        """Return the triangulation of the points of a window; None if there are too few.

        Args:
            window: the window of the points.
            rim_only: only of points beside large gaps. Triangles whose circle contains other points
                are dropped.
        """
        from scipy.spatial import Delaunay, QhullError, cKDTree

        points = self.vertices.point[window.cells]
        has_point = points != NO_POINT
        chosen = _beside_gaps(has_point) if rim_only else has_point
        try:
            delaunay = Delaunay(self._places(points[chosen], window))
        except (QhullError, ValueError):
            return None
        cloud, taken = self.cloud, points[chosen]
        values: list[NDArray[np.generic]] = [self.vertices.depth_m[window.cells][chosen][:, None]]
        if cloud.intensity is not None:
            values.append(np.asarray(cloud.intensity)[taken, np.newaxis])
        if cloud.rgb is not None:
            rgb = np.asarray(cloud.rgb)[taken].astype(np.float64)
            if cloud.has_rgb is not None:
                rgb[~np.asarray(cloud.has_rgb)[taken]] = np.nan
            values.append(rgb)
        return _Triangles(
            window=window,
            shape=self.slab.frame.shape,
            delaunay=delaunay,
            values=np.column_stack([np.asarray(part, dtype=np.float64) for part in values]),
            others=cKDTree(self._places(points[has_point], window), balanced_tree=False)
            if rim_only
            else None,
        )

    def _places(self, points: NDArray[np.uint32], window: _Window) -> NDArray[np.float64]:
        """Return positions (n, 2) of points as column and row in a window, cell centres at .5."""
        cloud, matrix = self.cloud, wall_from_offset(self.slab.frame, self.cloud.origin)
        offsets = np.stack([values[points] for values in (cloud.x, cloud.y, cloud.z)])
        corner = matrix[:2, 3] - (window.left, window.top)
        return (matrix[:2, :3] @ offsets.astype(np.float64)).T + corner

    def _set(
        self,
        rows: NDArray[np.int64],
        columns: NDArray[np.int64],
        triangles: _Triangles | None,
        span_cells: float,
    ) -> NDArray[np.int64]:
        """Set the values of cells, NaN without a triangle; report which have one."""
        n_channels = 1 + (self.net.intensity is not None) + 3 * (self.net.rgb is not None)
        found = np.full((rows.size, n_channels), np.nan, dtype=np.float32)
        if triangles is not None:
            triangles.interpolate(rows, columns, span_cells, found)
        cells = rows * self.slab.frame.width + columns
        self.net.depth_m[cells] = found[:, 0]
        if self.net.intensity is not None:
            self.net.intensity[cells] = found[:, 1]
        if self.net.rgb is not None:
            self.net.rgb[cells] = np.rint(np.nan_to_num(found[:, -3:])).astype(np.uint8)
        return np.flatnonzero(np.isfinite(found).any(axis=1))


def _cells_of(window: _Window) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Yield rows and columns of the cells of a window, some rows at a time."""
    for top in range(window.top, window.bottom, _ROWS_AT_ONCE):
        rows, columns = np.mgrid[
            top : min(top + _ROWS_AT_ONCE, window.bottom), window.left : window.right
        ]
        yield rows.ravel(), columns.ravel()


@dataclass(frozen=True, kw_only=True)
class _Triangles:
    """A triangulation over a window of a raster.

    Attributes:
        window: its window.
        shape: of the raster.
        delaunay: the triangulation, in cells of the window.
        values: (n, channels) of its vertices.
        others: all points in the window, if the triangulation is of some of them; else None.
    """

    window: _Window
    shape: tuple[int, int]
    delaunay: Delaunay
    values: NDArray[np.float64]
    others: cKDTree | None

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
        aside = [columns - self.window.left, rows - self.window.top]
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
            low = -np.array([self.window.left, self.window.top], dtype=np.float64)
            high = low + self.shape[::-1]
            beside = np.clip(centre, low, high) - centre
            half = np.sqrt(np.maximum(radius[:, np.newaxis] ** 2 - beside[:, ::-1] ** 2, 0.0))
            span = np.minimum(centre + half, high) - np.maximum(centre - half, low)
            belongs: NDArray[np.bool_] = (span <= span_cells).all(axis=1)
        if self.others is not None:
            asked = np.flatnonzero(belongs)
            nearest = np.asarray(self.others.query(centre[asked])[0])
            belongs[asked] = nearest >= radius[asked] * (1.0 - 1e-9)
        return belongs


def _beside_gaps(has_point: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return cells (rows, cols) with a point next to a position far from all points.

    The vertices of every triangle with a wide circle qualify: between a vertex and the centre there
    is a position that far from all points.
    """
    import cv2

    wide = np.pad(has_point, _RIM_CELLS)
    away = cv2.distanceTransform((~wide).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    is_near = (np.asarray(away) <= _EMPTY_CELLS).astype(np.uint8)
    beside = np.asarray(cv2.distanceTransform(is_near, cv2.DIST_L2, cv2.DIST_MASK_PRECISE))
    inner = slice(_RIM_CELLS, -_RIM_CELLS)
    return has_point & (beside[inner, inner] <= _RIM_CELLS)
