"""Compiled fits of planes: the flattest plane of moments, and a robust one to points."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import compiled, kernel_part

# What a fit may change: everything, a normal kept across up, or one kept along up.
FREE: Final = 0
VERTICAL: Final = 1
LEVEL: Final = 2

_STEPS_MOST: Final = 20
# Points within so many tolerances of a plane are kept while it is fitted to some of them.
_REACH: Final = 2.0
# A fit has settled when a point ten metres away moves by less than this share of the tolerance.
_SETTLED_SHARE: Final = 5e-4
# Points nearer to a line than this (root mean square) do not say how the plane lies about it.
_LINE_WIDTH_M: Final = 1e-4


@compiled
def flattest(sums: NDArray[np.float64], plane: NDArray[np.float64]) -> None:
    """Set (9,) plane to normal, middle, and the variances along the three principal axes.

    The eigenvalues of a symmetric 3 x 3 matrix in closed form, because the library's solver takes
    a hundred times as long for so small a one.

    Args:
        sums: (10,) number of points, sums of a, b, c, and of aa, ab, ac, bb, bc, cc.
        plane: set; variances ascend.
    """
    n = sums[0]
    ma, mb, mc = sums[1] / n, sums[2] / n, sums[3] / n
    aa, ab, ac = sums[4] / n - ma * ma, sums[5] / n - ma * mb, sums[6] / n - ma * mc
    bb, bc, cc = sums[7] / n - mb * mb, sums[8] / n - mb * mc, sums[9] / n - mc * mc
    mean = (aa + bb + cc) / 3.0
    da, db, dc = aa - mean, bb - mean, cc - mean
    off = ab * ab + ac * ac + bc * bc
    size = math.sqrt((da * da + db * db + dc * dc + 2.0 * off) / 6.0)
    plane[3], plane[4], plane[5] = ma, mb, mc
    if size < 1e-12:
        plane[0], plane[1], plane[2] = 0.0, 0.0, 1.0
        plane[6], plane[7], plane[8] = mean, mean, mean
        return
    determinant = (
        da * (db * dc - bc * bc) - ab * (ab * dc - bc * ac) + ac * (ab * bc - db * ac)
    ) / size**3
    angle = math.acos(min(1.0, max(-1.0, 0.5 * determinant))) / 3.0
    most = mean + 2.0 * size * math.cos(angle)
    least = mean + 2.0 * size * math.cos(angle + 2.0 * math.pi / 3.0)
    plane[6], plane[7], plane[8] = max(least, 0.0), 3.0 * mean - most - least, most
    # Rows of (matrix - least) are across the normal: the longest cross product of two is the best.
    ra, rb, rc = aa - least, bb - least, cc - least
    u0, u1, u2 = ab * bc - ac * rb, ac * ab - ra * bc, ra * rb - ab * ab
    v0, v1, v2 = ab * rc - ac * bc, ac * ac - ra * rc, ra * bc - ab * ac
    w0, w1, w2 = rb * rc - bc * bc, bc * ac - ab * rc, ab * bc - rb * ac
    u, v, w = u0 * u0 + u1 * u1 + u2 * u2, v0 * v0 + v1 * v1 + v2 * v2, w0 * w0 + w1 * w1 + w2 * w2
    if v > u:
        u, u0, u1, u2 = v, v0, v1, v2
    if w > u:
        u, u0, u1, u2 = w, w0, w1, w2
    length = math.sqrt(u)
    if length > 0.0:
        plane[0], plane[1], plane[2] = u0 / length, u1 / length, u2 / length
    else:
        plane[0], plane[1], plane[2] = 0.0, 0.0, 1.0


@kernel_part
def robust_moments(
    points: NDArray[np.float64], plane: NDArray[np.float64], tolerance_m: float
) -> NDArray[np.float64]:
    """Weighted sums of the points near a plane, Tukey's weights with a cut at the tolerance.

    Args:
        points: (m, 3) offsets, metres.
        plane: (4,) normal and offset.
        tolerance_m: distance at which a point's weight has fallen to zero.

    Returns:
        (10,) sum of weights, of w x, w y, w z, and of w times xx, xy, xz, yy, yz, zz.
    """
    sums = np.zeros(10)
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        distance_m = plane[0] * x + plane[1] * y + plane[2] * z - plane[3]
        if abs(distance_m) >= tolerance_m:
            continue
        ratio = distance_m / tolerance_m
        weight = (1.0 - ratio * ratio) ** 2
        sums[0] += weight
        sums[1] += weight * x
        sums[2] += weight * y
        sums[3] += weight * z
        sums[4] += weight * x * x
        sums[5] += weight * x * y
        sums[6] += weight * x * z
        sums[7] += weight * y * y
        sums[8] += weight * y * z
        sums[9] += weight * z * z
    return sums


@kernel_part
def _nearby(
    points: NDArray[np.float64], plane: NDArray[np.float64], reach_m: float
) -> NDArray[np.float64]:
    """(k, 3) the points within reach of a plane, in their order."""
    near = np.empty_like(points)
    count = 0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        near[count, 0], near[count, 1], near[count, 2] = x, y, z
        distance_m = plane[0] * x + plane[1] * y + plane[2] * z - plane[3]
        # Without a branch: which points are near cannot be foretold.
        count += 1 if abs(distance_m) < reach_m else 0
    return near[:count]


@kernel_part
def _furthest_m(points: NDArray[np.float64]) -> float:
    """The largest distance of a point from the origin."""
    largest = 0.0
    for i in range(points.shape[0]):
        largest = max(largest, points[i, 0] ** 2 + points[i, 1] ** 2 + points[i, 2] ** 2)
    return float(np.sqrt(largest))


@kernel_part
def _without_rise(sums: NDArray[np.float64], up: NDArray[np.float64]) -> None:
    """Replace moments by those that have up as their widest direction, so that no normal leans."""
    mean, second, across = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    order = ((4, 5, 6), (5, 7, 8), (6, 8, 9))
    for i in range(3):
        mean[i] = sums[1 + i] / sums[0]
    trace = 0.0
    for i in range(3):
        for j in range(3):
            second[i, j] = sums[order[i][j]] / sums[0] - mean[i] * mean[j]
            across[i, j] = (1.0 if i == j else 0.0) - up[i] * up[j]
        trace += second[i, i]
    for i in range(3):
        for j in range(i, 3):
            total = up[i] * up[j] * trace
            for k in range(3):
                for m in range(3):
                    total += across[i, k] * second[k, m] * across[m, j]
            sums[order[i][j]] = total + mean[i] * mean[j]
    sums[0] = 1.0
    for i in range(3):
        sums[1 + i] = mean[i]


@compiled
def refine_robustly(
    points: NDArray[np.float64],
    plane: NDArray[np.float64],
    tolerance_m: float,
    freedom: int,
    up: NDArray[np.float64],
) -> bool:
    """Move a plane to the densest layer of points near it: total least squares, reweighted.

    Args:
        points: (m, 3) offsets, metres.
        plane: (4,) normal and offset to start from; changed.
        tolerance_m: points further away have no weight (Tukey's weights).
        freedom: FREE, VERTICAL or LEVEL.
        up: (3,) unit vector.

    Returns:
        Whether more than a line of points supports it; if not, the plane means nothing.
    """
    fitted = np.empty(9)
    furthest_m = _furthest_m(points)
    # Only points near the plane matter, and mostly it moves little: those near it are asked again
    # only when it may have come within the tolerance of others.
    near, asked, reach_m = points, plane.copy(), np.inf
    for step in range(_STEPS_MOST):
        turned = np.sqrt(
            (plane[0] - asked[0]) ** 2 + (plane[1] - asked[1]) ** 2 + (plane[2] - asked[2]) ** 2
        )
        may_have_moved_m = turned * furthest_m + abs(plane[3] - asked[3])
        if step == 1 or may_have_moved_m + tolerance_m > reach_m:
            reach_m = _REACH * tolerance_m
            near, asked = _nearby(points, plane, reach_m), plane.copy()
        sums = robust_moments(near, plane, tolerance_m)
        if sums[0] <= 0.0:
            return False
        if freedom == VERTICAL:
            _without_rise(sums, up)
        if freedom == LEVEL:
            fitted[0], fitted[1], fitted[2] = up[0], up[1], up[2]
        else:
            flattest(sums, fitted)
            if fitted[7] < max(_LINE_WIDTH_M**2, 1e-8 * fitted[8]):
                return False
        turn, offset_m, sign = 0.0, 0.0, 0.0
        for i in range(3):
            sign += fitted[i] * plane[i]
        sign = -1.0 if sign < 0.0 else 1.0
        for i in range(3):
            offset_m += sign * fitted[i] * sums[1 + i] / sums[0]
            turn += (sign * fitted[i] - plane[i]) ** 2
            plane[i] = sign * fitted[i]
        moved_m = abs(offset_m - plane[3])
        plane[3] = offset_m
        if max(10.0 * np.sqrt(turn), moved_m) < _SETTLED_SHARE * tolerance_m:
            break
    return True
