"""Preparation of a cloud for detection: blocks of points, a sample, a bounding box, and noise.

Detectors search only the sample; planes are then fitted to all points, and all points are labelled.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import MethodError
from orthoflow.geometry import basis_from_up
from orthoflow.geometry.rows import spread_index
from orthoflow.geometry.slabs import read_only
from orthoflow.products import PointCloud
from orthoflow_plugins.plane.kernels import (
    BlockedPoints,
    assign_points,
    each_part,
    in_blocks,
    piece_of,
)

_Label = TypeVar("_Label", np.int8, np.int16)

SAMPLE_POINTS: Final = 200_000
# Number of points from which the extent of a scene is computed.
_BOX_POINTS: Final = 20_000
_TAIL_SHARE: Final = 0.05
# Margin of the robust box on each side: this share of the size of the box, plus a constant.
_MARGIN_SHARE: Final = 0.02
MARGIN_M: Final = 2.5
# Share of the points that may be outside the box on each side, far below the minimum share of a
# plane. If no points were allowed outside, reflections in mirrors and stray points (0.4 % in
# simulated rooms) would make the box several times as large.
_OUTSIDE_SHARE: Final = 0.00125
# Maximum number of threads, so that the memory for plans and rasters, which each thread needs, is
# small compared with the cloud.
_PARTS_MOST: Final = 8
# A cloud that is thinner than this in two directions is a line or a point.
_THINNEST_M: Final = 1e-4

# Number of positions at which noise is measured, radii of the neighbourhoods, and minimum and
# maximum number of points in a neighbourhood.
NOISE_SEEDS: Final = 600
_RADII_M: Final = (0.05, 0.1, 0.2, 0.4, 0.8)
_NEAR_LEAST: Final = 12
_NEAR_MOST: Final = 400
# A neighbourhood is flat if its extent along its plane is at least this multiple of the extent
# across it.
_FLATNESS: Final = 5.0
# Minimum number of flat neighbourhoods for an estimate.
_FLAT_LEAST: Final = 20
_QUARTER: Final = 0.25


@dataclass(frozen=True, kw_only=True)
class Sample:
    """A sample of at most `SAMPLE_POINTS` points of a cloud.

    Attributes:
        index: (m,) int64 indices of the points in the cloud, ascending.
        offsets_m: (m, 3) float64 coordinates relative to the cloud's origin, metres.
        n_represented: number of points of the cloud per sample point.
    """

    index: NDArray[np.int64]
    offsets_m: NDArray[np.float64]
    n_represented: float


@dataclass(frozen=True, kw_only=True)
class PreparedCloud:
    """A cloud in the form that kernels need, with the plane of each point.

    Attributes:
        points: all points.
        sample: a sample of the points.
        basis: (3, 3) rows e1, e2, up (see `geometry.basis_from_up`).
        low_m: (3,) lower corner of the robust box, as offsets in the (e1, e2, up) frame.
        extent_m: (3,) size of the robust box.
        viewpoint_m: (3,) offset of the mean of the stations, or of the median of the points if no
            station is known.
        tolerance_m: maximum distance of points that belong to a plane.
        fit_tolerance_m: maximum distance of points used to fit a plane.
        noise_m: median standard deviation of the noise of single points; 0 if unknown.
        parts: number of parts that are processed in parallel.
        claims: (n,) int8 plane of each point, set by `search.label`; -1 if not yet assigned.
    """

    points: BlockedPoints
    sample: Sample
    basis: NDArray[np.float64]
    low_m: NDArray[np.float64]
    extent_m: NDArray[np.float64]
    viewpoint_m: NDArray[np.float64]
    tolerance_m: float
    fit_tolerance_m: float
    noise_m: float
    parts: int
    claims: NDArray[np.int8]

    @property
    def up(self) -> NDArray[np.float64]:
        """Unit vector (3,) upwards, in world axes."""
        return np.asarray(self.basis[2])

    @property
    def sample_claims(self) -> NDArray[np.int8]:
        """Planes (m,) int8 of the sample points; -1 if not yet assigned."""
        return self.claims[self.sample.index]

    def box_corners(self) -> NDArray[np.float64]:
        """Return the corners (8, 3) of the robust box as offsets in metres."""
        steps = np.array(list(itertools.product((0.0, 1.0), repeat=3)))
        return (self.low_m + steps * self.extent_m) @ self.basis

    def bounds_of(self, rectangles_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return bounds (..., 5) of slabs: the tolerance, and rectangles (..., 4) widened by it."""
        wider = rectangles_m + self.tolerance_m * np.array([-1.0, 1.0, -1.0, 1.0])
        reach = np.full((*wider.shape[:-1], 1), self.tolerance_m)
        return np.concatenate([reach, wider], axis=-1)

    def assign(self, slabs: NDArray[np.float64], bounds_m: NDArray[np.float64]) -> None:
        """Assign each point to the nearest of the slabs (k, 12) whose bounds (k, 5) contain it."""

        def claim(_part: int, piece: slice) -> None:
            assign_points(piece_of(self.points, piece), self.claims[piece], slabs, bounds_m)

        each_part(len(self.claims), self.parts, claim)

    def write_labels(self, names: NDArray[_Label], labels: NDArray[_Label]) -> None:
        """Write the labels (n,) of points, given the names (k + 1,) of planes and of no plane.

        Args:
            names: the label of each plane, and finally that of points on no plane, in the type of
                the labels.
            labels: output; may be the claims themselves.
        """
        import cv2

        # Use a table with an entry for each value of a byte, including -1, because indexing `names`
        # would convert the whole array to 64 bits.
        table = np.full(256, names[-1], dtype=names.dtype)
        table[: len(names) - 1] = names[:-1]

        def write(_part: int, piece: slice) -> None:
            if piece.stop > piece.start:
                cv2.LUT(self.claims[piece].view(np.uint8), table, np.asarray(labels[piece]))

        each_part(len(labels), self.parts, write)


def prepare(
    cloud: PointCloud,
    tolerance_m: float,
    fit_tolerance_m: float,
    *,
    parts: int,
    noise_m: float = 0.0,
    outside_share: float = _OUTSIDE_SHARE,
) -> PreparedCloud:
    """Sample a cloud and compute the boxes of its blocks; no point is assigned to a plane yet.

    Args:
        cloud: the cloud.
        tolerance_m: maximum distance of points that belong to a plane.
        fit_tolerance_m: maximum distance of points that are used to fit a plane; at most
            `tolerance_m`.
        parts: number of threads.
        noise_m: standard deviation of the noise of single points; 0 if unknown.
        outside_share: share of the points that may be outside the box on each side.

    Raises:
        ProductError: the cloud has fewer than three points, or coordinates that are not finite.
        MethodError: the points coincide or are collinear.
    """
    sample = draw_sample(cloud)
    centred = sample.offsets_m - sample.offsets_m.mean(axis=0)
    spread_m2 = np.linalg.eigvalsh(centred.T @ centred) / len(sample.index)
    if spread_m2[1] < _THINNEST_M**2:
        where = "coincide" if spread_m2[2] < _THINNEST_M**2 else "are collinear"
        raise MethodError(f"the {len(cloud)} points of the cloud {where}, so they define no plane")
    basis, parts = basis_from_up(cloud.up), max(1, min(parts, _PARTS_MOST))
    points = in_blocks(read_only(cloud.x, cloud.y, cloud.z), parts=parts)
    if not np.isfinite(points.boxes).all():
        cloud.require_points(3)
    viewpoint_m = np.asarray(np.median(sample.offsets_m, axis=0))
    if cloud.stations is not None and len(cloud.stations):
        viewpoint_m = np.asarray(cloud.stations.mean(axis=0) - cloud.origin)
    low_m, extent_m = robust_box(sample, basis, outside_share)
    return PreparedCloud(
        points=points,
        sample=sample,
        basis=basis,
        low_m=low_m,
        extent_m=extent_m,
        viewpoint_m=viewpoint_m,
        tolerance_m=tolerance_m,
        fit_tolerance_m=fit_tolerance_m,
        noise_m=noise_m,
        parts=parts,
        claims=np.full(len(cloud), -1, dtype=np.int8),
    )


def draw_sample(cloud: PointCloud) -> Sample:
    """Draw one point from each of `SAMPLE_POINTS` equal parts of a cloud (see `spread_index`).

    Raises:
        ProductError: the cloud has fewer than three points, or coordinates that are not finite.
    """
    if len(cloud) < 3:
        cloud.require_points(3)
    index = spread_index(len(cloud), min(SAMPLE_POINTS, len(cloud)))
    offsets_m = np.column_stack([cloud.x[index], cloud.y[index], cloud.z[index]]).astype(np.float64)
    if not np.isfinite(offsets_m).all():
        cloud.require_points(3)
    return Sample(index=index, offsets_m=offsets_m, n_represented=len(cloud) / len(index))


def thinned(cloud: PointCloud, every: int) -> PointCloud:
    """Return coordinates and scans of every n-th point, at least three, as in `draw_sample`."""
    if every == 1:
        return cloud
    index = spread_index(len(cloud), min(len(cloud), max(3, len(cloud) // every)))
    return replace(
        cloud,
        x=cloud.x[index],
        y=cloud.y[index],
        z=cloud.z[index],
        scan=None if cloud.scan is None else cloud.scan[index],
        intensity=None,
        rgb=None,
        row=None,
        column=None,
    )


def blocked(offsets_m: NDArray[np.float64]) -> BlockedPoints:
    """Return the points (m, 3) of a sample, divided into blocks."""
    offsets = read_only(*np.ascontiguousarray(offsets_m.T, dtype=np.float32))
    return in_blocks(offsets, parts=1)


def robust_box(
    sample: Sample, basis: NDArray[np.float64], outside_share: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lower corner (3,) and size (3,) of the box of a cloud, excluding gross outliers.

    Args:
        sample: points of the cloud.
        basis: (3, 3) rows e1, e2, up.
        outside_share: share of the points that may be outside the box on each side.
    """
    framed = sample.offsets_m[:: max(1, len(sample.index) // _BOX_POINTS)] @ basis.T
    low, high = np.quantile(framed, (_TAIL_SHARE, 1.0 - _TAIL_SHARE), axis=0)
    # The outermost points may be in a side room or stray; only points farther away than the size of
    # the scene are certainly stray. This size is the largest extent, because a single wall is thin
    # in one direction.
    reach_m = float((high - low).max())
    framed = framed[((framed >= low - reach_m) & (framed <= high + reach_m)).all(axis=1)]
    low, high = np.quantile(framed, (outside_share, 1.0 - outside_share), axis=0)
    margin = _MARGIN_SHARE * (high - low) + MARGIN_M
    return low - margin, high - low + 2.0 * margin


def measure_noise(points_m: NDArray[np.float64]) -> tuple[float, float] | None:
    """Measure the noise of a cloud on a sample (n, 3) of its points; None without flat parts.

    A plane is fitted to the points around a seed (principal components). Their scatter across the
    plane is noise if the neighbourhood is flat, which means that its extent along the plane is at
    least five times that across it. Small neighbourhoods show the noise of single points. Large
    neighbourhoods also show errors common to neighbouring points, as caused by a bent trajectory,
    stereo matching or misregistered scans. Large neighbourhoods contain relief, too, so the lower
    quartile is used.

    Returns:
        Standard deviations across the surfaces, in metres: of single points relative to their
        neighbours, and of points including errors common to all points within 0.8 m.
    """
    from scipy.spatial import cKDTree

    if len(points_m) < _NEAR_LEAST:
        return None
    tree = cKDTree(points_m)
    seeds = points_m[:: max(1, len(points_m) // NOISE_SEEDS)]
    single = np.full(len(seeds), np.nan)
    shared = np.full(len(seeds), np.nan)
    for radius_m in _RADII_M:
        is_last = radius_m == _RADII_M[-1]
        for k in np.flatnonzero(np.isnan(single) | is_last).tolist():
            near = tree.query_ball_point(seeds[k], radius_m)
            if len(near) < _NEAR_LEAST:
                continue
            across_m = _flat_scatter_m(points_m[near[:: max(1, len(near) // _NEAR_MOST)]])
            if np.isnan(single[k]):
                single[k] = across_m
            if is_last:
                shared[k] = across_m
    known, large = single[np.isfinite(single)], shared[np.isfinite(shared)]
    if len(known) < _FLAT_LEAST:
        return None
    single_m = float(np.median(known))
    shared_m = float(np.quantile(large, _QUARTER)) if len(large) >= _FLAT_LEAST else single_m
    return single_m, max(single_m, shared_m)


def _flat_scatter_m(points_m: NDArray[np.float64]) -> float:
    """Return the robust scatter of points (n, 3) across their plane; NaN if they are not flat.

    The scatter is 1.4826 times the median distance from the plane of principal components. A
    neighbourhood with a second surface or an edge is thicker, so it fails the test for flatness.
    """
    relative = points_m - points_m.sum(axis=0) / len(points_m)
    values, axes = np.linalg.eigh(relative.T @ relative / (len(points_m) - 3))
    if values[1] < _FLATNESS**2 * values[0]:
        return math.nan
    across_m = relative @ axes[:, 0]
    return 1.4826 * _median(np.abs(across_m - _median(across_m)))


def _median(values: NDArray[np.float64]) -> float:
    # As np.median, which takes several times longer for some hundred values.
    ordered = np.sort(values)
    return float(0.5 * (ordered[(len(values) - 1) // 2] + ordered[len(values) // 2]))
