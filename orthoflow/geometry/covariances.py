"""Covariances that stay honest when observations err together."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

# Correlation lengths that are tried, and ends of the classes of distances between points, as shares
# of the extent of what a photo sees.
_LENGTHS: Final = (0.03, 0.08, 0.2, 0.5)
_DISTANCES: Final = (0.01, 0.02, 0.04, 0.08, 0.16, 0.32, 0.64)
# The products of all pairs of more points tell nothing new.
_MAX_POINTS: Final = 180
_MIN_POINTS: Final = 30
# An error is taken as shared where that explains the products so many times better; of independent
# errors it does for one photo in twenty (measured on 16 drawn photos of each kind: 1.0 to 1.4
# for independent errors, 2.0 to 5.7 for those that reach 1 to 4 m of 8 m).
_LEAST_GAIN: Final = 1.5


def honest_covariance(
    jacobian: NDArray[np.float64],
    residuals: NDArray[np.float64],
    cofactors: NDArray[np.float64],
    groups: NDArray[np.intp] | None,
    *,
    sigma0: float,
) -> NDArray[np.float64]:
    """Covariance that does not take points of one group as independent.

    The pose is adjusted, to first order, without each group in turn (delete-group jackknife: the
    CR3 estimate of Bell & McCaffrey 2002). Where the poses differ by more than the residuals
    explain, that is the covariance; nowhere is it smaller than what the residuals explain.

    Args:
        jacobian: (n, 2, p) derivatives of each point's two observations, in standard deviations.
        residuals: (n, 2) observed - computed, in standard deviations.
        cofactors: (p, p) inverse of the normal matrix, prior included.
        groups: (n,) group of each point, or None when all are independent.
        sigma0: standard deviation of unit weight.
    """
    plain = sigma0**2 * cofactors
    if groups is None:
        return plain
    names, group = np.unique(groups, return_inverse=True)
    n_free = len(plain)
    if names.size <= n_free:
        return plain
    order = np.argsort(group, kind="stable")
    starts = np.flatnonzero(np.diff(group[order], prepend=-1))
    jacobian, residuals = jacobian[order], residuals[order]
    pulls = np.add.reduceat(np.einsum("nij,ni->nj", jacobian, residuals), starts)
    normals = np.add.reduceat(np.einsum("nij,nik->njk", jacobian, jacobian), starts)
    left_out = _inverses(np.eye(n_free) - normals @ cofactors) @ pulls[:, :, None]
    moves = (cofactors @ left_out)[:, :, 0]
    return widened(plain, (names.size - 1) / names.size * moves.T @ moves)


@dataclass(frozen=True, kw_only=True)
class AdjustedPoints:
    """Points of one photo after its adjustment, whose places in the world may err together.

    Attributes:
        places: (n, 3) metres.
        residuals: (n, 2) observed - computed, in standard deviations.
        jacobian: (n, 2, p) derivatives by the unknowns, in standard deviations.
        by_place: (n, 2, 3) derivatives by the place, standard deviations per metre.
        cofactors: (p, p) of these unknowns in the inverse of the whole normal matrix.
        weight: for how many points of the adjustment each stands.
    """

    places: NDArray[np.float64]
    residuals: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    by_place: NDArray[np.float64]
    cofactors: NDArray[np.float64]
    weight: float = 1.0

    def thinned(self) -> AdjustedPoints:
        """Return points spread evenly over all, as many as tell how they err together."""
        n_points = len(self.places)
        chosen = np.unique(np.linspace(0, n_points - 1, min(n_points, _MAX_POINTS)).astype(int))
        return AdjustedPoints(
            places=self.places[chosen],
            residuals=self.residuals[chosen],
            jacobian=self.jacobian[chosen],
            by_place=self.by_place[chosen],
            cofactors=self.cofactors,
            weight=n_points / len(chosen),
        )


@dataclass(frozen=True, kw_only=True)
class CommonError:
    """An error of places that neighbours share: a sum of parts that reach differently far.

    Attributes:
        sigmas_m: of each coordinate, of each part; none where points err independently.
        lengths_m: of each part, whose correlation is exp(-distance / length).
        sigma_alone: what is left to each observation alone, in its standard deviations.
    """

    sigmas_m: tuple[float, ...] = ()
    lengths_m: tuple[float, ...] = ()
    sigma_alone: float

    @property
    def sigma_m(self) -> float:
        """Standard deviation of each coordinate of all parts together."""
        return math.hypot(*self.sigmas_m)

    def covariance(
        self, places: NDArray[np.float64], others: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the covariance (n, m) in square metres of the errors at two sets of places."""
        distances_m = _distances(places, others)
        total = np.zeros_like(distances_m)
        for sigma_m, length_m in zip(self.sigmas_m, self.lengths_m, strict=True):
            if sigma_m:
                total += sigma_m**2 * np.exp(-distances_m / length_m)
        return total


def common_error(photos: Sequence[AdjustedPoints]) -> CommonError:
    """Estimate the error that neighbouring points share from the products of their residuals.

    An adjustment takes up a part of such an error, the more the longer it reaches; expected
    products are those of residuals after that. Sums of products of pairs within classes of
    distances are explained by those of independent errors and of shared ones of each length (a
    variogram by moments; Cressie 1993, Statistics for spatial data, 2.6).
    """
    parts = [part.thinned() for part in photos if len(part.places) >= _MIN_POINTS]
    if not parts:
        return CommonError(sigma_alone=1.0)
    extents = [np.linalg.norm(part.places - part.places.mean(axis=0), axis=1) for part in parts]
    extent_m = 2.0 * float(np.median([np.percentile(each, 90) for each in extents]))
    n_classes = len(_DISTANCES) + 1
    counts, found, alone = (np.zeros(n_classes) for _ in range(3))
    shared = np.zeros((len(_LENGTHS), n_classes))
    for part in parts:
        n_points, n_free = len(part.places), part.cofactors.shape[0]
        flat = part.jacobian.reshape(-1, n_free)
        taken_up = flat @ part.cofactors @ flat.T
        # Of an error of its own, each point takes up what it does alone; of a shared one, as much
        # as all the points for which it stands.
        left_alone = np.eye(2 * n_points) - taken_up
        left = np.eye(2 * n_points) - part.weight * taken_up
        distance_m = _distances(part.places, part.places)
        # The first class is each point with itself.
        kind = np.digitize(distance_m / extent_m, _DISTANCES)
        kind += 1
        np.fill_diagonal(kind, 0)
        kind = np.where(kind >= n_classes, -1, kind)

        counts += _by_class(kind, np.ones_like(distance_m))
        found += _by_class(kind, part.residuals @ part.residuals.T)
        alone += _by_class(kind, _traces(left_alone))
        same = np.einsum("iad,jbd->iajb", part.by_place, part.by_place)
        for nth, share in enumerate(_LENGTHS):
            correlation = np.exp(-distance_m / (share * extent_m))
            errors = (same * correlation[:, None, :, None]).reshape(2 * n_points, 2 * n_points)
            shared[nth] += _by_class(kind, _traces(left @ errors @ left))
    weights = 1.0 / np.sqrt(np.maximum(counts, 1.0))
    # Each point with itself says as much as all the others.
    weights[0] *= math.sqrt(n_classes)
    return _fitted_error(found * weights, alone * weights, shared * weights, extent_m)


def _by_class(kind: NDArray[np.intp], products: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums of products of pairs by their class; -1 is none."""
    known = kind >= 0
    sums = np.bincount(kind[known], weights=products[known], minlength=len(_DISTANCES) + 1)
    return np.asarray(sums, dtype=np.float64)


def _fitted_error(
    found: NDArray[np.float64],
    alone: NDArray[np.float64],
    shared: NDArray[np.float64],
    extent_m: float,
) -> CommonError:
    from scipy.optimize import nnls  # noqa: PLC0415 - most who load this module adjust nothing

    own = max(0.0, float(found @ alone) / max(float(alone @ alone), 1e-300))
    off = float(np.linalg.norm(found - own * alone))
    scales = np.maximum(np.linalg.norm(shared, axis=1), 1e-300) / np.linalg.norm(alone)
    (rest, *common), left = nnls(np.column_stack([alone, (shared / scales[:, None]).T]), found)
    variances = np.array(common) / scales
    if left * _LEAST_GAIN > off or not variances.any():
        return CommonError(sigma_alone=math.sqrt(own))
    # Rounded: what comes behind must not hang on the order of sums.
    return CommonError(
        sigmas_m=tuple(float(f"{math.sqrt(variance):.4g}") for variance in variances),
        lengths_m=tuple(float(f"{share * extent_m:.4g}") for share in _LENGTHS),
        sigma_alone=float(f"{math.sqrt(rest):.4g}"),
    )


def _distances(places: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.linalg.norm(places[:, None] - others[None], axis=2), dtype=np.float64)


def _traces(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Traces (n, n) of the 2 x 2 blocks of a matrix (2 n, 2 n)."""
    return np.asarray(matrix[::2, ::2] + matrix[1::2, 1::2], dtype=np.float64)


def with_common_error(
    covariance: NDArray[np.float64], points: AdjustedPoints, error: CommonError
) -> NDArray[np.float64]:
    """Widen the covariance (p, p) of one photo by the error that its points share."""
    if not error.sigma_m:
        return covariance
    some = points.thinned()
    pulls = np.einsum("nip,nid->npd", some.jacobian, some.by_place)
    together = error.covariance(some.places, some.places)
    shared = np.einsum("npd,nqd->pq", pulls, np.einsum("nm,mqd->nqd", together, pulls))
    move = some.weight * points.cofactors
    spread = error.sigma_alone**2 * points.cofactors + move @ stable(shared) @ move.T
    return widened(covariance, spread)


def stable(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """Round sums (p, p) so that the number of threads that BLAS took does not show."""
    scale = np.sqrt(np.maximum(np.diag(sums), 1e-300))
    unit = np.outer(scale, scale)
    return np.asarray(np.round(sums / unit, 7) * unit, dtype=np.float64)


def _inverses(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverses (n, p, p); pseudo-inverses where a group alone fixes a parameter."""
    try:
        return np.asarray(np.linalg.inv(matrices), dtype=np.float64)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.pinv(matrices), dtype=np.float64)


def widened(plain: NDArray[np.float64], spread: NDArray[np.float64]) -> NDArray[np.float64]:
    """Give the larger of two covariances (p, p), along each axis in which the first is one."""
    root = _root(plain)
    inverse = np.linalg.inv(root)
    values, axes = np.linalg.eigh(inverse @ spread @ inverse.T)
    widened = root @ axes * np.sqrt(np.maximum(values, 1.0))
    result: NDArray[np.float64] = widened @ widened.T
    return result


def _root(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Give R (p, p) with R R' the covariance, or a little more where rounding left it none."""
    try:
        return np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
    except np.linalg.LinAlgError:
        # Some unknowns are hardly determined: their variances dwarf the others.
        sigmas = np.sqrt(np.diag(covariance))
        values, axes = np.linalg.eigh(covariance / np.outer(sigmas, sigmas))
        least = len(values) * np.finfo(np.float64).eps * values[-1]
        root = sigmas[:, None] * axes * np.sqrt(np.maximum(values, least))
        return np.asarray(root, dtype=np.float64)
