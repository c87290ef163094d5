"""`ortho.pointcloud-direct`: the point that colours a cell, and the gaps that are filled."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from itertools import count
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from orthoflow_plugins.ortho.filling import fillable_gaps
from orthoflow_plugins.ortho.pointcloud_direct import PointcloudDirect
from orthoflow_plugins.simulate.room import SimulateRoom

from orthoflow.errors import MethodError
from orthoflow.geometry import frame_over
from orthoflow.geometry.levels import light_of_levels, lit
from orthoflow.products import Layer, LayerMask, PointCloud, Walls
from orthoflow.sdk import StepContext
from tests import raster_scenes as scenes
from tests import samples
from tests.method_runs import run
from tests.raster_scenes import context


def bare_walls(known: scenes.KnownWall) -> Walls:
    frame = frame_over(known.planes().corners[0], known.normal, gsd_m=known.gsd_m)
    wall = samples.wall(frame, depth_m=np.full(frame.shape, np.nan, dtype=np.float32))
    return samples.walls(wall)


def laid(
    cloud: PointCloud, walls: Walls, ctx: StepContext, **params: object
) -> tuple[Layer, dict[str, Mapping[str, Any]]]:
    """Return the layer of the wall, and the values of diagnostics by code."""
    layers = run(PointcloudDirect, ctx, {"walls": walls, "cloud": cloud}, **params)
    assert layers.layers.names == (walls.walls[0].name,)
    return layers.layers.layers[0], {one.code: one.values for one in ctx.diagnostics}


def painted(cloud: PointCloud, walls: Walls, folder: Path, **params: object) -> Layer:
    return laid(cloud, walls, scenes.context(folder), **params)[0]


@pytest.mark.parametrize("at_survey", [False, True], ids=["local", "survey"])
def test_a_painted_relief_comes_back_cell_by_cell(tmp_path: Path, at_survey: bool) -> None:
    known = scenes.leaning_wall(at_survey=at_survey)
    columns, rows = scenes.cell_centres(known.shape)
    rgb = scenes.checker(columns, rows)
    behind = known.world(columns, rows, scenes.relief_m(columns) - 0.03)
    front = known.world(columns + 0.4, rows - 0.4, scenes.relief_m(columns))
    hidden = np.full_like(rgb, 200)
    cloud = scenes.cloud_of(np.vstack([behind, front]), rgb=np.vstack([hidden, rgb]))
    layer = painted(cloud, bare_walls(known), tmp_path)
    np.testing.assert_array_equal(layer.rgb.reshape(-1, 3), rgb)
    assert (layer.mask == LayerMask.PAINTED).all()
    assert layer.filled is not None
    assert not layer.filled.any()
    # The distance to the centre is 0.4 * sqrt(2) cells, so the quality is 1 - 0.4.
    np.testing.assert_allclose(layer.quality, 0.6, atol=1e-4)


def test_of_equally_high_points_the_most_central_one_is_shown(tmp_path: Path) -> None:
    known = scenes.upright_wall()
    columns, rows = scenes.cell_centres(known.shape)
    flat = np.zeros(columns.size)
    points = [
        known.world(columns + 0.25, rows, flat),
        known.world(columns + 0.125, rows, flat),
        known.world(columns, rows, flat + 0.1501),
    ]
    colours = np.array([[9, 9, 9], [70, 80, 90], [250, 0, 0]], dtype=np.uint8)
    cloud = scenes.cloud_of(np.vstack(points), rgb=np.repeat(colours, columns.size, 0))
    layer = painted(cloud, bare_walls(known), tmp_path)
    assert np.unique(layer.rgb.reshape(-1, 3), axis=0).tolist() == [[70, 80, 90]]


def holey_wall(is_void: NDArray[np.bool_]) -> tuple[PointCloud, Walls]:
    known = scenes.leaning_wall(shape=(is_void.shape[0], is_void.shape[1]))
    columns, rows = scenes.cell_centres(known.shape)
    rgb = scenes.checker(columns, rows) // 2 + 100
    kept = ~is_void.ravel()
    points = known.world(columns, rows, np.zeros(columns.size))[kept]
    return scenes.cloud_of(points, rgb=rgb[kept]), bare_walls(known)


@pytest.mark.parametrize("method", ["telea", "navier-stokes"])
def test_only_gaps_are_filled_and_they_are_marked(tmp_path: Path, method: str) -> None:
    is_void = np.random.default_rng(4).random((40, 50)) < 0.25
    is_void[12:30, 15:35] = True
    cloud, walls = holey_wall(is_void)
    before = painted(cloud, walls, tmp_path, inpaint="none")
    layer = painted(cloud, walls, tmp_path, inpaint=method)
    expected = fillable_gaps(is_void, (7, 23, 46))
    assert expected.any()
    assert layer.filled is not None
    np.testing.assert_array_equal(layer.filled > 0, expected)
    np.testing.assert_array_equal(layer.mask == LayerMask.PAINTED, ~is_void | expected)
    np.testing.assert_array_equal(layer.mask == LayerMask.NO_SURFACE, is_void & ~expected)
    np.testing.assert_array_equal(layer.rgb[~is_void], before.rgb[~is_void])
    assert not layer.rgb[layer.mask != LayerMask.PAINTED].any()
    # The quality is less than that of a point in the corner of its cell.
    assert layer.quality[expected].max() < min(0.5, layer.quality[~is_void].min())
    assert not layer.quality[layer.mask != LayerMask.PAINTED].any()
    # The black of the large void does not bleed into adjacent gaps. Telea changes a uniform grey by
    # 2 levels, whereas black would change it by 50 or more.
    even = dataclasses.replace(cloud, rgb=np.full_like(cloud.rgb, 180))
    layer = painted(even, walls, tmp_path, inpaint=method)
    shown = layer.rgb[layer.mask == LayerMask.PAINTED].astype(int)
    assert np.abs(shown - 180).max() <= 2


@pytest.mark.parametrize(("method", "flag"), [("telea", 1), ("navier-stokes", 0)])
def test_small_gaps_are_filled_as_opencv_fills_them(tmp_path: Path, method: str, flag: int) -> None:
    is_void = np.zeros((40, 50), dtype=bool)
    is_void[5:35:6, 5:45:7] = True
    cloud, walls = holey_wall(is_void)
    bare = painted(cloud, walls, tmp_path, inpaint="none")
    layer = painted(cloud, walls, tmp_path, inpaint=method, inpaint_radius_px=3.0)
    expected = cv2.inpaint(np.asarray(bare.rgb), is_void.astype(np.uint8), 3.0, flag)
    np.testing.assert_array_equal(layer.rgb, expected)


def test_without_colours_the_intensity_is_painted_as_grey(tmp_path: Path) -> None:
    cloud, walls = holey_wall(np.zeros((10, 12), dtype=bool))
    shares = np.linspace(0, 1, len(cloud), dtype=np.float32)
    grey = dataclasses.replace(cloud, rgb=None, intensity=shares)
    layer, by_code = laid(grey, walls, scenes.context(tmp_path))
    expected = np.rint(255 * shares).astype(np.uint8)
    np.testing.assert_array_equal(layer.rgb.reshape(-1, 3), np.column_stack([expected] * 3))
    assert list(by_code) == ["cloud-without-colour"]


@pytest.mark.parametrize("n_black", [0, 1, 9])
def test_points_of_pure_black_are_told(tmp_path: Path, n_black: int) -> None:
    cloud, walls = holey_wall(np.zeros((10, 20), dtype=bool))
    rgb = np.full((200, 3), 7, np.uint8)
    rgb[0] = (0, 0, 1)
    rgb[200 - n_black :] = 0
    dark = dataclasses.replace(cloud, rgb=rgb)
    layer, by_code = laid(dark, walls, scenes.context(tmp_path), inpaint="none")
    found = [(code, of["n_black"], of["grey"]) for code, of in by_code.items()]
    assert found == [("points-black", n_black, 10)] * (n_black > 0)
    # Black points do not make cells void.
    assert (layer.mask == LayerMask.PAINTED).all()


def test_specks_of_pure_black_paint_no_cell_and_are_reported(tmp_path: Path) -> None:
    cloud, walls = holey_wall(np.zeros((10, 20), dtype=bool))
    rgb = np.full((200, 3), 120, np.uint8)
    rgb[5::20] = 0
    specked = dataclasses.replace(cloud, rgb=rgb)
    layer, by_code = laid(specked, walls, scenes.context(tmp_path))
    assert (layer.rgb[layer.mask == LayerMask.PAINTED] == 120).all()
    assert by_code["black-points-left-out"]["n_points"] == 10
    # They are painted if requested.
    layer = painted(specked, walls, tmp_path, skip_below_grey=0)
    assert (layer.rgb == 0).all(axis=2).any()


@pytest.mark.parametrize("colouring", ["topmost", "centre", "gaussian", "median"])
def test_points_without_colour_are_skipped_on_request(tmp_path: Path, colouring: str) -> None:
    known = scenes.leaning_wall(shape=(12, 15))
    columns, rows = scenes.cell_centres(known.shape)
    rgb = scenes.checker(columns, rows) // 2 + 100
    least = 10
    rgb[7] = (0, 0, least)
    # Points that are too dark are above every other cell, and they are the only points in the last
    # cell.
    flat = np.zeros(columns.size)
    points = np.vstack(
        [
            known.world(columns, rows, flat)[:-1],
            known.world(columns, rows, flat + 0.002)[::2],
            known.world(columns, rows, flat)[-1:],
        ]
    )
    dark = np.full((len(points) - len(rgb) + 1, 3), least - 1, dtype=np.uint8)
    cloud = scenes.cloud_of(points, rgb=np.vstack([rgb[:-1], dark]))
    walls = bare_walls(known)
    options = {"colouring": colouring, "inpaint": "none"}
    spotted = painted(cloud, walls, tmp_path, **options)
    layer = painted(cloud, walls, tmp_path, skip_below_grey=least, **options)
    if colouring == "topmost":
        assert (spotted.rgb.reshape(-1, 3)[::2] == least - 1).all()
    np.testing.assert_array_equal(layer.rgb.reshape(-1, 3)[:-1], rgb[:-1])
    assert (layer.mask.ravel()[:-1] == LayerMask.PAINTED).all()
    assert (spotted.mask.ravel()[-1], layer.mask.ravel()[-1]) == (
        LayerMask.PAINTED,
        LayerMask.NO_SURFACE,
    )


def test_a_cloud_that_cannot_paint_is_refused(tmp_path: Path) -> None:
    cloud, walls = holey_wall(np.zeros((10, 12), dtype=bool))
    with pytest.raises(MethodError, match="neither colours nor intensity"):
        painted(dataclasses.replace(cloud, rgb=None), walls, tmp_path)
    with pytest.raises(MethodError, match="no point of the cloud is within the buffer"):
        painted(dataclasses.replace(cloud, origin=cloud.origin + 9.0), walls, tmp_path)


def test_times_and_shares_are_reported_apart(tmp_path: Path) -> None:
    is_void = np.zeros((10, 20), dtype=bool)
    is_void[4, 4] = True
    is_void[:, 10:] = True
    # Use a clock that advances by one second per call.
    clock = count()
    lines: list[str] = []
    ctx = dataclasses.replace(
        scenes.context(tmp_path),
        clock_s=lambda: float(next(clock)),
        listen=lambda event: lines.append(event.text) if event.kind == "log" else None,
    )
    laid(*holey_wall(is_void), ctx, void_limits=(1, 25, 49))
    shares = {"painted_share": 99 / 200, "filled_share": 1 / 200, "empty_share": 100 / 200}
    # The projection consists of two parts: the points near the wall, and their colours.
    seconds = {"projection_s": 2.0, "filling_s": 1.0}
    assert scenes.numbers(ctx) == pytest.approx(shares | seconds)
    assert any(line.startswith("wall 0: 50.0% of its cells contain no point") for line in lines)


@pytest.mark.parametrize("inpaint", ["between", "telea", "navier-stokes"])
@pytest.mark.parametrize("cells", [0.6, 1.1, 1.6])
def test_clouds_are_painted_in_place(tmp_path: Path, cells: float, inpaint: str) -> None:
    known = dataclasses.replace(scenes.leaning_wall(shape=(150, 190)), gsd_m=0.004)
    places = scenes.points_apart(known.shape, cells, seed=round(100 * cells), in_rows=False)
    shade = np.rint(255.0 * scenes.waves(*places.T)).astype(np.uint8)
    points = known.world(*places.T, np.zeros(len(places)))
    cloud = scenes.cloud_of(points, rgb=np.repeat(shade[:, None], 3, axis=1))
    layer = painted(cloud, bare_walls(known), tmp_path, inpaint=inpaint)
    is_painted = layer.mask == LayerMask.PAINTED
    shown = np.where(is_painted, layer.rgb[..., 0] / 255.0, np.nan)
    # OpenCV's fronts begin at the top left and shift the inpainted colours, here by 0.15 cells.
    limit_cells = 0.02 if inpaint == "between" or cells < 1.0 else 0.2
    assert np.abs(scenes.shift_of_waves(shown)).max() < limit_cells


N_TOP = 5


def painted_by_rule(
    folder: Path, colouring: str, inpaint: str = "none"
) -> tuple[Layer, dict[int, list[int]]]:
    """Return a painted wall with two layers of random colours, and the expected colours."""
    known = scenes.leaning_wall(shape=(20, 30))
    rng = np.random.default_rng(8)
    n_points = 6000
    places = rng.uniform([0, 0], [30, 20], (n_points, 2))
    depths_m = rng.choice([-0.06, 0.05], n_points) + rng.uniform(0.0, 0.009, n_points)
    rgb = rng.integers(0, 256, (n_points, 3), dtype=np.uint8)
    cloud = scenes.cloud_of(known.world(*places.T, depths_m), rgb=rgb)
    layer = painted(cloud, bare_walls(known), folder, colouring=colouring, inpaint=inpaint)
    expected: dict[int, list[int]] = {}
    cells = np.floor(places[:, 1]).astype(int) * 30 + np.floor(places[:, 0]).astype(int)
    for cell in np.unique(cells):
        own = np.flatnonzero(cells == cell)
        own = own[np.argsort(-depths_m[own], kind="stable")]
        own = own[depths_m[own[0]] - depths_m[own] <= 0.02]
        expected[int(cell)] = _expected(colouring, own, places, rgb)
    return layer, expected


def _expected(
    colouring: str, own: NDArray[np.int64], places: NDArray[np.float64], rgb: NDArray[np.uint8]
) -> list[int]:
    squares = ((places[own] % 1.0 - 0.5) ** 2).sum(axis=1)
    if colouring == "topmost":
        colour = rgb[own[0]].astype(float)
    elif colouring == "centre":
        colour = rgb[own[np.argmin(squares)]].astype(float)
    elif colouring == "gaussian":
        weights = np.exp(-squares / (2 * 0.36**2))
        colour = weights @ rgb[own] / weights.sum()
    else:
        colour = np.floor(np.median(rgb[own[:N_TOP]], axis=0) + 0.5)
    return [round(float(value)) for value in colour]


@pytest.mark.parametrize("colouring", ["topmost", "centre", "gaussian", "median"])
def test_colours_follow_their_rule(tmp_path: Path, colouring: str) -> None:
    layer, expected = painted_by_rule(tmp_path, colouring)
    shown = layer.mask.ravel() == LayerMask.PAINTED
    np.testing.assert_array_equal(np.flatnonzero(shown), sorted(expected))
    colours = np.array([expected[cell] for cell in sorted(expected)])
    # The tolerance is one grey level, since positions are float32 offsets.
    assert np.abs(layer.rgb.reshape(-1, 3)[shown].astype(int) - colours).max() <= 1


@pytest.mark.parametrize(
    ("colouring", "inpaint"),
    [("topmost", "between"), ("centre", "telea"), ("gaussian", "none"), ("median", "between")],
)
def test_bands_do_not_show_in_colours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, colouring: str, inpaint: str
) -> None:
    whole, _ = painted_by_rule(tmp_path, colouring, inpaint=inpaint)
    # Fronts on this wall are short.
    monkeypatch.setattr("orthoflow_plugins.ortho.filling.FRONT_CELLS", 2)
    monkeypatch.setattr("orthoflow_plugins.ortho.pointcloud_direct.BAND_CELLS", 30 * 24)
    monkeypatch.setattr("orthoflow_plugins.ortho.point_colours.POINTS_AT_ONCE", 100)
    banded, _ = painted_by_rule(tmp_path, colouring, inpaint=inpaint)
    for name in ("rgb", "mask", "filled"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(banded, name), err_msg=name)
    # Positions are relative to the corner of the band, which changes the last digit of float32.
    np.testing.assert_allclose(whole.quality, banded.quality, atol=1e-6)


def test_a_gap_is_fillable_where_no_window_has_too_many_void_cells() -> None:
    is_void = np.random.default_rng(2).random((30, 40)) < 0.35
    # Cells outside are void.
    padded = np.pad(is_void, 3, constant_values=True)
    counts = [
        sliding_window_view(padded[3 - k : 33 + k, 3 - k : 43 + k], (2 * k + 1,) * 2).sum((2, 3))
        for k in (1, 2, 3)
    ]
    # Each of the three limits matters.
    for limits in ((4, 10, 19), (1, 25, 49), (9, 1, 49), (9, 25, 1)):
        pairs = zip(counts, limits, strict=True)
        wanted = is_void & np.logical_and.reduce([n <= limit for n, limit in pairs])
        np.testing.assert_array_equal(fillable_gaps(is_void, limits), wanted)
        assert wanted.sum() < is_void.sum()
    assert fillable_gaps(is_void, (9, 25, 49)).sum() == is_void.sum()


# Factors on the light of one scan, yellowish.
CAST = np.array([1.3, 1.0, 0.7])


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> tuple[PointCloud, Walls]:
    """Return a simulated room, scanned in colour from two stations, and its largest wall."""
    ctx = context(tmp_path_factory.mktemp("room"))
    made = run(SimulateRoom, ctx, {}, scan_step_m=0.018, panorama_step_m=0.012, photo_layout="none")
    params = {"gsd_m": 0.02, "n_walls_max": 1}
    return made.cloud, scenes.rastered(made.cloud, made.truth.planes, ctx.scratch, **params)[0]


def light_painted(
    cloud: PointCloud, walls: Walls, folder: Path, **params: object
) -> tuple[NDArray[np.float64], Mapping[str, Any] | None]:
    """Return the logarithm of the light of each cell (rows, cols, 3), NaN if void; diagnostics."""
    layer, by_code = laid(cloud, walls, scenes.context(folder), inpaint="none", **params)
    light = np.log(np.maximum(light_of_levels(255)[layer.rgb], 1e-3).astype(np.float64))
    light[(layer.mask != LayerMask.PAINTED) | (layer.rgb.min(axis=2) < 20)] = np.nan
    return light, by_code.get("scans-balanced")


def test_equal_scans_are_not_balanced(tmp_path: Path, room: tuple[PointCloud, Walls]) -> None:
    found, by_code = light_painted(*room, tmp_path)
    plain, _ = light_painted(*room, tmp_path, balance_scans=False)
    np.testing.assert_array_equal(found, plain)
    assert by_code is None


def test_a_cast_of_one_scan_is_taken_away(tmp_path: Path, room: tuple[PointCloud, Walls]) -> None:
    cloud, walls = room
    assert cloud.scan is not None
    rgb, is_off = np.array(cloud.rgb), cloud.scan == np.bincount(cloud.scan).argmax()
    gains = np.broadcast_to(np.log(CAST).astype(np.float32), (int(is_off.sum()), 3))
    rgb[is_off] = lit(rgb[is_off], gains)
    cast = dataclasses.replace(cloud, rgb=rgb)
    expected, _ = light_painted(cloud, walls, tmp_path)
    found, by_code = light_painted(cast, walls, tmp_path)
    left, silent = light_painted(cast, walls, tmp_path, balance_scans=False)
    assert silent is None
    assert by_code is not None
    assert (by_code["n"], by_code["n_scans"]) == (1, int(cloud.scan.max()) + 1)
    assert by_code["share"] == pytest.approx(1.0 / CAST.min() - 1.0, abs=0.05)
    apart, before = found - expected, left - expected
    known = np.isfinite(apart).all(axis=2) & np.isfinite(before).all(axis=2)
    # Where this scan paints, its cast is visible; after balancing, no cell differs.
    is_cast = known & (np.abs(before - np.log(CAST)).max(axis=2) < 0.1)
    assert is_cast.mean() > 0.05
    for cells in (is_cast, known):
        assert np.abs(np.median(apart[cells], axis=0)).max() < 0.03
        assert np.percentile(np.abs(apart[cells]), 95) < 0.05
