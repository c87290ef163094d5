"""Samples, plans and compiled passes against plain formulations of the same, on random input."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane import cloud as clouds
from orthoflow_plugins.plane.cloud import draw_sample, plan_grid
from orthoflow_plugins.plane.kernels import (
    BLOCK_POINTS,
    FREE,
    LEVEL,
    STEPS_PER_TOLERANCE,
    VERTICAL,
    BlockedPoints,
    PlanGrid,
    assign_points,
    consensus_sums,
    count_points,
    flattest,
    refine_robustly,
    sum_assigned,
)
from orthoflow_plugins.plane.search import Claim
from orthoflow_plugins.plane.support import SurfaceRaster
from orthoflow_plugins.plane.votes import (
    VOTE_SHARES,
    best_bins,
    sharpest,
    vote_image,
    vote_places,
    vote_planes,
)

from orthoflow.errors import ProductError
from orthoflow.geometry import Plane, wall_axes
from orthoflow.geometry.slabs import Offsets, read_only
from tests import scenes
from tests.long_loops import seeds
from tests.plane_scenes import cloud_of, prepared, search_in

UP: Final = np.array([0.0, 0.0, 1.0])
# Three blocks and a piece of one.
N_POINTS: Final = 3 * BLOCK_POINTS + 61


def offsets_of(points_m: NDArray[np.float64]) -> Offsets:
    return read_only(*np.ascontiguousarray(points_m.T.astype(np.float32)))


def points_of(points_m: NDArray[np.float64]) -> BlockedPoints:
    return count_points(offsets_of(points_m), None, parts=1)[0]


def exact(points: BlockedPoints) -> NDArray[np.float64]:
    """(n, 3) what the passes see."""
    return np.column_stack([points.x, points.y, points.z]).astype(np.float64)


def runs_of(rng: np.random.Generator, values: NDArray[np.float64], n: int) -> NDArray[np.float64]:
    """(n, ...) values, each a few times in turn, as a scan's neighbours."""
    return np.repeat(values, rng.integers(1, 5, len(values)), axis=0)[:n]


def slab_rows(rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    """(count, 12) slabs through a box at random."""
    rows = []
    for _ in range(count):
        normal = rng.normal(size=3)
        normal /= np.linalg.norm(normal)
        u, v = wall_axes(normal, UP)
        low = rng.uniform(-0.2, 0.2, 3)
        rows.append([*normal, low[0], *u, low[1], *v, low[2]])
    return np.array(rows)


def along(slab: NDArray[np.float64], points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 3) places along the slab's normal, u and v."""
    rows = slab.reshape(3, 4)
    return points_m @ rows[:, :3].T - rows[:, 3]


# --- blocks and the plan ---


@pytest.mark.parametrize("parts", [1, 3])
@pytest.mark.parametrize("seed", seeds(3))
def test_points_are_counted_in_their_cell_and_storey(seed: int, parts: int) -> None:
    rng = np.random.default_rng(seed)
    shape = (5, 7, 4)
    basis = scenes.random_rotation(rng)
    grid = PlanGrid(basis=basis, low_m=rng.uniform(-9.0, 9.0, 3), cell_m=0.5, shape=shape)
    # Away from the sides of cells, which float32 does not know to the last bit; some lie outside.
    cells = runs_of(rng, rng.integers(-1, np.array(shape) + 1, (N_POINTS, 3)), N_POINTS)
    places = cells + rng.uniform(0.05, 0.95, cells.shape)
    offsets = offsets_of((grid.low_m + grid.cell_m * places) @ basis)
    points, plan, found_heights, is_finite = count_points(offsets, grid, parts=parts)
    inside = (cells >= 0) & (cells < np.array(shape))
    over = inside[:, :2].all(axis=1)
    expected = np.zeros(shape[:2], dtype=np.int64)
    np.add.at(expected, tuple(cells[over, :2].T), 1)
    np.testing.assert_array_equal(plan, expected)
    heights = np.bincount(cells[over & inside[:, 2], 2], minlength=shape[2])
    np.testing.assert_array_equal(found_heights, heights)
    assert is_finite
    for block, box in enumerate(points.boxes):
        held = slice(block * BLOCK_POINTS, (block + 1) * BLOCK_POINTS)
        sides = [side(values[held]) for values in offsets for side in (np.min, np.max)]
        np.testing.assert_array_equal(box, sides)


# --- one slab, and many ---


def summed_cells(
    placed: NDArray[np.float64], cells: NDArray[np.int64], n_cells: int, limits_m: list[float]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Counts within three tolerances, and sums of steps and their squares, per cell."""
    find_m, inner_m, fit_m = limits_m
    sizes = np.abs(placed[:, 0])
    steps = np.floor(placed[:, 0] * (STEPS_PER_TOLERANCE / fit_m) + 0.5).astype(np.int64)
    counts, sums = np.zeros((n_cells, 3), dtype=np.int64), np.zeros((n_cells, 2), dtype=np.int64)
    for column, limit_m in enumerate((find_m, inner_m, fit_m)):
        held = (cells >= 0) & (sizes <= limit_m) & (sizes <= find_m)
        np.add.at(counts[:, column], cells[held], 1)
    held = (cells >= 0) & (sizes <= fit_m) & (sizes <= find_m)
    np.add.at(sums[:, 0], cells[held], steps[held])
    np.add.at(sums[:, 1], cells[held], steps[held] ** 2)
    return counts, sums


@pytest.mark.parametrize("seed", seeds(3))
def test_all_planes_at_once_sum_the_points_that_they_own(seed: int) -> None:
    rng = np.random.default_rng(seed)
    slabs = slab_rows(rng, 4)
    points_m = runs_of(rng, rng.uniform(-1.0, 1.0, (N_POINTS, 3)), N_POINTS)
    # A block on one plane alone, of which no point has to be asked.
    slabs[3, 3] = 9.0
    points_m[:BLOCK_POINTS] = 0.1 * points_m[:BLOCK_POINTS] + 9.0 * slabs[3, :3]
    points = points_of(points_m)
    find_m, inner_m, fit_m = 0.3, 0.12, 0.2
    bounds = np.column_stack([np.full(4, find_m), np.tile([-0.9, 0.8, -0.7, 0.9], (4, 1))])
    claims = np.empty(len(points.x), dtype=np.int8)
    assign_points(points, claims, slabs, bounds)
    placed = np.array([along(slab, exact(points)) for slab in slabs])
    u, v = placed[..., 1], placed[..., 2]
    held = (np.abs(placed[..., 0]) <= find_m) & (np.abs(u + 0.05) <= 0.85)
    held &= np.abs(v - 0.1) <= 0.8
    away = np.where(held, np.abs(placed[..., 0]), np.inf)
    owner = np.where(held.any(axis=0), away.argmin(axis=0), -1)
    np.testing.assert_array_equal(claims, owner)
    assert (np.bincount(owner + 1, minlength=5) > 9).all()
    # Slab 1 has no rows: its points are not summed. What lies beyond the raster goes to its edge.
    shapes = [(5, 6), (0, 0), (7, 3), (4, 4)]
    starts = np.cumsum([0, *(rows * columns for rows, columns in shapes)])
    per_m = 1.0 / 0.2
    rasters = np.array(
        [
            [-0.5, -0.4, per_m, *shape, start, fit_m, inner_m]
            for shape, start in zip(shapes, starts, strict=False)
        ]
    )
    counts = np.zeros((int(starts[-1]), 3), dtype=np.int32)
    sums = np.zeros((int(starts[-1]), 2), dtype=np.int64)
    sum_assigned(points, slabs, bounds, rasters, np.ones(4, dtype=bool), counts, sums)
    for k, (rows, columns) in enumerate(shapes):
        if rows == 0:
            continue
        mine = placed[k][owner == k]
        column = np.clip(np.floor((mine[:, 1] + 0.5) * per_m), 0, columns - 1).astype(int)
        row = np.clip(np.floor((mine[:, 2] + 0.4) * per_m), 0, rows - 1).astype(int)
        cells = row * columns + column
        expected = summed_cells(mine, cells, rows * columns, [find_m, inner_m, fit_m])
        table = slice(starts[k], starts[k + 1])
        np.testing.assert_array_equal(counts[table], expected[0])
        np.testing.assert_array_equal(sums[table], expected[1])


# --- hypotheses ---


@pytest.mark.parametrize("seed", seeds(3))
def test_consensus_counts_points_near_planes_and_weighs_them_by_distance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.0, 1.0, (3, N_POINTS)).astype(np.float32)
    planes = np.column_stack([rng.normal(size=(5, 3)), rng.uniform(-0.3, 0.3, 5)])
    planes = (planes / np.linalg.norm(planes[:, :3], axis=1)[:, None]).astype(np.float32)
    n_bins, reach_m = 64, 0.25
    per_m = np.float32(n_bins / reach_m)
    a, b, c, d = (planes * per_m).T[:, :, None]
    bins = np.abs(a * points[0] + b * points[1] + c * points[2] - d)
    near = bins < n_bins
    sums = np.ones((5, 2), dtype=np.int64)
    consensus_sums(points, planes, reach_m, n_bins, sums)
    middles = 2 * np.floor(bins).astype(np.int64) + 1
    worth = np.where(near, 4 * n_bins**2 - middles**2, 0).sum(axis=1)
    np.testing.assert_array_equal(sums - 1, np.column_stack([near.sum(axis=1), worth]))


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
    # Moments without a flattest plane have the level one.
    flattest(moments(np.full((4, 3), 2.0), np.ones(4)), plane)
    np.testing.assert_array_equal(plane, [0, 0, 1, 2, 2, 2, 0, 0, 0])
    line = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    flattest(moments(line, np.ones(2)), plane)
    np.testing.assert_allclose(plane, [0, 0, 1, 0, 0, 0, 0, 0, 1], atol=1e-8)


def reweighted(
    points: NDArray[np.float64], plane: NDArray[np.float64], tolerance_m: float, freedom: int
) -> NDArray[np.float64]:
    """(4,) total least squares with Tukey's weights, settled, by the library's eigenvectors."""
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
    # Whichever side the start's normal is on, it stays.
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


def voted(
    image: NDArray[np.int32], along_rows: float, along_columns: float, n_bins: int
) -> NDArray[np.int64]:
    """(bins,) votes of an image's cells for the lines across a direction, cell by cell.

    Cells move along the axis that is nearer to the lines until they lie on the other one through
    the middle; from there they cover a piece of the direction, in quarters of bins.
    """
    votes = np.zeros(n_bins, dtype=np.int64)
    if abs(along_columns) < abs(along_rows):
        image, along_rows, along_columns = image.T, along_columns, along_rows
    n_rows, n_columns = image.shape
    for row, column in np.argwhere(image):
        height = row + 0.5 - 0.5 * n_rows
        shift = math.floor(height * (along_rows / along_columns) + 0.5)
        landed = column + shift - 0.5 * n_columns
        edges = sorted([along_columns * landed, along_columns * (landed + 1.0)])
        low = edges[0] + 0.5 * n_bins
        first = math.floor(low)
        share = math.floor(VOTE_SHARES * (first + 1 - low) / abs(along_columns) + 0.5)
        share = min(VOTE_SHARES, share)
        for place, quarters in ((first, share), (first + 1, VOTE_SHARES - share)):
            if 0 <= place < n_bins:
                votes[place] += quarters * image[row, column]
    return votes


def random_image(rng: np.random.Generator, shape: tuple[int, int]) -> NDArray[np.int32]:
    image = rng.integers(-3, 9, shape) * (rng.random(shape) < 0.2)
    # Rows and columns at the sides that are empty, whole tiles among them.
    image[:2] = image[:, -18:] = 0
    return image.astype(np.int32)


@pytest.mark.parametrize("shape", [(9, 37), (41, 20), (24, 24)])
@pytest.mark.parametrize("n_bins", [14, 60])
def test_cells_of_an_image_vote_for_the_lines_through_them(
    shape: tuple[int, int], n_bins: int
) -> None:
    image = random_image(np.random.default_rng(0), shape)
    angles = np.radians(np.arange(0.0, 180.0, 7.2))
    votes = np.ones((len(angles), n_bins), dtype=np.int32)
    vote_image(image, angles, votes)
    expected = [voted(image, math.cos(angle), math.sin(angle), n_bins) for angle in angles]
    np.testing.assert_array_equal(votes - 1, expected)


@pytest.mark.parametrize("seed", seeds(3))
def test_places_vote_for_the_planes_through_them(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape, bin_m, n_bins = (22, 35), 0.1, 30
    places = rng.uniform(-1.0, 1.0, (3, 200)).astype(np.float32) * np.float32([[1.6], [1.6], [1.3]])
    weights = rng.integers(1, 5, 200).astype(np.int32)
    # The middle omega has no direction.
    omegas, phis = np.radians([10.0, 60.0, 140.0]), np.radians([-80.0, -30.0, 0.0, 40.0, 90.0])
    angles = np.array([(omega, phi) for omega in omegas[[0, 2]] for phi in phis])
    starts = np.array([0, 5, 5, 10])
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
        held = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
        assert 0 < np.count_nonzero(held) < 200
        np.add.at(upright, (row[held], column[held]), weights[held])
        np.testing.assert_array_equal(found, voted(upright, math.sin(phi), math.cos(phi), n_bins))


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
    # Windows of three bins hold 140, 210, 170 about the middle, and nothing beside them.
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
    # The best window may lie at either side.
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


FIND_M = 0.3


def crossing_rasters(rng: np.random.Generator, count: int) -> list[SurfaceRaster]:
    """Planes through the box at random, with rectangles that do not cover it."""
    rasters = []
    for normal in rng.normal(size=(count, 3)):
        plane = Plane(normal=normal / np.linalg.norm(normal), offset_m=rng.uniform(-0.5, 0.5))
        low, axes = rng.uniform(-1.5, -0.5, 2), wall_axes(plane.normal, UP)
        rasters.append(SurfaceRaster(plane=plane, axes=axes, low_m=low, cell_m=0.2, shape=(8, 9)))
    return rasters


def nearest_holder(points_m: NDArray[np.float64], rasters: list[SurfaceRaster]) -> NDArray[np.int8]:
    """(n,) the nearest plane in whose slab and rectangle a point lies, point by point."""
    distances = np.full((len(rasters), len(points_m)), np.inf)
    for k, raster in enumerate(rasters):
        away_m = np.abs(raster.plane.distances_m(points_m))
        placed = (points_m @ raster.axes.T - raster.low_m) / raster.cell_m
        inside = ((placed >= 0.0) & (placed <= np.array(raster.shape[::-1]))).all(axis=1)
        distances[k] = np.where(inside & (away_m <= FIND_M), away_m, np.inf)
    nearest = distances.argmin(axis=0).astype(np.int8)
    return np.where(np.isfinite(distances.min(axis=0)), nearest, np.int8(-1))


@pytest.mark.parametrize("seed", seeds(4))
def test_planes_that_cross_share_the_sample_by_distance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rasters = crossing_rasters(rng, 5)
    search = search_in(prepared(rng.uniform(-2.0, 2.0, (6_000, 3)), parts=2))
    points_m = search.cloud.sample.offsets_m
    claims = [Claim(raster.slab(), np.append(FIND_M, raster.bounds_m())) for raster in rasters]
    for k, claim in enumerate(claims):
        search.claim(claim)
        expected = nearest_holder(points_m, rasters[: k + 1])
        np.testing.assert_array_equal(search.claims, expected)
        assert search.n_points == np.count_nonzero(expected < 0)
        offsets_m, points = search.free()
        np.testing.assert_array_equal(offsets_m, points_m[expected < 0])
        np.testing.assert_array_equal(points.x, points_m[expected < 0, 0].astype(np.float32))
    # One pass for all planes assigns as one plane after the other.
    search.cloud.assign(
        np.array([claim.slab for claim in claims]), np.array([claim.bounds_m for claim in claims])
    )
    np.testing.assert_array_equal(search.cloud.claims, expected)


# --- which points stand for all, and where the scene ends ---


def test_one_point_of_each_of_200000_stretches_is_drawn_at_places_of_the_golden_ratio() -> None:
    stretch = 3.5
    points = np.random.default_rng(0).uniform(0.0, 1.0, (700_000, 3))
    sample = draw_sample(cloud_of(points))
    assert sample.n_represented == stretch
    ordinal = np.arange(200_000)
    golden = np.modf(ordinal * (np.sqrt(5.0) - 1.0) / 2.0)[0]
    np.testing.assert_array_less(np.abs(sample.index / stretch - ordinal - golden), 1.0 / stretch)
    np.testing.assert_array_equal(sample.offsets_m, points[sample.index].astype(np.float32))


def boxed_scene(
    low: tuple[float, float, float], high: tuple[float, float, float]
) -> NDArray[np.float64]:
    """Points in a box, its corners among them."""
    points = np.random.default_rng(2).uniform(low, high, (4_000, 3))
    points[0], points[1] = low, high
    return points


def grid_of(points: NDArray[np.float64], cell_m: float = 0.1) -> PlanGrid:
    sample = draw_sample(cloud_of(points))
    return plan_grid(sample, np.eye(3), cell_m=cell_m, outside_share=0.0)


def test_a_plan_has_five_cells_and_a_fiftieth_about_the_scene() -> None:
    grid = grid_of(boxed_scene((-2.0, 1.0, 0.0), (4.0, 4.0, 2.0)))
    np.testing.assert_allclose(grid.low_m, [-2.62, 0.44, -0.54], atol=1e-6)
    # 7.24 x 4.12 x 3.08 m.
    assert (grid.cell_m, grid.shape) == (0.1, (73, 42, 31))
    # What is farther off than the scene is long does not widen it: nine tenths are within 9 m.
    points = boxed_scene((0.0, 0.0, 0.0), (10.0, 4.0, 2.0))
    for beyond_m, length_m in ((8.0, 26.0), (10.5, 10.0)):
        points[2:4] = [[10.0 + beyond_m, 2.0, 1.0], [-beyond_m, 2.0, 1.0]]
        low_m = -8.0 if length_m == 26.0 else 0.0
        grid = grid_of(points)
        assert grid.low_m[0] == pytest.approx(low_m - 0.5 - 0.02 * length_m, abs=1e-6)
        assert grid.shape[0] == pytest.approx(10.4 * length_m + 10, abs=1.5)


@pytest.mark.parametrize(
    ("high", "wanted_m", "cell_m"),
    [
        # Eight million cells of the plan, and as many storeys, at most.
        ((10_000.0, 8_000.0, 2.0), 0.1, math.sqrt((10_400.0 + 1.0) * (8_320.0 + 1.0) / 8e6)),
        ((1e6, 1.0, 2.0), 0.01, math.sqrt(1.04e6 * (1.04 + 0.1) / 8e6)),
    ],
    ids=["wide", "long"],
)
def test_cells_grow_where_a_plan_would_have_too_many(
    high: tuple[float, float, float], wanted_m: float, cell_m: float
) -> None:
    grid = grid_of(boxed_scene((0.0, 0.0, 0.0), high), wanted_m)
    assert grid.cell_m == pytest.approx(cell_m, rel=1e-6)


@pytest.mark.parametrize("plan_cell_m", [None, 0.1])
def test_a_point_that_is_no_place_is_refused_though_the_sample_misses_it(
    plan_cell_m: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clouds, "SAMPLE_POINTS", 10)
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (100, 3))
    missed = np.setdiff1d(np.arange(100), draw_sample(cloud_of(points)).index)[0]
    prepared(points, plan_cell_m=plan_cell_m)
    points[missed, 1] = np.nan
    with pytest.raises(ProductError):
        prepared(points, plan_cell_m=plan_cell_m)
