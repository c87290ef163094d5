"""The final fit of a plane to the cells on it, and how well it is known.

Neighbouring points of a scan share errors: relief, bow and plaster waves are larger than the
scanner's noise. A covariance from single points would promise micrometres. Here a cell is one
observation with a variance of its own (surface) plus noise over its points, and the covariance is a
cluster-robust ("sandwich") one over tiles; of several tile sizes the one that gives the largest
variance holds, because that is where neighbouring tiles stop sharing their errors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane
from orthoflow.geometry.plane_kernels import STEPS_PER_TOLERANCE
from orthoflow_plugins.plane.fitting import Freedom
from orthoflow_plugins.plane.footprints import CellSums, SurfaceRaster

_TILE_CELLS: Final = (2, 4, 8, 16)
# Fewer tiles do not show a spread.
_TILES_LEAST: Final = 20
_TUKEY: Final = 6.0
# What a surface is never flatter than, so that a perfectly flat simulation has weights too.
_FLATTEST_M: Final = 2e-5
_UNKNOWNS: Final[dict[Freedom, tuple[int, ...]]] = {
    "free": (0, 1, 2),
    "vertical": (0, 1),
    "level": (0,),
}


@dataclass(frozen=True, kw_only=True)
class AdjustedPlane:
    """A plane fitted to cells.

    Attributes:
        plane: in the cloud's offsets.
        covariance: (4, 4) of (normal, offset), in offsets.
        moved_m: how far the fit moved a corner of the cells at most.
        sigma_cell_m: spread of the cells about the plane, robust.
        bend_per_m: strongest curvature of the surface that the cells show, 1 over its radius.
        bend_share: share of the cells' variance that this curvature explains.
    """

    plane: Plane
    covariance: NDArray[np.float64]
    moved_m: float
    sigma_cell_m: float
    bend_per_m: float
    bend_share: float


@dataclass(frozen=True, kw_only=True)
class _Observations:
    """Cells as observations of the height over the raster's plane."""

    design: NDArray[np.float64]
    heights_m: NDArray[np.float64]
    noise_m2: NDArray[np.float64]
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]


def adjust_plane(
    raster: SurfaceRaster,
    sums: CellSums,
    cells: NDArray[np.bool_],
    *,
    fit_m: float,
    freedom: Freedom,
) -> AdjustedPlane | None:
    """Fit the plane to the mean distances of cells; to second order this is total least squares.

    Args:
        raster: cells on a plane that is nearly right.
        sums: their sums.
        cells: (rows, columns) bool, which of them belong.
        fit_m: tolerance the sums were made with.
        freedom: what may change.

    Returns:
        The plane, or None where the cells do not fix it.
    """
    rows, columns = np.nonzero(cells & (sums.n_fit > 0))
    if len(rows) < 4:
        return None
    step_m = fit_m / STEPS_PER_TOLERANCE
    number = sums.n_fit[rows, columns]
    heights_m = sums.steps[rows, columns] / number * step_m
    spread = np.maximum(sums.squared_steps[rows, columns] / number * step_m**2 - heights_m**2, 0.0)
    within = float(np.sum(spread * number) / max(1, int(np.sum(number - 1))))
    u, v = raster.centres_m()
    centre = np.array([u[rows, columns].mean(), v[rows, columns].mean()])
    full = np.column_stack(
        [np.ones(len(rows)), u[rows, columns] - centre[0], v[rows, columns] - centre[1]]
    )
    observed = _Observations(
        design=full[:, _UNKNOWNS[freedom]],
        heights_m=heights_m,
        noise_m2=within / number,
        rows=rows,
        columns=columns,
    )
    solved = _solve(observed)
    if solved is None:
        return None
    solution, weights, sigma_cell_m = solved
    change = np.zeros(3)
    change[list(_UNKNOWNS[freedom])] = solution
    covariance = np.zeros((3, 3))
    covariance[np.ix_(_UNKNOWNS[freedom], _UNKNOWNS[freedom])] = _tile_covariance(
        observed, weights, solution
    )
    plane, jacobian = _tilted(raster, change, centre)
    bend_per_m, bend_share = _bend(full, heights_m)
    return AdjustedPlane(
        plane=plane,
        covariance=jacobian @ covariance @ jacobian.T,
        moved_m=float(np.abs(full @ change).max()),
        sigma_cell_m=sigma_cell_m,
        bend_per_m=bend_per_m,
        bend_share=bend_share,
    )


def _solve(
    observed: _Observations,
) -> tuple[NDArray[np.float64], NDArray[np.float64], float] | None:
    """Weighted least squares with the cells' own variance estimated along; outliers lose weight."""
    design, heights_m = observed.design, observed.heights_m
    solution = np.zeros(design.shape[1])
    solution[0] = np.median(heights_m)
    sigma_cell_m = 0.0
    weights = np.ones(len(heights_m))
    for _ in range(15):
        residuals = heights_m - design @ solution
        scale_m = max(1.4826 * float(np.median(np.abs(residuals))), _FLATTEST_M)
        surface = max(scale_m**2 - float(np.median(observed.noise_m2)), _FLATTEST_M**2)
        sigma = np.sqrt(surface + observed.noise_m2)
        ratio = residuals / (_TUKEY * np.maximum(sigma, scale_m))
        weights = np.where(np.abs(ratio) < 1.0, (1.0 - ratio**2) ** 2, 0.0) / sigma**2
        normal_matrix = design.T @ (weights[:, None] * design)
        if np.linalg.cond(normal_matrix) > 1e12:
            return None
        updated = np.linalg.solve(normal_matrix, design.T @ (weights * heights_m))
        settled = float(np.abs(design @ (updated - solution)).max()) < 1e-7
        solution, sigma_cell_m = updated, scale_m
        if settled:
            break
    return solution, weights, sigma_cell_m


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


def _tile_covariance(
    observed: _Observations, weights: NDArray[np.float64], solution: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Sandwich covariance over square tiles, the largest of several tile sizes."""
    design = observed.design
    residuals = observed.heights_m - design @ solution
    inverse = np.linalg.inv(design.T @ (weights[:, None] * design))
    scores = weights[:, None] * design * residuals[:, None]
    largest = np.zeros(inverse.shape)
    reach = -1.0
    for size in _TILE_CELLS:
        tiles_across = int(observed.columns.max()) // size + 1
        tile = observed.rows // size * tiles_across + observed.columns // size
        _, member = np.unique(tile, return_inverse=True)
        n_tiles = int(member.max()) + 1
        if n_tiles < _TILES_LEAST and reach >= 0.0:
            break
        tile_scores = np.column_stack([np.bincount(member, column) for column in scores.T])
        correction = n_tiles / max(1, n_tiles - design.shape[1])
        covariance: NDArray[np.float64] = (
            inverse @ (tile_scores.T @ tile_scores) @ inverse * correction
        )
        # Mean variance of the plane's height over its cells: one number to compare sizes by.
        variance = float(np.einsum("ij,jk,ik->i", design, covariance, design).mean())
        if variance > reach:
            largest, reach = covariance, variance
    return largest


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
