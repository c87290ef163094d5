"""Covariances that remain valid when observations have common errors."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

# The correlation lengths that are tried, as shares of the extent of what a photo sees. Long-range
# errors are absorbed by the pose and leave almost no trace in the residuals, but errors of
# registration, of a scanner path or of stereo do not end where residuals cease to show them.
_PARTS: Final = ((0.03,), (0.1,), (0.25, 0.6, 1.2))
# Products of pairs of more points add no information.
_MAX_POINTS: Final = 280
_MIN_POINTS: Final = 30
# An error counts as common if it is this many times larger than chance makes it for independent
# errors.
_MIN_SIGNIFICANCE: Final = 5.0
# Kinds of errors whose explanations differ by less than this are not distinguished.
_MIN_OWN_SHARE: Final = 0.02


def honest_covariance(
    jacobian: NDArray[np.float64],
    residuals: NDArray[np.float64],
    cofactors: NDArray[np.float64],
    groups: NDArray[np.intp] | None,
    *,
    sigma0: float,
) -> NDArray[np.float64]:
    """Return a covariance that does not treat the points of a group as independent.

    The pose is adjusted, to first order, without each group in turn (delete-group jackknife: the
    CR3 estimate of Bell & McCaffrey 2002). If these poses differ by more than the residuals
    explain, their scatter is the covariance; it is never smaller than what the residuals explain.

    Args:
        jacobian: (n, 2, p) derivatives of each point's two observations, in standard deviations.
        residuals: (n, 2) observed - computed, in standard deviations.
        cofactors: (p, p) inverse of the normal matrix, prior included.
        groups: (n,) group of each point, or None if all are independent.
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
    return widened_by_moves(plain, moves)


@dataclass(frozen=True, kw_only=True)
class AdjustedPoints:
    """Points of photos after their adjustment, whose world positions may have common errors.

    Attributes:
        photo: (n,) index of the photo that sees each point.
        places: (n, 3) metres.
        residuals: (n, 2) observed - computed, in standard deviations.
        jacobian: (n, 2, p) derivatives by the unknowns, in standard deviations.
        by_place: (n, 2, 3) derivatives by the place, standard deviations per metre.
        pulls: (n, p, 3) effect of an error of the position on the normal equations, per metre.
        towards: (n, 3) unit vectors out of the surface: errors of a cloud are largest in depth.
        cofactors: (p, p) inverse of the normal matrix.
        weight: number of points of the adjustment that each point represents.
    """

    photo: NDArray[np.intp]
    places: NDArray[np.float64]
    residuals: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    by_place: NDArray[np.float64]
    pulls: NDArray[np.float64]
    towards: NDArray[np.float64]
    cofactors: NDArray[np.float64]
    weight: float = 1.0

    def thinned(self) -> AdjustedPoints:
        """Return evenly spread points, as many as the estimate of common errors needs."""
        n_points = len(self.places)
        chosen = np.unique(np.linspace(0, n_points - 1, min(n_points, _MAX_POINTS)).astype(int))
        return AdjustedPoints(
            photo=self.photo[chosen],
            places=self.places[chosen],
            residuals=self.residuals[chosen],
            jacobian=self.jacobian[chosen],
            by_place=self.by_place[chosen],
            pulls=self.pulls[chosen],
            towards=self.towards[chosen],
            cofactors=self.cofactors,
            weight=n_points / len(chosen),
        )

    @property
    def extent_m(self) -> float:
        """Return the extent of the points of a photo, median over the photos."""
        reaches = []
        for photo in np.unique(self.photo):
            mine = self.places[self.photo == photo]
            reach = np.linalg.norm(mine - mine.mean(axis=0), axis=1)
            reaches.append(float(np.percentile(reach, 90)))
        return 2.0 * float(np.median(reaches))


@dataclass(frozen=True, kw_only=True)
class CommonError:
    """An error common to neighbouring points: a sum of parts with different correlation lengths.

    Attributes:
        of_places_m: standard deviation of each coordinate of a position, common to all photos, for
            each part; empty if points have independent errors.
        of_depths_m: additional standard deviation of depth.
        of_photos_m: standard deviation of what only the points of one photo have in common, e.g.
            from its lens or its matching.
        lengths_m: correlation lengths of the parts; the correlation is the sum of exp(-distance /
            length).
        sigma_alone: standard deviation of the independent error of each observation, in units of
            its stated one.
    """

    of_places_m: tuple[float, ...] = ()
    of_depths_m: tuple[float, ...] = ()
    of_photos_m: tuple[float, ...] = ()
    lengths_m: tuple[tuple[float, ...], ...] = ()
    sigma_alone: float

    @property
    def is_any(self) -> bool:
        """Whether points have a common error at all."""
        return any(self.of_places_m + self.of_depths_m + self.of_photos_m)


def common_error(points: AdjustedPoints) -> CommonError:
    """Estimate the common error of neighbouring points from the products of their residuals.

    An adjustment absorbs a part of such an error; the part grows with the correlation length and
    with the number of photos that see the same places. Expected products are therefore those of
    residuals after the adjustment. The products of all pairs, also of points in different photos,
    are explained by independent errors and by common ones of each kind and length (least squares of
    variance components, MINQUE: Rao 1971, doi:10.1016/0047-259X(71)90001-7).
    """
    from scipy.optimize import nnls  # noqa: PLC0415 - most who load this module adjust nothing

    if len(points.places) < _MIN_POINTS:
        return CommonError(sigma_alone=1.0)
    some, extent_m = points.thinned(), points.extent_m
    flat = some.jacobian.reshape(-1, some.jacobian.shape[2])
    moved = flat @ some.cofactors
    # A point absorbs its own share of an independent error, and of a common error as much as all
    # points that it represents.
    expected = [np.eye(len(flat)) - moved @ flat.T]
    moved *= some.weight
    for directions, correlations in _kinds(some, [np.multiply(part, extent_m) for part in _PARTS]):
        products = sum(np.outer(by, by) for by, _ in directions)
        for correlation in correlations:
            errors = products * np.repeat(np.repeat(correlation, 2, 0), 2, 1)
            taken_up = (
                sum(by[:, None] * np.repeat(correlation @ pulls, 2, 0) for by, pulls in directions)
                @ moved.T
            )
            errors += moved @ _sum_over(directions, correlation) @ moved.T
            expected.append(errors - taken_up - taken_up.T)
    layers = np.array([layer.ravel() for layer in expected])
    scales = np.maximum(np.linalg.norm(layers, axis=1), 1e-300)
    layers /= scales[:, None]
    residuals = some.residuals.ravel()
    normal, right = layers @ layers.T, layers @ np.outer(residuals, residuals).ravel()
    # An error that does not exist is estimated with at most this deviation.
    chance = math.sqrt(2.0) * float(residuals @ residuals) / len(residuals)
    taken = [0]
    while True:
        # Added one at a time while each explains more than chance does: fitted together, errors
        # that do not exist would take shares of the others.
        solved = np.linalg.solve(normal[np.ix_(taken, taken)], normal[taken])
        left = np.maximum(1.0 - (normal[taken] * solved).sum(axis=0), 1e-9)
        found = (right - right[taken] @ solved) / np.sqrt(left)
        found[[*taken, *np.flatnonzero(left < _MIN_OWN_SHARE)]] = 0.0
        best = int(found.argmax())
        if found[best] <= _MIN_SIGNIFICANCE * chance:
            break
        taken.append(best)
    root = np.linalg.cholesky(normal[np.ix_(taken, taken)])
    variances = np.zeros(len(layers))
    variances[taken] = nnls(root.T, np.linalg.solve(root, right[taken]))[0]
    variances /= scales
    if not variances[1:].any():
        return CommonError(sigma_alone=math.sqrt(variances[0]))
    # Rounded, so that later results do not depend on the order of summation.
    alone, *sigmas = (float(f"{sigma:.4g}") for sigma in np.sqrt(variances))
    n = len(_PARTS)
    return CommonError(
        of_places_m=tuple(sigmas[:n]),
        of_depths_m=tuple(sigmas[n : 2 * n]),
        of_photos_m=tuple(sigmas[2 * n :]) or (0.0,) * n,
        lengths_m=tuple(tuple(length * extent_m for length in lengths) for lengths in _PARTS),
        sigma_alone=alone,
    )


def outwards(places: NDArray[np.float64], centre: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the normal (3,) of the plane that fits positions best, towards a camera."""
    middle = places.mean(axis=0)
    across = np.linalg.svd(places - middle, full_matrices=False)[2][2]
    return np.asarray(across if (centre - middle) @ across > 0.0 else -across)


def with_common_error(
    covariance: NDArray[np.float64], points: AdjustedPoints
) -> NDArray[np.float64]:
    """Widen the covariance (p, p) of an adjustment by the common error of its points."""
    error = common_error(points)
    if not error.is_any:
        return covariance
    some, shared = points.thinned(), np.zeros_like(covariance)
    sigmas_m = (error.of_places_m, error.of_depths_m, error.of_photos_m)
    for of_kind_m, (directions, correlations) in zip(
        sigmas_m, _kinds(some, error.lengths_m), strict=False
    ):
        for sigma_m, correlation in zip(of_kind_m, correlations, strict=True):
            if sigma_m:
                shared += sigma_m**2 * _sum_over(directions, correlation)
    move = some.weight * points.cofactors
    spread = error.sigma_alone**2 * points.cofactors + move @ stable(shared) @ move.T
    return widened(covariance, spread)


_Direction = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Derivatives (2 n,) of observations by errors along it, and their pulls (n, p)."""


def _kinds(
    some: AdjustedPoints, lengths_m: Sequence[Sequence[float] | NDArray[np.float64]]
) -> Iterator[tuple[list[_Direction], list[NDArray[np.float64]]]]:
    """Return the directions of each kind of common error, and its correlations (n, n) by part."""
    apart_m = np.linalg.norm(some.places[:, None] - some.places, axis=2)
    correlations = [
        np.sum([np.exp(-apart_m / length_m) for length_m in part], axis=0) for part in lengths_m
    ]
    axes = [(some.by_place[:, :, axis].ravel(), some.pulls[:, :, axis]) for axis in range(3)]
    along = np.einsum("nid,nd->ni", some.by_place, some.towards).ravel()
    yield axes, correlations
    yield [(along, np.einsum("npd,nd->np", some.pulls, some.towards))], correlations
    is_one = some.photo[:, None] == some.photo
    if not is_one.all():
        yield axes, [correlation * is_one for correlation in correlations]


def _sum_over(
    directions: Sequence[_Direction], correlation: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the covariance (p, p) of the sum of all pulls, each times an error of one metre."""
    return np.asarray(sum(pulls.T @ correlation @ pulls for _, pulls in directions))


def stable(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """Round sums (p, p) so that they do not depend on the number of threads of BLAS."""
    scale = np.sqrt(np.maximum(np.diag(sums), 1e-300))
    unit = np.outer(scale, scale)
    return np.asarray(np.round(sums / unit, 7) * unit, dtype=np.float64)


def _inverses(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return inverses (n, p, p); pseudo-inverses where a single group determines a parameter."""
    try:
        return np.asarray(np.linalg.inv(matrices), dtype=np.float64)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.pinv(matrices), dtype=np.float64)


def widened_by_moves(plain: NDArray[np.float64], moves: NDArray[np.float64]) -> NDArray[np.float64]:
    """Widen a covariance (p, p) by what leaving out each of some groups changes (g, p).

    Of few groups and many unknowns the largest spread is far too large and the smallest far too
    small by chance, so that the larger of two covariances is too large along most axes even where
    nothing errs together. Spreads are drawn towards their mean by the share of their differences
    that chance explains (Ledoit & Wolf 2004, doi:10.1016/S0047-259X(03)00096-4).
    """
    n, p = moves.shape
    root = _root(plain)
    white = math.sqrt((n - 1) / n) * moves @ np.linalg.inv(root).T
    spread = white.T @ white
    mean = np.trace(spread) / p * np.eye(p)
    differences = float(((spread - mean) ** 2).sum())
    of_chance = float(((white**2).sum(axis=1) ** 2).sum() - (spread**2).sum() / n)
    kept = max(0.0, 1.0 - of_chance / differences) if differences > 0.0 else 0.0
    return widened(plain, root @ (mean + kept * (spread - mean)) @ root.T)


def widened(plain: NDArray[np.float64], spread: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the larger of two covariances (p, p) along each axis that whitens the first."""
    root = _root(plain)
    inverse = np.linalg.inv(root)
    values, axes = np.linalg.eigh(inverse @ spread @ inverse.T)
    widened = root @ axes * np.sqrt(np.maximum(values, 1.0))
    result: NDArray[np.float64] = widened @ widened.T
    return result


def _root(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return R (p, p) with R R' the covariance, enlarged if rounding made it indefinite."""
    try:
        return np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
    except np.linalg.LinAlgError:
        # Some unknowns are poorly determined: their variances dwarf the others.
        sigmas = np.sqrt(np.diag(covariance))
        values, axes = np.linalg.eigh(covariance / np.outer(sigmas, sigmas))
        least = len(values) * np.finfo(np.float64).eps * values[-1]
        root = sigmas[:, None] * axes * np.sqrt(np.maximum(values, least))
        return np.asarray(root, dtype=np.float64)
