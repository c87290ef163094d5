"""Walls in cells that are no finer than their points lie apart, for matching.

What fills the cells between points says nothing of its own: patches of such cells tell no more than
their few points do, on less of the wall, and where most cells stay void nothing can be matched at
all. So cells are joined first; what is painted in the end keeps the cells that were asked for.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.interpolation import Surroundings, cell_values, interpolate
from orthoflow.geometry.narrow_gaps import narrow_gaps
from orthoflow.geometry.scan_steps import scan_step_m
from orthoflow.products import SurfaceMask, Wall
from orthoflow_plugins.match.channels import least_step_m

# Gaps between joined cells in which no disc of this radius fits are filled, as rasters have it.
_GAP_CELLS: Final = 2
# So many cells are joined at once: some 100 MB.
_CELLS_AT_ONCE: Final = 1 << 22


def in_cells_of_points(wall: Wall) -> Wall:
    """Join the cells of a wall until about one point lies in each.

    Points count where they lie: what a joined cell shows is carried to its centre.

    Args:
        wall: with intensity or not.

    Returns:
        The same wall where its cells are not much finer than its points lie apart; else with
        depths, spreads, counts and intensity of joined cells, without colours.
    """
    gsd_m = wall.frame.gsd_m
    factor = math.floor(scan_step_m(wall.count, gsd_m=gsd_m) / gsd_m)
    if factor < 2 or wall.intensity is None:
        return wall
    height, width = (-(-length // factor) for length in wall.frame.shape)
    frame = replace(wall.frame, gsd_m=gsd_m * factor, width=width, height=height)
    joined = replace(
        wall,
        frame=frame,
        depth_m=np.full(frame.shape, np.nan, dtype=np.float32),
        sigma_m=np.full(frame.shape, np.nan, dtype=np.float32),
        count=np.zeros(frame.shape, dtype=np.uint32),
        mask=np.zeros(frame.shape, dtype=np.uint8),
        intensity=np.full(frame.shape, np.nan, dtype=np.float32),
        rgb=None,
        rgb_mask=None,
        percentiles_m=None,
    )
    places = np.full((*frame.shape, 2), np.nan, dtype=np.float32)
    layer_m = factor * least_step_m(wall)
    n_rows = max(1, _CELLS_AT_ONCE // (wall.frame.width * factor))
    for first in range(0, height, n_rows):
        _join(wall, factor, joined, places, (slice(first, min(height, first + n_rows)), layer_m))
    _complete(joined, Surroundings(places.reshape(-1, 2), width, layer_m))
    return joined


def _join(
    wall: Wall,
    factor: int,
    joined: Wall,
    places: NDArray[np.float32],
    which: tuple[slice, float],
) -> None:
    """Fill some rows of a joined wall with what its measured cells hold, and where they lie.

    Args:
        wall: the wall.
        factor: how many of its cells lie along the side of a joined one.
        joined: filled, a row for each of these rows.
        places: (rows, cols, 2) as `Surroundings` has them, likewise.
        which: the rows, and depths that differ by more are of different surfaces.
    """
    rows, layer_m = which
    assert wall.intensity is not None  # noqa: S101 - asked before
    assert joined.intensity is not None  # noqa: S101 - it has what the wall has
    blocks = _Blocks(rows, factor, joined.frame.width)
    measured = blocks.of(wall.mask) == SurfaceMask.MEASURED
    depths_m = np.where(measured, blocks.of(wall.depth_m), np.float32(np.nan))
    n_known = np.isfinite(depths_m).sum(axis=2)
    # A depth that was measured, none between two surfaces; what is no number comes last.
    middle = np.maximum(n_known - 1, 0) // 2
    depth_m = np.take_along_axis(np.sort(depths_m, axis=2), middle[:, :, None], axis=2)
    on_surface = np.abs(depths_m - depth_m) <= layer_m
    n_summed = on_surface.sum(axis=2)

    def mean(values: NDArray[np.generic]) -> NDArray[np.float64]:
        total = np.where(on_surface, values, 0.0).sum(axis=2, dtype=np.float64)
        with np.errstate(invalid="ignore"):
            return np.asarray(total / n_summed, dtype=np.float64)

    joined.depth_m[rows] = depth_m[:, :, 0]
    joined.intensity[rows] = mean(blocks.of(wall.intensity))
    joined.count[rows] = np.where(measured, blocks.of(wall.count), 0).sum(axis=2)
    joined.mask[rows] = np.where(n_known > 0, SurfaceMask.MEASURED, SurfaceMask.VOID)
    squares = mean((depths_m - mean(depths_m)[:, :, None]) ** 2) * n_summed
    several = n_summed > 1
    joined.sigma_m[rows][several] = np.sqrt(squares[several] / (n_summed[several] - 1))
    steps = (np.arange(factor) + 0.5) / factor - 0.5
    down, across = (grid.ravel() for grid in np.meshgrid(steps, steps, indexing="ij"))
    places[rows, :, 0], places[rows, :, 1] = mean(across), mean(down)


class _Blocks:
    """Rows of joined cells, and what lies in each.

    Args:
        rows: of joined cells.
        factor: how many cells lie along the side of a joined one.
        width: columns of joined cells.
    """

    def __init__(self, rows: slice, factor: int, width: int) -> None:
        self._rows, self._factor, self._width = rows, factor, width

    def of(self, raster: NDArray[np.generic]) -> NDArray[np.generic]:
        """Values (rows, cols, factor^2) of a raster's cells; 0 beyond its border."""
        factor, height = self._factor, self._rows.stop - self._rows.start
        part = raster[self._rows.start * factor : self._rows.stop * factor]
        framed = np.zeros((height * factor, self._width * factor), dtype=raster.dtype)
        framed[: part.shape[0], : part.shape[1]] = part
        blocks = framed.reshape(height, factor, self._width, factor).swapaxes(1, 2)
        return np.asarray(blocks.reshape(height, self._width, factor * factor))


def _complete(joined: Wall, around: Surroundings) -> None:
    """Fill narrow gaps, and carry what cells show from where their points lie to their centres."""
    assert joined.intensity is not None  # noqa: S101 - asked before
    depth_m, intensity = joined.depth_m.reshape(-1), joined.intensity.reshape(-1)
    known = np.isfinite(joined.depth_m)
    values = cell_values(depth_m, intensity=intensity)
    gaps = narrow_gaps(known, _GAP_CELLS, threads=1)
    found = interpolate(gaps, around, values, values, reach_cells=_GAP_CELLS, threads=1)
    joined.mask.reshape(-1)[gaps[found]] = SurfaceMask.RECOVERED
    carried = cell_values(np.empty(0, dtype=np.float32), intensity=intensity.copy())
    measured = np.flatnonzero(known)
    interpolate(measured, around, values, carried, reach_cells=0.0, threads=1)
    intensity[:] = carried.intensity
