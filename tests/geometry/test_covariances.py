"""Covariances of poses whose points err together, against the scatter of drawn errors."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Final

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.geometry.covariances import AdjustedPoints, honest_covariance
from orthoflow.geometry.resection import adjust, predicted_covariances
from tests import samples
from tests.long_loops import long_only

LENS: Final = {
    "width": 3000,
    "height": 2000,
    "fx": 2700.0,
    "fy": 2700.0,
    "cx": 1500.0,
    "cy": 1000.0,
}
VIEW: Final = samples.camera(np.eye(3), np.array([0.0, 0.0, -8.0]), **LENS)


Draw = Callable[[NDArray[np.float64], np.random.Generator], NDArray[np.float64]]


def rough(sigma_m: float, length_m: float) -> Draw:
    """Errors (n, 3) of places with an exponential correlation."""

    def drawn(places: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        apart = np.linalg.norm(places[:, None] - places, axis=2)
        root = np.linalg.cholesky(np.exp(-apart / length_m) + 1e-9 * np.eye(len(places)))
        return np.asarray(sigma_m * root @ rng.normal(size=(len(places), 3)))

    return drawn


def smooth(sigma_m: float, length_m: float) -> Draw:
    """The same with a Gaussian correlation, as sums of waves."""

    def drawn(places: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        ways, phases = rng.normal(size=(60, 3, 3)) / length_m, rng.uniform(0.0, 2 * np.pi, (60, 3))
        waves = np.cos(np.einsum("nd,wkd->nwk", places, ways) + phases)
        return np.asarray(sigma_m * math.sqrt(2.0 / 60.0) * waves.sum(axis=1))

    return drawn


def registered(sigma_m: float, edges: tuple[float, ...] = (-1.3, 1.3)) -> Draw:
    """Scans side by side, each with a shift and a turn of its own."""

    def drawn(places: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        scan = np.digitize(places[:, 0] + rng.uniform(-0.5, 0.5), edges)
        shifts, turns = rng.normal(size=(2, 3, 3)) * [[[sigma_m]], [[0.2 * sigma_m]]]
        return np.asarray(shifts[scan] + np.cross(turns[scan], places))

    return drawn


def bent(sigma_m: float) -> Draw:
    """A parabola along the wall, as by drift along a path."""

    def drawn(places: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        along = ((places[:, 0] - rng.uniform(-2.0, 2.0)) / 4.0) ** 2
        return np.asarray(sigma_m * along[:, None] * rng.normal(size=3) * [0.0, 1.0, 1.0])

    return drawn


def drawn_resection(
    seed: int, error: Draw, n_seen: int, measured: float | None = None
) -> tuple[float, float]:
    """True and stated mean square, in pixels, of a camera over a wall 8 m away.

    The true one is without the shift of all places, which nothing in the photo can show. The errors
    may have been measured: this share is known, and the rest has a known pattern.
    """
    rng = np.random.default_rng(seed)
    points = rng.uniform([-4.0, -2.7, -1.0], [4.0, 2.7, 0.3], (n_seen, 3))
    off = error(points, rng)
    pixels = VIEW.project(points)[:, :2] + 0.3 * rng.normal(size=(n_seen, 2))
    seen = samples.seen(pixels, points + off - off.mean(axis=0), 0.3, 0.001)
    if measured is not None:
        patterns = np.stack([measured * off, (1.0 - measured) * off], axis=2)
        seen = replace(seen, scan_errors=patterns)
    found = adjust(seen, VIEW, independent=False, soft_limit=3.0)
    x, y = np.meshgrid(np.linspace(-3.5, 3.5, 8), np.linspace(-2.2, 2.2, 6))
    wall = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    true = found.camera.project(wall)[:, :2] - VIEW.project(wall)[:, :2]
    stated = predicted_covariances(found, wall)
    return float((true**2).mean()), float(np.trace(stated, axis1=1, axis2=2).mean() / 2.0)


DRAWN: Final[dict[str, tuple[Draw, int]]] = {
    "independent": (rough(0.0, 1.0), 250),
    "independent, many points": (rough(0.0, 1.0), 1500),
    "rough": (rough(0.003, 0.3), 250),
    "rough and wide": (rough(0.005, 2.0), 250),
    "rough, many points": (rough(0.005, 1.0), 900),
    "stereo": (smooth(0.004, 0.5), 250),
    "smooth and wide": (smooth(0.004, 3.0), 250),
    "registration": (registered(0.003), 250),
    "bending": (bent(0.006), 250),
    "short": (smooth(0.02, 0.4), 900),
}
# Limits of stated over true.
LIMITS: Final = {"smooth and wide": (0.75, 1.5), "short": (0.85, 1.25)}


@pytest.mark.parametrize(
    "name", [*LIMITS, *long_only(*(name for name in DRAWN if name not in LIMITS))]
)
def test_what_neighbours_share_is_stated(name: str) -> None:
    """Stated over true of each kind of error.

    The residuals of a photo hardly show tilts between scans side by side, but their overlaps do.
    """
    (error, n_seen), (low, high) = DRAWN[name], LIMITS.get(name, (0.7, 1.5))
    measured = 0.9 if name == "registration" else None
    draws = [drawn_resection(n, error, n_seen, measured) for n in range(8)]
    true, stated = np.array(draws).T
    assert low < math.sqrt(stated.mean() / true.mean()) < high


def test_measured_errors_of_scans_are_stated_as_they_are() -> None:
    """Of single draws, whose errors vary; without the measurement, half of them is stated.

    A turn of the whole wall leaves no residuals.
    """
    errors = (registered(0.003), 0.9), (registered(0.003), 0.0), (registered(0.003, ()), 0.0)
    for seed, (error, measured) in product(range(3), errors):
        true, stated = drawn_resection(seed, error, 250, measured)
        assert 0.8 < math.sqrt(stated / true) < 1.25


def test_no_common_error_switches_from_nothing_to_all_of_it() -> None:
    """Of one draw that is enlarged in steps of 0.06 mm, where the residuals begin to show it."""
    sizes_m = np.linspace(0.00045, 0.00081, 7)
    stated = np.sqrt([drawn_resection(3, rough(sigma_m, 0.5), 200)[1] for sigma_m in sizes_m])
    assert (stated[1:] / stated[:-1] < 1.4).all()
    assert stated[-1] > 1.3 * stated[0]


N_PHOTOS: Final = 4


def stretched_photos(
    rng: np.random.Generator, errors: NDArray[np.float64], places: NDArray[np.float64]
) -> AdjustedPoints:
    """The same places in four photos, each shifted and stretched, with noise of one pixel."""
    n = len(places)
    photo = np.repeat(np.arange(N_PHOTOS), n)
    # A kilopixel to the metre; of photos from other sides, depth pulls another way.
    by_photo = np.zeros((N_PHOTOS, 2, 3))
    by_photo[:, 0, 0] = by_photo[:, 1, 1] = 1000.0
    by_photo[:, 0, 2] = 1000.0 * np.linspace(-0.6, 0.6, N_PHOTOS)
    jacobian = np.zeros((N_PHOTOS * n, 2, 4 * N_PHOTOS))
    follows = np.zeros((N_PHOTOS, 4 * N_PHOTOS, 3))
    off_centre = np.tile(places - places.mean(axis=0), (N_PHOTOS, 1))
    for axis in range(2):
        jacobian[np.arange(N_PHOTOS * n), axis, 4 * photo + axis] = 1.0
        jacobian[np.arange(N_PHOTOS * n), axis, 4 * photo + 2 + axis] = off_centre[:, axis]
        follows[np.arange(N_PHOTOS), 4 * np.arange(N_PHOTOS) + axis] = by_photo[:, axis]
    rows = jacobian.reshape(-1, 4 * N_PHOTOS)
    cofactors = np.linalg.inv(rows.T @ rows)
    seen = np.einsum("nid,nd->ni", by_photo[photo], errors) + rng.normal(size=(N_PHOTOS * n, 2))
    return AdjustedPoints(
        photo=photo,
        places=np.tile(places, (N_PHOTOS, 1)),
        residuals=seen - (rows @ (cofactors @ (rows.T @ seen.ravel()))).reshape(-1, 2),
        jacobian=jacobian,
        by_place=by_photo[photo],
        pulls=np.einsum("nip,nid->npd", jacobian, by_photo[photo]),
        follows=follows,
        towards=np.tile([0.0, 0.0, 1.0], (N_PHOTOS * n, 1)),
        cofactors=cofactors,
    )


@pytest.mark.parametrize("shared_by", ["depths", *long_only("places", "photos")])
def test_photos_share_the_errors_of_places_but_not_their_own(shared_by: str) -> None:
    """Their stretches, correlated between photos as those of drawn errors scatter."""
    covariances, stretches = [], []
    among = np.array([0.0, 0.0, 1.0]) if shared_by == "depths" else np.ones(3)
    rng = np.random.default_rng(0)
    places = rng.uniform([0.0, 0.0, 0.0], [6.0, 4.0, 0.2], (90, 3))
    for nth in range(60):
        fields = [rough(0.002, 0.9)(places, rng) for _ in range(N_PHOTOS)]
        errors = np.concatenate(fields if shared_by == "photos" else [fields[0]] * N_PHOTOS)
        points = stretched_photos(rng, errors * among, places)
        noise = np.linalg.cholesky(points.cofactors) @ rng.normal(size=4 * N_PHOTOS)
        pulled = np.einsum("npd,nd->p", points.pulls, errors * among)
        stretches.append((points.cofactors @ pulled + noise).reshape(N_PHOTOS, 4)[:, 2:].ravel())
        if nth < 3:
            stretch = np.flatnonzero(np.arange(4 * N_PHOTOS) % 4 >= 2)
            covariances.append(honest_covariance(points, 1.0)[np.ix_(stretch, stretch)])
    stated, true = (
        np.mean(covariances, axis=0),
        np.mean([np.outer(one, one) for one in stretches], axis=0),
    )
    # Depths alone leave less behind, so that more of what is known beforehand remains.
    most = 2.0 if shared_by == "depths" else 1.5
    assert 0.7 < math.sqrt(np.trace(stated) / np.trace(true)) < most
    # Of the first and the last photo, down the picture.
    correlation = stated[1, 7] / math.sqrt(stated[1, 1] * stated[7, 7])
    assert (correlation > 0.4) == (shared_by == "places")


@pytest.mark.parametrize(("n_points", "sigma0"), [(3, 1.7), (40, 0.0)])
def test_points_without_redundancy_count_as_independent(n_points: int, sigma0: float) -> None:
    rng = np.random.default_rng(5)
    jacobian = rng.normal(size=(n_points, 2, 6))
    flat = jacobian.reshape(-1, 6)
    points = AdjustedPoints(
        photo=np.zeros(n_points, dtype=np.intp),
        places=rng.uniform(-2.0, 2.0, (n_points, 3)),
        residuals=np.zeros((n_points, 2)),
        jacobian=jacobian,
        by_place=rng.normal(size=(n_points, 2, 3)) * 1e3,
        pulls=rng.normal(size=(n_points, 6, 3)) * 1e3,
        follows=np.zeros((1, 6, 3)),
        towards=np.tile([0.0, 0.0, 1.0], (n_points, 1)),
        cofactors=np.linalg.inv(flat.T @ flat),
    )
    independent = sigma0**2 * points.cofactors
    np.testing.assert_allclose(honest_covariance(points, sigma0), independent, atol=1e-12)
    if n_points == 3:
        # No residual shows the errors of scans.
        errors = rng.normal(0.0, 1e-3, (n_points, 3, 2))
        moved = points.cofactors @ np.einsum("npd,ndq->pq", points.pulls, errors)
        stated = honest_covariance(replace(points, scan_errors=errors), sigma0)
        np.testing.assert_allclose(stated, independent + moved @ moved.T, rtol=1e-6)
