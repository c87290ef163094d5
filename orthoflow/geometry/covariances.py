"""Covariances of adjustments in which neighbouring points have common errors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import threadpoolctl
from numpy.typing import NDArray

# Correlation lengths, as shares of the extent of the points of a photo, for rough errors
# (exponential correlation, as caused by relief or offsets between scans) and smooth errors
# (Gaussian correlation, as caused by bending, drift of a scanner path or stereo). With twice as
# many lengths, stated errors in drawn rooms change by less than a tenth.
_ROUGH: Final = (0.15, 0.5, 1.5)
_SMOOTH: Final = (0.1, 0.25, 0.63, 1.8)
# Shares of the variance of a common error that all photos have in common; the rest differs between
# photos. Simulated clouds have only errors of positions (1). Of entry-p10 and fountain-p11, a tenth
# differs: when this was compared, true errors were 0.56 to 1.47 times the stated ones, 0.39 to 1.24
# times without this kind, and 0.45 to 1.62 times with shares of 0.8 to 0.95 (now 0.42 to 1.75).
_OF_ALL_PHOTOS: Final = (1.0, 0.9, 0.0)
# Ratios of the standard deviation of the common error to that of the independent error. Their prior
# is uniform on a logarithmic scale and decays exponentially above a ratio of about 10, since the
# unknowns absorb most of a large error with a long correlation length.
_RATIOS: Final = np.geomspace(0.01, 40.0, 28)
_DECAY: Final = 0.1
# Correlation length of the short-range error of positions (matching, structure of the surface), and
# ratios of its standard deviation to that of the independent error.
_SHORT: Final = 0.05
_SHORT_RATIOS: Final = np.array([0.0, 0.5, 1.0, 2.0])
# Neighbouring points of a photo are averaged in cells. The two limits are the maximum numbers of
# cells for one photo and for several.
MAX_CELLS: Final = 130
MAX_CELLS_OF_SEVERAL: Final = 200
# Side of the smallest cells, as a share of the extent of the points of a photo.
_FINEST_CELL: Final = 0.02
_COARSER: Final = 1.15
# Components of the residuals are omitted if the unknowns absorb all but this share of them. What
# remains of such a component mostly comes from the other observations (ties between photos, priors
# of lenses), whose systematic errors would look like a large, smooth error of the positions.
_ABSORBED: Final = 0.1
# Block size of LAPACK's routines.
_BLOCK: Final = 64


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
        follows: (k, p, 3) change of the unknowns if photo k is shifted against an axis, per metre
            (the sign of `pulls`).
        towards: (n, 3) unit normals of the surface. In this direction, the errors of a cloud are
            largest.
        cofactors: (p, p) inverse of the normal matrix.
        scan_errors: see `SeenPoints`.
    """

    photo: NDArray[np.intp]
    places: NDArray[np.float64]
    residuals: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    by_place: NDArray[np.float64]
    pulls: NDArray[np.float64]
    follows: NDArray[np.float64]
    towards: NDArray[np.float64]
    cofactors: NDArray[np.float64]
    scan_errors: NDArray[np.float64] | None = None

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

    Each residual is the sum of an independent error, a short-range error of the position, and an
    error common to neighbouring points: of their positions (common to all photos), of their depths
    only, of one photo (due to its lens or to matching), or mostly of positions. Without the
    short-range error, rough common errors would have to explain it, and long, smooth errors would
    be underestimated.

    The adjustment absorbs part of a common error, which leaves no residual, so the size and
    correlation length of the error are never known exactly. Therefore, the covariance is not chosen
    by a test; it is a mean over all kinds, lengths and sizes of errors, each weighted by the
    likelihood of the residuals (restricted likelihood: Harville 1977,
    doi:10.1080/01621459.1977.10480998; model averaging: Hoeting et al. 1999,
    doi:10.1214/ss/1009212519).

    The mean error of the points of a photo is not included, since a photo that is shifted by the
    same amount is correct relative to the scan. This error leaves almost no residual, and it is the
    largest part of an error with a long correlation length.

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
    seen = _Residuals(points)
    if not seen.n_free:
        # Without residuals, the magnitude of an error common to all points is unknown.
        return sigma0**2 * points.cofactors + seen.of_scans
    apart = np.linalg.norm(seen.places[:, None] - seen.places, axis=2)
    correlations = [np.exp(-apart / length) for length in _ROUGH]
    correlations += [np.exp(-0.5 * (apart / length) ** 2) for length in _SMOOTH]
    same = np.equal.outer(seen.photo, seen.photo)
    kinds = [(of_all + (1.0 - of_all) * same, False) for of_all in _OF_ALL_PHOTOS]
    kinds = [(np.ones_like(same), True), *kinds[: 1 if same.all() else None]]
    left, error_of_short = seen.covariances(np.exp(-0.5 * (apart / _SHORT) ** 2), in_depth=False)
    spreads = 1.0 + _SHORT_RATIOS[:, None] ** 2 * seen.turn(left)
    fields = [
        seen.covariances(correlation * among, in_depth=in_depth)
        for among, in_depth in kinds
        for correlation in correlations
    ]
    found = [[seen.evidence(left, spread) for spread in spreads] for left, _ in fields]
    evidence, variances = np.moveaxis(np.array(found), 2, 0)
    evidence -= _DECAY * _RATIOS
    weights = np.exp(evidence - evidence.max())
    weights *= variances / weights.sum()
    # Average the standard deviation, since a mean of the variance would depend on the tail of the
    # prior.
    totals = np.maximum(weights.sum(axis=(1, 2)), 1e-300)
    of_fields = (weights.sum(axis=1) @ _RATIOS) ** 2 / totals
    of_short = weights.sum(axis=(0, 2)) @ _SHORT_RATIOS**2
    # Round, so that later results do not depend on the order of summation.
    shares_of = [float(f"{value:.4g}") for value in (*of_fields, of_short)]
    errors = [*(error for _, error in fields), error_of_short]
    common = sum(share * error for share, error in zip(shares_of, errors, strict=True))
    return sigma0**2 * points.cofactors + _stable(np.asarray(common) + seen.of_scans)


class _Residuals:
    """Residuals of an adjustment, averaged in n cells and whitened, and the effects of errors.

    Attributes:
        n_free: number of independent residuals.
        places: (n, 3) positions, in units of the extent of the points of a photo.
        photo: (n,) index of the photo that shows a cell.
        of_scans: (p, p) mean square errors of the unknowns due to the registration of the scans.
    """

    def __init__(self, points: AdjustedPoints) -> None:
        is_one, extent_m = not points.photo.any(), max(points.extent_m, 1e-9)
        cells = _cells(points, extent_m, MAX_CELLS if is_one else MAX_CELLS_OF_SEVERAL)
        counts = np.bincount(cells)
        n_cells = len(counts)

        def means(values: NDArray[np.float64]) -> NDArray[np.float64]:
            sums = np.zeros((n_cells, *values.shape[1:]))
            np.add.at(sums, cells, values)
            return sums / counts.reshape(-1, *[1] * (values.ndim - 1))

        # Compute means per cell, in units of the standard deviation of a mean of independent
        # errors.
        roots = np.sqrt(counts)[:, None, None]
        residuals = means(points.residuals)
        self._scatter = float(((points.residuals - residuals[cells]) ** 2).sum())
        jacobian = (roots * means(points.jacobian)).reshape(2 * n_cells, -1)
        # Express position errors in units of the mean square of the residuals that they cause.
        unit = math.sqrt(float((points.by_place**2).sum()) / (2 * len(cells)))
        by_place = roots * means(points.by_place) / unit
        pulls = counts[:, None, None] * means(points.pulls) / unit
        self.places, self.photo = means(points.places) / extent_m, np.zeros(n_cells, dtype=np.intp)
        self.photo[cells], self._towards = points.photo, means(points.towards)
        moved = jacobian @ points.cofactors
        shares, axes = np.linalg.eigh(np.eye(2 * n_cells) - moved @ jacobian.T)
        kept = shares > _ABSORBED
        whitening = (axes[:, kept] / np.sqrt(shares[kept])).T
        self._white = whitening @ (roots[:, :, 0] * residuals).ravel()
        self.n_free = len(whitening) + 2 * (len(cells) - n_cells)
        # What an error of a cell along each axis leaves in the residuals (3, r, n), and its effect
        # on the unknowns (3, n, p), from which a shift of the photo is subtracted by the share of
        # the cell in the mean error.
        by_cell = np.einsum("rna,nad->drn", whitening.reshape(-1, n_cells, 2), by_place)
        self._remains = by_cell - (whitening @ moved) @ pulls.transpose(2, 1, 0)
        follows = points.follows[self.photo] / np.bincount(self.photo)[self.photo][:, None, None]
        self._effects = pulls.transpose(2, 0, 1) @ points.cofactors
        self._effects -= follows.transpose(2, 0, 1) / unit
        self.of_scans = np.zeros_like(points.cofactors)
        if points.scan_errors is not None:
            self._measure(unit * means(points.scan_errors))

    def _measure(self, scan_errors: NDArray[np.float64]) -> None:
        """Subtract errors of scans (n, 3, q) from the residuals, and set `of_scans`.

        The residuals show the uncertain ones, too, unless they have other causes.
        """
        # Residuals are observed minus computed, so they decrease by what an error leaves.
        left = np.einsum("drn,ndq->rq", self._remains, scan_errors)
        moved = np.einsum("dnp,ndq->pq", self._effects, scan_errors)
        self._white += left[:, 0]
        variance = max(float((self._white**2).mean()), 1e-12) if len(self._white) else 1.0
        shown = left[:, 1:].T / variance
        covariance = np.linalg.inv(np.eye(len(shown)) + shown @ left[:, 1:])
        sizes = covariance @ (shown @ -self._white)
        self._white += left[:, 1:] @ sizes
        known = moved[:, 0] + moved[:, 1:] @ sizes
        self.of_scans = np.outer(known, known) + moved[:, 1:] @ covariance @ moved[:, 1:].T

    def covariances(
        self, shared: NDArray[np.float64], *, in_depth: bool
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return those of residuals and unknowns due to a common error.

        Args:
            shared: (n, n) correlations of the errors of cells.
            in_depth: whether the errors are only in depth.
        """
        remains, effects = self._remains, self._effects
        if in_depth:
            remains = np.einsum("drn,nd->rn", remains, self._towards)[None]
            effects = np.einsum("dnp,nd->np", effects, self._towards)[None]
        left = sum(each @ shared @ each.T for each in remains)
        return np.asarray(left), np.asarray(sum(each.T @ shared @ each for each in effects))

    def turn(self, covariance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Rotate residuals so that a covariance (r, r) is diagonal; return the diagonal."""
        values, axes = np.linalg.eigh(covariance)
        self._remains, self._white = axes.T @ self._remains, axes.T @ self._white
        return np.asarray(np.maximum(values, 0.0))

    def evidence(
        self, left: NDArray[np.float64], spread: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the log-likelihood and the variance of unit weight for each ratio.

        Args:
            left: (r, r) covariance of the residuals due to the common error.
            spread: (r,) variances due to the other errors.
        """
        from scipy.linalg import lapack  # noqa: PLC0415 - loads slowly, and here alone

        # A tridiagonal matrix suffices, and takes half the time of an eigendecomposition. The
        # transformation leaves the first component as it is.
        scale = 1.0 / np.sqrt(spread)
        white, matrix = scale * self._white, scale[:, None] * left * scale
        if len(white) < 2:  # LAPACK needs two components.
            white, matrix = (np.pad(values, (0, 2 - len(spread))) for values in (white, matrix))
        reduced, diagonal, beside, factors, _ = lapack.dsytrd(
            matrix.T, lower=1, lwork=_BLOCK * len(white), overwrite_a=1
        )
        turned = lapack.dormqr("L", "T", reduced[1:, :-1], factors, white[1:, None], _BLOCK)[0]
        white[1:] = turned.ravel()
        logarithms = np.full(len(_RATIOS), np.log(spread).sum())
        squares = np.full(len(_RATIOS), self._scatter)
        for index, variance in enumerate(_RATIOS**2):
            shifted = 1.0 + variance * diagonal
            pivots, _, solution, _ = lapack.dptsv(shifted, variance * beside, white)
            logarithms[index] += np.log(pivots).sum()
            squares[index] += white @ solution
        # Avoid the logarithm of 0 for points without any error.
        squares = np.maximum(squares, np.finfo(np.float64).tiny)
        likelihood = -0.5 * logarithms - 0.5 * self.n_free * np.log(squares)
        return likelihood, squares / max(self.n_free - 2, 1)


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
