"""Metrics and diagnostics of wall rasters."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry import SphereBend, omega_phi_deg
from orthoflow.geometry.bands import count_cells
from orthoflow.geometry.cloud_quality import scan_step_m
from orthoflow.geometry.levels import plain_tone
from orthoflow.geometry.robust import depth_noise_m
from orthoflow.products import PointCloud, SurfaceMask, Wall
from orthoflow.sdk import DiagnosticSpec, StepContext
from orthoflow_plugins.raster.emptiness import Cause, Emptiness

# For walls with more cells, medians are estimated from a subset of the rows.
CELLS_ASKED: Final = 1 << 26
# Maximum spacing of the points of a scan, in cells.
_STEP_MOST_CELLS: Final = 2.0 / 3.0
# Minimum share of empty or interpolated cells for a warning.
_SHARE_WORTH_WORDS: Final = 0.1
# Minimum share of cells for a warning about a cause.
_CAUSE_WORTH_WORDS: Final = 0.01
# Minimum share of cells for a warning about omitted objects in front of a wall.
_LEFT_OUT_WORTH_WORDS: Final = 0.05
# Smoothing preserves depth steps of at least about this many standard deviations.
_STEP_SIGMAS: Final = 6.0
# Smallest share that is not printed as 0.0 %.
_SHARE_LEAST: Final = 0.0005

FRONT_LEFT_OUT: Final = DiagnosticSpec(
    code="wall-front-left-out",
    severity="error",
    text="{subject}: {share:.1%} of the wall is missing: objects up to {before_m} m in front of "
    "its plane are not considered part of the wall",
    remedy="set {step}.buffer_front_m={buffer_front_m} to include them",
    rank_by="share",
)
STOOD_ON: Final = DiagnosticSpec(
    code="floor-stood-on",
    severity="note",
    text=(
        "{subject}: {share:.1%} of its cells are empty under objects that project up to "
        "{before_m} m from it"
    ),
    rank_by="share",
)
BEHIND_BUFFER: Final = DiagnosticSpec(
    code="wall-behind-buffer",
    severity="warning",
    text="{subject}: {share:.1%} of its cells are empty: the points there are about {behind_m} m "
    "behind its plane",
    remedy="if they belong to the wall, set {step}.buffer_behind_m={buffer_behind_m}",
    rank_by="share",
)
HIDDEN: Final = DiagnosticSpec(
    code="wall-hidden",
    severity="warning",
    text="{subject}: {share:.1%} of its cells are empty because objects "
    "hide them from every station",
    remedy="scan from another station",
    rank_by="share",
)
SPARSE: Final = DiagnosticSpec(
    code="wall-sparse",
    severity="warning",
    text="{subject}: {share:.1%} of its cells are empty next to scanned cells: gaps between "
    "points, shadows of relief, or borders",
    remedy="increase {step}.gsd_m or {step}.recover_gap_cells to close narrow gaps",
    rank_by="share",
)
UNSEEN: Final = DiagnosticSpec(
    code="wall-unseen",
    severity="warning",
    text="{subject}: {share:.1%} of its cells are empty: nothing was scanned there (sky, glass, "
    "or hidden from all stations)",
    rank_by="share",
)
PLAIN: Final = DiagnosticSpec(
    code="wall-of-one-tone",
    severity="warning",
    text="{subject}: {share:.0%} of its {what} is {tone}; {cause}",
    remedy="{way}",
    rank_by="share",
)
COVERED: Final = DiagnosticSpec(
    code="wall-includes-others",
    severity="warning",
    text="{subject} shows {included} as relief, so these planes have no orthoimages of their own",
    remedy="set {step}.skip_covered=false to create one for each plane",
)
DISTORTED: Final = DiagnosticSpec(
    code="sphere-distorted",
    severity="note",
    text="{subject} is a sphere of radius {radius_m:.3f} m, which cannot be unrolled: lengths from "
    "its middle are to scale, and lengths across them are t / sin(t) times those on the sphere, "
    "with the angle t from the middle: up to {stretch:.2f} times at the edge",
    rank_by="stretch",
)
NO_INTENSITY: Final = DiagnosticSpec(
    code="scan-without-intensity",
    severity="warning",
    text="the cloud has no laser intensity; the luminance of its colours (Rec. 601) is used "
    "instead",
)
DEPTH_ONLY: Final = DiagnosticSpec(
    code="scan-without-intensity-and-colour",
    severity="warning",
    text="the cloud has neither intensity nor colour; only the depths of walls are rasterised",
)
NO_POINT: Final = DiagnosticSpec(
    code="wall-without-points",
    severity="error",
    text="{subject}: no points are within its buffer",
    remedy="check {step}.buffer_front_m and {step}.buffer_behind_m",
)
CLOSE_CELLS: Final = DiagnosticSpec(
    code="cells-finer-than-points",
    severity="warning",
    text="{subject}: cells of gsd_m = {gsd_m:g} m are used for points about {step_m:.2g} m "
    "apart; {measured:.0%} of the cells have a point, {interpolated:.0%} are interpolated",
    remedy="{remedy}",
    rank_by="interpolated",
)
NOISY: Final = DiagnosticSpec(
    code="depths-smoothed",
    severity="warning",
    text="{subject}: the depth noise of {noise_m:.2g} m exceeds the cell size of {gsd_m:g} m, so "
    "depths are smoothed over neighbouring cells, and relief of less than about {relief_m:.2g} m "
    "may be lost",
    remedy="set {step}.gsd_m={least_m:g} or larger, with which noise is averaged in the cells",
    rank_by="noise_m",
)
CAUSES: Final[dict[Cause, DiagnosticSpec]] = {
    "behind": BEHIND_BUFFER,
    "before": FRONT_LEFT_OUT,
    "hidden": HIDDEN,
    "sparse": SPARSE,
    "unseen": UNSEEN,
}

_Number = TypeVar("_Number", np.float32, np.uint32)


def warn(
    ctx: StepContext, walls: Sequence[Wall], steps_m: Sequence[float], intensity_source: str
) -> None:
    """Report missing data and distortion of walls, and cells finer than the point spacing."""
    if intensity_source == "luminance":
        ctx.report(NO_INTENSITY)
    if intensity_source == "none":
        ctx.report(DEPTH_ONLY)
    for wall, step_m in zip(walls, steps_m, strict=True):
        gsd_m = wall.frame.gsd_m
        if not wall.count.any():
            ctx.report(NO_POINT, subject=wall.name)
            continue
        if isinstance(bend := wall.frame.bend, SphereBend):
            ctx.report(
                DISTORTED,
                subject=wall.name,
                radius_m=bend.radius_m,
                stretch=bend.largest_stretch,
            )
        is_close = step_m > _STEP_MOST_CELLS * gsd_m
        filled = count_cells(wall.mask, SurfaceMask.RECOVERED) / wall.mask.size
        if is_close or filled >= _SHARE_WORTH_WORDS:
            measured = np.count_nonzero(wall.count) / wall.count.size
            larger = (
                f"set {{step}}.gsd_m={_least_gsd_m(step_m / _STEP_MOST_CELLS):g} or larger to "
                "interpolate fewer cells"
            )
            ctx.report(
                CLOSE_CELLS,
                subject=wall.name,
                gsd_m=gsd_m,
                step_m=step_m,
                measured=measured,
                interpolated=filled,
                remedy=larger if is_close else "",
            )


def is_noisy(ctx: StepContext, wall: Wall) -> bool:
    """Return whether the depths of a wall have more noise than its cells are wide, and report it.

    At 45 degrees, such noise displaces the pixels of a photo by more than a cell, and noise is
    mistaken for relief, whose steps are measured in cells.
    """
    noise_m, gsd_m = depth_noise_m(wall.depth_m), wall.frame.gsd_m
    if noise_m <= gsd_m:
        return False
    # The noise of a mean is inversely proportional to the cell size, if cells contain points.
    apart_m = max(gsd_m, scan_step_m(wall.count, gsd_m=gsd_m))
    ctx.report(
        NOISY,
        subject=wall.name,
        noise_m=noise_m,
        gsd_m=gsd_m,
        relief_m=_STEP_SIGMAS * noise_m,
        least_m=_least_gsd_m(math.sqrt(noise_m * apart_m)),
    )
    return True


def _least_gsd_m(least_m: float) -> float:
    """Return the next larger number with two significant digits."""
    digit_m = 10.0 ** (math.floor(math.log10(least_m)) - 1)
    # Round up, because the nearest number with two significant digits may be too fine.
    return float(f"{math.ceil(least_m / digit_m - 1e-6) * digit_m:.2g}")


def report_tones(ctx: StepContext, walls: Sequence[Wall], cloud: PointCloud) -> None:
    """Report walls whose intensity or colour is almost entirely black, white or uniform."""
    scans = cloud.source.get("scans")
    scales: dict[str, None] = {}
    colours: dict[str, None] = {}
    for scan in scans if isinstance(scans, list) else []:
        if isinstance(scan, dict) and isinstance(scale := scan.get("intensity"), dict):
            scales[f"{scale['low']} to {scale['high']} ({scale['rule']})"] = None
        if isinstance(scan, dict) and scan.get("rgb_scale"):
            colours[str(scan["rgb_scale"])] = None
    scaled = f"the scans' intensities are scaled from {', '.join(scales) or '0 to 1'}"
    read_as = f", read as {', '.join(colours)}" if colours else ""
    for wall in walls:
        if wall.intensity is not None:
            states = (SurfaceMask.MEASURED, SurfaceMask.RECOVERED)
            if found := plain_tone(wall.intensity, wall.mask, states, white=1.0):
                way = "set the intensity of white with {step[read.scan]}.intensity_max=NUMBER"
                words = {"what": "intensity", "cause": scaled, "way": way}
                ctx.report(PLAIN, subject=wall.name, tone=found[0], share=found[1], **words)
        if wall.rgb is None or wall.rgb_mask is None:
            continue
        if found := plain_tone(wall.rgb, wall.rgb_mask, (1,), white=255.0):
            cause = f"the colours of its points are, too{read_as}"
            way = "check whether the program that wrote the scan exported colours"
            words = {"what": "colour", "cause": cause, "way": way}
            ctx.report(PLAIN, subject=wall.name, tone=found[0], share=found[1], **words)


def warn_of_covered(ctx: StepContext, names: Mapping[int, str], covered: Mapping[int, int]) -> None:
    """Report planes that are not rasterised because a larger wall contains them.

    Args:
        ctx: context of the step.
        names: names of all planes and walls.
        covered: index of each such plane, with the index of the wall that contains it.
    """
    for wall in sorted(set(covered.values())):
        left_out = [names[index] for index, shown_by in covered.items() if shown_by == wall]
        ctx.report(COVERED, subject=names[wall], included=", ".join(left_out))


def report(ctx: StepContext, walls: Sequence[Wall], step_m: float, up: NDArray[np.float64]) -> None:
    """Report metrics of the walls.

    Args:
        ctx: context of the step.
        walls: at least one wall.
        step_m: point spacing on the first wall, in metres.
        up: (3,) unit vector.
    """
    frame = walls[0].frame
    omega_deg, phi_deg = omega_phi_deg(frame.facing_world, up)
    ctx.metric("omega_deg", omega_deg, "deg")
    ctx.metric("phi_deg", phi_deg, "deg")
    ctx.metric("area_m2", frame.height * frame.width * frame.gsd_m**2, "m2")
    n_cells = sum(wall.mask.size for wall in walls)
    counts = [_sampled(wall.count) for wall in walls]
    per_cell = np.concatenate([count[count > 0] for count in counts])
    spread_m = np.concatenate(
        [_sampled(wall.sigma_m)[count > 1] for wall, count in zip(walls, counts, strict=True)]
    )
    ctx.metric("n_walls", len(walls), "1")
    ctx.metric("n_points_inside", sum(int(wall.count.sum(dtype=np.int64)) for wall in walls), "1")
    ctx.metric("points_per_cell", float(np.median(per_cell)), "1")
    ctx.metric("scan_step_mm", 1000.0 * step_m, "mm")
    ctx.metric("gsd_mm", 1000.0 * walls[0].frame.gsd_m, "mm")
    noise_m = depth_noise_m(walls[0].depth_m)
    ctx.metric("depth_noise_mm", 1000.0 * noise_m, "mm")
    if spread_m.size:
        ctx.metric("sigma_median_mm", 1000.0 * float(np.median(spread_m)), "mm")
    for state in SurfaceMask:
        share = sum(count_cells(wall.mask, state) for wall in walls) / n_cells
        name = "empty" if state == SurfaceMask.VOID else state.name.lower()
        ctx.metric(f"{name}_share", share, "1")


def report_empty(ctx: StepContext, walls: Sequence[Wall], empty: Sequence[Emptiness]) -> None:
    """Report the causes of empty cells as metrics, and as diagnostics if many cells are empty."""
    sizes = np.array([wall.mask.size for wall in walls], dtype=np.float64)
    for cause in CAUSES:
        shares = [of_wall.shares[cause] for of_wall in empty]
        ctx.metric(f"empty_{cause}_share", float(sizes @ shares) / float(sizes.sum()), "1")
    for wall, of_wall in zip(walls, empty, strict=True):
        if not wall.count.any() or of_wall.share < _SHARE_LEAST:
            continue
        shares_of = {cause: of_wall.shares[cause] for cause in CAUSES}
        ctx.log(
            f"{wall.name}: {of_wall.share:.1%} of its cells are empty: "
            + ", ".join(f"{share:.1%} {cause}" for cause, share in shares_of.items())
        )
        # Do not warn about causes with few cells: tiles at the border of a hole contain cells of
        # its surroundings, too.
        least = max(_CAUSE_WORTH_WORDS, 0.1 * of_wall.share)
        if shares_of["before"] < _LEFT_OUT_WORTH_WORDS and of_wall.share < _SHARE_WORTH_WORDS:
            continue
        for cause, share in shares_of.items():
            if share >= least:
                is_floor = wall.frame.raster_axes in {"level", "map"}
                spec = STOOD_ON if cause == "before" and is_floor else CAUSES[cause]
                ctx.report(
                    spec,
                    subject=wall.name,
                    share=share,
                    behind_m=_digits(of_wall.behind_m),
                    before_m=_digits(of_wall.before_m),
                    buffer_behind_m=_rounded_up(of_wall.behind_m),
                    buffer_front_m=_rounded_up(of_wall.before_m),
                )


def _digits(depth_m: float) -> float | None:
    return float(f"{depth_m:.2g}") if math.isfinite(depth_m) else None


def _rounded_up(depth_m: float) -> float | None:
    """Round a depth up to whole decimetres; None for NaN."""
    return math.ceil(10.0 * depth_m) / 10.0 if math.isfinite(depth_m) else None


def _sampled(values: NDArray[_Number]) -> NDArray[_Number]:
    return values[:: max(1, values.size // CELLS_ASKED)]
