"""Colours of cells from the points of their topmost surface.

skarlatos2012 uses the topmost point, and proposes as future work to weight points by their distance
from the cell centre. The other rules are variants of these two.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.levels import light_of_levels
from orthoflow.geometry.rastering import (
    NO_POINT,
    Entries,
    empty_winners,
    entries_inside,
    keep_nearest,
    places_of_winners,
    share_cells,
    topmost_points,
    values_of_winners,
)
from orthoflow.geometry.robust import least_absolute
from orthoflow.geometry.slabs import Slab
from orthoflow.geometry.unrolling import unrolled
from orthoflow.products import PointCloud, SurfaceMask
from orthoflow_plugins.ortho.parameters import LAYER_M, DirectParams

# Standard deviation, in cells, of the Gaussian weight; it gives a point in the corner of a cell a
# weight of 1/7.
_SIGMA_CELLS: Final = 0.36
_NO_COLOUR: Final = 999
# Maximum number of points in a cell from which the median is computed.
_TOP_MOST: Final = 5
# Maximum number of points sorted at once for the median.
POINTS_AT_ONCE: Final = 1 << 24
# Side of the squares in which the colours of scans are compared.
_PLACE_M: Final = 0.05
# Minimum number of points that each scan must have in a square.
_POINTS_LEAST: Final = 4
# Levels below _DARKEST are almost black, and levels above _BRIGHTEST are clipped.
_DARKEST: Final = 10
_BRIGHTEST: Final = 245
# Scans that share fewer squares than this with other scans are ignored.
_PLACES_LEAST: Final = 20
# Maximum share of clipped or almost black points in a square.
_USELESS_MOST: Final = 0.05


@dataclass(frozen=True, kw_only=True)
class Painters:
    """The points that give cells their colours.

    Attributes:
        cloud: all points.
        values: (n, 3) uint8 colours, or (n, 1) grey levels.
        is_left_out: (n,) points without a colour; None if all points have one.
    """

    cloud: PointCloud
    values: NDArray[np.uint8]
    is_left_out: NDArray[np.bool_] | None = None


@dataclass(frozen=True, kw_only=True)
class CellColours:
    """The colours of the cells of a wall, as flat arrays.

    The point of a cell is the one that gives the cell its colour, or the topmost point if the
    colour is an average or a median of several points.

    Attributes:
        rgb: (cells, 3) uint8, 0 where void.
        has_point: (cells,) whether the cell contains a point.
        distance_cells: (cells,) distance between the point and the cell centre, infinite where
            void.
        places: (cells, 2) float32 offset of the point from the cell centre, to the right and down,
            in cells; 0 if the colours of several points are averaged, NaN where void.
        depth_m: (cells,) float32 depth of the point, NaN where void.
    """

    rgb: NDArray[np.uint8]
    has_point: NDArray[np.bool_]
    distance_cells: NDArray[np.float32]
    places: NDArray[np.float32]
    depth_m: NDArray[np.float32]


def on_plane(
    painters: Painters, slab: Slab, mask: NDArray[np.uint8] | None = None
) -> tuple[Painters, Slab]:
    """Unroll the points of a curved wall and its slab; a plane remains as it is.

    Args:
        painters: the points.
        slab: the frame and the depth range of the wall.
        mask: (rows, columns) `SurfaceMask` of the wall; points in its void cells, such as those
            beyond the groins of a vault, are left out.
    """
    if slab.frame.bend is None:
        return painters, slab
    near, flat = unrolled(painters.cloud, slab), slab.frame.flat
    cloud = replace(
        painters.cloud.selected(near.index), origin=near.origin, x=near.x, y=near.y, z=near.z
    )
    left_out = None if painters.is_left_out is None else painters.is_left_out[near.index]
    if mask is not None:
        offsets = np.column_stack([near.x, near.y, near.z]).astype(np.float64)
        column, row = (
            np.clip((offsets @ axis / flat.gsd_m).astype(np.intp), 0, length - 1)
            for axis, length in ((flat.u_world, flat.width), (flat.v_world, flat.height))
        )
        is_void = mask[row, column] == SurfaceMask.VOID
        left_out = is_void if left_out is None else left_out | is_void
    own = Painters(cloud=cloud, values=painters.values[near.index], is_left_out=left_out)
    return own, replace(slab, frame=flat)


def colours_of(
    painters: Painters, slab: Slab, params: DirectParams, *, threads: int
) -> CellColours:
    """Colour the cells of a wall.

    Args:
        painters: the points.
        slab: the frame and the depth range of the wall.
        params: the rule for colours.
        threads: number of threads.
    """
    cloud, colouring = painters.cloud, params.colouring
    winners = topmost_points(cloud, slab, threads=threads, is_left_out=painters.is_left_out)
    has_point = winners["point"] != NO_POINT
    floors_m = winners["depth_m"] - np.float32(LAYER_M)
    rgb = np.zeros((slab.n_cells, 3), dtype=np.uint8)
    if colouring == "centre":
        winners = empty_winners(slab.n_cells)
        for top in _on_top(painters, slab, floors_m, threads=threads):
            share_cells(threads, partial(keep_nearest, top, winners))
    if colouring == "gaussian":
        totals = np.zeros((slab.n_cells, painters.values.shape[1] + 1))
        for top in _on_top(painters, slab, floors_m, threads=threads):
            weights = np.exp(top.squares.astype(np.float64) / (-2.0 * _SIGMA_CELLS**2))
            np.add.at(totals[:, -1], top.cells, weights)
            for channel, values in enumerate(painters.values.T):
                np.add.at(totals[:, channel], top.cells, weights * values[top.points])
        means = totals[:, :-1] / np.maximum(totals[:, -1:], 1e-300)
        rgb[has_point] = np.rint(means[has_point])
    elif colouring == "median":
        # Limit the number of points processed at once, but process at least one cell.
        totals, first, n_before = np.cumsum(winners["n_points"], dtype=np.int64), 0, 0
        while first < totals.size:
            end = int(np.searchsorted(totals, n_before + POINTS_AT_ONCE, side="right"))
            cells = slice(first, max(first + 1, end))
            tops = list(_on_top(painters, slab, floors_m, threads=threads, cells=cells))
            _set_medians(rgb, tops, painters.values)
            first, n_before = cells.stop, int(totals[cells.stop - 1])
    else:
        rgb[:] = values_of_winners(winners, painters.values, 0)
    places = places_of_winners(cloud, slab, winners)
    if colouring in {"gaussian", "median"}:
        places[has_point] = 0.0
    return CellColours(
        rgb=rgb,
        has_point=has_point,
        distance_cells=np.sqrt(winners["square"]),
        places=places,
        depth_m=np.where(has_point, winners["depth_m"], np.float32(np.nan)),
    )


def scan_gains(painters: Painters, slabs: Sequence[Slab], *, threads: int) -> NDArray[np.float64]:
    """Compute the channel gains that remove colour casts of scans, as logarithms (scans, 3).

    Where two scans overlap, they show the same surface, so differences between their mean colours
    are due to exposure and white balance, except at edges of texture and objects; the L1 norm is
    robust to these. The median gain of a group of overlapping scans is 1.

    Args:
        painters: coloured points with scan numbers.
        slabs: walls on which the scans overlap.
        threads: number of threads.

    Returns:
        (scans, 3) natural logarithms of the gains, 0 for scans without overlap.
    """
    scans, light = painters.cloud.scan, light_of_levels(255)
    n_scans = 0 if scans is None or not len(scans) else int(scans.max()) + 1
    if scans is None or n_scans < 2:
        return np.zeros((n_scans, 3))
    pairs, apart = [np.empty((0, 2), dtype=np.int64)], [np.empty((0, 3))]
    for own, slab in (on_plane(painters, slab) for slab in slabs):
        frame, scale = slab.frame, max(1.0, _PLACE_M / slab.frame.gsd_m)
        width, height = (math.ceil(size / scale) for size in (frame.width, frame.height))
        places = replace(frame, gsd_m=scale * frame.gsd_m, width=width, height=height)
        near = Slab(
            frame=places,
            front_m=min(slab.front_m, _PLACE_M),
            behind_m=min(slab.behind_m, _PLACE_M),
        )
        sums = np.zeros((near.n_cells * n_scans, 5))
        own_scans = scans if own is painters else np.asarray(own.cloud.scan)
        for entries in entries_inside(
            own.cloud, near, threads=threads, is_left_out=own.is_left_out
        ):
            values = own.values[entries.points]
            is_useless = (values.min(axis=1) < _DARKEST) | (values.max(axis=1) > _BRIGHTEST)
            key = entries.cells.astype(np.int64) * n_scans + own_scans[entries.points]
            shades = np.column_stack([light[values], is_useless, np.ones(len(values))])
            for channel in range(5):
                sums[:, channel] += np.bincount(key, shades[:, channel], len(sums))
        # Exclude whole squares; excluding single points would remove more points from the darker
        # scan.
        is_known = (sums[:, 4] >= _POINTS_LEAST) & (sums[:, 3] <= _USELESS_MOST * sums[:, 4])
        known = np.flatnonzero(is_known)
        logs = np.log(sums[known, :3] / sums[known, 4:])
        # Entries of the same square are adjacent.
        first = np.flatnonzero(known[1:] // n_scans == known[:-1] // n_scans)
        pairs.append(np.column_stack([known[first], known[first + 1]]) % n_scans)
        apart.append(logs[first + 1] - logs[first])
    scan_pairs, differences = np.concatenate(pairs), np.concatenate(apart)
    # Ignore scans that have few squares in common with others.
    counts = np.bincount(scan_pairs.ravel(), minlength=n_scans)
    is_kept = (counts[scan_pairs] >= _PLACES_LEAST).all(axis=1)
    scan_pairs, differences = scan_pairs[is_kept], differences[is_kept]
    design, rows = np.zeros((len(scan_pairs), n_scans)), np.arange(len(scan_pairs))
    design[rows, scan_pairs[:, 0]], design[rows, scan_pairs[:, 1]] = 1.0, -1.0
    overlap = np.unique(scan_pairs)
    gains = np.zeros((n_scans, 3))
    for channel in range(3) if len(overlap) else ():
        found = least_absolute(design, differences[:, channel], np.full(n_scans, 1e-3))
        gains[overlap, channel] = found[overlap] - np.median(found[overlap])
    return gains


def _on_top(
    painters: Painters,
    slab: Slab,
    floors_m: NDArray[np.float32],
    *,
    threads: int,
    cells: slice | None = None,
) -> Iterator[Entries]:
    """Yield the points of the topmost surface in the given cells, or in all if none are given."""
    cells, width = cells or slice(0, slab.n_cells), slab.frame.width
    rows = slice(cells.start // width, -(-cells.stop // width))
    is_left_out = painters.is_left_out
    for entries in entries_inside(
        painters.cloud, slab, threads=threads, rows=rows, is_left_out=is_left_out
    ):
        is_on_top = entries.depths_m >= floors_m[entries.cells]
        is_on_top &= (entries.cells >= cells.start) & (entries.cells < cells.stop)
        yield Entries(
            entries.cells[is_on_top],
            entries.depths_m[is_on_top],
            entries.squares[is_on_top],
            entries.points[is_on_top],
        )


def _set_medians(rgb: NDArray[np.uint8], tops: list[Entries], values: NDArray[np.uint8]) -> None:
    """Set the colours of cells to the median of their topmost points in each channel."""
    if not tops:
        return
    cells, depths_m, _, points = (np.concatenate(parts) for parts in zip(*tops, strict=True))
    order = np.lexsort((points, -depths_m, cells))
    cells, points = cells[order], points[order]
    first = np.flatnonzero(np.append(True, cells[1:] != cells[:-1]))
    sizes = np.minimum(np.diff(np.append(first, cells.size)), _TOP_MOST)
    shades = np.full((first.size, _TOP_MOST, values.shape[1]), _NO_COLOUR, dtype=np.int16)
    for rank in range(_TOP_MOST):
        has_rank = sizes > rank
        shades[has_rank, rank] = values[points[first[has_rank] + rank]]
    shades.sort(axis=1)
    rows = np.arange(first.size)
    twice = shades[rows, (sizes - 1) // 2] + shades[rows, sizes // 2]
    rgb[cells[first]] = (twice + 1) // 2
