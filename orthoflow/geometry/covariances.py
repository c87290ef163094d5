"""Covariances of adjustments in which neighbouring points have common errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import threadpoolctl
from numpy.typing import NDArray

# Correlation lengths, as shares of the extent of the points of a photo: for rough errors
# (exponential correlation: matching, structure, steps between scans) and smooth errors (Gaussian
# correlation: bending, drift of a path, stereo). Errors with shorter lengths are independent;
# longer ones are shifts and tilts of all points, which do not appear in residuals. The effect of a
# smooth error on the camera depends on its length more than that of a rough one, so its lengths are
# closer together.
_ROUGH: Final = (0.12, 0.3, 0.75, 2.0)
_SMOOTH: Final = (0.1, 0.16, 0.26, 0.42, 0.68, 1.1, 1.8)
# Ratios of the standard deviation of the common error to that of the independent error. Their prior
# is uniform on a logarithmic scale, with an exponential decay at ratios above about 10: most of a
# large error with a long correlation length is absorbed.
_RATIOS: Final = np.geomspace(0.003, 40.0, 33)
_DECAY: Final = 0.1
# Neighbouring points of a photo are averaged in cells. These are the maximum numbers of cells for
# one photo and for several.
_MAX_CELLS: Final = 130
_MAX_CELLS_OF_SEVERAL: Final = 200
# Ratios of the standard deviation of errors common to a cell to that of the independent error.
_CELL_RATIOS: Final = np.array([0.0, 0.5, 1.0, 2.0])
# Side of the smallest cells, as a share of the extent of the points of a photo.
_FINEST_CELL: Final = 0.02
_COARSER: Final = 1.15
# The adjustment absorbs directions of the residuals of which less than this share remains.
_ABSORBED: Final = 1e-3


@dataclass(frozen=True, kw_only=True)
class AdjustedPoints:
    """Points of photos after their adjustment, whose world positions may have common errors.

    Attributes:
        photo: (n,) index of the photo that shows each point.
        places: (n, 3) positions in metres.
        residuals: (n, 2) observed minus computed, in standard deviations.
        jacobian: (n, 2, p) derivatives with respect to the unknowns, in standard deviations.
        by_place: (n, 2, 3) derivatives with respect to the position, standard deviations per metre.
        pulls: (n, p, 3) effect of a position error on the normal equations, per metre.
        follows: (k, p, 3) change of the unknowns if photo k moves along with all its points, per
            metre.
        towards: (n, 3) unit vectors out of the surface, in the direction of depth errors, which are
            the largest errors of a cloud.
        cofactors: (p, p) inverse of the normal matrix.
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

    @property
    def extent_m(self) -> float:
        """Median over the photos of the extent of a photo's points, in metres."""
        reaches = []
        for photo in np.unique(self.photo):
            mine = self.places[self.photo == photo]
            reach = np.linalg.norm(mine - mine.mean(axis=0), axis=1)
            reaches.append(float(np.percentile(reach, 90)))
        return 2.0 * float(np.median(reaches))


def honest_covariance(points: AdjustedPoints, sigma0: float) -> NDArray[np.float64]:
    """Return the covariance (p, p) of an adjustment whose points may have common errors.

    Each residual has an independent error, an error of its place with a short correlation length,
    and an error in common with its neighbours: of the positions (common to all photos), of their
    depth only, or of one photo (its lens or matching). The part of a common error that the
    adjustment absorbs leaves no residual, so its size and correlation length are never known
    exactly. Therefore the covariance is not chosen by a test. It is a mean over all kinds, lengths
    and sizes of common errors, each weighted by the likelihood of the residuals (restricted
    likelihood: Harville 1977, doi:10.1080/01621459.1977.10480998; model averaging: Hoeting et al.
    1999, doi:10.1214/ss/1009212519).

    The mean offset of the points of a photo is not included: a photo that moves along with them is
    correct relative to the scan. Residuals do not show this offset, and of an error with a long
    correlation length, it is the largest part.

    Args:
        points: the points with known positions.
        sigma0: standard deviation of unit weight of the whole adjustment. It is used as that of the
            independent errors, since position errors do not affect ties between photos.
    """
    # Use only one thread, because synchronisation makes eigenvalue solvers ten times as slow on a
    # busy machine.
    with threadpoolctl.threadpool_limits(1):
        return _averaged(points, sigma0)


def _averaged(points: AdjustedPoints, sigma0: float) -> NDArray[np.float64]:
    """Average over kinds, lengths and sizes of common errors; see `honest_covariance`."""
    seen = _Residuals(points, sigma0)
    if not seen.n_free:
        # Without residuals, the size of a common error is unknown.
        return sigma0**2 * points.cofactors
    fields = [seen.field(kind, *each) for kind in seen.kinds() for each in seen.correlations()]
    # Of positions; every third length suffices here.
    root = seen.root_of_cells(fields[2 : len(_ROUGH) + len(_SMOOTH) : 3])
    found = [seen.evidence(field, root) for field in fields]
    evidence, variances = (np.array(part) for part in zip(*found, strict=True))
    weights = np.exp(evidence - np.max(evidence))
    weights *= variances / weights.sum()
    # Average the standard deviation, since a mean of the variance would depend on the tail of the
    # prior.
    of_fields = (weights @ _RATIOS) ** 2 / np.maximum(weights.sum(axis=1), 1e-300)
    # Round, so that later results do not depend on the order of summation.
    shares = [float(f"{value:.4g}") for value in of_fields]
    common = sum(share * moves for share, (_, moves, _) in zip(shares, fields, strict=True))
    return sigma0**2 * points.cofactors + _stable(np.asarray(common))


_Kind = tuple[list[tuple[NDArray[np.float64], ...]], NDArray[np.bool_]]
"""Per direction of a common error, the derivatives (2 n,) of observations, their pulls (n, p), and
their effects (n, p) on the unknowns; and which pairs of cells (n, n) share the error.
"""
_Field = tuple[NDArray[np.float64], NDArray[np.float64], float]
"""Covariances of whitened residuals (r, r) and of the unknowns (p, p) by a common error, and its
correlation within a cell.
"""


class _Residuals:
    """The residuals of an adjustment, averaged in n cells and whitened.

    Attributes:
        n_free: number of independent residuals.
    """

    def __init__(self, points: AdjustedPoints, sigma0: float) -> None:
        self._extent_m = max(points.extent_m, 1e-9)
        most = _MAX_CELLS_OF_SEVERAL if points.photo.any() else _MAX_CELLS
        cells, self._cubes = _cells(points, self._extent_m, most)
        self._counts = counts = np.bincount(cells)
        n_cells = len(counts)

        def means(values: NDArray[np.float64]) -> NDArray[np.float64]:
            sums = np.zeros((n_cells, *values.shape[1:]))
            np.add.at(sums, cells, values)
            return sums / counts.reshape(-1, *[1] * (values.ndim - 1))

        # Compute means per cell, in standard deviations of a mean of independent errors.
        roots = np.sqrt(counts)[:, None, None]
        residuals = means(points.residuals)
        self._scatter = float(((points.residuals - residuals[cells]) ** 2).sum())
        jacobian = (roots * means(points.jacobian)).reshape(2 * n_cells, -1)
        self._by_place = roots * means(points.by_place)
        self._pulls = counts[:, None, None] * means(points.pulls)
        self._places, self._towards = means(points.places), means(points.towards)
        # RMS distance of two points of a cell.
        squares = float(((points.places - self._places[cells]) ** 2).sum())
        self._within = math.sqrt(2.0 * squares / max(len(cells) - n_cells, 1))
        self._photo = np.zeros(n_cells, dtype=np.intp)
        self._photo[cells] = points.photo
        n_of_photo = np.bincount(self._photo)[self._photo]
        self._effects = np.einsum("pq,nqd->npd", points.cofactors, self._pulls)
        self._effects -= points.follows[self._photo] / n_of_photo[:, None, None]
        self._moved = jacobian @ points.cofactors
        shares, axes = np.linalg.eigh(np.eye(2 * n_cells) - self._moved @ jacobian.T)
        kept = shares > _ABSORBED
        # Other observations (ties between photos, priors) determine part of the unknowns. Residuals
        # in directions that the unknowns absorb contain their errors, which may be larger.
        n_redundant = max(2 * len(cells) - float((1.0 - shares).sum()), 1.0)
        own = float((points.residuals**2).sum()) / n_redundant
        excess = max(sigma0**2 / max(own, np.finfo(np.float64).tiny), 1.0) - 1.0
        spread = shares[kept] * (1.0 + excess * (1.0 - shares[kept]))
        self._whitening = axes[:, kept] / np.sqrt(spread)
        self._white = self._whitening.T @ (roots[:, :, 0] * residuals).ravel()
        self.n_free = self._white.size + 2 * (len(cells) - n_cells)
        # Mean square, in standard deviations, of the effect of an error of one metre.
        self._unit = float((points.by_place**2).sum()) / (2 * len(cells))

    def correlations(self) -> list[tuple[NDArray[np.float64], float]]:
        """Return the correlations (n, n) of the errors of cells, and within cells, per length."""
        apart = np.linalg.norm(self._places[:, None] - self._places, axis=2) ** 2 + self._within**2
        apart = np.sqrt(np.append(apart.ravel(), self._within**2)) / self._extent_m
        found = [np.exp(-apart / length) for length in _ROUGH]
        found += [np.exp(-0.5 * (apart / length) ** 2) for length in _SMOOTH]
        correlations = []
        for values in found:
            shared, within = values[:-1].reshape(len(self._places), -1), float(values[-1])
            # The mean of all points of a cell, including each with itself.
            np.fill_diagonal(shared, within + (1.0 - within) / self._counts)
            correlations.append((shared, within))
        return correlations

    def kinds(self) -> list[_Kind]:
        """Return the kinds of common errors: of positions, of depths, and of each photo."""
        both = self._by_place, self._pulls, self._effects
        axes = [tuple(part[:, :, axis] for part in both) for axis in range(3)]
        depth = [tuple(np.einsum("nad,nd->na", part, self._towards) for part in both)]
        is_one = np.equal.outer(self._photo, self._photo)
        all_share = np.ones_like(is_one)
        kinds = [(axes, all_share), (depth, all_share)]
        return kinds if is_one.all() else [*kinds, (axes, is_one)]

    def field(self, kind: _Kind, correlation: NDArray[np.float64], within: float) -> _Field:
        """Return what a common error of unit size does to the residuals and the unknowns."""
        among = kind[1]
        directions = [(by.ravel(), *rest) for by, *rest in kind[0]]
        shared = correlation * among
        expected = np.repeat(np.repeat(shared, 2, axis=0), 2, axis=1)
        expected *= np.asarray(sum(np.outer(by, by) for by, _, _ in directions))
        pulled = np.asarray(sum(pull.T @ shared @ pull for _, pull, _ in directions))
        absorbed = np.asarray(
            sum(by[:, None] * np.repeat(shared @ pull, 2, axis=0) for by, pull, _ in directions)
        )
        absorbed = absorbed @ self._moved.T
        expected += self._moved @ pulled @ self._moved.T - absorbed - absorbed.T
        moves = np.asarray(sum(effect.T @ shared @ effect for _, _, effect in directions))
        white = self._whitening.T @ expected @ self._whitening
        return white / self._unit, moves / self._unit, within

    def root_of_cells(self, fields: Sequence[_Field]) -> NDArray[np.float64]:
        """Return the inverse root (r, r) of the covariance by uncorrelated and short-range errors.

        Errors of positions with a correlation length below a cell are common to the points of a
        cell, and to all photos of it. Their size is a mean over sizes, weighted by their likelihood
        with each of some common errors.
        """
        same = np.equal.outer(self._cubes, self._cubes).astype(np.float64)
        expected, _, _ = self.field(self.kinds()[0], same, 1.0)
        values, vectors = np.linalg.eigh(expected)
        spreads = 1.0 + _CELL_RATIOS[:, None] ** 2 * np.maximum(values, 0.0)
        evidence = [
            self.evidence(field, vectors / np.sqrt(spread))[0] - 0.5 * np.log(spread).sum()
            for spread in spreads
            for field in fields
        ]
        weights = np.exp(np.array(evidence) - np.max(evidence)).reshape(len(spreads), -1)
        return np.asarray(vectors / np.sqrt(weights.sum(axis=1) @ spreads / weights.sum()))

    def evidence(
        self, field: _Field, root: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return log-likelihood plus log-prior, and variance of unit weight, for each ratio."""
        expected, _, within = field
        values, vectors = np.linalg.eigh(root.T @ expected @ root)
        white = vectors.T @ (root.T @ self._white)
        spread = 1.0 + _RATIOS[:, None] ** 2 * np.maximum(values, 0.0)
        in_cells = 1.0 + _RATIOS**2 * (1.0 - within)
        squares = (white**2 / spread).sum(axis=1) + self._scatter / in_cells
        # Avoid the logarithm of 0 for points without any error.
        squares = np.maximum(squares, np.finfo(np.float64).tiny)
        n_in_cells = self.n_free - white.size
        evidence = -0.5 * (np.log(spread).sum(axis=1) + n_in_cells * np.log(in_cells))
        evidence -= 0.5 * self.n_free * np.log(squares) + _DECAY * _RATIOS
        return evidence, squares / max(self.n_free - 2, 1)


def _cells(
    points: AdjustedPoints, extent_m: float, n_most: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the cell (n,) of each point, and the cube (k,) of each cell.

    Cells are cubes in space, separate for each photo.
    """
    side = _FINEST_CELL
    while True:
        places = np.floor(points.places / (side * extent_m)).astype(np.intp)
        cubes = np.unique(places, axis=0, return_inverse=True)[1].ravel()
        keys = np.column_stack([points.photo, cubes])
        cells, of_points = np.unique(keys, axis=0, return_inverse=True)
        if len(cells) <= n_most:
            return np.asarray(of_points.ravel(), dtype=np.intp), cells[:, 1]
        side *= _COARSER


def outwards(places: NDArray[np.float64], centre: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the normal (3,) of the best-fitting plane of positions, towards a camera."""
    middle = places.mean(axis=0)
    across = np.linalg.svd(places - middle, full_matrices=False)[2][2]
    return np.asarray(across if (centre - middle) @ across > 0.0 else -across)


def _stable(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """Round sums (p, p) so that they do not depend on the number of threads of BLAS."""
    scale = np.sqrt(np.maximum(np.diag(sums), 1e-300))
    unit = np.outer(scale, scale)
    return np.asarray(np.round(sums / unit, 7) * unit, dtype=np.float64)
