"""Pictures, channels and merged cells of a wall, and points on its surface."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.match import channels, pictures
from orthoflow_plugins.match.channels import in_cells_of_points
from orthoflow_plugins.raster.surfaces import denoised
from scipy.ndimage import gaussian_filter

from orthoflow.errors import MethodError
from orthoflow.products import Photos, SurfaceMask, Wall
from tests import raster_scenes as scenes
from tests import samples


def texture(seed: int = 1, shape: tuple[int, int] = (90, 120)) -> NDArray[np.float32]:
    smooth = gaussian_filter(np.random.default_rng(seed).normal(size=shape), 1.5)
    return (100.0 + 20.0 * smooth / smooth.std()).astype(np.float32)


GSD_M = 0.01


# The type is Any, since the fields of the wall have different types.
def wall(depth_m: NDArray[np.float32], **known: Any) -> Wall:
    """Return a wall with four points in each cell and a spread of 2 mm."""
    usual = {
        "sigma_m": np.full(depth_m.shape, 0.002, dtype=np.float32),
        "count": np.full(depth_m.shape, 4, dtype=np.uint32),
    }
    frame = samples.facing_south(GSD_M, *depth_m.shape[::-1])
    return samples.wall(frame, depth_m=depth_m, **{**usual, **known})


def grey_of(depth_m: NDArray[np.float32], *, spread_m: float = 0.001) -> NDArray[np.float32]:
    """Return the grey values of a wall with three points in each cell, NaN where excluded."""
    made = wall(
        depth_m,
        sigma_m=np.full_like(depth_m, spread_m),
        count=np.full(depth_m.shape, 3, dtype=np.uint32),
        intensity=np.full_like(depth_m, 0.5),
    )
    grey = channels.WallTarget(made).grey
    assert grey is not None
    return grey


def test_gradients_have_six_directions_and_do_not_tell_light_from_dark() -> None:
    grey = texture()
    found, negative = (channels.gradient_channels(given) for given in (grey, 200.0 - grey))
    np.testing.assert_allclose(found.values, negative.values, atol=1e-4)
    assert (found.values >= 0.0).all()
    # At a vertical edge, the first direction is strongest and the fourth weakest.
    edge = np.zeros((60, 60), dtype=np.float32)
    edge[:, 30:] = 100.0
    at_edge = channels.gradient_channels(edge).values[30, 30]
    assert at_edge.shape == (6,)
    assert (int(np.argmax(at_edge)), int(np.argmin(at_edge))) == (0, 3)
    assert at_edge[1] == pytest.approx(at_edge[0] * np.cos(np.pi / 6), rel=1e-4)


def test_cells_within_two_of_a_void_are_not_known() -> None:
    grey = texture()
    grey[40, 50] = np.nan
    for content in (channels.grey_channels, channels.gradient_channels):
        found = content(grey)
        expected = np.ones(grey.shape, dtype=np.float32)
        expected[38:43, 48:53] = 0.0
        np.testing.assert_array_equal(found.known, expected)
        assert not found.values[38:43, 48:53].any()
        assert np.isfinite(found.values).all()


def test_colours_are_evened_out_as_one() -> None:
    red = texture(1)
    colours = np.stack([red, 0.1 * texture(2), np.full(red.shape, 7.0, np.float32)], axis=2)
    values = channels.colour_channels(colours).values
    spreads = values[10:-10, 10:-10].std(axis=(0, 1))
    # Weak channels remain weak next to strong ones.
    assert spreads[0] == pytest.approx(1.0, abs=0.15)
    assert spreads[1] == pytest.approx(0.1, abs=0.03)
    assert spreads[2] < 1e-3


@pytest.mark.parametrize("every", [1, 2, 3])
def test_a_patch_tells_no_more_than_its_measured_cells(every: int) -> None:
    count = np.zeros((60, 60), dtype=np.uint32)
    count[::every, ::every] = 5
    depth_m = np.zeros((60, 60), dtype=np.float32)
    found = channels.grain_of(wall(depth_m, count=count))
    assert np.mean(found[12:48, 12:48]) == pytest.approx(every**2, rel=0.1)
    assert found.min() >= 1.0
    # Void cells are not counted; where no cell is known, the result is 1.
    depth_m[:, 30:] = np.nan
    assert channels.grain_of(wall(depth_m, count=count))[30, 50] == 1.0


@pytest.mark.parametrize(
    ("spread_m", "step_m", "is_left_out"),
    [(0.001, 0.015, True), (0.001, 0.008, False), (0.004, 0.015, False), (0.004, 0.03, True)],
    ids=["step", "less-than-a-cell", "noise", "step-beyond-noise"],
)
@pytest.mark.parametrize("quarters", [0, 1, 2])
def test_cells_beside_a_step_are_left_out_of_what_is_compared(
    quarters: int, spread_m: float, step_m: float, is_left_out: bool
) -> None:
    depth_m = np.full((40, 40), 0.3, dtype=np.float32)
    depth_m[:, :20] += np.float32(step_m)
    # A window next to the step, higher up.
    depth_m[:8, 20:30] = np.nan
    turned = np.rot90(depth_m, quarters).copy()
    grey = grey_of(turned, spread_m=spread_m)
    left_out = np.isnan(np.rot90(grey, -quarters)) & np.isfinite(depth_m)
    assert left_out[10:].any(axis=0).nonzero()[0].tolist() == ([19, 20] if is_left_out else [])
    assert left_out[10:].sum() == (60 if is_left_out else 0)


@pytest.mark.parametrize(("every", "is_kept"), [(8, True), (40, False)], ids=["carved", "panels"])
def test_where_steps_are_everywhere_they_are_compared(every: int, is_kept: bool) -> None:
    columns = np.broadcast_to(np.arange(160), (140, 160))
    depth_m = np.where(columns // every % 2 == 0, 0.03, 0.0).astype(np.float32)
    assert np.isnan(grey_of(depth_m)).sum() == (0 if is_kept else 140 * 2 * 3)
    # Slopes are not steps.
    assert np.isfinite(grey_of((0.03 * columns).astype(np.float32))).all()


SHAPE = (301, 350)
FINE_M = 0.002
STEP_M = 0.05


def sparse_wall(spacing_cells: float, *, factor: int = 2) -> Wall:
    """Return a wall of single points at random positions.

    Values refer to cell centres, as in `raster.grid`.

    It shows `scenes.waves` for cells that are `factor` times as wide.
    """
    places = scenes.points_apart(SHAPE, spacing_cells, seed=3, in_rows=False)
    columns, rows = np.unique(np.floor(places).astype(np.intp), axis=0).T
    rasters = {
        name: np.full(SHAPE, np.nan, np.float32) for name in ("depth_m", "sigma_m", "intensity")
    }
    shade = scenes.waves((columns + 0.5) / factor, (rows + 0.5) / factor)
    rasters["intensity"][rows, columns] = shade
    noise_m = np.random.default_rng(2).normal(0.0, 0.001, len(rows))
    rasters["depth_m"][rows, columns] = np.where(columns < 150, STEP_M, 0.0) + noise_m
    count = np.zeros(SHAPE, dtype=np.uint32)
    count[rows, columns] = 1
    frame = samples.facing_south(FINE_M, SHAPE[1], SHAPE[0])
    return samples.wall(frame, count=count, **rasters)


@pytest.mark.parametrize(("spacing_cells", "factor"), [(2.2, 2), (3.3, 3)])
def test_joined_cells_show_the_wall_where_it_is(spacing_cells: float, factor: int) -> None:
    wall = sparse_wall(spacing_cells, factor=factor)
    joined = in_cells_of_points(wall)
    assert joined.frame.gsd_m == pytest.approx(factor * FINE_M)
    assert joined.frame.shape == tuple(-(-length // factor) for length in SHAPE)
    np.testing.assert_array_equal(joined.frame.origin_world, wall.frame.origin_world)
    assert joined.count.sum() == wall.count.sum()
    # Most of the void cells are now between points.
    assert np.isfinite(wall.depth_m).mean() < 0.25
    assert np.isfinite(joined.depth_m).mean() > 0.9
    np.testing.assert_array_equal(joined.mask == SurfaceMask.MEASURED, joined.count > 0)
    assert joined.intensity is not None
    assert np.abs(scenes.shift_of_waves(joined.intensity)).max() < 0.01


def test_no_joined_depth_lies_between_two_surfaces() -> None:
    joined = in_cells_of_points(sparse_wall(2.2))
    depth_m = joined.depth_m[np.isfinite(joined.depth_m)]
    assert (np.minimum(np.abs(depth_m), np.abs(depth_m - STEP_M)) < 0.006).all()
    spread_m = joined.sigma_m[np.isfinite(joined.sigma_m)]
    assert np.sqrt(np.mean(spread_m**2)) == pytest.approx(0.001, rel=0.15)


def test_cells_as_wide_as_points_lie_apart_stay_and_so_does_a_wall_that_shows_nothing() -> None:
    dense = sparse_wall(1.6)
    assert in_cells_of_points(dense) is dense
    blind = replace(sparse_wall(3.3), intensity=None)
    assert in_cells_of_points(blind) is blind


def ramp(rows: int = 20, columns: int = 30) -> NDArray[np.float32]:
    """Return depths that increase by 1 mm per column and 0.5 mm per row."""
    r, c = np.mgrid[:rows, :columns]
    return (0.001 * c + 0.0005 * r).astype(np.float32)


@pytest.mark.parametrize(
    ("place", "depth_m"),
    [
        ((5.5, 7.5), 0.005 + 0.0035),
        ((5.75, 7.5), 0.00525 + 0.0035),
        ((5.5, 7.0), 0.005 + 0.00325),
        # Beyond the outermost centres, the value of the last cell is used.
        ((0.1, 0.1), 0.0),
        ((29.9, 19.9), 0.029 + 0.0095),
    ],
)
def test_between_cells_a_smooth_surface_is_interpolated(
    place: tuple[float, float], depth_m: float
) -> None:
    found = pictures.points_on_wall(wall(ramp()), np.array([place]))
    np.testing.assert_allclose(
        found[0], [[GSD_M * place[0], -depth_m, -GSD_M * place[1]]], atol=1e-7
    )
    assert found[2].tolist() == [True]


def test_the_accuracy_of_a_point_is_that_of_its_cell_and_its_place_in_it() -> None:
    of = wall(ramp())
    of.count[7, 5], of.sigma_m[7, 5] = 16, 0.008
    of.count[7, 6] = 1  # a single point has no spread
    of.sigma_m[7, 7], of.count[7, 7] = np.nan, 4
    of.count[7, 8] = 400
    places = np.array([[5.5, 7.5], [6.5, 7.5], [7.5, 7.5], [8.5, 7.5]])
    in_cell_m = 0.5 * GSD_M / math.sqrt(12.0)
    # The usual spread is 2 mm; the mean of many points is at best accurate to 0.3 of it.
    for usual_m, told_m in ((0.002, None), (0.002, 0.002), (0.005, 0.005)):
        noises_m = (0.008 / 4.0, usual_m, usual_m / 2.0, 0.3 * usual_m)
        np.testing.assert_allclose(
            pictures.points_on_wall(of, places, spread=told_m and pictures.Spread(told_m, 1.0))[1],
            [math.hypot(noise_m, in_cell_m) for noise_m in noises_m],
            rtol=1e-6,
        )


def test_smoothing_reduces_the_error_of_a_point() -> None:
    noise_m = 0.02
    depth_m = np.random.default_rng(5).normal(0.0, noise_m, (300, 400)).astype(np.float32)
    spread_m = np.full(depth_m.shape, noise_m, dtype=np.float32)
    noisy = wall(depth_m, sigma_m=spread_m, count=np.ones(depth_m.shape, np.uint32))
    places = 10.0 + 10.0 * np.argwhere(np.ones((38, 28)))
    for of in (noisy, replace(noisy, depth_m=denoised(depth_m, noise_m))):
        points, sigmas_m, _ = pictures.points_on_wall(of, places + 0.5)
        assert np.median(sigmas_m) == pytest.approx(np.std(points[:, 1]), rel=0.3)


@pytest.mark.parametrize(("step_m", "is_edge"), [(0.0095, False), (0.0105, True)])
def test_at_an_edge_the_nearest_cell_holds_and_the_step_is_doubt(
    step_m: float, is_edge: bool
) -> None:
    depth_m = np.zeros((20, 30), dtype=np.float32)
    depth_m[:, 10:] = step_m
    found = pictures.points_on_wall(wall(depth_m), np.array([[10.25, 7.5]]))
    # The position is a quarter of a cell in front of the centre of the step's first cell.
    expected_m = step_m if is_edge else 0.75 * step_m
    assert -found[0][0, 1] == pytest.approx(expected_m, rel=1e-5)
    doubt_m = step_m / math.sqrt(12.0) if is_edge else 0.0
    plain_m = math.hypot(0.001, 0.5 * GSD_M / math.sqrt(12.0))
    assert found[1][0] == pytest.approx(math.hypot(plain_m, doubt_m), rel=1e-5)


def test_where_nothing_is_known_there_is_no_point() -> None:
    depth_m = ramp()
    depth_m[7, 5] = np.nan
    found = pictures.points_on_wall(wall(depth_m), np.array([[5.5, 7.5], [6.4, 7.5]]))
    assert found[2].tolist() == [False, True]
    # Next to a void, the value of the nearest cell is used.
    assert -found[0][1, 1] == pytest.approx(0.006 + 0.0035, abs=1e-6)


def test_void_is_filled_from_around_and_what_is_known_stays() -> None:
    values = np.add.outer(np.arange(40.0), 2.0 * np.arange(50.0))
    holes = values.copy()
    holes[10:14, 20:25] = np.nan
    filled = pictures.filled_smoothly(holes)
    known = np.isfinite(holes)
    np.testing.assert_array_equal(filled[known], values[known].astype(np.float32))
    np.testing.assert_allclose(filled[~known], values[~known], atol=6.0)
    half = np.full((32, 32), np.nan)
    assert np.isfinite(pictures.filled_smoothly(half)).all()
    half[0, 0] = 7.0
    np.testing.assert_allclose(pictures.filled_smoothly(half), 7.0, rtol=1e-5)


def test_a_wall_becomes_a_picture_of_its_inner_percentiles() -> None:
    depth_m = np.zeros((100, 200), np.float32)
    intensity = np.tile(np.linspace(0.2, 0.4, 200, dtype=np.float32), (100, 1))
    intensity[40:60, 80:120] = np.nan
    options = {"clip_limit": 0.0, "void_margin_cells": 2}
    picture = pictures.wall_picture(wall(depth_m, intensity=intensity), **options)
    assert picture is not None
    whole, usable = picture
    grey = whole[20].astype(int)
    assert (grey[0], grey[-1]) == (0, 255)
    assert (np.diff(grey) >= 0).all()
    assert grey[100] == pytest.approx(128, abs=3)
    # More than 0.7 of the 5 x 5 cells around a cell must be known; at a straight border, it is 0.8
    # or 0.6.
    assert usable[50, [78, 79, 100]].tolist() == [True, False, False]
    assert usable[:38].all()
    # A wall without intensity has no picture.
    for nothing in (None, np.full_like(depth_m, np.nan)):
        assert pictures.wall_picture(wall(depth_m, intensity=nothing), **options) is None


def test_nothing_to_match_is_refused() -> None:
    silent = wall(np.zeros((2, 2), np.float32))
    shown = replace(silent, intensity=np.zeros((2, 2), np.float32))
    pictures.require_intensity(samples.walls(silent, shown))
    with pytest.raises(MethodError, match="there are no walls to match photos with"):
        pictures.require_intensity(samples.walls())
    with pytest.raises(MethodError, match="there are no photos to match"):
        pictures.require_photos(Photos(photos=()))
