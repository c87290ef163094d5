"""Compiled passes over points against plain formulations of the same, on random input."""

from __future__ import annotations

from typing import Final

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.kernels import (
    BLOCK_POINTS,
    FREE,
    LEVEL,
    VERTICAL,
    BlockedPoints,
    PlanGrid,
    blocked,
    box_blocks,
    consensus_sums,
    count_over_plan,
    distance_histograms,
    flattest,
    refine_robustly,
)
from orthoflow_plugins.plane.slab_kernels import (
    HISTOGRAM_BINS,
    STEPS_PER_TOLERANCE,
    assign_points,
    measure_deviations,
    name_labels,
    sum_assigned,
    sum_cells,
)
from orthoflow_plugins.plane.support import closed, summed_around
from scipy import ndimage

from orthoflow.geometry import wall_axes
from orthoflow.geometry.point_kernels import Offsets, read_only
from tests import scenes

UP: Final = np.array([0.0, 0.0, 1.0])
# Three blocks and a piece of one.
N_POINTS: Final = 3 * BLOCK_POINTS + 61
SEEDS: Final = range(3)


def offsets_of(points_m: NDArray[np.float64]) -> Offsets:
    return read_only(*np.ascontiguousarray(points_m.T.astype(np.float32)))


def points_of(points_m: NDArray[np.float64]) -> BlockedPoints:
    offsets = offsets_of(points_m)
    return blocked(offsets, box_blocks(offsets, parts=1).boxes)


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
@pytest.mark.parametrize("seed", SEEDS)
def test_points_are_counted_in_their_cell_and_storey(seed: int, parts: int) -> None:
    rng = np.random.default_rng(seed)
    shape = (5, 7, 4)
    basis = scenes.random_rotation(rng)
    grid = PlanGrid(basis=basis, low_m=rng.uniform(-9.0, 9.0, 3), cell_m=0.5, shape=shape)
    # Away from the sides of cells, which float32 does not know to the last bit; some lie outside.
    cells = runs_of(rng, rng.integers(-1, np.array(shape) + 1, (N_POINTS, 3)), N_POINTS)
    places = cells + rng.uniform(0.05, 0.95, cells.shape)
    offsets = offsets_of((grid.low_m + grid.cell_m * places) @ basis)
    counted = count_over_plan(offsets, grid, parts=parts)
    inside = (cells >= 0) & (cells < np.array(shape))
    over = inside[:, :2].all(axis=1)
    expected = np.zeros(shape[:2], dtype=np.int64)
    np.add.at(expected, tuple(cells[over, :2].T), 1)
    np.testing.assert_array_equal(counted.cells, expected)
    heights = np.bincount(cells[over & inside[:, 2], 2], minlength=shape[2])
    np.testing.assert_array_equal(counted.heights, heights)
    for boxed in (counted.boxed, box_blocks(offsets, parts=parts)):
        assert boxed.n_unusable == 0
        for block, box in enumerate(boxed.boxes):
            held = slice(block * BLOCK_POINTS, (block + 1) * BLOCK_POINTS)
            sides = [side(values[held]) for values in offsets for side in (np.min, np.max)]
            np.testing.assert_array_equal(box, sides)


@pytest.mark.parametrize(
    ("values", "n_unusable"),
    [
        ((np.nan,), 1),
        ((-np.nan,), 1),
        ((np.inf,), 1),
        ((-np.inf,), 1),
        ((np.inf, -np.inf), 2),
        ((np.finfo(np.float32).max, np.finfo(np.float32).min), 0),
    ],
)
def test_sides_of_boxes_that_are_no_numbers_are_counted(
    values: tuple[float, ...], n_unusable: int
) -> None:
    points_m = np.random.default_rng(0).normal(size=(N_POINTS, 3))
    points_m[300 : 300 + len(values), 1] = values
    assert box_blocks(offsets_of(points_m), parts=2).n_unusable == n_unusable
    grid = PlanGrid(basis=np.eye(3), low_m=np.zeros(3), cell_m=1.0, shape=(2, 2, 2))
    assert count_over_plan(offsets_of(points_m), grid, parts=2).boxed.n_unusable == n_unusable


# --- neighbours in rasters ---


@pytest.mark.parametrize("shape", [(1, 1), (6, 9), (5, 4, 6)])
def test_sums_of_neighbours_are_a_convolution_with_ones(shape: tuple[int, ...]) -> None:
    values = np.random.default_rng(0).integers(-9, 9, shape)
    expected = ndimage.convolve(values, np.ones((3,) * len(shape), dtype=int), mode="constant")
    np.testing.assert_array_equal(summed_around(values), expected)


@pytest.mark.parametrize("reach", [1, 2])
def test_gaps_are_closed_as_by_dilation_and_erosion(reach: int) -> None:
    cells = np.random.default_rng(0).random((30, 40)) < 0.06
    window = np.ones((2 * reach + 1,) * 2, dtype=bool)
    wide = np.pad(cells, 2 * reach)
    expected = ndimage.binary_closing(wide, window)[2 * reach : -2 * reach, 2 * reach : -2 * reach]
    np.testing.assert_array_equal(closed(cells, reach), expected)


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


@pytest.mark.parametrize("seed", SEEDS)
def test_cells_of_one_slab_sum_the_points_over_them(seed: int) -> None:
    rng = np.random.default_rng(seed)
    (slab,) = slab_rows(rng, 1)
    # Blocks of which some miss the slab.
    points_m = rng.uniform(-1.0, 1.0, (N_POINTS, 3)) * 0.6
    points_m[:BLOCK_POINTS] += 3.0 * slab[:3]
    points = points_of(points_m)
    cell_m, limits_m = 0.11, [0.3, 0.12, 0.2]
    counts, sums = np.zeros((4, 6, 3), dtype=np.int32), np.zeros((4, 6, 2), dtype=np.int64)
    sum_cells(points, slab, np.array([cell_m, *limits_m]), counts, sums)
    placed = along(slab, exact(points))
    column, row = np.floor(placed[:, 1:] / cell_m).astype(np.int64).T
    inside = (column >= 0) & (column < 6) & (row >= 0) & (row < 4)
    cells = np.where(inside, row * 6 + column, -1)
    expected_counts, expected_sums = summed_cells(placed, cells, 24, limits_m)
    assert expected_counts[:, 0].sum() > 30
    np.testing.assert_array_equal(counts.reshape(24, 3), expected_counts)
    np.testing.assert_array_equal(sums.reshape(24, 2), expected_sums)


@pytest.mark.parametrize("seed", SEEDS)
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
    sum_assigned(points, slabs, bounds, rasters, counts, sums, (1, 0))
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
        # Distances are known to a fifth of a step in float32, and rounded to one.
        n_fit = expected[0][:, 2]
        assert (np.abs(sums[table, 0] - expected[1][:, 0]) <= n_fit).all()
        apart = np.abs(sums[table, 1] - expected[1][:, 1])
        assert (apart <= 2 * STEPS_PER_TOLERANCE * n_fit).all()


def test_distances_of_whole_steps_are_summed_without_rounding() -> None:
    rng = np.random.default_rng(0)
    # Halves and quarters of a metre, and of tolerances that are such: exact in float32.
    fit_m, inner_m, find_m = 0.5, 0.25, 1.0
    cells = np.repeat(rng.integers(0, 6, N_POINTS), rng.integers(1, 5, N_POINTS))[:N_POINTS]
    heights_m = rng.choice([-0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75], N_POINTS)
    points = points_of(np.column_stack([cells % 3 + 0.5, cells // 3 + 0.5, heights_m]))
    slabs = np.array([[0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0]])
    bounds = np.array([[find_m, 0.0, 3.0, 0.0, 2.0]])
    rasters = np.array([[0.0, 0.0, 1.0, 2, 3, 0, fit_m, inner_m]])
    counts, sums = np.zeros((6, 3), dtype=np.int32), np.zeros((6, 2), dtype=np.int64)
    sum_assigned(points, slabs, bounds, rasters, counts, sums, (1, 0))
    for cell in range(6):
        mine = heights_m[cells == cell]
        within = [mine[np.abs(mine) <= tolerance] for tolerance in (find_m, inner_m, fit_m)]
        np.testing.assert_array_equal(counts[cell], [len(some) for some in within])
        steps = (within[2] / fit_m * STEPS_PER_TOLERANCE).astype(int)
        np.testing.assert_array_equal(sums[cell], [steps.sum(), (steps**2).sum()])


def test_one_of_so_many_blocks_is_summed_wherever_a_part_begins() -> None:
    rng = np.random.default_rng(0)
    n_blocks = 300
    points_m = rng.uniform(-0.1, 0.1, (n_blocks * BLOCK_POINTS, 3))
    points = points_of(points_m)
    slabs = np.array([[0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0]])
    bounds = np.array([[0.2, -1.0, 1.0, -1.0, 1.0]])
    rasters = np.array([[-1.0, -1.0, 0.5, 1, 1, 0, 0.1, 0.05]])

    def n_summed(first: int, last: int, every: int) -> int:
        some = slice(first * BLOCK_POINTS, last * BLOCK_POINTS)
        counts, sums = np.zeros((1, 3), dtype=np.int32), np.zeros((1, 2), dtype=np.int64)
        part = BlockedPoints(*(values[some] for values in points[:3]), points.boxes[first:last])
        sum_assigned(part, slabs, bounds, rasters, counts, sums, (every, first))
        return int(counts[0, 0]) // BLOCK_POINTS

    assert n_summed(0, n_blocks, 1) == n_blocks
    for every in (2, 3, 7):
        drawn = [n_summed(block, block + 1, every) for block in range(n_blocks)]
        assert n_summed(0, n_blocks, every) == sum(drawn)
        assert n_summed(0, 123, every) + n_summed(123, n_blocks, every) == sum(drawn)
        # Four standard deviations of a fair draw.
        share = 1.0 / every
        slack = 4.0 * np.sqrt(n_blocks * share * (1.0 - share))
        assert abs(sum(drawn) - n_blocks * share) < slack
        # No fixed step: the distances between drawn blocks differ.
        assert len(set(np.diff(np.flatnonzero(drawn)))) > 2


def test_labels_are_the_names_of_claims() -> None:
    rng = np.random.default_rng(0)
    claims = rng.integers(0, 256, N_POINTS).astype(np.uint8)
    claims[:BLOCK_POINTS] = 7
    claims[BLOCK_POINTS : 2 * BLOCK_POINTS] = 0
    claims[2 * BLOCK_POINTS - 1] = 1
    names = rng.permutation(256).astype(np.int16)
    labels = np.full(N_POINTS, -9, dtype=np.int16)
    name_labels(claims, names, labels)
    np.testing.assert_array_equal(labels, names[claims])


@pytest.mark.parametrize("seed", SEEDS)
def test_deviations_are_those_of_claimed_points(seed: int) -> None:
    rng = np.random.default_rng(seed)
    slabs = slab_rows(rng, 3)
    points = points_of(rng.uniform(-1.0, 1.0, (N_POINTS, 3)))
    find_m, fit_m = 0.3, 0.2
    placed = np.array([along(slab, exact(points)) for slab in slabs])
    claims = rng.integers(-1, 3, N_POINTS).astype(np.int8)
    away = np.abs(placed[claims, np.arange(N_POINTS), 0])
    # Whatever is claimed is within the tolerance.
    claims[away > find_m] = -1
    claims[:BLOCK_POINTS] = -1
    box = [-0.6, 0.7, -0.5, 0.8]
    limits = np.tile([find_m, fit_m, *box], (3, 1))
    sums = np.zeros((3, 6), dtype=np.int64)
    histogram = np.zeros((3, HISTOGRAM_BINS), dtype=np.int64)
    extents = np.tile([np.inf, -np.inf, np.inf, -np.inf], (3, 1))
    measure_deviations(points, claims, slabs, limits, sums, histogram, extents)
    for k in range(3):
        distance, u, v = placed[k][claims == k].T
        fits = np.abs(distance) <= fit_m
        assert 20 < fits.sum() < len(fits)
        steps = np.round(distance * STEPS_PER_TOLERANCE / fit_m)
        expected = [
            (len(chosen), chosen.sum(), (chosen**2).sum()) for chosen in (steps, steps[fits])
        ]
        for found, (n, total, squares) in zip(sums[k].reshape(2, 3), expected, strict=True):
            assert found[0] == n
            # A step more or less for each point: float32 knows distances to a fifth of one.
            assert abs(found[1] - total) <= n
            assert abs(found[2] - squares) <= 2 * n * np.abs(steps).max() + n
        bins = np.histogram(distance, HISTOGRAM_BINS, (-find_m, find_m))[0]
        # A point at the side of a bin may fall to either.
        assert np.abs(np.cumsum(histogram[k]) - np.cumsum(bins)).max() <= 1
        assert histogram[k].sum() == len(distance)
        within = fits & (u >= box[0]) & (u <= box[1]) & (v >= box[2]) & (v <= box[3])
        sides = [u[within].min(), u[within].max(), v[within].min(), v[within].max()]
        np.testing.assert_allclose(extents[k], sides, atol=1e-12)


# --- hypotheses ---


@pytest.mark.parametrize("seed", SEEDS)
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
    histograms = np.ones((5, n_bins), dtype=np.int32)
    distance_histograms(points, planes, reach_m, histograms)
    for found, row, held in zip(histograms, bins, near, strict=True):
        expected = np.bincount(row[held].astype(int), minlength=n_bins)
        np.testing.assert_array_equal(found - 1, expected)


# --- fits ---


def moments(points: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y, z = points.T
    terms = [np.ones(len(x)), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z]
    return np.array([float((weights * term).sum()) for term in terms])


@pytest.mark.parametrize("seed", range(30))
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


def test_moments_without_a_flattest_plane_have_the_level_one() -> None:
    plane = np.empty(9)
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
@pytest.mark.parametrize("seed", range(4))
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
        assert refine_robustly(points, found, tolerance_m, freedom, UP)
        expected = reweighted(points, plane, tolerance_m, freedom)
        np.testing.assert_allclose(found, expected, atol=1e-8)


def test_neither_nothing_nor_a_line_supports_a_plane() -> None:
    rng = np.random.default_rng(0)
    level = np.array([0.0, 0.0, 1.0, 0.0])
    far = rng.uniform(-1.0, 1.0, (50, 3)) + np.array([0.0, 0.0, 9.0])
    for freedom in (FREE, VERTICAL, LEVEL):
        assert not refine_robustly(far, level.copy(), 0.05, freedom, UP)
    line = np.outer(rng.uniform(-1.0, 1.0, 50), [1.0, 0.0, 0.0])
    for width_m, is_plane in ((5e-5, False), (2e-4, True)):
        wide = line + np.outer(rng.choice([-1.0, 1.0], 50), [0.0, width_m, 0.0])
        assert refine_robustly(wide, level.copy(), 0.05, FREE, UP) is is_plane
