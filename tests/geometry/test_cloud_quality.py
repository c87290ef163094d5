"""The cloud is judged before anything else: thickness, scan step, scans that disagree."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.read.reporting import report_quality, warn_of_up

from orthoflow.geometry.cloud_quality import CloudQuality, judge_quality
from orthoflow.sdk import StepContext

ASKEW = np.array([[0.8, 0.0, -0.6], [0.0, 1.0, 0.0], [0.6, 0.0, 0.8]])
Offsets = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]


def wall(
    *, step_m: float, noise_m: float, seed: int = 0, away_m: float = 0.0, bow_m: float = 0.0
) -> NDArray[np.float64]:
    """Points (n, 3) in a grid of a wall of 3 m x 2 m that stands askew, about the origin."""
    rng = np.random.default_rng(seed)
    u, v = np.meshgrid(np.arange(-1.5, 1.5, step_m), np.arange(-1.0, 1.0, step_m))
    across = away_m + bow_m * np.cos(u) + rng.normal(0.0, noise_m, u.shape)
    return np.asarray(np.column_stack([u.ravel(), v.ravel(), across.ravel()]) @ ASKEW.T)


def offsets(points: NDArray[np.float64]) -> Offsets:
    x, y, z = points.T.astype(np.float32)
    return x, y, z


def context(folder: Path) -> StepContext:
    return StepContext(rng=np.random.default_rng(0), cores=1, scratch=folder)


@pytest.mark.parametrize("noise_m", [0.0005, 0.002, 0.006])
@pytest.mark.parametrize("step_m", [0.004, 0.008])
def test_thickness_and_step_are_those_of_the_scan(noise_m: float, step_m: float) -> None:
    # A bow of 10 cm is no thickness: in 10 cm it is 1 mm high at most.
    quality = judge_quality(offsets(wall(step_m=step_m, noise_m=noise_m, bow_m=0.1)), None)
    assert quality is not None
    assert quality.sigma_m == pytest.approx(noise_m, rel=0.15)
    assert quality.width_95_m == pytest.approx(3.92 * noise_m, rel=0.15)
    # The planes of noisy pieces lean a little.
    assert quality.scan_step_m == pytest.approx(step_m, rel=0.1)
    assert quality.is_thick == (noise_m > step_m)
    assert quality.scans_apart_m is None


@pytest.mark.parametrize("apart_m", [0.0, 0.005])
def test_scans_that_lie_apart_are_found(apart_m: float) -> None:
    one = wall(step_m=0.007, noise_m=0.002, seed=1)
    other = wall(step_m=0.009, noise_m=0.002, seed=2, away_m=apart_m)
    scan = np.repeat(np.array([3, 8], dtype=np.uint16), [len(one), len(other)])
    quality = judge_quality(offsets(np.concatenate([one, other])), scan)
    assert quality is not None
    # Each scan is as thick as it is, whatever the other one does.
    assert quality.sigma_m == pytest.approx(0.002, rel=0.15)
    assert quality.scan_step_m == pytest.approx(0.007, rel=0.05)
    assert quality.scans_apart_m == pytest.approx(apart_m, abs=0.0005)
    assert quality.disagrees == (apart_m > 0.0)


def test_coarse_clouds_are_judged_on_larger_pieces_and_few_points_not_at_all() -> None:
    coarse = judge_quality(offsets(wall(step_m=0.03, noise_m=0.004)), None)
    assert coarse is not None
    assert coarse.side_m == 0.3
    assert coarse.sigma_m == pytest.approx(0.004, rel=0.15)
    assert judge_quality(offsets(wall(step_m=0.5, noise_m=0.004)), None) is None
    lost = np.zeros((5000, 3))
    assert judge_quality(offsets(lost), None) is None
    room = np.random.default_rng(3).uniform(-1.0, 1.0, (50_000, 3))
    assert judge_quality(offsets(room), None) is None


def room(turned_deg: float, *, without_level: bool = False) -> NDArray[np.float64]:
    """Points on the six sides of a room of 6 x 4 x 3 m, turned about z; noise of 2 mm."""
    rng = np.random.default_rng(7)
    sides = np.array([6.0, 4.0, 3.0])
    points = []
    for axis in range(2 if without_level else 3):
        for end in (0.0, sides[axis]):
            one = rng.uniform(0.0, 1.0, (20_000, 3)) * sides
            one[:, axis] = end + rng.normal(0.0, 0.002, len(one))
            points.append(one)
    turn = np.radians(turned_deg)
    about_z = np.array(
        [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]]
    )
    return np.concatenate(points) @ about_z.T


Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # as most mesh programs write
UP = {"x": 0, "y": 1, "z": 2}


@pytest.mark.parametrize("turned_deg", [20.0, 70.0])
def test_a_room_on_its_side_shows_which_axis_is_up(turned_deg: float) -> None:
    upright, fallen = room(turned_deg), room(turned_deg) @ Y_UP.T
    for points, up in ((upright, "z"), (fallen, "y"), (fallen[:, [1, 0, 2]], "x")):
        quality = judge_quality(offsets(points), None)
        assert quality is not None
        said = {axis: quality.plainly_up(np.eye(3)[index]) for axis, index in UP.items()}
        assert said == {axis: None if axis == up else UP[up] for axis in UP}


@pytest.mark.parametrize(
    ("points", "why"),
    [
        (room(0.0) @ Y_UP.T, "square to all axes: nobody can tell"),
        (room(20.0, without_level=True), "walls alone, and z is up"),
        (wall(step_m=0.01, noise_m=0.002, bow_m=0.0), "one wall"),
        (room(20.0) @ ASKEW.T, "no axis is up"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_may_be_right_is_not_doubted(points: NDArray[np.float64], why: str) -> None:
    quality = judge_quality(offsets(points), None)
    assert quality is not None, why
    assert quality.plainly_up(np.array([0.0, 0.0, 1.0])) is None


def test_another_axis_is_told_with_the_setting(tmp_path: Path) -> None:
    ctx = context(tmp_path)
    fallen = judge_quality(offsets(room(20.0) @ Y_UP.T), None)
    warn_of_up(fallen, "z", ctx)
    (said,) = ctx.warnings
    assert said == (
        "the up axis seems to be y, not z: 96% of the surfaces are horizontal or vertical with "
        "respect to it, 37% with respect to z: {step}.up=y, or -y if floors become ceilings"
    )
    for right in ("y", "-y"):
        warn_of_up(fallen, right, ctx)
    warn_of_up(None, "z", ctx)
    assert ctx.warnings == [said]


def test_dense_clouds_are_judged_on_a_part_of_their_pieces() -> None:
    dense = judge_quality(offsets(wall(step_m=0.0015, noise_m=0.001)), None)
    assert dense is not None
    assert dense.n_pieces >= 20
    assert dense.sigma_m == pytest.approx(0.001, rel=0.15)


def test_what_is_wrong_is_said_with_numbers(tmp_path: Path) -> None:
    ctx = context(tmp_path)
    quality = CloudQuality(
        side_m=0.1,
        n_pieces=40,
        sigma_m=0.0031,
        width_95_m=0.0125,
        scan_step_m=0.002,
        scans_apart_m=0.0094,
        sigma_apart_m=0.0002,
        normals=np.tile(ASKEW[0], (40, 1)),
    )
    report_quality(quality, ctx)
    assert {metric.name: round(metric.value, 6) for metric in ctx.metrics} == {
        "thickness_mm": 3.1,
        "thickness_width_mm": 12.5,
        "scan_step_mm": 2.0,
        "thickness_scan_steps": 1.55,
        "scans_apart_mm": 9.4,
    }
    thick, apart = ctx.warnings
    assert thick.startswith(
        "the cloud is thicker than its point spacing: across surfaces, in pieces of about 10 cm, "
        "its points scatter by 3.1 mm (95 % within 12.5 mm), and along them the nearest other "
        "point is 2.0 mm away: planes and depths"
    )
    assert apart == (
        "the scans disagree: where two show the same surface, they are 9.4 mm apart (median), "
        "while the scatter of each is 3.1 mm: register them again, or use one at a time"
    )
    thin = context(tmp_path)
    report_quality(replace(quality, scan_step_m=0.0032, scans_apart_m=0.003), thin)
    assert thin.warnings == []
    quiet = context(tmp_path)
    report_quality(None, quiet)
    assert (quiet.metrics, quiet.warnings) == ([], [])


@pytest.mark.parametrize(
    ("sigma_m", "sigma_apart_m", "limit_m"),
    [(0.0002, 0.0001, 0.001), (0.003, 0.0001, 0.003), (0.0002, 0.001, 0.003)],
    ids=["a millimetre", "their scatter", "chance"],
)
def test_scans_disagree_beyond_a_millimetre_their_scatter_and_chance(
    sigma_m: float, sigma_apart_m: float, limit_m: float
) -> None:
    for off in (-0.0001, 0.0001):
        quality = CloudQuality(
            side_m=0.1,
            n_pieces=40,
            sigma_m=sigma_m,
            width_95_m=0.01,
            scan_step_m=0.002,
            scans_apart_m=limit_m + off,
            sigma_apart_m=sigma_apart_m,
            normals=ASKEW[:1],
        )
        assert quality.disagrees is (off > 0.0)


def test_of_a_large_cloud_a_part_is_measured() -> None:
    # Of more than four million points some slabs.
    quality = judge_quality(offsets(wall(step_m=0.0011, noise_m=0.001)), None)
    assert quality is not None
    assert quality.sigma_m == pytest.approx(0.001, rel=0.15)
    assert quality.scan_step_m == pytest.approx(0.0011, rel=0.1)
