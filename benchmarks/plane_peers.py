"""Find the main wall with other programs; programs that are missing are skipped with a message."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float32]
CELL_M, TOLERANCE_M = 0.02, 0.05
# Line transforms get this share of the occupied plan cells, the densest ones. With all cells, they
# would find floor and ceiling everywhere, and no wall.
DENSEST_SHARE = 0.03


@dataclass(frozen=True, kw_only=True)
class PeerPlane:
    """The first plane found by another program.

    Attributes:
        seconds: time without loading.
        normal: (3,) unit vector.
        offset_m: offset of the plane.
        n_planes: number of planes found in that time.
    """

    seconds: float
    normal: NDArray[np.float64]
    offset_m: float
    n_planes: int


@dataclass(frozen=True, kw_only=True)
class Peer:
    """Another program.

    Attributes:
        name: name of the program and its call.
        every: the program gets every n-th point.
        run: function that finds the first plane in (n, 3) points, or the plane nearest to the wall.
    """

    name: str
    every: int
    run: Callable[[Points, NDArray[np.float64]], PeerPlane]


def _open3d_ransac(points: Points, _wall: NDArray[np.float64]) -> PeerPlane:
    from orthoflow_plugins.plane.comparators import load_open3d

    open3d = load_open3d("the benchmark")
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(np.float64)))
    start = time.perf_counter()
    model, _ = cloud.segment_plane(TOLERANCE_M, 3, 1000)
    return _plane(time.perf_counter() - start, np.array(model[:3]), -float(model[3]), 1)


def _open3d_patches(points: Points, wall: NDArray[np.float64]) -> PeerPlane:
    from orthoflow_plugins.plane.comparators import load_open3d

    open3d = load_open3d("the benchmark")
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(np.float64)))
    start = time.perf_counter()
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(30))
    patches = cloud.detect_planar_patches()
    seconds = time.perf_counter() - start
    planes = [(np.array(patch.R)[:, 2], np.array(patch.center)) for patch in patches]
    normal, centre = min(
        planes, key=lambda p: abs(abs(p[0] @ wall[:3]) - 1.0) + abs(p[1] @ wall[:3] - wall[3])
    )
    return _plane(seconds, normal, float(normal @ centre), len(planes))


def _densest(points: Points) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Return the densest plan cells as an image of 0 and 255, and the position of its corner."""
    low, high = np.percentile(points[:: max(1, len(points) // 100_000), :2], (0.5, 99.5), axis=0)
    places = ((points[:, :2] - low.astype(np.float32)) * np.float32(1.0 / CELL_M)).astype(np.int32)
    shape = np.ceil((high - low) / CELL_M).astype(int)
    inside = ((places >= 0) & (places < shape)).all(axis=1)
    flat = places[inside, 0] * np.int32(shape[1]) + places[inside, 1]
    counts = np.bincount(flat, minlength=int(shape.prod())).reshape(shape)
    limit = np.quantile(counts[counts > 0], 1.0 - DENSEST_SHARE)
    return np.where(counts >= limit, np.uint8(255), np.uint8(0)).T.copy(), low


def _line(seconds: float, angle: float, distance: float, low: NDArray[np.float64]) -> PeerPlane:
    normal = np.array([math.cos(angle), math.sin(angle), 0.0])
    offset_m = CELL_M * (distance + 0.5 * (normal[0] + normal[1])) + float(normal[:2] @ low)
    return _plane(seconds, normal, offset_m, 1)


def _opencv_lines(points: Points, _wall: NDArray[np.float64]) -> PeerPlane:
    import cv2

    start = time.perf_counter()
    image, low = _densest(points)
    lines = cv2.HoughLines(image, 1.0, math.pi / 180.0, 50)
    distance, angle = np.asarray(lines).reshape(-1, 2)[0]
    return _line(time.perf_counter() - start, float(angle), float(distance), low)


def _skimage_lines(points: Points, _wall: NDArray[np.float64]) -> PeerPlane:
    from skimage.transform import hough_line

    start = time.perf_counter()
    image, low = _densest(points)
    votes, angles, distances = hough_line(image > 0, np.radians(np.arange(-90.0, 90.0)))
    row, column = np.unravel_index(int(votes.argmax()), votes.shape)
    return _line(time.perf_counter() - start, float(angles[column]), float(distances[row]), low)


def _skimage_ransac(points: Points, _wall: NDArray[np.float64]) -> PeerPlane:
    from skimage.measure import LineModelND, ransac

    plan = points[:, :2].astype(np.float64)
    start = time.perf_counter()
    model, _ = ransac(plan, LineModelND, 2, TOLERANCE_M, max_trials=100, rng=0)
    seconds = time.perf_counter() - start
    origin, direction = model.origin, model.direction
    normal = np.array([direction[1], -direction[0], 0.0])
    return _plane(seconds, normal, float(normal[:2] @ origin), 1)


def _pyransac3d(points: Points, _wall: NDArray[np.float64]) -> PeerPlane:
    import pyransac3d

    doubles = points.astype(np.float64)
    start = time.perf_counter()
    model, _ = pyransac3d.Plane().fit(doubles, TOLERANCE_M, maxIteration=200)
    seconds = time.perf_counter() - start
    return _plane(seconds, np.array(model[:3]), -float(model[3]), 1)


def _plane(seconds: float, normal: NDArray[np.float64], offset_m: float, count: int) -> PeerPlane:
    length = float(np.linalg.norm(normal))
    return PeerPlane(
        seconds=seconds, normal=normal / length, offset_m=offset_m / length, n_planes=count
    )


PEERS = (
    Peer(name="OpenCV HoughLines, densest 3 % of cells", every=1, run=_opencv_lines),
    Peer(name="scikit-image hough_line, likewise", every=20, run=_skimage_lines),
    Peer(name="Open3D segment_plane, 1000 hypotheses", every=20, run=_open3d_ransac),
    Peer(name="Open3D detect_planar_patches", every=20, run=_open3d_patches),
    Peer(name="pyransac3d, 200 hypotheses", every=20, run=_pyransac3d),
    Peer(name="scikit-image ransac, line in plan, 100 trials", every=20, run=_skimage_ransac),
)


def measured(peer: Peer, points: Points, wall: NDArray[np.float64]) -> PeerPlane | str:
    """Run a program on every n-th point; return its plane, or the reason why it cannot run.

    Args:
        peer: the program.
        points: (n, 3) all points.
        wall: (4,) true normal and offset of the main wall.
    """
    try:
        return peer.run(np.ascontiguousarray(points[:: peer.every]), wall)
    except ImportError as error:
        return f"not measured: {error}"
    except Exception as error:  # noqa: BLE001 - foreign programs fail in ways of their own
        return f"failed: {error}"
