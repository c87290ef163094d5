"""Image channels that look the same in different spectral bands, and measures of their texture.

The main channels are dense oriented gradients (similar to CFOG, Ye et al. 2019): the gradient
strength in several directions, smoothed and normalised locally. A light joint on dark stone has the
same channels as a dark joint on light stone. If the spectral bands are similar, grey values are
more accurate. If they differ, a combination of the colours of a photo, estimated for each patch,
may resemble the laser intensity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.cloud_quality import scan_step_m
from orthoflow.geometry.interpolation import Surroundings, cell_values, interpolate
from orthoflow.geometry.key_points import in_turns
from orthoflow.geometry.narrow_gaps import narrow_gaps
from orthoflow.products import SurfaceMask, Wall
from orthoflow_plugins.match.pictures import filled_smoothly, usual_spread

# As in rasters, gaps between merged cells are filled if they are too narrow for a disc of this
# radius.
_GAP_CELLS: Final = 2
# Number of cells merged at once; this many need about 100 MB of memory.
_CELLS_AT_ONCE: Final = 1 << 22


def in_cells_of_points(wall: Wall) -> Wall:
    """Merge cells of a wall so that each merged cell contains about one point.

    Values are interpolated from the centroids of the points to the centres of the merged cells.

    Args:
        wall: the wall, with or without intensity.

    Returns:
        The same wall if it has no intensity, or if its cells are not much finer than its point
        spacing; otherwise, a wall of merged cells with depths, spreads, counts and intensity, but
        without colours.
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
    """Fill some rows of a wall of merged cells with the values and centroids of its measured cells.

    Args:
        wall: the wall.
        factor: number of cells along the side of a merged cell.
        joined: the wall whose rows are filled.
        places: (rows, cols, 2) centroids as in `Surroundings`; the same rows are filled.
        which: the rows, and the depth difference beyond which points are on different surfaces.
    """
    rows, layer_m = which
    assert wall.intensity is not None  # noqa: S101 - checked before
    assert joined.intensity is not None  # noqa: S101 - as in the wall
    blocks = _Blocks(rows, factor, joined.frame.width)
    measured = blocks.of(wall.mask) == SurfaceMask.MEASURED
    depths_m = np.where(measured, blocks.of(wall.depth_m), np.float32(np.nan))
    n_known = np.isfinite(depths_m).sum(axis=2)
    # The lower median is always a measured depth, never one between two surfaces. NaN is sorted
    # last.
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
    """Blocks of cells to be merged.

    Args:
        rows: rows of merged cells.
        factor: number of cells along the side of a merged cell.
        width: number of columns of merged cells.
    """

    def __init__(self, rows: slice, factor: int, width: int) -> None:
        self._rows, self._factor, self._width = rows, factor, width

    def of(self, raster: NDArray[np.generic]) -> NDArray[np.generic]:
        """Return the cell values (rows, cols, factor^2) of a raster; 0 beyond its border."""
        factor, height = self._factor, self._rows.stop - self._rows.start
        part = raster[self._rows.start * factor : self._rows.stop * factor]
        framed = np.zeros((height * factor, self._width * factor), dtype=raster.dtype)
        framed[: part.shape[0], : part.shape[1]] = part
        blocks = framed.reshape(height, factor, self._width, factor).swapaxes(1, 2)
        return np.asarray(blocks.reshape(height, self._width, factor * factor))


def _complete(joined: Wall, around: Surroundings) -> None:
    """Fill narrow gaps, and interpolate intensity from the centroids of points to cell centres."""
    assert joined.intensity is not None  # noqa: S101 - checked before
    depth_m, intensity = joined.depth_m.reshape(-1), joined.intensity.reshape(-1)
    known = np.isfinite(joined.depth_m)
    values = cell_values(depth_m, intensity=intensity)
    gaps = narrow_gaps(known, _GAP_CELLS)
    found = interpolate(gaps, around, values, values, reach_cells=_GAP_CELLS, threads=1)
    joined.mask.reshape(-1)[gaps[found]] = SurfaceMask.RECOVERED
    carried = cell_values(np.empty(0, dtype=np.float32), intensity=intensity.copy())
    measured = np.flatnonzero(known)
    interpolate(measured, around, values, carried, reach_cells=0.0, threads=1)
    intensity[:] = carried.intensity


_N_DIRECTIONS: Final = 6
_NOISE_SIGMA_CELLS: Final = 0.8
_POOL_SIGMA_CELLS: Final = 0.8
_EVEN_SIGMA_CELLS: Final = 12.0
_BROAD_STEP: Final = 4
_MARGIN_CELLS: Final = 2
# The nine depths around a cell form a relief step if their range exceeds both _STEP_CELLS cell
# sizes and _STEP_SPREADS point spreads. On a smooth surface, their range is about three spreads and
# rarely five.
_STEP_CELLS: Final = 1.0
_STEP_SPREADS: Final = 6.0
# The surroundings of a cell count as relief if, in a window of _RELIEF_CELLS x _RELIEF_CELLS cells,
# more than _RELIEF_SHARE of the known cells are next to relief steps. The share is 0.06 to 0.11 in
# rooms with mouldings and 0.21 on a carved fountain.
_RELIEF_CELLS: Final = 121
_RELIEF_SHARE: Final = 0.16
# Minimum distance between textured positions. They are selected in turn from the fields of a grid.
_APART_CELLS: Final = 5
HALF_PATCH_CELLS: Final = 10
"""Half width h of compared patches, which are 2 h + 1 cells wide."""
_GRID: Final = 16


class Channels(NamedTuple):
    """The channels of a picture to be matched, in the form that compiled kernels require.

    Attributes:
        values: (rows, cols, c) float32, 0 where unknown.
        known: (rows, cols) float32, 1 where values are known, otherwise 0.
    """

    values: NDArray[np.float32]
    known: NDArray[np.float32]

    def part(self, cells: tuple[slice, slice]) -> Channels:
        """Return a section of the picture."""
        return Channels(
            values=np.ascontiguousarray(self.values[cells]),
            known=np.ascontiguousarray(self.known[cells]),
        )


def gradient_channels(grey: NDArray[np.float32]) -> Channels:
    """Return the oriented gradients of a picture in which unknown values are NaN."""
    import cv2

    gradient, known = _gradient(grey)
    angles = np.pi * np.arange(_N_DIRECTIONS) / _N_DIRECTIONS
    layers = [
        cv2.GaussianBlur(
            np.abs(gradient[0] * np.float32(np.cos(a)) + gradient[1] * np.float32(np.sin(a))),
            (0, 0),
            _POOL_SIGMA_CELLS,
        )
        for a in angles
    ]
    values = np.stack(layers, axis=-1).astype(np.float32)
    return Channels(values=_evened(values, known), known=known)


def grey_channels(grey: NDArray[np.float32]) -> Channels:
    """Return normalised grey values minus their local mean, for matching similar spectral bands."""
    return colour_channels(grey[:, :, None])


def colour_channels(colours: NDArray[np.float32]) -> Channels:
    """Return the colours (rows, cols, c) minus their local means, normalised jointly."""
    import cv2

    known = _safe(np.asarray(np.isfinite(colours).all(axis=2)))
    layers = []
    for layer in np.moveaxis(colours, 2, 0):
        filled = filled_smoothly(np.ascontiguousarray(layer))
        smooth = np.asarray(cv2.GaussianBlur(filled, (0, 0), 0.5), dtype=np.float32)
        layers.append(smooth - _broadly(smooth))
    return Channels(values=_evened(np.stack(layers, axis=-1), known), known=known)


@dataclass(frozen=True)
class WallTarget:
    """A wall with which photos are matched; gradients and grey values are computed on demand.

    Attributes:
        wall: the wall.
    """

    wall: Wall

    @cached_property
    def gradients(self) -> tuple[Channels, NDArray[np.float32]]:
        """Oriented gradients of the usable intensity, and their texture."""
        channels = gradient_channels(self.grey)
        return channels, texture(channels)

    @cached_property
    def greys(self) -> tuple[Channels, NDArray[np.float32]]:
        """Grey values of the usable intensity, and their texture."""
        channels = grey_channels(self.grey)
        return channels, texture(channels)

    @cached_property
    def grain(self) -> NDArray[np.float32]:
        """Ratio of known to measured cells, as returned by `grain_of`."""
        return grain_of(self.wall)

    @property
    def grey(self) -> NDArray[np.float32]:
        """Intensity, NaN where the depth is unknown or at relief steps."""
        assert self.wall.intensity is not None  # noqa: S101 - other walls are not matched
        known = np.isfinite(self.wall.depth_m) & ~_at_steps(self.wall)
        return np.where(known, self.wall.intensity, np.nan).astype(np.float32)


def _at_steps(wall: Wall) -> NDArray[np.bool_]:
    """Return a mask (rows, cols) of the cells next to a relief step.

    These cells contain points from both sides of the edge, at an unknown position within the cell,
    so the edge in the picture is displaced by part of a cell. An oblique photo shows the face of
    the step, or does not show the area behind it. Steep slopes are not steps. Where steps are
    everywhere, as on carved stone, no cells are masked, since too few would be left to compare.
    """
    import cv2

    known, step_m = np.isfinite(wall.depth_m), least_step_m(wall)
    kernel, inf = np.ones((3, 3), dtype=np.uint8), np.float32(np.inf)
    high = cv2.dilate(np.where(known, wall.depth_m, -inf), kernel)
    low = cv2.erode(np.where(known, wall.depth_m, inf), kernel)
    bent = np.zeros(wall.frame.shape, dtype=np.bool_)
    for depth_m, found in ((wall.depth_m, bent), (wall.depth_m.T, bent.T)):
        # Deviation of a depth from the line between its two neighbours; NaN next to void cells.
        off_m = np.abs(depth_m[:-2] - 2.0 * depth_m[1:-1] + depth_m[2:])
        found[1:-1] |= off_m > 0.5 * step_m
    # Without known depths nearby, the highest and the lowest depth are infinite.
    with np.errstate(over="ignore"):
        beside = known & bent & (high - low > step_m)
    n_beside, n_known = (
        cv2.blur(cells.astype(np.float32), (_RELIEF_CELLS, _RELIEF_CELLS))
        for cells in (beside, known)
    )
    return np.asarray(beside & (n_beside <= _RELIEF_SHARE * n_known), dtype=np.bool_)


def least_step_m(wall: Wall) -> float:
    """Return the minimum depth difference of a relief step."""
    spread = usual_spread(wall)
    return max(_STEP_CELLS * wall.frame.gsd_m, _STEP_SPREADS * spread.share * spread.usual_m)


def grain_of(wall: Wall) -> NDArray[np.float32]:
    """Return the ratio of known to measured cells around each cell (rows, cols), at least 1.

    Filled cells are interpolated from measured cells and share their errors, so they add no
    information.
    """
    import cv2

    side = (2 * HALF_PATCH_CELLS + 1,) * 2
    known = cv2.blur(np.isfinite(wall.depth_m).astype(np.float32), side)
    measured = cv2.blur((wall.count > 0).astype(np.float32), side)
    return np.asarray(np.maximum(1.0, known / np.maximum(measured, 1e-3)), dtype=np.float32)


def texture(channels: Channels) -> NDArray[np.float32]:
    """Return a measure (rows, cols) of how well the patch of each cell determines a displacement.

    The measure is the smaller eigenvalue of the second moments of the gradients in the patch (Shi &
    Tomasi 1994).
    """
    import cv2

    second = np.zeros((*channels.known.shape, 3), dtype=np.float32)
    for channel in range(channels.values.shape[2]):
        layer = np.ascontiguousarray(channels.values[:, :, channel])
        across = cv2.Scharr(layer, cv2.CV_32F, 1, 0)
        down = cv2.Scharr(layer, cv2.CV_32F, 0, 1)
        second += np.stack([across * across, across * down, down * down], axis=-1)
    second = np.asarray(cv2.GaussianBlur(second, (0, 0), 0.4 * HALF_PATCH_CELLS), dtype=np.float32)
    a, b, c = second[:, :, 0], second[:, :, 1], second[:, :, 2]
    return np.asarray(0.5 * (a + c) - np.sqrt(0.25 * (a - c) ** 2 + b * b), dtype=np.float32)


def textured_places(
    strength: NDArray[np.float32], usable: NDArray[np.bool_], n_most: int
) -> NDArray[np.intp]:
    """Select cells (n, 2) = (column, row) with the most texture.

    The best cells of each field of a grid are taken in turn, so that they cover the usable area
    evenly.

    Args:
        strength: (rows, cols) as returned by `texture`.
        usable: (rows, cols), cells that may be selected.
        n_most: maximum number of cells.
    """
    import cv2

    response = np.where(usable, strength, 0.0).astype(np.float32)
    kernel = np.ones((_APART_CELLS, _APART_CELLS), dtype=np.uint8)
    peak = (response >= cv2.dilate(response, kernel)) & (response > 0.0)
    rows, columns = np.nonzero(peak)
    if not rows.size:
        return np.empty((0, 2), dtype=np.intp)
    chosen = _spread(rows, columns, response[rows, columns], n_most)
    return np.column_stack([columns[chosen], rows[chosen]])


def _gradient(
    grey: NDArray[np.float32],
) -> tuple[tuple[NDArray[np.float32], NDArray[np.float32]], NDArray[np.float32]]:
    import cv2

    smooth = cv2.GaussianBlur(filled_smoothly(grey), (0, 0), _NOISE_SIGMA_CELLS)
    across = np.asarray(cv2.Scharr(smooth, cv2.CV_32F, 1, 0), dtype=np.float32)
    down = np.asarray(cv2.Scharr(smooth, cv2.CV_32F, 0, 1), dtype=np.float32)
    return (across, down), _safe(np.isfinite(grey))


def _safe(known: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Exclude cells next to void areas, since interpolation of void areas may create edges."""
    import cv2

    kernel = np.ones((2 * _MARGIN_CELLS + 1, 2 * _MARGIN_CELLS + 1), dtype=np.uint8)
    return np.asarray(cv2.erode(known.astype(np.uint8), kernel), dtype=np.float32)


def _evened(values: NDArray[np.float32], known: NDArray[np.float32]) -> NDArray[np.float32]:
    """Divide by the local strength, so that weak and strong edges have equal weights."""
    strength = np.einsum("ijk,ijk->ij", values, values) * known
    local = np.sqrt(_broadly(strength) / np.maximum(_broadly(known), 1e-3))
    floor = 0.1 * float(np.median(local[known > 0.0])) if (known > 0.0).any() else 1.0
    evened = values * (known / (local + np.float32(max(floor, 1e-6))))[:, :, None]
    return np.asarray(evened, dtype=np.float32)


def _broadly(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Blur with a wide Gaussian, at a quarter of the resolution.

    Compared with a blur at full resolution, this takes a tenth of the time, and the result differs
    by less than 1 %.
    """
    import cv2

    size = (values.shape[1], values.shape[0])
    few = (max(1, round(size[0] / _BROAD_STEP)), max(1, round(size[1] / _BROAD_STEP)))
    small = cv2.resize(values, few, interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), _EVEN_SIGMA_CELLS / _BROAD_STEP)
    return np.asarray(cv2.resize(small, size, interpolation=cv2.INTER_LINEAR), dtype=np.float32)


def _spread(
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
    strength: NDArray[np.float32],
    n_most: int,
) -> NDArray[np.intp]:
    low_row, low_column = rows.min(), columns.min()
    side_rows = max(1.0, (rows.max() - low_row + 1) / _GRID)
    side_columns = max(1.0, (columns.max() - low_column + 1) / _GRID)
    cell = ((rows - low_row) / side_rows).astype(np.intp) * _GRID + (
        (columns - low_column) / side_columns
    ).astype(np.intp)
    return in_turns(cell, (columns, rows, -strength), n_most)
