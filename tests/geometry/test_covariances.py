"""Covariances of poses: of independent points, of groups that are left out in turn, the larger."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.covariances import (
    AdjustedPoints,
    common_error,
    honest_covariance,
    widened,
)
from orthoflow.geometry.resection import SeenPoints, adjust, predicted_covariances

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
    # So small a sigma that nothing is widened but the spread counts: as large as it is over all
    # directions, with smaller differences between them than chance gives so few groups.
    found = honest_covariance(jacobian, residuals, cofactors, groups, sigma0=1e-6)
    white = np.linalg.inv(np.linalg.cholesky(cofactors))
    wanted, got = white @ spread @ white.T, white @ found @ white.T
    assert np.trace(got) == pytest.approx(np.trace(wanted), rel=1e-4)
    assert np.ptp(np.linalg.eigvalsh(got)) < np.ptp(np.linalg.eigvalsh(wanted))
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
    # Without a prior, only the last group sees the second unknown: left out, nothing does.
    jacobian = np.zeros((41, 2, 2))
    jacobian[:, 0, 0] = 1.0
    jacobian[40, 1, 1] = 1.0
    residuals = np.zeros((41, 2))
    residuals[:40, 0] = np.tile([1.0, -1.0], 20)
    cofactors = np.diag([1.0 / 41.0, 1.0])
    found = honest_covariance(jacobian, residuals, cofactors, np.arange(41), sigma0=0.5)
    # The mean of the others moves by a fortieth of what the group left out is off.
    np.testing.assert_allclose(found, np.diag([1.0 / 41.0, 0.25]), rtol=2e-3, atol=1e-12)


# Errors of places that neighbours share, drawn: Monte Carlo against what is stated.

VIEW = ViewingCamera(
    width=3000,
    height=2000,
    fx=2700.0,
    fy=2700.0,
    cx=1500.0,
    cy=1000.0,
    distortion=np.zeros(5),
    rotation=np.eye(3),
    translation=np.array([0.0, 0.0, 8.0]),
)


def drawn_resection(seed: int, sigma_m: float, length_m: float, n_seen: int) -> tuple[float, float]:
    """True and stated mean square, in pixels, of a camera over a wall 8 m away."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-4.0, -2.7, -1.0], [4.0, 2.7, 0.3], (n_seen, 3))
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    root = np.linalg.cholesky(np.exp(-apart / length_m) + 1e-9 * np.eye(n_seen))
    off = sigma_m * root @ rng.normal(size=(n_seen, 3))
    pixels = VIEW.project(points)[:, :2] + 0.3 * rng.normal(size=(n_seen, 2))
    seen = SeenPoints(
        pixels_photo=pixels,
        points_world=points + off,
        sigma_px=np.full(n_seen, 0.3),
        sigma_m=np.full(n_seen, 0.001),
    )
    cells = (pixels // 600).astype(int) @ [1, 10]
    found = adjust(seen, VIEW, groups=cells, soft_limit=3.0)
    x, y = np.meshgrid(np.linspace(-3.5, 3.5, 8), np.linspace(-2.2, 2.2, 6))
    wall = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    true = found.camera.project(wall)[:, :2] - VIEW.project(wall)[:, :2]
    stated = predicted_covariances(found, wall)
    return float((true**2).mean()), float(np.trace(stated, axis1=1, axis2=2).mean() / 2.0)


@pytest.mark.parametrize(
    ("sigma_m", "length_m", "n_seen", "least", "most"),
    [
        (0.0, 1.0, 250, 0.8, 1.25),
        (0.003, 0.2, 250, 0.8, 1.5),
        (0.005, 2.0, 250, 0.7, 1.4),
        (0.003, 4.0, 250, 0.65, 1.4),
        # Of so many points, some stand for the others.
        (0.005, 1.0, 900, 0.7, 1.4),
    ],
)
def test_what_neighbours_share_is_stated(
    sigma_m: float, length_m: float, n_seen: int, least: float, most: float
) -> None:
    """Stated over true: without the shared error 0.34 and 0.32 in the third and fourth."""
    draws = [drawn_resection(seed, sigma_m, length_m, n_seen) for seed in range(12)]
    true, stated = np.array(draws).T
    assert least < np.sqrt(stated.mean() / true.mean()) < most


N_PHOTOS = 4


def seen_by_four(seed: int, errors: NDArray[np.float64], places: NDArray[np.float64]) -> Any:
    """The same places in four photos, each shifted by two unknowns, with noise of one pixel."""
    rng = np.random.default_rng(seed)
    n = len(places)
    photo = np.repeat(np.arange(N_PHOTOS), n)
    # A kilopixel to the metre; of photos from other sides, depth pulls another way.
    by_place = np.zeros((N_PHOTOS, n, 2, 3))
    by_place[:, :, 0, 0] = by_place[:, :, 1, 1] = 1000.0
    by_place[:, :, 0, 2] = 1000.0 * np.linspace(-0.6, 0.6, N_PHOTOS)[:, None]
    by_place = by_place.reshape(-1, 2, 3)
    seen = np.einsum("nid,nd->ni", by_place, errors) + rng.normal(size=(N_PHOTOS * n, 2))
    jacobian = np.zeros((N_PHOTOS * n, 2, 2 * N_PHOTOS))
    for axis in range(2):
        jacobian[np.arange(N_PHOTOS * n), axis, 2 * photo + axis] = 1.0
    means = np.array([seen[photo == k].mean(axis=0) for k in range(N_PHOTOS)])
    return AdjustedPoints(
        photo=photo,
        places=np.tile(places, (N_PHOTOS, 1)),
        residuals=seen - means[photo],
        jacobian=jacobian,
        by_place=by_place,
        pulls=np.einsum("nip,nid->npd", jacobian, by_place),
        towards=np.tile([0.0, 0.0, 1.0], (N_PHOTOS * n, 1)),
        cofactors=np.eye(2 * N_PHOTOS) / n,
    )


def field(seed: int, places: NDArray[np.float64], length_m: float) -> NDArray[np.float64]:
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    root = np.linalg.cholesky(np.exp(-apart / length_m) + 1e-9 * np.eye(len(places)))
    return np.asarray(root @ np.random.default_rng(seed).normal(size=(len(places), 3)))


@pytest.mark.parametrize("kind", ["of_places_m", "of_depths_m", "of_photos_m"])
def test_a_shared_error_is_found_with_its_size_and_its_kind(kind: str) -> None:
    """Drawn with 2 mm over a twelfth of what a photo shows; found in the mean of eight draws."""
    found: dict[str, list[float]] = {"of_places_m": [], "of_depths_m": [], "of_photos_m": []}
    for seed in range(8):
        places = np.random.default_rng(seed).uniform([0.0, 0.0, 0.0], [6.0, 4.0, 0.2], (90, 3))
        # A twelfth of the 5.4 m between the outermost tenths.
        drawn = [field(100 * seed + k, places, 0.45) for k in range(N_PHOTOS)]
        errors = np.concatenate(drawn if kind == "of_photos_m" else [drawn[0]] * N_PHOTOS)
        if kind == "of_depths_m":
            errors = errors * [0.0, 0.0, 1.0]
        error = common_error(seen_by_four(seed, 0.002 * errors, places))
        for name, values in found.items():
            values.append(sum(sigma**2 for sigma in getattr(error, name)))
    sizes = {name: 1e3 * math.sqrt(float(np.mean(values))) for name, values in found.items()}
    assert sizes.pop(kind) == pytest.approx(2.0, rel=0.2)
    assert max(sizes.values()) < 1.0


def test_independent_errors_are_not_shared() -> None:
    places = np.random.default_rng(1).uniform([0.0, 0.0, 0.0], [6.0, 4.0, 0.2], (90, 3))
    found = [common_error(seen_by_four(seed, np.zeros((360, 3)), places)) for seed in range(12)]
    assert sum(error.is_any for error in found) <= 1
    assert np.mean([error.sigma_alone for error in found]) == pytest.approx(1.0, abs=0.03)
