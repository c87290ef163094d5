"""Cylinders in simulated buildings are found with the stated accuracy; nothing else is found."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.simulate.curved import SimulateCurved
from orthoflow_plugins.simulate.room import SimulateRoom
from orthoflow_plugins.surface.cone import SurfaceCone
from orthoflow_plugins.surface.cylinder import SurfaceCylinder

from orthoflow.products import PointCloud, PointLabels, Surface, Surfaces, Truth
from orthoflow.testing import Trial, run_trial
from orthoflow.testing.surveyed import few_points
from orthoflow.testing.trials import TrialRun
from tests.long_loops import long_only, seeds

SHIFT_M = (4e5, 5e6, 100.0)


@cache
def scanned(subject: str, seed: int = 3, step_m: float = 0.03) -> tuple[PointCloud, Truth]:
    params = {"subject": subject, "scan_step_m": step_m, "shift_world_m": SHIFT_M}
    trial = Trial(method=SimulateCurved, inputs={}, params=params, seed=seed)
    with TemporaryDirectory() as folder:
        out = run_trial(trial, Path(folder)).outputs
    return out["cloud"], out["truth"]


def found_in(folder: Path, cloud: PointCloud, labels: Any = None, **params: Any) -> TrialRun:
    inputs = {"cloud": cloud} | ({} if labels is None else {"labels": labels})
    return run_trial(Trial(method=SurfaceCylinder, inputs=inputs, params=params), folder)


def off(found: Surface, true: Surface) -> tuple[float, float, float]:
    """Errors of the direction (degrees), radius and place of the axis (metres)."""
    axis = true.shape.axis_world
    turn = math.degrees(np.linalg.norm(np.cross(found.shape.axis_world, axis)))
    apart = found.shape.point_world - true.shape.point_world
    across = float(np.linalg.norm(apart - (apart @ axis) * axis))
    return turn, abs(found.radius_m - true.radius_m), across


@pytest.mark.parametrize(
    ("subject", "kind", "arc_deg"),
    [
        ("barrel-vault", "vault", (140, 160)),
        ("cross-vault", "vault", (90, 150)),
        ("apse", "apse", (150, 185)),
        ("tower", "tower", (260, 330)),
        ("column", "column", (120, 230)),
    ],
)
def test_surfaces_are_found_as_accurately_as_stated(
    subject: str, kind: str, arc_deg: tuple[float, float], tmp_path: Path
) -> None:
    cloud, truth = scanned(subject, step_m=0.025 if subject == "column" else 0.03)
    assert truth.surfaces is not None
    run = found_in(tmp_path, cloud)
    found: Surfaces = run.outputs["surfaces"]
    assert [item.name for item in found.surfaces] == [f"{kind} {i}" for i in range(len(found))]
    assert len(found) == len(truth.surfaces)
    points = cloud.points_world()
    for index, surface in enumerate(found.surfaces):
        true = min(truth.surfaces.surfaces, key=lambda item: off(surface, item)[0])
        turn_deg, radius_m, across_m = off(surface, true)
        assert turn_deg < min(0.03, 5.0 * surface.sigma_axis_deg)
        assert radius_m < min(0.001, 5.0 * surface.sigma_radius_m)
        assert across_m < 0.001
        assert surface.shape.is_concave == true.shape.is_concave
        assert arc_deg[0] < math.degrees(surface.arc_rad[1] - surface.arc_rad[0]) < arc_deg[1]
        own = run.outputs["labels"].plane_index == index
        assert np.abs(surface.shape.distances_m(points[own])).max() < 0.051
        # Points of a cross vault are on both cylinders near the crown.
        is_true = (np.abs(true.shape.distances_m(points)) < 0.004) & (truth.labels < 0)
        assert own[is_true].mean() > (0.8 if subject == "cross-vault" else 0.93)
        assert surface.n_points == np.count_nonzero(own)


@pytest.mark.parametrize("seed", seeds(2))
def test_a_room_of_planes_has_no_cylinder(seed: int, tmp_path: Path) -> None:
    params = {"geometry": "drawn", "decoration": "drawn", "scan_step_m": 0.04}
    room = run_trial(
        Trial(method=SimulateRoom, inputs={}, params=params, seed=seed), tmp_path / "room"
    )
    run = found_in(tmp_path, room.outputs["cloud"])
    assert run.outputs["surfaces"].surfaces == ()
    assert (run.outputs["labels"].plane_index == -1).all()


def test_planes_that_are_strips_of_a_vault_are_searched_and_walls_are_not(tmp_path: Path) -> None:
    """A detector with a tolerance of 5 cm takes a vault for strips of planes 1.1 m wide."""
    cloud, truth = scanned("barrel-vault")
    assert truth.surfaces is not None
    (vault,) = truth.surfaces.surfaces
    points = cloud.points_world()
    labels = truth.labels.copy()
    normals = vault.shape.normals(points)
    aside = np.cross(vault.shape.axis_world, vault.zero_world)
    angles = np.arctan2(-normals @ aside, -normals @ vault.zero_world)
    on = (labels < 0) & (np.abs(vault.shape.distances_m(points)) < 0.03)
    on &= np.abs(angles) < vault.arc_rad[1]
    n_flat, width = len(truth.planes), 2.0 * math.acos(1.0 - 0.05 / vault.radius_m)
    labels[on] = n_flat + np.floor((angles[on] - angles[on].min()) / width)
    run = found_in(tmp_path, cloud, PointLabels(plane_index=labels))
    (found,) = run.outputs["surfaces"].surfaces
    assert off(found, vault)[1] < 0.001
    assert found.n_points > 0.95 * np.count_nonzero(on)
    tests = run.outputs["surfaces"].details["planes"]
    assert {test["index"] for test in tests if not test["is_strip"]} == set(range(n_flat))
    assert sum(test["is_strip"] for test in tests) == len(tests) - n_flat >= 5
    # Points of flat walls are on the surface only where they are nearer to it.
    own = run.outputs["labels"].plane_index == 0
    assert (own & (truth.labels >= 0)).mean() < 0.002


def points_of(name: str, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return points of a prism, a dome, strips between rounded corners, or a wall bent by 5 cm."""
    if name == "octagon":
        # Its inscribed circle has a radius of 2 m.
        side = math.pi / 4.0 * rng.integers(0, 8, 30_000)
        along = rng.uniform(-2.0, 2.0, len(side)) * math.tan(math.pi / 8.0)
        x = 2.0 * np.cos(side) - along * np.sin(side)
        y = 2.0 * np.sin(side) + along * np.cos(side)
        return np.column_stack([x, y, rng.uniform(-1.5, 1.5, len(side))])
    if name == "dome":
        vectors = np.abs(rng.normal(size=(30_000, 3)))
        return np.asarray(2.5 * vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
    if name == "strips":
        s = rng.uniform(0.0, 3.2, 30_000)
        fine = np.linspace(0.0, 3.2, 2_000)
        turn = np.interp(fine, [0.0, 0.8, 1.1, 2.1, 2.4, 3.2], [0.6, 0.6, 0.0, 0.0, -0.6, -0.6])
        x, y = (np.interp(s, fine, np.cumsum(f(turn)) * fine[1]) for f in (np.cos, np.sin))
        return np.column_stack([x, y, rng.uniform(-1.5, 1.5, len(s))])
    x, z = rng.uniform(-3.0, 3.0, (2, 30_000)) * np.array([[1.0], [0.5]])
    return np.column_stack([x, 3.0 + 0.05 * (x / 3.0) ** 2, z])


@pytest.mark.parametrize(
    ("name", "reason"),
    [("octagon", "flat parts"), ("dome", "dome"), ("strips", "no circle"), ("bent wall", None)],
)
def test_what_is_no_cylinder_is_rejected_with_the_reason(
    name: str, reason: str | None, tmp_path: Path
) -> None:
    rng = np.random.default_rng(1)
    points = points_of(name, rng)
    points += rng.normal(scale=0.002, size=points.shape)
    run = found_in(tmp_path, few_points(points))
    assert run.outputs["surfaces"].surfaces == ()
    reasons = [item["reason"] for item in run.outputs["surfaces"].details["rejected"]]
    assert reason is None or reason in reasons


def profile_of(name: str, rng: np.random.Generator) -> tuple[NDArray[np.float64], float]:
    """Return points of a vault and the (mean) radius of curvature of its crown."""
    radius, share, half = rng.uniform([2.5, 0.5, 0.5], [4.0, 0.8, 0.85])
    angles, along = rng.uniform([[-half - 0.5], [-2.5]], [[half + 0.5], [2.5]], (2, 60_000))
    if name == "relief":
        angles *= 0.4 / (half + 0.5)
        waves = rng.normal(scale=5.0, size=(2, 40))
        phases = np.outer(radius * angles, waves[0]) + np.outer(along, waves[1]) + np.arange(40.0)
        level = radius + 0.006 * np.cos(phases).sum(axis=1) / math.sqrt(20.0)
        return np.column_stack([level * np.sin(angles), along, level * np.cos(angles)]), radius
    if name == "polygon":
        width = rng.uniform(0.07, 0.17)
        level = radius / np.cos(angles % width - 0.5 * width)
        return np.column_stack(
            [level * np.sin(angles), along, level * np.cos(angles)]
        ), level.mean()
    # A basket vault has haunches of a smaller radius; an ellipse, a smaller height.
    own = np.where((np.abs(angles) < half) | (name == "ellipse"), radius, share * radius)
    x = (radius - own) * math.sin(half) * np.sign(angles) + own * np.sin(angles)
    z = (radius - own) * math.cos(half) + own * np.cos(angles)
    height = 0.95 if name == "ellipse" else 1.0
    return np.column_stack([x, along, height * z]), radius / height


# Narrow flat strips are accepted: their mean radius is within its stated error.
@pytest.mark.parametrize(
    ("name", "least"), [("ellipse", 0.5), ("relief", 0.3), ("basket", 0.1), ("polygon", 0.0)]
)
def test_the_radius_of_a_crown_is_as_accurate_as_stated(
    name: str, least: float, tmp_path: Path
) -> None:
    # The radius of this basket vault is 0.1 m off in the search, which includes the haunches.
    rng = np.random.default_rng(346 if name == "basket" else 8)
    ratios = []
    for case in range(4):
        points, radius = profile_of(name, rng)
        points += rng.normal(scale=0.002, size=points.shape)
        run = found_in(tmp_path / str(case), few_points(points))
        (found,) = run.outputs["surfaces"].surfaces
        ratios.append((found.radius_m - radius) / found.sigma_radius_m)
        codes = {event.diagnostic.code for event in run.events if event.diagnostic}
        assert name != "ellipse" or "profile-no-circle" in codes
    assert least < np.sqrt(np.mean(np.square(ratios))) < 1.5, ratios


def test_a_displacement_between_scans_is_part_of_the_stated_errors(tmp_path: Path) -> None:
    cloud, truth = scanned("barrel-vault")
    assert truth.surfaces is not None
    assert cloud.scan is not None
    moved = np.where(cloud.scan == 1, np.array([[0.003], [-0.0025], [0.003]]), 0.0)
    x, y, z = (np.array([cloud.x, cloud.y, cloud.z]) + moved).astype(np.float32)
    run = found_in(tmp_path, replace(cloud, x=x, y=y, z=z))
    (found,) = run.outputs["surfaces"].surfaces
    turn_deg, _, across_m = off(found, truth.surfaces.surfaces[0])
    assert 0.4 < turn_deg / found.sigma_axis_deg < 2.5
    assert 0.4 < across_m / math.sqrt(np.trace(found.covariance[:3, :3])) < 2.5


def test_noise_along_the_rays_does_not_shorten_the_radius_of_a_column(tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    ratios = []
    for case in range(3):
        azimuth, elevation = rng.uniform([[-0.0832], [-0.3]], [[0.0832], [0.3]], (2, 40_000))
        level = 3.0 * np.cos(azimuth) - np.sqrt(0.25**2 - (3.0 * np.sin(azimuth)) ** 2)
        level += rng.normal(scale=0.01, size=len(level)) * np.cos(elevation)
        points = level * np.stack([-np.cos(azimuth), np.sin(azimuth), np.tan(elevation)])
        run = found_in(tmp_path / str(case), few_points(points.T))
        (found,) = run.outputs["surfaces"].surfaces
        ratios.append((found.radius_m - 0.25) / found.sigma_radius_m)
    assert np.sqrt(np.mean(np.square(ratios))) < 2.0


@pytest.mark.parametrize(
    ("noise_m", "half_rad"), [*long_only((0.005, 2.6)), (0.02, 2.6), (0.005, math.pi)]
)
def test_a_leaning_cylinder_without_stations_is_found_despite_noise(
    noise_m: float, half_rad: float, tmp_path: Path
) -> None:
    rng = np.random.default_rng(2)
    axis = np.array([0.6, 0.0, 0.8])
    angles, along = rng.uniform(-half_rad, half_rad, 200_000), rng.uniform(0.0, 4.0, 200_000)
    # Few points are on a sector of 23 degrees.
    angles[:190_000][np.abs(angles[:190_000] - 1.0) < 0.2] = 0.0
    radial = np.array([0.8, 0.0, -0.6]) * np.cos(angles)[:, None]
    radial += np.array([0.0, 1.0, 0.0]) * np.sin(angles)[:, None]
    distances = 1.2 + rng.normal(scale=noise_m, size=len(angles))
    points = along[:, None] * axis + distances[:, None] * radial
    points[:20_000] = rng.uniform(-4.0, 4.0, (20_000, 3))
    cloud = few_points(points)
    cloud = PointCloud(origin=cloud.origin, x=cloud.x, y=cloud.y, z=cloud.z, up=cloud.up)
    run = found_in(tmp_path, cloud)
    (found,) = run.outputs["surfaces"].surfaces
    assert found.name == "cylinder 0"
    assert abs(found.radius_m - 1.2) < min(6.0 * found.sigma_radius_m, 0.1 * noise_m)
    turn = np.linalg.norm(np.cross(found.shape.axis_world, axis))
    assert math.degrees(turn) < 6.0 * found.sigma_axis_deg
    assert not found.shape.is_concave
    assert found.is_closed == (half_rad == math.pi)
    if found.is_closed:
        # A closed surface is cut where it has the fewest points.
        beside = np.cross(found.shape.axis_world, found.zero_world)
        start = math.cos(found.arc_rad[0]) * found.zero_world
        start += math.sin(found.arc_rad[0]) * beside
        assert abs(math.atan2(start[1], start @ [0.8, 0.0, -0.6]) - 1.0) < 0.2


@pytest.mark.parametrize("half_angle_deg", [3.0, *long_only(10.0), 25.0])
def test_a_cone_is_found_by_its_method_and_no_cylinder_is(
    half_angle_deg: float, tmp_path: Path
) -> None:
    rng = np.random.default_rng(3)
    axis = np.array([0.6, 0.0, -0.8])
    slope = math.tan(math.radians(half_angle_deg))
    far_m = 2.5 / slope
    along = np.sqrt(rng.uniform(max(0.4 * far_m, far_m - 5.0) ** 2, far_m**2, 80_000))
    angles = rng.uniform(-1.7, 1.7, len(along))
    outwards = np.array([0.8, 0.0, 0.6]) * np.cos(angles)[:, None]
    outwards += np.array([0.0, 1.0, 0.0]) * np.sin(angles)[:, None]
    points = along[:, None] * axis + (along * slope)[:, None] * outwards
    points += rng.normal(scale=0.002, size=points.shape)
    middle = points.mean(axis=0)
    cloud = few_points(points - middle)
    run = run_trial(Trial(method=SurfaceCone, inputs={"cloud": cloud}, params={}), tmp_path)
    (found,) = run.outputs["surfaces"].surfaces
    found_deg = math.degrees(found.shape.half_angle_rad)
    assert found_deg == pytest.approx(half_angle_deg, abs=0.005)
    assert np.linalg.norm(found.shape.apex_world + middle) < 0.02
    assert found.along_m == pytest.approx((along.min(), along.max()), abs=0.1)
    cylinders = found_in(tmp_path / "cylinder", cloud).outputs["surfaces"]
    assert cylinders.surfaces == ()
    assert "cone" in {item["reason"] for item in cylinders.details["rejected"]}


@pytest.mark.parametrize("seed", range(3))
def test_a_column_is_no_cone_whichever_way_noise_makes_it_taper(seed: int, tmp_path: Path) -> None:
    cloud, _ = scanned("column", seed)
    trial = Trial(method=SurfaceCone, inputs={"cloud": cloud}, params={}, seed=seed)
    surfaces = run_trial(trial, tmp_path).outputs["surfaces"]
    assert surfaces.surfaces == ()
    assert "cylinder" in {item["reason"] for item in surfaces.details["rejected"]}
