"""Walls too large to be rastered at once: band by band of rows, into arrays in files."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.row_bands import Allocate
from orthoflow.geometry.slabs import Slab
from orthoflow_plugins.raster.surfaces import CellSurface


@dataclass(frozen=True, kw_only=True)
class Raster:
    """The surface over a slab, and where it comes from.

    Attributes:
        surface: flat over the cells.
        mask: (cells,) uint8 `SurfaceMask`.
    """

    surface: CellSurface
    mask: NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True)
class Band:
    """Some rows of a wall, and so many more about them as decide what becomes of them.

    Attributes:
        slab: of all these rows.
        rows: of the wall, that the band is for.
        skipped: rows of the slab before them.
    """

    slab: Slab
    rows: slice
    skipped: int


def bands(slab: Slab, *, cells_most: int, reach_rows: int) -> Iterator[Band]:
    """Cut a wall into bands of equal height with at most so many cells, a reach included."""
    frame = slab.frame
    height = max(1, cells_most // frame.width - 2 * reach_rows)
    height = -(-frame.height // -(-frame.height // height))
    for first in range(0, frame.height, height):
        end = min(frame.height, first + height)
        begin, finish = max(0, first - reach_rows), min(frame.height, end + reach_rows)
        corner = frame.origin_world + begin * frame.gsd_m * frame.v_world
        part = replace(frame, origin_world=corner, height=finish - begin)
        yield Band(slab=replace(slab, frame=part), rows=slice(first, end), skipped=first - begin)


def rastered_in_bands(
    slab: Slab,
    raster_of: Callable[[Slab], Raster],
    *,
    cells_most: int,
    reach_rows: int,
    allocate: Allocate,
) -> Raster:
    """Raster a wall band by band; memory is that of one band.

    Args:
        slab: of the wall.
        raster_of: rasters a slab.
        cells_most: a band has at most so many cells.
        reach_rows: how far away a cell may lie that changes another.
        allocate: gives the arrays of the wall.
    """
    whole: dict[str, NDArray[np.generic]] = {}
    width = slab.frame.width
    for band in bands(slab, cells_most=cells_most, reach_rows=reach_rows):
        raster = raster_of(band.slab)
        cells = slice(band.rows.start * width, band.rows.stop * width)
        inner = slice(band.skipped * width, band.skipped * width + cells.stop - cells.start)
        arrays = {"mask": raster.mask} | {
            field.name: getattr(raster.surface, field.name) for field in fields(CellSurface)
        }
        for name, values in arrays.items():
            if values is None:
                continue
            if name not in whole:
                shape = (slab.n_cells, *values.shape[1:])
                whole[name] = allocate(name, shape, values.dtype)
            whole[name][cells] = values[inner]
    mask = whole.pop("mask")
    absent = dict.fromkeys(("intensity", "rgb", "percentiles_m"))
    # The arrays have the types of the bands' own.
    surface = CellSurface(**cast("dict[str, Any]", absent | whole))
    return Raster(surface=surface, mask=mask.astype(np.uint8, copy=False))
