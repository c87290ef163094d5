"""`orient.pnp`: each photo by itself from its ties with the walls (markiewicz2015, 3.6 and 4.3)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from orthoflow.errors import MethodError
from orthoflow.geometry.resection import SeenPoints
from orthoflow.products import Camera, Cameras, JsonValue, Photo, Photos, TieRole, Ties
from orthoflow.sdk import Method, MethodParams, Ports, StepContext
from orthoflow.sdk.methods import Determinism
from orthoflow_plugins.orient.estimating import EstimationRule, estimate_pose
from orthoflow_plugins.orient.figures import draw_residuals, draw_ties
from orthoflow_plugins.orient.judging import (
    Case,
    GateRule,
    reason_against,
    too_few,
    warnings_for,
)
from orthoflow_plugins.orient.residuals import PhotoNumbers, numbers_json, photo_numbers
from orthoflow_plugins.orient.splitting import withheld
from orthoflow_plugins.orient.wall_errors import known_walls, wall_error

_SEED_LIMIT = 2**31 - 1


@dataclass(frozen=True, kw_only=True)
class _Oriented:
    """What became of one photo.

    Attributes:
        camera: its orientation, or why there is none.
        role: (n,) `TieRole` of its ties.
        residuals_px: (n, 2), NaN without an orientation.
        numbers: for the metrics, None without an orientation.
        entry: for the record.
        notes: what limits it.
    """

    camera: Camera
    role: NDArray[np.uint8]
    residuals_px: NDArray[np.float64]
    numbers: PhotoNumbers | None = None
    entry: JsonValue = None
    notes: tuple[str, ...] = ()


class OrientPnp(Method):
    """Orient each photo by itself: robust pose, then a weighted adjustment with the full lens.

    A share of the ties is withheld from all of it and checks the result. A photo is `ok` only if
    its ties suffice and lie well, the withheld ones agree beyond chance, the camera stands in
    front of the wall, and the predicted error on the wall is small; else the reason is said.
    """

    id: ClassVar[str] = "orient.pnp"
    result_version: ClassVar[int] = 1
    determinism: ClassVar[Determinism] = "seeded"
    citations: ClassVar[tuple[str, ...]] = (
        "markiewicz2015: orthoimages of cultural heritage objects from TLS and images, 3.6, 4.3",
        "chum2003: Locally optimized RANSAC, doi:10.1007/978-3-540-45243-0_31",
        "persson2018: Lambda twist (P3P), doi:10.1007/978-3-030-01225-0_20",
        "schoenberger2016: Structure-from-motion revisited (COLMAP), doi:10.1109/CVPR.2016.445",
    )

    class Params(MethodParams):
        """Rejection, withheld share, and the gates an orientation has to pass."""

        rejection_sigma: float = Field(
            default=3.5,
            gt=1,
            le=20,
            description="Ties that deviate more than so many of their standard deviations are "
            "rejected.",
        )
        threshold_px: float | None = Field(
            default=None,
            gt=0,
            description="Largest deviation of a tie from a sampled pose; without it, what the "
            "ties' own standard deviations allow.",
        )
        check_share: float = Field(
            default=0.2,
            ge=0.2,
            le=0.5,
            description="Share of the ties withheld to check the orientation.",
        )
        n_trials_max: int = Field(
            default=20_000, ge=100, description="Random samples drawn per photo at most."
        )
        n_control_min: int = Field(
            default=12, ge=6, description="Control ties that must agree with the pose."
        )
        n_quadrant_min: int = Field(
            default=2,
            ge=0,
            description="Ties that must agree in each quarter of a photo (markiewicz2015: 2), "
            "unless the predicted error on the walls in that quarter stays below "
            "sigma_wall_max_cells; 0 leaves it to the predicted error alone.",
        )
        inlier_min_share: float = Field(
            default=0.04,
            ge=0,
            le=1,
            description="Share of a photo's ties that must agree with the pose.",
        )
        hull_min_ratio: float = Field(
            default=0.4,
            ge=0,
            le=1,
            description="Area of the control's hull over that of the walls in the photo.",
        )
        sigma_wall_max_cells: float = Field(
            default=1.0,
            gt=0,
            description="Largest predicted error on the wall, RMS over what the photo shows, in "
            "cells of its raster.",
        )
        sigma_corner_max_cells: float = Field(
            default=3.0, gt=0, description="The same at the worst place of what the photo shows."
        )
        n_ties_max: int = Field(
            default=20_000, ge=100, description="At most so many ties of a photo are used."
        )

    class In(Ports):
        """Ties, and the photos they are in."""

        ties: Ties
        photos: Photos

    class Out(Ports):
        """One orientation per photo."""

        cameras: Cameras

    def run(self, inputs: In, params: Params, ctx: StepContext) -> Out:
        """Orient the photos one after the other."""
        ties, photos = inputs.ties, inputs.photos
        _require(ties, photos)
        role, residuals = ties.role.copy(), np.full_like(ties.residual_px, np.nan)
        found: list[_Oriented] = []
        for nth, photo in enumerate(photos.photos):
            ctx.progress(nth / len(photos.photos), photo.name)
            chosen = _chosen(ties, photo.name, params.n_ties_max)
            oriented = _orient(photo, ties, chosen, params, ctx.rng)
            role[chosen], residuals[chosen] = oriented.role, oriented.residuals_px
            found.append(oriented)
            _tell(ctx, oriented)
            mine = _of_photo(ties, photo.name)
            draw_ties(
                ctx, photo, ties.pixels_photo[mine], role[mine], f"Status: {oriented.camera.status}"
            )
        _report(ctx, found)
        draw_residuals(ctx, residuals, role)
        details: dict[str, JsonValue] = {
            "photos": {item.camera.photo: item.entry for item in found},
            "sigma_wall": "standard deviation of one coordinate in the wall's plane, from the "
            "covariance, RMS over what the photo shows of its walls",
        }
        return self.Out(
            cameras=Cameras(
                cameras=tuple(item.camera for item in found),
                ties=replace(ties, role=role, residual_px=residuals),
                details=details,
            )
        )

    @classmethod
    def tools(cls) -> dict[str, str]:
        """COLMAP finds the first pose."""
        return {name: version(name) for name in ("pycolmap", "scipy")}


def _require(ties: Ties, photos: Photos) -> None:
    if not photos.photos:
        raise MethodError("there are no photos to orient: give at least one photo")
    if not len(ties.photo):
        raise MethodError(
            "there are no ties between photos and walls, so no photo can be oriented: see the "
            "matching step for what it found"
        )
    names = {photo.name for photo in photos.photos}
    strangers = [name for name in ties.photo_names if name not in names]
    if strangers:
        raise MethodError(
            f"the ties speak of photo {strangers[0]}, which is not among the photos given: wire "
            "the photos that the ties were made from"
        )


def _of_photo(ties: Ties, name: str) -> NDArray[np.intp]:
    if name not in ties.photo_names:
        return np.empty(0, dtype=np.intp)
    mine: NDArray[np.intp] = np.flatnonzero(ties.photo == ties.photo_names.index(name))
    return mine


def _chosen(ties: Ties, name: str, n_most: int) -> NDArray[np.intp]:
    """Ties of a photo that may be used: not rejected by the matcher, thinned evenly."""
    mine = _of_photo(ties, name)
    mine = np.asarray(mine[ties.role[mine] != TieRole.REJECTED], dtype=np.intp)
    if len(mine) <= n_most:
        return mine
    thinned = np.floor(np.arange(n_most) * len(mine) / n_most).astype(np.intp)
    return np.asarray(mine[thinned], dtype=np.intp)


def _orient(
    photo: Photo,
    ties: Ties,
    chosen: NDArray[np.intp],
    params: OrientPnp.Params,
    rng: np.random.Generator,
) -> _Oriented:
    # Drawn for every photo, so that one photo's ties do not change the luck of the next.
    own = np.random.default_rng(int(rng.integers(_SEED_LIMIT)))
    size_px = (photo.width, photo.height)
    reason = too_few(len(chosen))
    if reason:
        return _refused(photo, reason, len(chosen))
    seen = SeenPoints(
        pixels_photo=ties.pixels_photo[chosen],
        points_world=ties.points_world[chosen],
        sigma_px=ties.sigma_px[chosen],
        sigma_m=ties.sigma_m[chosen],
    )
    is_check = withheld(seen.pixels_photo, size_px, params.check_share, own)
    rule = EstimationRule(
        rejection_sigma=params.rejection_sigma,
        threshold_px=params.threshold_px,
        n_trials_most=params.n_trials_max,
        seed=int(own.integers(_SEED_LIMIT)),
    )
    estimate = estimate_pose(photo, seen, is_check, rule)
    if estimate is None:
        return _refused(photo, f"no pose agrees with enough of its {len(seen)} ties", len(chosen))
    used = np.zeros(len(ties.photo), dtype=np.bool_)
    used[chosen[estimate.agreeing]] = True
    known = known_walls(ties, used)
    case = Case(
        photo=photo,
        seen=seen,
        is_check=is_check,
        walls=ties.wall[chosen],
        estimate=estimate,
        known=known,
        error=wall_error(estimate.resection, known),
        rule=_gates(params),
        search_radius_px=_search_radius_px(ties, photo.name),
    )
    return _judged(case)


def _search_radius_px(ties: Ties, name: str) -> float:
    """What the matcher says of how far it looked for the ties of a photo."""
    photos = ties.details.get("photos")
    entry = photos.get(name) if isinstance(photos, Mapping) else None
    radius = entry.get("search_radius_px") if isinstance(entry, Mapping) else None
    return float(radius) if isinstance(radius, int | float) else math.inf


def _judged(case: Case) -> _Oriented:
    reason = reason_against(case)
    numbers = photo_numbers(case) if case.control.any() else None
    entry: JsonValue = None if numbers is None else numbers_json(case, numbers)
    if reason:
        refused = _refused(case.photo, reason, len(case.seen))
        return replace(refused, entry=entry)
    result, estimate = case.estimate.resection, case.estimate
    role = np.where(case.is_check, TieRole.CHECK, TieRole.CONTROL).astype(np.uint8)
    role[~estimate.agreeing] = TieRole.REJECTED
    return _Oriented(
        camera=Camera(
            photo=case.photo.name,
            status="ok",
            intrinsics=estimate.intrinsics,
            rotation_camera_from_world=result.camera.rotation,
            translation_camera_from_world=result.camera.translation,
            covariance=result.covariance[:6, :6],
            sigma0_px=result.sigma0 * float(np.median(case.seen.sigma_px[case.control])),
            sigma_wall_m=None if case.error is None else case.error.rms_m,
        ),
        role=role,
        residuals_px=estimate.fit.residuals_px,
        numbers=numbers,
        entry=entry,
        notes=tuple(warnings_for(case)),
    )


def _refused(photo: Photo, reason: str, n_ties: int) -> _Oriented:
    return _Oriented(
        camera=Camera(photo=photo.name, status=reason),
        role=np.full(n_ties, TieRole.REJECTED, dtype=np.uint8),
        residuals_px=np.full((n_ties, 2), np.nan),
    )


def _gates(params: OrientPnp.Params) -> GateRule:
    return GateRule(
        n_control_least=params.n_control_min,
        n_quadrant_least=params.n_quadrant_min,
        inlier_share_least=params.inlier_min_share,
        hull_ratio_least=params.hull_min_ratio,
        sigma_wall_most_gsd=params.sigma_wall_max_cells,
        sigma_corner_most_gsd=params.sigma_corner_max_cells,
    )


def _tell(ctx: StepContext, oriented: _Oriented) -> None:
    camera = oriented.camera
    if camera.status != "ok":
        ctx.warn(f"photo {camera.photo} is not oriented: {camera.status}")
    for note in oriented.notes:
        ctx.warn(f"photo {camera.photo}: {note}")


def _report(ctx: StepContext, found: list[_Oriented]) -> None:
    numbers = [item.numbers for item in found if item.camera.status == "ok" and item.numbers]
    n_ties = sum(len(item.role) for item in found)
    ctx.metric("n_photos", len(found), "1")
    ctx.metric("n_oriented", len(numbers), "1")
    ctx.metric("n_refused", len(found) - len(numbers), "1")
    ctx.metric("n_ties", n_ties, "1")
    ctx.metric("n_control", sum(item.n_control for item in numbers), "1")
    ctx.metric("n_check", sum(item.n_check for item in numbers), "1")
    rejected = sum(int((item.role == TieRole.REJECTED).sum()) for item in found)
    ctx.metric("rejected_share", rejected / max(n_ties, 1), "1")
    if not numbers:
        return
    sigmas = [item.camera.sigma_wall_m for item in found if item.camera.sigma_wall_m is not None]
    columns = {
        "control_rmse_px": ([item.control_rmse_px for item in numbers], "px"),
        "check_rmse_px": ([item.check_rmse_px for item in numbers], "px"),
        "check_rmse_mm": ([item.check_rmse_mm for item in numbers], "mm"),
        "sigma_wall_mm": ([1000.0 * sigma for sigma in sigmas], "mm"),
    }
    for name, (values, unit) in columns.items():
        known = [value for value in values if np.isfinite(value)]
        if known:
            ctx.metric(f"{name}_median", float(np.median(known)), unit)
            ctx.metric(f"{name}_worst", max(known), unit)
