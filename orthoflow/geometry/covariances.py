"""Covariances that stay honest when observations err together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


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
