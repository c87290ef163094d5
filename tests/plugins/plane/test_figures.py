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
from orthoflow_plugins.plane.planes import Deviations, Normality, normality
from orthoflow_plugins.plane.region import Region, region_proposer
from orthoflow_plugins.plane.thickness import RowPoints

from orthoflow.files.drawing import COLUMN_INCHES, plane_ink
from orthoflow.geometry import wall_axes
from orthoflow.products import Planes, Spread, Thickness
from tests import samples
from tests.plane_scenes import Rectangle, cloud_of, context, prepared, sampled, search_in

ORIGIN: Final = (100.0, 200.0, 50.0)
UP: Final = np.array([0.0, 0.0, 1.0])
# A front wall at y = 2 seen from the south, a left one at x = -3 seen from the east, a floor.
FACES: Final = (
    ((0.0, -1.0, 0.0), (0.0, 2.0, 0.0), (3.0, 1.5)),
    ((1.0, 0.0, 0.0), (-3.0, 0.0, 0.0), (2.0, 1.5)),
    ((0.0, 0.0, 1.0), (0.0, 0.0, -1.5), (3.0, 2.0)),
)
NAMES: Final = ("front", "left", "floor")


def planes_of(*, count: int = 3, parts: bool = False) -> Planes:
    normals, corners, offsets = [], [], []
    for k in range(count):
        normal, centre, (a, b) = FACES[k % len(FACES)]
        u, v = wall_axes(np.array(normal), UP)
        middle = np.array(centre) + ORIGIN
        normals.append(normal)
        offsets.append(float(np.array(normal) @ middle))
        corners.append([middle - a * u - b * v, middle - a * u + b * v,
                        middle + a * u + b * v, middle + a * u - b * v])  # fmt: skip
    box = np.array(corners)
    halves = box.copy()
    halves[:, 2:] = 0.5 * (box[:, 2:] + box[:, [1, 0]])
    return samples.planes(
        normal=np.array(normals),
        offset=np.array(offsets),
        corners=box,
        n_points=np.arange(count, 0, -1) * 1000,
        rms_m=np.full(count, 0.002),
        names=tuple(f"{NAMES[k % 3]}{'' if k < 3 else k}" for k in range(count)),
        part_corners=np.concatenate([halves[:1], box[:1], box[1:]]) if parts else None,
        part_plane=np.array([0, 0, *range(1, count)], dtype=np.int32) if parts else None,
    )


def lines(axes: Any) -> list[NDArray[np.float64]]:
    """(2, n) what each line of a panel shows."""
    return [np.array(line.get_data(), dtype=np.float64) for line in axes.lines]


def image(axes: Any) -> tuple[NDArray[np.float64], tuple[float, ...]]:
    (shown,) = axes.images
    return np.ma.filled(shown.get_array().astype(float), np.nan), tuple(shown.get_extent())


# --- deviations ---


def deviations_of(count: int) -> tuple[Deviations, list[Normality | None]]:
    find_m, fit_m = 0.05, 0.015
    edges_m = np.linspace(-find_m, find_m, HISTOGRAM_BINS + 1)
    rng = np.random.default_rng(0)
    values_m = [rng.normal(0.001 * k, 0.003, 4_000 + k) for k in range(count)]
    histogram = np.array([np.histogram(values, edges_m)[0] for values in values_m])
    n_points = np.array([len(values) for values in values_m])
    deviations = Deviations(
        n_points=n_points,
        rms_m=np.full(count, 0.004),
        n_fit=n_points - 7,
        rms_fit_m=np.array([0.003] * (count - 1) + [0.0]),
        mean_fit_m=0.001 * np.arange(count),
        histogram=histogram,
        extents_m=np.zeros((count, 4)),
        tolerance_m=find_m,
        fit_tolerance_m=fit_m,
    )
    shapes = [normality(row, tolerance_m=find_m, fit_tolerance_m=fit_m) for row in histogram]
    return deviations, [*shapes[:-1], None]


def test_deviations_are_drawn_with_the_gauss_curve_of_their_fit(
    drawings: dict[str, Any], tmp_path: Path
) -> None:
    deviations, shapes = deviations_of(3)
    draw_deviations(context(tmp_path), planes_of(), deviations, shapes)
    panels = [axes for axes in drawings["deviations"].axes if axes.axison]
    # The last has no distribution, and its deviation is zero: bars alone.
    assert len(panels) == 5
    bars = [axes for axes in panels if axes.patches]
    for k, axes in enumerate(bars):
        (stairs,) = axes.patches
        values, edges_mm, _ = stairs.get_data()
        counts, width_mm = deviations.histogram[k], 100.0 / HISTOGRAM_BINS
        per_point = 100.0 / max(1.0, counts.sum()) / width_mm
        np.testing.assert_allclose(values, counts * per_point)
        np.testing.assert_allclose(edges_mm, np.linspace(-50.0, 50.0, HISTOGRAM_BINS + 1))
        assert axes.get_title() == f"{NAMES[k]}: SD {3.0 if k < 2 else 0.0:.1f} mm"
        assert axes.patches[0].get_facecolor()[:3] == pytest.approx(plane_ink(k))
        # One scale, so that planes compare.
        assert axes.get_ylim() == bars[0].get_ylim()
        assert len(axes.lines) == (1 if k < 2 else 0)
        for x_mm, curve in lines(axes):
            # As many points below it as the fit had, about their mean.
            assert curve.sum() == pytest.approx(per_point * deviations.n_fit[k], rel=1e-6)
            mean_mm = (x_mm @ curve) / curve.sum()
            assert mean_mm == pytest.approx(1.0 * k, abs=1e-6)
            sigma_mm = math.sqrt((x_mm - mean_mm) ** 2 @ curve / curve.sum())
            assert sigma_mm == pytest.approx(3.0, rel=1e-6)
    for k, axes in enumerate(axes for axes in panels if not axes.patches):
        shape = shapes[k]
        assert shape is not None
        diagonal, quantiles = lines(axes)
        reach = shape.expected_sigmas[-1]
        np.testing.assert_array_equal(diagonal, [[-reach, reach], [-reach, reach]])
        np.testing.assert_array_equal(quantiles, [shape.expected_sigmas, shape.found_sigmas])


# --- planes in space ---


@pytest.mark.parametrize("parts", [False, True])
def test_planes_are_drawn_with_their_points_and_rectangles(
    parts: bool, drawings: dict[str, Any], tmp_path: Path
) -> None:
    planes = planes_of(parts=parts)
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
    above = math.cos(elevation) * UP - math.sin(elevation) * towards
    # The wall on the left and the floor turn to the eye; the front wall (-y) does as well.
    view = np.array([across, above])
    eye = math.cos(elevation) * towards + math.sin(elevation) * UP
    shown = [k for k in range(3) if planes.normal[k] @ eye > 0.0]
    assert shown == [0, 1, 2]
    flat = points_m.astype(np.float64) @ view.T
    grey, *coloured = lines(left)
    np.testing.assert_allclose(grey, flat[plane_of_point < 0].T, atol=1e-6)
    assert len(coloured) == len(shown)
    for k, drawn in zip(shown, coloured, strict=True):
        np.testing.assert_allclose(drawn, flat[plane_of_point == k].T, atol=1e-6)
    backdrop, *rectangles = lines(right)
    np.testing.assert_allclose(backdrop, flat.T, atol=1e-6)
    expected = planes.part_corners if planes.part_corners is not None else planes.corners
    assert len(rectangles) == len(expected)
    for corners, drawn in zip(expected, rectangles, strict=True):
        around = (corners[[0, 1, 2, 3, 0]] - np.array(ORIGIN)) @ view.T
        np.testing.assert_allclose(drawn, around.T, atol=1e-9)
    # One name per plane, also where it has two parts.
    assert [text.get_text() for text in drawings["planes"].legends[0].texts] == list(NAMES)
    corners = (planes.corners.reshape(-1, 3) - ORIGIN) @ view.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    for axes in (left, right):
        for k, limits in enumerate((axes.get_xlim(), axes.get_ylim())):
            span = high[k] - low[k]
            np.testing.assert_allclose(limits, [low[k] - 0.04 * span, high[k] + 0.04 * span])


# --- thickness ---


def spreads(*sigmas_m: float, name: str | None = None) -> tuple[Spread, ...]:
    return tuple(
        Spread(low=10.0 * k, high=10.0 * k + 4.0, n_points=99, sigma_m=sigma_m, name=name)
        for k, sigma_m in enumerate(sigmas_m)
    )


def test_thickness_is_drawn_by_plane_class_material_and_row(
    drawings: dict[str, Any], tmp_path: Path
) -> None:
    planes = planes_of()
    found = (
        Thickness(
            sigma_m=0.001,
            width_95_m=0.004,
            scan_step_m=0.005,
            incidence_deg=spreads(0.001, 0.002),
            material=spreads(0.003, 0.004, name="brick"),
        ),
        None,
        Thickness(sigma_m=0.002, width_95_m=0.008, scan_step_m=0.006, range_m=spreads(0.005)),
    )
    along = np.linspace(0.0, 2.0, 9)
    row = RowPoints(
        row=17, scan=3, along_m=along, distance_m=0.001 * along, intensity=0.125 * np.arange(9)
    )
    materials = {"dark": (0.25, 0.5), "bright": (0.75, 0.875)}
    draw_thickness(context(tmp_path), planes, found, row, materials)
    figure = drawings["thickness"]
    sigmas, incidence, ranges, by_material, in_row = figure.axes
    np.testing.assert_allclose([bar.get_width() for bar in sigmas.patches], [1.0, 2.0])
    assert [text.get_text() for text in sigmas.get_yticklabels()] == ["front", "floor"]
    np.testing.assert_allclose(lines(sigmas)[0], [[5.0, 6.0], [0.0, 1.0]])
    first, third = lines(incidence)
    np.testing.assert_allclose(first, [[2.0, 12.0], [1.0, 2.0]])
    assert third.size == 0
    assert [len(drawn[0]) for drawn in lines(ranges)] == [0, 1]
    np.testing.assert_allclose(lines(ranges)[1], [[2.0], [5.0]])
    assert incidence.get_ylim()[0] == ranges.get_ylim()[0] == 0.0
    assert incidence.get_legend() is not None
    assert ranges.get_legend() is None
    np.testing.assert_allclose([bar.get_width() for bar in by_material.patches], [3.0, 4.0])
    labels = [text.get_text() for text in by_material.get_yticklabels()]
    assert labels == ["brick, front", "brick, front"]
    every, dark, bright = lines(in_row)
    np.testing.assert_allclose(every, [along, along])
    np.testing.assert_allclose(dark[0], along[2:5])
    np.testing.assert_allclose(bright, [along[6:8], along[6:8]])
    assert in_row.get_legend() is not None
    # Two panels abreast, the row below all of them.
    assert figure.get_size_inches()[0] == pytest.approx(COLUMN_INCHES)
    assert in_row.get_position().y1 < min(axes.get_position().y0 for axes in figure.axes[:-1])


def test_thickness_without_classes_materials_or_row_is_one_panel(
    drawings: dict[str, Any], tmp_path: Path
) -> None:
    plain = Thickness(sigma_m=0.001, width_95_m=0.004, scan_step_m=0.005)
    draw_thickness(context(tmp_path), planes_of(), (None, None, None), None, {})
    assert not drawings
    draw_thickness(context(tmp_path), planes_of(count=14), (plain,) * 14, None, {})
    (sigmas,) = drawings["thickness"].axes
    assert len(sigmas.patches) == 12
    row = RowPoints(row=1, scan=0, along_m=np.ones(2), distance_m=np.ones(2), intensity=None)
    draw_thickness(context(tmp_path), planes_of(), (plain, None, None), row, {"a": (0.0, 1.0)})
    assert len(drawings["thickness"].axes[-1].lines) == 1


# --- how planes were looked for ---


def plan_votes(grid: PlanGrid, plan: Any, votes: Any, centre_m: Any, reach_m: float) -> Any:
    """A plan and its votes, as a detector keeps them."""
    return SimpleNamespace(
        grid=grid, plan=plan, first=votes, centre_m=centre_m, reach_m=reach_m, voters="cells vote"
    )


def test_the_accumulator_is_drawn_with_the_walls_as_lines_and_as_circles(
    drawings: dict[str, Any], tmp_path: Path
) -> None:
    rng = np.random.default_rng(0)
    grid = PlanGrid(
        basis=np.eye(3), low_m=np.array([-4.0, -3.0, -2.0]), cell_m=0.5, shape=(16, 14, 8)
    )
    plan = rng.integers(0, 9, (16, 14))
    votes = rng.integers(0, 9, (12, 24))
    picture = plan_votes(grid, plan, votes, np.array([0.0, 0.5]), 6.0)
    draw_accumulator(
        context(tmp_path), picture, planes_of(), cloud_of(np.zeros((3, 3)), origin=ORIGIN)
    )
    left, right, *bars = drawings["accumulator"].axes
    assert [bar.get_ylabel() for bar in bars] == ["points per cell", "votes"]
    shown, extent = image(left)
    np.testing.assert_allclose(shown, plan.T)
    assert extent == (-4.0, 4.0, -3.0, 4.0)
    shown, extent = image(right)
    np.testing.assert_allclose(shown, votes.T)
    assert extent == (0.0, 180.0, -6.0, 6.0)
    # The floor is no line of the plan.
    maximum, front, side = lines(left)
    row, column = np.unravel_index(votes.argmax(), votes.shape)
    fullest = [15.0 * row, -6.0 + 0.5 * (column + 0.5)]
    across = np.array([np.cos(np.radians(fullest[0])), np.sin(np.radians(fullest[0]))])
    np.testing.assert_allclose((maximum.T - [0.0, 0.5]) @ across, fullest[1], atol=1e-9)
    np.testing.assert_allclose(np.sort(front[0]), [-3.0, 3.0])
    np.testing.assert_allclose(front[1], 2.0)
    np.testing.assert_allclose(side[0], -3.0)
    np.testing.assert_allclose(np.sort(side[1]), [-2.0, 2.0])
    # r = x cos + y sin from the centre of the plan: y = 2 at 90 degrees, x = -3 at 0.
    marks = np.array([line[:, 0] for line in lines(right)])
    np.testing.assert_allclose(marks, [fullest, [90.0, 1.5], [0.0, -3.0]], atol=1e-9)
    # A plane has one colour in all figures.
    colours = [line.get_color() for line in left.lines[1:]]
    assert colours == [line.get_color() for line in right.lines[1:]]
    assert colours == [plane_ink(k) for k in (0, 1)]
    assert drawings["accumulator"].legends


def test_sections_count_the_points_of_one_layer_of_voxels(
    drawings: dict[str, Any], tmp_path: Path
) -> None:
    planes = planes_of()
    rng = np.random.default_rng(0)
    points_m = rng.uniform((-3.0, -2.0, -1.5), (3.0, 2.0, 1.5), (20_000, 3))
    cell_m = 0.25
    draw_sections(context(tmp_path), planes, cloud_of(points_m, origin=ORIGIN), cell_m=cell_m)
    low, high = np.array([-3.0, -2.0, -1.5]), np.array([3.0, 2.0, 1.5])
    axes_of = ((0, 1, 2), (0, 2, 1), (1, 2, 0))
    for axes, (first, second, across) in zip(drawings["voxels"].axes[:3], axes_of, strict=True):
        shown, extent = image(axes)
        near = points_m[np.abs(points_m[:, across]) < 0.5 * cell_m]
        assert shown.sum() == pytest.approx(len(near))
        # Five voxels around the planes, and whole voxels.
        assert extent[0] == pytest.approx(low[first] - 5 * cell_m)
        assert extent[2] == pytest.approx(low[second] - 5 * cell_m)
        assert 0.0 <= extent[1] - (high[first] + 5 * cell_m) < 1.01 * cell_m
        assert 0.0 <= extent[3] - (high[second] + 5 * cell_m) < 1.01 * cell_m
        columns = np.floor((near[:, first] - extent[0]) / cell_m).astype(int)
        expected = np.bincount(columns, minlength=shown.shape[1])
        np.testing.assert_allclose(shown.sum(axis=0), expected)
        rows = np.floor((near[:, second] - extent[2]) / cell_m).astype(int)
        expected = np.bincount(rows, minlength=shown.shape[0])
        np.testing.assert_allclose(shown.sum(axis=1), expected)


def test_an_accumulator_of_directions_is_drawn_with_the_planes_it_found(
    drawings: dict[str, Any], tmp_path: Path
) -> None:
    rng = np.random.default_rng(0)
    best = rng.uniform(-1.0, 4.0, (12, 6))
    over_omega, over_phi = (
        {30.0 * k: rng.uniform(0.0, 9.0, (count, 8)) for k in range(3)} for count in (12, 6)
    )
    planes = planes_of()
    lean = math.radians(20.0)
    normal = planes.normal.copy()
    # Omega 210 degrees and phi 20 is the same plane as omega 30 and phi -20.
    normal[0] = [
        math.cos(lean) * math.cos(math.radians(210.0)),
        math.cos(lean) * math.sin(math.radians(210.0)),
        math.sin(lean),
    ]
    draw_space(context(tmp_path), best, over_omega, over_phi, 2.5, replace(planes, normal=normal))
    axes, _ = drawings["accumulator"].axes
    shown, extent = image(axes)
    np.testing.assert_allclose(shown, np.maximum(best.T, 0.0))
    assert extent == (0.0, 180.0, -90.0, 90.0)
    circles = np.array([line[:, 0] for line in lines(axes)])
    np.testing.assert_allclose(circles[:2], [[30.0, -20.0], [0.0, 0.0]], atol=1e-9)
    assert circles[2, 1] == pytest.approx(90.0)
    panels = np.array(drawings["accumulator-sections"].axes[:6]).reshape(3, 2).T
    assert len({panel.images[0].get_clim() for panel in panels.flat}) == 1
    for k in range(3):
        for row, votes, span in ((0, over_omega, (0.0, 180.0)), (1, over_phi, (-90.0, 90.0))):
            shown, extent = image(panels[row, k])
            np.testing.assert_allclose(shown, votes[30.0 * k].T)
            assert extent == (*span, -2.5, 2.5)
            assert panels[row, k].get_title().endswith(f"= {30.0 * k:.0f} deg")


def test_normals_are_drawn_by_points_and_over_the_first_plane(
    drawings: dict[str, Any], tmp_path: Path
) -> None:
    wall = Rectangle("wall", (0, 2, 0), (1.5, 0, 0), (0, 0, 1.0), 60_000)
    lean = math.radians(30.0)
    # A slope of 30 degrees off the wall, half a metre before it.
    slope = Rectangle(
        "slope", (0, 1.5, 0), (0.3, 0, 0),
        (0, 0.3 * math.sin(lean), 0.3 * math.cos(lean)), 9_000,
    )  # fmt: skip
    points = sampled((wall, slope), noise_m=1e-3)
    cloud = cloud_of(points, origin=ORIGIN)
    params = Region.Params(neighbourhood_m=0.15, cell_m=0.05, min_share=0.005)
    regions = region_proposer(search_in(prepared(points)), params, viewer_m=np.zeros(3))
    planes = planes_of()
    half = np.array([[-1.5, 0, 1.0], [-1.5, 0, -1.0], [1.5, 0, -1.0], [1.5, 0, 1.0]])
    corners = planes.corners.copy()
    corners[0] = half + np.array([0.0, 2.0, 0.0]) + np.array(ORIGIN)
    ctx = context(tmp_path)
    draw_normals(ctx, regions.voxels, len(regions.planes), replace(planes, corners=corners), cloud)
    metrics = {metric.name: metric.value for metric in ctx.metrics}
    assert metrics["n_regions"] == len(regions.planes) == 2
    assert metrics["neighbourhood_mm"] == pytest.approx(150.0)
    assert metrics["cell_mm"] == pytest.approx(50.0)
    # A slope's error is s / (extent sqrt(n)) about both axes, with 225 points over 15 cm; half of
    # the normals are within 1.18 of it.
    slope_rad = 1e-3 / (0.15 / math.sqrt(12.0) * 15.0)
    expected_deg = math.degrees(1.18 * slope_rad)
    assert metrics["normal_scatter_deg"] == pytest.approx(expected_deg, rel=0.1)
    left, middle, right, _ = drawings["normals"].axes
    (stairs,) = left.patches
    share, edges_deg, _ = stairs.get_data()
    np.testing.assert_allclose(edges_deg, np.arange(91.0))
    assert share.sum() == pytest.approx(1.0)
    assert share[0] == pytest.approx(60_000 / 69_000, abs=0.03)
    assert share[29:31].sum() == pytest.approx(9_000 / 69_000, abs=0.03)
    (stairs,) = middle.patches
    share, edges_deg, _ = stairs.get_data()
    np.testing.assert_allclose(edges_deg, np.arange(-90.0, 91.0))
    # Ny of the wall is -1, of the slope -cos 30 deg.
    assert share[:10].sum() == pytest.approx(60_000 / 69_000, abs=0.03)
    assert share[28:32].sum() == pytest.approx(9_000 / 69_000, abs=0.03)
    shown, extent = image(right)
    np.testing.assert_allclose(extent, (0.0, 3.0, 2.0, 0.0))
    assert shown.shape == (40, 60)
    # The slope stands before the wall there and is cut off at 15 degrees.
    assert shown[20, 30] == pytest.approx(15.0)
    assert np.nanmedian(shown[:8]) < 0.2
    assert right.images[0].get_clim() == (0.0, 15.0)
