"""Compiled projection through a camera with distortion, for all steps that project points."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.compiling import inlined

# Layout of a camera as a flat float64 array, so that kernels need only one argument: 0..8 rows of
# the rotation, 9..11 translation, 12 fx, 13 fy, 14 cx, 15 cy, 16..20 k1 k2 p1 p2 k3, 21 width, 22
# height, 23 largest undistorted radius at which the lens model is monotonic, 24 skew.
CAMERA_LENGTH = 25


@inlined
def project_point(camera, x, y, z):  # type: ignore[no-untyped-def]  # numba infers the types
    """Project one world point to (u, v, depth); u and v are NaN if it is not visible.

    The model is Brown's as in OpenCV, but with the first pixel centre at (0.5, 0.5). A point is not
    visible if it is behind the camera, or farther from the axis than the radius at which the
    distortion polynomial folds back. Beyond this radius, the model could project a point into the
    image although the camera cannot see it.
    """
    xc = camera[0] * x + camera[1] * y + camera[2] * z + camera[9]
    yc = camera[3] * x + camera[4] * y + camera[5] * z + camera[10]
    zc = camera[6] * x + camera[7] * y + camera[8] * z + camera[11]
    if zc <= 1e-9:
        return math.nan, math.nan, zc
    a, b = xc / zc, yc / zc
    r2 = a * a + b * b
    if r2 > camera[23] * camera[23]:
        return math.nan, math.nan, zc
    radial = 1.0 + r2 * (camera[16] + r2 * (camera[17] + r2 * camera[20]))
    p1, p2 = camera[18], camera[19]
    ad = a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a)
    bd = b * radial + p1 * (r2 + 2.0 * b * b) + 2.0 * p2 * a * b
    return camera[12] * ad + camera[14] + camera[24] * bd, camera[13] * bd + camera[15], zc


def largest_radius(distortion: NDArray[np.float64], *, limit: float = 10.0) -> float:
    """Return the undistorted radius up to which radial distortion (k1, k2, k3) is monotonic.

    The derivative of r (1 + k1 r^2 + k2 r^4 + k3 r^6) is a cubic polynomial in r^2; the lens model
    folds back at its smallest positive root.
    """
    k1, k2, k3 = distortion[0], distortion[1], distortion[4]
    roots = np.roots([7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0.0)]
    return float(min(limit, math.sqrt(real.min()))) if real.size else limit
