"""Samples, boxes and compiled passes, compared with simple implementations on random input."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane import cloud as clouds
from orthoflow_plugins.plane.cloud import PreparedCloud, draw_sample
from orthoflow_plugins.plane.hough import (
    best_bins,
    sharpest,
    vote_places,
    vote_planes,
)
from orthoflow_plugins.plane.kernels import (
    BLOCK_POINTS,
    FREE,
    LEVEL,
    STEPS_PER_TOLERANCE,
    VERTICAL,
    bin_distances,
    flattest,
    in_blocks,
    refine_robustly,
)
from orthoflow_plugins.plane.planes import measure_planes
from orthoflow_plugins.plane.support import INNER_SHARE, SurfaceRaster, measure_cells

from orthoflow.errors import ProductError
from orthoflow.geometry import Plane, wall_axes
from orthoflow.geometry.slabs import read_only
from tests import scenes
from tests.long_loops import seeds
from tests.plane_scenes import cloud_of, prepared, search_in

UP: Final = np.array([0.0, 0.0, 1.0])
# Three blocks and a part of one.
N_POINTS: Final = 3 * BLOCK_POINTS + 61


# --- blocks and the plan ---


@pytest.mark.parametrize("parts", [1, 3])
def test_boxes_enclose_the_points_of_their_block(parts: int) -> None:
    rows = np.random.default_rng(parts).uniform(-9.0, 9.0, (3, N_POINTS)).astype(np.float32)
    offsets = read_only(*rows)
    points = in_blocks(offsets, parts=parts)
    for block, box in enumerate(points.boxes):
        held = slice(block * BLOCK_POINTS, (block + 1) * BLOCK_POINTS)
        sides = [side(values[held]) for values in offsets for side in (np.min, np.max)]
        np.testing.assert_array_equal(box, sides)


# --- hypotheses ---


@pytest.mark.parametrize("seed", seeds(3))
def test_points_near_planes_are_counted_in_bins_of_distance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.0, 1.0, (3, N_POINTS)).astype(np.float32)
    planes = np.column_stack([rng.normal(size=(5, 3)), rng.uniform(-0.3, 0.3, 5)])
    planes = (planes / np.linalg.norm(planes[:, :3], axis=1)[:, None]).astype(np.float32)
    n_bins, reach_m = 64, 0.25
    per_m = np.float32(n_bins / reach_m)
    a, b, c, d = (planes * per_m).T[:, :, None]
    bins = np.abs(a * points[0] + b * points[1] + c * points[2] - d)
    found = np.ones((5, n_bins), dtype=np.int64)
    bin_distances(points, planes, reach_m, found)
    for row, histogram in zip(bins, found, strict=True):
        counts = np.bincount(row[row < n_bins].astype(int), minlength=n_bins)
        np.testing.assert_array_equal(histogram - 1, counts)


# --- fits ---


def moments(points: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y, z = points.T
    terms = [np.ones(len(x)), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z]
    return np.array([float((weights * term).sum()) for term in terms])


@pytest.mark.parametrize("seed", seeds(30))
def test_the_flattest_plane_is_the_smallest_eigenvector(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape = scenes.random_rotation(rng) * rng.uniform(0.01, 2.0, 3)
    points = rng.normal(size=(60, 3)) @ shape.T + rng.uniform(-2.0, 2.0, 3)
    plane = np.empty(9)
    flattest(moments(points, np.ones(60)), plane)
    variances, directions = np.linalg.eigh(np.cov(points.T, bias=True))
    np.testing.assert_allclose(plane[3:6], points.mean(axis=0), atol=1e-12)
    np.testing.assert_allclose(plane[6:], variances, rtol=1e-6, atol=1e-9)
    assert abs(plane[:3] @ directions[:, 0]) == pytest.approx(1.0, abs=1e-8)
    assert np.linalg.norm(plane[:3]) == pytest.approx(1.0, abs=1e-12)
    # The result is a level plane if the moments have no flattest plane.
    flattest(moments(np.full((4, 3), 2.0), np.ones(4)), plane)
    np.testing.assert_array_equal(plane, [0, 0, 1, 2, 2, 2, 0, 0, 0])
    line = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    flattest(moments(line, np.ones(2)), plane)
    np.testing.assert_allclose(plane, [0, 0, 1, 0, 0, 0, 0, 0, 1], atol=1e-8)


def reweighted(
    points: NDArray[np.float64], plane: NDArray[np.float64], tolerance_m: float, freedom: int
) -> NDArray[np.float64]:
    """Return the plane (4,) by total least squares with Tukey's weights, until convergence."""
    normal, offset_m = plane[:3], plane[3]
    for _ in range(20):
        ratios = (points @ normal - offset_m) / tolerance_m
        weights = np.where(np.abs(ratios) < 1.0, (1.0 - ratios**2) ** 2, 0.0)
        mean = weights @ points / weights.sum()
        spread = np.cov(points.T, aweights=weights, bias=True)
        if freedom == FREE:
            fitted = np.linalg.eigh(spread)[1][:, 0]
        elif freedom == VERTICAL:
            fitted = np.append(np.linalg.eigh(spread[:2, :2])[1][:, 0], 0.0)
        else:
            fitted = UP
        fitted = fitted * (-1.0 if fitted @ normal < 0.0 else 1.0)
        turn, moved_m = np.linalg.norm(fitted - normal), abs(fitted @ mean - offset_m)
        normal, offset_m = fitted, float(fitted @ mean)
        # A point ten metres away has moved by less than half a thousandth of the tolerance.
        if max(10.0 * turn, moved_m) < 5e-4 * tolerance_m:
            break
    return np.append(normal, offset_m)


@pytest.mark.parametrize("freedom", [FREE, VERTICAL, LEVEL], ids=["free", "vertical", "level"])
@pytest.mark.parametrize("seed", seeds(4))
def test_robust_fits_are_reweighted_least_squares(seed: int, freedom: int) -> None:
    rng = np.random.default_rng(seed)
    tolerance_m = 0.05
    normal = UP if freedom == LEVEL else np.array([0.6, -0.8, 0.0])
    if freedom == FREE:
        normal = scenes.random_rotation(rng)[0]
    axes = np.linalg.svd(normal[None])[2][1:]
    on_plane = rng.uniform(-2.0, 2.0, (400, 2)) @ axes + 1.3 * normal
    on_plane += rng.normal(0.0, 0.01, (400, 1)) * normal
    points = np.concatenate([on_plane, rng.uniform(-2.0, 2.0, (300, 3)) + 1.3 * normal])
    start = np.append(normal, 1.3 + 0.02)
    if freedom != LEVEL:
        turned = normal + 0.01 * np.cross(UP if freedom == VERTICAL else axes[0], normal)
        start[:3] = turned / np.linalg.norm(turned)
    # The normal keeps the side that it has at the start.
    for plane in (start, -start if freedom != LEVEL else start):
        found = plane.copy()
        assert refine_robustly(points, found, tolerance_m, freedom)
        expected = reweighted(points, plane, tolerance_m, freedom)
        np.testing.assert_allclose(found, expected, atol=1e-8)


def test_neither_nothing_nor_a_line_supports_a_plane() -> None:
    rng = np.random.default_rng(0)
    level = np.array([0.0, 0.0, 1.0, 0.0])
    far = rng.uniform(-1.0, 1.0, (50, 3)) + np.array([0.0, 0.0, 9.0])
    for freedom in (FREE, VERTICAL, LEVEL):
        assert not refine_robustly(far, level.copy(), 0.05, freedom)
    line = np.outer(rng.uniform(-1.0, 1.0, 50), [1.0, 0.0, 0.0])
    for width_m, is_plane in ((5e-5, False), (2e-4, True)):
        wide = line + np.outer(rng.choice([-1.0, 1.0], 50), [0.0, width_m, 0.0])
        assert refine_robustly(wide, level.copy(), 0.05, FREE) is is_plane


@pytest.mark.parametrize("seed", seeds(3))
def test_places_vote_for_the_planes_through_them(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape, bin_m, n_bins = (28, 48), 0.1, 30
    places = rng.uniform(-1.0, 1.0, (3, 200)).astype(np.float32) * np.float32([[1.6], [1.6], [1.3]])
    weights = rng.integers(1, 5, 200).astype(np.int32)
    omegas, phis = np.radians([10.0, 140.0]), np.radians([-80.0, -30.0, 0.0, 40.0, 90.0])
    angles = np.array([(omega, phi) for omega in omegas for phi in phis])
    starts = np.array([0, 5, 10])
    image = np.zeros(shape, dtype=np.int32)
    votes = np.zeros((10, n_bins), dtype=np.int32)
    vote_planes(places, weights, angles, starts, image, bin_m, votes)
    assert not image.any()
    for (omega, phi), found in zip(angles, votes, strict=True):
        upright = np.zeros(shape, dtype=np.int32)
        level = np.float32(math.cos(omega) / bin_m) * places[0]
        level += np.float32(math.sin(omega) / bin_m) * places[1]
        column = np.floor(level + np.float32(0.5 * shape[1])).astype(int)
        row = np.floor(places[2] * np.float32(1.0 / bin_m) + np.float32(0.5 * shape[0])).astype(int)
        np.add.at(upright, (row, column), weights)
        rows, columns = np.nonzero(upright)
        away = math.cos(phi) * (columns + 0.5 - 0.5 * shape[1])
        away += math.sin(phi) * (rows + 0.5 - 0.5 * shape[0])
        edges = np.arange(n_bins + 1) - 0.5 * n_bins
        counts = np.histogram(away, edges, weights=upright[rows, columns])[0]
        assert 0 < counts.sum() <= weights.sum()
        # Cells in the middle between two bins may be rounded to either.
        np.testing.assert_allclose(np.cumsum(found), np.cumsum(counts), atol=weights.max())


def test_places_vote_one_by_one_at_their_distance() -> None:
    rng = np.random.default_rng(0)
    places = rng.uniform(-1.0, 1.0, (3, 300)).astype(np.float32)
    weights = rng.integers(-3, 9, 300).astype(np.int32)
    normals = np.array([[0.0, 0.0, 1.0], [-0.2, 0.0, 1.0], [0.6, 0.8, 0.0], [-0.1, -0.15, 1.0]])
    low_m, bin_m, n_bins = -0.6, 0.1, 12
    votes = np.ones((4, n_bins), dtype=np.int32)
    vote_places(places, weights, normals, low_m, bin_m, votes)
    edges = low_m + bin_m * np.arange(n_bins + 1)
    for normal, found in zip(normals, votes, strict=True):
        expected = np.histogram(normal @ places, edges, weights=weights)[0]
        assert 0 < np.abs(expected).sum() < np.abs(weights).sum()
        np.testing.assert_array_equal(found - 1, expected)


def test_a_maximum_lies_at_the_top_of_a_parabola_through_its_neighbours() -> None:
    votes = np.zeros((2, 30), dtype=np.int32)
    votes[1, 14:17] = (40, 100, 70)
    row, place = sharpest(votes)
    assert row == 1
    # Windows of three bins around the middle contain 140, 210 and 170 votes, and those beside them
    # contain none.
    assert place == pytest.approx(15.5 + 0.5 * (140 - 170) / (140 - 420 + 170), abs=1e-9)


@pytest.mark.parametrize(("half", "is_plain"), [(0, False), (1, False), (3, False), (0, True)])
def test_the_best_bin_stands_out_most_from_the_emptier_window_beside_it(
    half: int, is_plain: bool
) -> None:
    rng = np.random.default_rng(half)
    n_rows, n_bins = 9, 25
    votes = rng.integers(0, 6, (n_rows, n_bins)).astype(np.int32)
    barred = (rng.random(votes.shape) < 0.3).astype(np.uint8)
    barred[4] = 1
    votes[5], barred[5] = 0, 0
    # The best window may be at either end.
    votes[6, 0] = votes[7, -1] = 99
    barred[6] = barred[7] = 0
    asked = np.array([0, 1, 2, 4, 5, 6, 7, 8])
    scores, places = np.full(n_rows, -7), np.full(n_rows, -7)
    best_bins(votes, asked, half, is_plain, barred, scores, places)
    assert (scores[3], places[3]) == (-7, -7)
    apart = 2 * half + 2
    for row in asked:
        wide = np.pad(votes[row].astype(np.int64), half + apart)
        windows = np.convolve(wide, np.ones(2 * half + 1, dtype=np.int64), "valid")
        beside = np.minimum(windows[:n_bins], windows[2 * apart :])
        worth = windows[apart : apart + n_bins] - (0 if is_plain else beside)
        line = np.where(barred[row] != 0, -1, worth)
        best = max(int(line.max()), -1)
        assert scores[row] == best
        assert places[row] == (int(line.argmax()) if best >= 0 else 0)


FIND_M, FIT_M = 0.3, 0.2


def crossing_rasters(rng: np.random.Generator, offsets_m: list[float]) -> list[SurfaceRaster]:
    """Return planes of random directions, with rectangles of 1.8 x 1.6 m on them."""
    rasters = []
    for normal, offset_m in zip(rng.normal(size=(len(offsets_m), 3)), offsets_m, strict=True):
        plane = Plane(normal=normal / np.linalg.norm(normal), offset_m=offset_m)
        low, axes = rng.uniform(-1.5, -0.5, 2), wall_axes(plane.normal, UP)
        rasters.append(SurfaceRaster(plane=plane, axes=axes, low_m=low, cell_m=0.2, shape=(8, 9)))
    return rasters


def nearest_holder(points_m: NDArray[np.float64], rasters: list[SurfaceRaster]) -> NDArray[np.int8]:
    """Return, for each point, the nearest plane whose slab and widened rectangle contain it."""
    distances = np.full((len(rasters), len(points_m)), np.inf)
    for k, raster in enumerate(rasters):
        away_m = np.abs(raster.plane.distances_m(points_m))
        placed = points_m @ raster.axes.T - raster.low_m
        far = raster.cell_m * np.array(raster.shape[::-1]) + FIND_M
        inside = ((placed >= -FIND_M) & (placed <= far)).all(axis=1)
        distances[k] = np.where(inside & (away_m <= FIND_M), away_m, np.inf)
    nearest = distances.argmin(axis=0).astype(np.int8)
    return np.where(np.isfinite(distances.min(axis=0)), nearest, np.int8(-1))


def crossed(seed: int) -> tuple[PreparedCloud, list[SurfaceRaster]]:
    """Return points about four planes that cross, on a fifth one, and a sixth plane elsewhere."""
    rng = np.random.default_rng(seed)
    rasters = crossing_rasters(rng, [*rng.uniform(-0.5, 0.5, 4), 9.0, 50.0])
    points_m = rng.uniform(-2.0, 2.0, (6_000, 3))
    # All points of a block are on the fifth plane, so they need not be tested one by one.
    points_m[:BLOCK_POINTS] *= 0.1
    points_m[:BLOCK_POINTS] += rasters[4].plane.offset_m * rasters[4].plane.normal
    cloud = prepared(points_m, parts=2)
    return replace(cloud, tolerance_m=FIND_M, fit_tolerance_m=FIT_M), rasters


# Slabs may measure positions along their axes from anywhere.
STARTS_M = (0.1, -0.2)


def slabs_of(rasters: list[SurfaceRaster]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return slabs (k, 12) and rectangles (k, 4)."""
    slabs = np.array([raster.slab() for raster in rasters])
    slabs[:, [7, 11]] = STARTS_M
    return slabs, np.array([raster.bounds_m() for raster in rasters]) - np.repeat(STARTS_M, 2)


@pytest.mark.parametrize("seed", seeds(4))
def test_planes_that_cross_share_the_points_by_distance(seed: int) -> None:
    cloud, rasters = crossed(seed)
    search, points_m = search_in(cloud), cloud.sample.offsets_m
    for k, raster in enumerate(rasters):
        support: Any = SimpleNamespace(bounds_m=raster.bounds_m())
        search.claim(raster, support)
        expected = nearest_holder(points_m, rasters[: k + 1])
        np.testing.assert_array_equal(search.is_free, expected < 0)
        assert search.n_points == np.count_nonzero(expected < 0)
        offsets_m, points = search.free()
        np.testing.assert_array_equal(offsets_m, points_m[expected < 0])
        np.testing.assert_array_equal(points.x, points_m[expected < 0, 0].astype(np.float32))
    # A pass for all planes gives the same result as one pass per plane.
    slabs, rectangles_m = slabs_of(rasters)
    cloud.assign(slabs, cloud.bounds_of(rectangles_m))
    np.testing.assert_array_equal(cloud.claims, expected)


@pytest.mark.parametrize("seed", seeds(4))
def test_planes_that_cross_are_measured_on_their_own_points(seed: int) -> None:
    cloud, rasters = crossed(seed)
    points_m, (slabs, rectangles_m) = cloud.sample.offsets_m, slabs_of(rasters)
    cloud.claims[:] = claims = nearest_holder(points_m, rasters)
    found = measure_planes(cloud, slabs, rectangles_m)
    # The points of a plane whose raster has no rows are not summed.
    rasters[1] = replace(rasters[1], shape=(0, 0))
    bounds_m = cloud.bounds_of(rectangles_m + np.repeat(STARTS_M, 2))
    tables = measure_cells(cloud, rasters, bounds_m=list(bounds_m[:, None]))
    for k, (raster, sums) in enumerate(zip(rasters, tables, strict=True)):
        own = points_m[claims == k]
        assert found.n_points[k] == found.histogram[k].sum() == len(own)
        if k in {1, 5}:
            continue
        away_m, placed = raster.plane.distances_m(own), own @ raster.axes.T
        # Points beside the raster are added to cells at its edge.
        cells = ((placed - raster.low_m) / raster.cell_m).astype(int)
        column, row = np.clip(cells, 0, np.array(raster.shape[::-1]) - 1).T
        steps = np.floor(away_m * STEPS_PER_TOLERANCE / FIT_M + 0.5)
        limits_m = (FIND_M, INNER_SHARE * FIND_M, FIT_M, FIT_M, FIT_M)
        values = (*[np.ones(len(own))] * 3, steps, steps**2)
        for table, limit_m, value in zip(sums, limits_m, values, strict=True):
            summed, held = np.zeros(raster.shape), np.abs(away_m) <= limit_m
            np.add.at(summed, (row[held], column[held]), value[held])
            np.testing.assert_array_equal(table, summed)
        fits = np.abs(away_m) <= FIT_M
        assert found.n_fit[k] == fits.sum() > 50
        assert found.rms_m[k] == pytest.approx(np.sqrt((away_m**2).mean()), rel=1e-4)
        assert found.rms_fit_m[k] == pytest.approx(np.sqrt((away_m[fits] ** 2).mean()), rel=1e-4)
        assert found.mean_fit_m[k] == pytest.approx(away_m[fits].mean(), abs=1e-5)
        placed -= STARTS_M
        low_m, high_m = rectangles_m[k].reshape(2, 2).T
        within = placed[fits & ((placed >= low_m) & (placed <= high_m)).all(axis=1)]
        extent_m = np.column_stack([within.min(axis=0), within.max(axis=0)])
        np.testing.assert_allclose(found.extents_m[k], extent_m.ravel(), atol=1e-6)
    # Without points near it, a plane extends as far as its rectangle.
    assert (found.n_points[5], found.rms_m[5], found.mean_fit_m[5]) == (0, 0.0, 0.0)
    np.testing.assert_array_equal(found.extents_m[5], rectangles_m[5])


# --- the sample, and the extent of the scene ---


def test_one_point_of_each_of_200000_stretches_is_drawn_at_places_of_the_golden_ratio() -> None:
    stretch = 3.5
    points = np.random.default_rng(0).uniform(0.0, 1.0, (700_000, 3))
    sample = draw_sample(cloud_of(points))
    assert sample.n_represented == stretch
    ordinal = np.arange(200_000)
    golden = np.modf(ordinal * (np.sqrt(5.0) - 1.0) / 2.0)[0]
    np.testing.assert_array_less(np.abs(sample.index / stretch - ordinal - golden), 1.0 / stretch)
    np.testing.assert_array_equal(sample.offsets_m, points[sample.index].astype(np.float32))


def test_a_point_that_is_no_place_is_refused_though_the_sample_misses_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(clouds, "SAMPLE_POINTS", 10)
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (100, 3))
    missed = np.setdiff1d(np.arange(100), draw_sample(cloud_of(points)).index)[0]
    prepared(points)
    for value in (np.nan, -np.inf):
        points[missed, 1] = value
        with pytest.raises(ProductError):
            prepared(points)
