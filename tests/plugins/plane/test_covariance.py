"""Stated uncertainty of planes: what is stated must be what happens, over many walls and rooms."""

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
from orthoflow_plugins.simulate.room import SimulateRoom
from scipy import ndimage

from orthoflow.geometry import Plane, wall_axes
from tests.plane_scenes import context, detect, nearest

FIT_M = 0.015
UP = np.array([0.0, 0.0, 1.0])
# What stated and true errors may differ by, over many trials.
CALIBRATED = (0.7, 1.4)
SHAPE = (30, 45)
TRUE = Plane(normal=np.array([0.0, -1.0, 0.0]), offset_m=-2.0)
RASTER = SurfaceRaster(
    plane=TRUE,
    axes=wall_axes(TRUE.normal, UP),
    low_m=np.array([-1.0, -1.5]),
    cell_m=0.1,
    shape=SHAPE,
)


def wall_of_cells(
    seed: int, *, reach_cells: float, relief_m: float, mixed_share: float = 0.0
) -> CellSums:
    """Cells of a flat wall, 30 x 45, 25 points of 2 mm noise each, with waves of plaster on it.

    Args:
        seed: which wall.
        reach_cells: over how many cells the waves are similar.
        relief_m: standard deviation of the waves.
        mixed_share: so much of the points of a cell in ten lies between the wall and 15 mm before.
    """
    rng = np.random.default_rng(seed)
    waves = ndimage.gaussian_filter(rng.normal(size=SHAPE), reach_cells, mode="wrap")
    # By what the filter leaves on average, not by what it left of this wall.
    waves *= relief_m * (2.0 * np.sqrt(np.pi) * max(reach_cells, 0.3))
    points = waves[..., None] + rng.normal(0.0, 0.002, (*SHAPE, 25))
    spoilt = rng.uniform(size=(*SHAPE, 25)) < mixed_share
    spoilt &= (rng.uniform(size=SHAPE) < 0.1)[..., None]
    points = np.where(spoilt, rng.uniform(0.0, FIT_M, points.shape), points)
    steps = np.rint(points * STEPS_PER_TOLERANCE / FIT_M).astype(np.int64)
    return sums_of(steps.sum(axis=2), (steps**2).sum(axis=2))


def sums_of(steps: NDArray[np.int64], squared: NDArray[np.int64]) -> CellSums:
    number = np.full(steps.shape, 25, dtype=np.int64)
    return CellSums(n_near=number, n_inner=number, n_fit=number, steps=steps, squared_steps=squared)


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
    [(0.0, 0.0, 0.0), (0.0, 0.001, 0.0), (2.0, 0.002, 0.0), (0.0, 5e-4, 0.3)],
    ids=["noise", "rough", "waves of 20 cm", "mixed distances"],
)
def test_stated_sigmas_of_walls_are_their_errors(
    reach_cells: float, relief_m: float, mixed_share: float
) -> None:
    trials = []
    for seed in range(60):
        sums = wall_of_cells(
            seed, reach_cells=reach_cells, relief_m=relief_m, mixed_share=mixed_share
        )
        fit = adjust_plane(RASTER, sums, sums.n_fit > 0, fit_tolerance_m=FIT_M, freedom="free")
        assert fit is not None
        u, v = RASTER.centres_m()
        middle = np.array([u.mean(), v.mean()]) @ RASTER.axes - 2.0 * TRUE.normal
        trials.append(ratios(fit.plane, fit.stated()[0], TRUE, middle))
    assert (rms(trials) > CALIBRATED[0]).all(), rms(trials)
    assert (rms(trials) < CALIBRATED[1]).all(), rms(trials)


@pytest.mark.parametrize("tails", ["laplace", "two widths"])
def test_cells_that_fade_state_what_their_plane_scatters_by(tails: str) -> None:
    """A fifth to a quarter of what the weights say is lost where many cells lose theirs."""
    shape, squares, reach_m = (40, 60), [], 0.03
    raster = replace(RASTER, shape=shape)
    for seed in range(250):
        rng = np.random.default_rng(seed)
        heights_m = rng.laplace(0.0, 0.001, shape)
        if tails == "two widths":
            heights_m = np.where(rng.random(shape) < 0.4, 3.2, 1.0) * rng.normal(0.0, 0.001, shape)
        steps = np.rint(25 * heights_m * STEPS_PER_TOLERANCE / reach_m).astype(np.int64)
        noise = (0.0002 * STEPS_PER_TOLERANCE / reach_m) ** 2
        sums = sums_of(steps, np.rint(steps**2 / 25 + 25 * noise).astype(np.int64))
        cells = np.ones(shape, dtype=np.bool_)
        found = adjust_plane(raster, sums, cells, fit_tolerance_m=reach_m, freedom="free")
        assert found is not None
        # The true unknowns are zero.
        covariance = independent_covariance(found.fit)
        squares.append(found.fit.solution**2 / np.diag(covariance))
    assert math.sqrt(np.mean(squares)) == pytest.approx(1.0, abs=0.1)


def room_ratios(seed: int, folder: Path) -> list[list[float]]:
    """Of walls, floor and ceiling of a room drawn and scanned by a seed."""
    chosen = {"geometry": "drawn", "scan_step_m": 0.04}
    ctx = replace(context(folder), rng=np.random.default_rng(seed))
    room = SimulateRoom().run(SimulateRoom.In(), SimulateRoom.Params.model_validate(chosen), ctx)
    planes, true = detect(Ransac, room.cloud, folder)[0].planes, room.truth.planes
    found = []
    for k, name in enumerate(true.names):
        if " in " not in name:
            at = nearest(planes, true.normal[k], true.corners[k].mean(axis=0))
            middle = planes.corners[at].mean(axis=0)
            found.append(ratios(planes.plane(at), planes.covariance[at], true.plane(k), middle))
    return found


@pytest.mark.long
def test_stated_sigmas_of_fifty_rooms_are_their_errors(tmp_path: Path) -> None:
    found = [item for seed in range(50) for item in room_ratios(seed, tmp_path)]
    assert (rms(found) > CALIBRATED[0]).all(), rms(found)
    assert (rms(found) < CALIBRATED[1]).all(), rms(found)
