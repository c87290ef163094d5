"""Displacements between two images by least-squares matching, accurate to 1/100 cell."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.rows import Rows
from orthoflow.geometry.threads import in_order

PATCH_CELLS: Final = 32
_SMOOTH_CELLS: Final = 1.0
_LEAST_SHARE: Final = 0.3
_LEAST_REGION: Final = 0.8
_LEAST_WEIGHT: Final = 0.25
_ROUNDS: Final = 12
_AT_ONCE: Final = 2048
# A patch that moves farther than this during the refinement was located at a wrong position.
_STRAYED_CELLS: Final = 2.0
_CONVERGED_CELLS: Final = 0.002
# Smoothing correlates neighbouring cells; this many cells count as one independent observation.
_CELLS_PER_SAMPLE: Final = 4.0 * np.pi * _SMOOTH_CELLS**2
_SIGMA_LIMIT_CELLS: Final = 0.15


class GreyCells(ABC):
    """A grey image with a mask of valid cells; parts are computed on request."""

    @property
    @abstractmethod
    def shape(self) -> tuple[int, int]:
        """The number of rows and the number of columns."""

    @abstractmethod
    def cut(self, part: tuple[slice, slice]) -> GreyImage:
        """Return a part of the image."""

    def whole(self) -> GreyImage:
        """Return the whole image."""
        return self.cut((slice(0, self.shape[0]), slice(0, self.shape[1])))

    def fullest_part(self, side: int) -> GreyImage:
        """Return the tile, of at most `side` rows and columns, with the most valid cells."""

        def n_valid(tile: tuple[slice, slice]) -> int:
            return int(np.count_nonzero(self.cut(tile).valid))

        return self.cut(max(tiles(self.shape, side), key=n_valid))

    def square(self, corner: NDArray[np.int64], side: int) -> GreyImage:
        """Return a square that starts at (column, row); cells outside the image are invalid."""
        grey, valid = np.zeros((side, side)), np.zeros((side, side), dtype=np.bool_)
        first = np.clip(corner[::-1], 0, self.shape)
        end = np.clip(corner[::-1] + side, first, self.shape)
        rows, columns = (slice(int(one), int(other)) for one, other in zip(first, end, strict=True))
        down, right = (int(step) for step in first - corner[::-1])
        part = self.cut((rows, columns))
        height, width = part.grey.shape
        grey[down : down + height, right : right + width] = part.grey
        valid[down : down + height, right : right + width] = part.valid
        return GreyImage(grey=grey, valid=valid, region=valid)


@dataclass(frozen=True, kw_only=True)
class GreyImage(GreyCells):
    """A grey image with a mask of valid cells, in memory.

    Attributes:
        grey: (rows, cols) float64.
        valid: (rows, cols) bool, cells with a grey level.
        region: (rows, cols) bool, cells of the whole surface, including missing cells.
    """

    grey: NDArray[np.float64]
    valid: NDArray[np.bool_]
    region: NDArray[np.bool_]

    @property
    def shape(self) -> tuple[int, int]:
        """The number of rows and the number of columns."""
        rows, columns = self.grey.shape
        return rows, columns

    def cut(self, part: tuple[slice, slice]) -> GreyImage:
        """Return a part of the image."""
        return GreyImage(grey=self.grey[part], valid=self.valid[part], region=self.region[part])


@dataclass(frozen=True, kw_only=True)
class IntensityGrey(GreyCells):
    """An intensity raster as grey levels, 0 where unknown.

    Attributes:
        intensity: (rows, cols) float32 from 0 to 1, NaN where unknown.
        of_roots: whether to use square roots of intensities. Laser intensities span several orders
            of magnitude, and their roots are more similar to the grey values of a photo.
    """

    intensity: NDArray[np.float32]
    of_roots: bool = False

    @property
    def shape(self) -> tuple[int, int]:
        """The number of rows and the number of columns."""
        rows, columns = self.intensity.shape
        return rows, columns

    def cut(self, part: tuple[slice, slice]) -> GreyImage:
        """Return a part of the raster."""
        values = self.intensity[part]
        known = np.isfinite(values)
        level = np.where(known, values, np.float32(0.0))
        if self.of_roots:
            grey = 255.0 * np.sqrt(np.maximum(level, 0.0))
        else:
            grey = 255.0 * level.astype(np.float64)
        return GreyImage(grey=grey, valid=known, region=known)


def tiles(shape: tuple[int, int], side: int) -> Iterator[tuple[slice, slice]]:
    """Divide a raster into tiles of at most `side` rows and columns, in row order."""
    for row in range(0, shape[0], side):
        for column in range(0, shape[1], side):
            yield (
                slice(row, min(row + side, shape[0])),
                slice(column, min(column + side, shape[1])),
            )


@dataclass(frozen=True, kw_only=True)
class PatchShifts(Rows):
    """Displacements of patches with enough texture in both directions.

    Attributes:
        centre: (p, 2) float64 column and row of the patch centre.
        shift: (p, 2) float64 displacement along u and v, in cells, shown minus true position.
        sigma: (p, 2) float64 standard deviation of `shift` in cells.
        found: (p, 2) float64 displacement in cells before the refinement.
        correlation: (p,) float64 correlation coefficient of the patches; NaN before the refinement.
    """

    centre: NDArray[np.float64]
    shift: NDArray[np.float64]
    sigma: NDArray[np.float64]
    found: NDArray[np.float64]
    correlation: NDArray[np.float64]

    def within(self, rows: slice) -> PatchShifts:
        """Return the patches in a band, with rows counted from the start of the band."""
        first = rows.start or 0
        end = np.inf if rows.stop is None else rows.stop
        own = (self.centre[:, 1] >= first) & (self.centre[:, 1] < end)
        kept = self.take(own)
        return replace(kept, centre=kept.centre - (0.0, float(first)))


def unrefined(centre: NDArray[np.float64], shift: NDArray[np.float64]) -> PatchShifts:
    """Return patches at `centre` (p, 2) with approximate displacements (p, 2)."""
    return PatchShifts(
        centre=centre,
        shift=shift,
        sigma=np.ones(shift.shape),
        found=shift,
        correlation=np.full(len(shift), np.nan),
    )


class _Patches(NamedTuple):
    """Cells of patches, as arrays with shape (p, 32 * 32)."""

    rows: NDArray[np.float64]
    columns: NDArray[np.float64]
    grey: NDArray[np.float64]
    weight: NDArray[np.float64]


def measure_shifts(shown: GreyImage, true: GreyImage, *, reach_cells: int) -> PatchShifts:
    """Measure the displacement of `shown` relative to `true`, patch by patch.

    A patch has 32 x 32 cells. Its position is first found in whole cells, by the smallest mean
    squared difference, and then refined by Gauss-Newton steps for shift and brightness. Patches are
    omitted if they have too few valid cells, if they do not converge, or if their standard
    deviation exceeds 0.15 cells.

    Args:
        shown: the image to inspect.
        true: the reference image.
        reach_cells: maximum displacement in cells.
    """
    first, second = _smoothed(shown), _smoothed(true)
    start = _whole_cell_shifts(first, second, reach_cells)
    if len(start.centre) == 0:
        return start
    return _refined(first, _Sampler(second), start, _SIGMA_LIMIT_CELLS, math.inf)


def refine_shifts(
    shown: GreyImage,
    true: GreyImage,
    start: PatchShifts,
    *,
    sigma_most_cells: float,
    focus_cells: float = math.inf,
    threads: int = 1,
) -> PatchShifts:
    """Refine displacements that are known to within one or two cells, patch by patch.

    Args:
        shown: the image to inspect, with about the same contrast as the reference.
        true: the reference image.
        start: patches that are fully inside the image, with approximate displacements.
        sigma_most_cells: patches with a larger standard deviation are omitted.
        focus_cells: standard deviation, in cells, of the Gaussian weight around the patch centre.
        threads: number of threads.

    Returns:
        The patches that converge within two cells of their approximate displacement.
    """
    if not len(start.centre):
        return start
    first, second = in_order(_smoothed, (shown, true), threads=threads)
    sampler = _Sampler(second)

    def refined(begin: int) -> PatchShifts:
        part = slice(begin, begin + _AT_ONCE)
        chosen = unrefined(start.centre[part], start.shift[part])
        return _refined(first, sampler, chosen, sigma_most_cells, focus_cells)

    return PatchShifts.joined(
        [*in_order(refined, range(0, len(start.centre), _AT_ONCE), threads=threads)]
    )


def _smoothed(image: GreyImage) -> GreyImage:
    """Smooth with a Gaussian whose standard deviation is one cell, using only valid cells.

    Cells at the border of the region become invalid: their neighbours are only on one side, so
    their mean would be biased. Scattered holes have no such effect.
    """
    inside = _gauss(image.region) > _LEAST_REGION
    weight = _gauss(image.valid)
    grey = _gauss(np.where(image.valid, image.grey, 0.0)) / np.maximum(weight, 1e-6)
    valid = image.valid & inside & (weight > _LEAST_WEIGHT)
    return GreyImage(grey=grey, valid=valid, region=image.region)


def _gauss(values: NDArray[np.float64] | NDArray[np.bool_]) -> NDArray[np.float64]:
    from scipy.ndimage import gaussian_filter

    return gaussian_filter(values.astype(np.float64), _SMOOTH_CELLS, mode="constant")


def _whole_cell_shifts(shown: GreyImage, true: GreyImage, reach: int) -> PatchShifts:
    """Find the position of each patch with enough valid cells, in whole cells."""
    row, column = np.nonzero(_patch_counts(shown.valid) >= _LEAST_SHARE * PATCH_CELLS**2)
    grey = _windows(shown.grey, row, column, 0)
    valid = _windows(shown.valid, row, column, 0)
    # Cells outside the image count as invalid.
    true_grey = _windows(np.pad(true.grey, reach), row, column, reach)
    true_valid = _windows(np.pad(true.valid, reach), row, column, reach)
    best, shift = np.full(len(row), np.inf), np.zeros((len(row), 2))
    for down in range(-reach, reach + 1):
        for right in range(-reach, reach + 1):
            part = (
                slice(None),
                slice(reach - down, reach - down + PATCH_CELLS),
                slice(reach - right, reach - right + PATCH_CELLS),
            )
            both = valid & true_valid[part]
            counts = np.count_nonzero(both, axis=(1, 2))
            squares = np.einsum("pij,pij->p", both, (grey - true_grey[part]) ** 2)
            mean = np.where(
                counts >= _LEAST_SHARE * PATCH_CELLS**2, squares / np.maximum(counts, 1), np.inf
            )
            better = mean < best
            best[better] = mean[better]
            shift[better] = (right, down)
    found = np.isfinite(best)
    centre = np.column_stack([column + 0.5, row + 0.5])[found] * PATCH_CELLS
    return unrefined(centre, shift[found])


def _patch_counts(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    n_rows, n_columns = (size // PATCH_CELLS for size in mask.shape)
    tiles = mask[: n_rows * PATCH_CELLS, : n_columns * PATCH_CELLS]
    counts: NDArray[np.int64] = tiles.reshape(n_rows, PATCH_CELLS, n_columns, PATCH_CELLS).sum(
        axis=(1, 3)
    )
    return counts


_Value = TypeVar("_Value", bound=np.generic)


def _windows(
    values: NDArray[_Value], row: NDArray[np.int64], column: NDArray[np.int64], rim: int
) -> NDArray[_Value]:
    """Return patches (p, n, n), each with a margin; `values` includes the margin."""
    side = PATCH_CELLS + 2 * rim
    cells = np.arange(side)
    rows = row[:, None, None] * PATCH_CELLS + cells[:, None]
    columns = column[:, None, None] * PATCH_CELLS + cells
    windows: NDArray[_Value] = values[rows, columns]
    return windows


def _cut_patches(
    shown: GreyImage, centre: NDArray[np.float64], focus_cells: float = math.inf
) -> _Patches:
    row, column = np.mgrid[0:PATCH_CELLS, 0:PATCH_CELLS].reshape(2, -1)
    rows = (centre[:, 1:2] - PATCH_CELLS / 2).astype(np.int64) + row
    columns = (centre[:, :1] - PATCH_CELLS / 2).astype(np.int64) + column
    aside = (row - 0.5 * (PATCH_CELLS - 1)) ** 2 + (column - 0.5 * (PATCH_CELLS - 1)) ** 2
    return _Patches(
        rows=rows.astype(np.float64),
        columns=columns.astype(np.float64),
        grey=shown.grey[rows, columns],
        weight=shown.valid[rows, columns].astype(np.float64)
        * np.exp(-0.5 * aside / focus_cells**2),
    )


def _refined(
    shown: GreyImage,
    sampler: _Sampler,
    start: PatchShifts,
    sigma_most_cells: float,
    focus_cells: float,
) -> PatchShifts:
    patches = _cut_patches(shown, start.centre, focus_cells)
    shift, step = start.shift.copy(), np.full(start.shift.shape, np.inf)
    sigma = np.full(start.shift.shape, np.inf)
    correlation = np.zeros(len(shift))
    for _ in range(_ROUNDS):
        strayed = np.abs(shift - start.shift).max(axis=1) >= _STRAYED_CELLS
        active = np.flatnonzero((np.abs(step).max(axis=1) > _CONVERGED_CELLS) & ~strayed)
        if active.size == 0:
            break
        part = _Patches(*(array[active] for array in patches))
        expected, design, inside = sampler.at(part, shift[active])
        weight = part.weight * inside
        step[active], sigma[active] = _normal_step(design, part.grey - expected, weight)
        correlation[active] = correlations(part.grey, expected, weight)
        # Limit each step to half a cell, within which the linear model is valid.
        shift[active] += np.clip(step[active], -0.5, 0.5)
    good = (
        (np.abs(step).max(axis=1) < 5.0 * _CONVERGED_CELLS)
        & (sigma.max(axis=1) < sigma_most_cells)
        & (np.abs(shift - start.shift).max(axis=1) < _STRAYED_CELLS)
    )
    return PatchShifts(
        centre=start.centre[good],
        shift=shift[good],
        sigma=sigma[good],
        found=start.shift[good],
        correlation=correlation[good],
    )


def correlations(
    first: NDArray[np.float64], second: NDArray[np.float64], weight: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return weighted correlation coefficients (p,) of patches (p, n)."""
    total = np.maximum(weight.sum(axis=1, keepdims=True), 1e-9)
    one = first - (weight * first).sum(axis=1, keepdims=True) / total
    other = second - (weight * second).sum(axis=1, keepdims=True) / total
    spread = (weight * one**2).sum(axis=1) * (weight * other**2).sum(axis=1)
    found: NDArray[np.float64] = (weight * one * other).sum(axis=1) / np.sqrt(spread + 1e-12)
    return found


class _Sampler:
    """The true image, interpolated by cubic B-splines (Unser 1999), with a mask of valid cells.

    All cells of a patch have the same fractional position, so four weights per axis are sufficient.
    """

    def __init__(self, true: GreyImage) -> None:
        from scipy.ndimage import spline_filter

        self._spline: NDArray[np.float64] = spline_filter(true.grey, order=3)
        self._valid = true.valid

    def at(
        self, patches: _Patches, shift: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """Return expected grey levels (p, n), derivatives (p, n, 3) and a mask of valid cells."""
        first = np.column_stack([patches.rows[:, 0], patches.columns[:, 0]]) - shift[:, ::-1]
        whole = np.floor(first)
        part = first - whole
        window, valid = self._windows(whole.astype(np.int64))
        down, right = _spline_weights(part[:, 0]), _spline_weights(part[:, 1])
        rows, row_slopes = (_filtered(window, weights, 1) for weights in down)
        expected, slope_u = (_filtered(rows, weights, 2) for weights in right)
        slope_v = _filtered(row_slopes, right[0], 2)
        flat = (len(shift), -1)
        # The derivative of true(x - shift) with respect to the shift is the negative gradient.
        design = np.empty((*expected.reshape(flat).shape, 3))
        design[..., 0], design[..., 1] = -slope_u.reshape(flat), -slope_v.reshape(flat)
        design[..., 2] = 1.0
        return expected.reshape(flat), design, valid.reshape(flat)

    def _windows(self, corner: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return spline coefficients (p, 35, 35) of patches, and a mask (p, 32, 32) of valid cells.

        An interpolated cell is valid if its four neighbours are valid.
        """
        steps = np.arange(-1, PATCH_CELLS + 2)
        rows, columns = corner[:, :1] + steps, corner[:, 1:] + steps
        n_rows, n_columns = self._valid.shape
        inside_v = (rows >= 0) & (rows < n_rows)
        inside_u = (columns >= 0) & (columns < n_columns)
        rows = np.clip(rows, 0, n_rows - 1)[:, :, None]
        columns = np.clip(columns, 0, n_columns - 1)[:, None, :]
        valid = self._valid[rows, columns] & inside_v[:, :, None] & inside_u[:, None, :]
        both = valid[:, 1:-2] & valid[:, 2:-1]
        return self._spline[rows, columns], both[:, :, 1:-2] & both[:, :, 2:-1]


def _spline_weights(part: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return weights (2, p, 4) of four coefficients, for the value and for its derivative."""
    t = part
    s = 1.0 - t
    value = [s**3, 4.0 - 6.0 * t**2 + 3.0 * t**3, 4.0 - 6.0 * s**2 + 3.0 * s**3, t**3]
    slope = [-3.0 * s**2, 9.0 * t**2 - 12.0 * t, 12.0 * s - 9.0 * s**2, 3.0 * t**2]
    return np.moveaxis(np.array([value, slope]), 1, 2) / 6.0


def _filtered(
    window: NDArray[np.float64], weights: NDArray[np.float64], axis: int
) -> NDArray[np.float64]:
    """Return weighted sums of four neighbours along an axis of (p, rows, columns)."""
    size = window.shape[axis] - 3
    parts = (
        window[:, tap : tap + size] if axis == 1 else window[:, :, tap : tap + size]
        for tap in range(4)
    )
    total = next(parts) * weights[:, 0, None, None]
    for tap, part in enumerate(parts, start=1):
        total += weights[:, tap, None, None] * part
    return total


def _normal_step(
    design: NDArray[np.float64], residual: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the steps (p, 2) and standard deviations (p, 2) of all patches."""
    weighted = design * weight[:, :, None]
    normal = np.einsum("pni,pnj->pij", weighted, design) + 1e-9 * np.eye(3)
    right = np.einsum("pni,pn->pi", weighted, residual)
    inverse = np.linalg.inv(normal)
    step = np.einsum("pij,pj->pi", inverse, right)
    left_over = (residual - np.einsum("pni,pi->pn", design, step)) ** 2
    n_free = np.maximum(weight.sum(axis=1) / _CELLS_PER_SAMPLE - 3.0, 1.0)
    variance = (weight * left_over).sum(axis=1) / _CELLS_PER_SAMPLE / n_free
    spread = variance[:, None] * np.diagonal(inverse, axis1=1, axis2=2)[:, :2] * _CELLS_PER_SAMPLE
    return step[:, :2], np.sqrt(spread)
