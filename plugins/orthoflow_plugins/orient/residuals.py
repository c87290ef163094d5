"""Numbers about the residuals of an orientation, control and check apart."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoflow.products import JsonValue
from orthoflow_plugins.orient.estimating import metres_per_pixel
from orthoflow_plugins.orient.judging import Case
from orthoflow_plugins.orient.residual_tables import residual_rows


@dataclass(frozen=True, kw_only=True)
class PhotoNumbers:
    """What the report says of one oriented photo.

    Attributes:
        n_control: ties that determine the pose.
        n_check: withheld ties that agree.
        n_rejected: ties that do not agree.
        control_rmse_px: root mean square of a residual coordinate.
        check_rmse_px: the same of the withheld ties, NaN without any.
        check_rmse_mm: the same on the surface.
        pixel_mm: size of a pixel on the surface.
        hull_ratio: hull of the control over the part of the photo that shows its walls.
    """

    n_control: int
    n_check: int
    n_rejected: int
    control_rmse_px: float
    check_rmse_px: float
    check_rmse_mm: float
    pixel_mm: float
    hull_ratio: float


def photo_numbers(case: Case) -> PhotoNumbers:
    """Summarise an orientation."""
    residuals = case.estimate.fit.residuals_px
    control, check = residuals[case.control], residuals[case.checked]
    camera = case.estimate.resection.camera
    pixel_mm = 1000.0 * metres_per_pixel(camera, case.seen.points_world[case.control])
    check_rmse_px = _rms(check)
    return PhotoNumbers(
        n_control=len(control),
        n_check=len(check),
        n_rejected=int((~case.estimate.agreeing).sum()),
        control_rmse_px=_rms(control),
        check_rmse_px=check_rmse_px,
        check_rmse_mm=check_rmse_px * pixel_mm,
        pixel_mm=pixel_mm,
        hull_ratio=case.hull_ratio,
    )


def numbers_json(case: Case, numbers: PhotoNumbers) -> dict[str, JsonValue]:
    """Give the numbers of an orientation as JSON."""
    result = case.estimate.resection
    entry: dict[str, JsonValue] = {
        "n_control": numbers.n_control,
        "n_check": numbers.n_check,
        "n_rejected": numbers.n_rejected,
        "pixel_mm": numbers.pixel_mm,
        "hull_ratio": numbers.hull_ratio,
        "limit_sigma": case.estimate.limit,
        "sigma0": result.sigma0,
        "variance_factor": result.variance_factor,
        "lens": case.estimate.source,
        "focal_px": result.camera.fx,
        "k1": float(result.camera.distortion[0]),
    }
    entry |= case.estimate.details
    if case.error is not None:
        entry["sigma_wall_mm"] = 1000.0 * case.error.rms_m
        entry["sigma_wall_worst_mm"] = 1000.0 * case.error.worst_m
        entry["sigma_image_corners_mm"] = [
            1000.0 * sigma if math.isfinite(sigma) else None
            for sigma in case.error.corners_m.tolist()
        ]
    if result.lens.focal_sigma > 0.0:
        entry["focal_sigma_px"] = result.camera.fx * float(np.sqrt(result.covariance[6, 6]))
    return entry


def residual_table(case: Case, numbers: PhotoNumbers) -> list[JsonValue]:
    """Give the rows of the table of residuals, control and check apart."""
    units = {"px": 1.0, "mm": numbers.pixel_mm}
    if case.gsd_m is not None:
        units["cell"] = numbers.pixel_mm / (1000.0 * case.gsd_m)
    rows: list[JsonValue] = []
    for role, chosen in (("control", case.control), ("check", case.checked)):
        place: dict[str, JsonValue] = {"photo": case.photo.name, "role": role}
        rows += residual_rows(place, case.estimate.fit.residuals_px[chosen], units)
    return rows


def _rms(residuals: NDArray[np.float64]) -> float:
    """Root mean square of a coordinate of residuals (n, 2)."""
    return float(np.sqrt(np.mean(residuals**2))) if len(residuals) else float("nan")
