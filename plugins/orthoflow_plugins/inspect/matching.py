"""How far one image lies off another: patches matched by least squares to hundredths of a cell."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

_PATCH: Final = 32
_SMOOTH_CELLS: Final = 1.0
_LEAST_SHARE: Final = 0.3
_LEAST_REGION: Final = 0.8
_LEAST_WEIGHT: Final = 0.25
_ROUNDS: Final = 12
_CONVERGED_CELLS: Final = 0.002
# Smoothing makes neighbouring cells alike; so many cells count as one when precision is judged.
_CELLS_PER_SAMPLE: Final = 4.0 * np.pi * _SMOOTH_CELLS**2
_SIGMA_LIMIT_CELLS: Final = 0.15


@dataclass(frozen=True, kw_only=True)
class GreyImage:
    """A grey image of which some cells count.

    Attributes:
        grey: (rows, cols) float64.
        valid: (rows, cols) bool, cells that count.
        region: (rows, cols) bool, the whole of the surface, whatever is missing on it.
    """

    grey: NDArray[np.float64]
    valid: NDArray[np.bool_]
    region: NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class PatchShifts:
    """Displacements of the patches that have enough texture in both directions.

    Attributes:
        centre: (p, 2) float64 (column, row) of the patch's centre.
        shift: (p, 2) float64 cells along u and v, shown - true.
        sigma: (p, 2) float64 cells, standard deviations.
    """

    centre: NDArray[np.float64]
    shift: NDArray[np.float64]
    sigma: NDArray[np.float64]


class _Patches(NamedTuple):
    """Cells of the patches under work: arrays (p, 32 * 32)."""

    rows: NDArray[np.float64]
    columns: NDArray[np.float64]
    grey: NDArray[np.float64]
    weight: NDArray[np.float64]


def measure_shifts(shown: GreyImage, true: GreyImage, *, reach_cells: int) -> PatchShifts:
    """Measure where the content of `true` appears in `shown`, patch by patch.

    A patch is 32 x 32 cells. It is found to a whole cell by the smallest mean square difference
    within the reach, then by Gauss-Newton steps for shift and brightness. Patches that have too
    few valid cells, too little texture for 0.15 cells, or do not converge are left out.

    Args:
        shown: the image to judge.
        true: the image it should be.
        reach_cells: largest displacement that is looked for.
    """
    first, second = _smoothed(shown), _smoothed(true)
    start = _whole_cell_shifts(first, second, reach_cells)
    if len(start.centre) == 0:
        return start
    return _refined(first, second, start)


def _smoothed(image: GreyImage) -> GreyImage:
    """Smooth by a Gaussian of one cell, as if only valid cells were there.

    At the rim of the region the mean leans to one side, by what the region cuts off and not by
    what is shown; such cells do not count. Scattered holes do no harm.
    """
    inside = _gauss(image.region) > _LEAST_REGION
    weight = _gauss(image.valid)
    grey = _gauss(np.where(image.valid, image.grey, 0.0)) / np.maximum(weight, 1e-6)
    valid = image.valid & inside & (weight > _LEAST_WEIGHT)
    return GreyImage(grey=grey, valid=valid, region=image.region)


def _gauss(values: NDArray[np.float64] | NDArray[np.bool_]) -> NDArray[np.float64]:
    from scipy.ndimage import gaussian_filter

    smooth: NDArray[np.float64] = gaussian_filter(
        values.astype(np.float64), _SMOOTH_CELLS, mode="constant"
    )
    return smooth


def _whole_cell_shifts(shown: GreyImage, true: GreyImage, reach: int) -> PatchShifts:
    """Find each patch to a whole cell, among those that have enough valid cells."""
    row, column = np.nonzero(_patch_counts(shown.valid) >= _LEAST_SHARE * _PATCH**2)
    grey = _windows(shown.grey, row, column, 0)
    valid = _windows(shown.valid, row, column, 0)
    # What comes in from beyond the border is not valid.
    true_grey = _windows(np.pad(true.grey, reach), row, column, reach)
    true_valid = _windows(np.pad(true.valid, reach), row, column, reach)
    best, shift = np.full(len(row), np.inf), np.zeros((len(row), 2))
    for down in range(-reach, reach + 1):
        for right in range(-reach, reach + 1):
            part = (
                slice(None),
                slice(reach - down, reach - down + _PATCH),
                slice(reach - right, reach - right + _PATCH),
            )
            both = valid & true_valid[part]
            counts = np.count_nonzero(both, axis=(1, 2))
            squares = np.einsum("pij,pij->p", both, (grey - true_grey[part]) ** 2)
            mean = np.where(
                counts >= _LEAST_SHARE * _PATCH**2, squares / np.maximum(counts, 1), np.inf
            )
            better = mean < best
            best[better] = mean[better]
            shift[better] = (right, down)
    found = np.isfinite(best)
    return PatchShifts(
        centre=np.column_stack([column + 0.5, row + 0.5])[found] * _PATCH,
        shift=shift[found],
        sigma=np.ones((np.count_nonzero(found), 2)),
    )


def _patch_counts(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    n_rows, n_columns = (size // _PATCH for size in mask.shape)
    tiles = mask[: n_rows * _PATCH, : n_columns * _PATCH]
    counts: NDArray[np.int64] = tiles.reshape(n_rows, _PATCH, n_columns, _PATCH).sum(axis=(1, 3))
    return counts


_Value = TypeVar("_Value", bound=np.generic)


def _windows(
    values: NDArray[_Value], row: NDArray[np.int64], column: NDArray[np.int64], rim: int
) -> NDArray[_Value]:
    """Patches (p, n, n) with a rim round each; `values` has the rim round it."""
    side = _PATCH + 2 * rim
    cells = np.arange(side)
    rows = row[:, None, None] * _PATCH + cells[:, None]
    columns = column[:, None, None] * _PATCH + cells
    windows: NDArray[_Value] = values[rows, columns]
    return windows


def _cut_patches(shown: GreyImage, centre: NDArray[np.float64]) -> _Patches:
    row, column = np.mgrid[0:_PATCH, 0:_PATCH].reshape(2, -1)
    rows = (centre[:, 1:2] - _PATCH / 2).astype(np.int64) + row
    columns = (centre[:, :1] - _PATCH / 2).astype(np.int64) + column
    return _Patches(
        rows=rows.astype(np.float64),
        columns=columns.astype(np.float64),
        grey=shown.grey[rows, columns],
        weight=shown.valid[rows, columns].astype(np.float64),
    )


def _refined(shown: GreyImage, true: GreyImage, start: PatchShifts) -> PatchShifts:
    patches = _cut_patches(shown, start.centre)
    sampler = _Sampler(true)
    shift, step = start.shift.copy(), np.full(start.shift.shape, np.inf)
    sigma = np.full(start.shift.shape, np.inf)
    for _ in range(_ROUNDS):
        active = np.flatnonzero(np.abs(step).max(axis=1) > _CONVERGED_CELLS)
        if active.size == 0:
            break
        part = _Patches(*(array[active] for array in patches))
        expected, design, inside = sampler.at(part, shift[active])
        step[active], sigma[active] = _normal_step(
            design, part.grey - expected, part.weight * inside
        )
        # Half a cell at most: the linear model holds no further.
        shift[active] += np.clip(step[active], -0.5, 0.5)
    good = (
        (np.abs(step).max(axis=1) < 5.0 * _CONVERGED_CELLS)
        & (sigma.max(axis=1) < _SIGMA_LIMIT_CELLS)
        & (np.abs(shift - start.shift).max(axis=1) < 2.0)
    )
    return PatchShifts(centre=start.centre[good], shift=shift[good], sigma=sigma[good])


class _Sampler:
    """The true image between its cells: grey by cubic splines, slopes and validity linearly."""

    def __init__(self, true: GreyImage) -> None:
        from scipy.ndimage import spline_filter

        self._spline = spline_filter(true.grey, order=3)
        self._slope_v: NDArray[np.float64] = np.gradient(true.grey, axis=0)
        self._slope_u: NDArray[np.float64] = np.gradient(true.grey, axis=1)
        self._valid = true.valid.astype(np.float64)

    def at(
        self, patches: _Patches, shift: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """Expected grey (p, n), its derivatives (p, n, 3), and where the truth is valid (p, n)."""
        from scipy.ndimage import map_coordinates

        at = [patches.rows - shift[:, 1:2], patches.columns - shift[:, :1]]
        expected = map_coordinates(self._spline, at, order=3, prefilter=False, mode="nearest")
        slope_u = map_coordinates(self._slope_u, at, order=1, mode="nearest")
        slope_v = map_coordinates(self._slope_v, at, order=1, mode="nearest")
        valid = map_coordinates(self._valid, at, order=1, mode="constant", cval=0.0)
        # The derivative of true(x - shift) by the shift is minus the slope.
        design = np.stack([-slope_u, -slope_v, np.ones_like(expected)], axis=-1)
        return expected, design, valid > 0.999


def _normal_step(
    design: NDArray[np.float64], residual: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Solve every patch's normal equations: steps (p, 2) and standard deviations (p, 2)."""
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
