"""`raster.grid`: depth, spread, intensity and colour of walls with known cells, gaps and crops."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from orthoflow_plugins.raster import grid
from orthoflow_plugins.raster.extents import Extent
from orthoflow_plugins.raster.grid import RasterGrid
from orthoflow_plugins.raster.selection import frame_of
from pydantic import ValidationError

from orthoflow.errors import MethodError, OrthoflowError
from orthoflow.products import PointCloud, SurfaceMask, Wall
from orthoflow.sdk import StepContext
from tests import raster_scenes as scenes
from tests import samples
from tests.raster_scenes import rastered

SURFACES = ["median", "centre", "topmost", "mean"]


def one_point_per_cell(
    wall: scenes.KnownWall, *, moved_cells: float = 0.0
) -> tuple[PointCloud, NDArray[np.float64]]:
    columns, rows = scenes.cell_centres(wall.shape)
    depths_m = scenes.relief_m(columns)
    rng = np.random.default_rng(3)
    shift = moved_cells * rng.uniform(-1, 1, (2, columns.size))
    points = wall.world(columns + shift[0], rows + shift[1], depths_m)
    intensity = np.linspace(0.1, 0.9, columns.size, dtype=np.float32)
    rgb = scenes.checker(columns, rows)
    return scenes.cloud_of(points, rgb=rgb, intensity=intensity), depths_m.reshape(wall.shape)


@pytest.mark.parametrize("surface", SURFACES)
@pytest.mark.parametrize("at_survey", [False, True], ids=["local", "survey"])
def test_cells_have_the_values_of_their_point(
    tmp_path: Path, surface: str, at_survey: bool
) -> None:
    known = scenes.leaning_wall(at_survey=at_survey)
    # The mean of few points is extrapolated to the centre of the cell; a single point is not.
    moved_cells = 0.0 if surface in {"median", "mean"} else 0.45
    cloud, depths_m = one_point_per_cell(known, moved_cells=moved_cells)
    walls, _ = rastered(cloud, known.planes(), tmp_path, gsd_m=known.gsd_m, surface=surface)
    wall = walls.walls[0]
    assert wall.frame.shape == known.shape
    # Computations may change a survey by 0.05 mm; float32 offsets of a metre are more accurate.
    np.testing.assert_allclose(wall.depth_m, depths_m, atol=5e-5)
    columns, rows = scenes.cell_centres(known.shape)
    np.testing.assert_array_equal(wall.rgb.reshape(-1, 3), scenes.checker(columns, rows))
    # Points are 1e-6 cells from the centres, where the slope of the pattern is 1.
    np.testing.assert_allclose(wall.intensity.ravel(), cloud.intensity, atol=1e-5)
    assert (wall.count == 1).all()
    assert (wall.mask == SurfaceMask.MEASURED).all()
    assert np.isnan(wall.sigma_m).all()
    assert walls.intensity_source == "laser"
    if not moved_cells:
        places, depths_m = np.column_stack([columns, rows]), wall.depth_m.ravel().astype(np.float64)
        world = wall.frame.world_from_wall(places, depths_m)
        np.testing.assert_allclose(world, cloud.points_world(), atol=1e-6)


def cell_with(depths_m: ArrayLike, folder: Path, **params: object) -> Wall:
    """Return the wall of a cloud with all points in cell (4, 3), the first nearest the centre."""
    known = scenes.upright_wall()
    depths_m = np.array(depths_m)
    shift = np.linspace(0.0, 0.04, len(depths_m))
    points = known.world(3.5 + shift, 4.5 + shift, depths_m)
    grey = np.linspace(0.1, 0.5, len(depths_m), dtype=np.float32)
    cloud = scenes.cloud_of(points, intensity=grey)
    params = {"recover_gap_cells": 0, "gsd_m": known.gsd_m, "buffer_m": 1.0, **params}
    return rastered(cloud, known.planes(), folder, **params)[0].walls[0]


@pytest.mark.parametrize(
    ("surface", "depth_m"),
    [("centre", 0.015), ("topmost", 0.25), ("mean", 0.0754), ("median", 0.012)],
)
def test_surfaces_choose_as_they_say(tmp_path: Path, surface: str, depth_m: float) -> None:
    # The layer at about 1 cm, which has three points, provides the median. The layers at 9 and 25
    # cm have one point each.
    wall = cell_with([0.015, 0.25, 0.010, 0.012, 0.09], tmp_path, surface=surface)
    assert wall.depth_m[4, 3] == pytest.approx(depth_m, abs=1e-7)
    assert wall.count[4, 3] == 5
    spread = np.std([0.015, 0.25, 0.010, 0.012, 0.09], ddof=1)
    assert wall.sigma_m[4, 3] == pytest.approx(spread, abs=1e-7)
    assert np.count_nonzero(wall.mask) == 1


def test_a_median_never_lies_between_two_surfaces(tmp_path: Path) -> None:
    wall = cell_with([0.0, 0.001, 0.08, 0.081], tmp_path, surface="median")
    assert wall.depth_m[4, 3] == pytest.approx(0.0805, abs=1e-7)
    # The intensity is the mean of the two points on that surface, (0.3667 + 0.5) / 2.
    assert wall.intensity[4, 3] == pytest.approx(0.43333, abs=1e-5)


@pytest.mark.parametrize("n_points", [40, 1001])
def test_a_median_of_many_points_is_numpys(tmp_path: Path, n_points: int) -> None:
    depths_m = np.random.default_rng(n_points).normal(0.0, 0.002, n_points)
    wall = cell_with(depths_m, tmp_path)
    assert wall.depth_m[4, 3] == pytest.approx(np.median(depths_m), abs=1e-6)


def test_points_outside_the_buffer_never_show(tmp_path: Path) -> None:
    wall = cell_with([0.31, 0.05, -0.11], tmp_path, buffer_front_m=0.3, buffer_behind_m=0.1)
    assert wall.count[4, 3] == 1
    assert wall.depth_m[4, 3] == pytest.approx(0.05, abs=1e-7)


@pytest.mark.parametrize("surface", SURFACES)
def test_counts_sum_to_the_points_whatever_the_threads(tmp_path: Path, surface: str) -> None:
    known = scenes.leaning_wall(shape=(45, 70))
    rng = np.random.default_rng(11)
    n_points = 30_000
    columns, rows = rng.uniform(-5, 75, n_points), rng.uniform(-5, 50, n_points)
    depths_m = rng.normal(0.0, 0.1, n_points)
    rgb = rng.integers(0, 256, (n_points, 3), dtype=np.uint8)
    intensity = rng.random(n_points, dtype=np.float32)
    cloud = scenes.cloud_of(known.world(columns, rows, depths_m), rgb=rgb, intensity=intensity)
    params = {"gsd_m": known.gsd_m, "surface": surface, "rectangle": "points", "buffer_m": 0.15}
    walls, _ = rastered(cloud, known.planes(), tmp_path, **params)
    inside = (
        (np.abs(depths_m) <= 0.15) & (columns >= 0) & (columns < 70) & (rows >= 0) & (rows < 45)
    )
    assert walls.walls[0].count.sum() == np.count_nonzero(inside)
    alone = rastered(cloud, known.planes(), tmp_path, cores=1, **params)[0].to_payload()
    for name, array in walls.to_payload().arrays.items():
        np.testing.assert_array_equal(array, alone.arrays[name], err_msg=name)


def test_luminance_replaces_missing_intensity(tmp_path: Path) -> None:
    known = scenes.leaning_wall()
    cloud, _ = one_point_per_cell(known)
    grey = dataclasses.replace(cloud, intensity=None)
    walls, ctx = rastered(grey, known.planes(), tmp_path, gsd_m=0.01)
    assert walls.intensity_source == "luminance"
    assert any("no laser intensity" in warning for warning in ctx.warnings)
    expected = cloud.rgb @ np.array([0.299, 0.587, 0.114]) / 255.0
    np.testing.assert_allclose(walls.walls[0].intensity.ravel(), expected, atol=1e-6)
    walls, ctx = rastered(dataclasses.replace(grey, rgb=None), known.planes(), tmp_path, gsd_m=0.01)
    assert walls.intensity_source == "none"
    assert walls.walls[0].intensity is None
    assert walls.walls[0].rgb is None
    assert any("neither intensity nor colour" in warning for warning in ctx.warnings)


def test_a_margin_widens_the_frame_on_all_sides(tmp_path: Path) -> None:
    known = scenes.leaning_wall()
    cloud, _ = one_point_per_cell(known)
    plain, wide = (
        rastered(cloud, known.planes(), tmp_path, gsd_m=0.01, margin_m=margin_m)[0].walls[0]
        for margin_m in (0.0, 0.02)
    )
    rows, columns = plain.frame.shape
    assert wide.frame.shape == (rows + 4, columns + 4)
    np.testing.assert_array_equal(wide.count[2:-2, 2:-2], plain.count)


def test_what_gives_no_raster_is_refused(tmp_path: Path) -> None:
    known = scenes.leaning_wall()
    cloud, _ = one_point_per_cell(known)
    far = dataclasses.replace(cloud, origin=cloud.origin + 50.0)
    cases: list[tuple[PointCloud, dict[str, object], str]] = [
        (far, {}, "no point of the cloud is inside"),
        (cloud, {"constraint": "horizontal"}, "is horizontal within"),
        (cloud, {"gsd_m": 1e-6}, "gsd_m = 1e-06 m .* increase gsd_m"),
    ]
    for given, params, message in cases:
        with pytest.raises(OrthoflowError, match=message):
            rastered(given, known.planes(), tmp_path, **{"gsd_m": 0.01, **params})
    none = {"normal": np.zeros((0, 3)), "offset": np.zeros(0), "corners": np.zeros((0, 4, 3))}
    planes = samples.planes(**none, names=())
    with pytest.raises(MethodError, match="no plane was found"):
        rastered(cloud, planes, tmp_path, gsd_m=0.01)


@pytest.mark.parametrize(("askew_m", "n_warnings"), [(0.069, 0), (0.071, 1)])
def test_cuts_of_5_cm_or_more_are_reported(tmp_path: Path, askew_m: float, n_warnings: int) -> None:
    known, ctx = scenes.leaning_wall(), scenes.context(tmp_path)
    extent = Extent(front_m=0.1, behind_m=0.1, cut_m={"left": askew_m})
    # A margin takes 2 cm of this.
    params = RasterGrid.Params(margin_m=0.02)
    planes = known.planes()
    frames = {0: frame_of(planes, 0, gsd_m=0.01, margin_m=0.02)}
    grid.report_doubts(frames, planes, params, lambda _: extent, ctx)
    assert [one.values["cut_m"] for one in ctx.diagnostics] == [pytest.approx(0.051)] * n_warnings


def test_a_wall_of_one_tone_is_reported_with_its_cause(tmp_path: Path) -> None:
    known = scenes.leaning_wall(shape=(50, 60))
    cloud, _ = one_point_per_cell(known)
    scan: dict[str, Any] = {"intensity": {"low": 0.0, "high": 65535.0, "rule": "stated"}}
    cloud = dataclasses.replace(cloud, source={"scans": [scan]})
    dark = np.linspace(0.0, 1e-3, len(cloud), dtype=np.float32)
    white = np.full((len(cloud), 3), 255, dtype=np.uint8)
    for changed, what in (
        ({}, None),
        ({"intensity": dark}, "intensity is black"),
        ({"intensity": np.float32(1.0) - dark}, "intensity is white"),
        ({"rgb": white}, "colour is white"),
    ):
        given = dataclasses.replace(cloud, **changed)
        _, ctx = rastered(given, known.planes(), tmp_path, gsd_m=0.01)
        found = [one.text for one in ctx.diagnostics if one.code == "wall-of-one-tone"]
        assert len(found) == (what is not None)
        if what is not None:
            assert what in found[0]
            assert ("0.0 to 65535.0 (stated)" in found[0]) == ("intensity" in what)


# --- missing points between neighbours in the grid of the scan ---


SCANNED_WALL = scenes.upright_wall(shape=(40, 60))
# Slope per cell: steep, but points two steps apart differ by less than layer_m.
SLOPE_M = 0.004


def with_gaps(cloud: PointCloud, folder: Path, **params: object) -> Wall:
    more: dict[str, object] = {"gsd_m": SCANNED_WALL.gsd_m, "buffer_m": 1.0, **params}
    return scenes.rastered(cloud, SCANNED_WALL.planes(), folder, **more)[0].walls[0]


def depth_m(columns: NDArray[np.float64]) -> NDArray[np.float64]:
    return SLOPE_M * columns


def scanned(
    step_cells: float, *, missing: NDArray[np.bool_] | None = None, depths: str = "slope"
) -> PointCloud:
    """Return a scan with given row and column spacing on the wall, rotated by a few degrees."""
    n = int(120 / step_cells)
    row, column = (grid.ravel() for grid in np.mgrid[:n, :n])
    turned = np.radians(7.0)
    u = 0.3 + step_cells * (np.cos(turned) * column + np.sin(turned) * (row - n / 3))
    v = 0.3 + step_cells * (np.cos(turned) * row - np.sin(turned) * column)
    kept = (u > 0) & (u < SCANNED_WALL.shape[1]) & (v > 0) & (v < SCANNED_WALL.shape[0])
    if missing is not None:
        kept &= ~missing[np.clip(v, 0, 39.9).astype(int), np.clip(u, 0, 59.9).astype(int)]
    u, v, row, column = u[kept], v[kept], row[kept], column[kept]
    depths_m = depth_m(u) if depths == "slope" else np.where(u < 30.0, 0.0, 0.1)
    cloud = scenes.cloud_of(
        SCANNED_WALL.world(u, v, depths_m),
        intensity=(0.2 + 0.01 * u).astype(np.float32),
        rgb=np.repeat(np.rint(2.0 * v)[:, None], 3, axis=1).astype(np.uint8),
    )
    # Row and column numbers may begin with any number, here above 12,000.
    return dataclasses.replace(
        cloud, row=(row + 12_000).astype(np.uint32), column=column.astype(np.uint32)
    )


def test_a_coarse_scan_is_recovered_linear_between_its_points(tmp_path: Path) -> None:
    wall = with_gaps(scanned(2.4), tmp_path, surface="topmost")
    recovered = wall.mask == SurfaceMask.RECOVERED
    # The border is not between points.
    inner = np.zeros(SCANNED_WALL.shape, dtype=bool)
    inner[4:-4, 4:-4] = True
    assert (wall.mask[inner] != SurfaceMask.VOID).all()
    assert np.mean(recovered[inner]) > 0.7
    rows, columns = np.nonzero(recovered & inner)
    expected_m = depth_m(columns.astype(np.float64) + 0.5)
    np.testing.assert_allclose(wall.depth_m[rows, columns], expected_m, atol=1e-6)
    np.testing.assert_allclose(
        wall.intensity[rows, columns], 0.2 + 0.01 * (columns + 0.5), atol=1e-6
    )
    # Colours are rounded for the points, and again after interpolation.
    np.testing.assert_allclose(wall.rgb[rows, columns, 0], 2.0 * (rows + 0.5), atol=1.01)
    assert (wall.count[recovered] == 0).all()
    assert np.isnan(wall.sigma_m[recovered]).all()


def test_single_missing_points_are_recovered_on_the_slope_they_lie_on(tmp_path: Path) -> None:
    missing = np.random.default_rng(4).random(SCANNED_WALL.shape) < 0.08
    errors_m = []
    for steps in (2, 0):
        wall = with_gaps(
            scanned(0.9, missing=missing), tmp_path, surface="centre", recover_scan_steps=steps
        )
        rows, columns = np.nonzero(wall.mask == SurfaceMask.RECOVERED)
        errors_m.append(
            np.abs(wall.depth_m[rows, columns] - depth_m(columns.astype(np.float64) + 0.5))
        )
    assert np.median(errors_m[0]) < 1e-6
    # Cells surrounded by others are on their slope; at the border, they are on that of their
    # neighbours.
    assert np.median(errors_m[1]) < 0.02 * SLOPE_M
    assert errors_m[1].max() < 2.0 * SLOPE_M


def test_what_the_scanner_looked_through_stays_void(tmp_path: Path) -> None:
    window = np.zeros(SCANNED_WALL.shape, dtype=bool)
    window[10:30, 20:40] = True
    wall = with_gaps(scanned(0.9, missing=window), tmp_path)
    is_void = wall.mask == SurfaceMask.VOID
    assert is_void[11:29, 21:39].all()
    assert np.isnan(wall.depth_m[is_void]).all()
    assert np.isnan(wall.intensity[is_void]).all()
    np.testing.assert_array_equal(wall.rgb_mask > 0, ~is_void)


def test_a_depth_step_is_not_bridged(tmp_path: Path) -> None:
    wall = with_gaps(scanned(2.4, depths="step"), tmp_path, surface="topmost")
    known = wall.depth_m[np.isfinite(wall.depth_m)]
    assert set(known.round(4).tolist()) == {0.0, np.float32(0.1).item()}


@pytest.mark.parametrize(
    ("without", "reach"),
    [(("row", "column"), {}), ((), {"recover_scan_steps": 0}), ((), {"recover_gap_cells": 0})],
)
def test_without_grid_or_reach_nothing_is_spanned(
    tmp_path: Path, without: tuple[str, ...], reach: dict[str, object]
) -> None:
    cloud = dataclasses.replace(scanned(2.4), **dict.fromkeys(without))
    params: dict[str, object] = {"surface": "topmost", "recover_gap_cells": 1, **reach}
    wall = with_gaps(cloud, tmp_path, **params)
    # Cells in the middle between four points are too far away for a gap of one cell.
    assert np.mean(wall.mask[4:-4, 4:-4] == SurfaceMask.VOID) > 0.1


# --- parts of walls ---


# The wall has 40 x 30 cells of 0.125 m, so it is 5 m wide and 3.75 m high.
WHOLE = scenes.upright_wall()


def cropped(folder: Path, **params: object) -> tuple[Wall, StepContext]:
    cloud, _ = one_point_per_cell(WHOLE)
    walls, ctx = scenes.rastered(cloud, WHOLE.planes(), folder, gsd_m=WHOLE.gsd_m, **params)
    return walls.walls[0], ctx


def assert_same(part: Wall, whole: Wall, cells: Any, kept: NDArray[np.bool_]) -> None:
    for name in ("depth_m", "sigma_m", "count", "mask", "intensity", "rgb", "rgb_mask"):
        one, other = getattr(part, name), getattr(whole, name)[cells]
        np.testing.assert_array_equal(one[kept], other[kept], err_msg=name)


@pytest.mark.parametrize(
    ("crop", "part"),
    [
        ((1.0, 0.5, 2.0, 1.5), np.s_[4:12, 8:16]),
        ((0.99, 0.51, 2.01, 1.49), np.s_[4:12, 7:17]),
        ((4.0, 3.0, 9.0, 9.0), np.s_[24:30, 32:40]),
        ((-3.0, -1.0, 0.25, 0.125), np.s_[0:1, 0:2]),
        (((1.0, 0.5), (1.0, 1.5), (2.0, 1.5), (2.0, 0.5)), np.s_[4:12, 8:16]),
    ],
    ids=["whole cells", "cells in part", "past a corner", "past the origin", "square polygon"],
)
def test_a_crop_holds_the_cells_of_the_whole_wall(
    tmp_path: Path, crop: object, part: tuple[slice, slice]
) -> None:
    whole, _ = cropped(tmp_path)
    wall, ctx = cropped(tmp_path, crop=crop)
    assert_same(wall, whole, part, np.ones(wall.frame.shape, dtype=np.bool_))
    corner = np.array([[part[1].start, part[0].start]], dtype=np.float64)
    np.testing.assert_allclose(
        wall.frame.origin_world, whole.frame.world_from_wall(corner)[0], atol=1e-12
    )
    assert not any(one.code.startswith("crop") for one in ctx.diagnostics)


def test_cells_beyond_a_polygon_are_void(tmp_path: Path) -> None:
    whole, _ = cropped(tmp_path)
    # The crop is the triangle to the right of the line from (1, 3) to (3, 1), below v = 1, with a
    # notch at its lower edge.
    notched = [
        [1.0, 3.0],
        [3.0, 1.0],
        [3.0, 3.0],
        [2.75, 3.0],
        [2.75, 2.0],
        [2.25, 2.0],
        [2.25, 3.0],
    ]
    wall, _ = cropped(tmp_path, crop=notched)
    assert wall.frame.shape == (16, 16)
    rows, columns = np.mgrid[8:24, 8:24] + 0.5
    # Cells with their centres on the diagonal may be on either side.
    inside, on = columns + rows > 32.0, columns + rows == 32.0
    inside[8:, 10:14] = False
    kept = wall.mask == SurfaceMask.MEASURED
    np.testing.assert_array_equal(kept[~on], inside[~on])
    assert_same(wall, whole, np.s_[8:24, 8:24], kept)
    assert np.isnan(wall.depth_m[~kept]).all()
    assert np.isnan(wall.intensity[~kept]).all()
    assert not wall.count[~kept].any()
    assert not wall.rgb[~kept].any()


def test_a_crop_without_an_area_or_beside_the_wall_is_refused(tmp_path: Path) -> None:
    for crop in ((1, 1, 1, 2), ((0, 0), (1, 1)), ((0, 0), (1, 1), (2, 2))):
        with pytest.raises(ValidationError, match="that span an area"):
            RasterGrid.Params.model_validate({"crop": crop})
    with pytest.raises(MethodError, match=r"wall 0 is 5\.000 m wide and 3\.750 m high"):
        cropped(tmp_path, crop=(6.0, 0.0, 7.0, 1.0))


@pytest.mark.parametrize(("away_m", "is_told"), [(0.95, False), (1.05, True)])
def test_a_distant_nearest_wall_is_reported(
    tmp_path: Path, away_m: float, *, is_told: bool
) -> None:
    _, ctx = cropped(tmp_path, near=[[2.0, -away_m, -1.0]])
    apart = [one.values["apart_m"] for one in ctx.diagnostics if one.code == "near-is-far"]
    assert apart == [pytest.approx(away_m)] * is_told


def test_walls_are_chosen_in_one_way() -> None:
    with pytest.raises(ValidationError, match="by ranks or by near, not by both"):
        RasterGrid.Params.model_validate({"ranks": [0], "near": [[0, 0, 0]]})
