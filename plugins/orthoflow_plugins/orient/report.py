"""Results of an orientation step: product, diagnostics, metrics, figures and residuals."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.files.drawing import (
    column_figure,
    encode_chart,
    in_column_style,
    map_chart,
    picture_figure,
    plane_ink,
    round_scale,
)
from orthoflow.files.images import decode_image
from orthoflow.geometry import frame_over
from orthoflow.geometry.cameras import to_opencv
from orthoflow.geometry.resection import pixels_by_point
from orthoflow.geometry.robust import median_deviation
from orthoflow.products import Camera, Cameras, JsonValue, Photo, ResidualRow, TieRole, Ties
from orthoflow.sdk import StepContext
from orthoflow_plugins.orient.gates import Candidate, sigmas_on_wall
from orthoflow_plugins.orient.pose import NOT_ORIENTED, Note, ties_of_photo

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Limit in standard deviations. It is exceeded by 4.55 % of a normal distribution, and by at most a
# quarter of any distribution (Chebyshev).
_BEYOND: Final = 2.0
SIDE_PX: Final = 900
# Colours as in Figure 17 of markiewicz2015: control green, rejected red, check yellow.
_ROLE_RGB: Final = {
    TieRole.REJECTED: (220, 40, 40),
    TieRole.CONTROL: (40, 200, 60),
    TieRole.CHECK: (250, 220, 40),
}
_MAX_FIGURES: Final = 24
_SUB_PIXEL_BITS: Final = 4
# Number of cells along the longer side of a map of predicted errors.
_MAP_CELLS: Final = 90
# Number of bars in histograms; normal distributions are shown as in Figures 18, 20, 21 and 23 of
# markiewicz2015.
_BARS: Final = 40
_BARS_OF_A_PHOTO: Final = 25
# Maximum number of photos that are shown separately in a figure.
_MAX_PHOTOS: Final = 30
# Height of the highest bar relative to the height of the row.
_ROW_SHARE: Final = 0.8
_BAR_COLOUR: Final = "#9db8d2"
_CURVE_COLOUR: Final = "#b03a2e"
# Length of the arrow that shows the direction of view in the plan of the photos.
_VIEW_M: Final = 0.4
# Maximum number of control points per photo in the plan of the photos.
_MAX_CONTROL: Final = 300
_PERCENTILE: Final = 99.5
# Maximum length of a photo name in figures.
_NAME_LETTERS: Final = 14
# Maximum number of residuals from which a density is estimated.
_MAX_KERNELS: Final = 5000
_KINDS: Final = (TieRole.CONTROL, TieRole.CHECK)


@dataclass(frozen=True, kw_only=True)
class Oriented:
    """The result of one photo.

    Attributes:
        camera: orientation of the photo, or the reason why there is none.
        chosen: (n,) indices of the ties of the photo among all ties.
        role: (n,) `TieRole` of these ties.
        residuals_px: (n, 2) observed minus computed pixels; NaN if the photo is not oriented.
        entry: entry of the photo in the record.
        notes: diagnostics of the photo.
        candidate: the tested values, if the orientation was accepted.
    """

    camera: Camera
    chosen: NDArray[np.intp]
    role: NDArray[np.uint8]
    residuals_px: NDArray[np.float64]
    entry: JsonValue = None
    notes: tuple[Note, ...] = ()
    candidate: Candidate | None = None

    def residuals_of(self, kind: TieRole) -> NDArray[np.float64]:
        """Return the finite residuals (m, 2) of ties with one role."""
        values = self.residuals_px[self.role == kind]
        return np.asarray(values[np.isfinite(values).all(axis=1)])


def pixel_mm(candidate: Candidate) -> float:
    """Return the median size of a photo pixel at the control points, in millimetres."""
    camera = candidate.estimate.resection.camera
    derivatives = pixels_by_point(camera, candidate.seen.points_world[candidate.control])
    across = np.linalg.svd(derivatives, compute_uv=False)
    return 1000.0 * float(np.median(1.0 / np.sqrt(across[:, 0] * across[:, 1])))


def numbers_json(candidate: Candidate) -> dict[str, JsonValue]:
    """Return the numbers of an orientation as JSON."""
    estimate, error = candidate.estimate, candidate.error
    result, n_agreeing = estimate.resection, int(estimate.agreeing.sum())
    entry: dict[str, JsonValue] = {
        # Check points that duplicate a control point are not counted.
        "n_control": n_agreeing - int(candidate.checked.sum()),
        "n_check": int(candidate.checked.sum()),
        "n_rejected": len(candidate.seen) - n_agreeing,
        "pixel_mm": pixel_mm(candidate),
        "hull_ratio": candidate.hull_ratio,
        "limit_sigma": estimate.limit,
        "sigma0": result.sigma0,
        "variance_factor": result.variance_factor,
        "lens": estimate.source,
        "focal_px": result.camera.fx,
        "k1": float(result.camera.distortion[0]),
        **estimate.numbers,
    }
    if error is not None:
        entry["sigma_wall_mm"] = 1000.0 * error.rms_m
        entry["sigma_wall_worst_mm"] = 1000.0 * error.worst_m
        corners_mm = (1000.0 * error.corners_m).tolist()
        entry["sigma_image_corners_mm"] = [mm if math.isfinite(mm) else None for mm in corners_mm]
    if result.lens.focal_sigma > 0.0:
        entry["focal_sigma_px"] = result.camera.fx * float(np.sqrt(result.covariance[6, 6]))
    return entry


def residual_table(candidate: Candidate) -> list[ResidualRow]:
    """Return the residual table, with separate rows for control and check points."""
    units = {"px": 1.0, "mm": pixel_mm(candidate)}
    if candidate.gsd_m is not None:
        units["cell"] = units["mm"] / (1000.0 * candidate.gsd_m)
    residuals_px, name = candidate.estimate.fit.residuals_px, candidate.photo.name
    return [
        *residual_rows(name, "control", residuals_px[candidate.control], units),
        *residual_rows(name, "check", residuals_px[candidate.checked], units),
    ]


def residual_rows(
    photo: str,
    role: str,
    residuals_px: NDArray[np.float64],
    units: Mapping[str, float],
) -> list[ResidualRow]:
    """Return the rows of the residual table for one photo and role.

    Args:
        photo: name of the photo.
        role: `control` or `check`.
        residuals_px: (n, 2) observed minus computed pixels.
        units: size of a pixel in each unit, by the name of the unit; includes `cell` if known.

    Returns:
        One row per coordinate and unit; empty if there are no residuals.
    """
    if not len(residuals_px):
        return []
    is_beyond = np.abs(residuals_px) > _BEYOND * np.sqrt(np.mean(residuals_px**2, axis=0))
    rows: list[ResidualRow] = []
    for axis, values, is_far in zip("uv", residuals_px.T, is_beyond.T, strict=True):
        beyond_cells = None
        if "cell" in units:
            beyond_cells = float((np.abs(values) > _BEYOND / units["cell"]).mean())
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
                rmse=float(np.sqrt(np.mean(scaled**2))),
                p95=float(np.percentile(lengths, 95.0)),
                max=float(lengths.max()),
                beyond_own=float(is_far.mean()),
                beyond_cells=beyond_cells,
                beyond_any=float(is_beyond.any(axis=1).mean()),
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
    """Return the product, and report diagnostics, metrics and figures.

    Args:
        ctx: the context.
        ties: all ties of the input.
        photos: the photos.
        found: the result for each photo.
        details: further details of the method.
    """
    role, residuals = ties.role.copy(), np.full_like(ties.residual_px, np.nan)
    for photo, oriented in zip(photos, found, strict=True):
        role[oriented.chosen] = oriented.role
        residuals[oriented.chosen] = oriented.residuals_px
        status = oriented.camera.status
        if status != "ok":
            ctx.report(NOT_ORIENTED, subject=photo.name, status=status)
        for note, values in oriented.notes:
            ctx.report(note, subject=photo.name, **values)
        mine = ties_of_photo(ties, photo.name)
        draw_ties(ctx, photo, ties.pixels_photo[mine], role[mine], f"Status: {status}")
    candidates = [item.candidate for item in found if item.candidate is not None]
    _measure(ctx, found, candidates)
    draw_wall_errors(ctx, candidates)
    draw_positions(ctx, candidates)
    draw_residuals(ctx, [item for item in found if item.camera.status == "ok"])
    return Cameras(
        cameras=tuple(item.camera for item in found),
        ties=replace(ties, role=role, residual_px=residuals),
        residual_table=tuple(row for each in candidates for row in residual_table(each)),
        details={"photos": {item.camera.photo: item.entry for item in found}, **(details or {})},
    )


def measure_expected(ctx: StepContext, cameras: Sequence[Camera]) -> None:
    """Report the expected error on the wall for each camera for which it is known."""
    sigmas = [camera.sigma_wall_m for camera in cameras if camera.sigma_wall_m is not None]
    _sum_up(ctx, "sigma_wall_mm", [1000.0 * sigma for sigma in sigmas], "mm")


def _chance_of_mean(values: NDArray[np.float64]) -> float | None:
    """Return the p-value of the t test that the mean is 0; None for fewer than two values."""
    from scipy.special import stdtr  # importing scipy.stats would take seconds

    n = len(values)
    if n < 2:
        return None
    deviation = float(values.std(ddof=1))
    if deviation == 0.0:
        return 1.0 if values[0] == 0.0 else 0.0
    return 2.0 * float(stdtr(n - 1, -abs(float(values.mean())) * math.sqrt(n) / deviation))


def _skewness(values: NDArray[np.float64]) -> float | None:
    """Return the third standardised moment; None if the variance is zero."""
    centred = values - values.mean()
    variance = float(np.mean(centred**2))
    return float(np.mean(centred**3)) / variance**1.5 if variance > 0.0 else None


def _measure(ctx: StepContext, found: Sequence[Oriented], candidates: Sequence[Candidate]) -> None:
    n_ties = sum(len(item.role) for item in found)
    n_oriented = sum(item.camera.status == "ok" for item in found)
    n_rejected = sum(int((item.role == TieRole.REJECTED).sum()) for item in found)
    n_check = [int(each.checked.sum()) for each in candidates]
    ctx.metric("n_photos", len(found), "1")
    ctx.metric("n_oriented", n_oriented, "1")
    ctx.metric("n_refused", len(found) - n_oriented, "1")
    ctx.metric("n_ties", n_ties, "1")
    n_agreeing = sum(int(each.estimate.agreeing.sum()) for each in candidates)
    ctx.metric("n_control", n_agreeing - sum(n_check), "1")
    ctx.metric("n_check", sum(n_check), "1")
    ctx.metric("rejected_share", n_rejected / max(n_ties, 1), "1")
    control, check = (
        [
            float(np.sqrt(np.mean(residuals**2))) if len(residuals) else math.nan
            for residuals in some
        ]
        for some in (
            [each.estimate.fit.residuals_px[each.control] for each in candidates],
            [each.estimate.fit.residuals_px[each.checked] for each in candidates],
        )
    )
    _sum_up(ctx, "control_rmse_px", control, "px")
    _sum_up(ctx, "check_rmse_px", check, "px")
    sizes_mm = [pixel_mm(each) for each in candidates]
    _sum_up(ctx, "check_rmse_mm", [a * b for a, b in zip(check, sizes_mm, strict=True)], "mm")
    measure_expected(ctx, [item.camera for item in found])


def _sum_up(ctx: StepContext, name: str, values: Sequence[float], unit: str) -> None:
    known = [value for value in values if np.isfinite(value)]
    if known:
        ctx.metric(f"{name}_median", float(np.median(known)), unit)
        ctx.metric(f"{name}_worst", max(known), unit)


def draw_ties(
    ctx: StepContext,
    photo: Photo,
    pixels_photo: NDArray[np.float64],
    role: NDArray[np.uint8],
    status: str,
) -> None:
    """Draw the ties of a photo: control green, check yellow, rejected red."""
    import cv2

    if len(ctx.figures) >= _MAX_FIGURES:
        return
    stem = photo.name.rpartition(".")[0] or photo.name
    name = f"ties_{re.sub(r'[^A-Za-z0-9_-]', '-', stem)}"
    if any(figure.name == name for figure in ctx.figures):
        name = f"{name}-{len(ctx.figures)}"
    rgb = decode_image(photo.encoded, f"photo {photo.name}")
    scale = min(1.0, SIDE_PX / max(photo.width, photo.height))
    size = (max(1, round(photo.width * scale)), max(1, round(photo.height * scale)))
    small = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    # Dim the photo so that the marks are visible.
    canvas = np.rint(0.7 * small).astype(np.uint8)
    unit = 1 << _SUB_PIXEL_BITS
    for kind, colour in _ROLE_RGB.items():
        at = np.rint(to_opencv(pixels_photo[role == kind] * scale) * unit).astype(int)
        for u, v in at.tolist():
            cv2.circle(canvas, (u, v), 2 * unit, colour, -1, cv2.LINE_AA, _SUB_PIXEL_BITS)
    counts = {kind: int(np.count_nonzero(role == kind)) for kind in _ROLE_RGB}
    ctx.figure(
        name,
        partial(_with_legend, canvas, counts),
        f"Ties of {photo.name}: control green, check yellow, rejected red. {status}. If green "
        "ties are spread over the whole wall, the orientation is reliable; if they are only in "
        "one corner or mixed with red ties everywhere, it is not.",
    )


@in_column_style()
def _with_legend(canvas: NDArray[np.uint8], counts: Mapping[TieRole, int]) -> bytes:
    from matplotlib.lines import Line2D

    figure, _ = picture_figure(canvas, extra_inches=0.2)
    handles = []
    for kind in (TieRole.CONTROL, TieRole.CHECK, TieRole.REJECTED):
        red, green, blue = (value / 255.0 for value in _ROLE_RGB[kind])
        mark = Line2D([], [], marker="o", linestyle="none", color=(red, green, blue))
        mark.set_label(f"{counts[kind]} {kind.name.lower()}")
        handles.append(mark)
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return encode_chart(figure)


def draw_wall_errors(ctx: StepContext, candidates: Sequence[Candidate]) -> None:
    """Draw a map of the predicted error on each wall, for the most accurate photo at each position.

    Args:
        ctx: the context.
        candidates: the accepted orientations.
    """
    walls = {wall.index: wall for candidate in candidates for wall in candidate.known}
    for index in sorted(walls):
        wall = walls[index]
        if len(ctx.figures) >= _MAX_FIGURES:
            return
        across, down = np.linalg.norm(wall.corners_world[[3, 1]] - wall.corners_world[0], axis=1)
        if (curved := wall.frame) is not None:
            across, down = curved.width * curved.gsd_m, curved.height * curved.gsd_m
        cell_m = max(across, down) / _MAP_CELLS
        shape = (max(1, round(down / cell_m)), max(1, round(across / cell_m)))
        best = np.full(shape, np.inf)
        for candidate in candidates:
            sigmas = sigmas_on_wall(candidate.estimate.resection, wall, shape)
            best = np.fmin(best, sigmas)
        shown = np.isfinite(best)
        if not shown.any():
            continue
        # With percentiles, a sparsely covered corner does not dominate the scale.
        median_m, high_m = np.percentile(best[shown], [50.0, 98.0])
        error_mm = np.where(shown, 1e3 * best, np.nan)
        label = "predicted error of a coordinate [mm]"
        if curved is None:
            frame = frame_over(wall.corners_world, wall.normal, gsd_m=cell_m)
        else:
            frame = replace(curved, gsd_m=cell_m, width=shape[1], height=shape[0])
        ctx.figure(
            f"wall_{wall.number}_predicted_error",
            partial(map_chart, error_mm, label, frame, low=0.0, high=round_scale(1e3 * high_m)),
            f"Predicted error of a coordinate on {wall.name}, for the most accurate photo at "
            f"each position; median {1e3 * median_m:.2g} mm. Grey: no oriented "
            "photo shows the wall. In bright areas far from ties, the orthoimage may "
            "be displaced; more ties there would help.",
        )


@in_column_style()
def draw_positions(ctx: StepContext, candidates: Sequence[Candidate]) -> None:
    """Draw the positions of photos and control points in two views of the first wall.

    One view is along the wall, and the other one faces it; for a floor, the second view is a plan.
    The figure follows Figure 3 of skarlatos2012.

    Args:
        ctx: the context.
        candidates: the accepted orientations.
    """
    walls = {wall.index: wall for candidate in candidates for wall in candidate.known}
    if not walls:
        return
    first = walls[min(walls)]
    sides = first.corners_world[[3, 1]] - first.corners_world[0]
    axes_world = np.vstack([sides / np.linalg.norm(sides, axis=1)[:, None], first.normal])
    origin = first.corners_world[0]
    feet = np.array([one.estimate.resection.camera.centre_world for one in candidates])
    everything = np.vstack([feet, *(wall.corners_world for wall in walls.values())]) - origin
    spans_m = np.ptp(everything @ axes_world.T, axis=0)
    # Draw both views at the same scale.
    heights = np.clip(2.9 * spans_m[[2, 1]] / spans_m[0], 0.5, 3.5)
    figure = column_figure(float(heights.sum()) + 0.9)
    panels = figure.subplots(2, 1, height_ratios=heights)
    for panel, axis, label in zip(panels, (2, 1), ("before it", "down it"), strict=True):
        shown = axes_world[[0, axis]].T
        for wall in walls.values():
            ring = (wall.ring_world - origin) @ shown
            panel.plot(*ring.T, color=plane_ink(wall.number), linewidth=1.2)
        for candidate in candidates:
            _draw_position(panel, candidate, origin, shown, is_named=axis == 1)
        panel.set_aspect("equal")
        panel.set_xlabel("along the first wall [m]")
        panel.set_ylabel(f"{label} [m]")
    panels[1].invert_yaxis()
    ctx.figure(
        "positions",
        figure,
        "Positions and viewing directions of the oriented photos, with their control ties: seen "
        "along the first wall (top) and facing it (bottom); for a floor, the lower view is its "
        "plan. A photo behind a wall or far from the others is oriented wrongly.",
    )


@in_column_style()
def draw_residuals(ctx: StepContext, photos: Sequence[Oriented]) -> None:
    """Draw histograms of the residuals of the oriented photos, together and separately."""
    pooled = {
        kind: np.vstack([np.empty((0, 2)), *(photo.residuals_of(kind) for photo in photos)])
        for kind in _KINDS
    }
    drawn = {kind: values for kind, values in pooled.items() if len(values) > 2}
    if drawn:
        _draw_pooled(ctx, drawn)
        _draw_each(ctx, photos, drawn)


def _draw_position(
    axes: Axes,
    candidate: Candidate,
    origin: NDArray[np.float64],
    shown: NDArray[np.float64],
    *,
    is_named: bool,
) -> None:
    """Draw position, direction and control points of a photo on two world axes (3, 2)."""
    camera = candidate.estimate.resection.camera
    control = (candidate.seen.points_world[candidate.control] - origin) @ shown
    step = max(1, len(control) // _MAX_CONTROL)
    axes.plot(*control[::step].T, ".", markersize=0.8, color="#30a040")
    x, y = ((camera.centre_world - origin) @ shown).tolist()
    across, down = (_VIEW_M * camera.rotation[2] @ shown).tolist()
    axes.arrow(x, y, across, down, head_width=0.2 * _VIEW_M, color=_CURVE_COLOUR, linewidth=0.8)
    # Names are shown in only one view: in the other, those of photos one above the other would
    # overlap.
    if is_named:
        axes.annotate(
            candidate.photo.name, (x, y), xytext=(2, 2), textcoords="offset points", fontsize=6.0
        )


def _draw_pooled(ctx: StepContext, pooled: dict[TieRole, NDArray[np.float64]]) -> None:
    figure = column_figure(0.4 + 1.35 * len(pooled))
    panels = figure.subplots(len(pooled), 2, squeeze=False, sharex=True)
    reach = _reach(np.vstack(list(pooled.values())))
    for (kind, values), row in zip(pooled.items(), panels, strict=True):
        for label, column, axes in zip("uv", values.T, row, strict=True):
            # A single outline is drawn faster than forty bars.
            counts, edges = np.histogram(column, bins=_BARS, range=(-reach, reach))
            axes.stairs(counts, edges, fill=True, color=_BAR_COLOUR)
            _draw_curves(axes, column, edges)
            axes.set_title(f"{kind.name.lower()} {label}: {len(column)}, SD {column.std():.2f} px")
        row[0].set_ylabel("ties per bar")
    for axes in panels[-1]:
        axes.set_xlabel("observed - computed [px]")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    ctx.figure(
        "residuals",
        figure,
        "Residuals of all oriented photos. Narrow peaks around 0 are good. A peak away from 0, a "
        "density with secondary peaks, or a density that is broader for check ties than for "
        "control ties indicates a systematic error or a group of wrong ties.",
    )


def _draw_each(
    ctx: StepContext,
    photos: Sequence[Oriented],
    pooled: dict[TieRole, NDArray[np.float64]],
) -> None:
    shown = photos[:_MAX_PHOTOS]
    figure = column_figure(len(pooled) * (0.45 + 0.22 * len(shown)))
    panels = figure.subplots(len(pooled), 2, squeeze=False, sharex=True, sharey=True)
    reach = _reach(np.vstack(list(pooled.values())))
    for kind, row in zip(pooled, panels, strict=True):
        for axis, axes in enumerate(row):
            for place, photo in enumerate(shown):
                _draw_row(axes, photo.residuals_of(kind)[:, axis], -place, reach)
            axes.axvline(0.0, color="#888888", linewidth=0.5)
            axes.set_title(f"{kind.name.lower()} {'uv'[axis]}; number, SD [px]")
    panels[0, 0].set_xlim(-reach, 1.9 * reach)
    panels[0, 0].set_ylim(0.9 - len(shown), 1.0)
    panels[0, 0].set_yticks(
        [-row for row in range(len(shown))],
        [_end_of(photo.camera.photo) for photo in shown],
    )
    for axes in panels[-1]:
        axes.set_xlabel("observed - computed [px]")
    ctx.figure(
        "residuals_by_photo",
        figure,
        "Residuals of each oriented photo, with their density and the normal distribution of the "
        "same mean and SD. Look at photos whose row is broader than the others, is not centred on "
        "0, or has several peaks.",
    )


def _draw_row(axes: Axes, values: NDArray[np.float64], base: float, reach: float) -> None:
    if len(values) < 3:
        return
    counts, edges = np.histogram(values, bins=_BARS_OF_A_PHOTO, range=(-reach, reach))
    peak = float(_normal(values, edges, np.array([values.mean()]))[0])
    scale = _ROW_SHARE / max(float(counts.max()), peak, 1e-9)
    axes.stairs(scale * counts + base, edges, baseline=base, fill=True, color=_BAR_COLOUR)
    _draw_curves(axes, values, edges, scale=scale, base=base)
    text = f"{len(values)}, {values.std():.2f}"
    axes.text(1.88 * reach, base + 0.1, text, fontsize=6.0, ha="right")


def _draw_curves(
    axes: Axes,
    values: NDArray[np.float64],
    edges: NDArray[np.float64],
    *,
    scale: float = 1.0,
    base: float = 0.0,
) -> None:
    """Draw the normal distribution and the estimated density, which may have several peaks."""
    grid = np.linspace(edges[0], edges[-1], 161)
    curve = scale * _normal(values, edges, grid) + base
    axes.plot(grid, curve, color="black", linestyle="--", linewidth=0.6, label="normal")
    # Use Silverman's rule of thumb with a robust spread, since a standard deviation increased by
    # outliers would remove secondary peaks.
    spread = min(float(values.std()), median_deviation(values, float(np.median(values))))
    width = max(0.9 * spread * len(values) ** -0.2, 1e-9)
    some = values[:: max(1, len(values) // _MAX_KERNELS)]
    kernels = np.exp(-0.5 * ((grid[:, None] - some) / width) ** 2) / width / np.sqrt(2.0 * np.pi)
    density = len(values) * (edges[1] - edges[0]) * kernels.mean(axis=1)
    axes.plot(grid, scale * density + base, color=_CURVE_COLOUR, linewidth=0.8, label="density")


def _end_of(name: str) -> str:
    """Shorten a photo name at its beginning, since the names in a series differ at the end."""
    return name if len(name) <= _NAME_LETTERS else f"..{name[2 - _NAME_LETTERS :]}"


def _reach(values: NDArray[np.float64]) -> float:
    """Return the largest residual to draw, common to all panels of a figure."""
    return round_scale(max(float(np.percentile(np.abs(values), _PERCENTILE)), 1e-6))


def _normal(
    values: NDArray[np.float64], edges: NDArray[np.float64], grid: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the counts per bar of a normal distribution with the mean and SD of the values."""
    mean, deviation = float(values.mean()), max(float(values.std()), 1e-9)
    density = np.exp(-0.5 * ((grid - mean) / deviation) ** 2) / deviation / np.sqrt(2.0 * np.pi)
    return np.asarray(len(values) * (edges[1] - edges[0]) * density)
