"""Fits surfaces, with covariances, to the means of all points of a cloud in small cells."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from orthoflow.geometry.rows import Rows
from orthoflow.geometry.slabs import Offsets, read_only
from orthoflow.geometry.surfaces import zero_direction
from orthoflow.geometry.threads import even_parts, in_threads
from orthoflow.products import PointCloud, Surface
from orthoflow_plugins.surface.kernels import Cells, sum_cells
from orthoflow_plugins.surface.rounds import design, robust_solution
from orthoflow_plugins.surface.search import Found, longest_gap

# Minimum size and maximum number of the cells of a surface.
_CELL_M: Final = 0.03
_CELL_RAD: Final = 0.05
_MOST_CELLS: Final = 30_000
_LEAST_CELLS: Final = 8
# Number of parts of the sums; it is fixed, so that the sums do not depend on the number of threads.
_PARTS: Final = 4
# Maximum distance, in standard deviations, of the points that are summed.
_SUM_SIGMAS: Final = 5.0
_LEAST_SUM_M: Final = 0.012
# Cells are merged until they contain this many points on average; cells and tiles become no larger
# than this share of a circle, because their curvature would be lost.
_LEAST_MEAN_POINTS: Final = 6.0
_LEAST_AROUND: Final = 32
# Size, in cells, of the tiles to whose means the surface is fitted. Tukey's weights detect smaller
# deviations of tiles, such as those of tangential walls, than of cells.
_TILE: Final = 4
# Sizes, in tiles, of the clusters from whose scatter the covariance is estimated, and number of
# sectors over the whole length, whose scatter is large if the profile is not a circle.
_CLUSTERS: Final = ((1, 1), (4, 4))
_SECTORS: Final = 18
# Numbers of cells around surfaces are multiples of this number.
_MULTIPLE: Final = 16
_OPEN_SHARE: Final = 0.15
# Cells adjacent to cells without weight are ignored if more than this share of all cells remains.
_LEAST_USED: Final = 0.4
# A cell belongs to the extent if its mean distance is within this many standard deviations plus a
# tolerance.
_EXTENT_SIGMAS: Final = 3.0
_EXTENT_SLACK_M: Final = 0.001


@dataclass(frozen=True, kw_only=True)
class FittedSurface:
    """A surface fitted to all points.

    Attributes:
        surface: the surface, without a name.
        cell_scatter_m: scatter of the means of cells beyond the noise of points.
        noise_m: standard deviation of the points within cells.
        shift_m: maximum displacement from the surface found among voxels.
        slope: change of the radius per metre along the axis if a cone is fitted to a cylinder's
            cells; 0 for cones.
    """

    surface: Surface
    cell_scatter_m: float
    noise_m: float
    shift_m: float
    slope: float


@dataclass(frozen=True, kw_only=True)
class _Means(Rows):
    """Means of the distances of the points in the cells of a grid.

    Attributes:
        i: (m,) index of each cell around the axis.
        j: (m,) index of each cell along the axis.
        n: (m,) number of points.
        means: (m,) mean distance.
        matrix: (m, 6) mean of the rows of `design` with the slope.
        n_around: number of cells around the axis.
    """

    i: NDArray[np.int64]
    j: NDArray[np.int64]
    n: NDArray[np.float64]
    means: NDArray[np.float64]
    matrix: NDArray[np.float64]
    n_around: int

    def merged(self, side: int) -> _Means:
        """Return the means of squares of `side` by `side` cells."""
        key = (self.i // side) * (self.j.max() + 1) + self.j // side
        n = np.bincount(key, self.n).astype(np.float64)
        own = np.flatnonzero(n)

        def mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.asarray(np.bincount(key, self.n * values)[own] / n[own])

        return _Means(
            i=own // (self.j.max() + 1),
            j=own % (self.j.max() + 1),
            n=n[own],
            means=mean(self.means),
            matrix=np.column_stack([mean(column) for column in self.matrix.T]),
            n_around=self.n_around // side,
        )


def fit_all(
    found: list[Found],
    cloud: PointCloud,
    plane_labels: tuple[NDArray[np.int16], NDArray[np.float64]] | None,
    tolerances_m: list[float],
    noise_m: float,
    *,
    is_cone: bool,
    cores: int,
) -> tuple[list[FittedSurface], NDArray[np.int16]]:
    """Fit surfaces to all points near them, and label the points.

    Args:
        found: the surfaces.
        cloud: the cloud.
        plane_labels: planes of the points (n,), and normal and offset (k, 4) of each plane whose
            points are only used where they are nearer to the surface; NaN for other planes.
        tolerances_m: largest distance of labelled points, for each surface.
        noise_m: standard deviation of points across surfaces.
        is_cone: whether the surfaces are cones.
        cores: number of threads.

    Returns:
        The fitted surfaces, and the index of the surface of each point, -1 for none.
    """
    if not found:
        return [], np.full(len(cloud), -1, dtype=np.int16)
    labels = np.empty(len(cloud), dtype=np.int16)
    cells = _cells_of(found, tolerances_m, noise_m)
    n_cells = int(cells.sizes[-1, 0] + cells.sizes[-1, 1] * cells.sizes[-1, 2])
    offsets = read_only(cloud.x, cloud.y, cloud.z)
    planes = plane_labels or (np.zeros(0, dtype=np.int16), np.zeros((0, 4)))
    parts = even_parts(len(cloud), _PARTS)
    sums = np.zeros((_PARTS, n_cells, 3))
    counts = np.zeros((_PARTS, len(found)), dtype=np.int64)

    def run(part: int) -> None:
        own = parts[part]
        mine = Offsets(*(values[own] for values in offsets))
        sum_cells(mine, planes[0][own], planes[1], cells, sums[part], labels[own], counts[part])

    in_threads([partial(run, part) for part in range(_PARTS)], threads=cores)
    total = sums.sum(axis=0)
    fitted = []
    for index, item in enumerate(found):
        first, around, along, _ = cells.sizes[index].tolist()
        own = total[first : first + around * along].reshape(around, along, 3)
        n_points = int(counts[:, index].sum())
        fitted.append(_fitted(item, own, cells.bounds[index], n_points, cloud, is_cone=is_cone))
    return fitted, labels


def _cells_of(found: list[Found], tolerances_m: list[float], noise_m: float) -> Cells:
    rounds, bounds, sizes, opens = [], [], [], []
    first, first_open = 0, 0
    for item, tolerance_m in zip(found, tolerances_m, strict=True):
        low_m, high_m = item.along_m
        radius_m = item.round.radius_m
        area_m2 = 2.0 * math.pi * radius_m * (high_m - low_m) * float(item.is_open.mean())
        size_m = max(min(_CELL_M, _CELL_RAD * radius_m), math.sqrt(area_m2 / _MOST_CELLS))
        around = _MULTIPLE * max(2, round(2.0 * math.pi * radius_m / size_m / _MULTIPLE))
        along = max(_LEAST_CELLS, round((high_m - low_m) / size_m))
        rounds.append(item.round.row(item.zero))
        within_m = min(tolerance_m, max(_LEAST_SUM_M, _SUM_SIGMAS * noise_m))
        bounds.append((low_m, high_m, tolerance_m, within_m))
        sizes.append((first, around, along, first_open))
        opens.append(item.is_open[np.arange(around) * len(item.is_open) // around])
        first += around * along
        first_open += around
    return Cells(np.array(rounds), np.array(bounds), np.array(sizes), np.concatenate(opens))


def _fitted(
    found: Found,
    sums: NDArray[np.float64],
    bounds: NDArray[np.float64],
    n_points: int,
    cloud: PointCloud,
    *,
    is_cone: bool,
) -> FittedSurface:
    around, along = sums.shape[:2]
    size_m = (bounds[1] - bounds[0]) / along
    i, j = np.nonzero(sums[:, :, 0] >= 1.0)
    n, total, square = sums[i, j].T
    angles = ((i + 0.5) / around - 0.5) * 2.0 * math.pi
    places = bounds[0] + (j + 0.5) * size_m
    within = np.maximum(square - total**2 / n, 0.0)
    many = n >= 2.0
    noise_m = math.sqrt(float(within[many].sum() / max(1.0, (n[many] - 1.0).sum())))
    matrix = design(angles, places, found.round.steepness, is_cone=True)
    n_own = 6 if is_cone else 5
    cells = _Means(i=i, j=j, n=n, means=total / n, matrix=matrix, n_around=around)
    while cells.n.mean() < _LEAST_MEAN_POINTS and cells.n_around >= 2 * _LEAST_AROUND:
        cells = cells.merged(2)
    variance = max(noise_m, 1e-5) ** 2
    _, weights, extra_m = robust_solution(cells.matrix[:, :n_own], cells.means, variance / cells.n)
    # Cells at edges also contain points of mouldings and of adjoining walls. Only at the sides of a
    # surface seen from outside, there are none.
    is_good = np.zeros((cells.n_around + 2, cells.j.max() + 1), dtype=np.bool_)
    is_good[cells.i + 1, cells.j] = weights > 0.0
    is_open = np.full_like(is_good, found.side < 0.0)
    is_open[cells.i + 1, cells.j] = weights > 0.0
    is_open[[0, -1]] = is_open[[-2, 1]]
    is_in = ndimage.binary_erosion(is_open, np.ones((3, 3), dtype=np.bool_), border_value=1)
    is_in &= ndimage.binary_erosion(is_good, np.ones((1, 3), dtype=np.bool_))
    is_in = is_in[cells.i + 1, cells.j]
    tiles = cells.take(is_in if is_in.mean() > _LEAST_USED else weights > 0.0)
    tiles = tiles.merged(max(1, min(_TILE, tiles.n_around // _LEAST_AROUND)))
    variances = variance / tiles.n
    change, weights, _ = robust_solution(tiles.matrix[:, :n_own], tiles.means, variances)
    slope = 0.0
    if not is_cone:
        slope = float(robust_solution(tiles.matrix, tiles.means, variances)[0][5])
    own = _covariance(tiles, change, weights)
    rest = total / n - matrix[:, :n_own] @ change
    best = found.round.corrected(found.zero, change)
    zero = zero_direction(best.axis, cloud.up)
    middle_m = float(n @ places / n.sum())
    best, own = best.moved(middle_m), _moved_covariance(own, middle_m)
    near = np.abs(rest) < bounds[3]
    rms_m = math.sqrt(max(0.0, float((within + n * rest**2)[near].sum() / n[near].sum())))
    is_on = np.zeros((around, along), dtype=np.bool_)
    largest_m = _EXTENT_SIGMAS * np.sqrt(noise_m**2 / n + extra_m**2) + _EXTENT_SLACK_M
    is_on[i, j] = np.abs(rest) < largest_m
    arc, ends = _extent(is_on, sums[:, :, 0])
    # Positions along the axis of a cone are measured from its apex.
    start_m = bounds[0] - middle_m + (best.radius_m / best.slope if best.slope > 0.0 else 0.0)
    surface = Surface(
        name="",
        shape=best.shape(cloud.origin, is_concave=found.side > 0.0),
        covariance=best.covariance(zero, own),
        n_points=n_points,
        rms_m=rms_m,
        zero_world=zero,
        along_m=(float(start_m + size_m * ends[0]), float(start_m + size_m * ends[1])),
        arc_rad=arc,
    )
    return FittedSurface(
        surface=surface,
        cell_scatter_m=extra_m,
        noise_m=noise_m,
        shift_m=float(np.abs(matrix[:, :n_own] @ change).max()),
        slope=slope,
    )


def _moved_covariance(own: NDArray[np.float64], along_m: float) -> NDArray[np.float64]:
    """Return the covariance after the surface's point has moved along the axis."""
    turn = np.eye(len(own))
    turn[0, 2] = turn[1, 3] = along_m
    if len(own) > 5:
        turn[4, 5] = along_m
    return np.asarray(turn @ own @ turn.T)


def _covariance(
    tiles: _Means, change: NDArray[np.float64], weights: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Estimate the covariance of the parameters from the scatter between tiles.

    Neighbouring tiles have common errors, so clusters of several sizes are used, and the largest
    covariance is returned (White's estimator with clusters).
    """
    matrix = tiles.matrix[:, : len(change)]
    rest = tiles.means - matrix @ change
    inverse = np.linalg.pinv(matrix.T @ (matrix * weights[:, None]), hermitian=True)
    leverage = weights * np.einsum("ij,jk,ik->i", matrix, inverse, matrix)
    scores = matrix * (weights * rest / (1.0 - np.minimum(leverage, 0.9)))[:, None]
    best = np.zeros_like(inverse)
    sector = max(1, math.ceil(len(np.unique(tiles.i)) / _SECTORS))
    for around, along in (*_CLUSTERS, (sector, int(tiles.j.max()) + 1)):
        cluster = (tiles.i // around) * (tiles.j.max() + 1) + tiles.j // along
        n_clusters = len(np.unique(cluster[weights > 0.0]))
        if n_clusters <= 2 * len(inverse):
            continue
        sums = np.column_stack([np.bincount(cluster, column) for column in scores.T])
        factor = n_clusters / (n_clusters - len(inverse))
        found = factor * inverse @ (sums.T @ sums) @ inverse
        best = found if np.trace(found) > np.trace(best) else best
    return np.asarray(best if best.any() else inverse)


def _extent(
    is_full: NDArray[np.bool_], counts: NDArray[np.float64]
) -> tuple[tuple[float, float], tuple[int, int]]:
    """Return the ranges of angles and of cells along the axis (end exclusive) with points.

    The range of a closed surface begins in the middle of the 10 degrees with the fewest points.
    """
    length = float(np.quantile(is_full.sum(axis=1), 0.95))
    is_open = is_full.sum(axis=1) >= max(1.0, _OPEN_SHARE * length)
    # Isolated columns are clutter.
    count = len(is_open)
    wide = ndimage.binary_opening(np.tile(is_open, 3), np.ones(3, dtype=np.bool_))
    is_open = wide[count : 2 * count] if wide.any() else is_open
    rows = np.flatnonzero(is_full[is_open].sum(axis=0) >= 0.1 * is_open.sum())
    ends = (int(rows[0]), int(rows[-1]) + 1) if len(rows) else (0, is_full.shape[1])
    gap = longest_gap(is_open)
    step = 2.0 * math.pi / count
    if gap <= max(2, count // 60):
        near = ndimage.uniform_filter1d(counts.sum(axis=1), max(1, count // 36), mode="wrap")
        low = (int(np.argmin(near)) + 0.5) * step - math.pi
        return (low, low + 2.0 * math.pi), ends
    opens = np.flatnonzero(is_open)
    steps = np.diff(np.append(opens, opens[0] + count))
    start = int(opens[(int(np.argmax(steps)) + 1) % len(opens)])
    low = start * step - math.pi
    return (low, low + (count - gap) * step), ends
