"""Planes found in the sample, fitted to all points: one pass for all planes, one for labels.

All points take part in the fits, or of more than 24 million every so many'th block of neighbours,
drawn over the whole cloud: neighbours share their errors, so that those left out say the same.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.threads import in_threads
from orthoflow_plugins.plane.candidates import (
    PASSES_MOST,
    SETTLED_SHARE,
    FoundPlane,
    Rules,
    Verification,
    carried,
    verification,
)
from orthoflow_plugins.plane.kernels import BLOCK_POINTS, each_part, piece_of
from orthoflow_plugins.plane.sample import PreparedCloud
from orthoflow_plugins.plane.slab_kernels import assign_points, name_labels, sum_assigned
from orthoflow_plugins.plane.support import INNER_SHARE, CellSums, SurfaceRaster, cell_for

# Points that fix every plane better than its surface is plane; of larger clouds a part is fitted.
_FITTED_MOST: Final = 12_000_000
# A plane whose cells cover less of its rectangle is a frame or scattered parts.
_FILLED_SHARE: Final = 0.5
# Rectangles that one plane is cut into at most: a frame has four sides.
_RECTANGLES_MOST: Final = 8
# Cells along a side that cuts are looked for between.
_CUT_CELLS: Final = 64
# Claims are bytes.
_SLABS_MOST: Final = 127


def fit_to_all(found: list[FoundPlane], cloud: PreparedCloud, rules: Rules) -> list[FoundPlane]:
    """Fit planes to all points; those that the points do not bear out are left out.

    Args:
        found: planes of the sample.
        cloud: the cloud.
        rules: when a plane counts.
    """
    every = max(1, len(cloud.claims) // _FITTED_MOST)
    unsettled = [True] * len(found)
    for _ in range(PASSES_MOST):
        rasters = [_raster(item, cloud, rules.find_m, every) for item in found]
        measured = _measured(found, rasters, unsettled, cloud, rules, every)
        n_least = rules.least_share * len(cloud.claims) / every
        verdicts = _verified(found, rasters, measured, unsettled, cloud, rules, n_least)
        kept: list[FoundPlane] = []
        moves: list[bool] = []
        for item, raster, verdict, is_new in zip(found, rasters, verdicts, unsettled, strict=True):
            if not is_new:
                kept.append(item)
                moves.append(False)
            elif verdict is not None:
                kept.append(
                    replace(
                        item,
                        raster=carried(raster, verdict.adjusted.plane, cloud.up),
                        support=verdict.support,
                        adjusted=verdict.adjusted,
                    )
                )
                moves.append(verdict.adjusted.moved_m > SETTLED_SHARE * rules.fit_m)
        found, unsettled = kept, moves
        if not any(unsettled):
            break
    return found


def _verified(
    found: list[FoundPlane],
    rasters: list[SurfaceRaster],
    measured: list[CellSums],
    wanted: list[bool],
    cloud: PreparedCloud,
    rules: Rules,
    n_least: float,
) -> list[Verification | None]:
    """What the sums say of each plane that is wanted, several planes at a time."""
    verdicts: list[Verification | None] = [None] * len(found)

    def verify(first: int) -> None:
        for index in range(first, len(found), cloud.parts):
            if wanted[index]:
                freedom = found[index].freedom
                verdicts[index] = verification(
                    rasters[index], measured[index], rules, freedom, n_least=n_least
                )

    in_threads([partial(verify, first) for first in range(cloud.parts)])
    return verdicts


def label(found: list[FoundPlane], cloud: PreparedCloud, find_m: float) -> None:
    """Claim all points for the nearest plane in whose rectangles they lie."""
    slabs, bounds, plane_of_slab = _slabs(found, find_m)
    # The last entry is for a claim of -1.
    names = np.append(plane_of_slab, -1).astype(np.int8)

    def give(_part: int, piece: slice) -> None:
        claims = cloud.claims[piece]
        assign_points(piece_of(cloud.points, piece), claims, slabs, bounds)
        if len(slabs) > len(found):
            claims[:] = names[claims]

    each_part(len(cloud.claims), cloud.parts, give)


def name_points(cloud: PreparedCloud, names: NDArray[np.int16], labels: NDArray[np.int16]) -> None:
    """Write the label (n,) of each point; the last of (k + 1,) names is for points on no plane."""
    by_byte = np.full(256, names[-1], dtype=np.int16)
    by_byte[: len(names) - 1] = names[:-1]
    claims = cloud.claims.view(np.uint8)

    def write(_part: int, piece: slice) -> None:
        name_labels(claims[piece], by_byte, labels[piece])

    each_part(len(labels), cloud.parts, write)


def _raster(item: FoundPlane, cloud: PreparedCloud, find_m: float, every: int) -> SurfaceRaster:
    """Cells over the plane's rectangle alone, as fine as the points that are summed allow."""
    cells = item.support.cells
    area_m2 = float(cells.sum()) * item.raster.cell_m**2
    share = len(cloud.claims) / max(1, len(cloud.sample.index)) / every
    cell_m = min(item.raster.cell_m, cell_for(item.support.n_points * share, area_m2))
    left, right, top, bottom = item.label_bounds(find_m)[1:]
    return SurfaceRaster(
        plane=item.raster.plane,
        axes=item.raster.axes,
        low_m=np.array([left, top]),
        cell_m=cell_m,
        shape=(
            max(1, math.ceil((bottom - top) / cell_m)),
            max(1, math.ceil((right - left) / cell_m)),
        ),
    )


def _measured(
    found: list[FoundPlane],
    rasters: list[SurfaceRaster],
    wanted: list[bool],
    cloud: PreparedCloud,
    rules: Rules,
    every: int,
) -> list[CellSums]:
    """The sums of the cells of each plane that is wanted; others give no cells."""
    shapes = [
        r.shape if is_wanted else (0, 0) for r, is_wanted in zip(rasters, wanted, strict=True)
    ]
    sizes = [rows * columns for rows, columns in shapes]
    starts = np.concatenate([[0], np.cumsum(sizes)])
    rows = np.array(
        [
            (*r.low_m, 1.0 / r.cell_m, *shape, start, rules.fit_m, INNER_SHARE * rules.find_m)
            for r, shape, start in zip(rasters, shapes, starts, strict=False)
        ]
    ).reshape(-1, 8)
    # Flat tables over the cells of all rasters, of each part its own.
    counts = np.zeros((cloud.parts, int(starts[-1]), 3), dtype=np.int32)
    sums = np.zeros((cloud.parts, int(starts[-1]), 2), dtype=np.int64)
    slabs, bounds, plane_of_slab = _slabs(found, rules.find_m)
    rows = rows[plane_of_slab]

    def add(part: int, piece: slice) -> None:
        points, drawn = piece_of(cloud.points, piece), (every, piece.start // BLOCK_POINTS)
        sum_assigned(points, slabs, bounds, rows, counts[part], sums[part], drawn)

    each_part(len(cloud.claims), cloud.parts, add)
    all_counts, all_sums = counts.sum(axis=0, dtype=np.int64), sums.sum(axis=0)
    measured = []
    for shape, start, size in zip(shapes, starts, sizes, strict=False):
        cells = slice(start, start + size)
        measured.append(
            CellSums.of(all_counts[cells].reshape(*shape, 3), all_sums[cells].reshape(*shape, 2))
        )
    return measured


def _slabs(
    found: list[FoundPlane], find_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Return slabs (k, 12), their bounds (k, 5), and (k,) the plane that each slab is of.

    A plane has one slab over its rectangle. Where its cells cover little of that, it has several
    that do: a frame must not compete for the points of the wall that it surrounds.
    """
    slabs: list[NDArray[np.float64]] = []
    bounds: list[NDArray[np.float64]] = []
    planes: list[int] = []
    n_spare = _SLABS_MOST - len(found)
    for index, item in enumerate(found):
        cells, every = _coarser(item.support.cells)
        rectangles = _rectangles(cells, min(_RECTANGLES_MOST, n_spare + 1))
        n_spare -= len(rectangles) - 1
        if len(rectangles) == 1:
            own = item.label_bounds(find_m)[None]
        else:
            low_m = item.raster.low_m[[1, 1, 0, 0]]
            rows_columns_m = low_m + every * item.raster.cell_m * np.array(rectangles)
            grown = rows_columns_m[:, [2, 3, 0, 1]] + find_m * np.array([-1.0, 1.0, -1.0, 1.0])
            own = np.column_stack([np.full(len(grown), find_m), grown])
        slabs.extend([item.raster.slab()] * len(own))
        bounds.extend(own)
        planes.extend([index] * len(own))
    return (
        np.array(slabs).reshape(-1, 12),
        np.array(bounds).reshape(-1, 5),
        np.array(planes, dtype=np.int64),
    )


def _coarser(cells: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], int]:
    """Join cells (rows, columns) until `_CUT_CELLS` are left along a side; and how many are one."""
    every = max(1, math.ceil(max(cells.shape) / _CUT_CELLS))
    rows, columns = (math.ceil(side / every) for side in cells.shape)
    padded = np.zeros((rows * every, columns * every), dtype=bool)
    padded[: cells.shape[0], : cells.shape[1]] = cells
    joined = padded.reshape(rows, every, columns, every).any(axis=(1, 3))
    return np.asarray(joined, dtype=np.bool_), every


def _rectangles(cells: NDArray[np.bool_], n_most: int) -> list[tuple[int, int, int, int]]:
    """Cover cells (rows, columns) by first row, end row, first column, end column of rectangles.

    One rectangle where it is covered well; else the cut that leaves the smallest area is made
    again and again, until `_FILLED_SHARE` is reached.
    """
    rectangles = [_tight(cells, (0, cells.shape[0], 0, cells.shape[1]))]
    n_cells = np.count_nonzero(cells)
    while len(rectangles) < n_most and n_cells < _FILLED_SHARE * sum(map(_area, rectangles)):
        cuts = [_best_cut(cells, rectangle) for rectangle in rectangles]
        saved = [
            _area(rectangle) - sum(map(_area, cut))
            for rectangle, cut in zip(rectangles, cuts, strict=True)
        ]
        best = int(np.argmax(saved))
        if saved[best] <= 0:
            break
        rectangles[best : best + 1] = cuts[best]
    return rectangles


def _best_cut(
    cells: NDArray[np.bool_], rectangle: tuple[int, int, int, int]
) -> list[tuple[int, int, int, int]]:
    """Cut a rectangle in two that cover its cells with the smallest area; itself if none does."""
    top, bottom, left, right = rectangle
    best = [rectangle]
    for row in range(top + 1, bottom):
        halves = [_tight(cells, (top, row, left, right)), _tight(cells, (row, bottom, left, right))]
        best = min(best, halves, key=lambda cut: sum(map(_area, cut)))
    for column in range(left + 1, right):
        halves = [
            _tight(cells, (top, bottom, left, column)),
            _tight(cells, (top, bottom, column, right)),
        ]
        best = min(best, halves, key=lambda cut: sum(map(_area, cut)))
    return best


def _tight(
    cells: NDArray[np.bool_], rectangle: tuple[int, int, int, int]
) -> tuple[int, int, int, int]:
    """Shrink a rectangle to the cells in it; without any it has no area."""
    top, bottom, left, right = rectangle
    within = cells[top:bottom, left:right]
    rows, columns = np.flatnonzero(within.any(axis=1)), np.flatnonzero(within.any(axis=0))
    if not len(rows):
        return (top, top, left, left)
    return (
        top + int(rows[0]),
        top + int(rows[-1]) + 1,
        left + int(columns[0]),
        left + int(columns[-1]) + 1,
    )


def _area(rectangle: tuple[int, int, int, int]) -> int:
    top, bottom, left, right = rectangle
    return (bottom - top) * (right - left)
