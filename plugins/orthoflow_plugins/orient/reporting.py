"""What an orientation step tells: one product, warnings, metrics and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from orthoflow.products import Camera, Cameras, JsonValue, Photo, TieRole, Ties
from orthoflow.sdk import StepContext
from orthoflow_plugins.orient.figures import (
    PhotoResiduals,
    draw_positions,
    draw_residuals,
    draw_ties,
    draw_wall_errors,
)
from orthoflow_plugins.orient.residuals import COLUMNS_SAID
from orthoflow_plugins.orient.single_photo import Oriented, of_photo


def hand_over(
    ctx: StepContext,
    ties: Ties,
    photos: Sequence[Photo],
    found: Sequence[Oriented],
    details: dict[str, JsonValue] | None = None,
) -> Cameras:
    """Give the product and tell the rest through the context.

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
        mine = of_photo(ties, photo.name)
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


def _warn(ctx: StepContext, oriented: Oriented) -> None:
    camera = oriented.camera
    if camera.status != "ok":
        ctx.warn(f"photo {camera.photo} is not oriented: {camera.status}")
    for note in oriented.notes:
        ctx.warn(f"photo {camera.photo}: {note}")


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


def measure_expected(ctx: StepContext, cameras: Sequence[Camera]) -> None:
    """Report the errors on the wall that orientations carry; nothing where none carries one."""
    sigmas = [camera.sigma_wall_m for camera in cameras if camera.sigma_wall_m is not None]
    _sum_up(ctx, "sigma_wall_mm", [1000.0 * sigma for sigma in sigmas], "mm")


def _sum_up(ctx: StepContext, name: str, values: Sequence[float], unit: str) -> None:
    known = [value for value in values if np.isfinite(value)]
    if known:
        ctx.metric(f"{name}_median", float(np.median(known)), unit)
        ctx.metric(f"{name}_worst", max(known), unit)
