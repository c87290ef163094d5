"""Fits of a plane: to points of the sample, with a shrinking tolerance, and to the cells on it.

All planes here are in the cloud's own offsets (metres from its origin), so that survey coordinates
cost no digits; `assembling` adds the origin once, at the end.

The fit to cells is robust total least squares, cell by cell. Neighbouring points of a scan share
errors: relief, bow and plaster waves are larger than the scanner's noise. Here a cell is one
observation with a variance of its own (surface) plus the noise of its points; what the fit says of
its own exactness is in `covariance`.

Mouldings, edges and mixed distances put points beside the surface, nearly always on one side of it.
Three things keep them out: the fit starts at the densest layer of cells instead of their median,
cells far off lose their weight, and so do cells whose points scatter more than those of others.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane
from orthoflow_plugins.plane.covariance import CellFit, CellHeights, Stated, stated_covariance
from orthoflow_plugins.plane.kernels import FREE, LEVEL, VERTICAL, refine_robustly
from orthoflow_plugins.plane.slab_kernels import STEPS_PER_TOLERANCE
from orthoflow_plugins.plane.support import CellSums, SurfaceRaster

# What a fit may change: everything, or a normal kept exactly horizontal, or kept along up.
Freedom = Literal["free", "vertical", "level"]

_FREEDOMS: Final[dict[Freedom, int]] = {"free": FREE, "vertical": VERTICAL, "level": LEVEL}
# In standard deviations of a cell: beyond, a cell has no weight (Beaton & Tukey 1974).
_TUKEY: Final = 3.5
# The densest layer holds this share of the cells; a normal distribution holds it within +-0.385.
_LAYER_SHARE: Final = 0.3
_LAYER_SIGMAS: Final = 0.7706
# What is usual near a cell counts beside its own variance as if it had so many points.
_USUAL_POINTS: Final = 40
# What is usual is the median of blocks so wide, if they hold so many cells.
_BLOCK_CELLS: Final = 8
_BLOCK_LEAST: Final = 12
_CHANCE_SIGMAS: Final = 3.0
_STEPS_MOST: Final = 30
# A fit has settled when none of its cells moves by more than this.
SETTLED_M: Final = 1e-7
# What a surface is never flatter than, so that a perfectly flat simulation has weights too.
_FLATTEST_M: Final = 2e-5
_UNKNOWNS: Final[dict[Freedom, tuple[int, ...]]] = {
    "free": (0, 1, 2),
    "vertical": (0, 1),
    "level": (0,),
}


def shrinking_tolerances(find_m: float, fit_m: float) -> tuple[float, ...]:
    """Tolerances to fit with, one after the other: 5 cm, 2.7 cm and 1.5 cm for the defaults.

    A fit at 5 cm finds the wall but is pulled by mouldings and the floor's edge; a fit at 1.5 cm is
    exact but would not get there from a rough start.
    """
    if fit_m >= find_m:
        return (find_m,)
    return (find_m, math.sqrt(find_m * fit_m), fit_m)


def refine_plane(
    points: NDArray[np.float64],
    start: Plane,
    tolerance_m: float,
    *,
    freedom: Freedom,
    up: NDArray[np.float64],
) -> Plane | None:
    """Move a plane to the densest layer of points near it: total least squares, reweighted.

    Args:
        points: (m, 3) offsets, metres.
        start: plane to start from.
        tolerance_m: points further away have no weight (Tukey's weights).
        freedom: what may change.
        up: (3,) unit vector.

    Returns:
        The plane, or None where fewer than three points or only a line of points support it.
    """
    row = np.append(start.normal, start.offset_m)
    # Every other point of an array, or all: one kernel for both.
    packed = np.ascontiguousarray(points)
    if not refine_robustly(packed, row, tolerance_m, _FREEDOMS[freedom], up):
        return None
    # Twice, because Plane accepts no length that is off by more than rounding.
    normal = row[:3] / np.linalg.norm(row[:3])
    return Plane(normal=normal / np.linalg.norm(normal), offset_m=float(row[3]))


@dataclass(frozen=True, kw_only=True)
class AdjustedPlane:
    """A plane fitted to cells.

    Attributes:
        plane: in the cloud's offsets.
        moved_m: how far the fit moved a corner of the cells at most.
        bend_per_m: strongest curvature of the surface that the cells show, 1 over its radius.
        bend_share: share of the cells' variance that this curvature explains.
        observed: the cells.
        fit: the fit to them.
        jacobian: (4, p) of (normal, offset) by the unknowns of the fit.
    """

    plane: Plane
    moved_m: float
    bend_per_m: float
    bend_share: float
    observed: CellHeights
    fit: CellFit
    jacobian: NDArray[np.float64]

    def stated(self) -> Stated:
        """State the covariance (4, 4) of (normal, offset), in offsets."""
        stated = stated_covariance(self.observed, self.fit)
        return Stated(
            covariance=self.jacobian @ stated.covariance @ self.jacobian.T,
            n_independent=stated.n_independent,
        )


@dataclass(frozen=True, kw_only=True)
class _Placed:
    """Where cells lie, and how many points each has; (n,) each."""

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    number: NDArray[np.int64]


def adjust_plane(
    raster: SurfaceRaster,
    sums: CellSums,
    cells: NDArray[np.bool_],
    *,
    fit_m: float,
    freedom: Freedom,
    settled_m: float = SETTLED_M,
) -> AdjustedPlane | None:
    """Fit the plane to the mean distances of cells; to second order this is total least squares.

    Args:
        raster: cells on a plane that is nearly right.
        sums: their sums.
        cells: (rows, columns) bool, which of them belong.
        fit_m: tolerance the sums were made with.
        freedom: what may change.
        settled_m: the fit ends when no cell moves by more.

    Returns:
        The plane, or None where the cells do not fix it.
    """
    rows, columns = np.nonzero(cells & (sums.n_fit > 0))
    if len(rows) < 4:
        return None
    step_m = fit_m / STEPS_PER_TOLERANCE
    number = sums.n_fit[rows, columns]
    heights_m = sums.steps[rows, columns] / number * step_m
    squares_m2 = sums.squared_steps[rows, columns] / number * step_m**2
    placed = _Placed(rows=rows, columns=columns, number=number)
    noise_m2, mixture_m2 = _cell_variances(squares_m2 - heights_m**2, placed, fit_m)
    u, v = raster.centres_m()
    centre = np.array([u[rows, columns].mean(), v[rows, columns].mean()])
    full = np.column_stack(
        [np.ones(len(rows)), u[rows, columns] - centre[0], v[rows, columns] - centre[1]]
    )
    observed = CellHeights(
        design=full[:, _UNKNOWNS[freedom]],
        heights_m=heights_m,
        noise_m2=noise_m2,
        mixture_m2=mixture_m2,
        rows=rows,
        columns=columns,
    )
    solved = _solve(observed, settled_m)
    if solved is None:
        return None
    change = np.zeros(3)
    change[list(_UNKNOWNS[freedom])] = solved.solution
    plane, jacobian = _tilted(raster, change, centre)
    bend_per_m, bend_share = _bend(full, heights_m)
    return AdjustedPlane(
        plane=plane,
        moved_m=float(np.abs(full @ change).max()),
        bend_per_m=bend_per_m,
        bend_share=bend_share,
        observed=observed,
        fit=solved,
        jacobian=jacobian[:, _UNKNOWNS[freedom]],
    )


def _cell_variances(
    spread_m2: NDArray[np.float64], placed: _Placed, fit_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Variance of each cell's mean by the noise of its points, and by points that do not belong.

    A share of points spread evenly from the surface to the tolerance D, as mixed distances are,
    adds share * D**2 / 3 to the variance of a cell and moves its mean by share * D / 2: the mean is
    off by 1.5 / D times the variance in excess of what is usual thereabouts.
    """
    number = placed.number
    free = np.maximum(number - 1, 0)
    own = np.maximum(spread_m2, 0.0) * number / np.maximum(free, 1)
    usual = _usual_nearby(own, placed)
    blended = (own * free + _USUAL_POINTS * usual) / (free + _USUAL_POINTS)
    by_chance = usual * (1.0 + _CHANCE_SIGMAS * np.sqrt(2.0 / np.maximum(free, 1)))
    excess = np.where(own > by_chance, own - usual, 0.0)
    return blended / number, (1.5 * excess / fit_m) ** 2


def _usual_nearby(own_m2: NDArray[np.float64], placed: _Placed) -> NDArray[np.float64]:
    """Median variance of the cells in each cell's block: noise differs with incidence and cloth."""
    several = placed.number >= 3
    overall = float(np.median(own_m2[several])) if several.any() else float(own_m2.mean())
    across = int(placed.columns.max()) // _BLOCK_CELLS + 1
    block = placed.rows // _BLOCK_CELLS * across + placed.columns // _BLOCK_CELLS
    n_blocks = across * (int(placed.rows.max()) // _BLOCK_CELLS + 1)
    order = np.argsort(own_m2)
    # Sixteen bits, so that the sort takes no comparisons.
    narrow = block[order].astype(np.uint16 if n_blocks <= 65536 else np.int64)
    order = order[np.argsort(narrow, kind="stable")]
    count = np.bincount(block, minlength=n_blocks)
    first = np.cumsum(count) - count
    held = count >= _BLOCK_LEAST
    middle = np.full(n_blocks, overall)
    middle[held] = own_m2[order[(first + count // 2)[held]]]
    usual: NDArray[np.float64] = np.maximum(middle[block], 0.1 * overall)
    return usual


def _solve(observed: CellHeights, settled_m: float) -> CellFit | None:
    """Weighted least squares with the cells' own variance estimated along; outliers lose weight."""
    design, heights_m = observed.design, observed.heights_m
    solution = np.zeros(design.shape[1])
    solution[0] = _densest_layer(heights_m)[0]
    noise_m2 = float(np.median(observed.noise_m2 + observed.mixture_m2))
    for _ in range(_STEPS_MOST):
        residuals = heights_m - design @ solution
        scale_m = max(_densest_layer(residuals)[1], _FLATTEST_M)
        surface_m2 = max(scale_m**2 - noise_m2, _FLATTEST_M**2)
        fit = CellFit(
            solution=solution,
            scale_m=scale_m,
            limit_m=_TUKEY * np.sqrt(surface_m2 + observed.noise_m2),
            variance_m2=surface_m2 + observed.noise_m2 + observed.mixture_m2,
        )
        updated = fit.stepped(observed)
        if updated is None:
            return None
        moved_m = float(np.abs(design @ (updated - solution)).max())
        solution = updated
        if moved_m < settled_m:
            break
    return replace(fit, solution=solution)


def _densest_layer(heights_m: NDArray[np.float64]) -> tuple[float, float]:
    """Middle of the shortest interval that holds a share of the heights, and the spread it shows.

    The "shorth" of Rousseeuw & Leroy 1987 with a smaller share: a panel that covers half of a wall
    does not move it.
    """
    ordered = np.sort(heights_m)
    held = max(2, int(_LAYER_SHARE * len(ordered)))
    lengths = ordered[held - 1 :] - ordered[: len(ordered) - held + 1]
    first = int(np.argmin(lengths))
    middle = 0.5 * float(ordered[first + (held - 1) // 2] + ordered[first + held // 2])
    return middle, float(lengths[first]) / _LAYER_SIGMAS


def _bend(design: NDArray[np.float64], heights_m: NDArray[np.float64]) -> tuple[float, float]:
    """Curvature of the cells' heights, and the share of their variance that it explains."""
    reach_m = max(float(np.abs(design[:, 1:]).max()), _FLATTEST_M)
    # In units of the reach, so that the normal equations are well conditioned.
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


def _tilted(
    raster: SurfaceRaster, change: NDArray[np.float64], centre: NDArray[np.float64]
) -> tuple[Plane, NDArray[np.float64]]:
    """Apply height and slopes at a point of the plane; gives the Jacobian (4, 3) too."""
    height_m, slope_u, slope_v = change
    u, v = raster.axes
    normal = raster.plane.normal - slope_u * u - slope_v * v
    offset_m = raster.plane.offset_m + height_m - slope_u * centre[0] - slope_v * centre[1]
    length = float(np.linalg.norm(normal))
    jacobian = np.zeros((4, 3))
    jacobian[:3, 1], jacobian[:3, 2] = -u, -v
    jacobian[3] = (1.0, -centre[0], -centre[1])
    normal = normal / length
    # Twice, because Plane accepts no length that is off by more than rounding.
    plane = Plane(normal=normal / np.linalg.norm(normal), offset_m=offset_m / length)
    return plane, jacobian
