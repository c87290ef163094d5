"""Planes of the sample, fitted to all points, and the points that each of them gets."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane import final_fit
from orthoflow_plugins.plane.candidates import Candidate, FoundPlane, verify
from orthoflow_plugins.plane.final_fit import fit_to_all, label, name_points
from orthoflow_plugins.plane.sample import PreparedCloud, Unassigned, prepare
from orthoflow_plugins.plane.support import cell_for

from orthoflow.geometry import Plane, angle_between_deg
from tests.plane_scenes import RULES, Rectangle, cloud_of, sampled

# Three quarters of the points and a quarter.
WALLS = (
    Rectangle("south", (0, 2, 0), (2, 0, 0), (0, 0, 1), 30_000),
    Rectangle("west", (-2, 0, 0), (0, 2, 0), (0, 0, 1), 10_000),
)


@pytest.fixture(scope="module")
def points() -> NDArray[np.float64]:
    """Of both walls, mixed as several scans mix them."""
    return np.random.default_rng(1).permutation(sampled(WALLS, noise_m=0.002))


@pytest.fixture
def cloud(points: NDArray[np.float64]) -> PreparedCloud:
    return prepare(cloud_of(points), np.eye(3), cell_m=0.5, least_share=0.01, parts=2)


@pytest.fixture
def found(cloud: PreparedCloud) -> list[FoundPlane]:
    """Both walls, from candidates a centimetre off."""
    unassigned = Unassigned.of(cloud)
    planes = []
    for wall in WALLS:
        offset_m = float(wall.normal @ np.array(wall.centre)) + 0.01
        rough = Candidate(
            plane=Plane(normal=wall.normal, offset_m=offset_m), family="wall", votes=1.0
        )
        item = verify(rough, unassigned, RULES)
        assert item is not None
        unassigned.claim(item.claim(RULES.find_m))
        planes.append(item)
    return planes


def assert_as_true(item: FoundPlane, wall: Rectangle, *, within_m: float) -> None:
    plane = item.raster.plane
    away_deg = angle_between_deg(plane.normal, wall.normal)
    assert min(away_deg, 180.0 - away_deg) < 0.01
    assert abs(float(plane.distances_m(np.array([wall.centre]))[0])) < within_m


@pytest.mark.parametrize("most", [40_000, 20_001, 10_000])
def test_all_points_fix_a_plane_or_of_many_every_so_many_th_block(
    found: list[FoundPlane],
    cloud: PreparedCloud,
    monkeypatch: pytest.MonkeyPatch,
    most: int,
) -> None:
    monkeypatch.setattr(final_fit, "_FITTED_MOST", most)
    every = 40_000 // most
    fitted = fit_to_all(found, cloud, RULES)
    assert len(fitted) == 2
    for item, wall in zip(fitted, WALLS, strict=True):
        # 2 mm of noise over so many points: three standard deviations.
        assert_as_true(item, wall, within_m=3.0 * 0.002 / math.sqrt(wall.n_points / every))
        # Blocks are drawn by chance, 40 of them about.
        expected = wall.n_points / every
        assert item.support.n_points == pytest.approx(expected, rel=0.03 if every == 1 else 0.4)
    # Of all candidates the sample's planes are what the detector said.
    assert [item.candidate for item in fitted] == [item.candidate for item in found]


def test_planes_that_all_points_do_not_bear_out_are_left_out(
    found: list[FoundPlane], cloud: PreparedCloud
) -> None:
    kept = fit_to_all(found, cloud, replace(RULES, least_share=0.3))
    assert [item.candidate for item in kept] == [found[0].candidate]
    assert fit_to_all(found, cloud, replace(RULES, least_share=0.8)) == []
    assert fit_to_all([], cloud, RULES) == []


def test_cells_are_as_fine_as_all_points_allow(
    found: list[FoundPlane], cloud: PreparedCloud
) -> None:
    for every in (1, 4):
        raster = final_fit._raster(found[0], cloud, 0.05, every)
        left, right, top, bottom = found[0].support.bounds_m
        np.testing.assert_allclose(raster.low_m, [left - 0.05, top - 0.05])
        area_m2 = found[0].support.cells.sum() * found[0].raster.cell_m ** 2
        cell_m = min(found[0].raster.cell_m, cell_for(found[0].support.n_points / every, area_m2))
        assert raster.cell_m == pytest.approx(cell_m)
        assert raster.shape == (
            math.ceil((bottom - top + 0.1) / cell_m),
            math.ceil((right - left + 0.1) / cell_m),
        )
    # A sample that stands for ten times as many points.
    few = replace(cloud, sample=replace(cloud.sample, index=cloud.sample.index[::10]))
    coarse = replace(found[0], raster=replace(found[0].raster, cell_m=1.0))
    area_m2 = float(coarse.support.cells.sum())
    cell_m = final_fit._raster(coarse, few, 0.05, 1).cell_m
    assert cell_m == pytest.approx(cell_for(10.0 * coarse.support.n_points, area_m2))


def test_points_belong_to_the_nearest_plane_whose_rectangle_holds_them(
    found: list[FoundPlane], cloud: PreparedCloud, points: NDArray[np.float64]
) -> None:
    label(found, cloud, 0.05)
    away_m = np.abs(np.column_stack([item.raster.plane.distances_m(points) for item in found]))
    # Within the tolerance of one alone, and apart from the corner.
    for k in range(2):
        alone = (away_m[:, k] < 0.049) & (away_m[:, 1 - k] > 0.051)
        assert alone.sum() > 9_000
        assert (cloud.claims[alone] == k).mean() > 0.999
    corner = (away_m < 0.049).all(axis=1) & (np.abs(away_m[:, 0] - away_m[:, 1]) > 1e-4)
    assert corner.sum() > 30
    np.testing.assert_array_equal(cloud.claims[corner], away_m[corner].argmin(axis=1))
    names = np.array([7, 3, -1], dtype=np.int16)
    labels = np.empty(len(points), dtype=np.int16)
    name_points(cloud, names, labels)
    np.testing.assert_array_equal(labels, names[cloud.claims])


@pytest.mark.parametrize("gap_m", [0.0, 0.8], ids=["connected", "in two parts"])
def test_a_frame_around_a_wall_leaves_the_wall_its_points(gap_m: float) -> None:
    # Its rectangle covers the wall, and its plane runs through the wall at an angle of one degree.
    walls = (Rectangle("wall", (0, 2, 0), (2, 0, 0), (0, 0, 1), 60_000),)
    lean = 0.02
    frame = (
        Rectangle("side", (2.35, 1.98, 0), (0.15, 0, 0), (0, lean, 1), 6_000),
        Rectangle(
            "below", (-gap_m, 1.98 - 1.25 * lean, -1.25), (2.5, 0, 0), (0, 0.2 * lean, 0.2), 9_000
        ),
    )
    on_wall, on_frame = sampled(walls, noise_m=0.004), sampled(frame, noise_m=0.002)
    found = []
    for points, normal in ((on_wall, (0.0, 1.0, 0.0)), (on_frame, (0.0, 1.0, -lean))):
        alone = prepare(cloud_of(points), np.eye(3), cell_m=0.5, least_share=0.01, parts=2)
        unit = np.array(normal) / np.linalg.norm(normal)
        offset_m = float(np.median(points @ unit))
        rough = Candidate(plane=Plane(normal=unit, offset_m=offset_m), family="wall", votes=1.0)
        item = verify(rough, Unassigned.of(alone), RULES)
        assert item is not None
        found.append(item)
    both = np.concatenate([on_wall, on_frame])
    cloud = prepare(cloud_of(both), np.eye(3), cell_m=0.5, least_share=0.01, parts=2)
    fitted = fit_to_all(found, cloud, RULES)
    for item, rectangle in zip(fitted, (*walls, frame[0]), strict=True):
        assert_as_true(item, rectangle, within_m=0.0003)
    label(fitted, cloud, RULES.find_m)
    assert (cloud.claims[: len(on_wall)] == 0).mean() > 0.95
    assert (cloud.claims[len(on_wall) :] == 1).mean() > 0.95
