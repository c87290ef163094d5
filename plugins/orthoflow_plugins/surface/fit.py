"""Fits surfaces, with covariances, to the means of all points of a cloud in small cells."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from orthoflow.geometry.slabs import Offsets, read_only
from orthoflow.geometry.surfaces import zero_direction
from orthoflow.geometry.threads import even_parts, in_threads
from orthoflow.products import PointCloud, Surface
from orthoflow_plugins.surface.kernels import Cells, sum_cells
from orthoflow_plugins.surface.rounds import design, robust_solution
from orthoflow_plugins.surface.search import Found, longest_gap

# Minimum size and maximum number of the cells of a surface.
_CELL_M: Final = 0.03
_MOST_CELLS: Final = 30_000
_LEAST_CELLS: Final = 8
# Number of parts of the sums; it is fixed, so that the sums do not depend on the number of threads.
_PARTS: Final = 4
# Maximum distance, in standard deviations, of the points that are summed.
_SUM_SIGMAS: Final = 5.0
_LEAST_SUM_M: Final = 0.012
# Sizes, in cells, of the tiles from whose scatter the covariance is estimated.
_TILES: Final = (1, 4, 16)
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
        counts: (around, along) number of points in each cell.
        means_m: (around, along) mean distance of each cell from the surface, positive towards the
            viewer; NaN for empty cells.
        shift_m: maximum displacement from the surface found among voxels.
        slope: change of the radius per metre along the axis if a cone is fitted to a cylinder's
            cells; 0 for cones.
    """

    surface: Surface
    cell_scatter_m: float
    noise_m: float
    counts: NDArray[np.int64]
    means_m: NDArray[np.float64]
    shift_m: float
    slope: float


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
        size_m = max(_CELL_M, math.sqrt(area_m2 / _MOST_CELLS))
        # Each part of the circle that may be open contains a whole number of cells.
        n_open = len(item.is_open)
        around = n_open * max(1, round(2.0 * math.pi * radius_m / size_m / n_open))
        along = max(_LEAST_CELLS, round((high_m - low_m) / size_m))
        rounds.append(item.round.row(item.zero))
        within_m = min(tolerance_m, max(_LEAST_SUM_M, _SUM_SIGMAS * noise_m))
        bounds.append((low_m, high_m, tolerance_m, within_m))
        sizes.append((first, around, along, first_open))
        opens.append(np.repeat(item.is_open, around // n_open))
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
    means = total / n
    many = n >= 4.0
    within = np.maximum(square - n * means**2, 0.0)
    noise_m = math.sqrt(float(within[many].sum() / max(1.0, (n[many] - 1.0).sum())))
    matrix = design(angles, places, found.round.steepness, is_cone=is_cone)
    variances = max(noise_m, 1e-5) ** 2 / n
    _, weights, _ = robust_solution(matrix, means, variances)
    # Cells adjacent to those without weight also contain a few points of mouldings and edges.
    is_out = np.zeros((around, along), dtype=np.bool_)
    is_out[i, j] = weights == 0.0
    is_in = ~ndimage.binary_dilation(is_out, np.ones((3, 3), dtype=np.bool_))[i, j]
    used = is_in if is_in.mean() > _LEAST_USED else weights > 0.0
    change, weights, extra_m = robust_solution(matrix[used], means[used], variances[used])
    rest = means - matrix @ change
    slope = 0.0
    if not is_cone:
        wider = design(angles[used], places[used], 1.0, is_cone=True)
        slope = float(robust_solution(wider, means[used], variances[used])[0][5])
    own = _covariance(matrix[used], rest[used], weights, (i[used], j[used]))
    best = found.round.corrected(found.zero, change)
    zero = zero_direction(best.axis, cloud.up)
    middle_m = float(n @ places / n.sum())
    best, own = best.moved(middle_m), _moved_covariance(own, middle_m)
    counts = np.zeros((around, along), dtype=np.int64)
    counts[i, j] = n
    sign = -1.0 if found.side > 0.0 else 1.0
    means_m = np.full((around, along), np.nan)
    means_m[i, j] = sign * rest
    near = np.abs(rest) < bounds[3]
    rms_m = math.sqrt(max(0.0, float((within + n * rest**2)[near].sum() / n[near].sum())))
    is_on = np.zeros((around, along), dtype=np.bool_)
    largest_m = _EXTENT_SIGMAS * np.sqrt(noise_m**2 / n + extra_m**2) + _EXTENT_SLACK_M
    is_on[i, j] = np.abs(rest) < largest_m
    arc, ends = _extent(is_on, counts)
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
        counts=counts,
        means_m=means_m,
        shift_m=float(np.abs(matrix @ change).max()),
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
    matrix: NDArray[np.float64],
    rest: NDArray[np.float64],
    weights: NDArray[np.float64],
    cell: tuple[NDArray[np.int64], NDArray[np.int64]],
) -> NDArray[np.float64]:
    """Estimate the covariance of the parameters from the scatter between tiles.

    Neighbouring cells have common errors, so tiles of several sizes are used, and the largest
    covariance is returned (White's estimator with clusters).
    """
    inverse = np.linalg.pinv(matrix.T @ (matrix * weights[:, None]), hermitian=True)
    best = np.zeros_like(inverse)
    for side in _TILES:
        tile = (cell[0] // side) * 100_003 + cell[1] // side
        _, own = np.unique(tile, return_inverse=True)
        n_tiles = int(own.max()) + 1
        if n_tiles <= 3 * len(inverse):
            break
        scores = np.zeros((n_tiles, len(inverse)))
        np.add.at(scores, own, matrix * (weights * rest)[:, None])
        factor = n_tiles / (n_tiles - len(inverse))
        found = factor * inverse @ (scores.T @ scores) @ inverse
        best = found if np.trace(found) > np.trace(best) else best
    return np.asarray(best if best.any() else inverse)


def _extent(
    is_full: NDArray[np.bool_], counts: NDArray[np.int64]
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
        near = ndimage.uniform_filter1d(
            counts.sum(axis=1, dtype=np.float64), max(1, count // 36), mode="wrap"
        )
        low = (int(np.argmin(near)) + 0.5) * step - math.pi
        return (low, low + 2.0 * math.pi), ends
    opens = np.flatnonzero(is_open)
    steps = np.diff(np.append(opens, opens[0] + count))
    start = int(opens[(int(np.argmax(steps)) + 1) % len(opens)])
    low = start * step - math.pi
    return (low, low + (count - gap) * step), ends
