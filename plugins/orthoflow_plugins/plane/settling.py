"""Planes found on part of a cloud, fitted to more of it: one pass for all planes, one for labels.

All points take part in the fits, or of more than 24 million every so many'th block of neighbours,
drawn over the whole cloud: neighbours share their errors, so that those left out say the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.plane_set_kernels import assign_points, name_labels
from orthoflow.geometry.point_kernels import BLOCK_POINTS, each_part, piece_of
from orthoflow.geometry.threads import in_threads
from orthoflow_plugins.plane.candidates import FoundPlane, Rules
from orthoflow_plugins.plane.examining import Look, carried, judged
from orthoflow_plugins.plane.footprints import INNER_SHARE, CellSums, SurfaceRaster, cell_for
from orthoflow_plugins.plane.remainders import Remainder

_PASSES_MOST: Final = 3
# A fit that moved by more than this share of the fit tolerance saw its points askew.
_SETTLED_SHARE: Final = 0.1
# Points that fix every plane better than its surface is plane; of larger clouds a part is fitted.
_FITTED_MOST: Final = 12_000_000


@dataclass(frozen=True, kw_only=True)
class _Tables:
    """Flat tables over the cells of several rasters."""

    rasters: NDArray[np.float64]
    counts: NDArray[np.int32]
    sums: NDArray[np.int64]


def settle(found: list[FoundPlane], whole: Remainder, rules: Rules) -> list[FoundPlane]:
    """Fit planes to all points; those that the points do not bear out are left out.

    Args:
        found: planes of a sample or of a thinned cloud.
        whole: the cloud; its claims serve as scratch.
        rules: when a plane counts.
    """
    every = max(1, len(whole.claims) // _FITTED_MOST)
    unsettled = [True] * len(found)
    for _ in range(_PASSES_MOST):
        rasters = [_raster(item, whole, rules.find_m, every) for item in found]
        measured = _measured(found, rasters, unsettled, whole, rules, every)
        n_least = rules.least_share * len(whole.claims) / every
        looks = _judged(found, rasters, measured, unsettled, whole, rules, n_least)
        kept: list[FoundPlane] = []
        moves: list[bool] = []
        for item, raster, look, is_new in zip(found, rasters, looks, unsettled, strict=True):
            if not is_new:
                kept.append(item)
                moves.append(False)
            elif look is not None:
                kept.append(_settled(item, raster, look, whole))
                moves.append(look.adjusted.moved_m > _SETTLED_SHARE * rules.fit_m)
        found, unsettled = kept, moves
        if not any(unsettled):
            break
    return found


def _judged(
    found: list[FoundPlane],
    rasters: list[SurfaceRaster],
    measured: list[CellSums],
    wanted: list[bool],
    whole: Remainder,
    rules: Rules,
    n_least: float,
) -> list[Look | None]:
    """What the sums say of each plane that is wanted, several planes at a time."""
    looks: list[Look | None] = [None] * len(found)

    def judge(first: int) -> None:
        for index in range(first, len(found), whole.parts):
            if wanted[index]:
                freedom = found[index].freedom
                looks[index] = judged(
                    rasters[index], measured[index], rules, freedom, n_least=n_least
                )

    in_threads([partial(judge, first) for first in range(whole.parts)])
    return looks


def label(found: list[FoundPlane], whole: Remainder, find_m: float) -> None:
    """Claim all points for the nearest plane in whose rectangle they lie."""
    nothing = _Tables(
        rasters=np.ones((len(found), 8)),
        counts=np.zeros((0, 3), dtype=np.int32),
        sums=np.zeros((0, 2), dtype=np.int64),
    )
    _assign(found, whole, find_m, [nothing] * whole.parts, 1)


def name_points(whole: Remainder, names: NDArray[np.int16], labels: NDArray[np.int16]) -> None:
    """Write the label (n,) of each point; the last of (k + 1,) names is for points on no plane."""
    by_byte = np.full(256, names[-1], dtype=np.int16)
    by_byte[: len(names) - 1] = names[:-1]
    claims = whole.claims.view(np.uint8)

    def write(_part: int, piece: slice) -> None:
        name_labels(claims[piece], by_byte, labels[piece])

    each_part(len(labels), whole.parts, write)


def _raster(item: FoundPlane, whole: Remainder, find_m: float, every: int) -> SurfaceRaster:
    """Cells over the plane's rectangle alone, as fine as the points that are summed allow."""
    cells = item.footprint.cells
    area_m2 = float(cells.sum()) * item.raster.cell_m**2
    share = len(whole.claims) / max(1, len(whole.sample.index)) / every
    cell_m = min(item.raster.cell_m, cell_for(item.footprint.n_points * share, area_m2))
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
    whole: Remainder,
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
    tables = [
        _Tables(
            rasters=rows,
            counts=np.zeros((int(starts[-1]), 3), dtype=np.int32),
            sums=np.zeros((int(starts[-1]), 2), dtype=np.int64),
        )
        for _ in range(whole.parts)
    ]
    _assign(found, whole, rules.find_m, tables, every)
    counts = np.stack([table.counts for table in tables]).sum(axis=0, dtype=np.int64)
    sums = np.stack([table.sums for table in tables]).sum(axis=0)
    measured = []
    for shape, start, size in zip(shapes, starts, sizes, strict=False):
        n_points = counts[start : start + size].reshape(*shape, 3)
        steps = sums[start : start + size].reshape(*shape, 2)
        measured.append(
            CellSums(
                n_find=n_points[..., 0],
                n_inner=n_points[..., 1],
                n_fit=n_points[..., 2],
                steps=steps[..., 0],
                squared_steps=steps[..., 1],
            )
        )
    return measured


def _assign(
    found: list[FoundPlane],
    whole: Remainder,
    find_m: float,
    tables: list[_Tables],
    every: int,
) -> None:
    slabs = np.array([item.raster.slab() for item in found]).reshape(-1, 12)
    bounds = np.array([item.label_bounds(find_m) for item in found]).reshape(-1, 5)

    def give(part: int, piece: slice) -> None:
        table = tables[part]
        assign_points(
            piece_of(whole.points, piece),
            whole.claims[piece],
            slabs,
            bounds,
            table.rasters,
            table.counts,
            table.sums,
            (every, piece.start // BLOCK_POINTS),
        )

    each_part(len(whole.claims), whole.parts, give)


def _settled(item: FoundPlane, raster: SurfaceRaster, look: Look, whole: Remainder) -> FoundPlane:
    return replace(
        item,
        raster=carried(raster, look.adjusted.plane, whole.up),
        footprint=look.footprint,
        adjusted=look.adjusted,
    )
