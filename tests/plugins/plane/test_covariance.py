"""Stated uncertainty of planes: what is said must be what happens, over many walls and rooms."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.fit import adjust_plane, independent_covariance
from orthoflow_plugins.plane.kernels import STEPS_PER_TOLERANCE
from orthoflow_plugins.plane.ransac import Ransac
from orthoflow_plugins.plane.support import CellSums, SurfaceRaster
from scipy import ndimage

from orthoflow.geometry import Plane, wall_axes
from orthoflow.products import Planes
from tests.plane_scenes import context
from tests.random_rooms import random_room

FIT_M = 0.015
UP = np.array([0.0, 0.0, 1.0])
# What stated and true errors may differ by, over many trials.
CALIBRATED = (0.7, 1.4)


def wall_of_cells(
    seed: int, *, reach_cells: float, relief_m: float, mixed_share: float = 0.0
) -> tuple[SurfaceRaster, CellSums]:
    """Cells of a flat wall, 30 x 45, 25 points of 2 mm noise each, with waves of plaster on it.

    Args:
        seed: which wall.
        reach_cells: over how many cells the waves are alike.
        relief_m: standard deviation of the waves.
        mixed_share: so much of the points of a cell in ten lies between the wall and 15 mm before.
    """
    rng = np.random.default_rng(seed)
    shape, n_points = (30, 45), 25
    waves = ndimage.gaussian_filter(rng.normal(size=shape), reach_cells, mode="wrap")
    # By what the filter leaves on average, not by what it left of this wall.
    waves *= relief_m * (2.0 * np.sqrt(np.pi) * max(reach_cells, 0.3))
    points = waves[..., None] + rng.normal(0.0, 0.002, (*shape, n_points))
    spoilt = rng.uniform(size=(*shape, n_points)) < mixed_share
    spoilt &= (rng.uniform(size=shape) < 0.1)[..., None]
    points = np.where(spoilt, rng.uniform(0.0, FIT_M, points.shape), points)
    steps = np.rint(points * STEPS_PER_TOLERANCE / FIT_M).astype(np.int64)
    number = np.full(shape, n_points, dtype=np.int64)
    plane = Plane(normal=np.array([0.0, -1.0, 0.0]), offset_m=-2.0)
    raster = SurfaceRaster(
        plane=plane,
        axes=wall_axes(plane.normal, UP),
        low_m=np.array([-1.0, -1.5]),
        cell_m=0.1,
        shape=shape,
    )
    sums = CellSums(
        n_near=number,
        n_inner=number,
        n_fit=number,
        steps=steps.sum(axis=2),
        squared_steps=(steps**2).sum(axis=2),
    )
    return raster, sums


def ratios(
    found: Plane, covariance: NDArray[np.float64], true: Plane, middle: NDArray[np.float64]
) -> list[float]:
    """Errors over stated sigmas: offset at a place, and the direction about two axes."""
    at_middle = np.append(middle, -1.0)
    off_m = float(found.distances_m(middle[None])[0] - true.distances_m(middle[None])[0])
    turned = found.normal - true.normal
    axes = wall_axes(true.normal, UP)
    return [
        off_m / np.sqrt(at_middle @ covariance @ at_middle),
        *(turned @ axis / np.sqrt(axis @ covariance[:3, :3] @ axis) for axis in axes),
    ]


def rms(values: list[list[float]]) -> NDArray[np.float64]:
    squares: NDArray[np.float64] = np.mean(np.square(values), axis=0)
    return np.sqrt(squares)


@pytest.mark.parametrize(
    ("reach_cells", "relief_m", "mixed_share"),
    [(0.0, 0.0, 0.0), (0.0, 0.001, 0.0), (1.0, 0.001, 0.0), (2.0, 0.002, 0.0), (0.0, 5e-4, 0.3)],
    ids=["noise", "rough", "waves of 10 cm", "waves of 20 cm", "mixed distances"],
)
def test_stated_sigmas_of_walls_are_their_errors(
    reach_cells: float, relief_m: float, mixed_share: float
) -> None:
    trials = []
    for seed in range(60):
        raster, sums = wall_of_cells(
            seed, reach_cells=reach_cells, relief_m=relief_m, mixed_share=mixed_share
        )
        fit = adjust_plane(raster, sums, sums.n_fit > 0, fit_tolerance_m=FIT_M, freedom="free")
        assert fit is not None
        u, v = raster.centres_m()
        middle = np.array([u.mean(), v.mean()]) @ raster.axes - 2.0 * raster.plane.normal
        trials.append(ratios(fit.plane, fit.stated()[0], raster.plane, middle))
    assert (rms(trials) > CALIBRATED[0]).all(), rms(trials)
    assert (rms(trials) < CALIBRATED[1]).all(), rms(trials)


@pytest.mark.parametrize("tails", ["laplace", "two widths"])
def test_cells_that_fade_state_what_their_plane_scatters_by(tails: str) -> None:
    """A fifth to a quarter of what the weights say is lost where many cells lose theirs."""
    shape, squares, reach_m = (40, 60), [], 0.03
    raster = replace(wall_of_cells(0, reach_cells=0.0, relief_m=0.0)[0], shape=shape)
    number = np.full(shape, 25, dtype=np.int64)
    for seed in range(250):
        rng = np.random.default_rng(seed)
        heights_m = rng.laplace(0.0, 0.001, shape)
        if tails == "two widths":
            heights_m = np.where(rng.random(shape) < 0.4, 3.2, 1.0) * rng.normal(0.0, 0.001, shape)
        steps = np.rint(25 * heights_m * STEPS_PER_TOLERANCE / reach_m).astype(np.int64)
        noise = (0.0002 * STEPS_PER_TOLERANCE / reach_m) ** 2
        sums = CellSums(
            n_near=number,
            n_inner=number,
            n_fit=number,
            steps=steps,
            squared_steps=np.rint(steps**2 / 25 + 25 * noise).astype(np.int64),
        )
        found = adjust_plane(raster, sums, number > 0, fit_tolerance_m=reach_m, freedom="free")
        assert found is not None
        # The true unknowns are zero.
        covariance = independent_covariance(found.fit)
        squares.append(found.fit.solution**2 / np.diag(covariance))
    assert math.sqrt(np.mean(squares)) == pytest.approx(1.0, abs=0.1)


def room_ratios(seed: int, folder: Path, *, step_deg: float) -> list[list[float]]:
    cloud, true_planes = random_room(seed, folder, step_deg=step_deg)
    planes = Ransac().run(Ransac.In(cloud=cloud), Ransac.Params(), context(folder)).planes
    found = []
    for true in true_planes:
        k = _nearest(planes, true.plane)
        middle = planes.corners[k].mean(axis=0)
        found.append(ratios(planes.plane(k), planes.covariance[k], true.plane, middle))
    return found


def _nearest(planes: Planes, true: Plane) -> int:
    middles = planes.corners.mean(axis=1)
    parallel = planes.normal @ true.normal > np.cos(np.radians(0.5))
    index = int(np.argmin(np.abs(true.distances_m(middles)) + 1e6 * ~parallel))
    assert parallel[index]
    return index


def test_stated_sigmas_of_scanned_rooms_are_their_errors(tmp_path: Path) -> None:
    found = [item for seed in (4,) for item in room_ratios(seed, tmp_path, step_deg=1.4)]
    # Six planes and three numbers each: the spread of their root mean square is a sixth.
    joint = float(np.sqrt(np.mean(np.square(found))))
    assert 0.5 < joint < 1.7


@pytest.mark.long
@pytest.mark.parametrize("step_deg", [0.5, 1.0])
def test_stated_sigmas_of_fifty_rooms_are_their_errors(step_deg: float, tmp_path: Path) -> None:
    found = [item for seed in range(50) for item in room_ratios(seed, tmp_path, step_deg=step_deg)]
    assert (rms(found) > CALIBRATED[0]).all(), rms(found)
    assert (rms(found) < CALIBRATED[1]).all(), rms(found)
