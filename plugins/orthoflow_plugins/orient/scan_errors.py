"""Errors of a cloud due to the registration of its scans, measured where scans overlap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.rows import group_sums, spread_index

_MAX_POINTS: Final = 500_000
# Side of the cubes into which the cloud is divided. It is doubled until most points are in cubes
# with at least this number of points.
_SIDE_M: Final = 0.2
_POINTS_PER_CUBE: Final = 60
# Maximum number of cubes along an axis, so that 64 bits suffice to number them.
_MAX_SIDES: Final = 2**20
# Minimum number of points of one scan in a cube. More points than the second number do not make
# their mean more accurate, because neighbouring points have common errors.
_LEAST: Final = 8
_INDEPENDENT: Final = 100
# A surface extends over at least this share of a cube in both directions (standard deviation).
_COVER_SIDES: Final = 0.1
# Lower limit of the thickness of a surface, to avoid a division by zero.
_MIN_THICKNESS_M: Final = 1e-5
_SOFT_LIMIT: Final = 2.0
_ROUNDS: Final = 20
_CONVERGED: Final = 0.01
# Patterns of uncertain motions are omitted if their variance is below this share of that of an
# unknown motion.
_KEPT_VARIANCE: Final = 1e-3
MAX_SCANS: Final = 100
"""The motions of more scans would take minutes."""
# Translation and rotation of a scan.
_MOTION: Final = 6


@dataclass(frozen=True, kw_only=True)
class ScanErrors:
    """Motions of the scans of a cloud relative to their mean.

    Attributes:
        origin: (3,) world coordinates of the point about which scans rotate, metres.
        extent_m: distance by which rotations are multiplied, so that all motions are in metres.
        centres: (c, 3) centres of the cubes that contain points, metres from `origin`.
        shares: (c, k) share of each scan in the points of a cube.
        motions: (k, 6, q) translations and rotations of the scans, metres: the most probable ones,
            followed by patterns with the size of their standard deviation.
        sigma_m: (2,) standard deviations of a coordinate of the translations and of the rotations.
    """

    origin: NDArray[np.float64]
    extent_m: float
    centres: NDArray[np.float64]
    shares: NDArray[np.float64]
    motions: NDArray[np.float64]
    sigma_m: NDArray[np.float64]

    def at(self, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the errors (n, 3, q) of points (n, 3), as in `SeenPoints.scan_errors`."""
        from scipy.spatial import cKDTree

        points = points_world - self.origin
        cubes = cKDTree(self.centres).query(points)[1]
        # A match finds the mean of the scans, the scan with the most points, or something between
        # them. The standard deviation of this uniform distribution is another pattern.
        mean = self.shares[cubes]
        most = np.eye(mean.shape[1])[mean.argmax(axis=1)]
        motions = np.einsum("ns,smq->nmq", 0.5 * (mean + most), self.motions)
        between = np.einsum("ns,smq->nmq", (most - mean) / 12.0**0.5, self.motions[:, :, :1])
        motions = np.concatenate([motions, between], axis=2)
        turned = np.cross(motions[:, 3:], points[:, :, None] / self.extent_m, axis=1)
        return np.asarray(motions[:, :3] + turned)


def measured_scan_errors(
    offsets: Sequence[NDArray[np.float32]],
    scan: NDArray[np.uint16],
    origin: NDArray[np.float64],
    stations: NDArray[np.float64] | None = None,
) -> ScanErrors | None:
    """Estimate small motions of the scans from the surfaces that several of them contain.

    Each scan has a rigid motion. Points of two scans on one surface show the difference of their
    motions along its normal. Motions that no surface shows, such as those along the only wall, have
    a normal distribution, whose variance is estimated from the others (MacKay 1992,
    doi:10.1162/neco.1992.4.3.415).

    Args:
        offsets: three arrays (n,) of coordinates in metres from `origin`.
        scan: (n,) scan of each point.
        origin: (3,) world coordinates in metres.
        stations: (s, 3) station of each scan. Scans from the same station have the same motion.

    Returns:
        The motions; None if no surface is in several scans, or if there are more than 100 scans.
    """
    chosen = spread_index(len(scan), min(len(scan), _MAX_POINTS))
    points = np.column_stack([axis[chosen] for axis in offsets]).astype(np.float64)
    own = scan[chosen].astype(np.intp)
    if stations is not None and np.ptp(stations, axis=0).any():
        # Such scans, like a panorama and details, are registered together.
        own = np.unique(stations, axis=0, return_inverse=True)[1].ravel()[own]
    numbers, of_point = np.unique(own, return_inverse=True)
    n_scans = len(numbers)
    if not 2 <= n_scans <= MAX_SCANS:
        return None
    middle = points.mean(axis=0)
    points -= middle
    side_m = max(_SIDE_M, float(np.ptp(points, axis=0).max()) / _MAX_SIDES)
    while True:
        cubes, cube_of, counts = np.unique(
            _numbered(points, side_m), return_inverse=True, return_counts=True
        )
        if np.median(counts[cube_of]) >= _POINTS_PER_CUBE or len(cubes) == 1:
            break
        side_m *= 2.0
    means = group_sums(points, cube_of) / counts[:, None]
    cells, cell_of, counts = np.unique(
        cube_of * n_scans + of_point, return_inverse=True, return_counts=True
    )
    cube, own = np.divmod(cells, n_scans)
    shares = np.zeros((len(cubes), n_scans))
    shares[cube, own] = counts
    pieces = _Pieces.of(points - means[cube_of], (cell_of, cube, own, counts), means, side_m)
    if pieces is None:
        return None
    extent_m = float(np.sqrt((pieces.places**2).sum(axis=1).mean()))
    motions, sigma_m = _motions(pieces, n_scans, extent_m)
    return ScanErrors(
        origin=origin + middle,
        extent_m=extent_m,
        centres=means,
        shares=shares / shares.sum(axis=1, keepdims=True),
        motions=motions,
        sigma_m=sigma_m,
    )


def _numbered(points: NDArray[np.float64], side_m: float) -> NDArray[np.int64]:
    cubes = np.floor((points - points.min(axis=0)) / side_m).astype(np.int64)
    return np.asarray(np.ravel_multi_index(tuple(cubes.T), tuple(cubes.max(axis=0) + 1)))


@dataclass(frozen=True, kw_only=True)
class _Pieces:
    """The m parts of surface pieces that belong to one scan.

    Attributes:
        cube: (m,) cube of the piece.
        scan: (m,) scan of the part.
        along: (m,) position along the normal, metres.
        places: (m, 3) middle of the piece, metres.
        axes: (m, 3, 3) unit normal of the piece, and the two directions in the piece, multiplied by
            the standard deviations of the rotation of the normal towards them.
        sigmas_m: (m,) standard deviation of `along`, except for a common factor.
    """

    cube: NDArray[np.intp]
    scan: NDArray[np.intp]
    along: NDArray[np.float64]
    places: NDArray[np.float64]
    axes: NDArray[np.float64]
    sigmas_m: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        local: NDArray[np.float64],
        cells: tuple[NDArray[np.intp], ...],
        centres: NDArray[np.float64],
        side_m: float,
    ) -> _Pieces | None:
        """Find pieces of surfaces in the cubes that several scans contain; None if there are none.

        Args:
            local: (n, 3) points, relative to the mean of their cube.
            cells: cell (a cube and a scan) of each point; cube, scan and number of points of each
                cell.
            centres: (c, 3) mean of the points of each cube.
            side_m: side of the cubes.
        """
        cell_of, cube, scan, counts = cells
        first, second = np.triu_indices(3)
        means = group_sums(local, cell_of) / counts[:, None]
        squares = np.zeros((len(cube), 3, 3))
        squares[:, first, second] = group_sums(local[:, first] * local[:, second], cell_of)
        squares[:, second, first] = squares[:, first, second]
        squares -= counts[:, None, None] * means[:, :, None] * means[:, None]
        kept = counts >= _LEAST
        n_scans, n_points = np.bincount(cube, kept), np.bincount(cube, kept * (counts - 1.0))
        # A displacement of the scans does not change the scatter within each of them.
        within = group_sums(squares[kept].reshape(-1, 9), cube[kept], len(centres))
        within = within.reshape(-1, 3, 3)
        values, axes = np.linalg.eigh(within / np.maximum(n_points, 1.0)[:, None, None])
        is_surface = (n_scans > 1) & (
            np.sqrt(np.maximum(values[:, 1], 0.0)) > _COVER_SIDES * side_m
        )
        kept &= is_surface[cube]
        if not kept.any():
            return None
        thickness_m = np.maximum(np.sqrt(np.maximum(values[:, 0], 0.0)), _MIN_THICKNESS_M)
        # Standard deviation of the slope of a line through n points.
        turns = thickness_m / np.sqrt(np.maximum(n_points, 1.0) * values.T[1:].clip(1e-12))
        axes = (
            axes.transpose(0, 2, 1)
            * np.stack([np.ones_like(thickness_m), *turns], axis=1)[:, :, None]
        )
        cube = cube[kept]
        return cls(
            cube=cube,
            scan=scan[kept],
            along=np.einsum("md,md->m", axes[cube, 0], means[kept]),
            places=centres[cube],
            axes=axes[cube],
            sigmas_m=thickness_m[cube] / np.sqrt(np.minimum(counts[kept], _INDEPENDENT)),
        )


def _motions(
    pieces: _Pieces, n_scans: int, extent_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return `ScanErrors.motions` and `ScanErrors.sigma_m`."""
    from scipy import linalg, sparse

    n, p = len(pieces.cube), _MOTION * n_scans
    columns = _MOTION * pieces.scan[:, None] + np.arange(_MOTION)
    index = np.repeat(np.arange(n), _MOTION), columns.ravel()
    designs: list[Any] = []
    for axis in pieces.axes.transpose(1, 0, 2):
        values = np.hstack([axis, np.cross(pieces.places, axis) / extent_m])
        designs.append(sparse.csr_matrix((values.ravel(), index), shape=(n, p)))
    _, of_piece = np.unique(pieces.cube, return_inverse=True)
    rows = of_piece, np.arange(n)
    n_pieces = of_piece.max() + 1
    is_translation = np.arange(p) % _MOTION < _MOTION // 2
    weights, robust = pieces.sigmas_m**-2.0, np.ones(n)
    variances, motion = np.full(2, 1e-4), np.zeros(p)
    for _ in range(_ROUNDS):
        # The position of each piece is unknown, so weighted means are subtracted.
        weight = weights * robust
        roots = 1.0 / np.sqrt(np.bincount(of_piece, weight))
        mean: Any = sparse.csr_matrix((weight * roots[of_piece], rows), shape=(n_pieces, n))
        residuals = pieces.along - designs[0] @ motion
        residuals -= (roots * (mean @ residuals))[of_piece]
        factor = max(float((weight * residuals**2).sum()) / max(n - n_pieces - p, 1), 1e-12)
        normalised = np.sqrt(weights / factor) * np.abs(residuals)
        normal, *by_noise = (
            (each.T @ sparse.diags(weight) @ each - (part := mean @ each).T @ part).toarray()
            / factor
            for each in designs
        )
        along = weight * pieces.along - mean.T @ (mean @ pieces.along)
        robust = np.minimum(1.0, _SOFT_LIMIT / np.maximum(normalised, 1e-12))
        prior = np.where(is_translation, 1.0 / variances[0], 1.0 / variances[1])
        # Random rotations of the normals only seem to show motions along the surfaces.
        shares, axes = linalg.eigh(sum(by_noise), normal + np.diag(prior))
        of_prior = prior @ axes**2
        real = np.maximum(1.0 - of_prior - shares, 0.0)
        damped = real / np.maximum(1.0 - of_prior, 1e-12) / (of_prior + real)
        motion = axes @ (damped * (axes.T @ (designs[0].T @ along)) / factor)
        covariance = (axes / (of_prior + real)) @ axes.T
        determined = 1.0 - prior * np.diag(covariance)
        before = variances
        variances = np.array(
            [
                max(float((motion[own] ** 2).sum()) / max(determined[own].sum(), 1e-6), 1e-12)
                for own in (is_translation, ~is_translation)
            ]
        )
        if np.abs(variances - before).max() < _CONVERGED * variances.max():
            break
    # A motion of the whole cloud is no error.
    relative = np.kron(np.eye(n_scans) - 1.0 / n_scans, np.eye(_MOTION))
    sizes, patterns = np.linalg.eigh(relative @ covariance @ relative)
    kept = sizes > _KEPT_VARIANCE * variances.max()
    motions = np.column_stack([relative @ motion, patterns[:, kept] * np.sqrt(sizes[kept])])
    return motions.reshape(n_scans, _MOTION, -1), np.sqrt(variances)
