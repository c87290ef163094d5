"""Balanced intensities of scans: known effects are removed again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.raster.balancing import balanced

from orthoflow.geometry.slabs import Slab
from orthoflow.products import PointCloud
from tests import raster_scenes as scenes
from tests import samples
from tests.plane_scenes import cloud_of

STATIONS = np.array([[-1.5, -3.0, 0.2], [2.0, -1.5, -0.3], [0.2, -5.0, 0.0]])
SCALES = np.array([1.0, 0.7, 1.3])
RANGE_POWER, COSINE_POWER = -0.8, 0.6
ORIGIN = (1000.0, 2000.0, 100.0)


def slab() -> Slab:
    """Return the slab of the wall y = 0, 4 m x 3 m, seen from the south."""
    frame = samples.facing_south(0.01, 400, 300, np.array([-2.0, 0.0, 1.5]) + ORIGIN)
    return Slab(frame=frame, front_m=0.05, behind_m=0.03)


def albedo(points: np.ndarray) -> np.ndarray:
    return 0.2 + 0.05 * np.sin(2.0 * points[:, 0]) * np.cos(3.0 * points[:, 2])


def cloud(n_scans: int = 3, n_points: int = 40_000) -> tuple[PointCloud, np.ndarray]:
    """Return a wall in several scans, with some points off the wall, and true intensities."""
    rng = np.random.default_rng(0)
    points = np.column_stack(
        [rng.uniform(-2.3, 2.3, n_points), np.zeros(n_points), rng.uniform(-1.8, 1.8, n_points)]
    )
    # Some points are in front of the slab, some behind it, and some just inside.
    points[::10, 1], points[1::10, 1], points[2::10, 1] = -0.06, 0.04, -0.04
    scan = rng.integers(0, n_scans, n_points)
    rays = STATIONS[scan] - points
    range_m = np.linalg.norm(rays, axis=1)
    cosine = -rays[:, 1] / range_m
    true = albedo(points)
    seen = true * SCALES[scan] * range_m**RANGE_POWER * cosine**COSINE_POWER
    plain = cloud_of(points, origin=ORIGIN, stations=STATIONS[:n_scans])
    return (replace(plain, scan=scan.astype(np.uint16), intensity=seen.astype(np.float32)), true)


def test_scale_range_and_incidence_are_estimated_from_overlaps(tmp_path: Path) -> None:
    known, true = cloud()
    ctx = scenes.context(tmp_path)
    found = balanced(known, [slab()], ctx)
    metrics = scenes.numbers(ctx)
    assert metrics["intensity_range_power"] == pytest.approx(RANGE_POWER, abs=0.03)
    assert metrics["intensity_cosine_power"] == pytest.approx(COSINE_POWER, abs=0.06)
    assert metrics["intensity_scale_spread"] == pytest.approx(0.6, abs=0.03)
    points = known.points_world() - ORIGIN
    on_wall = (np.abs(points[:, 0]) < 2.0) & (np.abs(points[:, 2]) < 1.5)
    on_wall &= (points[:, 1] < 0.03) & (points[:, 1] > -0.05)
    assert 0.3 < on_wall.mean() < 0.9
    # Points that are not on the wall are unchanged.
    np.testing.assert_array_equal(found.intensity[~on_wall], known.intensity[~on_wall])
    # The intensity is as in the first scan, from three metres at perpendicular incidence.
    ratio = found.intensity[on_wall] / true[on_wall]
    spread_before = np.std(known.intensity[on_wall] / true[on_wall])
    assert np.std(ratio) < 0.05 * spread_before
    assert np.median(ratio) == pytest.approx(3.0**RANGE_POWER, rel=0.03)


@pytest.mark.parametrize("name", ["intensity", "scan", "stations"])
def test_without_known_scans_nothing_changes(name: str, tmp_path: Path) -> None:
    known, _ = cloud(n_points=500)
    plain = replace(known, **{name: None})
    ctx = scenes.context(tmp_path)
    assert balanced(plain, [slab()], ctx) is plain
    # Nor if no scans overlap.
    alone, _ = cloud(n_scans=1, n_points=4_000)
    assert balanced(alone, [slab()], ctx) is alone
    assert len(ctx.warnings) == 2
    assert not ctx.metrics
