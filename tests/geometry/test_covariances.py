"""Covariances of poses: of independent points, of groups that are left out in turn, the larger."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.geometry.covariances import honest_covariance, widened

N_FREE = 3


def observed(
    seed: int, n_points: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Derivatives, residuals of their adjustment with a weak prior, and its cofactors."""
    rng = np.random.default_rng(seed)
    jacobian = rng.normal(size=(n_points, 2, N_FREE))
    seen = rng.normal(size=(n_points, 2)) + 3.0 * rng.normal(size=(1, 2))
    flat = jacobian.reshape(-1, N_FREE)
    cofactors = np.linalg.inv(flat.T @ flat + 0.01 * np.eye(N_FREE))
    found = cofactors @ flat.T @ seen.ravel()
    return jacobian, seen - jacobian @ found, cofactors


def test_independent_points_have_the_covariance_of_their_adjustment() -> None:
    jacobian, residuals, cofactors = observed(1, 40)
    found = honest_covariance(jacobian, residuals, cofactors, None, sigma0=1.5)
    np.testing.assert_allclose(found, 2.25 * cofactors)
    # As many groups as there are unknowns tell nothing either.
    few = np.arange(40) % N_FREE
    found = honest_covariance(jacobian, residuals, cofactors, few, sigma0=1.5)
    np.testing.assert_allclose(found, 2.25 * cofactors)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("n_groups", [4, 9])
def test_groups_are_left_out_one_after_the_other(seed: int, n_groups: int) -> None:
    jacobian, residuals, cofactors = observed(seed, 60)
    # In no order, and called by any numbers.
    groups = np.random.default_rng(seed).permutation(np.arange(60) % n_groups) * 7 - 3
    moves = []
    for name in np.unique(groups):
        kept = (jacobian[groups != name]).reshape(-1, N_FREE)
        normal = kept.T @ kept + 0.01 * np.eye(N_FREE)
        # Adjusted anew to first order, from where all points put it.
        pull = kept.T @ residuals[groups != name].ravel()
        all_of = jacobian.reshape(-1, N_FREE).T @ residuals.ravel()
        moves.append(np.linalg.solve(normal, pull - all_of))
    spread = (n_groups - 1) / n_groups * np.array(moves).T @ np.array(moves)
    # So small a sigma that nothing is widened but the spread counts.
    found = honest_covariance(jacobian, residuals, cofactors, groups, sigma0=1e-6)
    np.testing.assert_allclose(found, spread, rtol=1e-4, atol=1e-9)
    # So large a one that the groups explain less.
    found = honest_covariance(jacobian, residuals, cofactors, groups, sigma0=1e3)
    np.testing.assert_allclose(found, 1e6 * cofactors, rtol=1e-9)


def test_the_larger_counts_in_each_direction() -> None:
    rng = np.random.default_rng(5)
    root = rng.normal(size=(4, 4))
    plain = root @ root.T + 0.1 * np.eye(4)
    np.testing.assert_allclose(widened(plain, 0.5 * plain), plain)
    np.testing.assert_allclose(widened(plain, 4.0 * plain), 4.0 * plain)
    np.testing.assert_allclose(
        widened(np.diag([1.0, 4.0, 9.0]), np.diag([2.0, 1.0, 9.0])), np.diag([2.0, 4.0, 9.0])
    )
    # In the axes in which the first is one, whatever those of the world are.
    lower = np.linalg.cholesky(plain)
    axes, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    shares = np.array([0.2, 0.9, 3.0, 5.0])
    spread = lower @ axes @ np.diag(shares) @ axes.T @ lower.T
    wanted = lower @ axes @ np.diag(np.maximum(shares, 1.0)) @ axes.T @ lower.T
    np.testing.assert_allclose(widened(plain, spread), wanted)


def test_a_covariance_that_rounding_left_without_a_root_is_widened_all_the_same() -> None:
    # Two unknowns that are as good as one, one of them known to a million of its units.
    sigmas = np.array([1e-3, 1e6, 2.0])
    correlation = np.array([[1.0, 1.0, 0.0], [1.0, 1.0 - 2e-16, 0.0], [0.0, 0.0, 1.0]])
    plain = correlation * np.outer(sigmas, sigmas)
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(plain)
    spread = np.diag([0.0, 0.0, 36.0])
    found = widened(plain, spread)
    np.testing.assert_allclose(np.sqrt(np.diag(found)), [1e-3, 1e6, 6.0], rtol=1e-6)
    np.testing.assert_allclose(found, found.T)
    np.testing.assert_allclose(found[0, 1], 1e3, rtol=1e-6)


def test_a_group_that_alone_fixes_an_unknown_leaves_it_where_it_is() -> None:
    # Without a prior, only the last of four groups sees the second unknown: left out, nothing does.
    jacobian = np.zeros((4, 2, 2))
    jacobian[:, 0, 0] = 1.0
    jacobian[3, 1, 1] = 1.0
    residuals = np.zeros((4, 2))
    residuals[:, 0] = [3.0, -1.0, -2.0, 0.0]
    cofactors = np.diag([0.25, 1.0])
    found = honest_covariance(jacobian, residuals, cofactors, np.arange(4), sigma0=0.5)
    # The mean of the other three moves by a third of what the group left out is off.
    moves = residuals[:, 0] / 3.0
    np.testing.assert_allclose(found, np.diag([0.75 * moves @ moves, 0.25]), atol=1e-12)
