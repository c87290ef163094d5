"""Fits surfaces, with covariances, to the means of all points of a cloud in small cells."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, ndimage, special
from scipy.spatial.distance import cdist

from orthoflow.geometry.robust import median_deviation
from orthoflow.geometry.rows import Rows, spread_index
from orthoflow.geometry.slabs import Offsets, read_only
from orthoflow.geometry.surfaces import zero_direction
from orthoflow.geometry.threads import even_parts, in_order, in_threads
from orthoflow.products import PointCloud, Surface
from orthoflow_plugins.surface.kernels import Cells, sum_cells
from orthoflow_plugins.surface.rounds import TUKEY, Round, design, robust_solution
from orthoflow_plugins.surface.search import Found, longest_gap

# Minimum size and maximum number of the cells of a surface.
_CELL_M: Final = 0.03
_CELL_RAD: Final = 0.05
_MOST_CELLS: Final = 30_000
_LEAST_CELLS: Final = 8
# Number of parts of the sums; it is fixed, so that the sums do not depend on the number of threads.
_PARTS: Final = 8
# Maximum distance, in standard deviations, of the points that are summed.
_SUM_SIGMAS: Final = 5.0
_LEAST_SUM_M: Final = 0.012
# Surfaces found among voxels are usually off by 0.1 to 0.3 standard deviations of a point. If it is
# more than this number, the points are summed again about the fitted surface. This happens to
# basket vaults found with their haunches: a change of the radius by 0.1 m is not linear.
_FAR_SIGMAS: Final = 2.0
_PASSES: Final = 3
# Cells are merged until they contain this many points on average; cells and tiles become no larger
# than this share of a circle, because their curvature would be lost.
_LEAST_MEAN_POINTS: Final = 6.0
_LEAST_AROUND: Final = 64
# Size, in cells, of the tiles to whose means the surface is fitted. Tukey's weights detect smaller
# deviations of tiles, such as those of tangential walls, than of cells.
_TILES: Final = (4, 2, 1)
_TILES_AROUND: Final = 72
# Maximum number of tiles from which the correlation of the relief is estimated, correlation lengths
# in tiles, and shares of the correlated part of the variance.
_MOST_TILES: Final = 200
_LENGTHS: Final = (1.0, 2.0, 4.0, 8.0)
_CORRELATED: Final = (0.25, 0.5, 0.75, 0.95)
# Least norm of the remaining distances: points without noise may be exactly on the surface.
_LEAST_SCATTER_M: Final = 1e-9
# Variance, in square metres or radians, of parameters that the tiles do not determine.
_UNDETERMINED: Final = 1e6
# The profile is tested in sectors of at least this angle and this number of tiles, which are
# divided into pieces of this number of tiles along the axis. There are at least three sectors if
# there are enough tiles, and at most twelve. Angles from 25 to 45 degrees give the same results for
# 70 drawn profiles (circles with and without relief, ellipses, basket vaults, strips of planes);
# with smaller ones, relief looks like a variation of the profile. To find where the ends of an arc
# leave its circle, there are at least five sectors, which may be narrower.
_SECTOR_RAD: Final = math.radians(30.0)
_END_RAD: Final = math.radians(15.0)
_SECTOR_TILES: Final = 3
_PIECE_TILES: Final = 4
_SECTORS: Final = (3, 12)
# Minimum share of the tiles within the ends of the arc that are on the circle, if only the ends are
# not.
_LEAST_INNER: Final = 0.9
# A profile is a circle if its variation has at least the first probability on circles, and is none
# if it has less than the second.
_LEVELS: Final = (0.05, 0.001)
# Number of parameters of a sphere, and angle by which it may extend beyond its voxels: pendentives
# are so near walls that they may be labelled as parts of these.
_N_SPHERE: Final = 4
_PENDENTIVE_RAD: Final = math.radians(15.0)
# Numbers of cells around surfaces are multiples of this number.
_MULTIPLE: Final = 16
_OPEN_SHARE: Final = 0.15
# Cells adjacent to cells without weight are ignored if more than this share of all cells remains.
_LEAST_USED: Final = 0.4
# A surface is a cylinder if its generatrices are parallel to its axis to within this angle, and
# otherwise a cone; 97.5 % probability, one-sided.
CYLINDER_SLOPE: Final = math.radians(1.0)
_SIGMAS: Final = 1.96
# Step by which the effect of noise is differentiated, as a share of the radius, and least cosine of
# the angle of incidence.
_NOISE_STEP: Final = 0.01
_LEAST_INCIDENCE: Final = 0.05
# Number of points from which displacements between scans are estimated, and minimum number of
# points of a scan on a surface.
_SCAN_SAMPLE: Final = 50_000
_LEAST_SCAN_POINTS: Final = 100
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
        round: the surface relative to the same point of the axis as the surface to which the points
            were compared.
        shift_m: maximum displacement from that surface.
        slope: change of the radius per metre along the axis if a cone is fitted to a cylinder's
            cells; 0 for cones.
        variation: deviation of the profile's curvature along the arc from the circle's, RMS, as a
            share of its mean; 0 if it is insignificant.
    """

    surface: Surface
    cell_scatter_m: float
    noise_m: float
    round: Round
    shift_m: float
    slope: float
    variation: float


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


class _Near(NamedTuple):
    """The points near a surface.

    Attributes:
        sums: (around, along, 3) number of points of each cell, sums of their distances and of the
            squares of these.
        bounds: see `Cells`.
        n_points: number of labelled points.
        sample: indices of some of these points; empty if their scans are unknown.
    """

    sums: NDArray[np.float64]
    bounds: NDArray[np.float64]
    n_points: int
    sample: NDArray[np.int64]


def fit_all(
    found: list[Found],
    cloud: PointCloud,
    plane_labels: tuple[NDArray[np.int16], NDArray[np.float64]] | None,
    tolerances_m: list[float],
    noise_m: float,
    *,
    is_cone: bool,
    cores: int,
) -> tuple[list[FittedSurface | None], NDArray[np.int16]]:
    """Fit surfaces to all points near them, and label the points.

    Args:
        found: the surfaces; earlier ones, which are last, only keep the points near them.
        cloud: the cloud.
        plane_labels: planes of the points (n,), and normal and offset (k, 4) of each plane whose
            points are only used where they are nearer to the surface; NaN for other planes.
        tolerances_m: largest distance of labelled points, for each surface.
        noise_m: standard deviation of points across surfaces.
        is_cone: whether the surfaces are cones.
        cores: number of threads.

    Returns:
        The fitted surfaces, or None where the fit leaves the points, and the index of the surface
        of each point, -1 for none.
    """
    n_new = sum(not item.is_earlier for item in found)
    if not n_new:
        return [], np.full(len(cloud), -1, dtype=np.int16)
    planes = plane_labels or (np.zeros(0, dtype=np.int16), np.zeros((0, 4)))
    labels = np.empty(len(cloud), dtype=np.int16)
    found, moved_m = [*found], [0.0] * n_new
    nears: list[_Near] = []
    fitted: list[FittedSurface | None] = []

    def fit(index: int) -> FittedSurface | None:
        near, old = nears[index], before[index] if before else None
        # The points near most surfaces remain the same when others are moved.
        if old and old.n_points == near.n_points and np.array_equal(old.sums, near.sums):
            return fitted[index]
        return _fitted(found[index], near, cloud, is_cone=is_cone)

    for number in range(_PASSES):
        cells = _cells_of(found, tolerances_m, noise_m)
        before, nears = nears, _summed(cells, cloud, planes, labels, cores=cores)
        fitted = list(in_order(fit, range(n_new), threads=cores))
        # Far from the surface found among voxels, distances are not linear in the parameters, and
        # points of the surface may be too far away to be summed.
        far = {
            index: item
            for index, item in enumerate(fitted)
            if item and item.shift_m > _FAR_SIGMAS * item.noise_m
        }
        if number == _PASSES - 1 or not far:
            break
        for index, item in far.items():
            found[index] = replace(found[index], round=item.round)
            moved_m[index] += item.shift_m
    return [
        item and replace(item, shift_m=item.shift_m + before_m)
        for item, before_m in zip(fitted, moved_m, strict=True)
    ], labels


def _summed(
    cells: Cells,
    cloud: PointCloud,
    planes: tuple[NDArray[np.int16], NDArray[np.float64]],
    labels: NDArray[np.int16],
    *,
    cores: int,
) -> list[_Near]:
    """Label the points, and sum their distances in the cells of each surface."""
    offsets = read_only(cloud.x, cloud.y, cloud.z)
    parts = even_parts(len(cloud), _PARTS)
    sums = np.zeros((_PARTS, cells.columns.max() + cells.sizes[:, 2].max(), 3))
    counts = np.zeros((_PARTS, len(cells.rounds)), dtype=np.int64)

    def run(part: int) -> None:
        own = parts[part]
        mine = Offsets(*(values[own] for values in offsets))
        sum_cells(mine, planes[0][own], planes[1], cells, sums[part], labels[own], counts[part])

    in_threads([partial(run, part) for part in range(_PARTS)], threads=cores)
    total = sums.sum(axis=0)
    n_sample = 0 if cloud.scan is None else min(_SCAN_SAMPLE, len(cloud))
    sample = spread_index(len(cloud), n_sample)
    results = []
    for index, (first, around, along) in enumerate(cells.sizes.tolist()):
        columns, own = cells.columns[first : first + around], np.zeros((around, along, 3))
        own[columns >= 0] = total[columns[columns >= 0, None] + np.arange(along)]
        n_points, on = int(counts[:, index].sum()), sample[labels[sample] == index]
        results.append(_Near(own, cells.bounds[index], n_points, on))
    return results


def _cells_of(found: list[Found], tolerances_m: list[float], noise_m: float) -> Cells:
    rounds, bounds, sizes, columns = [], [], [], []
    n_cells, n_columns = 0, 0
    for item, tolerance_m in zip(found, tolerances_m, strict=True):
        low_m, high_m = item.along_m
        radius_m = item.round.radius_m
        if item.round.is_sphere:
            farthest = math.acos(min(1.0, max(-1.0, low_m / radius_m))) + _PENDENTIVE_RAD
            low_m = radius_m * math.cos(min(math.pi, farthest))
        area_m2 = 2.0 * math.pi * radius_m * (high_m - low_m) * float(item.is_open.mean())
        size_m = max(min(_CELL_M, _CELL_RAD * radius_m), math.sqrt(area_m2 / _MOST_CELLS))
        around = _MULTIPLE * max(2, round(2.0 * math.pi * radius_m / size_m / _MULTIPLE))
        along = max(_LEAST_CELLS, round((high_m - low_m) / size_m))
        rounds.append(item.round.row(item.zero))
        scatter_m = max(noise_m, item.evidence["scatter_mm"] / 1000.0)
        within_m = min(tolerance_m, max(_LEAST_SUM_M, _SUM_SIGMAS * scatter_m))
        bounds.append((low_m, high_m, tolerance_m, within_m))
        sizes.append((n_columns, around, along))
        is_open = item.is_open[np.arange(around) * len(item.is_open) // around]
        columns.append(np.where(is_open, n_cells + along * (np.cumsum(is_open) - 1), -1))
        n_cells += along * int(is_open.sum())
        n_columns += around
    return Cells(np.array(rounds), np.array(bounds), np.array(sizes), np.concatenate(columns))


def _fitted(found: Found, near: _Near, cloud: PointCloud, *, is_cone: bool) -> FittedSurface | None:
    """Fit a surface to the points near it; return None if the fit leaves them."""
    sums, bounds, n_points, sample = near
    around, along = sums.shape[:2]
    size_m = (bounds[1] - bounds[0]) / along
    i, j = np.nonzero(sums[:, :, 0] >= 1.0)
    n, total, square = sums[i, j].T
    angles = ((i + 0.5) / around - 0.5) * 2.0 * math.pi
    places = bounds[0] + (j + 0.5) * size_m
    within = np.maximum(square - total**2 / n, 0.0)
    noise_m = math.sqrt(float(within.sum() / max(1.0, (n - 1.0).sum())))
    is_sphere = found.round.is_sphere
    n_own = _N_SPHERE if is_sphere else 6 if is_cone else 5
    variance = max(noise_m, 1e-5) ** 2
    points = found.round.points(angles, places, total / n, found.zero)

    core = places >= found.along_m[0]
    if not core.any():
        return None

    def cells_of(
        surface: Round, at: tuple[NDArray[np.float64], ...], means: NDArray[np.float64]
    ) -> _Means:
        matrix = design(surface, *at, is_cone=True)
        cells = _Means(i=i, j=j, n=n, means=means, matrix=matrix, n_around=around).take(core)
        while cells.n.mean() < _LEAST_MEAN_POINTS and cells.n_around >= 2 * _LEAST_AROUND:
            cells = cells.merged(2)
        return cells

    cells = cells_of(found.round, (angles, places), total / n)
    change, weights, extra_m = robust_solution(
        cells.matrix[:, :n_own], cells.means, variance / cells.n
    )
    # The design is linear, so it is computed again about the new surface.
    start = found.round.corrected(found.zero, change)
    zero = zero_direction(start.axis, cloud.up)
    cells = cells_of(start, start.places(points, zero), start.outwards(points)[0])
    tiles = _inside(cells, weights, is_open_beside=found.side < 0.0)
    tiles = (
        _along_meridians(tiles)
        if is_sphere
        else _without_noise_effect(tiles, start, zero, found.side, variance, cloud)
    )
    change, own, variation, slope = _solution(tiles, variance, start.radius_m, n_own)
    best = start.corrected(zero, change)
    own += _scan_effect(best, zero, n_own, cloud, sample)
    rest, _ = best.outwards(points)
    middle_m = 0.0 if is_sphere else float(n @ places / n.sum())
    middle = best.moved(middle_m)
    own = middle.covariance(zero, _moved_covariance(own, middle_m))
    zero = zero_direction(best.axis, cloud.up)
    largest_m = _EXTENT_SIGMAS * np.sqrt(noise_m**2 / n + extra_m**2) + _EXTENT_SLACK_M
    is_near, on = np.abs(rest) < bounds[3], np.abs(rest) < largest_m
    if min(best.radius_m, middle.radius_m) <= 0.0 or not (is_near & on).any():
        return None
    rms_m = math.sqrt(max(0.0, float((within + n * rest**2)[is_near].sum() / n[is_near].sum())))
    along_m, arc = _ends(middle, sums, bounds, (i[on], j[on]), rest[on], middle_m)
    surface = Surface(
        name="",
        shape=middle.shape(cloud.origin, is_concave=found.side > 0.0),
        covariance=own,
        n_points=n_points,
        rms_m=rms_m,
        zero_world=best.axis if is_sphere else zero,
        along_m=along_m,
        arc_rad=arc,
    )
    return FittedSurface(
        surface=surface,
        cell_scatter_m=extra_m,
        noise_m=noise_m,
        round=best,
        shift_m=float(np.abs(rest - total / n).max()),
        slope=slope,
        variation=variation,
    )


def _ends(
    best: Round,
    sums: NDArray[np.float64],
    bounds: NDArray[np.float64],
    cells: tuple[NDArray[np.int64], NDArray[np.int64]],
    distances: NDArray[np.float64],
    middle_m: float,
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the ranges of positions along the axis and of angles of a `Surface`.

    Args:
        best: the surface.
        sums: see `_Near`.
        bounds: see `Cells`.
        cells: indices (m,) of the cells on the surface around the axis and along it.
        distances: (m,) their mean distances.
        middle_m: position along the axis of the surface's point.
    """
    (around, along), size_m = sums.shape[:2], (bounds[1] - bounds[0]) / sums.shape[1]
    is_on = np.zeros((around, along), dtype=np.bool_)
    is_on[cells] = True
    if best.is_sphere:
        places_m = bounds[0] + (np.arange(along) + 0.5) * size_m
        is_on = _above_springing(
            is_on, cells, distances, sums[cells][:, 0], places_m, best.radius_m
        )
    arc, ends = _extent(is_on, sums[:, :, 0], best.least_row_share)
    # Positions along the axis of a cone are measured from its apex.
    start_m = bounds[0] - middle_m + (best.radius_m / best.slope if best.slope > 0.0 else 0.0)
    along_m = float(start_m + size_m * ends[0]), float(start_m + size_m * ends[1])
    if best.is_sphere:
        # Rows of cells are between planes across the axis.
        least, most = (math.acos(min(1.0, max(-1.0, at / best.radius_m))) for at in along_m[::-1])
        along_m, arc = (best.radius_m * least, best.radius_m * most), (-most, most)
    return along_m, arc


def _above_springing(
    is_on: NDArray[np.bool_],
    cells: tuple[NDArray[np.int64], NDArray[np.int64]],
    distances: NDArray[np.float64],
    counts: NDArray[np.float64],
    places_m: NDArray[np.float64],
    radius_m: float,
) -> NDArray[np.bool_]:
    """Return the cells of a sphere without those of walls below or beside it.

    A drum continues a dome without an edge, and leaves its sphere only by millimetres in the first
    decimetres. The means of rows show where the meridians become straight.

    Args:
        is_on: (around, along) whether a cell is on the sphere.
        cells: indices (m,) of these cells around the axis and along it.
        distances: (m,) their mean distances.
        counts: (m,) their numbers of points.
        places_m: (along,) positions of the rows along the axis.
        radius_m: radius of the sphere.
    """
    # Walls cross a sphere in lines one or two cells wide, also below its springing line.
    square = np.ones((3, 3), dtype=np.bool_)
    wide = ndimage.binary_opening(np.pad(is_on, ((4, 4), (0, 0)), mode="wrap"), square)
    is_on = is_on & ndimage.binary_dilation(wide, square, iterations=2)[4:-4]
    kept = is_on[cells]
    rows, weights = cells[1][kept], counts[kept]
    own = np.unique(rows)
    n = np.bincount(rows, weights)[own]
    means = np.bincount(rows, weights * distances[kept])[own] / n
    arcs_m = radius_m * np.arccos(np.clip(places_m[own] / radius_m, -1.0, 1.0))
    # Each row of this matrix contains the distances of a line that begins in this row of cells.
    expected = np.hypot(radius_m, np.maximum(arcs_m - arcs_m[:, None], 0.0)) - radius_m
    squares, free = (means - expected) ** 2 @ n, len(own) - 2
    gain = float(n @ means**2 - squares.min())
    chance = special.fdtrc(1, free, free * gain / max(squares.min(), 1e-12)) if free > 0 else 1.0
    if chance < _LEVELS[1]:
        is_on[:, places_m < places_m[own[np.argmin(squares)]]] = False
    return is_on


def _inside(cells: _Means, weights: NDArray[np.float64], *, is_open_beside: bool) -> _Means:
    """Return tiles of the cells with weights that are not at edges.

    Cells at edges also contain points of mouldings and of adjoining walls. Only at the sides of a
    surface seen from outside, there are none.
    """
    is_good = np.zeros((cells.n_around + 2, cells.j.max() + 1), dtype=np.bool_)
    is_good[cells.i + 1, cells.j] = weights > 0.0
    is_open = np.full_like(is_good, is_open_beside)
    is_open[cells.i + 1, cells.j] = weights > 0.0
    is_open[[0, -1]] = is_open[[-2, 1]]
    is_in = ndimage.binary_erosion(is_open, np.ones((3, 3), dtype=np.bool_), border_value=1)
    is_in &= ndimage.binary_erosion(is_good, np.ones((1, 3), dtype=np.bool_))
    is_in = is_in[cells.i + 1, cells.j]
    inside = cells.take(is_in if is_in.mean() > _LEAST_USED else weights > 0.0)
    fine = (side for side in _TILES if cells.n_around >= side * _TILES_AROUND)
    return inside.merged(next(fine, 1))


def _along_meridians(tiles: _Means) -> _Means:
    """Return the tiles of a sphere with angles from its middle as positions around the axis.

    The profile of a dome is tested along its meridians; positions along the axis are the angles
    about it.
    """
    angles = np.arccos(np.clip(tiles.matrix[:, 2], -1.0, 1.0))
    i = (angles / (2.0 * math.pi) * tiles.n_around).astype(np.int64)
    return replace(tiles, i=i, j=tiles.i)


def _solution(
    tiles: _Means, variance: float, radius_m: float, n_own: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], float, float]:
    """Fit a surface to tiles, and test its profile.

    Args:
        tiles: the tiles.
        variance: variance of points.
        radius_m: the radius.
        n_own: number of parameters of the surface: 4 for a sphere, 5 for a cylinder and 6 for a
            cone.

    Returns:
        The change of the parameters (n_own,), their covariance, and the variation and the slope of
        `FittedSurface`.
    """
    # Numbers of parameters that move the centre, and index of the radius.
    n_centre, radius = (3, 3) if n_own == _N_SPHERE else (2, 4)
    change, used = _solved(tiles, variance, n_own)
    own = _covariance(used, n_own)
    variation, chance = _variation(used, radius_m)
    # The ends of the arc may be on walls, or on arcs of another radius, that adjoin it without an
    # edge. Then the radius without them differs significantly (Hausman 1978, doi:10.2307/1913827).
    # Smaller differences are part of the stated errors.
    while True:
        sector, _ = _sectors(tiles, _END_RAD, _SECTORS[0] + 2)
        if not len(np.unique(sector)) == sector.max() + 1 >= _SECTORS[0] + 2:
            break
        inner = tiles.take((sector > 0) & (sector < sector.max()))
        again, kept = _solved(inner, variance, n_own)
        theirs, differs = _covariance(kept, n_own), again - change
        largest = theirs[radius, radius] - own[radius, radius]
        largest = special.chdtri(1.0, _LEVELS[1]) * max(0.0, largest)
        is_circle = len(kept) > _LEAST_INNER * len(inner)
        is_circle = is_circle and _variation(kept, radius_m)[1] > _LEVELS[0]
        if not (is_circle and (chance < _LEVELS[1] or differs[radius] ** 2 > largest)):
            own += np.outer(differs, differs)
            break
        tiles, change, used, own, chance = inner, again, kept, theirs, 1.0
    variation = variation if chance < _LEVELS[1] else 0.0
    # If the radius of curvature varies, the centre does, too; the middle of the arc stays.
    turn = np.zeros(n_own)
    turn[:n_centre] = -used.n @ used.matrix[:, :n_centre] / used.n.sum()
    turn[radius] = 1.0
    own += (variation * radius_m) ** 2 * np.outer(turn, turn)
    slope = 0.0
    if n_own == 5:
        steep, parts = _solved(tiles, variance, 6)
        slope = float(steep[5])
        if abs(slope) > CYLINDER_SLOPE:
            # Relief also causes a slope.
            sigma = math.sqrt(_covariance(parts, 6)[5, 5])
            slope = math.copysign(max(0.0, abs(slope) - _SIGMAS * sigma), slope)
    return change, own, variation, slope


def _without_noise_effect(
    tiles: _Means,
    surface: Round,
    zero: NDArray[np.float64],
    side: float,
    variance: float,
    cloud: PointCloud,
) -> _Means:
    """Subtract the expected distances of tiles from their surface due to noise of the points.

    Noise along the ray displaces points across the surface and also along it, from places where
    their density and the incidence of rays differ. With the density d and the components r, t and
    z of the noise across the surface, around the axis and along it, the expected distance is
    E[t^2] / 2R - (d/ds (d E[rt]) + d/dz (d E[rz])) / d, where s is the arc length. Without
    stations, noise is assumed to be the same in all directions.

    Args:
        tiles: the tiles.
        surface: the surface.
        zero: (3,) direction of angle 0.
        side: 1 if the surface is seen from the axis, -1 if from outside.
        variance: variance of the points across the surface.
        cloud: the cloud, for the stations.
    """
    cosine, sine, _, _, _, along = (tiles.matrix / surface.steepness).T
    radius_m, angles = surface.radius_m, np.arctan2(sine, cosine)
    if cloud.stations is None or not len(cloud.stations):
        return replace(tiles, means=tiles.means - variance / (2.0 * radius_m))
    stations = cloud.stations - cloud.origin

    def moments(turn: float, step_m: float) -> NDArray[np.float64]:
        """Return density, and density times E[rr], E[rt], E[rz] and E[tt], beside the tiles."""
        points = surface.points(angles + turn, along + step_m, np.zeros(len(along)), zero)
        _, outwards = surface.outwards(points)
        rays = points - stations[:, None]
        lengths = np.linalg.norm(rays, axis=2)
        r = np.einsum("smi,mi->sm", rays, outwards) / lengths
        t = np.einsum("smi,mi->sm", rays, np.cross(surface.axis, outwards)) / lengths
        density = np.maximum(side * r, _LEAST_INCIDENCE) / lengths**2
        z = rays @ surface.axis / lengths
        return np.stack(
            [(density * part).sum(axis=0) for part in (1.0 + 0.0 * r, r * r, r * t, r * z, t * t)]
        )

    turn, step_m = _NOISE_STEP, _NOISE_STEP * radius_m
    density, across, _, _, aside = moments(0.0, 0.0)
    around = (moments(turn, 0.0)[2] - moments(-turn, 0.0)[2]) / (2.0 * turn * radius_m)
    upwards = (moments(0.0, step_m)[3] - moments(0.0, -step_m)[3]) / (2.0 * step_m)
    along_ray = variance * tiles.n.sum() / float(tiles.n @ (across / density))
    effect = along_ray * (aside / (2.0 * radius_m) - around - upwards) / density
    return replace(tiles, means=tiles.means - effect)


def _scan_effect(
    surface: Round,
    zero: NDArray[np.float64],
    n_own: int,
    cloud: PointCloud,
    sample: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Return the covariance of the parameters due to displacements between scans.

    A displacement is fitted for each scan, together with the surface; that of a cylinder is across
    its axis. Zeros are returned if the displacements are not significant.

    Args:
        surface: the surface.
        zero: (3,) direction of angle 0.
        n_own: number of parameters.
        cloud: the cloud.
        sample: indices of points on the surface; empty if their scans are unknown.
    """
    nothing = np.zeros((n_own, n_own))
    if cloud.scan is None:
        return nothing
    _, scan, counts = np.unique(cloud.scan[sample], return_inverse=True, return_counts=True)
    is_many = counts >= _LEAST_SCAN_POINTS
    sample, scan = sample[is_many[scan]], (np.cumsum(is_many) - 1)[scan[is_many[scan]]]
    n_scans = np.count_nonzero(is_many)
    if n_scans < 2:
        return nothing
    points = np.column_stack([cloud.x[sample], cloud.y[sample], cloud.z[sample]]).astype(np.float64)
    distances, _ = surface.outwards(points)
    matrix = design(surface, *surface.places(points, zero), is_cone=True)[:, :n_own]
    n_centre = 3 if surface.is_sphere else 2
    scatter_m = max(1e-6, median_deviation(distances, 0.0))
    weights = (np.abs(distances) < TUKEY * scatter_m) / scatter_m**2
    # Displacements are relative to the first scan.
    is_of = scan[:, None] == np.arange(n_scans)
    columns = [is_of[:, number, None] * matrix[:, :n_centre] for number in range(n_scans)]
    rows = np.column_stack([matrix, *columns[1:]])
    normal = (rows.T * weights) @ rows
    inverse = np.linalg.pinv(normal, hermitian=True)
    apart = (inverse @ (rows.T * weights) @ distances)[n_own:]
    alone = np.linalg.inv(normal[:n_own, :n_own])
    square = apart @ np.linalg.solve(inverse[n_own:, n_own:], apart)
    if special.chdtrc(len(apart), square) > _LEVELS[1]:
        return nothing
    apart = np.vstack([np.zeros(n_centre), apart.reshape(-1, n_centre)])
    variance = float(apart.var(axis=0, ddof=1).mean())
    effects = [alone @ (matrix.T * weights) @ column for column in columns]
    return np.asarray(variance * np.sum([effect @ effect.T for effect in effects], axis=0))


def _moved_covariance(own: NDArray[np.float64], along_m: float) -> NDArray[np.float64]:
    """Return the covariance after the surface's point has moved along the axis."""
    turn = np.eye(len(own))
    if len(own) < 5:
        return own
    turn[0, 2] = turn[1, 3] = along_m
    if len(own) > 5:
        turn[4, 5] = along_m
    return np.asarray(turn @ own @ turn.T)


def _solved(tiles: _Means, variance: float, n_own: int) -> tuple[NDArray[np.float64], _Means]:
    """Fit a surface to tiles.

    Returns:
        The change (n_own,), and the tiles with weights, their means reduced to the
        remaining distances and their counts replaced by the weights.
    """
    matrix = tiles.matrix[:, :n_own]
    change, weights, _ = robust_solution(matrix, tiles.means, variance / tiles.n)
    used = replace(tiles, means=tiles.means - matrix @ change, n=weights).take(weights > 0.0)
    return change, used


def _covariance(tiles: _Means, n_own: int) -> NDArray[np.float64]:
    """Estimate the covariance of the parameters from the scatter of tiles and its correlation.

    The scatter is white noise plus relief whose correlation decreases exponentially with the
    distance. Their shares and the correlation length have the largest restricted likelihood
    (Patterson and Thompson 1971, doi:10.1093/biomet/58.3.545), which allows for the relief that the
    fit has absorbed. The variances are very large if the tiles do not determine the parameters.

    Args:
        tiles: the result of `_solved`.
        n_own: number of parameters.
    """
    while len(tiles) > _MOST_TILES:
        tiles = tiles.merged(2)
    matrix = tiles.matrix[:, :n_own]
    free = len(matrix) - n_own
    if free <= 0 or np.linalg.matrix_rank(matrix) < n_own:
        return _UNDETERMINED * np.eye(n_own)
    turn = math.pi / tiles.n_around * (tiles.i[:, None] - tiles.i)
    apart = np.hypot(tiles.n_around / math.pi * np.sin(turn), tiles.j[:, None] - tiles.j)
    if n_own == _N_SPHERE:
        apart = cdist(matrix[:, :3], matrix[:, :3]) * tiles.n_around / (2.0 * math.pi)
    white = np.diag(tiles.n.mean() / tiles.n)
    columns = np.column_stack([matrix, tiles.means])
    best, least = white, math.inf
    relief = [np.exp(-apart / length) for length in _LENGTHS]
    for correlation, share in [(relief[0], 0.0), *itertools.product(relief, _CORRELATED)]:
        model = (1.0 - share) * white + share * correlation
        root = np.linalg.cholesky(model)
        whitened = linalg.solve_triangular(root, columns, lower=True)
        diagonal = np.maximum(np.abs(np.diag(np.linalg.qr(whitened, mode="r"))), _LEAST_SCATTER_M)
        logs = np.log(diagonal)
        score = np.log(np.diag(root)).sum() + logs[:-1].sum() + free * logs[-1]
        if score < least:
            best, least = diagonal[-1] ** 2 / free * model, score
    weighted = matrix * tiles.n[:, None]
    inverse = np.linalg.pinv(matrix.T @ weighted, hermitian=True)
    return np.asarray(inverse @ weighted.T @ best @ weighted @ inverse)


def _sectors(
    tiles: _Means, least_rad: float, n_least: int = _SECTORS[0]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the sector (m,) of each tile, and its angle (m,) from the middle of the sector.

    Args:
        tiles: the tiles.
        least_rad: least angle of a sector.
        n_least: least number of sectors, if there are enough tiles.
    """
    # Positions around the axis, from the end of the longest gap.
    columns = np.unique(tiles.i)
    gaps = np.diff(np.append(columns, columns[0] + tiles.n_around))
    around = (tiles.i - columns[(int(np.argmax(gaps)) + 1) % len(columns)]) % tiles.n_around
    width_rad = 2.0 * math.pi / tiles.n_around
    n_around = int(around.max()) + 1
    count = int(n_around / max(_SECTOR_TILES, least_rad / width_rad))
    count = max(1, count, min(n_least, n_around // _SECTOR_TILES))
    count = min(count, _SECTORS[1])
    sector = around * count // n_around
    return sector, (around + 0.5 - (sector + 0.5) * n_around / count) * width_rad


def _variation(tiles: _Means, radius_m: float) -> tuple[float, float]:
    """Return the variation of the curvature along the arc, and its probability on a circle.

    Parabolas are fitted to the pieces of sectors. By an analysis of variance, the deviations of the
    sectors' curvatures from the circle's are compared with the scatter between the pieces of a
    sector, which differ in their positions along the axis.
    """
    sector, t = _sectors(tiles, _SECTOR_RAD)
    n_rows, n_sectors = int(tiles.j.max()) + 1, int(sector.max()) + 1
    n_pieces = max(2, n_rows // _PIECE_TILES)
    piece = sector * n_pieces + tiles.j * n_pieces // n_rows
    column = np.unique(piece * tiles.n_around + tiles.i)
    full = np.bincount(column // tiles.n_around) >= _SECTOR_TILES
    powers = np.column_stack([np.bincount(piece, tiles.n * t**power)[full] for power in range(5)])
    bulge = tiles.n * tiles.means / radius_m
    right = [np.bincount(piece, bulge * t**power)[full] for power in range(3)]
    normal = powers[:, np.add.outer(np.arange(3), np.arange(3))]
    parabolas = np.linalg.solve(normal, np.stack(right, axis=1)[:, :, None])
    curvatures = 1.0 - 2.0 * parabolas[:, 2, 0]
    of = np.flatnonzero(full) // n_pieces
    counts = np.bincount(of, minlength=n_sectors)
    means = np.bincount(of, curvatures, n_sectors) / np.maximum(counts, 1)
    n_between = np.count_nonzero(counts)
    n_within = len(of) - n_between
    if n_within < 1:
        # There are too few tiles for a test.
        return 0.0, 1.0
    within = float(((curvatures - means[of]) ** 2).sum()) / n_within
    between = float((counts * (means - 1.0) ** 2).sum()) / n_between
    chance = float(special.fdtrc(n_between, n_within, between / max(within, 1e-12)))
    # In sectors without tiles, nothing shows that the surface is curved.
    mean = n_between / n_sectors
    return math.sqrt(max(0.0, between - within) * n_between / len(of)) / mean, chance


def _extent(
    is_full: NDArray[np.bool_], counts: NDArray[np.float64], least_share: float
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
    rows = np.flatnonzero(is_full[is_open].sum(axis=0) >= least_share * is_open.sum())
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
