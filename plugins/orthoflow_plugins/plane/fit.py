"""Fits of a plane: to sample points, with decreasing tolerance, and to the cells on the plane.

All planes in this module refer to offsets in metres from the cloud's origin, so that no precision
is lost with large survey coordinates. The module `planes` adds the origin at the end.

The fit to cells is a robust total least squares adjustment. Neighbouring points of a scan have
common errors, because relief, bow and waves of the plaster exceed the noise of the scanner. Each
cell is therefore an observation whose variance is the sum of the variance of the surface and that
due to the noise of the cell's points.

Mouldings, edges and mixed pixels cause points off the surface, nearly always on the same side of
it. The influence of these points is reduced in three ways: the fit starts at the densest layer of
cells instead of at their median, distant cells have no weight, and cells with a larger scatter than
usual have less weight.

A covariance computed from single points would be far too small. Instead, the covariance is
estimated in three steps.

- Tiles of cells are the independent units: the covariance is estimated by leaving out one tile at a
  time (cluster jackknife, CR3 in Cameron & Miller 2015, section VI.B), which remains valid with few
  tiles. Several tile sizes are tried, and the one with the largest variance is used, because the
  variance increases with the size as long as tiles are smaller than the correlation length.
- Cells whose weight decreases with their residual carry less information than their weights
  suggest: the covariance is enlarged by the derivative of the influence function (Huber &
  Ronchetti 2009, section 7.6).
- Mouldings and mixed pixels, which are on one side, bias the fit, but the scatter does not show
  this bias. It is estimated from the displacement of the plane when cells up to twice the distance
  are used, and is added as a separate component (GUM, JCGM 100:2008, 4.3).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane, basis_from_up
from orthoflow.geometry.rows import group_sums
from orthoflow_plugins.plane.kernels import (
    FREE,
    LEVEL,
    STEPS_PER_TOLERANCE,
    VERTICAL,
    refine_robustly,
)
from orthoflow_plugins.plane.proposing import Candidate, Constraint
from orthoflow_plugins.plane.support import CellSums, Support, SurfaceRaster

# For each constraint on the orientation: the constant of the kernel, and the free unknowns (0:
# height, 1: slope along u, 2: slope along v).
_FREEDOMS: Final[dict[Constraint, tuple[int, list[int]]]] = {
    "any": (FREE, [0, 1, 2]),
    "vertical": (VERTICAL, [0, 1]),
    "horizontal": (LEVEL, [0]),
}

# Residual, in standard deviations of a cell, beyond which the cell has no weight (Beaton & Tukey
# 1974).
_TUKEY: Final = 3.5
# Cells whose residuals are below this share of the limit have full weight. With Tukey's original
# function, weights decrease even for small residuals. The weights of points would then depend on
# the division into cells: a seventh of the information would be lost, and rotating a wall would
# displace the plane by half its standard deviation.
_FULL_SHARE: Final = 0.571
# Share of the cells that the densest layer contains. In a normal distribution, 30 % of the values
# are within +-0.385 standard deviations of the mean.
_LAYER_SHARE: Final = 0.3
_LAYER_SIGMAS: Final = 0.7706
# Weight, as a number of points, of the usual variance near a cell when it is averaged with the
# cell's own variance.
_USUAL_POINTS: Final = 40
# The usual variance is the median in a block of this width, provided that the block contains a
# minimum number of cells.
_BLOCK_CELLS: Final = 8
_BLOCK_LEAST: Final = 12
_CHANCE_SIGMAS: Final = 3.0
_STEPS_MOST: Final = 30
# A fit has converged if it moves no cell by more than this.
SETTLED_M: Final = 1e-7
# Lower limit for the roughness of a surface, so that the weights of perfectly flat surfaces are
# finite.
_FLATTEST_M: Final = 2e-5

# Widths, in cells, of the tiles for the covariance, and minimum number of tiles.
_TILE_CELLS: Final = (2, 4, 8, 16)
_TILES_LEAST: Final = 8
# Lower limit for the ratio of the derivative of the influence function to the weights.
_FLATTENING_LEAST: Final = 0.3
_STEADY: Final = 1e-6
_WIDER: Final = 2.0
_WIDER_STEPS: Final = 3


def shrinking_tolerances(tolerance_m: float, fit_tolerance_m: float) -> tuple[float, ...]:
    """Return the tolerances of successive fits; by default, these are 5, 2.7 and 1.5 cm.

    A fit with 5 cm finds the wall, but is biased by mouldings and the edge of the floor. A fit with
    1.5 cm is accurate, but does not converge from a poor initial plane.
    """
    if fit_tolerance_m >= tolerance_m:
        return (tolerance_m,)
    return (tolerance_m, math.sqrt(tolerance_m * fit_tolerance_m), fit_tolerance_m)


def refine_plane(
    points: NDArray[np.float64],
    start: Plane,
    *tolerances_m: float,
    freedom: Constraint,
    up: NDArray[np.float64],
) -> Plane | None:
    """Move a plane to the densest layer of points near it, by reweighted total least squares.

    Args:
        points: (m, 3) offsets, metres.
        start: initial plane.
        tolerances_m: tolerances of successive fits; points farther away have no weight (Tukey).
        freedom: constraint on the orientation, which the fit keeps exactly.
        up: (3,) unit vector.

    Returns:
        The plane; None if fewer than three points, or only collinear points, are near it.
    """
    basis = np.eye(3) if freedom == "any" else basis_from_up(up)
    # Always use the same memory layout, so that only one version of the kernel is compiled.
    packed = np.ascontiguousarray(points if freedom == "any" else points @ basis.T)
    row = np.append(basis @ start.normal, start.offset_m)
    for tolerance_m in tolerances_m:
        if not refine_robustly(packed, row, tolerance_m, _FREEDOMS[freedom][0]):
            return None
    normal = row[:3] @ basis
    # Normalise twice, because `Plane` tolerates only rounding errors in the length.
    normal /= np.linalg.norm(normal)
    return Plane(normal=normal / np.linalg.norm(normal), offset_m=float(row[3]))


@dataclass(frozen=True, kw_only=True)
class CellFit:
    """A robust fit to cells; observations are the heights of cells above an approximate plane.

    Attributes:
        design: (n, p) derivatives of heights with respect to the unknowns.
        heights_m: (n,) mean height of the points in each cell.
        rows: (n,) row of each cell.
        columns: (n,) column of each cell.
        limit_m: (n,) residual beyond which a cell has no weight.
        variance_m2: (n,) variance of each cell.
        solution: (p,) the unknowns.
    """

    design: NDArray[np.float64]
    heights_m: NDArray[np.float64]
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    limit_m: NDArray[np.float64]
    variance_m2: NDArray[np.float64]
    solution: NDArray[np.float64]

    def residuals_m(self) -> NDArray[np.float64]:
        """Heights (n,) of the cells above the fitted plane."""
        return np.asarray(self.heights_m - self.design @ self.solution)

    def faded(self) -> NDArray[np.float64]:
        """Positions (n,) of the residuals between full weight (0) and no weight (1)."""
        beyond = (np.abs(self.residuals_m() / self.limit_m) - _FULL_SHARE) / (1.0 - _FULL_SHARE)
        return np.clip(beyond, 0.0, 1.0)

    def weights(self) -> NDArray[np.float64]:
        """Weights (n,): inverse variances, reduced by Tukey's function near the limit."""
        return (1.0 - self.faded() ** 2) ** 2 / self.variance_m2

    def stepped(self) -> CellFit | None:
        """Solve with the current weights; return None if the cells do not determine a plane."""
        weighted = self.weights() * self.design.T
        normal_matrix = weighted @ self.design
        extremes = np.abs(np.linalg.eigvalsh(normal_matrix))
        if extremes.max() > 1e12 * extremes.min():
            return None
        solution = np.linalg.solve(normal_matrix, weighted @ self.heights_m)
        return replace(self, solution=np.asarray(solution, dtype=np.float64))


@dataclass(frozen=True, kw_only=True)
class AdjustedPlane:
    """A plane fitted to cells.

    Attributes:
        plane: the plane, for offsets from the cloud's origin.
        moved_m: largest displacement of a cell by the fit, in metres.
        bend_per_m: largest curvature of the surface, the inverse of its radius.
        bend_share: share of the variance of the cells that the curvature explains.
        fit: the fit to the cells.
        jacobian: (4, p) derivatives of (normal, offset) with respect to the unknowns.
    """

    plane: Plane
    moved_m: float
    bend_per_m: float
    bend_share: float
    fit: CellFit
    jacobian: NDArray[np.float64]

    def stated(self) -> tuple[NDArray[np.float64], float]:
        """Return the covariance (4, 4) of (normal, offset), for offsets from the cloud's origin.

        Returns:
            The covariance, and the number of independent cells that would give the same covariance.
        """
        covariance, n_independent = stated_covariance(self.fit)
        return self.jacobian @ covariance @ self.jacobian.T, n_independent


@dataclass(frozen=True)
class FoundPlane:
    """An accepted plane.

    Attributes:
        raster: raster on the plane; `raster.plane` is the plane, for offsets from the cloud's
            origin.
        support: cells that belong to the plane, connected parts and rectangle.
        adjusted: the fit.
        candidate: proposal of the detector.
        freedom: constraint on the orientation, which the fit keeps exactly.
    """

    raster: SurfaceRaster
    support: Support
    adjusted: AdjustedPlane
    candidate: Candidate
    freedom: Constraint


def adjust_plane(
    raster: SurfaceRaster,
    sums: CellSums,
    cells: NDArray[np.bool_],
    *,
    fit_tolerance_m: float,
    freedom: Constraint,
    settled_m: float = SETTLED_M,
) -> AdjustedPlane | None:
    """Fit a plane to the mean distances of cells; equals total least squares to second order.

    Args:
        raster: raster on an approximate plane.
        sums: sums over the points in each cell.
        cells: (rows, columns) bool, True for cells that belong to the plane.
        fit_tolerance_m: maximum distance of the points in the sums from the approximate plane.
        freedom: constraint on the orientation, which the fit keeps exactly.
        settled_m: the fit has converged if it moves no cell by more than this.

    Returns:
        The plane; None if the cells do not determine it.
    """
    rows, columns = np.nonzero(cells & (sums.n_fit > 0))
    if len(rows) < 4:
        return None
    step_m = fit_tolerance_m / STEPS_PER_TOLERANCE
    number = sums.n_fit[rows, columns]
    heights_m = sums.steps[rows, columns] / number * step_m
    squares_m2 = sums.squared_steps[rows, columns] / number * step_m**2
    noise_m2, mixture_m2 = _cell_variances(
        squares_m2 - heights_m**2, number, rows, columns, fit_tolerance_m
    )
    u, v = (centres[rows, columns] for centres in raster.centres_m())
    centre = np.array([u.mean(), v.mean()])
    full = np.column_stack([np.ones(len(rows)), u - centre[0], v - centre[1]])
    unknowns = _FREEDOMS[freedom][1]
    fit = _solved(full[:, unknowns], heights_m, rows, columns, noise_m2, mixture_m2, settled_m)
    if fit is None:
        return None
    change = np.zeros(3)
    change[unknowns] = fit.solution
    # Use the height and the slopes at the centre of the cells as unknowns.
    axes = raster.axes
    normal = raster.plane.normal - change[1:] @ axes
    offset_m = raster.plane.offset_m + float(change @ [1.0, *-centre])
    length = float(np.linalg.norm(normal))
    jacobian = np.zeros((4, 3))
    jacobian[:3, 1:], jacobian[3] = -axes.T, (1.0, *-centre)
    normal = normal / length
    bend_per_m, bend_share = _bend(full, heights_m)
    return AdjustedPlane(
        # Normalise twice, because `Plane` tolerates only rounding errors in the length.
        plane=Plane(normal=normal / np.linalg.norm(normal), offset_m=offset_m / length),
        moved_m=float(np.abs(full @ change).max()),
        bend_per_m=bend_per_m,
        bend_share=bend_share,
        fit=fit,
        jacobian=jacobian[:, unknowns],
    )


def _cell_variances(
    spread_m2: NDArray[np.float64],
    number: NDArray[np.int64],
    rows: NDArray[np.int64],
    columns: NDArray[np.int64],
    fit_tolerance_m: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the variances of the cells' means due to noise, and due to points off the surface.

    If a share of the points is distributed evenly between the surface and the tolerance D, as with
    mixed pixels, the variance of a cell increases by share * D**2 / 3, and its mean moves by share
    * D / 2. The error of the mean is therefore 1.5 / D times the difference between the variance
    and the usual variance. The usual variance is the median in a block of cells, because noise
    depends on incidence and material.
    """
    free = np.maximum(number - 1, 0)
    own = np.maximum(spread_m2, 0.0) * number / np.maximum(free, 1)
    several = number >= 3
    overall = float(np.median(own[several])) if several.any() else float(own.mean())
    across = int(columns.max()) // _BLOCK_CELLS + 1
    block = rows // _BLOCK_CELLS * across + columns // _BLOCK_CELLS
    n_blocks = across * (int(rows.max()) // _BLOCK_CELLS + 1)
    order = np.argsort(own)
    # NumPy sorts 16-bit integers by radix sort, without comparisons.
    narrow = block[order].astype(np.uint16 if n_blocks <= 65536 else np.int64)
    order = order[np.argsort(narrow, kind="stable")]
    count = np.bincount(block, minlength=n_blocks)
    first = np.cumsum(count) - count
    held = count >= _BLOCK_LEAST
    middle = np.full(n_blocks, overall)
    middle[held] = own[order[(first + count // 2)[held]]]
    usual = np.maximum(middle[block], 0.1 * overall)
    blended = (own * free + _USUAL_POINTS * usual) / (free + _USUAL_POINTS)
    by_chance = usual * (1.0 + _CHANCE_SIGMAS * np.sqrt(2.0 / np.maximum(free, 1)))
    excess = np.where(own > by_chance, own - usual, 0.0)
    return blended / number, (1.5 * excess / fit_tolerance_m) ** 2


def _solved(
    design: NDArray[np.float64],
    heights_m: NDArray[np.float64],
    rows: NDArray[np.int64],
    columns: NDArray[np.int64],
    noise_m2: NDArray[np.float64],
    mixture_m2: NDArray[np.float64],
    settled_m: float,
) -> CellFit | None:
    solution = np.zeros(design.shape[1])
    solution[0] = _densest_layer(heights_m)[0]
    usual_m2 = float(np.median(noise_m2 + mixture_m2))
    for _ in range(_STEPS_MOST):
        scale_m = max(_densest_layer(heights_m - design @ solution)[1], _FLATTEST_M)
        surface_m2 = max(scale_m**2 - usual_m2, _FLATTEST_M**2)
        fit = CellFit(
            design=design,
            heights_m=heights_m,
            rows=rows,
            columns=columns,
            limit_m=_TUKEY * np.sqrt(surface_m2 + noise_m2),
            variance_m2=surface_m2 + noise_m2 + mixture_m2,
            solution=solution,
        ).stepped()
        if fit is None:
            return None
        moved_m = float(np.abs(design @ (fit.solution - solution)).max())
        solution = fit.solution
        if moved_m < settled_m:
            break
    return fit


def _densest_layer(heights_m: NDArray[np.float64]) -> tuple[float, float]:
    """Return the centre of the shortest interval with a given share of the heights, and sigma.

    This is the "shorth" of Rousseeuw & Leroy 1987 with a smaller share, so that a panel that covers
    half of the wall does not affect the result.
    """
    ordered = np.sort(heights_m)
    held = max(2, int(_LAYER_SHARE * len(ordered)))
    lengths = ordered[held - 1 :] - ordered[: len(ordered) - held + 1]
    first = int(np.argmin(lengths))
    middle = 0.5 * float(ordered[first + (held - 1) // 2] + ordered[first + held // 2])
    return middle, float(lengths[first]) / _LAYER_SIGMAS


def _bend(design: NDArray[np.float64], heights_m: NDArray[np.float64]) -> tuple[float, float]:
    """Return the curvature of the cells' heights, and the share of variance that it explains."""
    reach_m = max(float(np.abs(design[:, 1:]).max()), _FLATTEST_M)
    # Scale coordinates by their range, so that the normal equations are well conditioned.
    u, v = design[:, 1] / reach_m, design[:, 2] / reach_m
    curved = np.column_stack([np.ones(len(u)), u, v, u * u, u * v, v * v])
    normal_matrix, right = curved.T @ curved, curved.T @ heights_m
    squares = float(heights_m @ heights_m)
    flat = np.linalg.lstsq(normal_matrix[:3, :3], right[:3])[0]
    terms = np.linalg.lstsq(normal_matrix, right)[0]
    variance = squares - float(flat @ right[:3])
    if variance < len(heights_m) * _FLATTEST_M**2:
        return 0.0, 0.0
    hessian = np.array([[2.0 * terms[3], terms[4]], [terms[4], 2.0 * terms[5]]]) / reach_m**2
    strongest = float(np.abs(np.linalg.eigvalsh(hessian)).max())
    return strongest, 1.0 - max(0.0, squares - float(terms @ right)) / variance


def stated_covariance(fit: CellFit) -> tuple[NDArray[np.float64], float]:
    """Return the covariance of a robust fit, allowing for correlated and one-sided errors.

    Returns:
        The covariance (p, p) of the unknowns, and the number of independent cells that would give
        the same covariance.
    """
    design, weights = fit.design, fit.weights()
    scores, products, used = _scores(fit)
    rows, columns = fit.rows[used], fit.columns[used]
    factor = _enlargement(fit, weights)
    largest = np.zeros((design.shape[1],) * 2)
    # With independent cells, each cell is a tile.
    alone = before = _mean_variance(design, independent_covariance(fit))
    reach = -math.inf
    for size in _TILE_CELLS:
        tile = rows // size * (int(columns.max()) // size + 1) + columns // size
        if np.count_nonzero(np.bincount(tile)) < _TILES_LEAST and math.isfinite(reach):
            break
        covariance = factor * jackknife_covariance(scores, products, tile)
        variance = _mean_variance(design, covariance)
        if variance > reach:
            # Extrapolate: if the tile size doubles, the effect of correlation across tile borders
            # is halved.
            beyond = max(1.0, 2.0 - before / variance) if variance else 1.0
            largest, reach = beyond * covariance, variance
        before = variance
    # Compute the change of the unknowns when cells up to twice the distance are used.
    wider = replace(fit, limit_m=_WIDER * fit.limit_m)
    for _ in range(_WIDER_STEPS):
        wider = wider.stepped() or wider
    moved = wider.solution - fit.solution
    covariance = largest + np.outer(moved, moved)
    variance = _mean_variance(design, covariance)
    effective = float(weights.sum() ** 2 / np.sum(weights**2))
    return covariance, effective * alone / variance if variance else effective


def independent_covariance(fit: CellFit) -> NDArray[np.float64]:
    """Return the covariance (p, p) of the unknowns for independent cells.

    This is the sandwich estimator for M-estimates (Huber & Ronchetti 2009, section 7.6). It
    neglects the leverage of single cells.
    """
    scores, products, _ = _scores(fit)
    inverse = np.linalg.inv(products.sum(axis=0))
    factor = _enlargement(fit, fit.weights())
    return np.asarray(factor * inverse @ (scores.T @ scores) @ inverse)


def _scores(
    fit: CellFit,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return scores (m, p) and products (m, p, p) of cells with a weight, and their mask (n,)."""
    weights = fit.weights()
    used = weights > 0.0
    design, weights = fit.design[used], weights[used]
    scores = (weights * fit.residuals_m()[used])[:, None] * design
    products = (weights[:, None] * design)[:, :, None] * design[:, None, :]
    return scores, products, used


def _mean_variance(design: NDArray[np.float64], covariance: NDArray[np.float64]) -> float:
    """Return the mean variance of the plane's height over all cells, to compare covariances."""
    return float(np.sum((design @ covariance) * design)) / len(design)


def jackknife_covariance(
    scores: NDArray[np.float64], products: NDArray[np.float64], tile: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the jackknife covariance, leaving out one tile at a time."""
    held = np.bincount(tile) > 0
    n_tiles, size = int(np.count_nonzero(held)), scores.shape[1]
    sums = group_sums(scores, tile)[held]
    parts = np.empty((n_tiles, size, size))
    for i in range(size):
        for j in range(i, size):
            parts[:, i, j] = parts[:, j, i] = np.bincount(tile, products[:, i, j])[held]
    whole = parts.sum(axis=0)
    # Damp the matrix, because the other tiles may not determine a plane.
    without = whole - parts + _STEADY * np.diag(np.diag(whole))
    moves = np.linalg.solve(without, sums[:, :, None])[:, :, 0]
    return (n_tiles - 1) / n_tiles * (moves.T @ moves)


def _enlargement(fit: CellFit, weights: NDArray[np.float64]) -> float:
    """Return the factor by which weights that decrease with the residuals enlarge a covariance."""
    design, faded = fit.design, fit.faded()
    inside = 1.0 - faded**2
    ratios = fit.residuals_m() / fit.limit_m
    falls = 4.0 * faded * np.abs(ratios) / (1.0 - _FULL_SHARE)
    slopes = inside * (inside - falls) / fit.variance_m2
    by_weights = float(np.trace(design.T @ (weights[:, None] * design)))
    by_slopes = float(np.trace(design.T @ (slopes[:, None] * design)))
    return max(_FLATTENING_LEAST, by_slopes / by_weights) ** -2
