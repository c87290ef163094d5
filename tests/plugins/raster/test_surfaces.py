"""The rules of `raster.grid` that look beyond one cell, and what they make of noise and steps."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.raster.nets import NO_POINT, interpolate_net
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import cKDTree

from orthoflow.errors import MethodError
from orthoflow.geometry import frame_over
from orthoflow.geometry.slabs import Slab
from orthoflow.products import PointCloud, SurfaceMask, Walls
from tests import raster_scenes as scenes

NOISE_M = 0.002


def rastered(cloud: PointCloud, known: scenes.KnownWall, folder: Path, **params: object) -> Walls:
    return scenes.rastered(cloud, known.planes(), folder, gsd_m=known.gsd_m, **params)[0]


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
    (both,), (no_rgb,), (no_intensity,) = (
        rastered(dataclasses.replace(cloud, **lost), known, tmp_path, recover_gap_cells=0).walls
        for lost in ({}, {"rgb": None}, {"intensity": None})
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
    wall = rastered(cloud, known, tmp_path, surface="nearest", recover_gap_cells=0).walls[0]
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
        wall = rastered(cloud, known, tmp_path, surface=surface).walls[0]
        np.testing.assert_allclose(wall.depth_m, true_m, atol=1e-5)
        np.testing.assert_array_equal(wall.mask == SurfaceMask.RECOVERED, wrong)


def test_denoising_takes_the_noise_and_leaves_the_steps(tmp_path: Path) -> None:
    known = scenes.leaning_wall(shape=(120, 160))
    cloud, _, _ = scattered(known, per_cell=2.25, noise_m=NOISE_M)
    columns, _ = scenes.cell_centres(known.shape)
    true_m = scenes.relief_m(columns).reshape(known.shape)
    rms_mm = {}
    for surface in ("median", "denoised"):
        wall = rastered(cloud, known, tmp_path, surface=surface).walls[0]
        measured = wall.mask == SurfaceMask.MEASURED
        errors = (wall.depth_m - true_m)[measured]
        rms_mm[surface] = 1e3 * float(np.sqrt(np.mean(errors**2)))
        # Steps of 8 and 10 cm every ten cells stay where they are, to the cell.
        assert np.abs(errors).max() < 0.02
    # A cell has about two points, sqrt(1/2) of 2 mm and some cells with one.
    assert 1.2 < rms_mm["median"] < 2.0
    assert rms_mm["denoised"] < 0.45 * rms_mm["median"]


def test_a_net_of_triangles_closes_windows(tmp_path: Path) -> None:
    known = scenes.leaning_wall(shape=(40, 60))
    cloud, places, _ = scattered(known, per_cell=3.0)
    in_window = (np.abs(places - [25.0, 20.0]) < 8.0).all(axis=1)
    holed = scenes.part_of(cloud, np.flatnonzero(~in_window))
    grid, net = (
        rastered(holed, known, tmp_path, surface=name).walls[0] for name in ("median", "tin")
    )
    assert (grid.mask[16:24, 21:29] == SurfaceMask.VOID).all()
    assert (net.mask[16:24, 21:29] == SurfaceMask.RECOVERED).all()
    np.testing.assert_array_equal(net.count, grid.count)
    assert (net.rgb[net.mask > 0] == 120).all()


def test_percentiles_are_numpys(tmp_path: Path) -> None:
    known = scenes.upright_wall()
    rng = np.random.default_rng(9)
    depths_m = rng.normal(0.0, 0.03, 57)
    points = known.world(rng.uniform(3, 4, 57), rng.uniform(4, 5, 57), depths_m)
    walls = rastered(scenes.cloud_of(points), known, tmp_path, percentiles=[0, 10, 50, 99])
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
        found.append(rastered(cloud, known, tmp_path, percentiles=[5, 50]).walls[0])
    for name in ("depth_m", "percentiles_m", "count", "intensity"):
        np.testing.assert_array_equal(*(getattr(wall, name) for wall in found), err_msg=name)


def test_the_buffer_is_three_tolerances_of_the_planes_unless_set(tmp_path: Path) -> None:
    known = scenes.leaning_wall(shape=(40, 60))
    cloud, _, _ = scattered(known, per_cell=1.0)

    def buffers(stated: dict[str, float], **params: object) -> tuple[float, float]:
        planes = dataclasses.replace(known.planes(), **stated)
        walls, _ = scenes.rastered(cloud, planes, tmp_path, gsd_m=known.gsd_m, **params)
        return walls.buffer_front_m, walls.buffer_behind_m

    assert buffers({}) == pytest.approx((0.15, 0.15))
    assert buffers({"tolerance_m": 0.1}) == pytest.approx((0.3, 0.3))
    assert buffers({"tolerance_m": 0.04}, buffer_front_m=0.2) == pytest.approx((0.2, 0.12))
    assert buffers({"tolerance_m": 0.04}, buffer_m=0.25) == pytest.approx((0.25, 0.25))


def test_scans_without_stations_cannot_be_balanced(tmp_path: Path) -> None:
    known = scenes.leaning_wall(shape=(40, 60))
    cloud, *_ = scattered(known, per_cell=1.0)
    _, ctx = scenes.rastered(cloud, known.planes(), tmp_path, balance_intensity=True)
    assert "intensity-not-balanced" in {one.code for one in ctx.diagnostics}


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
    wall = rastered(cloud, known, tmp_path, buffer_m=0.3, recover_gap_cells=0).walls[0]
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
    whole = rastered(cloud, known, tmp_path, **params).walls[0]
    monkeypatch.setattr("orthoflow_plugins.raster.walls._BAND_CELLS", 60 * 180)
    banded = rastered(cloud, known, tmp_path, **params).walls[0]
    for name in ("count", "mask", "rgb", "percentiles_m", "intensity", "depth_m", "sigma_m"):
        one, other = getattr(whole, name), getattr(banded, name)
        # How strongly noise is taken out follows from the noise of a band.
        tolerance = 0.2 * NOISE_M if surface == "denoised" and name == "depth_m" else 1e-6
        np.testing.assert_allclose(one, other, atol=tolerance, err_msg=name)
    assert list(tmp_path.glob("*/allocated/walls.0.depth_m"))


SHAPE = (340, 260)


def slab_of(known: scenes.KnownWall) -> Slab:
    frame = frame_over(known.planes().corners[0], known.normal, gsd_m=known.gsd_m)
    return Slab(frame=frame, front_m=0.1, behind_m=0.1)


def test_values_are_linear_in_the_triangles_between_points() -> None:
    rng = np.random.default_rng(5)
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    has_point = rng.random(SHAPE) < 0.67
    has_point[30:180, 20:175] = False
    # As far as a gable: beside it nothing was scanned.
    has_point[rows + 60 < columns / 2] = False
    count = int(np.count_nonzero(has_point))
    places = np.column_stack([columns[has_point], rows[has_point]]) + rng.random((count, 2))
    known = scenes.leaning_wall(shape=SHAPE)
    depths_m = (0.02 * np.sin(places[:, 0] / 9.0)).astype(np.float32)
    intensity = rng.random(count).astype(np.float32)
    rgb = rng.integers(0, 256, (count, 3), dtype=np.uint8)
    cloud = scenes.cloud_of(known.world(*places.T, depths_m), intensity=intensity, rgb=rgb)
    point = np.full(SHAPE, NO_POINT)
    point[has_point] = np.arange(count)
    depth_m = np.full(SHAPE, np.nan, dtype=np.float32)
    depth_m[has_point] = depths_m
    found = interpolate_net(cloud, slab_of(known), point.ravel(), depth_m.ravel())
    values = np.column_stack([depths_m, intensity, rgb])
    expected = LinearNDInterpolator(places, values)(columns + 0.5, rows + 0.5).reshape(-1, 5)
    is_inside = np.isfinite(expected[:, 0])
    assert 0.7 < is_inside.mean() < 0.99
    np.testing.assert_array_equal(np.isfinite(found[0]), is_inside)
    apart = np.column_stack(found) - expected
    # Coordinates in float32 may turn single triangles.
    is_off = np.abs(apart[is_inside]) > [1e-5, 1e-3, 0.6, 0.6, 0.6]
    assert is_off.any(axis=1).mean() < 1e-4
    two = np.where(point < 2, point, NO_POINT).ravel()
    with pytest.raises(MethodError, match="points that span triangles"):
        interpolate_net(cloud, slab_of(known), two, depth_m.ravel())
