"""What an orientation step reports: one product, warnings, metrics, pictures, and residuals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.robust import median_deviation
from orthoflow.products import Camera, Cameras, JsonValue, Photo, ResidualRow, TieRole, Ties
from orthoflow.sdk import StepContext
from orthoflow_plugins.orient.figures import (
    PhotoResiduals,
    draw_positions,
    draw_residuals,
    draw_ties,
    draw_wall_errors,
)
from orthoflow_plugins.orient.gates import Candidate
from orthoflow_plugins.orient.parameters import NOT_ORIENTED, Note
from orthoflow_plugins.orient.pose import metres_per_pixel, ties_of_photo

# Of a normal distribution 4.55 % lie beyond; of any, at most a quarter can (Chebyshev).
_BEYOND: Final = 2.0
_AXES: Final = ("u", "v")

COLUMNS_SAID: Final[Mapping[str, JsonValue]] = {
    "residual": "observed - computed; u and v of the photo",
    "unit": "px of the photo, cell of the wall's raster, or mm on the wall: px times the median "
    "size of a pixel there",
    "shift_p": "probability of such a mean by chance, Student's t, two-sided",
    "nmad": "1.4826 times the median absolute deviation from the median",
    "p95": "95 % of the residuals are no longer than this",
    "beyond_own": "share beyond twice the coordinate's own RMSE",
    "beyond_cells": "share beyond two cells of the wall's raster, a reference that does not move",
    "beyond_any": "share of ties of which u or v lies beyond twice its own RMSE",
}


@dataclass(frozen=True, kw_only=True)
class PhotoNumbers:
    """What the report says of one oriented photo.

    Attributes:
        n_control: ties that determine the pose, and withheld ones that are one of these again.
        n_check: withheld ties that agree, and are no control.
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


@dataclass(frozen=True, kw_only=True)
class Oriented:
    """What became of one photo.

    Attributes:
        camera: its orientation, or why there is none.
        chosen: (n,) index into all ties of those that were used.
        role: (n,) `TieRole` of these.
        residuals_px: (n, 2), NaN without an orientation.
        numbers: for the metrics, None without an orientation.
        entry: for the record.
        table: rows of the table of residuals.
        notes: what limits it.
        candidate: what it was judged by, of a photo that is ok.
    """

    camera: Camera
    chosen: NDArray[np.intp]
    role: NDArray[np.uint8]
    residuals_px: NDArray[np.float64]
    numbers: PhotoNumbers | None = None
    entry: JsonValue = None
    table: tuple[ResidualRow, ...] = ()
    notes: tuple[Note, ...] = ()
    candidate: Candidate | None = None


def photo_numbers(candidate: Candidate) -> PhotoNumbers:
    """Summarise an orientation."""
    residuals = candidate.estimate.fit.residuals_px
    control, check = residuals[candidate.control], residuals[candidate.checked]
    camera = candidate.estimate.resection.camera
    pixel_mm = 1000.0 * metres_per_pixel(camera, candidate.seen.points_world[candidate.control])
    check_rmse_px = _rms(check)
    return PhotoNumbers(
        n_control=int(candidate.estimate.agreeing.sum()) - len(check),
        n_check=len(check),
        n_rejected=int((~candidate.estimate.agreeing).sum()),
        control_rmse_px=_rms(control),
        check_rmse_px=check_rmse_px,
        check_rmse_mm=check_rmse_px * pixel_mm,
        pixel_mm=pixel_mm,
        hull_ratio=candidate.hull_ratio,
    )


def numbers_json(candidate: Candidate, numbers: PhotoNumbers) -> dict[str, JsonValue]:
    """Return the numbers of an orientation as JSON."""
    result = candidate.estimate.resection
    entry: dict[str, JsonValue] = {
        "n_control": numbers.n_control,
        "n_check": numbers.n_check,
        "n_rejected": numbers.n_rejected,
        "pixel_mm": numbers.pixel_mm,
        "hull_ratio": numbers.hull_ratio,
        "limit_sigma": candidate.estimate.limit,
        "sigma0": result.sigma0,
        "variance_factor": result.variance_factor,
        "lens": candidate.estimate.source,
        "focal_px": result.camera.fx,
        "k1": float(result.camera.distortion[0]),
    }
    entry |= candidate.estimate.numbers
    if candidate.error is not None:
        entry["sigma_wall_mm"] = 1000.0 * candidate.error.rms_m
        entry["sigma_wall_worst_mm"] = 1000.0 * candidate.error.worst_m
        entry["sigma_image_corners_mm"] = [
            1000.0 * sigma if math.isfinite(sigma) else None
            for sigma in candidate.error.corners_m.tolist()
        ]
    if result.lens.focal_sigma > 0.0:
        entry["focal_sigma_px"] = result.camera.fx * float(np.sqrt(result.covariance[6, 6]))
    return entry


def residual_table(candidate: Candidate, numbers: PhotoNumbers) -> list[ResidualRow]:
    """Return the rows of the table of residuals, control and check apart."""
    units = {"px": 1.0, "mm": numbers.pixel_mm}
    if candidate.gsd_m is not None:
        units["cell"] = numbers.pixel_mm / (1000.0 * candidate.gsd_m)
    rows: list[ResidualRow] = []
    for role, chosen in (("control", candidate.control), ("check", candidate.checked)):
        residuals_px = candidate.estimate.fit.residuals_px[chosen]
        rows += residual_rows(candidate.photo.name, role, residuals_px, units)
    return rows


def residual_rows(
    photo: str,
    role: str,
    residuals_px: NDArray[np.float64],
    units: Mapping[str, float],
) -> list[ResidualRow]:
    """Return the rows of one photo and role.

    Args:
        photo: name of the photo.
        role: `control` or `check`.
        residuals_px: (n, 2), observed - computed.
        units: by name, how many of them a pixel is; `cell` among them if it is known.

    Returns:
        One row per coordinate and unit; none without residuals.
    """
    if not len(residuals_px):
        return []
    is_beyond = np.abs(residuals_px) > _BEYOND * _rmse(residuals_px)
    any_axis = _share(is_beyond[:, 0] | is_beyond[:, 1])
    rows: list[ResidualRow] = []
    for axis, values in zip(_AXES, residuals_px.T, strict=True):
        limit = _BEYOND / units["cell"] if "cell" in units else None
        beyond_own = _share(np.abs(values) > _BEYOND * _rmse(values))
        beyond_cells = None if limit is None else _share(np.abs(values) > limit)
        for unit, factor in units.items():
            scaled = values * factor
            lengths, median = np.abs(scaled), float(np.median(scaled))
            row = ResidualRow(
                photo=photo,
                role=role,
                axis=axis,
                unit=unit,
                n=len(scaled),
                mean=float(scaled.mean()),
                shift_p=_chance_of_mean(scaled),
                sd=float(scaled.std(ddof=1)) if len(scaled) > 1 else 0.0,
                median=median,
                nmad=median_deviation(scaled, median),
                skewness=_skewness(scaled),
                rmse=float(_rmse(scaled)),
                p95=float(np.percentile(lengths, 95.0)),
                max=float(lengths.max()),
                beyond_own=beyond_own,
                beyond_cells=beyond_cells,
                beyond_any=any_axis,
            )
            rows.append(row)
    return rows


def hand_over(
    ctx: StepContext,
    ties: Ties,
    photos: Sequence[Photo],
    found: Sequence[Oriented],
    details: dict[str, JsonValue] | None = None,
) -> Cameras:
    """Return the product and tell the rest through the context.

    Args:
        ctx: takes warnings, metrics and figures.
        ties: all ties, as they were given.
        photos: the photos.
        found: what became of each.
        details: what the method says beyond what every orientation says.
    """
    role, residuals = ties.role.copy(), np.full_like(ties.residual_px, np.nan)
    for photo, oriented in zip(photos, found, strict=True):
        role[oriented.chosen] = oriented.role
        residuals[oriented.chosen] = oriented.residuals_px
        _warn(ctx, oriented)
        mine = ties_of_photo(ties, photo.name)
        status = f"Status: {oriented.camera.status}"
        draw_ties(ctx, photo, ties.pixels_photo[mine], role[mine], status)
    _measure(ctx, found)
    candidates = [item.candidate for item in found if item.candidate is not None]
    draw_wall_errors(ctx, candidates)
    draw_positions(ctx, candidates)
    draw_residuals(
        ctx,
        [
            PhotoResiduals(name=item.camera.photo, residuals_px=item.residuals_px, role=item.role)
            for item in found
            if item.camera.status == "ok"
        ],
    )
    said: dict[str, JsonValue] = {
        "photos": {item.camera.photo: item.entry for item in found},
        "residual_columns": dict(COLUMNS_SAID),
        "sigma_wall": "standard deviation of one coordinate in the wall's plane, from the "
        "covariance, RMS over what the photo shows of its walls",
    }
    return Cameras(
        cameras=tuple(item.camera for item in found),
        ties=replace(ties, role=role, residual_px=residuals),
        residual_table=tuple(row for item in found for row in item.table),
        details=said | (details or {}),
    )


def measure_expected(ctx: StepContext, cameras: Sequence[Camera]) -> None:
    """Report the errors on the wall that orientations carry; nothing where none carries one."""
    sigmas = [camera.sigma_wall_m for camera in cameras if camera.sigma_wall_m is not None]
    _sum_up(ctx, "sigma_wall_mm", [1000.0 * sigma for sigma in sigmas], "mm")


def _chance_of_mean(values: NDArray[np.float64]) -> float | None:
    """Probability of a mean as far from 0 when there is no shift; None for fewer than two."""
    from scipy.special import stdtr  # scipy.stats would take seconds to import

    n = len(values)
    if n < 2:
        return None
    deviation = float(values.std(ddof=1))
    if deviation == 0.0:
        return 1.0 if values[0] == 0.0 else 0.0
    return 2.0 * float(stdtr(n - 1, -abs(float(values.mean())) * math.sqrt(n) / deviation))


def _skewness(values: NDArray[np.float64]) -> float | None:
    """Third standardised moment; None where nothing varies."""
    centred = values - values.mean()
    variance = float(np.mean(centred**2))
    return float(np.mean(centred**3)) / variance**1.5 if variance > 0.0 else None


def _rmse(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Root mean square along the first axis."""
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def _share(is_beyond: NDArray[np.bool_]) -> float:
    return float(is_beyond.mean())


def _rms(residuals: NDArray[np.float64]) -> float:
    """Root mean square of a coordinate of residuals (n, 2)."""
    return float(np.sqrt(np.mean(residuals**2))) if len(residuals) else float("nan")


def _warn(ctx: StepContext, oriented: Oriented) -> None:
    camera = oriented.camera
    if camera.status != "ok":
        ctx.report(NOT_ORIENTED, subject=camera.photo, status=camera.status)
    for note, values in oriented.notes:
        ctx.report(note, subject=camera.photo, **values)


def _measure(ctx: StepContext, found: Sequence[Oriented]) -> None:
    oriented = [item for item in found if item.camera.status == "ok"]
    numbers = [item.numbers for item in oriented if item.numbers]
    n_ties = sum(len(item.role) for item in found)
    ctx.metric("n_photos", len(found), "1")
    ctx.metric("n_oriented", len(oriented), "1")
    ctx.metric("n_refused", len(found) - len(oriented), "1")
    ctx.metric("n_ties", n_ties, "1")
    ctx.metric("n_control", sum(item.n_control for item in numbers), "1")
    ctx.metric("n_check", sum(item.n_check for item in numbers), "1")
    rejected = sum(int((item.role == TieRole.REJECTED).sum()) for item in found)
    ctx.metric("rejected_share", rejected / max(n_ties, 1), "1")
    columns = {
        "control_rmse_px": ([item.control_rmse_px for item in numbers], "px"),
        "check_rmse_px": ([item.check_rmse_px for item in numbers], "px"),
        "check_rmse_mm": ([item.check_rmse_mm for item in numbers], "mm"),
    }
    for name, (values, unit) in columns.items():
        _sum_up(ctx, name, values, unit)
    measure_expected(ctx, [item.camera for item in found])


def _sum_up(ctx: StepContext, name: str, values: Sequence[float], unit: str) -> None:
    known = [value for value in values if np.isfinite(value)]
    if known:
        ctx.metric(f"{name}_median", float(np.median(known)), unit)
        ctx.metric(f"{name}_worst", max(known), unit)
