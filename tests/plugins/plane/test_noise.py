"""Noise of a cloud, and tolerances that follow it: drawn walls and rooms of known noise."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.cloud import measure_noise
from orthoflow_plugins.plane.hough2d import Hough2d
from orthoflow_plugins.plane.hough3d import Hough3d
from orthoflow_plugins.plane.ransac import Ransac
from orthoflow_plugins.plane.region import Region

from orthoflow.products import Planes
from tests.long_loops import long_only
from tests.plane_scenes import cloud_of, detect, turned

every_detector = pytest.mark.parametrize("method", [Hough2d, Hough3d, Ransac, Region])
SIZE_M = np.array([5.0, 4.0, 2.8])


def wall(noise_m: float, n_points: int) -> NDArray[np.float64]:
    """One flat wall of 12 x 6 m, upright, with independent noise along its normal."""
    rng = np.random.default_rng(3)
    points = rng.uniform((0.0, 0.0, 0.0), (12.0, 0.0, 6.0), (n_points, 3))
    points[:, 1] = rng.normal(0.0, noise_m, n_points)
    return points


def waves(rng: np.random.Generator, places_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Errors (n,) that neighbours share, of standard deviation 1, over half metres and more."""
    total: NDArray[np.float64] = np.zeros(len(places_m))
    for _ in range(24):
        length_m, direction = rng.uniform(0.6, 3.0), rng.normal(size=places_m.shape[1])
        direction = direction / np.linalg.norm(direction)
        phase = rng.uniform(0.0, 2.0 * np.pi)
        total += np.cos(2.0 * np.pi * (places_m @ direction) / length_m + phase)
    return total / np.sqrt(12.0)


def room(rng: np.random.Generator, noise_m: float, shared_m: float) -> NDArray[np.float64]:
    """A box room turned at random: six surfaces, each with noise along its normal."""
    points = []
    for axis in range(3):
        for level in (0.0, SIZE_M[axis]):
            count = int(500 * np.prod(np.delete(SIZE_M, axis)))
            side = rng.uniform(0.0, 1.0, (count, 3)) * SIZE_M
            side[:, axis] = level + rng.normal(0.0, noise_m, count)
            side[:, axis] += shared_m * waves(rng, np.delete(side, axis, axis=1))
            points.append(side)
    return np.concatenate(points) @ turned(rng.uniform(0.0, 360.0)).T


def detected(method: Any, points: NDArray[np.float64], folder: Path) -> Planes:
    out, ctx = detect(method, cloud_of(points), folder, seed=5)
    planes: Planes = out.planes
    metrics = {metric.name: metric.value for metric in ctx.metrics}
    assert metrics["tolerance_m"] == planes.tolerance_m
    return planes


@pytest.mark.parametrize("noise_m", [0.001, 0.02])
def test_the_noise_of_a_flat_wall_is_measured(noise_m: float) -> None:
    found = measure_noise(wall(noise_m, 120_000))
    assert found == pytest.approx((noise_m, noise_m), rel=0.12)


def test_errors_that_neighbours_share_show_in_large_neighbourhoods() -> None:
    points = wall(0.002, 200_000)
    points[:, 1] += 0.015 * waves(np.random.default_rng(4), points[:, [0, 2]])
    found = measure_noise(points)
    assert found is not None
    single_m, shared_m = found
    assert single_m < 0.006
    assert shared_m > 0.004


def test_a_cloud_without_flat_places_has_no_measured_noise_and_a_clean_one_usual_tolerances(
    tmp_path: Path,
) -> None:
    assert measure_noise(np.random.default_rng(1).uniform(-2.0, 2.0, (30_000, 3))) is None
    assert measure_noise(np.zeros((3, 3))) is None
    planes = detected(Hough2d, room(np.random.default_rng(2), 0.002, 0.0), tmp_path)
    assert planes.tolerance_m == 0.05


@every_detector
def test_one_noisy_wall_is_found_at_defaults(method: type, tmp_path: Path) -> None:
    planes = detected(method, wall(0.02, 60_000), tmp_path)
    assert len(planes) == 1
    assert np.degrees(np.arccos(abs(planes.normal[0, 1]))) < 0.03
    assert abs(planes.offset[0]) < 0.0013


@pytest.mark.parametrize(
    ("noise_m", "shared_m"), [(0.025, 0.003), *long_only((0.005, 0.003), (0.01, 0.01))]
)
@every_detector
def test_walls_of_a_noisy_room_are_found_beside_denser_clutter(
    method: type, noise_m: float, shared_m: float, tmp_path: Path
) -> None:
    """A screen with 2 % of the points, a column and a sphere with 20 %: seven planes, no other."""
    rng = np.random.default_rng(7)
    walls = room(rng, noise_m, shared_m)
    middle = 0.5 * (walls.min(axis=0) + walls.max(axis=0))
    along, across = np.array([[0.8, 0.6, 0.0], [0.6, -0.8, 0.0]])
    place = middle + np.array([0.4, 0.5, -0.3])
    u, v = rng.uniform(-1.0, 1.0, (2, 1100, 1))
    screen = place + u * along + v * (0.0, 0.0, 1.0) + rng.normal(0.0, noise_m, (1100, 1)) * across
    rays = rng.normal(size=(4000, 3))
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    ball = middle - np.array([1.0, 0.4, 0.9]) + rays * rng.normal(0.4, noise_m, (4000, 1))
    turn = rng.uniform(0.0, 2.0 * np.pi, 8000)
    column = 0.3 * np.column_stack([np.cos(turn), np.sin(turn)]) + middle[:2] + [0.6, -1.0]
    column = np.column_stack([column, rng.uniform(0.0, SIZE_M[2], 8000)])
    column += rng.normal(0.0, noise_m, column.shape)
    planes = detected(method, np.concatenate([walls, screen, ball, column]), tmp_path)
    assert len(planes) == 7
    turned_deg = np.degrees(np.arccos(np.abs(planes.normal @ across)))
    assert np.any((turned_deg < 1.0) & (np.abs(planes.normal @ place - planes.offset) < 0.01))
