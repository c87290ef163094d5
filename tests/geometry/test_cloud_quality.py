"""The cloud is judged before anything else: thickness, point spacing, scans that disagree."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.read.reporting import report_quality, warn_of_up

from orthoflow.geometry import cloud_quality
from orthoflow.geometry.cloud_quality import CloudQuality, judge_quality, scan_step_m
from tests.raster_scenes import context

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


def judged(points: NDArray[np.float64], scan: NDArray[np.uint16] | None = None) -> CloudQuality:
    quality = judge_quality(offsets(points), scan)
    assert quality is not None
    return quality


@pytest.mark.parametrize(("step_m", "noise_m"), [(0.004, 0.0005), (0.008, 0.002), (0.004, 0.006)])
def test_thickness_and_step_are_those_of_the_scan(noise_m: float, step_m: float) -> None:
    # A bow of 10 cm is no thickness: in 10 cm it is 1 mm high at most.
    quality = judged(wall(step_m=step_m, noise_m=noise_m, bow_m=0.1))
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
    quality = judged(np.concatenate([one, other]), scan)
    # Each scan is as thick as it is, whatever the other one does.
    assert quality.sigma_m == pytest.approx(0.002, rel=0.15)
    assert quality.scan_step_m == pytest.approx(0.007, rel=0.05)
    assert quality.scans_apart_m == pytest.approx(apart_m, abs=0.0005)
    assert quality.disagrees == (apart_m > 0.0)


def test_coarse_clouds_are_judged_on_larger_pieces_and_few_points_not_at_all() -> None:
    coarse = judged(wall(step_m=0.03, noise_m=0.004))
    assert coarse.side_m == 0.3
    assert coarse.sigma_m == pytest.approx(0.004, rel=0.15)
    lost, scattered = np.zeros((5000, 3)), np.random.default_rng(3).uniform(-1, 1, (50_000, 3))
    for points in (wall(step_m=0.5, noise_m=0.004), lost, scattered):
        assert judge_quality(offsets(points), None) is None


def room(turned_deg: float, *, without_level: bool = False) -> NDArray[np.float64]:
    """Points on the six sides of a room of 6 x 4 x 3 m, turned about z; noise of 2 mm."""
    rng = np.random.default_rng(7)
    sides = np.array([6.0, 4.0, 3.0])
    points = []
    for axis in range(2 if without_level else 3):
        for end in (0.0, sides[axis]):
            one = rng.uniform(0.0, 1.0, (8_000, 3)) * sides
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
        quality = judged(points)
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
    assert judged(points).plainly_up(np.array([0.0, 0.0, 1.0])) is None, why


def test_another_axis_is_told_with_the_setting(tmp_path: Path) -> None:
    ctx = context(tmp_path)
    fallen = judged(room(20.0) @ Y_UP.T)
    warn_of_up(fallen, "z", ctx)
    (said,) = ctx.diagnostics
    assert "{step}.up=y" in said.remedy
    for right in ("y", "-y"):
        warn_of_up(fallen, right, ctx)
    warn_of_up(None, "z", ctx)
    assert ctx.diagnostics == [said]


def quality_of(**numbers: float) -> CloudQuality:
    pieces = {"side_m": 0.1, "width_95_m": 0.0125, "scan_step_m": 0.002, **numbers}
    return CloudQuality(n_pieces=40, normals=ASKEW[:1], **pieces)


def test_what_is_wrong_is_said_with_numbers(tmp_path: Path) -> None:
    ctx = context(tmp_path)
    quality = quality_of(sigma_m=0.0031, scans_apart_m=0.0094, sigma_apart_m=0.0002)
    report_quality(quality, ctx)
    assert {metric.name: round(metric.value, 6) for metric in ctx.metrics} == {
        "thickness_mm": 3.1,
        "thickness_width_mm": 12.5,
        "scan_step_mm": 2.0,
        "thickness_scan_steps": 1.55,
        "scans_apart_mm": 9.4,
    }
    thick, apart = ctx.diagnostics
    assert [round(thick.values[name], 6) for name in ("sigma_mm", "width_mm", "step_mm")] == [
        3.1,
        12.5,
        2.0,
    ]
    assert [round(apart.values[name], 6) for name in ("apart_mm", "sigma_mm")] == [9.4, 3.1]
    quiet = context(tmp_path)
    report_quality(replace(quality, scan_step_m=0.0032, scans_apart_m=0.003), quiet)
    report_quality(None, quiet)
    assert (len(quiet.metrics), quiet.warnings) == (len(ctx.metrics), [])


@pytest.mark.parametrize(
    ("sigma_m", "sigma_apart_m", "limit_m"),
    [(0.0002, 0.0001, 0.001), (0.003, 0.0001, 0.003), (0.0002, 0.001, 0.003)],
    ids=["a millimetre", "their scatter", "chance"],
)
def test_scans_disagree_beyond_a_millimetre_their_scatter_and_chance(
    sigma_m: float, sigma_apart_m: float, limit_m: float
) -> None:
    for off in (-0.0001, 0.0001):
        apart: dict[str, float] = {"scans_apart_m": limit_m + off, "sigma_apart_m": sigma_apart_m}
        assert quality_of(sigma_m=sigma_m, **apart).disagrees is (off > 0.0)


def test_of_a_large_cloud_a_part_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    # Of more points some slabs, and of dense pieces some.
    monkeypatch.setattr(cloud_quality, "MAX_LOOKED_AT", 400_000)
    monkeypatch.setattr(cloud_quality, "MAX_GATHERED", 150_000)
    quality = judged(wall(step_m=0.0035, noise_m=0.001))
    assert quality.n_pieces >= 20
    assert quality.sigma_m == pytest.approx(0.001, rel=0.15)
    assert quality.scan_step_m == pytest.approx(0.0035, rel=0.1)


GSD_M = 0.01


def every(step: int, shape: tuple[int, int] = (96, 128)) -> NDArray[np.uint32]:
    """One point in each block of step x step cells."""
    count = np.zeros(shape, dtype=np.uint32)
    count[step // 2 :: step, step // 2 :: step] = 1
    return count


@pytest.mark.parametrize("step", [1, 2, 4, 8])
def test_points_every_few_cells_lie_so_many_apart(step: int) -> None:
    assert scan_step_m(every(step), gsd_m=GSD_M) == pytest.approx(step * GSD_M)
    # So they do where they cover a corner of the wall alone, and on cells of other sizes.
    part = every(step)
    part[64:] = part[:, 64:] = 0
    assert scan_step_m(part, gsd_m=0.25) == pytest.approx(step * 0.25)


@pytest.mark.parametrize("per_cell", [1, 4, 9, 100])
def test_many_points_per_cell_lie_closer_than_cells(per_cell: int) -> None:
    count = np.full((30, 40), per_cell, dtype=np.uint32)
    assert scan_step_m(count, gsd_m=GSD_M) == pytest.approx(GSD_M / np.sqrt(per_cell))


def test_points_at_random_are_as_far_apart_as_they_are_many() -> None:
    rng = np.random.default_rng(3)
    for mean in (0.05, 0.3, 1.0, 6.0):
        count = rng.poisson(mean, (200, 240)).astype(np.uint32)
        assert scan_step_m(count, gsd_m=GSD_M) == pytest.approx(GSD_M / np.sqrt(mean), rel=0.05)


def test_a_wall_without_points_has_no_step_and_one_point_has_the_wall() -> None:
    assert scan_step_m(np.zeros((7, 9), dtype=np.uint32), gsd_m=GSD_M) == 0.0
    one = np.zeros((7, 9), dtype=np.uint32)
    one[3, 8] = 1
    # Four doublings make one block of nine columns.
    assert scan_step_m(one, gsd_m=GSD_M) == pytest.approx(16 * GSD_M)
