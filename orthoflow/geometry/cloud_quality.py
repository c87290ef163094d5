"""Quality of a cloud as read: thickness, point spacing, and misalignment of scans."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.robust import median_deviation


def scan_step_m(count: NDArray[np.uint32], *, gsd_m: float) -> float:
    """Estimate the point spacing on a wall from the numbers of points in the cells.

    Groups of 2 x 2 cells are merged until the blocks that contain points contain at least four on
    average. Then hardly any block on a scanned surface is empty by chance, so the total area of the
    blocks with points is the scanned area.

    Args:
        count: (rows, cols) number of points per cell.
        gsd_m: cell size in metres.

    Returns:
        Square root of the area per point, metres; 0 if there are no points.
    """
    # Sums do not exceed the number of points, which fits into 32 bits.
    blocks, side_m = count, gsd_m
    while blocks.any():
        per_block = blocks.sum(dtype=np.int64) / np.count_nonzero(blocks)
        if per_block >= 4.0 or blocks.size == 1:
            return float(side_m / np.sqrt(per_block))
        blocks = _joined(blocks)
        side_m *= 2.0
    return 0.0


def _joined(blocks: NDArray[np.uint32]) -> NDArray[np.uint32]:
    rows, columns = blocks.shape
    sums = np.zeros((-(-rows // 2), -(-columns // 2)), dtype=np.uint32)
    for first_row in (0, 1):
        for first_column in (0, 1):
            quarter = blocks[first_row::2, first_column::2]
            sums[: quarter.shape[0], : quarter.shape[1]] += quarter
    return sums


# Sides of the surface pieces in metres. If pieces with one side contain too few points, the next
# larger side is used.
_SIDES_M: Final = (0.1, 0.3, 1.0)
_PIECES_MOST: Final = 300
_PIECES_LEAST: Final = 20
# Minimum number of points of one scan in a piece, and maximum number of points used.
_POINTS_LEAST: Final = 30
_POINTS_MOST: Final = 4000
# Number of points processed together, small enough for the processor's cache.
_AT_ONCE: Final = 1 << 16
_HASH_BITS: Final = 20
_CUBE_BITS: Final = 21
MAX_GATHERED: Final = 1_500_000
# Maximum number of points assigned to cubes. For larger clouds, only some layers of cubes are used.
MAX_LOOKED_AT: Final = 4_000_000
# Odd factors with well distributed bits, so that the upper bits of a product depend on all bits of
# the other factor.
_PRIMES: Final = (np.uint32(2_654_435_761), np.uint32(2_246_822_519), np.uint32(3_266_489_917))
# A piece is a single surface if at least this share of its points is near its plane, if the scatter
# of the points is below a given share of the side of the piece, and if they extend over the piece
# in both directions.
_SURFACE_SHARE: Final = 0.85
_SCATTER_SIDES: Final = 0.1
_COVER_SIDES: Final = 0.15
_NEAR_SIGMAS: Final = 4.0
# Standard deviation of the median of n values, relative to that of one value divided by sqrt(n).
_MEDIAN_SIGMA: Final = 1.2533
_SURE_SIGMAS: Final = 3.0
# Two scans agree if their distance is below this limit, even if it exceeds their scatter.
_AGREE_M: Final = 0.001
# Maximum tilt of horizontal and vertical pieces; noise tilts the smallest pieces by 2 degrees.
_SQUARE_DEG: Final = 5.0
# If the share of horizontal pieces is smaller, the given up direction is wrong, since nearly every
# building has horizontal surfaces.
_LEVEL_NONE: Final = 0.03
_LEVEL_PLAIN: Final = 0.15
_SQUARE_PLAIN: Final = 0.8
_SQUARER_BY: Final = 0.15


@dataclass(frozen=True, kw_only=True)
class CloudQuality:
    """Medians over small pieces of surfaces.

    Attributes:
        side_m: side of the pieces.
        n_pieces: number of measured pieces.
        sigma_m: thickness, the robust standard deviation of the distances of a scan's points from
            the surface.
        width_95_m: width of the range that contains 95 % of the distances from the surface.
        scan_step_m: distance between a point and the nearest point of the same scan.
        scans_apart_m: distance between scans, perpendicular to a piece that both contain; None if
            fewer than 20 pieces are in more than one scan.
        sigma_apart_m: standard deviation of `scans_apart_m` due to the scatter of points.
        normals: (n_pieces, 3) unit normals of the pieces, with arbitrary sign.
    """

    side_m: float
    n_pieces: int
    sigma_m: float
    width_95_m: float
    scan_step_m: float
    scans_apart_m: float | None = None
    sigma_apart_m: float = 0.0
    normals: NDArray[np.float64]

    def square_shares(self, up: NDArray[np.float64]) -> tuple[float, float]:
        """Return the share of horizontal pieces, and the share of horizontal or vertical pieces.

        Args:
            up: (3,) unit vector of the given up direction.
        """
        cosines = np.abs(self.normals @ up)
        is_level = cosines > np.cos(np.radians(_SQUARE_DEG))
        is_upright = cosines < np.sin(np.radians(_SQUARE_DEG))
        return float(is_level.mean()), float((is_level | is_upright).mean())

    def plainly_up(self, up: NDArray[np.float64]) -> int | None:
        """Return the axis (0, 1, 2) that the surfaces show to be up; None if `up` may be right.

        `up` is wrong if it makes no surface horizontal and many surfaces inclined, whereas one of
        the axes makes all surfaces horizontal or vertical, and some of them horizontal. The result
        is None for slopes, single walls, and rooms whose walls are parallel to the axes, because
        their surfaces do not show which axis is up.
        """
        level, square = self.square_shares(up)
        for axis, direction in enumerate(np.eye(3)):
            other_level, other_square = self.square_shares(direction)
            is_plain = other_level >= _LEVEL_PLAIN and other_square >= _SQUARE_PLAIN
            if level < _LEVEL_NONE and is_plain and other_square - square >= _SQUARER_BY:
                return axis
        return None

    @property
    def is_thick(self) -> bool:
        """Whether the thickness of the cloud exceeds its point spacing."""
        return self.sigma_m > self.scan_step_m

    @property
    def disagrees(self) -> bool:
        """Whether scans are farther apart than their scatter and chance can explain."""
        if self.scans_apart_m is None:
            return False
        limit_m = max(self.sigma_m, _AGREE_M, _SURE_SIGMAS * self.sigma_apart_m)
        return self.scans_apart_m > limit_m


@dataclass(frozen=True, kw_only=True)
class _Piece:
    """Measurements of one piece; `apart_m` is NaN if only one scan contains it."""

    sigma_m: float
    width_95_m: float
    scan_step_m: float
    apart_m: float
    sigma_apart_m: float
    normal: NDArray[np.float64]


def judge_quality(
    offsets: Sequence[NDArray[np.float32]], scan: NDArray[np.uint16] | None
) -> CloudQuality | None:
    """Measure a cloud on a few hundred pieces of surfaces distributed over it.

    Args:
        offsets: three arrays (n,) of coordinates in metres.
        scan: (n,) scan of each point; None if there is only one scan.

    Returns:
        The medians; None if too few pieces contain a surface.
    """
    for side_m in _SIDES_M:
        pieces = [
            piece
            for chosen in _indices_of_pieces(offsets, side_m)
            if (piece := _measured(_points(offsets, chosen), _scans(scan, chosen), side_m))
        ]
        if len(pieces) >= _PIECES_LEAST:
            return _summed_up(pieces, side_m)
    return None


def _indices_of_pieces(
    offsets: Sequence[NDArray[np.float32]], side_m: float
) -> Iterator[NDArray[np.intp]]:
    n_points = len(offsets[0])
    lows = tuple(axis.min() for axis in offsets)
    one_of = -(-n_points // MAX_LOOKED_AT)
    seeds = np.unique(np.linspace(0, n_points - 1, one_of * 2 * _PIECES_MOST).astype(np.intp))
    cubes = _cubes(offsets, lows, seeds, side_m)
    along = max(range(3), key=lambda axis: len(np.unique(cubes[axis])))
    slabs = _hash(cubes[along : along + 1])
    is_slab, is_asked = np.zeros((2, 1 << _HASH_BITS), dtype=np.bool_)
    is_slab[np.unique(slabs)[::one_of]] = True
    hashes = np.unique(_hash(cubes)[is_slab[slabs]])
    is_asked[hashes[:: max(1, -(-len(hashes) // _PIECES_MOST))]] = True
    found: list[NDArray[np.intp]] = []
    for start in range(0, n_points, _AT_ONCE):
        part = slice(start, min(start + _AT_ONCE, n_points))
        slabs = _hash(_cubes(offsets, lows, part, side_m, axes=(along,)))
        chosen = start + np.flatnonzero(is_slab[slabs])
        found.append(chosen[is_asked[_hash(_cubes(offsets, lows, chosen, side_m))]])
    indices = np.concatenate(found)
    # Cubes with the same hash are distinguished by their numbers.
    x, y, z = (axis.astype(np.int64) for axis in _cubes(offsets, lows, indices, side_m))
    groups = x + (y << _CUBE_BITS) + (z << 2 * _CUBE_BITS)
    known = np.unique(groups)
    # In a dense cloud, fewer pieces suffice.
    known = known[:: max(1, len(indices) // MAX_GATHERED)]
    is_known = np.isin(groups, known)
    indices, groups = indices[is_known], groups[is_known]
    order = np.argsort(groups, kind="stable")
    for group in np.split(order, np.flatnonzero(np.diff(groups[order])) + 1):
        if len(group) >= _POINTS_LEAST:
            yield indices[group]


def _cubes(
    offsets: Sequence[NDArray[np.float32]],
    lows: tuple[np.float32, ...],
    chosen: NDArray[np.intp] | slice,
    side_m: float,
    *,
    axes: Sequence[int] = (0, 1, 2),
) -> list[NDArray[np.uint32]]:
    return [
        ((offsets[axis][chosen] - lows[axis]) * np.float32(1.0 / side_m)).astype(np.uint32)
        for axis in axes
    ]


def _hash(cubes: Sequence[NDArray[np.uint32]]) -> NDArray[np.uint32]:
    """Return 20-bit hashes of cubes, given their indices along one to three axes."""
    mixed = reduce(
        np.bitwise_xor, (axis * prime for axis, prime in zip(cubes, _PRIMES, strict=False))
    )
    return mixed >> np.uint32(32 - _HASH_BITS)


def _points(
    offsets: Sequence[NDArray[np.float32]], chosen: NDArray[np.intp]
) -> NDArray[np.float64]:
    return np.column_stack([axis[chosen] for axis in offsets]).astype(np.float64)


def _scans(scan: NDArray[np.uint16] | None, chosen: NDArray[np.intp]) -> NDArray[np.uint16]:
    return np.zeros(len(chosen), dtype=np.uint16) if scan is None else np.asarray(scan[chosen])


def _measured(
    points: NDArray[np.float64], scan: NDArray[np.uint16], side_m: float
) -> _Piece | None:
    numbers, counts = np.unique(scan, return_counts=True)
    enough = numbers[counts >= _POINTS_LEAST]
    if not len(enough):
        return None
    kept = np.concatenate([np.flatnonzero(scan == one)[:_POINTS_MOST] for one in enough])
    points, scan = points[kept], scan[kept]
    frame = _frame(points)
    across = (points - points.mean(axis=0)) @ frame[2]
    main = enough[np.argmax([np.count_nonzero(scan == one) for one in enough])]
    is_main = scan == main
    middles = {one: float(np.median(across[scan == one])) for one in enough}
    of_main = across[is_main] - middles[main]
    sigma_m = median_deviation(of_main, 0.0)
    near = np.abs(of_main) <= _NEAR_SIGMAS * max(sigma_m, 1e-6)
    on_surface = (points[is_main] @ frame[:2].T)[near]
    if near.mean() < _SURFACE_SHARE or sigma_m > _SCATTER_SIDES * side_m:
        return None
    if on_surface.std(axis=0).min() < _COVER_SIDES * side_m:
        return None
    step_m = _step_m(on_surface)
    if step_m is None:
        return None
    other_m, other_sigma_m = _farthest(across, scan, middles, main)
    return _Piece(
        sigma_m=sigma_m,
        width_95_m=float(np.diff(np.percentile(of_main, [2.5, 97.5]))[0]),
        scan_step_m=step_m,
        apart_m=other_m,
        sigma_apart_m=other_sigma_m,
        normal=frame[2],
    )


def _frame(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return two axes of the plane that fits most of the points (n, 3), and its normal, as rows."""
    kept = np.ones(len(points), dtype=np.bool_)
    axes = np.eye(3)
    for _ in range(3):
        chosen = points[kept]
        centre = chosen.mean(axis=0)
        axes = np.linalg.svd((chosen - centre).T @ (chosen - centre))[2]
        away = (points - centre) @ axes[2]
        away -= np.median(away)
        kept = np.abs(away) <= 2.5 * max(median_deviation(away, 0.0), 1e-6)
    return np.asarray(axes)


def _farthest(
    across: NDArray[np.float64],
    scan: NDArray[np.uint16],
    middles: dict[np.uint16, float],
    main: np.uint16,
) -> tuple[float, float]:
    """Return the largest distance between a scan and the main scan, and its standard deviation."""
    others = [one for one in middles if one != main]
    if not others:
        return np.nan, np.nan
    farthest = max(others, key=lambda one: abs(middles[one] - middles[main]))
    variances = []
    for one in (main, farthest):
        own = across[scan == one] - middles[one]
        variances.append((_MEDIAN_SIGMA * median_deviation(own, 0.0)) ** 2 / len(own))
    return abs(middles[farthest] - middles[main]), float(np.sqrt(sum(variances)))


def _step_m(on_surface: NDArray[np.float64]) -> float | None:
    """Return the median distance of points (n, 2) to their nearest point; None if all coincide."""
    from scipy.spatial import cKDTree  # noqa: PLC0415 - loads slowly, and here alone

    distances, _ = cKDTree(on_surface).query(on_surface, k=2)
    apart = np.asarray(distances)[:, 1]
    apart = apart[apart > 0.0]
    return float(np.median(apart)) if len(apart) else None


def _summed_up(pieces: Sequence[_Piece], side_m: float) -> CloudQuality:
    shared = [piece for piece in pieces if np.isfinite(piece.apart_m)]
    is_shared = len(shared) >= _PIECES_LEAST

    def median(values: list[float]) -> float:
        return float(np.median(values))

    return CloudQuality(
        side_m=side_m,
        n_pieces=len(pieces),
        sigma_m=median([piece.sigma_m for piece in pieces]),
        width_95_m=median([piece.width_95_m for piece in pieces]),
        scan_step_m=median([piece.scan_step_m for piece in pieces]),
        scans_apart_m=median([piece.apart_m for piece in shared]) if is_shared else None,
        sigma_apart_m=median([piece.sigma_apart_m for piece in shared]) if is_shared else 0.0,
        normals=np.array([piece.normal for piece in pieces]),
    )
