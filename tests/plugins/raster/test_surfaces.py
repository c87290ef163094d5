"""Rules of `raster.grid` that use several cells, at steps and for rotated walls."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.raster.nets import interpolate_net
from orthoflow_plugins.raster.surfaces import denoised, without_specks
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import cKDTree

from orthoflow.errors import MethodError
from orthoflow.geometry import frame_over
from orthoflow.geometry.rastering import NO_POINT
from orthoflow.geometry.robust import depth_noise_m
from orthoflow.geometry.slabs import Slab
from orthoflow.products import PointCloud, SurfaceMask, Wall, Walls
from tests import raster_scenes as scenes
from tests.turns import OTHER_TURNS, TURNS, Turn

NOISE_M = 0.002


def rastered(cloud: PointCloud, known: scenes.KnownWall, folder: Path, **params: object) -> Walls:
    return scenes.rastered(cloud, known.planes(), folder, gsd_m=known.gsd_m, **params)[0]


def scattered(
    known: scenes.KnownWall, *, per_cell: float, seed: int = 4, noise_m: float = 0.0
) -> tuple[PointCloud, NDArray[np.float64], NDArray[np.float64]]:
    """Return random points on a wall with steps, their columns and rows (n, 2), and depths."""
    rng = np.random.default_rng(seed)
    n_points = int(per_cell * np.prod(known.shape))
    places = rng.uniform(0.0, known.shape[::-1], (n_points, 2))
    depths_m = scenes.relief_m(places[:, 0]) + noise_m * rng.normal(size=n_points)
    grey = np.full((n_points, 3), 120, dtype=np.uint8)
    intensity = rng.random(n_points, dtype=np.float32)
    cloud = scenes.cloud_of(known.world(*places.T, depths_m), rgb=grey, intensity=intensity)
    return cloud, places, depths_m


def test_intensity_and_colour_are_extrapolated_to_cell_centres(tmp_path: Path) -> None:
    known = scenes.leaning_wall(shape=(20, 30))
    cloud, places, _ = scattered(known, per_cell=1.5)
    # Both rise along the wall, so extrapolated values are those at the cell centres.
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
    # On average, points are a quarter of a cell from the centre.
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


@pytest.mark.parametrize("noise_m", [NOISE_M, 0.03])
def test_the_median_is_denoised_after_gaps_are_closed_by_default_if_noise_exceeds_the_cells(
    tmp_path: Path, noise_m: float
) -> None:
    known = scenes.leaning_wall(shape=(60, 80))
    cloud, _, _ = scattered(known, per_cell=1.0, noise_m=noise_m)
    variants: tuple[dict[str, object], ...] = (
        {"surface": "median", "recover_gap_cells": 0},
        {"surface": "median"},
        {"surface": "denoised"},
        {},
    )
    planes = dataclasses.replace(known.planes(), rms_m=np.array([noise_m]))
    found = [
        scenes.rastered(cloud, planes, tmp_path, gsd_m=known.gsd_m, **params) for params in variants
    ]
    measured_m, median_m, filtered_m, default_m = (walls.walls[0].depth_m for walls, _ in found)
    expected_m = denoised(median_m, depth_noise_m(measured_m))
    np.testing.assert_allclose(filtered_m, expected_m, atol=1e-6)
    assert 0.25 * noise_m < np.nanstd(filtered_m - median_m) < noise_m
    # Two points of a cell are not on different surfaces because of their noise.
    assert abs(np.nanmedian(median_m - scenes.relief_m(np.arange(80) + 0.5))) < 0.06 * noise_m
    is_noisy, ctx = noise_m > known.gsd_m, found[3][1]
    np.testing.assert_array_equal(default_m, filtered_m if is_noisy else median_m)
    assert found[3][0].details["surface"] == ["denoised" if is_noisy else "median"]
    assert ("depths-smoothed" in {one.code for one in ctx.diagnostics}) == is_noisy


def test_percentiles_are_numpys_in_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    known = scenes.leaning_wall(shape=(40, 60))
    cloud, places, depths_m = scattered(known, per_cell=5.0, noise_m=NOISE_M)
    found = []
    for n_points, n_cells in ((1 << 26, 1 << 20), (700, 50)):
        monkeypatch.setattr("orthoflow_plugins.raster.surfaces.POINTS_AT_ONCE", n_points)
        monkeypatch.setattr("orthoflow_plugins.raster.surfaces.CELLS_AT_ONCE", n_cells)
        found.append(rastered(cloud, known, tmp_path, percentiles=[5, 50]).walls[0])
    for name in ("depth_m", "percentiles_m", "count", "intensity"):
        np.testing.assert_array_equal(*(getattr(wall, name) for wall in found), err_msg=name)
    percentiles_m = found[0].percentiles_m
    for row, column in ((0, 0), (7, 11), (39, 59)):
        own = (places.astype(int) == (column, row)).all(axis=1)
        expected = np.percentile(depths_m[own], [5, 50])
        np.testing.assert_allclose(percentiles_m[row, column], expected, atol=2e-6)
    np.testing.assert_array_equal(np.isnan(percentiles_m).all(axis=2), found[0].count == 0)


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


def test_strays_in_a_shadow_become_void_and_sparse_surfaces_stay(tmp_path: Path) -> None:
    known = scenes.leaning_wall(shape=(120, 160))
    columns, rows = scenes.cell_centres(known.shape)
    rng = np.random.default_rng(8)
    true_m = np.where(columns < 40, 0.07, 0.0)
    in_shadow = (columns > 40) & (columns < 60)
    # As in a scan, there are few points, mixed distances from both sides of the edge, and outliers.
    is_stray = in_shadow & (rng.random(len(columns)) < 0.06)
    depths_m = np.where(is_stray, rng.uniform(0.0, 0.2, len(columns)), true_m)
    # There is a dark surface with few points, all on one plane.
    is_dark = (columns > 100) & (columns < 140)
    kept = np.where(in_shadow, is_stray, ~is_dark | (rng.random(len(columns)) < 0.25))
    cloud = scenes.cloud_of(known.world(columns[kept], rows[kept], depths_m[kept]))
    wall = rastered(cloud, known, tmp_path, buffer_m=0.3, recover_gap_cells=0).walls[0]
    measured = (wall.mask == SurfaceMask.MEASURED).ravel()
    assert np.count_nonzero(is_stray & kept) > 100
    # Some stray points form a slope.
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
    monkeypatch.setattr("orthoflow_plugins.raster.walls.BAND_CELLS", 60 * 180)
    banded = rastered(cloud, known, tmp_path, **params).walls[0]
    for name in ("count", "mask", "rgb", "percentiles_m", "intensity", "depth_m", "sigma_m"):
        one, other = getattr(whole, name), getattr(banded, name)
        # The strength of the filter depends on the noise of each band.
        tolerance = 0.2 * NOISE_M if surface == "denoised" and name == "depth_m" else 1e-6
        np.testing.assert_allclose(one, other, atol=tolerance, err_msg=name)
    assert list(tmp_path.glob("*/allocated/*"))


SHAPE = (340, 260)


def slab_of(known: scenes.KnownWall) -> Slab:
    frame = frame_over(known.planes().corners[0], known.normal, gsd_m=known.gsd_m)
    return Slab(frame=frame, front_m=0.1, behind_m=0.1)


def test_values_are_linear_in_the_triangles_between_points() -> None:
    rng = np.random.default_rng(5)
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    has_point = rng.random(SHAPE) < 0.67
    has_point[30:180, 20:175] = False
    # A gable, beside which nothing was scanned.
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
    # float32 coordinates may change a few triangles.
    is_off = np.abs(apart[is_inside]) > [1e-5, 1e-3, 0.6, 0.6, 0.6]
    assert is_off.any(axis=1).mean() < 1e-4
    two = np.where(point < 2, point, NO_POINT).ravel()
    with pytest.raises(MethodError, match="form no triangle"):
        interpolate_net(cloud, slab_of(known), two, depth_m.ravel())


LAYER_M = 0.1
GSD_M = 0.01


def specks(depth_m: NDArray[np.float32]) -> NDArray[np.bool_]:
    cleaned = without_specks(depth_m, gsd_m=GSD_M, layer_m=LAYER_M, threads=2)
    is_speck = np.isnan(cleaned) & ~np.isnan(depth_m)
    np.testing.assert_array_equal(cleaned[~is_speck], depth_m[~is_speck])
    return is_speck


def flat(rows: int = 40, columns: int = 40, *, noise_m: float = 0.001) -> NDArray[np.float32]:
    return np.random.default_rng(1).normal(0.0, noise_m, (rows, columns)).astype(np.float32)


@pytest.mark.parametrize(("off_m", "n_cells", "is_speck"), [
    (0.2, 1, True),
    (0.2, 2, True),
    (0.2, 3, False),
    (0.09, 1, False),
    (-0.2, 1, True),
])  # fmt: skip
def test_cells_without_two_like_them_are_specks(off_m: float, n_cells: int, is_speck: bool) -> None:
    depth_m = flat()
    depth_m[20, 20 : 20 + n_cells] = off_m
    expected = np.zeros(depth_m.shape, dtype=np.bool_)
    expected[20, 20 : 20 + n_cells] = is_speck
    np.testing.assert_array_equal(specks(depth_m), expected)


@pytest.mark.parametrize(("n_known", "is_speck"), [(5, False), (6, True)])
def test_fewer_than_six_known_cells_say_nothing(n_known: int, is_speck: bool) -> None:
    # The cells are isolated in the void, so that no denser area is nearby.
    depth_m = np.full((40, 40), np.nan, dtype=np.float32)
    around = [(18, 18), (18, 20), (18, 22), (20, 18), (20, 22), (22, 18)][:n_known]
    for k, (row, column) in enumerate(around):
        depth_m[row, column] = 0.5 + 0.001 * k
    depth_m[20, 20] = 0.0
    assert specks(depth_m)[20, 20] == is_speck


def test_an_outlier_among_points_three_cells_apart_is_a_speck() -> None:
    depth_m = np.full((40, 40), np.nan, dtype=np.float32)
    depth_m[::3, ::3] = flat()[::3, ::3]
    depth_m[21, 21] = 0.2
    np.testing.assert_array_equal(specks(depth_m), depth_m == np.float32(0.2))


def shadow(*, agree: int, n: int = 6) -> NDArray[np.float32]:
    """Return a dense wall with a shadow of 10 columns that contains a few cells."""
    depth_m = flat(40, 60)
    depth_m[:, 25:35] = np.nan
    depth_m[20, 30] = 0.5
    places = [(20, 28), (20, 32), (18, 30), (22, 30), (17, 28), (23, 32)][:n]
    for k, (row, column) in enumerate(places):
        # Cells that do not agree also differ from each other.
        depth_m[row, column] = 0.5 if k < agree else 0.7 + 0.1 * k
    return depth_m


@pytest.mark.parametrize(
    ("agree", "n", "is_speck"), [(3, 6, False), (2, 6, True), (2, 3, True), (3, 3, False)]
)
def test_in_a_shadow_three_and_half_must_agree(agree: int, n: int, is_speck: bool) -> None:
    assert specks(shadow(agree=agree, n=n))[20, 30] == is_speck


def test_sparse_cells_agree_but_for_a_slope_of_one_in_two() -> None:
    for slope, is_speck in ((0.4, False), (0.8, True)):
        depth_m = flat(40, 60, noise_m=1e-5)
        depth_m[:, 25:35] = np.nan
        for row, column in ((20, 30), (20, 28), (20, 32), (20, 34)):
            depth_m[row, column] = 0.5 + slope * GSD_M * (column - 30)
        # The farthest cell is four columns away.
        assert specks(depth_m)[20, 30] == is_speck, slope


def weighed(depth_m: NDArray[np.float64], reach_m: float) -> NDArray[np.float64]:
    """Apply a bilateral filter cell by cell, with a disc of neighbours and Gaussian weights."""
    radius, sigma = 4, 2.0
    high = np.pad(depth_m, radius, mode="edge")
    total, weights = np.zeros_like(depth_m), np.zeros_like(depth_m)
    rows, columns = depth_m.shape
    steps = range(-radius, radius + 1)
    for down, right in [(a, b) for a in steps for b in steps if a * a + b * b <= radius**2]:
        other = high[radius + down :, radius + right :][:rows, :columns]
        weight = np.exp(-0.5 * ((other - depth_m) / reach_m) ** 2)
        weight *= np.exp(-0.5 * (down**2 + right**2) / sigma**2)
        total, weights = total + weight * other, weights + weight
    return total / weights


def test_noise_is_removed_by_two_bilateral_filters() -> None:
    depth_m = flat(30, 30, noise_m=0.012)
    depth_m[:, 15:] += 0.05
    expected = weighed(weighed(depth_m.astype(np.float64), 0.03), 0.015)
    np.testing.assert_allclose(denoised(depth_m, 0.01), expected, atol=2e-5)


TURNED = (34, 43)
SURFACES = ("median", "denoised", "nearest", "centre", "topmost", "mean", "tin")


@dataclasses.dataclass(frozen=True)
class Scattered:
    """Points on a wall of TURNED, with a depth step, a slope and a window."""

    places: NDArray[np.float64]
    depths_m: NDArray[np.float64]

    def cloud(self, turn: Turn) -> tuple[scenes.KnownWall, PointCloud]:
        known = scenes.upright_wall(shape=turn.shape(TURNED), gsd_m=2.0**-7)
        at = turn.places(self.places, TURNED)
        shade = 0.5 + 0.2 * np.sin(self.places[:, 0] / 2) + 0.2 * np.cos(self.places[:, 1] / 3)
        rgb = np.rint(np.stack([shade, shade**2, 1.0 - shade], axis=1) * 255.0)
        cloud = scenes.cloud_of(
            known.world(*at.T, self.depths_m),
            intensity=shade.astype(np.float32),
            rgb=rgb.astype(np.uint8),
        )
        return known, cloud


def in_window(places: NDArray[np.float64]) -> NDArray[np.bool_]:
    inside: NDArray[np.bool_] = (np.abs(places - (12.0, 22.0)) < (5.0, 4.0)).all(axis=1)
    return inside


def sloping_relief(places: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    step = np.where(places[:, 0] + 0.3 * places[:, 1] > 30.0, 0.06, 0.0)
    return step + 0.002 * places[:, 1] + rng.normal(0.0, 0.001, len(places))


@cache
def in_any_order(per_cell: float) -> Scattered:
    rng = np.random.default_rng(11)
    places = rng.uniform((0, 0), TURNED[::-1], (round(per_cell * TURNED[0] * TURNED[1]), 2))
    places = places[~in_window(places)]
    return Scattered(places, sloping_relief(places, rng))


def rastered_turned(scattered: Scattered, turn: Turn, folder: Path, **params: object) -> Wall:
    known, cloud = scattered.cloud(turn)
    walls, _ = scenes.rastered(cloud, known.planes(), folder, gsd_m=known.gsd_m, **params)
    return walls.walls[0]


def assert_turned(wall: Wall, turned: Wall, turn: Turn) -> None:
    np.testing.assert_array_equal(turned.count, turn.raster(wall.count))
    np.testing.assert_array_equal(turned.mask, turn.raster(wall.mask))
    # The tolerance is about a millionth, since float32 coordinates have another origin and sums
    # another order.
    for name, tolerance in (("depth_m", 2e-6), ("sigma_m", 2e-6), ("intensity", 2e-5)):
        one, other = getattr(wall, name), getattr(turned, name)
        np.testing.assert_allclose(other, turn.raster(one), atol=tolerance, err_msg=name)
    # Colours are rounded to whole levels.
    off = np.abs(turned.rgb.astype(int) - turn.raster(wall.rgb).astype(int))
    assert off.max() <= 1
    assert (off > 0).mean() < 0.001


@pytest.mark.parametrize("turn", OTHER_TURNS, ids=str)
@pytest.mark.parametrize("surface", SURFACES)
def test_a_turned_cloud_gives_the_turned_raster(tmp_path: Path, surface: str, turn: Turn) -> None:
    scattered = in_any_order(0.8)
    wall = rastered_turned(scattered, TURNS[0], tmp_path, surface=surface)
    assert 0.2 < np.mean(wall.mask == SurfaceMask.RECOVERED) < 0.6
    # A net of triangles also closes the window.
    closed = SurfaceMask.RECOVERED if surface == "tin" else SurfaceMask.VOID
    assert (wall.mask[20:24, 9:15] == closed).all()
    assert_turned(wall, rastered_turned(scattered, turn, tmp_path, surface=surface), turn)


@pytest.mark.parametrize("turn", OTHER_TURNS, ids=str)
def test_equally_near_cells_have_equal_weights(tmp_path: Path, turn: Turn) -> None:
    """Every other cell is measured at its centre, so each gap has four equally near points."""
    columns, rows = scenes.cell_centres(TURNED)
    places = np.column_stack([columns, rows])
    places = places[(columns + rows) % 2 > 0.5]
    # There are two adjacent surfaces; each gap at their border has two equally near points on each.
    scattered = Scattered(places, np.where(places[:, 0] < 21.0, 0.0, 0.0625))
    wall = rastered_turned(scattered, TURNS[0], tmp_path)
    assert_turned(wall, rastered_turned(scattered, turn, tmp_path), turn)
    assert set(np.unique(wall.depth_m[np.isfinite(wall.depth_m)])) == {
        np.float32(0.0),
        np.float32(0.0625),
    }


@pytest.mark.parametrize("surface", ["median", "centre", "nearest"])
@pytest.mark.parametrize("in_rows", [True, False], ids=["rows", "anywhere"])
@pytest.mark.parametrize("cells", [0.6, 1.1, 1.6])
def test_what_a_raster_shows_is_where_it_is(
    tmp_path: Path, cells: float, in_rows: bool, surface: str
) -> None:
    known = dataclasses.replace(scenes.leaning_wall(shape=(150, 190)), gsd_m=0.004)
    places = scenes.points_apart(known.shape, cells, seed=round(100 * cells), in_rows=in_rows)
    shade = scenes.waves(*places.T).astype(np.float32)
    cloud = scenes.cloud_of(known.world(*places.T, np.zeros(len(places))), intensity=shade)
    params: dict[str, object] = {"gsd_m": known.gsd_m, "surface": surface}
    wall = scenes.rastered(cloud, known.planes(), tmp_path, **params)[0].walls[0]
    # With rules that use a single point, the points of a scan may be on one side of many cells.
    limit = 0.01 if surface == "median" else 0.02
    assert np.abs(scenes.shift_of_waves(wall.intensity)).max() < limit
