"""`raster.grid`: depth, spread, intensity and colour of walls with known cells."""

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

from orthoflow.errors import MethodError, OrthoflowError
from orthoflow.products import PointCloud, SurfaceMask, Wall
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
def test_each_cell_gets_the_depth_intensity_and_colour_of_its_point(
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
def test_counts_conserve_the_points_and_threads_change_nothing(
    tmp_path: Path, surface: str
) -> None:
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


def test_without_intensity_the_grey_of_the_colours_stands_in_and_bare_points_give_depth_only(
    tmp_path: Path,
) -> None:
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
def test_what_an_adjoining_plane_cuts_off_is_warned_of_from_5_cm(
    tmp_path: Path, askew_m: float, n_warnings: int
) -> None:
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
