"""Covariances of adjustments in which neighbouring points have common errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import threadpoolctl
from numpy.typing import NDArray

# Correlation lengths, as shares of the extent of the points of a photo, for rough errors
# (exponential correlation, as caused by matching, relief or offsets between scans) and smooth
# errors (Gaussian correlation, as caused by bending, drift of a scanner path or stereo). Errors
# with shorter correlation lengths are practically independent; errors with longer correlation
# lengths shift and tilt all points and do not appear in residuals.
_ROUGH: Final = (0.04, 0.15, 0.5, 1.5)
_SMOOTH: Final = (0.05, 0.15, 0.4, 1.0)
# Ratios of the standard deviation of the common error to that of the independent error. Their prior
# is uniform on a logarithmic scale and decays exponentially above a ratio of about 1.
_RATIOS: Final = np.geomspace(0.003, 10.0, 25)
# Neighbouring points of a photo are averaged in cells. The two limits are the maximum numbers of
# cells for one photo and for several.
MAX_CELLS: Final = 130
MAX_CELLS_OF_SEVERAL: Final = 280
# Side of the smallest cells, as a share of the extent of the points of a photo.
_FINEST_CELL: Final = 0.02
_COARSER: Final = 1.15
# Components of the errors are omitted if less than this share of them remains in the residuals of
# the adjustment.
_ABSORBED: Final = 1e-3


@dataclass(frozen=True, kw_only=True)
class AdjustedPoints:
    """Points of photos after their adjustment, whose world positions may have common errors.

    Attributes:
        photo: (n,) index of the photo that shows each point.
        places: (n, 3) positions in metres.
        residuals: (n, 2) observed minus computed pixel coordinates, in standard deviations.
        jacobian: (n, 2, p) derivatives of the computed pixel coordinates, in standard deviations,
            with respect to the unknowns.
        by_place: (n, 2, 3) derivatives with respect to the position, in standard deviations per
            metre.
        pulls: (n, p, 3) effect of a position error on the normal equations, per metre.
        towards: (n, 3) unit normals of the surface. In this direction, the errors of a cloud are
            largest.
        cofactors: (p, p) inverse of the normal matrix.
    """

    photo: NDArray[np.intp]
    places: NDArray[np.float64]
    residuals: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    by_place: NDArray[np.float64]
    pulls: NDArray[np.float64]
    towards: NDArray[np.float64]
    cofactors: NDArray[np.float64]

    @property
    def extent_m(self) -> float:
        """Median, over all photos, of the extent of the points of a photo, in metres."""
        reaches = []
        for photo in np.unique(self.photo):
            mine = self.places[self.photo == photo]
            reach = np.linalg.norm(mine - mine.mean(axis=0), axis=1)
            reaches.append(float(np.percentile(reach, 90)))
        return 2.0 * float(np.median(reaches))


def honest_covariance(points: AdjustedPoints, sigma0: float) -> NDArray[np.float64]:
    """Return the covariance (p, p) of an adjustment whose points may have common errors.

    Each residual is the sum of an independent error and an error common to neighbouring points. The
    common error may be one of the positions (common to all photos), of their depths only, or of one
    photo (due to its lens or to matching). The adjustment absorbs part of a common error, which
    leaves no residual, so the size and correlation length of the error are never known exactly.
    Therefore, the covariance is not chosen by a test; it is a mean over all kinds, lengths and
    sizes of common errors, each weighted by the likelihood of the residuals (restricted likelihood:
    Harville 1977, doi:10.1080/01621459.1977.10480998; model averaging: Hoeting et al. 1999,
    doi:10.1214/ss/1009212519).

    A common shift of all positions leaves no residual at all and is not included.

    Args:
        points: the points with known positions.
        sigma0: standard deviation of unit weight of the whole adjustment. It is used for the
            independent errors, since position errors do not affect ties between photos.
    """
    # Use only one thread, because synchronisation makes eigenvalue solvers ten times as slow on a
    # busy machine.
    with threadpoolctl.threadpool_limits(1):
        return _averaged(points, sigma0)


def _averaged(points: AdjustedPoints, sigma0: float) -> NDArray[np.float64]:
    is_one, extent_m = not points.photo.any(), max(points.extent_m, 1e-9)
    cells = _cells(points, extent_m, MAX_CELLS if is_one else MAX_CELLS_OF_SEVERAL)
    counts = np.bincount(cells)
    n_cells = len(counts)

    def means(values: NDArray[np.float64]) -> NDArray[np.float64]:
        sums = np.zeros((n_cells, *values.shape[1:]))
        np.add.at(sums, cells, values)
        return sums / counts.reshape(-1, *[1] * (values.ndim - 1))

    # Compute means per cell, in units of the standard deviation of a mean of independent errors.
    roots = np.sqrt(counts)[:, None, None]
    residuals = means(points.residuals)
    scatter = float(((points.residuals - residuals[cells]) ** 2).sum())
    n_scattered = 2 * (len(cells) - n_cells)
    jacobian = (roots * means(points.jacobian)).reshape(2 * n_cells, -1)
    by_place = roots * means(points.by_place)
    pulls = counts[:, None, None] * means(points.pulls)
    places, towards, photo = means(points.places), means(points.towards), np.zeros(n_cells)
    photo[cells] = points.photo
    moved = jacobian @ points.cofactors
    shares, axes = np.linalg.eigh(np.eye(2 * n_cells) - moved @ jacobian.T)
    kept = shares > _ABSORBED
    whitening = axes[:, kept] / np.sqrt(shares[kept])
    white = whitening.T @ (roots[:, :, 0] * residuals).ravel()
    n_free = white.size + n_scattered
    if not n_free:
        # Without residuals, the magnitude of an error common to all points is unknown.
        return sigma0**2 * points.cofactors

    evidence, variances, errors = [], [], []
    # Mean square, in units of the variance, of the residuals that a position error of one metre
    # causes.
    unit = float((points.by_place**2).sum()) / (2 * len(cells))
    apart = np.linalg.norm(places[:, None] - places, axis=2) / extent_m
    correlations = [np.exp(-apart / length) for length in _ROUGH]
    correlations += [np.exp(-0.5 * (apart / length) ** 2) for length in _SMOOTH]
    for directions, among in _kinds(by_place, pulls, towards, photo):
        products = np.asarray(sum(np.outer(by, by) for by, _ in directions))
        for correlation in correlations:
            shared = correlation * among
            pulled = np.asarray(sum(pull.T @ shared @ pull for _, pull in directions))
            absorbed = np.asarray(
                sum(by[:, None] * np.repeat(shared @ pull, 2, axis=0) for by, pull in directions)
            )
            absorbed = absorbed @ moved.T
            expected = products * np.repeat(np.repeat(shared, 2, axis=0), 2, axis=1)
            expected += moved @ pulled @ moved.T - absorbed - absorbed.T
            values, vectors = np.linalg.eigh(whitening.T @ expected @ whitening / unit)
            spread = 1.0 + _RATIOS[:, None] ** 2 * np.maximum(values, 0.0)
            squares = ((vectors.T @ white) ** 2 / spread).sum(axis=1) + scatter
            # Avoid the logarithm of 0 for points without any error.
            squares = np.maximum(squares, np.finfo(np.float64).tiny)
            evidence.append(
                -0.5 * np.log(spread).sum(axis=1) - 0.5 * n_free * np.log(squares) - _RATIOS
            )
            variances.append(squares / max(n_free - 2, 1))
            errors.append(pulled / unit)
    weights = np.exp(np.array(evidence) - np.max(evidence))
    weights *= np.array(variances) / weights.sum()
    # Average the standard deviation, since a mean of the variance would depend on the tail of the
    # prior.
    of_kinds = (weights @ _RATIOS) ** 2 / np.maximum(weights.sum(axis=1), 1e-300)
    # Round, so that later results do not depend on the order of summation.
    shares_of = [float(f"{value:.4g}") for value in of_kinds]
    common = sum(share * error for share, error in zip(shares_of, errors, strict=True))
    moves = points.cofactors @ _stable(np.asarray(common)) @ points.cofactors
    return sigma0**2 * points.cofactors + moves


_Direction = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Derivatives (2 n,) of observations with respect to an error, and the pulls (n, p)."""


def _kinds(
    by_place: NDArray[np.float64],
    pulls: NDArray[np.float64],
    towards: NDArray[np.float64],
    photo: NDArray[np.float64],
) -> list[tuple[list[_Direction], NDArray[np.bool_]]]:
    """Return the directions of each kind of common error, and a mask (n, n) of affected pairs."""
    axes = [(by_place[:, :, axis].ravel(), pulls[:, :, axis]) for axis in range(3)]
    by_depth = np.einsum("nid,nd->ni", by_place, towards).ravel()
    depth = [(by_depth, np.einsum("npd,nd->np", pulls, towards))]
    is_one = np.equal.outer(photo, photo)
    all_share = np.ones_like(is_one)
    kinds = [(axes, all_share), (depth, all_share)]
    return kinds if is_one.all() else [*kinds, (axes, is_one)]


def _cells(points: AdjustedPoints, extent_m: float, n_most: int) -> NDArray[np.intp]:
    """Return the cell (n,) of each point; cells are cubes in space, separately for each photo."""
    side = _FINEST_CELL
    while True:
        cubes = np.floor(points.places / (side * extent_m)).astype(np.intp)
        keys = np.column_stack([points.photo, cubes])
        cells = np.unique(keys, axis=0, return_inverse=True)[1].ravel()
        if cells.max() < n_most:
            return np.asarray(cells, dtype=np.intp)
        side *= _COARSER


def outwards(places: NDArray[np.float64], centre: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit normal (3,) of the plane that fits positions (n, 3), towards a camera."""
    middle = places.mean(axis=0)
    across = np.linalg.svd(places - middle, full_matrices=False)[2][2]
    return np.asarray(across if (centre - middle) @ across > 0.0 else -across)


def _stable(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """Round sums (p, p) so that they do not depend on the number of threads of BLAS."""
    scale = np.sqrt(np.maximum(np.diag(sums), 1e-300))
    unit = np.outer(scale, scale)
    return np.asarray(np.round(sums / unit, 7) * unit, dtype=np.float64)
