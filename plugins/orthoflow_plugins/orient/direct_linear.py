"""The direct linear transform: a camera from eleven parameters, without anything known before."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError
from orthoflow.geometry.cameras import ViewingCamera


@dataclass(frozen=True, kw_only=True)
class DirectLinear:
    """A camera found by a direct linear transform.

    Attributes:
        camera: without distortion and skew.
        skew_px: what the eleven parameters say besides: shift in u per unit of y / z.
        condition: largest over second smallest singular value of the normalised equations; on
            points of one plane it grows without bound.
    """

    camera: ViewingCamera
    skew_px: float
    condition: float


@dataclass(frozen=True, kw_only=True)
class Relief:
    """How far points leave the plane that fits them best.

    Attributes:
        rms_m: root mean square distance from it.
        extent_m: standard deviation along its longer axis.
    """

    rms_m: float
    extent_m: float


def relief(points: NDArray[np.float64]) -> Relief:
    """Measure how far points (n, 3) leave a plane."""
    centred = points - points.mean(axis=0)
    variances = np.linalg.eigvalsh(np.einsum("ni,nj->ij", centred, centred) / len(points))
    roots = np.sqrt(np.maximum(variances, 0.0))
    return Relief(rms_m=float(roots[0]), extent_m=float(roots[2]))


def direct_linear(
    pixels: NDArray[np.float64], points_world: NDArray[np.float64], size_px: tuple[int, int]
) -> DirectLinear:
    """Solve for the eleven parameters (Abdel-Aziz & Karara 1971, normalised after Hartley 1997).

    Args:
        pixels: (n, 2), at least six.
        points_world: (n, 3) metres.
        size_px: width and height of the photo.

    Raises:
        GeometryError: the points do not determine a camera.
    """
    if len(pixels) < 6:
        raise GeometryError(f"a direct linear transform needs six points, got {len(pixels)}")
    shift_px, scale_px = _normalisation(pixels, math.sqrt(2.0))
    shift_m, scale_m = _normalisation(points_world, math.sqrt(3.0))
    uv = (pixels - shift_px) * scale_px
    xyz = np.column_stack([(points_world - shift_m) * scale_m, np.ones(len(pixels))])
    rows = np.zeros((len(pixels), 2, 12))
    rows[:, 0, :4], rows[:, 0, 8:] = xyz, -uv[:, :1] * xyz
    rows[:, 1, 4:8], rows[:, 1, 8:] = xyz, -uv[:, 1:] * xyz
    # Of the normal equations, summed in order: a singular value decomposition of the rows adds up
    # differently with another number of threads. The adjustment makes good the lost digits.
    values, vectors = np.linalg.eigh(np.einsum("nij,nik->jk", rows, rows))
    matrix = vectors[:, 0].reshape(3, 4)
    inverse_px = np.array(
        [[1 / scale_px, 0.0, shift_px[0]], [0.0, 1 / scale_px, shift_px[1]], [0.0, 0.0, 1.0]]
    )
    local = inverse_px @ matrix @ np.diag([scale_m, scale_m, scale_m, 1.0])
    camera, skew_px = _decomposed(local, points_world - shift_m, size_px)
    return DirectLinear(
        camera=camera.shifted(-shift_m),
        skew_px=skew_px,
        condition=math.sqrt(float(values[-1]) / max(float(values[1]), 1e-300)),
    )


def _normalisation(values: NDArray[np.float64], length: float) -> tuple[NDArray[np.float64], float]:
    """Shift and scale that bring points to the origin, at this distance from it on average."""
    shift = values.mean(axis=0)
    mean = float(np.linalg.norm(values - shift, axis=1).mean())
    if not mean > 0.0:
        raise GeometryError("the points of a direct linear transform lie in one place")
    return shift, length / mean


def _decomposed(
    matrix: NDArray[np.float64], points: NDArray[np.float64], size_px: tuple[int, int]
) -> tuple[ViewingCamera, float]:
    """Take a projection matrix (3, 4) apart: camera, and its skew in pixels."""
    if np.linalg.det(matrix[:, :3]) < 0.0:
        matrix = -matrix
    # RQ from QR: rows and columns in reverse order.
    q, r = np.linalg.qr(matrix[::-1, :3].T)
    upper, rotation = r.T[::-1, ::-1], q.T[::-1]
    signs = np.sign(np.diag(upper))
    if not signs.all():
        raise GeometryError("the points of a direct linear transform do not determine a camera")
    upper, rotation = upper * signs, signs[:, None] * rotation
    translation = np.linalg.solve(upper, matrix[:, 3])
    if float(np.median(points @ rotation[2] + translation[2])) <= 0.0:
        raise GeometryError("a direct linear transform puts the points behind the camera")
    upper = upper / upper[2, 2]
    camera = ViewingCamera(
        width=size_px[0],
        height=size_px[1],
        fx=float(upper[0, 0]),
        fy=float(upper[1, 1]),
        cx=float(upper[0, 2]),
        cy=float(upper[1, 2]),
        distortion=np.zeros(5),
        rotation=rotation,
        translation=translation,
    )
    return camera, float(upper[0, 1])
