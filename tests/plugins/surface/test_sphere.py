"""Domes are found with the stated accuracy; cylinders and corners of rooms are no spheres."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.simulate.curved import SimulateCurved
from orthoflow_plugins.surface.sphere import SurfaceSphere

from orthoflow.products import PointCloud, Surfaces
from orthoflow.testing import Trial, run_trial
from orthoflow.testing.surveyed import few_points
from tests.long_loops import long_only, seeds

RADIUS_M = 2.5
# The scanner of `few_points` is at the origin.
CENTRE = np.array([0.3, -0.4, 0.2])


def found_in(cloud: PointCloud, folder: Path) -> Surfaces:
    trial = Trial(method=SurfaceSphere, inputs={"cloud": cloud}, params={})
    found: Surfaces = run_trial(trial, folder).outputs["surfaces"]
    return found


@pytest.mark.parametrize("seed", seeds(10))
def test_a_simulated_dome_is_found_to_a_third_of_a_millimetre(seed: int, tmp_path: Path) -> None:
    params = {"subject": "dome", "scan_step_m": 0.06, "shift_world_m": (4e5, 5e6, 100.0)}
    trial = Trial(method=SimulateCurved, inputs={}, params=params, seed=seed)
    out = run_trial(trial, tmp_path / "room").outputs
    surfaces = found_in(out["cloud"], tmp_path / "found")
    (found,), (true,) = surfaces.surfaces, out["truth"].surfaces.surfaces
    assert found.name == true.name == "dome 0"
    off_m = found.shape.centre_world - true.shape.centre_world
    assert np.abs(off_m).max() < 0.0003
    assert abs(found.radius_m - true.radius_m) < min(0.0003, 5.0 * found.sigma_radius_m)
    assert (np.abs(off_m) < 5.0 * np.sqrt(np.diagonal(found.covariance)[:3])).all()
    assert 0.86 < found.along_m[1] / (0.5 * math.pi * true.radius_m) < 1.01


def part_of_sphere(
    name: str, rng: np.random.Generator, *, noise_m: float
) -> tuple[NDArray[np.float64], float]:
    """Return points on a part of a sphere, and its largest angle from its middle."""
    least = {"cap": math.cos(0.42), "semi-dome": 0.0, "dome on a drum": 0.0}[name]
    z, angles = rng.uniform(least, 1.0, 120_000), rng.uniform(-math.pi, math.pi, 120_000)
    if name == "semi-dome":
        angles *= 0.5
    radii_m = RADIUS_M + rng.normal(scale=noise_m, size=len(z))
    level = np.sqrt(1.0 - z**2)[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    points = radii_m[:, None] * np.column_stack([level, z])
    if name == "dome on a drum":
        # The drum continues the dome without an edge; 0.2 m below, it is 8 mm off the sphere.
        drum = radii_m[:30_000, None] * np.column_stack([np.cos(angles), np.sin(angles)])[:30_000]
        points = np.vstack([points, np.column_stack([drum, rng.uniform(-0.6, 0.0, 30_000)])])
    return CENTRE + points, math.acos(least)


@pytest.mark.parametrize(
    ("name", "noise_m"),
    [("cap", 0.006), ("semi-dome", 0.002), ("dome on a drum", 0.004), *long_only(("cap", 0.002))],
)
def test_parts_of_spheres_have_the_stated_errors(name: str, noise_m: float, tmp_path: Path) -> None:
    points, most_rad = part_of_sphere(name, np.random.default_rng(5), noise_m=noise_m)
    (found,) = found_in(few_points(points), tmp_path).surfaces
    off_m = np.append(found.shape.centre_world - CENTRE, found.radius_m - RADIUS_M)
    variances = np.diagonal(found.covariance)[[0, 1, 2, 6]]
    assert (np.abs(off_m) < 4.0 * np.sqrt(variances)).all()
    assert np.abs(off_m).max() < (0.006 if name == "cap" else 0.0005)
    is_half = name == "semi-dome"
    assert found.name == ("sphere 0" if is_half else "dome 0")
    middle = np.array([math.sqrt(0.5), 0.0, math.sqrt(0.5)]) if is_half else [0.0, 0.0, 1.0]
    np.testing.assert_allclose(found.zero_world, middle, atol=0.02)
    ends_rad = np.array(found.along_m) / RADIUS_M
    assert ends_rad == pytest.approx((0.0, most_rad), abs=0.16 if is_half else 0.025)


@pytest.mark.parametrize("name", ["column", "vault", "corner"])
def test_what_is_no_sphere_is_not_found(name: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    along, angles = rng.uniform(-2.0, 2.0, 30_000), rng.uniform(-1.3, 1.3, 30_000)
    if name == "column":
        angles *= math.pi / 1.3
    radius_m = 0.8 if name == "column" else 3.0
    points = np.column_stack([radius_m * np.cos(angles), radius_m * np.sin(angles), along])
    if name == "corner":
        points = rng.uniform(0.0, 3.0, (30_000, 3))
        points[np.arange(30_000), np.arange(30_000) % 3] = 0.0
    surfaces = found_in(few_points(points + rng.normal(scale=0.002, size=points.shape)), tmp_path)
    assert surfaces.surfaces == ()
    reasons = {item["reason"] for item in surfaces.details["rejected"]}
    assert name == "corner" or "flat parts" in reasons
