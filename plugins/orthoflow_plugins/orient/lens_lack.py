"""What a poor lens model leaves out: how far the full one would move the photo, stated as error."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.errors import GeometryError
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.lenses import LensFreedom, linearised
from orthoflow.geometry.resection import (
    Resection,
    SeenPoints,
    adjust,
    moved_origin,
    predicted_covariances,
)
from orthoflow_plugins.orient.estimating import SOFT_LIMIT, Estimate, Start
from orthoflow_plugins.orient.splitting import GROUPS, image_cells

# Ties that deviate so many times more than they should show what the lens model lacks.
_SIGMA0_MOST: Final = 1.5
# Points per side of the grid over a photo on which lens models are compared.
_FRAME: Final = 12


def with_what_is_missing(
    estimate: Estimate, control: SeenPoints, start: Start, freedom: LensFreedom
) -> Estimate:
    """Widen what is stated of a camera by how far a fuller lens model would move it, everywhere.

    Residuals show hardly a tenth of what a lens model lacks: the other parameters take up the rest,
    and bend the photo between and beyond the ties. So the error of the poorer camera is taken as
    its distance from the fuller one, and the error of that one on top. With the distortion of a
    usual lens unknown, eleven parameters stated a ninth of their error without this.

    Args:
        estimate: by the poorer model.
        control: the ties that determined it.
        start: what it started from.
        freedom: what the fuller model may change of the lens.
    """
    model = estimate.resection
    size_px = (model.camera.width, model.camera.height)
    try:
        full = adjust(
            control,
            model.camera,
            prior=start.prior,
            lens=freedom,
            groups=image_cells(control.pixels_photo, size_px, GROUPS),
            soft_limit=SOFT_LIMIT * max(model.sigma0, 1.0),
        )
    except GeometryError:
        return estimate
    points = control.points_world
    missing = _mean_square(_moved_px(model.camera, full.camera, points)) - _variance_px2(
        full, points
    )
    if missing <= 0.0:
        return estimate
    bias = _bias(model.camera, full, control)
    wider = replace(model, covariance=full.covariance + np.outer(bias, bias), lens=full.lens)
    factor = _variance_px2(wider, points) / _variance_px2(model, points)
    wider = replace(wider, variance_factor=factor * model.variance_factor)
    return replace(estimate, resection=wider, notes=_misfit_notes(estimate, missing, factor))


def _bias(camera: ViewingCamera, full: Resection, control: SeenPoints) -> NDArray[np.float64]:
    """How the parameters (p,) would have to change to see all the frame as the full model does.

    Not the difference of the parameters: focal length and distance, say, differ by much that
    cancels, and to first order it would not.
    """
    middle = control.points_world.mean(axis=0)
    points = _frame_points(camera, control) - middle
    near = camera.shifted(middle)
    linear = linearised(near, points, full.lens)
    moved = _moved_px(near, full.camera.shifted(middle), points)
    seen = np.isfinite(moved).all(axis=1)
    rows = linear.by_parameters[seen].reshape(-1, len(full.covariance))
    scale = np.linalg.norm(rows, axis=0)
    bias = np.linalg.lstsq(rows / scale, moved[seen].ravel(), rcond=1e-9)[0] / scale
    return np.asarray(moved_origin(camera, middle, len(bias)) @ bias)


def _frame_points(camera: ViewingCamera, control: SeenPoints) -> NDArray[np.float64]:
    """Points (n, 3) behind the pixels of a grid over the photo, each as far as control near it."""
    across, down = ((np.arange(_FRAME) + 0.5) / _FRAME for _ in range(2))
    pixels = np.stack(np.meshgrid(across * camera.width, down * camera.height), axis=-1)
    pixels = pixels.reshape(-1, 2)
    off = pixels[:, None] - control.pixels_photo
    nearest = (off**2).sum(axis=2).argmin(axis=1)
    ranges = np.linalg.norm(control.points_world - camera.centre_world, axis=1)
    rays = camera.rays_world(pixels)
    points: NDArray[np.float64] = (
        camera.centre_world + (ranges[nearest] / np.linalg.norm(rays, axis=1))[:, None] * rays
    )
    return points


def _moved_px(
    camera: ViewingCamera, other: ViewingCamera, points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """How far (n, 2) another camera sees points from where the first sees them, in pixels."""
    moved: NDArray[np.float64] = other.project(points)[:, :2] - camera.project(points)[:, :2]
    return moved


def _mean_square(moved_px: NDArray[np.float64]) -> float:
    """Mean square of a coordinate of moves (n, 2)."""
    return 0.5 * float((moved_px**2).sum(axis=1).mean())


def _variance_px2(resection: Resection, points: NDArray[np.float64]) -> float:
    """Mean predicted variance of a coordinate of the pixels of points (n, 3)."""
    covariances = predicted_covariances(resection, points)
    return 0.5 * float(np.trace(covariances, axis1=1, axis2=2).mean())


def _misfit_notes(estimate: Estimate, missing_px2: float, factor: float) -> tuple[str, ...]:
    sigma0 = estimate.resection.sigma0
    if sigma0 <= _SIGMA0_MOST and factor <= _SIGMA0_MOST**2:
        return ()
    note = (
        f"its ties deviate {sigma0:.1f} times as much as they should, and a fuller lens model "
        f"would move its points by {math.sqrt(missing_px2):.1f} px: its lens has distortion "
        "that a DLT without that does not describe, worst at the corners; the stated error is "
        f"{math.sqrt(factor):.1f} times as large for it"
    )
    return (note,)
