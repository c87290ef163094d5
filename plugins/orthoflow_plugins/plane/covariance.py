"""How well a fitted plane is known: a covariance that respects correlated and one-sided errors.

A covariance from single points would promise micrometres. Three things are done about it.

- Tiles of cells are the units that err independently: the covariance is that of leaving out one
  tile after the other (the jackknife of clusters, CR3 in Cameron & Miller 2015, section VI.B),
  which is still right with few tiles. Of several sizes of tile the one with the largest variance
  holds: as long as tiles are smaller than the reach of the correlation, it grows with their size.
- Cells that lose their weight as they move away tell less than their weights say: the covariance
  grows by the derivative of the influence function (Huber & Ronchetti 2009, section 7.6).
- Mouldings and mixed distances lie on one side and bias the fit, which no scatter shows. How far
  the plane moves when cells twice as far away may take part shows it; that is added as a component
  of its own (GUM, JCGM 100:2008, 4.3).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

_TILE_CELLS: Final = (2, 4, 8, 16)
# Fewer tiles do not show a spread.
_TILES_LEAST: Final = 8
# The derivative of the influence function is trusted down to this share of the weights.
_FLATTENING_LEAST: Final = 0.3
_STEADY: Final = 1e-6
# Cells nearer than this share of the limit have all their weight. Would it fade from the plane on,
# as Tukey's does, each way to cut a wall into cells would weigh the same points differently: a
# seventh of what they say would be lost, and a turned wall found elsewhere by half its sigma.
_FULL_SHARE: Final = 0.571
_WIDER: Final = 2.0
_WIDER_STEPS: Final = 3


@dataclass(frozen=True, kw_only=True)
class CellHeights:
    """Cells as observations of the height over a plane that is nearly right.

    Attributes:
        design: (n, p) derivatives of a height by the unknowns.
        heights_m: (n,) mean height of the points of each cell.
        noise_m2: (n,) variance of that mean by the noise of the points.
        mixture_m2: (n,) its variance by points that do not belong to the surface.
        rows: (n,) place of the cell on the plane.
        columns: see rows.
    """

    design: NDArray[np.float64]
    heights_m: NDArray[np.float64]
    noise_m2: NDArray[np.float64]
    mixture_m2: NDArray[np.float64]
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class CellFit:
    """A robust fit to cells.

    Attributes:
        solution: (p,) the unknowns.
        scale_m: spread of the cells about the plane, robust.
        limit_m: (n,) residual at which a cell has no weight any more.
        variance_m2: (n,) variance of each cell.
    """

    solution: NDArray[np.float64]
    scale_m: float
    limit_m: NDArray[np.float64]
    variance_m2: NDArray[np.float64]

    def ratios(self, observed: CellHeights) -> NDArray[np.float64]:
        """(n,) residuals over the limit."""
        residuals = observed.heights_m - observed.design @ self.solution
        return np.asarray(residuals / self.limit_m, dtype=np.float64)

    def weights(self, observed: CellHeights) -> NDArray[np.float64]:
        """(n,) robust weights over the variances: all, then Tukey's as residuals near the limit."""
        return (1.0 - self.faded(observed) ** 2) ** 2 / self.variance_m2

    def faded(self, observed: CellHeights) -> NDArray[np.float64]:
        """(n,) how far residuals are from where weights begin to fade, 0, to the limit, 1."""
        beyond = (np.abs(self.ratios(observed)) - _FULL_SHARE) / (1.0 - _FULL_SHARE)
        return np.clip(beyond, 0.0, 1.0)

    def stepped(self, observed: CellHeights) -> NDArray[np.float64] | None:
        """Solution with the weights of this one; None where the cells do not fix it."""
        weighted = self.weights(observed) * observed.design.T
        normal_matrix = weighted @ observed.design
        extremes = np.abs(np.linalg.eigvalsh(normal_matrix))
        if extremes.max() > 1e12 * extremes.min():
            return None
        solution = np.linalg.solve(normal_matrix, weighted @ observed.heights_m)
        return np.asarray(solution, dtype=np.float64)


@dataclass(frozen=True, kw_only=True)
class Stated:
    """What is said about the exactness of a fit.

    Attributes:
        covariance: (p, p) of the unknowns.
        n_independent: so many cells without common errors would fix it as well.
    """

    covariance: NDArray[np.float64]
    n_independent: float


def stated_covariance(observed: CellHeights, fit: CellFit) -> Stated:
    """State the covariance of a robust fit to cells, correlated and one-sided errors included."""
    design, weights = observed.design, fit.weights(observed)
    used = weights > 0.0
    residuals = observed.heights_m - design @ fit.solution
    design_used, weights_used = design[used], weights[used]
    scores = (weights_used * residuals[used])[:, None] * design_used
    products = (weights_used[:, None] * design_used)[:, :, None] * design_used[:, None, :]
    rows, columns = observed.rows[used], observed.columns[used]
    factor = _flattening(observed, fit, weights) ** -2
    largest = np.zeros((design.shape[1],) * 2)
    inverse = np.linalg.inv(products.sum(axis=0))
    # Every cell a tile of its own; what one of them has in the solution is too little to matter.
    alone = before = _mean_variance(design, factor * inverse @ (scores.T @ scores) @ inverse)
    reach = -math.inf
    for size in _TILE_CELLS:
        tile = rows // size * (int(columns.max()) // size + 1) + columns // size
        if np.count_nonzero(np.bincount(tile)) < _TILES_LEAST and math.isfinite(reach):
            break
        covariance = factor * _left_out(scores, products, tile)
        variance = _mean_variance(design, covariance)
        if variance > reach:
            # Tiles twice as wide add as much again: what crosses their rims halves with each step.
            beyond = max(1.0, 2.0 - before / variance) if variance else 1.0
            largest, reach = beyond * covariance, variance
        before = variance
    moved = _moved_by_more(observed, fit)
    covariance = largest + np.outer(moved, moved)
    variance = _mean_variance(design, covariance)
    effective = float(weights.sum() ** 2 / np.sum(weights**2))
    return Stated(
        covariance=covariance, n_independent=effective * alone / variance if variance else effective
    )


def _mean_variance(design: NDArray[np.float64], covariance: NDArray[np.float64]) -> float:
    """Mean variance of the plane's height over its cells: one number to compare covariances by."""
    return float(np.sum((design @ covariance) * design)) / len(design)


def _left_out(
    scores: NDArray[np.float64], products: NDArray[np.float64], tile: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Covariance by how far the unknowns move when each tile in turn is left out."""
    held = np.bincount(tile) > 0
    n_tiles, size = int(np.count_nonzero(held)), scores.shape[1]
    sums = np.column_stack([np.bincount(tile, column)[held] for column in scores.T])
    parts = np.empty((n_tiles, size, size))
    for i in range(size):
        for j in range(i, size):
            parts[:, i, j] = parts[:, j, i] = np.bincount(tile, products[:, i, j])[held]
    whole = parts.sum(axis=0)
    # A tile without which the rest fixes no plane: its part is damped.
    without = whole - parts + _STEADY * np.diag(np.diag(whole))
    moves = np.linalg.solve(without, sums[:, :, None])[:, :, 0]
    return (n_tiles - 1) / n_tiles * (moves.T @ moves)


def _flattening(observed: CellHeights, fit: CellFit, weights: NDArray[np.float64]) -> float:
    """Share of the weights that the derivative of the influence function leaves."""
    design = observed.design
    faded = fit.faded(observed)
    inside = 1.0 - faded**2
    falls = 4.0 * faded * np.abs(fit.ratios(observed)) / (1.0 - _FULL_SHARE)
    slopes = inside * (inside - falls) / fit.variance_m2
    by_weights = float(np.trace(design.T @ (weights[:, None] * design)))
    by_slopes = float(np.trace(design.T @ (slopes[:, None] * design)))
    return max(_FLATTENING_LEAST, by_slopes / by_weights)


def _moved_by_more(observed: CellHeights, fit: CellFit) -> NDArray[np.float64]:
    """How far the unknowns move when cells twice as far away may take part."""
    wider = CellFit(
        solution=fit.solution,
        scale_m=fit.scale_m,
        limit_m=_WIDER * fit.limit_m,
        variance_m2=fit.variance_m2,
    )
    for _ in range(_WIDER_STEPS):
        solution = wider.stepped(observed)
        if solution is None:
            break
        wider = CellFit(
            solution=solution,
            scale_m=wider.scale_m,
            limit_m=wider.limit_m,
            variance_m2=wider.variance_m2,
        )
    return wider.solution - fit.solution
