"""The cloud is judged before anything else: thickness, scan step, scans that disagree."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.read import quality as quality_module
from orthoflow_plugins.read.quality import CloudQuality, judge_quality, report_quality

from orthoflow.sdk import StepContext

Offsets = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]


def wall(
    *, step_m: float, noise_m: float, seed: int = 0, away_m: float = 0.0, bow_m: float = 0.0
) -> NDArray[np.float64]:
    """Points (n, 3) in a grid of a wall of 3 m x 2 m that stands askew, about the origin."""
    rng = np.random.default_rng(seed)
    u, v = np.meshgrid(np.arange(-1.5, 1.5, step_m), np.arange(-1.0, 1.0, step_m))
    across = away_m + bow_m * np.cos(u) + rng.normal(0.0, noise_m, u.shape)
    turn = np.array([[0.8, 0.0, -0.6], [0.0, 1.0, 0.0], [0.6, 0.0, 0.8]])
    return np.asarray(np.column_stack([u.ravel(), v.ravel(), across.ravel()]) @ turn.T)


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


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_of_a_large_cloud_a_part_says_as_much(monkeypatch: pytest.MonkeyPatch, axis: int) -> None:
    # As large as two hundred million points, in the way of looking: slabs across the longest axis.
    monkeypatch.setattr("orthoflow_plugins.read.quality._LOOKED_AT_MOST", 4000)
    points = np.roll(wall(step_m=0.005, noise_m=0.002), axis, axis=1)
    looked_at = 0
    measured = quality_module._measured

    def counted(points: NDArray[np.float64], *rest: Any) -> Any:
        nonlocal looked_at
        looked_at += len(points)
        return measured(points, *rest)

    monkeypatch.setattr("orthoflow_plugins.read.quality._measured", counted)
    quality = judge_quality(offsets(points), None)
    assert quality is not None
    assert looked_at < 0.2 * len(points)
    assert quality.sigma_m == pytest.approx(0.002, rel=0.15)
    assert quality.scan_step_m == pytest.approx(0.005, rel=0.1)


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
        "the cloud is thicker than its scan step: across surfaces, in pieces of about 10 cm, its "
        "points scatter by 3.1 mm (95 % within 12.5 mm), and along them the nearest other point is "
        "2.0 mm away: planes and depths"
    )
    assert apart == (
        "the scans disagree: where two show one surface they lie 9.4 mm apart across it (median), "
        "while each scatters by 3.1 mm: register them again, or take one at a time"
    )
    quiet = context(tmp_path)
    report_quality(None, quiet)
    assert (quiet.metrics, quiet.warnings) == ([], [])
