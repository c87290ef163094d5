"""The rules of `raster.grid` that look beyond one cell, and what they make of noise and steps."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.raster.grid import RasterGrid
from scipy.spatial import cKDTree

from orthoflow.products import PointCloud, SurfaceMask, Walls
from orthoflow.sdk import StepContext
from tests import raster_scenes as scenes

NOISE_M = 0.002


def rastered(
    cloud: PointCloud, known: scenes.KnownWall, ctx: StepContext, **params: object
) -> Walls:
    inputs = RasterGrid.In(cloud=cloud, planes=known.planes())
    chosen = RasterGrid.Params.model_validate({"gsd_m": known.gsd_m, **params})
    return RasterGrid().run(inputs, chosen, ctx).walls


def scattered(
    known: scenes.KnownWall, *, per_cell: float, seed: int = 4, noise_m: float = 0.0
) -> tuple[PointCloud, NDArray[np.float64], NDArray[np.float64]]:
    """Points all over a wall with steps, their columns and rows (n, 2), and depths."""
    rng = np.random.default_rng(seed)
    rows, columns = known.shape
    n_points = int(per_cell * rows * columns)
    places = rng.uniform([0, 0], [columns, rows], (n_points, 2))
    depths_m = scenes.relief_m(places[:, 0]) + noise_m * rng.normal(size=n_points)
    grey = np.full((n_points, 3), 120, dtype=np.uint8)
    intensity = rng.random(n_points, dtype=np.float32)
    cloud = scenes.cloud_of(known.world(*places.T, depths_m), rgb=grey, intensity=intensity)
    return cloud, places, depths_m


def test_intensity_and_colour_are_carried_to_the_centres_of_cells_alone_and_together(
    tmp_path: Path,
) -> None:
    known = scenes.leaning_wall(shape=(20, 30))
    cloud, places, _ = scattered(known, per_cell=1.5)
    # Both rise along the wall: carried to its centre, a cell has what lies there.
    rising = (places[:, 0] / 30.0).astype(np.float32)
    cloud = dataclasses.replace(
        cloud,
        intensity=rising,
        rgb=np.repeat(np.rint(255.0 * rising)[:, None], 3, axis=1).astype(np.uint8),
    )
    clouds = (
        cloud,
        dataclasses.replace(cloud, rgb=None),
        dataclasses.replace(cloud, intensity=None),
    )
    (both,), (no_rgb,), (no_intensity,) = (
        rastered(one, known, scenes.context(tmp_path), recover_gap_cells=0).walls for one in clouds
    )
    assert no_rgb.rgb is None
    assert no_rgb.rgb_mask is None
    np.testing.assert_array_equal(no_rgb.intensity, both.intensity)
    np.testing.assert_array_equal(no_intensity.rgb, both.rgb)
    few = (both.count == 1) & np.isfinite(both.depth_m)
    off = np.abs(both.intensity - (np.arange(30) + 0.5) / 30.0)[few]
    # Points lie a quarter of a cell beside the centre on average.
    assert np.median(off) < 0.1 * 0.25 / 30.0


def test_nearest_takes_the_nearest_point_wherever_it_lies(tmp_path: Path) -> None:
    known = scenes.leaning_wall(shape=(40, 60))
    cloud, places, _ = scattered(known, per_cell=1.5)
    ctx = scenes.context(tmp_path)
    wall = rastered(cloud, known, ctx, surface="nearest", recover_gap_cells=0).walls[0]
    columns, rows = scenes.cell_centres(known.shape)
    nearest = cKDTree(places).query(np.column_stack([columns, rows]))[1].reshape(known.shape)
    measured = wall.count > 0
    is_elsewhere = (
        np.floor(places[nearest]).astype(int)
        != np.stack([columns.astype(int), rows.astype(int)], axis=1).reshape(*known.shape, 2)
    ).any(axis=-1)
    assert (is_elsewhere & measured).any()
    np.testing.assert_array_equal(wall.intensity[measured], cloud.intensity[nearest[measured]])
    assert np.isnan(wall.depth_m[~measured]).all()
    assert not wall.rgb[~measured].any()
    assert wall.count.sum() == len(places)


def test_cells_of_single_outliers_are_recovered_and_thin_bars_stay(tmp_path: Path) -> None:
    known = scenes.leaning_wall(shape=(60, 80))
    columns, rows = scenes.cell_centres(known.shape)
    true_m = np.zeros(known.shape)
    true_m[30, 20:40] = 0.05  # a bar one cell wide
    wrong = np.zeros(known.shape, dtype=bool)
    wrong[[5, 12, 50], [7, 60, 33]] = True
    depths_m = np.where(wrong, 0.12, true_m).ravel()
    cloud = scenes.cloud_of(known.world(columns, rows, depths_m))
    for surface in ("median", "denoised"):
        wall = rastered(cloud, known, scenes.context(tmp_path), surface=surface).walls[0]
        np.testing.assert_allclose(wall.depth_m, true_m, atol=1e-5)
        np.testing.assert_array_equal(wall.mask == SurfaceMask.RECOVERED, wrong)


def test_denoising_takes_the_noise_and_leaves_the_steps(tmp_path: Path) -> None:
    known = scenes.leaning_wall(shape=(120, 160))
    cloud, _, _ = scattered(known, per_cell=2.25, noise_m=NOISE_M)
    columns, _ = scenes.cell_centres(known.shape)
    true_m = scenes.relief_m(columns).reshape(known.shape)
    rms_mm = {}
    for surface in ("median", "denoised"):
        wall = rastered(cloud, known, scenes.context(tmp_path), surface=surface).walls[0]
        measured = wall.mask == SurfaceMask.MEASURED
        errors = (wall.depth_m - true_m)[measured]
        rms_mm[surface] = 1e3 * float(np.sqrt(np.mean(errors**2)))
        # Steps of 8 and 10 cm every ten cells stay where they are, to the cell.
        assert np.abs(errors).max() < 0.02
    # A cell has about two points, sqrt(1/2) of 2 mm and some cells with one.
    assert 1.2 < rms_mm["median"] < 2.0
    assert rms_mm["denoised"] < 0.45 * rms_mm["median"]


def test_a_net_of_triangles_closes_windows_and_slopes_over_steps(tmp_path: Path) -> None:
    known = scenes.leaning_wall(shape=(40, 60))
    cloud, places, depths_m = scattered(known, per_cell=3.0)
    in_window = (np.abs(places[:, 0] - 25.0) < 8.0) & (np.abs(places[:, 1] - 20.0) < 8.0)
    kept = np.flatnonzero(~in_window)
    holed = scenes.part_of(cloud, kept)
    grid = rastered(holed, known, scenes.context(tmp_path)).walls[0]
    net = rastered(holed, known, scenes.context(tmp_path), surface="tin").walls[0]
    window = (slice(16, 24), slice(21, 29))
    assert (grid.mask[window] == SurfaceMask.VOID).all()
    assert (net.mask[window] == SurfaceMask.RECOVERED).all()
    known_depths = np.unique(np.round(depths_m, 6))

    def between(values: NDArray[np.float32]) -> float:
        far = np.abs(values[..., None] - known_depths).min(axis=-1) > 0.01
        return float(np.mean(far[np.isfinite(values)]))

    assert between(grid.depth_m) == 0.0
    assert between(net.depth_m) > 0.05
    np.testing.assert_array_equal(net.count, grid.count)
    assert (net.rgb[net.mask > 0] == 120).all()


def test_percentiles_are_numpys(tmp_path: Path) -> None:
    known = scenes.upright_wall()
    rng = np.random.default_rng(9)
    depths_m = rng.normal(0.0, 0.03, 57)
    points = known.world(rng.uniform(3, 4, 57), rng.uniform(4, 5, 57), depths_m)
    walls = rastered(
        scenes.cloud_of(points), known, scenes.context(tmp_path), percentiles=[0, 10, 50, 99]
    )
    wall = walls.walls[0]
    np.testing.assert_allclose(
        wall.percentiles_m[4, 3], np.percentile(depths_m, [0, 10, 50, 99]), atol=1e-6
    )
    assert np.isnan(wall.percentiles_m[4, 4]).all()
    assert walls.percentiles == (0, 10, 50, 99)


def test_depths_sorted_a_few_at_a_time_give_the_same_medians_and_percentiles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = scenes.leaning_wall(shape=(40, 60))
    cloud, *_ = scattered(known, per_cell=5.0, noise_m=NOISE_M)
    found = []
    for n_points, n_cells in ((1 << 26, 1 << 20), (700, 50)):
        monkeypatch.setattr("orthoflow_plugins.raster.surfaces._POINTS_AT_ONCE", n_points)
        monkeypatch.setattr("orthoflow_plugins.raster.surfaces.CELLS_AT_ONCE", n_cells)
        ctx = scenes.context(tmp_path)
        found.append(rastered(cloud, known, ctx, percentiles=[5, 50]).walls[0])
    for name in ("depth_m", "percentiles_m", "count", "intensity"):
        np.testing.assert_array_equal(*(getattr(wall, name) for wall in found), err_msg=name)


def test_the_buffer_is_three_tolerances_of_the_planes_unless_set(tmp_path: Path) -> None:
    known = scenes.leaning_wall(shape=(40, 60))
    cloud, _, _ = scattered(known, per_cell=1.0)

    def buffers(stated: dict[str, float], **params: object) -> tuple[float, float]:
        planes = dataclasses.replace(known.planes(), **stated)
        inputs = RasterGrid.In(cloud=cloud, planes=planes)
        chosen = RasterGrid.Params.model_validate({"gsd_m": known.gsd_m, **params})
        walls = RasterGrid().run(inputs, chosen, scenes.context(tmp_path)).walls
        return walls.buffer_front_m, walls.buffer_behind_m

    assert buffers({}) == pytest.approx((0.15, 0.15))
    assert buffers({"tolerance_m": 0.1}) == pytest.approx((0.3, 0.3))
    assert buffers({"tolerance_m": 0.04}, buffer_front_m=0.2) == pytest.approx((0.2, 0.12))
    assert buffers({"tolerance_m": 0.04}, buffer_m=0.25) == pytest.approx((0.25, 0.25))


def test_scans_without_stations_cannot_be_balanced(tmp_path: Path) -> None:
    known = scenes.leaning_wall(shape=(40, 60))
    ctx = scenes.context(tmp_path)
    rastered(scattered(known, per_cell=1.0)[0], known, ctx, balance_intensity=True)
    assert any("scans with known stations" in warning for warning in ctx.warnings)


def test_strays_in_the_shadow_of_an_edge_are_left_void_and_sparse_surfaces_stay(
    tmp_path: Path,
) -> None:
    known = scenes.leaning_wall(shape=(120, 160))
    columns, rows = scenes.cell_centres(known.shape)
    rng = np.random.default_rng(8)
    true_m = np.where(columns < 40, 0.07, 0.0)
    in_shadow = (columns > 40) & (columns < 60)
    # What a scan has there: few distances, mixed of both sides of the edge, and outliers.
    is_stray = in_shadow & (rng.random(len(columns)) < 0.06)
    depths_m = np.where(is_stray, rng.uniform(0.0, 0.2, len(columns)), true_m)
    # A dark surface that gives few points, all on one plane.
    is_dark = (columns > 100) & (columns < 140)
    kept = np.where(in_shadow, is_stray, ~is_dark | (rng.random(len(columns)) < 0.25))
    cloud = scenes.cloud_of(known.world(columns[kept], rows[kept], depths_m[kept]))
    ctx = scenes.context(tmp_path)
    wall = rastered(cloud, known, ctx, buffer_m=0.3, recover_gap_cells=0).walls[0]
    measured = (wall.mask == SurfaceMask.MEASURED).ravel()
    assert np.count_nonzero(is_stray & kept) > 100
    # Some strays lie beside each other like a slope.
    assert np.mean(measured[is_stray & kept]) < 0.1
    np.testing.assert_array_equal(measured[~in_shadow], kept[~in_shadow])


@pytest.mark.parametrize("surface", ["nearest", "denoised", "topmost"])
def test_a_wall_rastered_in_bands_is_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, surface: str
) -> None:
    known = scenes.leaning_wall(shape=(300, 60))
    cloud, *_ = scattered(known, per_cell=1.2, noise_m=NOISE_M)
    params = {"surface": surface, "percentiles": (10.0,)}
    whole = rastered(cloud, known, scenes.context(tmp_path), **params).walls[0]
    monkeypatch.setattr("orthoflow_plugins.raster.walls._BAND_CELLS", 60 * 180)
    banded = rastered(cloud, known, scenes.context(tmp_path), **params).walls[0]
    for name in ("count", "mask", "rgb", "percentiles_m", "intensity", "depth_m", "sigma_m"):
        one, other = getattr(whole, name), getattr(banded, name)
        # How strongly noise is taken out follows from the noise of a band.
        tolerance = 0.2 * NOISE_M if surface == "denoised" and name == "depth_m" else 1e-6
        np.testing.assert_allclose(one, other, atol=tolerance, err_msg=name)
    assert list(tmp_path.glob("*/allocated/walls.0.depth_m"))
