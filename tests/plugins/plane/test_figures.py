"""What is drawn of planes: the data of each panel, not its looks."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.figures import (
    draw_accumulator,
    draw_deviations,
    draw_normals,
    draw_planes,
    draw_sections,
    draw_space,
    draw_thickness,
)
from orthoflow_plugins.plane.kernels import HISTOGRAM_BINS, PlanGrid
from orthoflow_plugins.plane.planes import Deviations, normality, rectangle_m
from orthoflow_plugins.plane.region import Region, region_proposer
from orthoflow_plugins.plane.thickness import RowPoints

from orthoflow.files.drawing import plane_ink
from orthoflow.geometry import Plane, wall_axes
from orthoflow.products import Planes, Spread, Thickness
from tests import samples
from tests.plane_scenes import Rectangle, cloud_of, context, prepared, sampled, search_in

ORIGIN: Final = (100.0, 200.0, 50.0)
UP: Final = np.array([0.0, 0.0, 1.0])
NAMES: Final = ("front", "left", "floor")


def planes_of() -> Planes:
    """A front wall at y = 2 seen from the south, a left one at x = -3 seen from the east, a floor.

    The front wall has two parts.
    """
    normals = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    halves = np.array([[3.0, 1.5], [2.0, 1.5], [3.0, 2.0]])
    corners = []
    for normal, offset_m, (a, b) in zip(normals, (-2.0, -3.0, -1.5), halves, strict=True):
        plane = Plane(normal=normal, offset_m=offset_m)
        corners.append(rectangle_m(plane, wall_axes(normal, UP), np.array([-a, a, -b, b])))
    box = np.array(corners) + ORIGIN
    half = box[:1].copy()
    half[:, 2:] = 0.5 * (box[:1, 2:] + box[:1, [1, 0]])
    return samples.planes(
        normal=normals,
        offset=np.array([-2.0, -3.0, -1.5]) + normals @ ORIGIN,
        corners=box,
        n_points=np.array([3000, 2000, 1000]),
        rms_m=np.full(3, 0.002),
        names=NAMES,
        part_corners=np.concatenate([half, box]),
        part_plane=np.array([0, 0, 1, 2], dtype=np.int32),
    )


def lines(axes: Any) -> list[NDArray[np.float64]]:
    """(2, n) what each line of a panel shows."""
    return [np.array(line.get_data(), dtype=np.float64) for line in axes.lines]


def image(axes: Any) -> tuple[NDArray[np.float64], tuple[float, ...]]:
    (shown,) = axes.images
    return np.ma.filled(shown.get_array().astype(float), np.nan), tuple(shown.get_extent())


def test_deviations_are_drawn_with_the_gauss_curve_of_their_fit(
    drawings: dict[str, Any], tmp_path: Path
) -> None:
    edges_m = np.linspace(-0.05, 0.05, HISTOGRAM_BINS + 1)
    rng = np.random.default_rng(0)
    values_m = [rng.normal(0.001 * k, 0.003, 4_000 + k) for k in range(3)]
    histogram = np.array([np.histogram(values, edges_m)[0] for values in values_m])
    n_points = np.array([len(values) for values in values_m])
    deviations = Deviations(
        n_points=n_points,
        rms_m=np.full(3, 0.004),
        n_fit=n_points - 7,
        # The last has no distribution, and its deviation is zero: bars alone.
        rms_fit_m=np.array([0.003, 0.003, 0.0]),
        mean_fit_m=np.array([0.0, 0.001, 0.002]),
        histogram=histogram,
        extents_m=np.zeros((3, 4)),
        tolerance_m=0.05,
        fit_tolerance_m=0.015,
    )
    shapes = [normality(row, tolerance_m=0.05, fit_tolerance_m=0.015) for row in histogram]
    draw_deviations(context(tmp_path), planes_of(), deviations, [*shapes[:2], None])
    panels = [axes for axes in drawings["deviations"].axes if axes.axison]
    assert len(panels) == 5
    for k, axes in enumerate(axes for axes in panels if axes.patches):
        values, edges_mm, _ = axes.patches[0].get_data()
        per_point = 100.0 / histogram[k].sum() / (100.0 / HISTOGRAM_BINS)
        np.testing.assert_allclose(values, histogram[k] * per_point)
        np.testing.assert_allclose(edges_mm, 1e3 * edges_m)
        assert axes.get_title() == f"{NAMES[k]}: SD {3.0 if k < 2 else 0.0:.1f} mm"
        assert len(axes.lines) == (1 if k < 2 else 0)
        for x_mm, curve in lines(axes):
            # As many points below it as the fit had, about their mean.
            assert curve.sum() == pytest.approx(per_point * deviations.n_fit[k], rel=1e-6)
            mean_mm = (x_mm @ curve) / curve.sum()
            assert mean_mm == pytest.approx(1.0 * k, abs=1e-6)
            sigma_mm = math.sqrt((x_mm - mean_mm) ** 2 @ curve / curve.sum())
            assert sigma_mm == pytest.approx(3.0, rel=1e-6)
    for shape, axes in zip(shapes[:2], (axes for axes in panels if not axes.patches), strict=True):
        assert shape is not None
        np.testing.assert_array_equal(lines(axes)[1], [shape.expected_sigmas, shape.found_sigmas])


def test_planes_are_drawn_with_their_points_and_rectangles(
    drawings: dict[str, Any], tmp_path: Path
) -> None:
    planes = planes_of()
    rng = np.random.default_rng(0)
    points_m = rng.uniform(-1.0, 1.0, (400, 3))
    plane_of_point = rng.integers(-1, 3, 400)
    cloud = cloud_of(points_m, origin=ORIGIN)
    draw_planes(context(tmp_path), planes, points_m, plane_of_point, cloud)
    left, right = drawings["planes"].axes
    # Seen from a third of the way round and 35 degrees up: these three are its axes.
    azimuth, elevation = math.radians(-60.0), math.radians(35.0)
    towards = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    across = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    view = np.array([across, math.cos(elevation) * UP - math.sin(elevation) * towards])
    flat = points_m @ view.T
    # What is on no plane, and the planes, which all turn to the eye.
    for k, drawn in zip((-1, 0, 1, 2), lines(left), strict=True):
        np.testing.assert_allclose(drawn, flat[plane_of_point == k].T, atol=1e-6)
    assert planes.part_corners is not None
    backdrop, *rectangles = lines(right)
    np.testing.assert_allclose(backdrop, flat.T, atol=1e-6)
    for corners, drawn in zip(planes.part_corners, rectangles, strict=True):
        around = (corners[[0, 1, 2, 3, 0]] - np.array(ORIGIN)) @ view.T
        np.testing.assert_allclose(drawn, around.T, atol=1e-9)
    # One name per plane, also where it has two parts.
    assert [text.get_text() for text in drawings["planes"].legends[0].texts] == list(NAMES)


def test_thickness_is_drawn_by_plane_material_and_row(
    drawings: dict[str, Any], tmp_path: Path
) -> None:
    bricks = tuple(
        Spread(low=0.0, high=1.0, n_points=99, sigma_m=sigma_m, name="brick")
        for sigma_m in (0.003, 0.004)
    )
    first = Thickness(sigma_m=0.001, width_95_m=0.004, scan_step_m=0.005, material=bricks)
    third = Thickness(sigma_m=0.002, width_95_m=0.008, scan_step_m=0.006)
    along = np.linspace(0.0, 2.0, 9)
    row = RowPoints(
        row=17, scan=3, along_m=along, distance_m=0.001 * along, intensity=np.linspace(0.0, 1.0, 9)
    )
    materials = {"dark": (0.25, 0.5), "bright": (0.75, 0.875)}
    draw_thickness(context(tmp_path), planes_of(), (None, None, None), None, {})
    assert not drawings
    draw_thickness(context(tmp_path), planes_of(), (first, None, third), row, materials)
    sigmas, by_material, in_row = drawings["thickness"].axes
    np.testing.assert_allclose([bar.get_width() for bar in sigmas.patches], [1.0, 2.0])
    assert [text.get_text() for text in sigmas.get_yticklabels()] == ["front", "floor"]
    np.testing.assert_allclose(lines(sigmas)[0], [[5.0, 6.0], [0.0, 1.0]])
    np.testing.assert_allclose([bar.get_width() for bar in by_material.patches], [3.0, 4.0])
    labels = [text.get_text() for text in by_material.get_yticklabels()]
    assert labels == ["brick, front", "brick, front"]
    every, dark, bright = lines(in_row)
    np.testing.assert_allclose(every, [along, along])
    np.testing.assert_allclose(dark[0], along[2:5])
    np.testing.assert_allclose(bright, [along[6:8], along[6:8]])


def test_the_accumulator_is_drawn_with_the_walls_as_lines_and_as_circles(
    drawings: dict[str, Any], tmp_path: Path
) -> None:
    rng = np.random.default_rng(0)
    low_m = np.array([-4.0, -3.0, -2.0])
    plan, votes = rng.integers(0, 9, (16, 14)), rng.integers(0, 9, (12, 24))
    # A plan and its votes, as a detector keeps them.
    picture: Any = SimpleNamespace(
        grid=PlanGrid(basis=np.eye(3), low_m=low_m, cell_m=0.5, shape=(16, 14, 8)),
        plan=plan,
        first=votes,
        centre_m=np.array([0.0, 0.5]),
        reach_m=6.0,
        voters="cells vote",
    )
    cloud = cloud_of(np.zeros((3, 3)), origin=ORIGIN)
    draw_accumulator(context(tmp_path), picture, planes_of(), cloud)
    left, right, *_ = drawings["accumulator"].axes
    for axes, values, span in (
        (left, plan, (-4.0, 4.0, -3.0, 4.0)),
        (right, votes, (0.0, 180.0, -6.0, 6.0)),
    ):
        shown, extent = image(axes)
        np.testing.assert_allclose(shown, values.T)
        assert extent == span
    # The floor is no line of the plan.
    _, front, side = lines(left)
    np.testing.assert_allclose([np.sort(front[0]), front[1]], [[-3.0, 3.0], [2.0, 2.0]])
    np.testing.assert_allclose([side[0], np.sort(side[1])], [[-3.0, -3.0], [-2.0, 2.0]])
    # r = x cos + y sin from the centre of the plan: y = 2 at 90 degrees, x = -3 at 0.
    marks = np.array([line[:, 0] for line in lines(right)])
    np.testing.assert_allclose(marks[1:], [[90.0, 1.5], [0.0, -3.0]], atol=1e-9)
    # A plane has one colour in all figures.
    for axes in (left, right):
        assert [line.get_color() for line in axes.lines[1:]] == [plane_ink(k) for k in (0, 1)]


def test_sections_count_the_points_of_one_layer_of_voxels(
    drawings: dict[str, Any], tmp_path: Path
) -> None:
    low, high = np.array([-3.0, -2.0, -1.5]), np.array([3.0, 2.0, 1.5])
    points_m = np.random.default_rng(0).uniform(low, high, (20_000, 3))
    cell_m = 0.25
    draw_sections(context(tmp_path), planes_of(), cloud_of(points_m, origin=ORIGIN), cell_m=cell_m)
    axes_of = ((0, 1, 2), (0, 2, 1), (1, 2, 0))
    for axes, (first, second, across) in zip(drawings["voxels"].axes[:3], axes_of, strict=True):
        shown, extent = image(axes)
        near = points_m[np.abs(points_m[:, across]) < 0.5 * cell_m]
        for at, axis, counts in ((0, first, shown.sum(axis=0)), (2, second, shown.sum(axis=1))):
            # Five voxels around the planes, and whole voxels.
            assert extent[at] == pytest.approx(low[axis] - 5 * cell_m)
            assert 0.0 <= extent[at + 1] - (high[axis] + 5 * cell_m) < 1.01 * cell_m
            cells = np.floor((near[:, axis] - extent[at]) / cell_m).astype(int)
            np.testing.assert_allclose(counts, np.bincount(cells, minlength=len(counts)))


def test_an_accumulator_of_directions_is_drawn_with_the_planes_it_found(
    drawings: dict[str, Any], tmp_path: Path
) -> None:
    rng = np.random.default_rng(0)
    best = rng.uniform(-1.0, 4.0, (12, 6))
    over_omega, over_phi = (
        {30.0 * k: rng.uniform(0.0, 9.0, (count, 8)) for k in range(3)} for count in (12, 6)
    )
    planes = planes_of()
    lean, turn = math.radians(20.0), math.radians(210.0)
    normal = planes.normal.copy()
    # Omega 210 degrees and phi 20 is the same plane as omega 30 and phi -20.
    normal[0] = [math.cos(lean) * math.cos(turn), math.cos(lean) * math.sin(turn), math.sin(lean)]
    draw_space(context(tmp_path), best, over_omega, over_phi, 2.5, replace(planes, normal=normal))
    axes, _ = drawings["accumulator"].axes
    shown, extent = image(axes)
    np.testing.assert_allclose(shown, np.maximum(best.T, 0.0))
    assert extent == (0.0, 180.0, -90.0, 90.0)
    circles = np.array([line[:, 0] for line in lines(axes)])
    np.testing.assert_allclose(circles[:2], [[30.0, -20.0], [0.0, 0.0]], atol=1e-9)
    assert circles[2, 1] == pytest.approx(90.0)
    panels = np.array(drawings["accumulator-sections"].axes[:6]).reshape(3, 2).T
    for k in range(3):
        for row, votes, span in ((0, over_omega, (0.0, 180.0)), (1, over_phi, (-90.0, 90.0))):
            shown, extent = image(panels[row, k])
            np.testing.assert_allclose(shown, votes[30.0 * k].T)
            assert extent == (*span, -2.5, 2.5)


def test_normals_are_drawn_by_points_and_over_the_first_plane(
    drawings: dict[str, Any], tmp_path: Path
) -> None:
    wall = Rectangle("wall", (0, 2, 0), (1.5, 0, 0), (0, 0, 1.0), 60_000)
    # A slope of 30 degrees off the wall, half a metre before it.
    up = (0, 0.3 * math.sin(math.radians(30.0)), 0.3 * math.cos(math.radians(30.0)))
    points = sampled((wall, Rectangle("slope", (0, 1.5, 0), (0.3, 0, 0), up, 9_000)), noise_m=1e-3)
    params = Region.Params(neighbourhood_m=0.15, cell_m=0.05, min_share=0.005)
    regions = region_proposer(search_in(prepared(points)), params, viewer_m=np.zeros(3))
    planes = planes_of()
    corners = planes.corners.copy()
    corners[0] = np.array([[-1.5, 2, 1.0], [-1.5, 2, -1.0], [1.5, 2, -1.0], [1.5, 2, 1.0]]) + ORIGIN
    ctx = context(tmp_path)
    cloud = cloud_of(points, origin=ORIGIN)
    draw_normals(ctx, regions.voxels, len(regions.planes), replace(planes, corners=corners), cloud)
    metrics = {metric.name: metric.value for metric in ctx.metrics}
    # A slope's error is s / (extent sqrt(n)) about both axes, with 225 points over 15 cm; half of
    # the normals are within 1.18 of it.
    expected_deg = math.degrees(1.18 * 1e-3 / (0.15 / math.sqrt(12.0) * 15.0))
    assert metrics == {
        "n_regions": 2,
        "neighbourhood_mm": pytest.approx(150.0),
        "cell_mm": pytest.approx(50.0),
        "normal_scatter_deg": pytest.approx(expected_deg, rel=0.1),
    }
    left, middle, right, _ = drawings["normals"].axes
    np.testing.assert_allclose(left.patches[0].get_data()[1], np.arange(91.0))
    np.testing.assert_allclose(middle.patches[0].get_data()[1], np.arange(-90.0, 91.0))
    shown, extent = image(right)
    np.testing.assert_allclose(extent, (0.0, 3.0, 2.0, 0.0))
    assert shown.shape == (40, 60)
    # The slope stands before the wall there and is cut off at 15 degrees.
    assert shown[20, 30] == pytest.approx(15.0)
    assert np.nanmedian(shown[:8]) < 0.2
