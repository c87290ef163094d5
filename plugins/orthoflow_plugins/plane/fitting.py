"""Planes through noisy points: robust fits with a shrinking tolerance on a sample.

All planes here are in the cloud's own offsets (metres from its origin), so that survey coordinates
cost no digits; `world_plane` of `assembling` adds the origin once, at the end.
"""

from __future__ import annotations

import math
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import Plane
from orthoflow.geometry.plane_kernels import robust_moments

# What a fit may change: everything, or a normal kept exactly horizontal, or kept along up.
Freedom = Literal["free", "vertical", "level"]

_STEPS_MOST: Final = 20
# A fit has settled when a point ten metres away moves by less than this.
_SETTLED_M: Final = 2e-6
# Points nearer to a line than this (root mean square) do not say how the plane lies about it.
_LINE_WIDTH_M: Final = 1e-4


def shrinking_tolerances(find_m: float, fit_m: float) -> tuple[float, ...]:
    """Tolerances to fit with, one after the other: 5 cm, 2.7 cm and 1.5 cm for the defaults.

    A fit at 5 cm finds the wall but is pulled by mouldings and the floor's edge; a fit at 1.5 cm is
    exact but would not get there from a rough start.
    """
    if fit_m >= find_m:
        return (find_m,)
    return (find_m, math.sqrt(find_m * fit_m), fit_m)


def refine_plane(
    points: NDArray[np.float64],
    start: Plane,
    tolerance_m: float,
    *,
    freedom: Freedom,
    up: NDArray[np.float64],
) -> Plane | None:
    """Move a plane to the densest layer of points near it: total least squares, reweighted.

    Args:
        points: (m, 3) offsets, metres.
        start: plane to start from.
        tolerance_m: points further away have no weight (Tukey's weights).
        freedom: what may change.
        up: (3,) unit vector.

    Returns:
        The plane, or None where fewer than three points or only a line of points support it.
    """
    plane = start
    for _ in range(_STEPS_MOST):
        row = np.append(plane.normal, plane.offset_m)
        fitted = plane_from_moments(
            robust_moments(points, row, tolerance_m), plane, freedom=freedom, up=up
        )
        if fitted is None:
            return None
        turned = float(np.linalg.norm(fitted.normal - plane.normal))
        # The shift is taken at the points, not at the origin, which may be far from them.
        moved = abs(fitted.offset_m - plane.offset_m)
        plane = fitted
        if max(10.0 * turned, moved) < _SETTLED_M:
            break
    return plane


def plane_from_moments(
    sums: NDArray[np.float64], near: Plane, *, freedom: Freedom, up: NDArray[np.float64]
) -> Plane | None:
    """Give the plane of least squared distances from `robust_moments`, on the side of `near`."""
    if sums[0] <= 0.0:
        return None
    mean = sums[1:4] / sums[0]
    second = np.array([[sums[4], sums[5], sums[6]], [sums[5], sums[7], sums[8]]])
    moments = np.vstack([second, [sums[6], sums[8], sums[9]]]) / sums[0] - np.outer(mean, mean)
    if freedom == "level":
        normal = up
    else:
        if freedom == "vertical":
            # Without its part along up, the covariance has up itself as a null direction.
            across = np.eye(3) - np.outer(up, up)
            moments = across @ moments @ across + np.outer(up, up) * np.trace(moments)
        variances, directions = np.linalg.eigh(moments)
        if variances[1] < max(_LINE_WIDTH_M**2, 1e-8 * variances[2]):
            return None
        normal = directions[:, 0]
    if float(normal @ near.normal) < 0.0:
        normal = -normal
    normal = normal / np.linalg.norm(normal)
    return Plane(normal=normal, offset_m=float(normal @ mean))
