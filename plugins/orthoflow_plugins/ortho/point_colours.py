"""The colour of a cell from the points on its topmost surface.

skarlatos2012 takes the topmost point and proposes as future work to weight points by their distance
from the centre of the cell; the other rules are that proposal, and two averages.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.slabs import Slab
from orthoflow.products import PointCloud

if TYPE_CHECKING:
    from orthoflow.geometry.raster_kernels import Entries

Colouring = Literal["topmost", "centre", "gaussian", "median"]

# Sigma of the Gaussian in cells: a point in the corner of its cell has a weight of a seventh.
_SIGMA_CELLS: Final = 0.36
_NO_COLOUR: Final = 999
# Number of points that the median sorts at once.
_POINTS_AT_ONCE: Final = 1 << 24


@dataclass(frozen=True, kw_only=True)
class ColourRule:
    """How a cell is coloured by its points.

    Attributes:
        colouring: `topmost` point; the one nearest the `centre` on the topmost surface; `gaussian`
            weighted mean of that surface; `median` of its highest points.
        layer_m: points at most this far below the topmost one are on its surface.
        n_top: maximum number of points for the median.
        threads: number of threads.
    """

    colouring: Colouring
    layer_m: float
    n_top: int
    threads: int


@dataclass(frozen=True, kw_only=True)
class Painters:
    """The points that paint.

    Attributes:
        cloud: all points.
        values: (n, 3) uint8 their colours, or (n, 1) their greys.
        is_left_out: (n,) points without a colour; None if all have one.
    """

    cloud: PointCloud
    values: NDArray[np.uint8]
    is_left_out: NDArray[np.bool_] | None = None

    def entries(self, slab: Slab, *, threads: int, rows: slice | None = None) -> Iterator[Entries]:
        """Yield the points inside a slab, chunk by chunk (`entries_inside`)."""
        from orthoflow.geometry.rastering import entries_inside

        return entries_inside(
            self.cloud, slab, threads=threads, rows=rows, is_left_out=self.is_left_out
        )


@dataclass(frozen=True, kw_only=True)
class CellColours:
    """Colours of the cells of a wall, flat.

    Attributes:
        rgb: (cells, 3) uint8, 0 where void.
        has_point: (cells,).
        distance_cells: (cells,) distance from the centre of the point that represents the cell: the
            coloured one, or the topmost one of those averaged; infinite where void.
        places: (cells, 2) float32, position of the coloured point right of and below the centre, in
            cells, 0 if several are averaged; NaN where void.
        depth_m: (cells,) float32, of the point that represents the cell; NaN where void.
    """

    rgb: NDArray[np.uint8]
    has_point: NDArray[np.bool_]
    distance_cells: NDArray[np.float32]
    places: NDArray[np.float32]
    depth_m: NDArray[np.float32]


def colours_of(painters: Painters, slab: Slab, rule: ColourRule) -> CellColours:
    """Colour the cells of a wall.

    Args:
        painters: the points.
        slab: the wall, and the depths of its points.
        rule: how.
    """
    from orthoflow.geometry.raster_kernels import NO_POINT
    from orthoflow.geometry.rastering import (
        places_of_winners,
        topmost_points,
        values_of_winners,
    )

    cloud = painters.cloud
    winners = topmost_points(cloud, slab, threads=rule.threads, is_left_out=painters.is_left_out)
    has_point = winners["point"] != NO_POINT
    floors_m = winners["depth_m"] - np.float32(rule.layer_m)
    if rule.colouring == "centre":
        winners = _most_central(painters, slab, floors_m, threads=rule.threads)
    rgb = np.zeros((slab.n_cells, 3), dtype=np.uint8)
    if rule.colouring == "gaussian":
        rgb[has_point] = _weighted_means(painters, slab, floors_m, rule)[has_point]
    elif rule.colouring == "median":
        for cells in _in_parts(winners["n_points"]):
            _set_medians(rgb, cells, painters, slab, floors_m, rule)
    else:
        rgb[:] = values_of_winners(winners, painters.values, 0, threads=rule.threads)
    places = places_of_winners(cloud, slab, winners, threads=rule.threads)
    if rule.colouring in {"gaussian", "median"}:
        places[has_point] = 0.0
    return CellColours(
        rgb=rgb,
        has_point=has_point,
        distance_cells=np.sqrt(winners["square"]),
        places=places,
        depth_m=np.where(has_point, winners["depth_m"], np.float32(np.nan)),
    )


def _most_central(
    painters: Painters, slab: Slab, floors_m: NDArray[np.float32], *, threads: int
) -> NDArray[np.void]:
    """Return the points on the topmost surface that are nearest to the centres of their cells."""
    from orthoflow.geometry.raster_kernels import keep_nearest
    from orthoflow.geometry.rastering import empty_winners, share_cells

    winners = empty_winners(slab.n_cells, threads=threads)
    for entries in painters.entries(slab, threads=threads):
        slots = _slots(entries)
        is_below = entries.depths_m[slots] < floors_m[entries.cells[slots]]
        entries.squares[slots[is_below]] = np.inf
        share_cells(threads, partial(keep_nearest, entries, winners))
    return winners


@dataclass(frozen=True)
class _TopPoints:
    """Points of one chunk on the topmost surface of their cells, all (n,)."""

    cells: NDArray[np.int32]
    depths_m: NDArray[np.float32]
    squares: NDArray[np.float32]
    points: NDArray[np.uint32]


def _on_top(
    painters: Painters,
    slab: Slab,
    floors_m: NDArray[np.float32],
    *,
    threads: int,
    wanted: slice | None = None,
) -> Iterator[_TopPoints]:
    """Yield the points on the topmost surface, of all cells or of the requested ones."""
    width = slab.frame.width
    wanted = wanted or slice(0, slab.n_cells)
    rows = slice(wanted.start // width, -(-wanted.stop // width))
    for entries in painters.entries(slab, threads=threads, rows=rows):
        slots = _slots(entries)
        cells = entries.cells[slots]
        is_wanted = (cells >= wanted.start) & (cells < wanted.stop)
        slots = slots[is_wanted & (entries.depths_m[slots] >= floors_m[cells])]
        yield _TopPoints(
            entries.cells[slots],
            entries.depths_m[slots],
            entries.squares[slots],
            entries.points[slots],
        )


def _slots(entries: Entries) -> NDArray[np.int64]:
    """Return slots of a chunk that hold a point."""
    from orthoflow.geometry.raster_kernels import BLOCK

    is_used = np.arange(BLOCK) < entries.n_inside[:, np.newaxis]
    return np.flatnonzero(is_used)


def _weighted_means(
    painters: Painters,
    slab: Slab,
    floors_m: NDArray[np.float32],
    rule: ColourRule,
) -> NDArray[np.uint8]:
    values = painters.values
    totals = np.zeros((slab.n_cells, values.shape[1] + 1))
    for top in _on_top(painters, slab, floors_m, threads=rule.threads):
        weights = np.exp(top.squares.astype(np.float64) / (-2.0 * _SIGMA_CELLS**2))
        np.add.at(totals[:, -1], top.cells, weights)
        for channel in range(values.shape[1]):
            shades = weights * values[top.points, channel]
            np.add.at(totals[:, channel], top.cells, shades)
    means = totals[:, :-1] / np.maximum(totals[:, -1:], 1e-300)
    return np.asarray(np.rint(means), dtype=np.uint8)


def _in_parts(n_points: NDArray[np.uint32]) -> Iterator[slice]:
    """Cut cells into parts with a limited number of points each, or one cell."""
    totals = np.cumsum(n_points, dtype=np.int64)
    first = n_before = 0
    while first < n_points.size:
        end = int(np.searchsorted(totals, n_before + _POINTS_AT_ONCE, side="right"))
        end = max(first + 1, end)
        yield slice(first, end)
        first, n_before = end, int(totals[end - 1])


def _set_medians(
    rgb: NDArray[np.uint8],
    wanted: slice,
    painters: Painters,
    slab: Slab,
    floors_m: NDArray[np.float32],
    rule: ColourRule,
) -> None:
    """Set `rgb` of cells to the median colour, channel by channel, of their highest points."""
    chunks = list(_on_top(painters, slab, floors_m, threads=rule.threads, wanted=wanted))
    if not chunks:
        return
    cells = np.concatenate([chunk.cells for chunk in chunks])
    depths_m = np.concatenate([chunk.depths_m for chunk in chunks])
    points = np.concatenate([chunk.points for chunk in chunks])
    order = np.lexsort((points, -depths_m, cells))
    cells, points = cells[order], points[order]
    values = painters.values
    is_first = np.append(True, cells[1:] != cells[:-1])
    first = np.flatnonzero(is_first)
    sizes = np.minimum(np.diff(np.append(first, cells.size)), rule.n_top)
    shades = np.full((first.size, rule.n_top, values.shape[1]), _NO_COLOUR, dtype=np.int16)
    for rank in range(rule.n_top):
        has_rank = sizes > rank
        shades[has_rank, rank] = values[points[first[has_rank] + rank]]
    shades.sort(axis=1)
    rows = np.arange(first.size)
    twice = shades[rows, (sizes - 1) // 2] + shades[rows, sizes // 2]
    rgb[cells[first]] = (twice + 1) // 2
